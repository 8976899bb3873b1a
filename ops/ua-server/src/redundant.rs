//! Redundant servers: the role of this server, and the nodes with which clients choose a server
//! (OPC 10000-4, 6.6.2).
//!
//! All servers of a set show the values of the space, so that the set is Hot. The active server
//! alone sends the values that clients write, and calls Methods. The others refuse both, and have a
//! lower ServiceLevel. Each server shows the ServiceLevels of all servers of the set, which their
//! heartbeats carry.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bridge_core::{Redundancy, RedundancyRole};
use bridge_node::RedundancyRank;
use mappings::{Endpoint, Mapping, Server};
use opcua::server::address_space::AddressSpace;
use opcua::sync::Mutex;
use opcua::types::{
    ExtensionObject, NodeId, ObjectId, ObjectTypeId, RedundantServerDataType, ReferenceTypeId,
    ServerState, UAString, VariableId, Variant,
};
use plant_opcua::server::CoreValue;

/// Returns the other servers of the set of a ranked server, with their endpoints.
pub(crate) fn others(server: &Server) -> impl Iterator<Item = (&str, &Endpoint)> {
    let endpoints = if is_member(server) {
        &server.redundant_endpoints[..]
    } else {
        &[]
    };
    let servers = server.redundant.iter().map(String::as_str).zip(endpoints);
    servers.filter(|(uri, _)| *uri != server.application_uri)
}

/// Returns whether a ranked server is one of a redundant set.
pub(crate) fn is_member(server: &Server) -> bool {
    server.redundant.contains(&server.application_uri)
}

/// The role of a server.
#[derive(Debug, Clone, Default)]
pub(crate) struct ServerRole {
    is_standby: Arc<AtomicBool>,
}

impl ServerRole {
    /// Creates the role of a server that starts: it is a standby if it is one of several servers.
    pub(crate) fn new(rank: Option<RedundancyRank>) -> Self {
        Self {
            is_standby: Arc::new(AtomicBool::new(rank.is_some())),
        }
    }

    /// Returns whether another server sends the values that clients write.
    pub(crate) fn is_standby(&self) -> bool {
        self.is_standby.load(Ordering::Acquire)
    }

    pub(crate) fn set_active(&self, is_active: bool) {
        self.is_standby.store(!is_active, Ordering::Release);
    }
}

/// Returns the mapping for the server of a rank: with the ApplicationUri of the rank.
pub(crate) fn ranked(mapping: &Arc<Mapping>, rank: Option<RedundancyRank>) -> Arc<Mapping> {
    let ranked = rank.and_then(|rank| mapping.for_rank(rank.get()));
    ranked.map_or_else(|| Arc::clone(mapping), Arc::new)
}

/// The servers of a redundant set with their ServiceLevels, as this server knows them.
#[derive(Clone)]
pub(crate) struct ServerSet {
    /// The rank of this server; `None` without redundancy.
    rank: Option<RedundancyRank>,
    members: Arc<Mutex<Members>>,
}

/// The servers by their ranks, in the order of the ServerUriArray.
struct Members {
    servers: Vec<RedundantServerDataType>,
    is_changed: bool,
}

impl Members {
    fn set(&mut self, rank: RedundancyRank, (level, state): (u8, ServerState)) {
        let at = usize::from(rank.get()).checked_sub(1);
        let Some(server) = at.and_then(|at| self.servers.get_mut(at)) else {
            return;
        };
        self.is_changed |= (server.service_level, server.server_state) != (level, state);
        server.service_level = level;
        server.server_state = state;
    }
}

impl ServerSet {
    /// Creates the set of a server that starts. It knows no other server.
    pub(crate) fn new(server: &Server, rank: Option<RedundancyRank>) -> Self {
        let uris = rank.map_or(&[][..], |_| &server.redundant);
        let servers = uris.iter().map(|uri| RedundantServerDataType {
            server_id: uri.as_str().into(),
            service_level: UNREACHABLE,
            server_state: ServerState::Unknown,
        });
        let set = Self {
            rank,
            members: Arc::new(Mutex::new(Members {
                servers: servers.collect(),
                is_changed: false,
            })),
        };
        set.set_own(BEST_DEGRADED);
        set
    }

    /// Sets the ServiceLevel of this server.
    pub(crate) fn set_own(&self, level: u8) {
        if let Some(rank) = self.rank {
            self.members.lock().set(rank, (level, ServerState::Running));
        }
    }

    /// Returns the ServiceLevel of this server; `None` without redundancy.
    pub(crate) fn own(&self) -> Option<u8> {
        let at = usize::from(self.rank?.get()).checked_sub(1)?;
        Some(self.members.lock().servers.get(at)?.service_level)
    }

    /// Sets the other servers by their heartbeats.
    pub(crate) fn follow(&self, redundancy: &Redundancy, now: Instant) {
        let mut members = self.members.lock();
        let ranks = (1..=RedundancyRank::MOST).filter_map(RedundancyRank::new);
        for rank in ranks.filter(|rank| Some(*rank) != self.rank) {
            // A restarted server is a second peer for some time.
            let peers = redundancy.peers(now);
            let peers = peers.filter(|peer| peer.rank() == rank && peer.age(now) < LOST_AFTER);
            let peer = peers.min_by_key(|peer| peer.age(now));
            let seen = peer.map(|peer| {
                // A server of an earlier version does not send its level.
                let by_role = match peer.role() {
                    RedundancyRole::Active => u8::MAX,
                    RedundancyRole::Starting | RedundancyRole::Standby => BEST_DEGRADED,
                };
                let level = peer.service_level().unwrap_or(by_role);
                (level, ServerState::Running)
            });
            members.set(rank, seen.unwrap_or((UNREACHABLE, ServerState::Unknown)));
        }
    }

    /// Returns the RedundantServerArray (OPC 10000-5, 6.3.7 and 12.7).
    fn value(&self) -> Variant {
        let servers = self.members.lock().servers.clone();
        let servers = servers.into_iter().map(ExtensionObject::from_message);
        servers.collect::<Vec<ExtensionObject>>().into()
    }

    /// Returns the RedundantServerArray if it has changed since the last call.
    pub(crate) fn take_change(&self) -> Option<Variant> {
        let is_changed = std::mem::take(&mut self.members.lock().is_changed);
        is_changed.then(|| self.value())
    }
}

/// Makes the ServerRedundancy object of a redundant server a NonTransparentRedundancyType, with the
/// ServerUriArray among its properties (OPC 10000-5, 6.3.9).
pub(crate) fn prepare(core: &mut AddressSpace) {
    let object: NodeId = ObjectId::Server_ServerRedundancy.into();
    let before: NodeId = ObjectTypeId::ServerRedundancyType.into();
    let after: NodeId = ObjectTypeId::NonTransparentRedundancyType.into();
    let uris: NodeId = VariableId::Server_ServerRedundancy_ServerUriArray.into();
    // A core namespace without the reference has none to delete.
    let _was_there = core.delete_reference(&object, &before, ReferenceTypeId::HasTypeDefinition);
    core.insert_reference(&object, &after, ReferenceTypeId::HasTypeDefinition);
    core.insert_reference(&object, &uris, ReferenceTypeId::HasProperty);
}

/// Returns the values of ServerRedundancy (OPC 10000-5, 6.3.7 and 6.3.9).
pub(crate) fn values(server: &Server, set: &ServerSet) -> Vec<(VariableId, CoreValue)> {
    let support = match set.rank {
        Some(_) => HOT,
        None => NONE,
    };
    let uris = match set.rank {
        Some(_) => &server.redundant[..],
        None => &[],
    };
    let uris: Vec<UAString> = uris.iter().map(|uri| uri.as_str().into()).collect();
    let set = set.clone();
    vec![
        (
            VariableId::Server_ServerRedundancy_RedundantServerArray,
            CoreValue::Read(Arc::new(move |_| set.value())),
        ),
        (
            VariableId::Server_ServerRedundancy_RedundancySupport,
            Variant::from(support).into(),
        ),
        (
            VariableId::Server_ServerRedundancy_ServerUriArray,
            Variant::from(uris).into(),
        ),
    ]
}

/// The state of a server that its ServiceLevel shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ServerCondition {
    pub(crate) is_standby: bool,
    /// Topics with values of other programs, and how many of them are silent.
    pub(crate) topics: usize,
    pub(crate) silent: usize,
}

impl ServerCondition {
    /// Returns the ServiceLevel (OPC 10000-4, 6.6.2.4.2): 1 without data; 2 to 199 if a part is not
    /// available, as writing at a standby; 200 to 255 otherwise, lower with each silent publisher.
    pub(crate) fn service_level(self) -> u8 {
        if self.topics > 0 && self.silent >= self.topics {
            return NO_DATA;
        }
        let best = if self.is_standby {
            BEST_DEGRADED
        } else {
            u8::MAX
        };
        let lost = self.silent.saturating_mul(RANGE) / self.topics.max(1);
        best.saturating_sub(u8::try_from(lost).unwrap_or(u8::MAX))
    }
}

/// RedundancySupport (OPC 10000-5, 12.5).
const NONE: i32 = 0;
const HOT: i32 = 3;
/// The ServiceLevel of a server that this server does not reach: clients do not connect to it.
const UNREACHABLE: u8 = 0;
/// The time without a heartbeat after which a server is shown as unknown. It is longer than a short
/// stall of this program, unlike the limit of a takeover.
const LOST_AFTER: Duration = Duration::from_millis(500);
/// The ServiceLevel of a server without data.
const NO_DATA: u8 = 1;
/// The best ServiceLevel of a server with parts that are not available.
const BEST_DEGRADED: u8 = 199;
/// The number of levels that show the share of silent topics.
const RANGE: usize = 55;

#[cfg(test)]
mod tests {
    use super::*;

    const ACTIVE: ServerCondition = ServerCondition {
        is_standby: false,
        topics: 10,
        silent: 0,
    };

    #[test]
    fn the_active_server_is_healthy_and_the_standby_is_degraded() {
        let level = |condition: ServerCondition| condition.service_level();
        let standby = ServerCondition {
            is_standby: true,
            ..ACTIVE
        };
        assert_eq!((level(ACTIVE), level(standby)), (255, 199));
        for silent in 0..10 {
            let active = ServerCondition { silent, ..ACTIVE };
            let standby = ServerCondition { silent, ..standby };
            assert!((200..=255).contains(&level(active)), "{silent}");
            assert!((2..=199).contains(&level(standby)), "{silent}");
        }
        let half = ServerCondition {
            silent: 5,
            ..ACTIVE
        };
        assert!(level(half) < level(ACTIVE));
        let lost = ServerCondition {
            silent: 10,
            ..ACTIVE
        };
        assert_eq!(level(lost), NO_DATA);
        let empty = ServerCondition {
            topics: 0,
            ..ACTIVE
        };
        assert_eq!(level(empty), 255, "a space without robots");
    }

    #[test]
    fn a_server_starts_as_standby_only_in_a_redundant_set() {
        assert!(!ServerRole::new(None).is_standby());
        let role = ServerRole::new(RedundancyRank::new(1));
        assert!(role.is_standby());
        role.set_active(true);
        assert!(!role.is_standby());
    }

    #[test]
    fn the_set_shows_the_levels_of_all_servers_and_each_change_once() {
        let text = "spaces: [{id: 1}]\nserver: {redundant: [\"urn:cell:a\", \"urn:cell:b\"]}\n";
        let mapping = Mapping::from_yaml(text, "cell.yaml").mapping.unwrap();
        let now = bridge_node::now();
        let rank = |number| RedundancyRank::new(number).unwrap();
        let set = ServerSet::new(mapping.server(), Some(rank(2)));
        let shown = || {
            let servers = set.members.lock().servers.clone();
            let levels = servers
                .iter()
                .map(|one| (one.service_level, one.server_state));
            levels.collect::<Vec<_>>()
        };
        let unknown = (UNREACHABLE, ServerState::Unknown);
        let standby = (BEST_DEGRADED, ServerState::Running);
        assert_eq!(shown(), [unknown, standby]);
        assert_eq!(set.own(), Some(BEST_DEGRADED));

        let mut first = Redundancy::new(rank(1), 1, now);
        first.set_service_level(Some(231));
        let mut own = Redundancy::new(rank(2), 2, now);
        let from = ([127, 0, 0, 1], 4840).into();
        let _change = own.hear(first.heartbeat(), from, now);
        set.follow(&own, now.monotonic);
        assert_eq!(shown(), [(231, ServerState::Running), standby]);
        assert!(set.take_change().is_some());
        set.follow(&own, now.monotonic);
        assert!(set.take_change().is_none());

        set.set_own(255);
        set.follow(&own, now.monotonic + Duration::from_secs(1));
        assert_eq!(shown(), [unknown, (255, ServerState::Running)]);
        assert!(set.take_change().is_some());
        assert_eq!(ServerSet::new(mapping.server(), None).own(), None);
    }

    #[test]
    fn each_rank_has_its_application_uri() {
        let text = "spaces: [{id: 1}]\nserver: {redundant: [\"urn:cell:a\", \"urn:cell:b\"]}\n";
        let mapping = Mapping::from_yaml(text, "cell.yaml").mapping.unwrap();
        let mapping = Arc::new(mapping);
        let uri = |rank| {
            ranked(&mapping, RedundancyRank::new(rank))
                .server()
                .application_uri
                .clone()
        };
        assert_eq!((&uri(1)[..], &uri(2)[..]), ("urn:cell:a", "urn:cell:b"));
        assert_eq!(ranked(&mapping, None), mapping);
        assert!(!is_member(mapping.server()));
        assert!(is_member(ranked(&mapping, RedundancyRank::new(1)).server()));
    }
}
