//! Making what is open fit what the domain holds.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::PortEvent;
use mappings::{PatternFault, PatternVariable, TopicId};
use messages::{MessageType, Selection, TypeName};
use rustdds::GUID;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use super::{MAX_TOPICS, Ros2Port, lost};
use crate::compatibility::Incompatibility;
use crate::domain::{Domain, DomainError};
use crate::graph::{Endpoint, ros_topic};
use crate::outlet::Outlet;
use crate::qos::Requested;
use crate::sink::{Open, Sink, shortest_deadline};
use crate::source::{Reading, Source};

impl Ros2Port {
    /// Makes what is open fit what the domain holds, at most [`MAX_BATCH`] endpoints at a time: RustDDS' discovery
    /// takes commands from a bounded queue and drops what does not fit.
    pub(super) fn reconcile(&mut self, now: Instant) {
        self.schedule.reconciled = now;
        self.schedule.changed = false;
        self.schedule.unfinished = false;
        self.budget = MAX_BATCH;
        while self.retired.front().is_some_and(|(until, _)| *until <= now) {
            self.retired.pop_front();
        }
        self.graph = self.domain.graph();
        let graph = &self.graph;
        self.incompatible.retain(|guid| graph.holds(*guid));
        self.report_drops();
        self.announce_anew(now);
        self.take_descriptions(now);
        self.find_topics(now);
        for index in 0..self.sources.len() {
            self.reconcile_source(index, now);
        }
        let topics: Vec<TopicId> = self.sinks.keys().copied().collect();
        for topic in topics {
            self.reconcile_sink(topic, now);
        }
    }

    /// Makes anew what RustDDS left out of its announcements.
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
        // What is left are endpoints of services and of the node itself, and readers that were replaced and hear on.
        if made == 0 {
            let count = lost.len();
            self.tell_once("", "unannounced", || {
                format!("{count} endpoints of services or of the node were not announced by the DDS stack; start again")
            });
        } else {
            warn!(
                endpoints = made,
                "readers and writers of ours were not announced by the DDS stack; made anew"
            );
        }
    }

    /// Zero configuration, and patterns: a topic named in our part of the space, or that a pattern is about, crosses as
    /// soon as somebody writes it.
    fn find_topics(&mut self, now: Instant) {
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
            // Those that were given up leave their place behind.
            let read = self.sources.iter().filter(|s| !s.values.is_empty());
            if read.count() >= MAX_TOPICS {
                self.tell_once("", "too many topics", || {
                    format!("more than {MAX_TOPICS} topics of the space: the rest is left alone")
                });
                return;
            }
            let same = |source: &&Source| source.values.iter().any(|(other, _)| *other == topic);
            if let Some(other) = self.sources.iter().find(same) {
                let other = other.dds_topic.clone();
                self.tell_once(&dds_topic, "pattern", || {
                    format!("it would be {topic}, which {other} is already: it does not cross")
                });
                continue;
            }
            let writers = self.graph.writers(&dds_topic).to_vec();
            let types: Vec<String> = writers
                .iter()
                .map(|writer| writer.type_name.clone())
                .collect();
            for name in types
                .iter()
                .filter_map(|name| TypeName::from_dds(name).ok())
            {
                // So that its hash is known; that it is not known is told below.
                let _known = self.definitions.get(&name).is_ok();
            }
            if !self.types_are_settled(&writers, now) {
                continue;
            }
            let known = types
                .iter()
                .filter(|name| self.may_be(&dds_topic, name))
                .cloned()
                .collect::<Vec<_>>()
                .iter()
                .find_map(|name| self.message_type(topic, &dds_topic, name));
            if let Some(message_type) = known {
                let index = self.source(dds_topic, message_type.name().clone());
                if let Some(source) = self.sources.get_mut(index) {
                    source.values.push((topic, selection));
                }
            }
        }
    }

    /// The value a topic is that the mapping does not name: by its own name, or by a pattern.
    fn value_of(&mut self, dds_topic: String) -> Option<(String, TopicId, Selection)> {
        let name = ros_topic(&dds_topic)?;
        if let Ok(topic) = name.parse::<TopicId>() {
            if topic.space != self.own {
                return None;
            }
            if self.is_tied(topic) {
                self.tell_once(&dds_topic, "tied elsewhere", || {
                    format!("{topic} comes from another ROS topic, as the mapping says; this one is left alone")
                });
                return None;
            }
            return Some((dds_topic, topic, Selection::Whole));
        }
        // Others who write where values of other spaces go are not a value of ours.
        if self.sinks.values().any(|sink| sink.dds_topic == dds_topic) {
            return None;
        }
        let made = self
            .graph
            .writers(&dds_topic)
            .iter()
            .find_map(|writer| self.made_of(name, &writer.type_name))?;
        match made {
            Ok(made) => Some((dds_topic, made.topic, made.selection)),
            Err(fault) => {
                self.tell_once(&dds_topic, "pattern", || fault.to_string());
                None
            }
        }
    }

    /// What a pattern makes of a topic that is written in that type.
    fn made_of(&self, name: &str, dds_type: &str) -> Option<Result<PatternVariable, PatternFault>> {
        let message_type = TypeName::from_dds(dds_type).ok()?;
        let name = format!("/{name}");
        self.mapping.matching(self.own, &name, Some(&message_type))
    }

    /// Whether a topic that the mapping does not name is a value in that type: a pattern may be about one type.
    fn may_be(&self, dds_topic: &str, dds_type: &str) -> bool {
        ros_topic(dds_topic).is_some_and(|name| {
            name.parse::<TopicId>().is_ok() || self.made_of(name, dds_type).is_some()
        })
    }

    /// Whether the mapping gives this value to another ROS topic of our domain.
    fn is_tied(&self, topic: TopicId) -> bool {
        self.mapping
            .variable(topic)
            .is_some_and(|variable| variable.binding(self.own).is_some())
    }

    /// The type a peer names, or `None` after saying once why it cannot be used.
    fn message_type(
        &mut self,
        topic: TopicId,
        dds_topic: &str,
        dds_type: &str,
    ) -> Option<Arc<MessageType>> {
        let found = match TypeName::from_dds(dds_type) {
            Ok(name) => self
                .definitions
                .get(&name)
                .map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        match found {
            Ok(message_type) => Some(message_type),
            Err(error) => {
                let first = self.tell_once(dds_topic, "unknown type", || {
                    format!(
                        "the topic cannot cross: {error}. Start the bridge where the ROS workspace that defines it \
                         is sourced (AMENT_PREFIX_PATH), or map the topic to a known type"
                    )
                });
                if first {
                    self.events
                        .push_back(lost(topic, "type without a definition", 1));
                }
                None
            }
        }
    }

    fn reconcile_source(&mut self, index: usize, now: Instant) {
        // Without a value it is one that the mapping no longer names.
        let sources = self.sources.get_mut(index);
        let Some(source) = sources.filter(|source| !source.values.is_empty()) else {
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
        let requested = Requested::from_writers(&ours);
        let returned = requested.is_transient_local() && !source.returned(writers).is_empty();
        match source.reading {
            Reading::Pending => {
                let name = source.message_type.clone();
                let known = self.definitions.get(&name).is_ok();
                // What nobody knows and nobody publishes is asked for when somebody does.
                if (known || !ours.is_empty()) && self.types_are_settled(&ours, now) {
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
        if let Some(stranger) = strange {
            self.tell_stranger(index, &stranger);
        }
    }

    fn open_source(&mut self, index: usize, requested: Requested) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        let message_type = match self.definitions.get(&name) {
            Ok(message_type) => message_type,
            Err(error) => {
                self.tell_once(&topic, "unknown type", || {
                    format!("the topic cannot cross: {error}")
                });
                return;
            }
        };
        self.announce_type(&name.dds(), &name);
        let Some(reader) = self.make(|domain| domain.reader(&topic, &name.dds(), requested)) else {
            return;
        };
        let slot = self.inbox.insert(index, reader);
        if let Some(source) = self.sources.get_mut(index) {
            source.reading = Reading::Open { slot, requested };
            let definition = self.definitions.source(&name);
            info!(topic, message_type = %name, definition, ?requested, "subscribed");
            for (topic, selection) in &source.values {
                self.events.push_back(PortEvent::Bound {
                    topic: *topic,
                    message_type: Arc::clone(&message_type),
                    selection: selection.clone(),
                });
            }
        }
    }

    /// Another QoS needs another reader, and so do transient-local writers that were gone for a while and are to tell again
    /// what they keep: to the reader there is, that is nothing new. It stays for a while: it fills the cache both share,
    /// until the writers have matched the new one.
    fn reopen_source(&mut self, index: usize, requested: Requested, now: Instant) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let Reading::Open { slot, .. } = source.reading else {
            return;
        };
        let (topic, dds_type) = (source.dds_topic.clone(), source.message_type.dds());
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
                ?requested,
                "subscribed anew, as its publishers changed"
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
        let (topic, name) = (source.dds_topic.clone(), source.message_type.to_string());
        self.tell_once(&topic, "publisher of another type", || {
            format!(
                "a publisher has type {}, but the topic crosses as {name}: its messages are dropped",
                stranger.type_name
            )
        });
    }

    fn reconcile_sink(&mut self, topic: TopicId, now: Instant) {
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        if self.graph.is_at_home(topic.space.into()) {
            // Another bridge serves its space in this domain. What was written would stand beside it, and grow old.
            let given_up = sink.open.take().is_some();
            let dds_topic = sink.dds_topic.clone();
            if given_up {
                self.tell_once(&dds_topic, "at home", || {
                    format!(
                        "another bridge of this domain serves space {}: its values are left to it",
                        topic.space
                    )
                });
            }
            return;
        }
        let readers = self.graph.readers(&sink.dds_topic);
        if let Some(open) = &mut sink.open {
            match open.outlet.set_readers(readers, now) {
                Ok(()) => {}
                Err(refusal) => self.events.push_back(lost(topic, refusal.label(), 1)),
            }
            self.schedule.waiting |= open.outlet.is_waiting();
            if open.outlet.is_stuck(now) {
                self.replace_writer(topic, now);
                return;
            }
            if let Some(deadline) = open.shorter_deadline(readers) {
                let before = open.deadline.replace(deadline);
                open.tightened += 1;
                self.offer_deadline(topic, before, now);
                return;
            }
            let offered = sink.offered.with_deadline(open.deadline);
            let dds_type = open.message_type.name().dds();
            let asks: Vec<_> = readers
                .iter()
                .filter(|reader| reader.type_name == dds_type)
                .map(|reader| (reader.guid, Incompatibility::between(&offered, &reader.qos)))
                .collect();
            self.note_incompatible(&Side::Sink(topic), asks);
        }
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let readers = self.graph.readers(&sink.dds_topic);
        if !sink.serves(readers) {
            self.open_sink(topic);
        }
    }

    /// A reader that acknowledges nothing must not keep a value from the others.
    fn replace_writer(&mut self, topic: TopicId, now: Instant) {
        if let Some(dds_topic) = self.advertise_anew(topic, now) {
            warn!(
                topic = dds_topic,
                "a subscriber does not acknowledge; advertised anew for the others"
            );
        }
    }

    /// A reader that asks for a deadline is matched by a writer that offers it.
    fn offer_deadline(&mut self, topic: TopicId, before: Option<rustdds::Duration>, now: Instant) {
        if let Some(dds_topic) = self.advertise_anew(topic, now) {
            info!(
                topic = dds_topic,
                "a subscriber asks for a deadline; advertised anew with it"
            );
        } else if let Some(open) = self
            .sinks
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            // The writer there is goes on with what it offers; the next look tries again.
            open.deadline = before;
        }
    }

    /// Puts another writer in the place of a sink's; returns the topic.
    fn advertise_anew(&mut self, topic: TopicId, now: Instant) -> Option<String> {
        let sink = self.sinks.get(&topic)?;
        let open = sink.open.as_ref()?;
        let dds_topic = sink.dds_topic.clone();
        let qos = sink.offered.with_deadline(open.deadline);
        let dds_type = open.message_type.name().dds();
        let writer = self.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))?;
        if let Some(open) = self
            .sinks
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            open.outlet.replace_writer(writer, now);
        }
        Some(dds_topic)
    }

    /// Tells and counts, once each, the endpoints of others that DDS does not match with ours.
    fn note_incompatible(&mut self, side: &Side, peers: Vec<(GUID, Option<Incompatibility>)>) {
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
            self.tell_once(&dds_topic, found.policy, || {
                format!(
                    "a {peer} of {} is not matched: in {} {} is offered and {} requested",
                    owner.as_deref().unwrap_or("an unnamed node"),
                    found.policy,
                    found.offered,
                    found.requested
                )
            });
        }
    }

    /// Opens a sink in the best type there is; one that is open in a lesser type is opened anew.
    pub(super) fn open_sink(&mut self, topic: TopicId) {
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let (dds_topic, offered) = (sink.dds_topic.clone(), sink.offered);
        let mut found = None;
        for name in sink.candidates(self.graph.readers(&sink.dds_topic)) {
            match self.definitions.get(&name) {
                Ok(message_type) => {
                    found = Some(message_type);
                    break;
                }
                Err(error) => {
                    self.tell_once(&dds_topic, "unknown type", || {
                        format!("no value can be written in the type asked for: {error}")
                    });
                }
            }
        }
        let Some(message_type) = found else { return };
        let dds_type = message_type.name().dds();
        if self.is_open_as(topic, &message_type) {
            self.tell_once(&dds_topic, "subscriber of another type", || {
                format!("a subscriber asks for another type than {dds_type}, in which the topic is written")
            });
            return;
        }
        let deadline = shortest_deadline(self.graph.readers(&dds_topic));
        let qos = offered.with_deadline(deadline);
        self.announce_type(&dds_type, message_type.name());
        let Some(writer) = self.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))
        else {
            return;
        };
        let definition = self.definitions.source(message_type.name());
        info!(topic = dds_topic, message_type = %message_type.name(), definition, ?offered, "advertised");
        let mut outlet = Outlet::new(writer, offered);
        if let Err(refusal) = outlet.set_readers(self.graph.readers(&dds_topic), Instant::now()) {
            self.events.push_back(lost(topic, refusal.label(), 1));
        }
        let mut selection = Selection::Whole;
        if let Some(sink) = self.sinks.get_mut(&topic) {
            selection = sink.selection(message_type.name());
            sink.open = Some(Open {
                message_type: Arc::clone(&message_type),
                outlet,
                deadline,
                tightened: 0,
                stamps: sink.stamps(&message_type),
            });
        }
        self.events.push_back(PortEvent::Bound {
            topic,
            message_type,
            selection,
        });
    }

    /// Has the domain announce the hash of a type.
    fn announce_type(&self, dds_type: &str, name: &TypeName) {
        if let Some(hash) = self.definitions.hash_of(name) {
            self.domain.learn_type_hash(dds_type, hash.to_string());
            if let Ok(described) = self.definitions.described(name) {
                self.told_types.learn(&described, name, hash);
            }
        }
    }

    fn is_open_as(&self, topic: TopicId, message_type: &MessageType) -> bool {
        self.sinks
            .get(&topic)
            .and_then(|sink| sink.open.as_ref())
            .is_some_and(|open| open.message_type.name() == message_type.name())
    }

    /// Makes an endpoint if the budget allows; `None` when it does not, or when RustDDS fails, which is told once.
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
                self.tell_once(&text, "endpoint", || text.clone());
                None
            }
        }
    }
}

/// Which of our endpoints others are not matched with.
enum Side {
    /// The reader of that source.
    Source(usize),
    /// The writer of that sink.
    Sink(TopicId),
}

/// How long a replaced reader hears on.
const RETIRE_AFTER: Duration = Duration::from_secs(2);
/// Endpoints made in one go. RustDDS queues two commands for each, and has room for 1024.
pub(super) const MAX_BATCH: usize = 200;
