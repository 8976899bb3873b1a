//! Types that are known to the nodes that publish them: from ROS 2 Iron on each node tells what its types are.

use std::collections::BTreeMap;
use std::time::Duration;

use messages::{DescribedType, TypeHash, TypeName};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use super::Ros2Port;
use crate::graph::Endpoint;
use crate::service::{ServiceClient, ServiceClientOptions, ServicePeers};
use crate::type_description;

/// What was asked for, and what came of it.
pub(super) struct Descriptions {
    peers: ServicePeers,
    asked: BTreeMap<Wanted, State>,
    calls: JoinSet<Told>,
}

/// A type as a writer announces it.
type Wanted = (TypeName, TypeHash);
/// Who was asked for what, and the answer.
type Told = (Wanted, String, Result<Vec<DescribedType>, String>);

#[derive(Debug, Clone, Copy)]
enum State {
    /// To be asked for, not before `next`.
    Waiting {
        since: Instant,
        next: Instant,
        tries: u8,
    },
    Asking {
        tries: u8,
    },
    /// It is known, or nobody tells it.
    Settled,
}

impl Descriptions {
    pub(super) fn new(peers: ServicePeers) -> Self {
        Self {
            peers,
            asked: BTreeMap::new(),
            calls: JoinSet::new(),
        }
    }

    /// Whether a call is out or will be, so that there is something to look for again.
    fn is_waiting(&self, wanted: &Wanted) -> bool {
        !matches!(self.asked.get(wanted), Some(State::Settled) | None)
    }
}

impl Ros2Port {
    /// Whether what these writers announce is the type we know, or nobody tells it: `false` while a node is asked. Writers
    /// that announce no hash are of no release that tells.
    pub(super) fn types_are_settled(&mut self, writers: &[Endpoint], now: Instant) -> bool {
        let announced = writers.iter().filter_map(|writer| {
            let name = TypeName::from_dds(&writer.type_name).ok()?;
            Some((name, writer.type_hash?))
        });
        let Some(wanted) = announced.into_iter().next() else {
            return true;
        };
        if self.definitions.hash_of(&wanted.0) == Some(wanted.1) {
            return true;
        }
        let full = self.descriptions.asked.len() >= MOST_ASKED;
        let state = match self.descriptions.asked.get(&wanted) {
            Some(state) => *state,
            None if full => return true,
            None => State::Waiting {
                since: now,
                next: now,
                tries: 0,
            },
        };
        let state = self.ask(&wanted, writers, state, now);
        self.descriptions.asked.insert(wanted.clone(), state);
        !self.descriptions.is_waiting(&wanted)
    }

    /// The state after what can be done now.
    fn ask(&mut self, wanted: &Wanted, writers: &[Endpoint], state: State, now: Instant) -> State {
        let State::Waiting { since, next, tries } = state else {
            return state;
        };
        if now < next || self.descriptions.calls.len() >= MOST_CALLS {
            return state;
        }
        let (name, hash) = wanted;
        let dds_type = name.dds();
        let alike = |writer: &&Endpoint| {
            writer.type_hash.as_ref() == Some(hash) && writer.type_name == dds_type
        };
        let nodes: Vec<String> = writers
            .iter()
            .filter(alike)
            .filter_map(|writer| self.domain.owner(writer.guid))
            .collect();
        let snapshot = self.descriptions.peers.look(now, FRESH);
        let services: Vec<_> = nodes
            .iter()
            .map(|node| type_description::service(node))
            .filter(|service| !snapshot.readers(&service.request_topic()).is_empty())
            .collect();
        let Some(service) = services.get(usize::from(tries) % services.len().max(1)) else {
            if now.duration_since(since) < OFFERED_WITHIN {
                return state;
            }
            self.untold(
                wanted,
                "no node that publishes it offers get_type_description",
            );
            return State::Settled;
        };
        let options = ServiceClientOptions {
            timeout: Some(ANSWERED_WITHIN),
            max_calls: 1,
        };
        let peers = self.descriptions.peers.clone();
        let opened = self.make(|domain| ServiceClient::open(domain, &peers, service, options));
        let Some(client) = opened else {
            return state;
        };
        debug!(message_type = %name, service = service.name, "asking what the type is");
        let request = type_description::request(name, *hash);
        let (wanted, asked) = (wanted.clone(), service.name.clone());
        self.descriptions.calls.spawn(async move {
            let told = match client.call(request).await {
                Ok(answer) => type_description::read_answer(&answer),
                Err(error) => Err(error.to_string()),
            };
            (wanted, asked, told)
        });
        State::Asking { tries }
    }

    /// Takes in what was answered since the last look.
    pub(super) fn take_descriptions(&mut self, now: Instant) {
        while let Some(ended) = self.descriptions.calls.try_join_next() {
            let Ok((wanted, service, told)) = ended else {
                continue;
            };
            let tries = match self.descriptions.asked.get(&wanted) {
                Some(State::Asking { tries }) => tries + 1,
                Some(State::Waiting { .. } | State::Settled) | None => continue,
            };
            let state = match told {
                Ok(types) => {
                    self.described(&wanted, &service, &types);
                    State::Settled
                }
                Err(why) if tries >= MOST_TRIES => {
                    self.untold(&wanted, &format!("{service}: {why}"));
                    State::Settled
                }
                Err(why) => {
                    debug!(message_type = %wanted.0, service, why, "the type was not told");
                    State::Waiting {
                        since: now,
                        next: now + PAUSE * u32::from(tries),
                        tries,
                    }
                }
            };
            self.descriptions.asked.insert(wanted, state);
        }
    }

    /// Another answer would be no better than one that is not of the hash.
    fn described(&mut self, wanted: &Wanted, service: &str, types: &[DescribedType]) {
        let (name, hash) = wanted;
        let from = || format!("type description of {service}");
        match self.definitions.add_described(name, types, *hash, from) {
            Ok(()) => {
                info!(message_type = %name, service, "the type was told by its publisher");
            }
            Err(error) => self.untold(wanted, &format!("{service}: {error}")),
        }
    }

    fn untold(&self, (name, hash): &Wanted, why: &str) {
        match self.definitions.hash_of(name) {
            Some(ours) => warn!(
                message_type = %name,
                definition = self.definitions.source(name),
                "a publisher's type has the hash {hash}, ours {ours}: what it sends may be misread, or not at all; {why}"
            ),
            None => {
                warn!(message_type = %name, "the type is not told by those who publish it: {why}")
            }
        }
    }
}

/// How long a node may take to tell its name and services.
const OFFERED_WITHIN: Duration = Duration::from_secs(3);
/// How long a call may take.
const ANSWERED_WITHIN: Duration = Duration::from_secs(3);
/// Calls for one type.
const MOST_TRIES: u8 = 3;
/// After the first call that failed; longer after the next.
const PAUSE: Duration = Duration::from_secs(1);
/// Calls at a time: each has two endpoints.
const MOST_CALLS: usize = 4;
/// Types asked for while the program runs: anybody in the domain can invent names.
const MOST_ASKED: usize = 1024;
/// How old what is known of services may be.
const FRESH: Duration = Duration::from_millis(100);
