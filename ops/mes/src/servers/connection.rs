//! The connection to a server: its nodes are read after each connect, after each reported change
//! of its model, on command, and at an interval.

use std::sync::Arc;
use std::time::Duration;

use plant_opcua::client::{
    ClientConfig, ClientSubscription, Link, MonitoredWatch, Notice, OpcUaClient, Select,
};
use plant_opcua::types::{DateTime, ObjectId, ObjectTypeId, VariableId, Variant};
use skills::ClientOptions;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info};

use super::graph::ServerGraph;
use super::walk::{self, Searched};
use super::{ServerBoard, ServerState, ServerStatus};
use crate::cell::now;
use crate::settings::{NamedServers, ServerEntry};

/// A server whose nodes are in the graph.
pub(super) struct FollowedServer {
    /// The name in findings and in the status.
    pub(super) name: String,
    pub(super) endpoint: String,
    pub(super) entry: ServerEntry,
    pub(super) options: ClientOptions,
    pub(super) board: Arc<ServerBoard>,
    /// Signals a command to read the nodes again.
    pub(super) again: Arc<Notify>,
}

impl FollowedServer {
    /// Follows the server until the task is aborted.
    pub(super) async fn run(self) {
        let config = ClientConfig {
            pki: self.options.pki.clone(),
            user: self.entry.user.clone().or(self.options.user.clone()),
            security: self.options.security,
            timeout: REQUEST,
            backoff: BACKOFF,
            ..ClientConfig::new(
                &self.options.application_uri,
                &self.options.application_name,
            )
        };
        let client = OpcUaClient::open(config, &self.endpoint);
        let mut link = client.link();
        loop {
            let state = link.borrow_and_update().clone();
            match state {
                Link::Up {
                    connects,
                    application_uri,
                    ..
                } => {
                    let is_other = |link: &Link| !matches!(link, Link::Up { connects: other, .. } if *other == connects);
                    tokio::select! {
                        () = self.connected(&client, &application_uri) => {}
                        _ = link.wait_for(is_other) => {}
                    }
                    // The graph is removed with the connection.
                    self.board.status(&self.name, |status| {
                        (status.nodes, status.statements) = (0, 0);
                    });
                    continue;
                }
                Link::Down { reason, .. } => {
                    self.state(ServerState::NotConnected);
                    self.finding(&format!("it is not connected: {reason}"));
                }
                Link::Connecting => {}
                Link::Closed => return,
            }
            if link.changed().await.is_err() {
                return;
            }
        }
    }

    /// Keeps the graph current while the server is connected.
    async fn connected(&self, client: &OpcUaClient, application_uri: &str) {
        let uri = match application_uri.is_empty() || application_uri.len() > LONGEST_URI {
            true => self.endpoint.as_str(),
            false => application_uri,
        };
        let taken = loop {
            match self.board.uris.take(uri, &self.name) {
                Ok(taken) => break taken,
                // The graph of the previous connection is still being removed.
                Err(owner) if owner == self.name => {}
                Err(owner) => {
                    self.state(ServerState::Duplicate);
                    // Discovery may find a server that has an entry under another address.
                    if self.entry.which == NamedServers::Discovered {
                        self.board.findings(&self.name, Vec::new());
                    } else {
                        self.finding(&format!(
                        "it has the ApplicationUri `{uri}` of the server {owner}, whose nodes would \
                         have the same IRIs; give each server an ApplicationUri of its own"
                    ));
                    }
                }
            }
            self.board.uris.free(uri).await;
        };
        let graph = ServerGraph::new(Arc::clone(&self.board.knowledge), taken);
        let mut changes = ModelChanges::new(client);
        let mut failed = FIRST_PAUSE;
        let mut reason = "connected";
        loop {
            let is_read = self.read(client, &graph, uri, reason).await;
            let pause = match is_read {
                true => self.entry.every,
                false => failed,
            };
            failed = match is_read {
                true => FIRST_PAUSE,
                false => (failed * 2).min(LONGEST_PAUSE),
            };
            let read = Instant::now();
            reason = tokio::select! {
                () = sleep_until(read + pause) => "interval",
                () = self.again.notified() => "command",
                why = changes.next() => why,
            };
            let burst = Instant::now() + BURST;
            changes.settle(burst.max(read + SETTLED)).await;
        }
    }

    /// Reads the nodes, and replaces the graph. Returns whether that was possible.
    async fn read(
        &self,
        client: &OpcUaClient,
        graph: &ServerGraph,
        uri: &str,
        reason: &str,
    ) -> bool {
        // Few servers are read at a time, so that their memory is bounded.
        let Ok(_permit) = self.board.reading.acquire().await else {
            return false;
        };
        self.state(ServerState::Reading);
        let began = Instant::now();
        let known = self.board.nodesets();
        let is_known = move |namespace: &str| known.contains(namespace);
        let search = walk::search(client, &self.entry.start, &self.entry.limits, &is_known);
        let found = timeout(self.entry.limits.within + SLOWEST_END, search).await;
        let searched = match found {
            Ok(Ok(searched)) => searched,
            Ok(Err(fault)) => return self.failed(&fault.to_string()),
            Err(_) => return self.failed("it does not respond in time"),
        };
        let Searched {
            mut space,
            findings,
        } = searched;
        uri.clone_into(&mut space.application_uri);
        space.endpoint.clone_from(&self.endpoint);
        space.browsed = super::facts::time_text(&DateTime::now());
        let (nodes, is_complete) = (space.nodes.len(), space.is_complete);
        let statements = match graph.write(space).await {
            Ok(statements) => statements,
            Err(why) => return self.failed(&why),
        };
        let took = began.elapsed();
        let server = &self.name;
        info!(
            server,
            nodes,
            statements,
            ?took,
            reason,
            "the nodes of a server are in the graph"
        );
        self.board.status(&self.name, |status| {
            *status = ServerStatus {
                state: ServerState::Current,
                application_uri: uri.to_owned(),
                graph: graph.iri(),
                nodes,
                statements,
                complete: is_complete,
                read_ms: now(),
                took_ms: u64::try_from(took.as_millis()).unwrap_or(u64::MAX),
                reads: status.reads.saturating_add(1),
                reason: reason.to_owned(),
                ..status.clone()
            };
        });
        let findings = findings.into_iter().map(|what| (what, false));
        self.board.findings(&self.name, findings.collect());
        true
    }

    fn failed(&self, why: &str) -> bool {
        self.state(ServerState::Failed);
        self.finding(&format!("its nodes cannot be read: {why}"));
        false
    }

    fn state(&self, state: ServerState) {
        self.board.status(&self.name, |status| status.state = state);
    }

    fn finding(&self, what: &str) {
        let what = what.chars().take(LONGEST_FINDING).collect();
        self.board.findings(&self.name, vec![(what, true)]);
    }
}

/// The changes of its model that a server reports.
struct ModelChanges {
    subscription: ClientSubscription,
    /// The known values of the watched variables.
    known: [Option<Variant>; 2],
}

impl ModelChanges {
    fn new(client: &OpcUaClient) -> Self {
        let value = |id: VariableId| MonitoredWatch::Value(id.into());
        let events = |of_type: ObjectTypeId| MonitoredWatch::Events {
            node: ObjectId::Server.into(),
            select: vec![Select::new(ObjectTypeId::BaseEventType, "EventType")],
            of_type: Some(of_type.into()),
        };
        let watches = vec![
            value(VariableId::Server_NamespaceArray),
            value(VariableId::Server_ServerStatus_State),
            events(ObjectTypeId::BaseModelChangeEventType),
            // Some servers, such as those of asyncua, do not include subtypes.
            events(ObjectTypeId::GeneralModelChangeEventType),
        ];
        Self {
            subscription: client.subscribe(watches, INTERVAL, QUEUE),
            known: [None, None],
        }
    }

    /// Waits for a change. Returns its kind.
    async fn next(&mut self) -> &'static str {
        loop {
            let Some(notice) = self.subscription.next().await else {
                // The client is closed, and so is the task.
                return std::future::pending().await;
            };
            if let Some(change) = self.change(notice) {
                return change;
            }
        }
    }

    fn change(&mut self, notice: Notice) -> Option<&'static str> {
        match notice {
            Notice::Event { .. } => Some("model change"),
            Notice::Value { watch, value } => {
                let known = self.known.get_mut(watch)?;
                let before = std::mem::replace(known, value.value);
                let is_changed = before.is_some() && *known != before;
                is_changed.then_some("change of the server")
            }
            Notice::Refused { watch, status } => {
                debug!(watch, %status, "a server does not report changes of its model");
                None
            }
            Notice::Subscribed => None,
        }
    }

    /// Takes further changes until a time, so that a burst causes one search.
    async fn settle(&mut self, until: Instant) {
        loop {
            tokio::select! {
                () = sleep_until(until) => return,
                _ = self.next() => {}
            }
        }
    }
}

/// Time limit of a request.
const REQUEST: Duration = Duration::from_secs(10);
/// Time after the limit of a search in which its last requests end.
const SLOWEST_END: Duration = Duration::from_secs(30);
const BACKOFF: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(30));
/// Pauses after a failed search.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Shortest time between two searches.
const SETTLED: Duration = Duration::from_secs(1);
/// Time in which further changes belong to the first change.
const BURST: Duration = Duration::from_millis(200);
/// Publishing interval of the subscription.
const INTERVAL: Duration = Duration::from_millis(500);
const QUEUE: usize = 64;
const LONGEST_URI: usize = 512;
const LONGEST_FINDING: usize = 1000;
