//! Reconciles the open endpoints with the endpoints of the domain.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::policy::{Found, MAX_TOPICS};
use bridge_node::{PortEvent, Reason};
use mappings::TopicId;
use messages::{Selection, TypeName};
use ros2_node::compatibility::Incompatibility;
use ros2_node::domain::{Domain, DomainError};
use ros2_node::graph::{Endpoint, ros_topic};
use ros2_node::inbox::SlotId;
use ros2_node::qos::Requested;
use rustdds::GUID;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use super::calls::SETTLED;
use super::{Ros2Port, lost};
use crate::definitions::Definition;
use crate::sink::Sink;
use crate::source::{OTHER_DEFINITION, OTHER_TYPE, Reading};

impl Ros2Port {
    /// Reconciles the open endpoints with the domain, if either may have changed. Creates at most
    /// [`MAX_BATCH`] endpoints at a time: the discovery of RustDDS takes commands from a bounded
    /// queue and drops commands that do not fit.
    pub(super) fn reconcile(&mut self, now: Instant) {
        let domain = self.domain.changes();
        let is_due = self.schedule.is_look_due(domain, now);
        self.schedule.reconciled = now;
        let free = self.descriptors.free();
        self.budget = MAX_BATCH.min(free.mapped);
        if free.found == 0 {
            self.tell_scarce();
        }
        while self.retired.front().is_some_and(|(until, _)| *until <= now) {
            self.retired.pop_front();
        }
        self.former.retain(|former| !former.is_done(now));
        self.report_drops();
        let monotonic = bridge_node::now().monotonic;
        self.calls.tidy(monotonic);
        self.actions.tidy(&self.policy, monotonic);
        if is_due {
            self.graph = self.domain.graph();
        }
        self.offer_calls();
        self.offer_actions();
        if !is_due {
            return;
        }
        self.schedule.looks(domain, now);
        let graph = &self.graph;
        self.incompatible.retain(|guid| graph.holds(*guid));
        self.misreading.retain(|guid| graph.holds(*guid));
        self.tell_of_bridges();
        self.announce_anew(now);
        self.take_descriptions(now);
        self.find_topics(now);
        self.find_services();
        self.find_actions();
        for index in 0..self.sources.len() {
            self.reconcile_source(index, now);
        }
        let topics: Vec<TopicId> = self.sinks.keys().copied().collect();
        for topic in topics {
            self.reconcile_sink(topic, now);
        }
        if self.descriptions.is_asking(now) {
            // Replies are taken in a pass.
            self.schedule.look_next();
        }
    }

    /// Recreates the endpoints that RustDDS left out of its announcements.
    fn announce_anew(&mut self, now: Instant) {
        let lost = self.domain.unannounced(&self.graph);
        if lost.is_empty() {
            return;
        }
        let mut made = 0_usize;
        for index in 0..self.sources.len() {
            let Some(Reading::Open { slot, requested }) =
                self.sources.get(index).map(|s| s.reading)
            else {
                continue;
            };
            if self
                .inbox
                .guid(slot)
                .is_some_and(|guid| lost.contains(&guid))
            {
                self.reopen_source(index, requested, now);
                made += 1;
            }
        }
        let is_lost = |sink: &Sink| {
            let open = sink.open.as_ref();
            open.is_some_and(|open| lost.contains(&open.outlet.guid()))
        };
        let sinks = self.sinks.iter().filter(|(_, sink)| is_lost(sink));
        let sinks: Vec<TopicId> = sinks.map(|(topic, _)| *topic).collect();
        for topic in sinks {
            made += usize::from(self.advertise_anew(topic, now).is_some());
        }
        // The remaining endpoints are service endpoints, endpoints of the node itself, and replaced
        // readers that still receive.
        if made == 0 {
            let count = lost.len();
            self.policy.told.once("", "unannounced", || {
                format!(
                    "the DDS stack did not announce {count} endpoints of services or of the node; \
                         restart the bridge"
                )
            });
        } else {
            warn!(
                endpoints = made,
                "the DDS stack did not announce readers and writers of this bridge; created them again"
            );
        }
    }

    /// Finds topics without a binding (zero configuration and patterns): a topic named in our part
    /// of the space, or matched by a pattern, crosses once it has a publisher.
    fn find_topics(&mut self, now: Instant) {
        let pending = self.sources.iter();
        let pending = pending.filter(|source| source.reading == Reading::Pending);
        let free = self.descriptors.free().found;
        let mut free = free.saturating_sub(pending.count());
        let unknown = |topic: &&str| !self.source_of.contains_key(*topic);
        let found: Vec<(String, TopicId, Selection)> = self
            .graph
            .written_topics()
            .filter(unknown)
            .map(str::to_owned)
            .collect::<Vec<_>>()
            .into_iter()
            .filter_map(|topic| self.value_of(topic))
            .collect();
        for (dds_topic, topic, selection) in found {
            // Sources that were given up keep their slots.
            let read = self.sources.iter().filter(|s| !s.values.is_empty());
            if read.count() >= MAX_TOPICS {
                self.policy.told.once("", "too many topics", || {
                    format!(
                        "more than {MAX_TOPICS} topics of the space: the bridge ignores the others"
                    )
                });
                return;
            }
            let mut sources = self.sources.iter();
            let same =
                sources.find(|source| source.values.iter().any(|(other, _)| *other == topic));
            if let Some(other) = same {
                let other = other.dds_topic.clone();
                self.policy.tell_same(&dds_topic, topic, &other);
                continue;
            }
            if free == 0 {
                self.tell_scarce();
                self.events.push_back(PortEvent::Dropped {
                    reason: Reason::TooManyTopics,
                    why: "not enough file descriptors for the topic",
                    count: 1,
                });
                return;
            }
            if let Some(name) = self.found_type(topic, &dds_topic, now) {
                free -= 1;
                let index = self.source(dds_topic, name);
                if let Some(source) = self.sources.get_mut(index) {
                    source.values.push((topic, selection));
                }
            }
        }
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

    /// Returns the first known type of a topic's writers; `None` while no type is known or a node
    /// is asked for its description.
    fn found_type(&mut self, topic: TopicId, dds_topic: &str, now: Instant) -> Option<TypeName> {
        let writers = self.graph.writers(dds_topic).to_vec();
        let mut known = None;
        for writer in &writers {
            // A pattern may apply to a single type.
            if known.is_some() || self.found(dds_topic, &writer.type_name) == Found::Nothing {
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
    /// pattern.
    fn value_of(&mut self, dds_topic: String) -> Option<(String, TopicId, Selection)> {
        let writers = self.graph.writers(&dds_topic).iter();
        let mut found = writers.map(|writer| self.found(&dds_topic, &writer.type_name));
        match found.find(|found| *found != Found::Nothing)? {
            Found::Named(topic) => Some((dds_topic, topic, Selection::Whole)),
            Found::Tied(topic) => {
                self.policy.told.once(&dds_topic, "tied elsewhere", || {
                    format!("ignored this topic: by the mapping, {topic} comes from another ROS topic or a service")
                });
                None
            }
            // Other publishers on a topic to which the bridge writes values of other spaces are no
            // value of ours.
            Found::Made(_) | Found::Fault(_) if self.is_written(&dds_topic) => None,
            Found::Made(made) => Some((dds_topic, made.topic, made.selection)),
            Found::Fault(fault) => {
                self.policy
                    .told
                    .once(&dds_topic, "pattern", || fault.to_string());
                None
            }
            Found::Nothing => None,
        }
    }

    /// Classifies a topic that the mapping does not name, written with the DDS type. No pattern
    /// applies to a type that is not a ROS type.
    pub(super) fn found(&self, dds_topic: &str, dds_type: &str) -> Found {
        let Some(name) = ros_topic(dds_topic) else {
            return Found::Nothing;
        };
        let message_type = TypeName::from_dds(dds_type).ok();
        let found = self
            .policy
            .found(&format!("/{name}"), message_type.as_ref());
        let by_pattern = matches!(found, Found::Made(_) | Found::Fault(_));
        match by_pattern && message_type.is_none() {
            true => Found::Nothing,
            false => found,
        }
    }

    /// Returns whether values of other spaces are written to the topic.
    pub(super) fn is_written(&self, dds_topic: &str) -> bool {
        self.sinks.values().any(|sink| sink.dds_topic == dds_topic)
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

    fn reconcile_source(&mut self, index: usize, now: Instant) {
        // A source without a value is no longer named by the mapping.
        let source = self.sources.get(index);
        if source.is_none_or(|source| source.values.is_empty()) {
            return;
        }
        let settled = self.settle_source(index, now);
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let writers = self.graph.writers(&source.dds_topic);
        let ours = source.meet(writers);
        for publisher in source.gone(writers) {
            let values = source.values.iter();
            self.events.extend(values.map(|(topic, _)| PortEvent::Left {
                topic: *topic,
                publisher,
            }));
        }
        let strange = writers
            .iter()
            .find(|writer| !ours.contains(writer))
            .cloned();
        let requested = match ours.is_empty() {
            true => Requested::without_writers(&source.message_type),
            false => Requested::from_writers(&ours),
        };
        let returned = requested.is_transient_local() && !source.returned(writers).is_empty();
        match source.reading {
            Reading::Pending => {
                let name = source.message_type.clone();
                let known = self.definitions.get(&name).is_ok();
                // A reader that requests more than a writer offers makes the writer's node log a
                // warning. After the wait, the present writers are known.
                let is_early = ours.is_empty() && self.joined.elapsed() < SETTLED;
                if is_early {
                    self.schedule.look_next();
                }
                // The unknown type of a topic without a publisher is requested when a publisher
                // appears.
                if (known || !ours.is_empty()) && settled && !is_early {
                    self.open_source(index, requested);
                }
            }
            Reading::Open {
                requested: before, ..
            } if (before != requested && !ours.is_empty()) || returned => {
                self.reopen_source(index, requested, now);
            }
            Reading::Open { slot, .. } => self
                .inbox
                .retain_writers(slot, |writer| writers.iter().any(|w| w.guid == *writer)),
        }
        let wanted = requested.policies();
        let offers: Vec<_> = ours
            .iter()
            .map(|writer| (writer.guid, Incompatibility::between(&writer.qos, &wanted)))
            .collect();
        self.set_live(index, !ours.is_empty());
        self.note_incompatible(&Side::Source(index), offers);
        if let Some(stranger) = strange.filter(|_| settled) {
            self.tell_stranger(index, &stranger);
        }
    }

    /// Selects the definition of a source's type; returns `false` while a node is asked. Closes a
    /// reader that uses another definition, so that a new reader can be created.
    fn settle_source(&mut self, index: usize, now: Instant) -> bool {
        let Some(source) = self.sources.get(index) else {
            return false;
        };
        let (name, current) = (source.message_type.clone(), source.announced);
        let dds_type = name.dds();
        let writers = self.graph.writers(&source.dds_topic);
        let read_so = |writer: &Endpoint| writer.is_of(&dds_type, current);
        // Only while the source is read with the definition of the hash: a built-in definition
        // precedes a hash that no node describes.
        let known = source.definition.as_ref().map(|it| it.hash) == Some(current);
        if current.is_some() && known && writers.iter().any(read_so) {
            return true;
        }
        let writers = writers.to_vec();
        let Some(hash) = self.hash_that_counts(&name, &writers, current, now) else {
            return false;
        };
        let found = self.definitions.announced(&name, hash).ok();
        let Some(source) = self.sources.get_mut(index) else {
            return false;
        };
        let same = |(a, b): (&Definition, &Definition)| a.is_same(b);
        let read = source.definition.as_ref().zip(found.as_ref());
        if let Reading::Open { slot, .. } = source.reading
            && !read.is_none_or(same)
        {
            // The reader holds samples of the former definition; the new definition would misread
            // them.
            source.meet(&writers);
            for taken in self.inbox.drain(slot) {
                self.taken(taken);
            }
            self.close_source(index, slot);
        }
        if let Some(source) = self.sources.get_mut(index) {
            source.announced = hash.or(current);
        }
        true
    }

    /// Closes the reader of a source because its publishers use another definition of its type.
    fn close_source(&mut self, index: usize, slot: SlotId) {
        drop(self.inbox.remove(slot));
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        source.reading = Reading::Pending;
        source.live = false;
        // Samples of the former definition must not be repeated with the new definition.
        let unbound = source.values.iter();
        self.events
            .extend(unbound.map(|(topic, _)| PortEvent::Unbound { topic: *topic }));
        info!(
            topic = source.dds_topic,
            message_type = %source.message_type,
            "the publishers use another definition of the type now"
        );
    }

    fn open_source(&mut self, index: usize, requested: Requested) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        let definition = match self.definitions.announced(&name, source.announced) {
            Ok(definition) => definition,
            Err(error) => {
                let values: Vec<_> = source.values.iter().map(|(topic, _)| *topic).collect();
                let first = self.tell_unknown_type(&topic, "cannot bridge the topic", &error);
                if first {
                    let uncrossed = values.into_iter();
                    self.events.extend(
                        uncrossed.map(|topic| lost(topic, (Reason::Untyped, UNKNOWN_TYPE), 1)),
                    );
                }
                return;
            }
        };
        self.announce_type(&definition);
        let Some(reader) = self.make(|domain| domain.reader(&topic, &name.dds(), requested)) else {
            return;
        };
        let slot = self.inbox.insert(index, reader);
        if let Some(source) = self.sources.get_mut(index) {
            source.reading = Reading::Open { slot, requested };
            source.announced = source.announced.or(definition.hash);
            info!(topic, message_type = %name, definition = %definition.from, %requested, "subscribed");
            for (topic, selection) in &source.values {
                self.events.push_back(PortEvent::Bound {
                    topic: *topic,
                    message_type: Arc::clone(&definition.message_type),
                    selection: selection.clone(),
                });
            }
            source.definition = Some(definition);
        }
    }

    /// Reopens a reader. A change of QoS requires a new reader. So do transient-local writers that
    /// return after an absence and have to resend their samples: for the existing reader these are
    /// not new. The former reader stays for a while: it fills the cache that both share until the
    /// writers have matched the new reader.
    fn reopen_source(&mut self, index: usize, requested: Requested, now: Instant) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let Reading::Open { slot, .. } = source.reading else {
            return;
        };
        let (topic, dds_type) = (source.dds_topic.clone(), source.message_type.dds());
        if let Some(definition) = &source.definition {
            self.announce_type(definition);
        }
        let Some(reader) = self.make(|domain| domain.reader(&topic, &dds_type, requested)) else {
            return;
        };
        if let Some(before) = self.inbox.replace(slot, reader) {
            self.retired.push_back((now + RETIRE_AFTER, before));
        }
        if let Some(source) = self.sources.get_mut(index) {
            source.reading = Reading::Open { slot, requested };
            if requested.is_transient_local() {
                for writer in source.returned(self.graph.writers(&topic)) {
                    source.reread(writer);
                    self.inbox.repeat_last(slot, writer);
                }
            }
            debug!(
                topic,
                %requested,
                "subscribed again because the publishers changed"
            );
        }
    }

    fn set_live(&mut self, index: usize, live: bool) {
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        if source.live == live || source.reading == Reading::Pending {
            return;
        }
        source.live = live;
        for (topic, _) in &source.values {
            self.events.push_back(PortEvent::Live {
                topic: *topic,
                live,
            });
        }
    }

    fn tell_stranger(&mut self, index: usize, stranger: &Endpoint) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        if let Some((theirs, ours)) = stranger.type_hash.zip(source.announced)
            && stranger.type_name == name.dds()
        {
            let owner = self.domain.owner(stranger.guid);
            self.policy.told.once(&topic, OTHER_DEFINITION, || {
                format!(
                    "messages of a publisher of {} are dropped: its definition of {name} has the hash \
                     {theirs}, but the topic uses {ours}; build both sides from the same definition",
                    owner.as_deref().unwrap_or("an unnamed node"),
                )
            });
            return;
        }
        self.policy.told.once(&topic, OTHER_TYPE, || {
            format!(
                "messages of a publisher are dropped: its type is {}, but the topic uses {name}",
                stranger.type_name
            )
        });
    }

    /// Logs and counts, once each, the remote endpoints that DDS does not match with ours.
    pub(super) fn note_incompatible(
        &mut self,
        side: &Side,
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
            let (dds_topic, topics, peer) = match side {
                Side::Source(index) => {
                    let Some(source) = self.sources.get(*index) else {
                        continue;
                    };
                    let topics = source.values.iter().map(|(topic, _)| *topic).collect();
                    (source.dds_topic.clone(), topics, "publisher")
                }
                Side::Sink(topic) => {
                    let Some(sink) = self.sinks.get(topic) else {
                        continue;
                    };
                    (sink.dds_topic.clone(), vec![*topic], "subscriber")
                }
            };
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
    pub(super) fn announce_type(&self, definition: &Definition) {
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
}

/// Our endpoints with which remote endpoints are not matched.
pub(super) enum Side {
    /// The reader of the source.
    Source(usize),
    /// The writer of the sink.
    Sink(TopicId),
}

/// The reason for drops on a topic of unknown type.
const UNKNOWN_TYPE: &str = "type without a definition";
/// How long a replaced reader keeps receiving.
const RETIRE_AFTER: Duration = Duration::from_secs(2);
/// Maximum number of endpoints created in one pass. RustDDS queues two commands for each and has
/// room for 1024.
pub(super) const MAX_BATCH: usize = 200;
