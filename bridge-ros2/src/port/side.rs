//! The node in its domain, as the topics, services and actions of the port share it.

use std::collections::{BTreeSet, VecDeque};
use std::convert::Infallible;
use std::time::Duration;

use bridge_node::policy::{Policy, Read, TopicMeaning};
use bridge_node::{BridgeActions, PortEvent, Present, Reason};
use mappings::{Mapping, TopicId};
use messages::{DefinitionError, Selection, TextKind, TypeName};
use ros2_node::compatibility::Incompatibility;
use ros2_node::domain::{Domain, DomainError};
use ros2_node::graph::{Graph, RemoteEndpoint, dds_topic, ros_topic};
use ros2_node::type_description::TypeServer;
use rustdds::GUID;
use tokio::time::Instant;

use super::descriptions::TypeDescriptions;
use super::schedule::Schedule;
use crate::definitions::{Ros2Definitions, TypeDefinition};
use crate::descriptors::Descriptors;

/// The node, the domain around it, and the events for the run loop.
pub(super) struct Ros2Side {
    pub(super) domain: Domain,
    pub(super) domain_id: u16,
    pub(super) joined: Instant,
    pub(super) graph: Graph,
    pub(super) policy: Policy,
    pub(super) definitions: Ros2Definitions,
    pub(super) descriptions: TypeDescriptions,
    /// Serves the descriptions of the types that this bridge reads and writes.
    pub(super) told_types: TypeServer,
    /// Endpoints that may be created before the next pass.
    pub(super) budget: usize,
    pub(super) descriptors: Descriptors,
    /// Remote endpoints that were logged and counted as incompatible with ours.
    pub(super) incompatible: BTreeSet<GUID>,
    pub(super) schedule: Schedule,
    /// Events that `recv` returns next; filled only while it is empty, or by one pass over the
    /// topics.
    pub(super) events: VecDeque<PortEvent>,
}

/// A kind of servers: services or actions.
#[derive(Clone, Copy)]
pub(super) struct ServerKind {
    /// The noun in log messages.
    pub(super) noun: &'static str,
    /// The key under which an unusable type is logged once.
    pub(super) told: &'static str,
    /// Converts the DDS type of the requests to the ROS type.
    pub(super) type_of: fn(&str) -> String,
}

impl Ros2Side {
    /// Returns the topics that the mapping reads.
    pub(super) fn read(&self) -> Read {
        let name = |ros_topic: &str| Ok::<_, Infallible>(dds_topic(ros_topic));
        self.policy.read(name)
    }

    /// Returns the changes of a mapping that require a restart.
    pub(super) fn fixed(&self, mapping: &Mapping) -> Vec<String> {
        let declared = mapping
            .space(self.policy.own())
            .and_then(|space| space.domain);
        let other = declared.filter(|domain| *domain != self.domain_id);
        let fixed = other.map(|domain| {
            format!(
                "spaces (space {} in domain {domain}, not {})",
                self.policy.own(),
                self.domain_id
            )
        });
        fixed.into_iter().collect()
    }

    /// Logs once that further topics that the mapping does not name are ignored.
    pub(super) fn tell_scarce(&mut self) {
        let limit = self.descriptors.limit();
        self.policy.told.once("", "descriptors", || {
            format!(
                "three quarters of the {limit} file descriptors of this process are in use: the bridge \
                 ignores further topics that the mapping does not name; raise the limit (`LimitNOFILE=`, \
                 `ulimit -n`), or stop the nodes that publish so many topics of the space"
            )
        });
    }

    /// Logs an unknown type once per topic; returns whether it was logged.
    pub(super) fn tell_unknown_type(
        &mut self,
        topic: &str,
        what: &str,
        error: &DefinitionError,
    ) -> bool {
        let definitions = &mut self.definitions;
        self.policy.told.once(topic, "unknown type", || {
            let why = definitions.known.explain(TextKind::Message, error);
            format!("{what}: {why}")
        })
    }

    /// Returns the first known type of a topic's writers; `None` while no type is known or a node
    /// is asked for its description.
    pub(super) fn found_type(
        &mut self,
        topic: TopicId,
        dds_topic: &str,
        now: Instant,
    ) -> Option<TypeName> {
        let writers = self.graph.writers(dds_topic).to_vec();
        let mut known = None;
        for writer in &writers {
            // A pattern may apply to a single type.
            if known.is_some() || self.found(dds_topic, &writer.type_name) == TopicMeaning::Nothing
            {
                continue;
            }
            let found = match TypeName::from_dds(&writer.type_name) {
                Ok(name) => {
                    let Some(hash) = self.hash_that_counts(&name, &writers, None, now) else {
                        continue;
                    };
                    let found = self.definitions.announced(&name, hash);
                    found.map_err(|error| error.to_string())
                }
                Err(error) => Err(error.to_string()),
            };
            match found {
                Ok(definition) => known = Some(definition.name().clone()),
                Err(error) => self.tell_unknown(topic, dds_topic, &error),
            }
        }
        known
    }

    /// Returns the value of a topic that the mapping does not name: by the topic's own name or by a
    /// pattern. `is_written` returns whether values of other spaces are written to a topic.
    pub(super) fn value_of(
        &mut self,
        dds_topic: String,
        is_written: impl Fn(&str) -> bool,
    ) -> Option<(String, TopicId, Selection)> {
        let writers = self.graph.writers(&dds_topic).iter();
        let mut found = writers.map(|writer| self.found(&dds_topic, &writer.type_name));
        match found.find(|found| *found != TopicMeaning::Nothing)? {
            TopicMeaning::Named(topic) => Some((dds_topic, topic, Selection::Whole)),
            TopicMeaning::Tied(topic) => {
                self.policy.told.once(&dds_topic, "tied elsewhere", || {
                    format!("ignored this topic: by the mapping, {topic} comes from another ROS topic or a service")
                });
                None
            }
            // Other publishers on a topic to which the bridge writes values of other spaces are no
            // value of ours.
            TopicMeaning::Made(_) | TopicMeaning::Fault(_) if is_written(&dds_topic) => None,
            TopicMeaning::Made(made) => Some((dds_topic, made.topic, made.selection)),
            TopicMeaning::Fault(fault) => {
                self.policy
                    .told
                    .once(&dds_topic, "pattern", || fault.to_string());
                None
            }
            TopicMeaning::Nothing => None,
        }
    }

    /// Classifies a topic that the mapping does not name, written with the DDS type. No pattern
    /// applies to a type that is not a ROS type.
    pub(super) fn found(&self, dds_topic: &str, dds_type: &str) -> TopicMeaning {
        let Some(name) = ros_topic(dds_topic) else {
            return TopicMeaning::Nothing;
        };
        let message_type = TypeName::from_dds(dds_type).ok();
        let found = self
            .policy
            .found(&format!("/{name}"), message_type.as_ref());
        let by_pattern = matches!(found, TopicMeaning::Made(_) | TopicMeaning::Fault(_));
        match by_pattern && message_type.is_none() {
            true => TopicMeaning::Nothing,
            false => found,
        }
    }

    /// Logs once why a topic cannot be used.
    fn tell_unknown(&mut self, topic: TopicId, dds_topic: &str, error: &str) {
        let first = self.policy.told.once(dds_topic, "unknown type", || {
            format!(
                "cannot bridge the topic: {error}. Start the bridge where the ROS workspace that defines it \
                 is sourced (AMENT_PREFIX_PATH), or map the topic to a known type"
            )
        });
        if first {
            self.events
                .push_back(lost(topic, (Reason::Untyped, UNKNOWN_TYPE), 1));
        }
    }

    /// Logs and counts, once each, the remote endpoints that DDS does not match with ours. `about`
    /// returns the topic, its values, and the noun of a remote endpoint.
    pub(super) fn note_incompatible(
        &mut self,
        about: impl Fn() -> (String, Vec<TopicId>, &'static str),
        peers: Vec<(GUID, Option<Incompatibility>)>,
    ) {
        for (guid, found) in peers {
            let Some(found) = found else {
                self.incompatible.remove(&guid);
                continue;
            };
            if !self.incompatible.insert(guid) {
                continue;
            }
            let (dds_topic, topics, peer) = about();
            let unmatched = |topic: TopicId| PortEvent::Unmatched { topic };
            self.events.extend(topics.into_iter().map(unmatched));
            let owner = self.domain.owner(guid);
            self.policy.told.once(&dds_topic, found.policy, || {
                format!(
                    "a {peer} of {} is not connected: for the QoS policy {}, {} is offered and {} requested",
                    owner.as_deref().unwrap_or("an unnamed node"),
                    found.policy,
                    found.offered,
                    found.requested
                )
            });
        }
    }

    /// Sets the type hash that the domain announces with the next endpoints of the definition's
    /// type, and serves the description of the type.
    pub(super) fn announce_type(&self, definition: &TypeDefinition) {
        let (name, Some(hash)) = (definition.name(), definition.hash) else {
            return;
        };
        self.domain.learn_type_hash(&name.dds(), hash.to_string());
        if !self.told_types.tells(&name.ros2(), hash)
            && let Ok(described) = self.definitions.described(name, hash)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hash);
        }
    }

    /// Creates an endpoint if the budget allows; returns `None` if it does not, or if RustDDS
    /// fails, which is logged once.
    pub(super) fn make<E>(
        &mut self,
        make: impl FnOnce(&Domain) -> Result<E, DomainError>,
    ) -> Option<E> {
        let Some(left) = self.budget.checked_sub(1) else {
            self.schedule.unfinished = true;
            return None;
        };
        self.budget = left;
        match make(&self.domain) {
            Ok(endpoint) => Some(endpoint),
            Err(error) => {
                let text = error.to_string();
                self.policy.told.once(&text, "endpoint", || text.clone());
                None
            }
        }
    }

    /// Returns the wanted servers of other nodes with their types. Servers of other bridges are
    /// left out: they are executed elsewhere. If servers of one name have two types, neither can be
    /// called.
    pub(super) fn present<'s>(
        &mut self,
        offered: impl Iterator<Item = (&'s str, &'s [RemoteEndpoint])>,
        kind: ServerKind,
        is_wanted: impl Fn(&Policy, &str) -> bool,
    ) -> Present {
        let ServerKind {
            noun,
            told,
            type_of,
        } = kind;
        let mut present = Present::new();
        for (name, servers) in offered {
            let name = format!("/{name}");
            if !is_wanted(&self.policy, &name) {
                continue;
            }
            let servers = servers.iter().filter(|one| !self.graph.is_bridge(one.guid));
            let types: BTreeSet<String> = servers.map(|one| type_of(&one.type_name)).collect();
            let type_name = match types.first() {
                None => continue,
                Some(name) if types.len() == 1 => name.parse().ok(),
                Some(_) => None,
            };
            if type_name.is_none() && BridgeActions::is_named(&self.policy, &name) {
                let types: Vec<String> = types.into_iter().collect();
                self.policy.told.once(&name, told, || {
                    format!(
                        "the {noun} {name} is not offered to other spaces: its type is {}",
                        types.join(" and ")
                    )
                });
            }
            present.insert(name, type_name);
        }
        present
    }

    /// Serves the description of the type of a service.
    pub(super) fn tell_service(&self, name: &TypeName) {
        if let Some(hashes) = self.definitions.service_type_hashes(name)
            && let Ok(described) = self.definitions.described_service(name)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hashes.service);
        }
    }

    /// Serves the description of the type of an action. The name of a call that sends goals is the
    /// name of the action type.
    pub(super) fn tell_action(&mut self, name: &TypeName) {
        if let Some(hashes) = self.definitions.action_type_hashes(name)
            && let Ok(described) = self.definitions.described_action(name)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hashes.action);
        }
    }
}

/// Returns the event for the loss of samples of a topic.
pub(super) fn lost(topic: TopicId, (reason, why): (Reason, &'static str), count: u64) -> PortEvent {
    PortEvent::Lost {
        topic: Some(topic),
        reason,
        why,
        count,
    }
}

/// Returns the name of a DDS topic as ROS tools show it, for messages.
pub(super) fn shown_topic(dds_topic: &str) -> String {
    match ros_topic(dds_topic) {
        Some(name) => format!("/{name}"),
        None => dds_topic.to_owned(),
    }
}

/// The reason for drops on a topic of unknown type.
pub(super) const UNKNOWN_TYPE: &str = "type without a definition";
/// The delay after joining a domain before services are offered.
pub(super) const SETTLED: Duration = Duration::from_secs(1);
