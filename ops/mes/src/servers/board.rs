//! The states of all servers in the graph, and the parts that their connections share.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use knowledge::{Knowledge, KnowledgeSource, SourceKind};
use serde::Serialize;
use tokio::sync::{Semaphore, watch};

use super::graph::ServerUris;
use crate::sources::MesSources;

/// The parts that all connections share.
pub(super) struct ServerBoard {
    pub(super) knowledge: Arc<Knowledge>,
    pub(super) sources: Arc<MesSources>,
    pub(super) uris: ServerUris,
    /// The namespaces of the NodeSets in the graph, whose types are not read from servers.
    pub(super) nodesets: watch::Sender<BTreeSet<String>>,
    pub(super) reading: Semaphore,
    statuses: Mutex<BTreeMap<String, FollowedServerStatus>>,
}

/// The state of a server in `/status`.
#[derive(Debug, Clone, Default, Serialize)]
pub(super) struct FollowedServerStatus {
    pub(super) server: String,
    pub(super) endpoint: String,
    pub(super) state: FollowedServerState,
    pub(super) application_uri: String,
    /// The IRI of its graph.
    pub(super) graph: String,
    pub(super) nodes: usize,
    /// Maximum number of nodes of the read that is under way.
    #[serde(skip)]
    pub(super) reserved: usize,
    pub(super) statements: usize,
    /// Whether no nodes and no references are missing.
    pub(super) complete: bool,
    /// Time of the last read in ms since 1970, its duration in ms, and the number of reads.
    pub(super) read_ms: u64,
    pub(super) took_ms: u64,
    pub(super) reads: u64,
    /// The reason of the last read.
    pub(super) reason: String,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum FollowedServerState {
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

impl ServerBoard {
    pub(super) fn new(knowledge: Arc<Knowledge>, sources: Arc<MesSources>) -> Self {
        Self {
            nodesets: watch::Sender::new(nodesets(&knowledge)),
            knowledge,
            sources,
            uris: ServerUris::default(),
            reading: Semaphore::new(READ_AT_A_TIME),
            statuses: Mutex::default(),
        }
    }

    /// Returns the states of all servers.
    pub(super) fn json(&self) -> serde_json::Value {
        let statuses = self.statuses();
        serde_json::json!(statuses.values().collect::<Vec<_>>())
    }

    /// Compares the NodeSets in the graph with those that are known. A change makes all servers be
    /// read again.
    pub(super) fn compare_nodesets(&self) {
        let current = nodesets(&self.knowledge);
        self.nodesets.send_if_modified(|known| {
            let is_changed = *known != current;
            *known = current;
            is_changed
        });
    }

    /// Returns the namespaces that are left out when a server is read: those of the NodeSets in the
    /// graph, and the ApplicationUris of other components and servers.
    pub(super) fn left_out(&self, own: &str) -> BTreeSet<String> {
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
    pub(super) fn reserve(&self, name: &str, wanted: usize) -> usize {
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
    pub(super) fn status(&self, name: &str, change: impl FnOnce(&mut FollowedServerStatus)) {
        change(self.statuses().entry(name.to_owned()).or_default());
    }

    /// Replaces the findings about a server. Each has a text, and whether the server is not in the
    /// graph because of it.
    pub(super) fn findings(&self, name: &str, findings: Vec<(String, bool)>) {
        let source = KnowledgeSource::new(SourceKind::Server, name);
        self.sources.replace_findings(&source, findings);
    }

    /// Removes the statuses and findings of servers that are not followed any more.
    pub(super) fn keep_only<'n>(
        &self,
        planned: impl Iterator<Item = &'n String>,
        missing: &BTreeMap<String, String>,
    ) {
        let planned: BTreeSet<&String> = planned.collect();
        let is_kept = |name: &String| planned.contains(name) || missing.contains_key(name);
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
                *status = FollowedServerStatus {
                    server: name.clone(),
                    state: FollowedServerState::NotFound,
                    ..FollowedServerStatus::default()
                };
            });
            self.findings(name, vec![(what.clone(), true)]);
        }
    }

    fn statuses(&self) -> MutexGuard<'_, BTreeMap<String, FollowedServerStatus>> {
        self.statuses.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the namespaces of the NodeSets in the graph.
fn nodesets(knowledge: &Knowledge) -> BTreeSet<String> {
    let sources = knowledge.sources().into_iter();
    let nodesets = sources.filter(|source| source.kind == SourceKind::NodeSet);
    nodesets.map(|source| source.name).collect()
}

/// Maximum number of nodes of all servers, without types that are read beside them.
pub(super) const MOST_NODES_OF_ALL: usize = 200_000;
/// Number of servers that are read at a time.
const READ_AT_A_TIME: usize = 2;
