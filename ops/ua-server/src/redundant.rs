//! Redundant servers: the role of this server, and the nodes with which clients choose a server
//! (OPC 10000-4, 6.6.2).
//!
//! All servers of a set show the values of the space, so that the set is Hot. The active server
//! alone sends the values that clients write, and calls Methods. The others refuse both, and have a
//! lower ServiceLevel.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bridge_node::Rank;
use mappings::{Mapping, Server};
use opcua::types::{UAString, VariableId, Variant};
use plant_opcua::server::CoreValue;

/// The role of a server.
#[derive(Debug, Clone, Default)]
pub(crate) struct ServerRole {
    is_standby: Arc<AtomicBool>,
}

impl ServerRole {
    /// Creates the role of a server that starts: it is a standby if it is one of several servers.
    pub(crate) fn new(rank: Option<Rank>) -> Self {
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
pub(crate) fn ranked(mapping: &Arc<Mapping>, rank: Option<Rank>) -> Arc<Mapping> {
    let ranked = rank.and_then(|rank| mapping.for_rank(rank.get()));
    ranked.map_or_else(|| Arc::clone(mapping), Arc::new)
}

/// Returns the values of ServerRedundancy (OPC 10000-5, 6.3.7 and 6.3.9).
pub(crate) fn values(server: &Server, rank: Option<Rank>) -> Vec<(VariableId, CoreValue)> {
    let support = match rank {
        Some(_) => HOT,
        None => NONE,
    };
    let uris = match rank {
        Some(_) => &server.redundant[..],
        None => &[],
    };
    let uris: Vec<UAString> = uris.iter().map(|uri| uri.as_str().into()).collect();
    vec![
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
pub(crate) struct Condition {
    pub(crate) is_standby: bool,
    /// Topics with values of other programs, and how many of them are silent.
    pub(crate) topics: usize,
    pub(crate) silent: usize,
}

impl Condition {
    /// Returns the ServiceLevel (OPC 10000-4, 6.6.2.4.2): 1 without data; 2 to 199 if a part is not
    /// available, as writing at a standby; 200 to 255 otherwise, lower with each silent publisher.
    pub(crate) fn service_level(self) -> u8 {
        if self.topics > 0 && self.silent >= self.topics {
            return NO_DATA;
        }
        let best = match self.is_standby {
            true => BEST_DEGRADED,
            false => u8::MAX,
        };
        let lost = self.silent.saturating_mul(RANGE) / self.topics.max(1);
        best.saturating_sub(u8::try_from(lost).unwrap_or(u8::MAX))
    }
}

/// RedundancySupport (OPC 10000-5, 12.5).
const NONE: i32 = 0;
const HOT: i32 = 3;
/// The ServiceLevel of a server without data.
const NO_DATA: u8 = 1;
/// The best ServiceLevel of a server with parts that are not available.
const BEST_DEGRADED: u8 = 199;
/// The number of levels that show the share of silent topics.
const RANGE: usize = 55;

#[cfg(test)]
mod tests {
    use super::*;

    const ACTIVE: Condition = Condition {
        is_standby: false,
        topics: 10,
        silent: 0,
    };

    #[test]
    fn the_active_server_is_healthy_and_the_standby_is_degraded() {
        let level = |condition: Condition| condition.service_level();
        let standby = Condition {
            is_standby: true,
            ..ACTIVE
        };
        assert_eq!((level(ACTIVE), level(standby)), (255, 199));
        for silent in 0..10 {
            let active = Condition { silent, ..ACTIVE };
            let standby = Condition { silent, ..standby };
            assert!((200..=255).contains(&level(active)), "{silent}");
            assert!((2..=199).contains(&level(standby)), "{silent}");
        }
        let half = Condition {
            silent: 5,
            ..ACTIVE
        };
        assert!(level(half) < level(ACTIVE));
        let lost = Condition {
            silent: 10,
            ..ACTIVE
        };
        assert_eq!(level(lost), NO_DATA);
        let empty = Condition {
            topics: 0,
            ..ACTIVE
        };
        assert_eq!(level(empty), 255, "a space without robots");
    }

    #[test]
    fn a_server_starts_as_standby_only_in_a_redundant_set() {
        assert!(!ServerRole::new(None).is_standby());
        let role = ServerRole::new(Rank::new(1));
        assert!(role.is_standby());
        role.set_active(true);
        assert!(!role.is_standby());
    }

    #[test]
    fn each_rank_has_its_application_uri() {
        let text = "spaces: [{id: 1}]\nserver: {redundant: [\"urn:cell:a\", \"urn:cell:b\"]}\n";
        let mapping = Mapping::from_yaml(text, "cell.yaml").mapping.unwrap();
        let mapping = Arc::new(mapping);
        let uri = |rank| {
            ranked(&mapping, Rank::new(rank))
                .server()
                .application_uri
                .clone()
        };
        assert_eq!((&uri(1)[..], &uri(2)[..]), ("urn:cell:a", "urn:cell:b"));
        assert_eq!(ranked(&mapping, None), mapping);
    }
}
