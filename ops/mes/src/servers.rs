//! The nodes of running servers in the graph: which servers, and their connections.
//!
//! Reading order: `connection` (when a server is read), `searched` and `walk` (the search through
//! its address space), `facts` (attributes and values), `graph`.

mod connection;
mod facts;
mod graph;
mod searched;
mod walk;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use discovery::{PresentServer, ServerChange};
use knowledge::{Knowledge, KnowledgeSource, SourceKind};
use serde::Serialize;
use skills::ClientOptions;
use tokio::sync::{Notify, Semaphore, watch};
use tokio::task::JoinHandle;
use tokio::time::sleep;

use self::connection::FollowedServer;
use self::graph::ServerUris;
pub(crate) use self::searched::SearchLimits;
use crate::settings::{NamedServers, ServerEntry};
use crate::sources::MesSources;

/// The servers whose nodes are in the graph.
pub(crate) struct LiveServers {
    board: Arc<ServerBoard>,
    options: ClientOptions,
    /// The ApplicationUri of the MES, which is not read itself.
    own_uri: String,
    wanted: Mutex<WantedServers>,
    changed: Notify,
}

#[derive(Default)]
struct WantedServers {
    entries: Vec<ServerEntry>,
    /// The discovered servers by their names in discovery.
    present: BTreeMap<String, PresentServer>,
    /// Number of commands to read all servers again.
    commands: u64,
}

/// The parts that all connections share.
struct ServerBoard {
    knowledge: Arc<Knowledge>,
    sources: Arc<MesSources>,
    uris: ServerUris,
    /// The namespaces of the NodeSets in the graph, whose types are not read from servers.
    nodesets: watch::Sender<BTreeSet<String>>,
    reading: Semaphore,
    statuses: Mutex<BTreeMap<String, ServerStatus>>,
}

/// The state of a server in `/status`.
#[derive(Debug, Clone, Default, Serialize)]
struct ServerStatus {
    server: String,
    endpoint: String,
    state: ServerState,
    application_uri: String,
    /// The IRI of its graph.
    graph: String,
    nodes: usize,
    /// Maximum number of nodes of the read that is under way.
    #[serde(skip)]
    reserved: usize,
    statements: usize,
    /// Whether no nodes and no references are missing.
    complete: bool,
    /// Time of the last read in ms since 1970, its duration in ms, and the number of reads.
    read_ms: u64,
    took_ms: u64,
    reads: u64,
    /// The reason of the last read.
    reason: String,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum ServerState {
    #[default]
    Connecting,
    NotConnected,
    /// Its nodes are being read.
    Reading,
    /// The graph has the nodes as they were read last.
    Current,
    /// The nodes cannot be read; the graph has the nodes that were read before, if any.
    Failed,
    /// Another server has its ApplicationUri.
    Duplicate,
    /// Discovery has not found it.
    NotFound,
}

/// A server to follow.
#[derive(Clone)]
struct PlannedServer {
    endpoint: String,
    entry: ServerEntry,
}

struct RunningServer {
    planned: PlannedServer,
    again: Arc<Notify>,
    task: JoinHandle<()>,
}

impl LiveServers {
    pub(crate) fn new(
        knowledge: Arc<Knowledge>,
        sources: Arc<MesSources>,
        options: ClientOptions,
        own_uri: &str,
    ) -> Self {
        Self {
            board: Arc::new(ServerBoard {
                nodesets: watch::Sender::new(nodesets(&knowledge)),
                knowledge,
                sources,
                uris: ServerUris::default(),
                reading: Semaphore::new(READ_AT_A_TIME),
                statuses: Mutex::default(),
            }),
            options,
            own_uri: own_uri.to_owned(),
            wanted: Mutex::default(),
            changed: Notify::new(),
        }
    }

    /// Replaces the servers of the YAML, and reads all servers again.
    pub(crate) fn configure(&self, entries: Vec<ServerEntry>) {
        {
            let mut wanted = self.wanted();
            wanted.entries = entries;
            wanted.commands = wanted.commands.wrapping_add(1);
        }
        self.changed.notify_one();
    }

    /// Takes a change of discovery.
    pub(crate) fn discovered(&self, change: &ServerChange) {
        let known = change.known();
        match change {
            ServerChange::Gone { .. } => drop(self.wanted().present.remove(&known.name)),
            ServerChange::Seen(_) | ServerChange::Restarted(_) => {
                let name = known.name.clone();
                drop(self.wanted().present.insert(name, known.clone()));
            }
        }
        self.changed.notify_one();
    }

    /// Returns the states of all servers.
    pub(crate) fn status(&self) -> serde_json::Value {
        let statuses = self.board.statuses();
        serde_json::json!(statuses.values().collect::<Vec<_>>())
    }

    /// Follows the servers until the program ends.
    pub(crate) async fn run(self: Arc<Self>) {
        let mut running: BTreeMap<String, RunningServer> = BTreeMap::new();
        let mut commands = 0;
        loop {
            let (planned, missing, now) = {
                let wanted = self.wanted();
                let (planned, missing) = wanted.plan(&self.own_uri);
                (planned, missing, wanted.commands)
            };
            let is_command = now != commands;
            commands = now;
            let ended: Vec<String> = running
                .iter()
                .filter(|(name, one)| {
                    let same = |planned: &&PlannedServer| planned.is_same(&one.planned);
                    planned.get(*name).filter(same).is_none()
                })
                .map(|(name, _)| name.clone())
                .collect();
            for name in ended {
                if let Some(one) = running.remove(&name) {
                    one.task.abort();
                    // The task was aborted.
                    drop(one.task.await);
                }
            }
            self.board.keep_only(&planned, &missing);
            for (name, planned) in planned {
                match running.get(&name) {
                    Some(one) if is_command => one.again.notify_one(),
                    Some(_) => {}
                    None => drop(running.insert(name.clone(), self.start(name, planned))),
                }
            }
            loop {
                tokio::select! {
                    () = self.changed.notified() => break,
                    () = sleep(NODESETS_EVERY) => self.board.compare_nodesets(),
                }
            }
        }
    }

    fn start(&self, name: String, planned: PlannedServer) -> RunningServer {
        let again = Arc::new(Notify::new());
        self.board.status(&name, |status| {
            *status = ServerStatus {
                server: name.clone(),
                endpoint: planned.endpoint.clone(),
                ..ServerStatus::default()
            };
        });
        let followed = FollowedServer {
            name,
            endpoint: planned.endpoint.clone(),
            entry: planned.entry.clone(),
            options: self.options.clone(),
            board: Arc::clone(&self.board),
            again: Arc::clone(&again),
        };
        RunningServer {
            planned,
            again,
            task: tokio::spawn(followed.run()),
        }
    }

    fn wanted(&self) -> MutexGuard<'_, WantedServers> {
        self.wanted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl WantedServers {
    /// Returns the servers to follow by their names, and findings about the others by their names.
    fn plan(&self, own_uri: &str) -> (BTreeMap<String, PlannedServer>, BTreeMap<String, String>) {
        let mut planned: BTreeMap<String, PlannedServer> = BTreeMap::new();
        let mut missing = BTreeMap::new();
        let mut endpoints: BTreeSet<String> = BTreeSet::new();
        let mut entries: Vec<&ServerEntry> = self.entries.iter().collect();
        // A server that has an entry of its own is not one of the others.
        entries.sort_by(|one, other| one.which.cmp(&other.which));
        for entry in entries {
            let name = entry.which.text();
            let found: Vec<(String, String)> = match &entry.which {
                NamedServers::Endpoint(url) => vec![(name.to_owned(), url.clone())],
                NamedServers::Application(uri) => {
                    let is_it = |one: &&PresentServer| one.application_uri.as_ref() == Some(uri);
                    let found = self.present.values().find(is_it);
                    let found = found.map(|one| (name.to_owned(), one.url.clone()));
                    if found.is_none() {
                        let what = "no server with this ApplicationUri was discovered; start it, \
                                    or give its endpoint instead";
                        missing.insert(name.to_owned(), what.to_owned());
                    }
                    found.into_iter().collect()
                }
                NamedServers::Discovered => {
                    let is_own =
                        |one: &PresentServer| one.application_uri.as_deref() == Some(own_uri);
                    let others = self
                        .present
                        .values()
                        .filter(|one| !one.is_lds() && !is_own(one));
                    others
                        .map(|one| (one.url.clone(), one.url.clone()))
                        .collect()
                }
            };
            for (name, endpoint) in found {
                if planned.len() >= MOST_SERVERS {
                    let what = format!("there are more than {MOST_SERVERS} servers; name fewer");
                    missing.insert(entry.which.text().to_owned(), what);
                    break;
                }
                if endpoints.insert(endpoint.trim_end_matches('/').to_owned()) {
                    let entry = entry.clone();
                    planned.insert(name, PlannedServer { endpoint, entry });
                }
            }
        }
        (planned, missing)
    }
}

impl PlannedServer {
    fn is_same(&self, other: &Self) -> bool {
        self.endpoint == other.endpoint && self.entry.is_same(&other.entry)
    }
}

impl ServerBoard {
    /// Compares the NodeSets in the graph with those that are known. A change makes all servers be
    /// read again.
    fn compare_nodesets(&self) {
        let current = nodesets(&self.knowledge);
        self.nodesets.send_if_modified(|known| {
            let is_changed = *known != current;
            *known = current;
            is_changed
        });
    }

    /// Returns the namespaces whose types a server does not state: those of the NodeSets in the
    /// graph, and the ApplicationUris of other components and servers.
    fn left_out(&self, own: &str) -> BTreeSet<String> {
        let mut all = nodesets(&self.knowledge);
        let sources = self.knowledge.sources().into_iter();
        let components = sources
            .filter(|source| matches!(source.kind, SourceKind::Component | SourceKind::Server))
            .map(|source| source.name);
        let others = components.chain(self.uris.all());
        all.extend(others.filter(|uri| uri != own));
        all
    }

    /// Reserves nodes of the number that all servers may have together. Returns their number.
    fn reserve(&self, name: &str, wanted: usize) -> usize {
        let mut statuses = self.statuses();
        let others = statuses.iter().filter(|(other, _)| *other != name);
        let taken: usize = others
            .map(|(_, status)| status.nodes.max(status.reserved))
            .sum();
        let reserved = wanted.min(MOST_NODES_OF_ALL.saturating_sub(taken));
        statuses.entry(name.to_owned()).or_default().reserved = reserved;
        reserved
    }

    /// Changes the status of a server.
    fn status(&self, name: &str, change: impl FnOnce(&mut ServerStatus)) {
        change(self.statuses().entry(name.to_owned()).or_default());
    }

    /// Replaces the findings about a server. Each has a text, and whether the server is not in the
    /// graph because of it.
    fn findings(&self, name: &str, findings: Vec<(String, bool)>) {
        let source = KnowledgeSource::new(SourceKind::Server, name);
        self.sources.replace_findings(&source, findings);
    }

    /// Removes the statuses and findings of servers that are not followed any more.
    fn keep_only(
        &self,
        planned: &BTreeMap<String, PlannedServer>,
        missing: &BTreeMap<String, String>,
    ) {
        let is_kept = |name: &String| planned.contains_key(name) || missing.contains_key(name);
        let removed: Vec<String> = {
            let mut statuses = self.statuses();
            let all: Vec<String> = statuses.keys().cloned().collect();
            statuses.retain(|name, _| is_kept(name));
            all.into_iter().filter(|name| !is_kept(name)).collect()
        };
        for name in removed {
            self.findings(&name, Vec::new());
        }
        for (name, what) in missing {
            self.status(name, |status| {
                *status = ServerStatus {
                    server: name.clone(),
                    state: ServerState::NotFound,
                    ..ServerStatus::default()
                };
            });
            self.findings(name, vec![(what.clone(), true)]);
        }
    }

    fn statuses(&self) -> MutexGuard<'_, BTreeMap<String, ServerStatus>> {
        self.statuses.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the namespaces of the NodeSets in the graph.
fn nodesets(knowledge: &Knowledge) -> BTreeSet<String> {
    let sources = knowledge.sources().into_iter();
    let nodesets = sources.filter(|source| source.kind == SourceKind::NodeSet);
    nodesets.map(|source| source.name).collect()
}

/// Interval of comparing the NodeSets in the graph.
const NODESETS_EVERY: Duration = Duration::from_secs(5);
/// Maximum number of nodes of all servers, without types that are read beside them.
const MOST_NODES_OF_ALL: usize = 200_000;
/// Number of servers that are read at a time.
const READ_AT_A_TIME: usize = 2;
const MOST_SERVERS: usize = 100;

#[cfg(test)]
mod tests;
