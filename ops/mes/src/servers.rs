//! The nodes of running servers in the graph: which servers, and their connections.
//!
//! Reading order: `board` (the states of all servers), `connection` (when a server is read),
//! `searched` and `walk` (the search through its address space), `facts` (attributes and values),
//! `graph`.

mod board;
mod connection;
mod facts;
mod graph;
mod searched;
mod walk;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use discovery::{PresentServer, ServerChange};
use knowledge::Knowledge;
use skills::ClientOptions;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio::time::sleep;

use self::board::{FollowedServerStatus, ServerBoard};
use self::connection::FollowedServer;
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
            board: Arc::new(ServerBoard::new(knowledge, sources)),
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
        self.board.json()
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
            self.board.keep_only(planned.keys(), &missing);
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
            *status = FollowedServerStatus {
                server: name.clone(),
                endpoint: planned.endpoint.clone(),
                ..FollowedServerStatus::default()
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

/// Interval of comparing the NodeSets in the graph.
const NODESETS_EVERY: Duration = Duration::from_secs(5);
const MOST_SERVERS: usize = 100;

#[cfg(test)]
mod tests;
