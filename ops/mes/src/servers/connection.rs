//! The connection to a server: its nodes are read after each connect, after each reported change
//! of its model, on command, and at an interval.

use std::sync::Arc;
use std::time::Duration;

use plant_opcua::client::{
    ClientConfig, ClientSubscription, Link, MonitoredWatch, Notice, OpcUaClient, Select,
};
use plant_opcua::types::{DateTime, NodeId, ObjectId, ObjectTypeId, VariableId, Variant};
use skills::ClientOptions;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info};

use super::board::{FollowedServerState, FollowedServerStatus, MOST_NODES_OF_ALL, ServerBoard};
use super::graph::ServerGraph;
use super::walk::{self, Searched};
use crate::clock::now;
use crate::search_limits::SearchLimits;
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
            user: self.entry.user.clone(),
            security: self.options.security,
            timeout: REQUEST,
            backoff: BACKOFF,
            ..ClientConfig::new(
                &self.options.application_uri,
                &self.options.application_name,
            )
        };
        let client = OpcUaClient::open(config, &self.endpoint);
        // A server that ends the session during a read is not read after each connect.
        let mut retry = ReadRetry::default();
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
                        () = self.connected(&client, &application_uri, &mut retry) => {}
                        _ = link.wait_for(is_other) => {}
                    }
                    // The graph is removed with the connection.
                    self.board.status(&self.name, |status| {
                        (status.nodes, status.statements, status.reserved) = (0, 0, 0);
                    });
                    continue;
                }
                Link::Down { reason, .. } => {
                    self.state(FollowedServerState::NotConnected);
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

    /// Returns why the connected server is not the server of the entry.
    fn other(&self, application_uri: &str) -> Option<String> {
        if application_uri == self.options.application_uri {
            return Some("it is this MES, which is not read itself; remove the entry".to_owned());
        }
        match &self.entry.which {
            NamedServers::Application(wanted) if wanted != application_uri => Some(format!(
                "the server at {} has the ApplicationUri `{application_uri}`; correct the entry, or \
                 give the endpoint instead",
                self.endpoint
            )),
            NamedServers::Endpoint(_) | NamedServers::Application(_) | NamedServers::Discovered => {
                None
            }
        }
    }

    /// Keeps the graph current while the server is connected.
    async fn connected(&self, client: &OpcUaClient, application_uri: &str, retry: &mut ReadRetry) {
        let only_discovered = self.entry.which == NamedServers::Discovered;
        if let Some(why) = self.other(application_uri) {
            self.state(FollowedServerState::Failed);
            if only_discovered {
                self.board.findings(&self.name, Vec::new());
            } else {
                self.finding(&why);
            }
            return std::future::pending().await;
        }
        let uri = match application_uri.is_empty() || application_uri.len() > LONGEST_URI {
            true => self.endpoint.as_str(),
            false => application_uri,
        };
        let uris = &self.board.uris;
        let _claim = (!only_discovered).then(|| uris.claim(uri, &self.name));
        let taken = loop {
            match uris.take(uri, &self.name, only_discovered) {
                Ok(taken) => break taken,
                // The graph of the previous connection is still being removed.
                Err(owner) if owner == self.name => {}
                Err(owner) => {
                    self.state(FollowedServerState::Duplicate);
                    // Discovery may find a server that has an entry under another address.
                    if only_discovered {
                        self.board.findings(&self.name, Vec::new());
                    } else {
                        self.finding(&format!(
                        "it has the ApplicationUri `{uri}` of the server {owner}, whose nodes would \
                         have the same IRIs; give each server an ApplicationUri of its own"
                    ));
                    }
                }
            }
            uris.free(uri, only_discovered).await;
        };
        let graph = ServerGraph::new(Arc::clone(&self.board.knowledge), taken);
        let claimed = async {
            match only_discovered {
                true => uris.claimed(uri).await,
                false => std::future::pending().await,
            }
        };
        tokio::select! {
            () = self.reads(client, &graph, uri, retry) => {}
            () = claimed => {}
        }
    }

    /// Reads the nodes again and again.
    async fn reads(
        &self,
        client: &OpcUaClient,
        graph: &ServerGraph,
        uri: &str,
        retry: &mut ReadRetry,
    ) {
        let mut changes = ModelChanges::new(client);
        let mut nodesets = self.board.nodesets.subscribe();
        let mut reason = "connected";
        tokio::select! {
            () = sleep_until(retry.not_before) => {}
            () = self.again.notified() => reason = COMMAND,
        }
        loop {
            nodesets.mark_unchanged();
            let began = Instant::now();
            retry.begins(began);
            let is_read = self.read(client, graph, uri, reason).await;
            let ended = Instant::now();
            if is_read {
                retry.is_over(ended);
            }
            let next = match is_read {
                true => ended + self.entry.every,
                false => retry.not_before,
            };
            let earliest = ended + rest_after(reason, ended - began);
            reason = tokio::select! {
                () = sleep_until(next) => "interval",
                () = self.again.notified() => COMMAND,
                _ = nodesets.changed() => "NodeSets",
                why = changes.next() => why,
            };
            if reason == COMMAND {
                continue;
            }
            let burst = Instant::now() + BURST;
            tokio::select! {
                () = changes.settle(burst.max(earliest).max(retry.not_before)) => {}
                () = self.again.notified() => reason = COMMAND,
            }
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
        self.state(FollowedServerState::Reading);
        let began = Instant::now();
        let left_out = self.board.left_out(uri);
        let is_known = |namespace: &str| left_out.contains(namespace);
        let most = self.board.reserve(&self.name, self.entry.limits.nodes);
        if most == 0 {
            return self.failed(&too_many_nodes());
        }
        let limits = SearchLimits {
            nodes: most,
            ..self.entry.limits.clone()
        };
        let search = walk::search(client, &self.entry.start, &limits, &is_known);
        let found = timeout(self.entry.limits.within + SLOWEST_END, search).await;
        let searched = match found {
            Ok(Ok(searched)) => searched,
            Ok(Err(fault)) => return self.failed(&fault.to_string()),
            Err(_) => return self.failed("it does not respond in time"),
        };
        let Searched {
            mut space,
            mut findings,
        } = searched;
        if most < self.entry.limits.nodes && !space.is_complete {
            findings.push(too_many_nodes());
        }
        uri.clone_into(&mut space.application_uri);
        space.endpoint.clone_from(&self.endpoint);
        space.browsed = super::facts::time_text(&DateTime::now());
        let (nodes, is_complete) = (space.nodes.len(), space.is_complete);
        let statements = match graph.write(space, left_out).await {
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
            *status = FollowedServerStatus {
                state: FollowedServerState::Current,
                application_uri: uri.to_owned(),
                graph: graph.iri(),
                nodes,
                reserved: 0,
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
        self.board.status(&self.name, |status| {
            (status.state, status.reserved) = (FollowedServerState::Failed, 0);
        });
        self.finding(&format!("its nodes cannot be read: {why}"));
        false
    }

    fn state(&self, state: FollowedServerState) {
        self.board.status(&self.name, |status| status.state = state);
    }

    fn finding(&self, what: &str) {
        let what = what.chars().take(LONGEST_FINDING).collect();
        self.board.findings(&self.name, vec![(what, true)]);
    }
}

/// The time before which a server is not read again after a read that failed or was interrupted.
/// It lasts over connections.
struct ReadRetry {
    pause: Duration,
    not_before: Instant,
}

impl Default for ReadRetry {
    fn default() -> Self {
        Self {
            pause: FIRST_PAUSE,
            not_before: Instant::now(),
        }
    }
}

impl ReadRetry {
    /// Takes the begin of a read, which may end with the connection.
    fn begins(&mut self, now: Instant) {
        self.not_before = now + self.pause;
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }

    /// Takes the end of a completed read.
    fn is_over(&mut self, ended: Instant) {
        self.pause = FIRST_PAUSE;
        self.not_before = ended;
    }
}

/// Returns the shortest time until the next read. A server whose changes cause reads is not read
/// most of the time.
fn rest_after(reason: &str, took: Duration) -> Duration {
    match reason {
        MODEL_CHANGE | SERVER_CHANGE => (took * REST).max(SHORTEST_REST),
        _ => SETTLED,
    }
}

fn too_many_nodes() -> String {
    format!(
        "all servers have more than {MOST_NODES_OF_ALL} nodes; name fewer servers, or lower `nodes`"
    )
}

/// The changes of its model that a server reports.
struct ModelChanges<'c> {
    client: &'c OpcUaClient,
    subscription: ClientSubscription,
    /// The known values of the watched variables.
    known: [Option<Variant>; 2],
}

impl<'c> ModelChanges<'c> {
    fn new(client: &'c OpcUaClient) -> Self {
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
            client,
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
            if let Some(change) = self.change(notice).await {
                return change;
            }
        }
    }

    async fn change(&mut self, notice: Notice) -> Option<&'static str> {
        match notice {
            Notice::Event { fields, .. } => {
                // A server may ignore the filter, and send events of all types.
                let Some(Variant::NodeId(of_type)) = fields.into_iter().next() else {
                    return None;
                };
                let base: NodeId = ObjectTypeId::BaseModelChangeEventType.into();
                let is_change = self.client.is_subtype_of(&of_type, &base).await;
                is_change.unwrap_or(false).then_some(MODEL_CHANGE)
            }
            Notice::Value { watch, value } => {
                let known = self.known.get_mut(watch)?;
                let before = std::mem::replace(known, value.value);
                let is_changed = before.is_some() && *known != before;
                is_changed.then_some(SERVER_CHANGE)
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
/// Shortest time between two searches because of changes, and the same as a multiple of the
/// duration of the last search.
const SHORTEST_REST: Duration = Duration::from_secs(10);
const REST: u32 = 10;
/// Reasons of a search.
const COMMAND: &str = "command";
const MODEL_CHANGE: &str = "model change";
const SERVER_CHANGE: &str = "change of the server";
/// Publishing interval of the subscription.
const INTERVAL: Duration = Duration::from_millis(500);
const QUEUE: usize = 64;
const LONGEST_URI: usize = 512;
const LONGEST_FINDING: usize = 1000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interrupted_reads_are_repeated_ever_later_until_one_is_completed() {
        let mut retry = ReadRetry::default();
        let now = Instant::now();
        let pauses: Vec<u64> = (0..7)
            .map(|_| {
                retry.begins(now);
                (retry.not_before - now).as_secs()
            })
            .collect();
        assert_eq!(pauses, [2, 4, 8, 16, 32, 60, 60]);
        retry.is_over(now);
        assert_eq!(retry.not_before, now);
        retry.begins(now);
        assert_eq!((retry.not_before - now).as_secs(), 2);
    }

    #[test]
    fn reads_because_of_changes_leave_the_server_most_of_the_time() {
        let seconds = Duration::from_secs;
        assert_eq!(rest_after(MODEL_CHANGE, seconds(3)), seconds(30));
        assert_eq!(rest_after(SERVER_CHANGE, seconds(0)), seconds(10));
        assert_eq!(rest_after("connected", seconds(3)), SETTLED);
    }
}
