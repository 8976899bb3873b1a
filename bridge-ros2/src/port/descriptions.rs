//! Types that are known to the nodes that use them: from ROS 2 Iron on each node tells what its types are.

use std::collections::BTreeMap;
use std::time::Duration;

use messages::{DescribedType, TypeHash, TypeName};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use super::Ros2Port;
use crate::definitions::Definition;
use crate::graph::Endpoint;
use crate::service::{ServiceClient, ServiceClientOptions, ServicePeers};
use crate::type_description;

/// What was asked for, and what came of it.
pub(super) struct Descriptions {
    peers: ServicePeers,
    asked: BTreeMap<Wanted, State>,
    calls: JoinSet<Told>,
}

/// A type as an endpoint announces it.
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
    /// Which of the definitions of a type counts on a topic with these endpoints, by its hash: the one that counts by now
    /// while it is known and any of them announces it, else the first that is known, of which the nodes of the endpoints are
    /// asked; else the first. Endpoints that announce none are of no release that does. `None` while a node is asked.
    pub(super) fn hash_that_counts(
        &mut self,
        name: &TypeName,
        endpoints: &[Endpoint],
        current: Option<TypeHash>,
        now: Instant,
    ) -> Option<Option<TypeHash>> {
        let dds_type = name.dds();
        let of_type = endpoints
            .iter()
            .filter(|endpoint| endpoint.type_name == dds_type);
        let mut announced: Vec<TypeHash> = Vec::new();
        for hash in of_type.filter_map(|endpoint| endpoint.type_hash) {
            if !announced.contains(&hash) {
                announced.push(hash);
            }
        }
        let there = current.filter(|hash| announced.is_empty() || announced.contains(hash));
        let candidates = there.into_iter().chain(announced.iter().copied());
        for hash in candidates {
            if self.definitions.of_hash(name, hash).is_some() {
                return Some(Some(hash));
            }
        }
        let mut settled = true;
        for hash in &announced {
            settled &= self.is_settled((name.clone(), *hash), endpoints, now);
        }
        settled.then(|| there.or_else(|| announced.first().copied()))
    }

    /// Whether a type of that hash is known, or nobody tells it: `false` while a node is asked.
    fn is_settled(&mut self, wanted: Wanted, endpoints: &[Endpoint], now: Instant) -> bool {
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
        let state = self.ask(&wanted, endpoints, state, now);
        self.descriptions.asked.insert(wanted.clone(), state);
        !self.descriptions.is_waiting(&wanted)
    }

    /// The state after what can be done now.
    fn ask(
        &mut self,
        wanted: &Wanted,
        endpoints: &[Endpoint],
        state: State,
        now: Instant,
    ) -> State {
        let State::Waiting { since, next, tries } = state else {
            return state;
        };
        if now < next || self.descriptions.calls.len() >= MOST_CALLS {
            return state;
        }
        let (name, hash) = wanted;
        let dds_type = name.dds();
        let alike = |endpoint: &&Endpoint| {
            endpoint.type_hash.as_ref() == Some(hash) && endpoint.type_name == dds_type
        };
        let nodes: Vec<String> = endpoints
            .iter()
            .filter(alike)
            .filter_map(|endpoint| self.domain.owner(endpoint.guid))
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
            self.untold(wanted, "no node that uses it offers get_type_description");
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
        let from = format!("type description of {service}");
        match self.definitions.add_described(name, types, *hash, &from) {
            Ok(()) => {
                info!(message_type = %name, %hash, service, "the type was told by a node that uses it");
            }
            Err(error) => self.untold(wanted, &format!("{service}: {error}")),
        }
    }

    fn untold(&mut self, (name, hash): &Wanted, why: &str) {
        match self.definitions.here(name) {
            Ok(Definition {
                hash: Some(ours),
                from,
                ..
            }) => warn!(
                message_type = %name,
                definition = %from,
                "another node's type has the hash {hash}, ours {ours}: it may be misread, or not at all; {why}"
            ),
            Ok(Definition { hash: None, .. }) | Err(_) => {
                warn!(message_type = %name, %hash, "the type is not told by those who use it: {why}");
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
