//! The readers of the topics: opened, reopened and closed as the publishers of the domain require.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::policy::MAX_TOPICS;
use bridge_node::{PortEvent, Reason};
use mappings::TopicId;
use messages::{Selection, TypeName};
use ros2_node::compatibility::Incompatibility;
use ros2_node::graph::RemoteEndpoint;
use ros2_node::inbox::SlotId;
use ros2_node::qos::Requested;
use rustdds::GUID;
use tokio::time::Instant;
use tracing::{debug, info};

use super::super::side::{Ros2Side, SETTLED, UNKNOWN_TYPE, lost, shown_topic};
use super::ReadTopics;
use crate::definitions::TypeDefinition;
use crate::source::{OTHER_DEFINITION, OTHER_TYPE, ReaderState};

impl ReadTopics {
    /// Finds topics without a binding (zero configuration and patterns): a topic named in our part
    /// of the space, or matched by a pattern, crosses once it has a publisher. `is_written`
    /// returns whether values of other spaces are written to a topic.
    pub(in crate::port) fn find(
        &mut self,
        side: &mut Ros2Side,
        is_written: impl Fn(&str) -> bool,
        now: Instant,
    ) {
        let pending = self.list.iter();
        let pending = pending.filter(|source| source.reading == ReaderState::Pending);
        let free = side.descriptors.free().found;
        let mut free = free.saturating_sub(pending.count());
        let unknown = |topic: &&str| !self.by_name.contains_key(*topic);
        let found: Vec<(String, TopicId, Selection)> = side
            .graph
            .written_topics()
            .filter(unknown)
            .map(str::to_owned)
            .collect::<Vec<_>>()
            .into_iter()
            .filter_map(|topic| side.value_of(topic, &is_written))
            .collect();
        for (dds_topic, topic, selection) in found {
            // Sources that were given up keep their slots.
            let read = self.list.iter().filter(|s| !s.values.is_empty());
            if read.count() >= MAX_TOPICS {
                side.policy.told.once("", "too many topics", || {
                    format!(
                        "more than {MAX_TOPICS} topics of the space: the bridge ignores the others"
                    )
                });
                return;
            }
            let mut sources = self.list.iter();
            let same =
                sources.find(|source| source.values.iter().any(|(other, _)| *other == topic));
            if let Some(other) = same {
                let other = other.dds_topic.clone();
                side.policy.tell_same(&dds_topic, topic, &other);
                continue;
            }
            if free == 0 {
                side.tell_scarce();
                side.events.push_back(PortEvent::Dropped {
                    reason: Reason::TooManyTopics,
                    why: "not enough file descriptors for the topic",
                    count: 1,
                });
                return;
            }
            if let Some(name) = side.found_type(topic, &dds_topic, now) {
                free -= 1;
                let index = self.source(dds_topic, name);
                if let Some(source) = self.list.get_mut(index) {
                    source.values.push((topic, selection));
                }
            }
        }
    }

    /// Reopens the readers that RustDDS left out of its announcements. Returns their number.
    pub(in crate::port) fn announce_anew(
        &mut self,
        side: &mut Ros2Side,
        lost: &BTreeSet<GUID>,
        now: Instant,
    ) -> usize {
        let mut made = 0_usize;
        for index in 0..self.list.len() {
            let Some(ReaderState::Open { slot, requested }) =
                self.list.get(index).map(|s| s.reading)
            else {
                continue;
            };
            let is_lost = |guid: GUID| lost.contains(&guid);
            if self.inbox.guid(slot).is_some_and(is_lost) {
                self.reopen_source(side, index, requested, now);
                made += 1;
            }
        }
        made
    }

    /// Reconciles the readers with the publishers of the domain.
    pub(in crate::port) fn reconcile(&mut self, side: &mut Ros2Side, now: Instant) {
        for index in 0..self.list.len() {
            self.reconcile_source(side, index, now);
        }
    }

    fn reconcile_source(&mut self, side: &mut Ros2Side, index: usize, now: Instant) {
        // A source without a value is no longer named by the mapping.
        let source = self.list.get(index);
        if source.is_none_or(|source| source.values.is_empty()) {
            return;
        }
        let settled = self.settle_source(side, index, now);
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        let writers = side.graph.writers(&source.dds_topic);
        let ours = source.meet(writers);
        for publisher in source.gone(writers) {
            let values = source.values.iter();
            side.events.extend(values.map(|(topic, _)| PortEvent::Left {
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
            ReaderState::Pending => {
                let name = source.message_type.clone();
                let known = side.definitions.get(&name).is_ok();
                // A reader that requests more than a writer offers makes the writer's node log a
                // warning. After the wait, the present writers are known.
                let is_early = ours.is_empty() && side.joined.elapsed() < SETTLED;
                if is_early {
                    side.schedule.look_next();
                }
                // The unknown type of a topic without a publisher is requested when a publisher
                // appears.
                if (known || !ours.is_empty()) && settled && !is_early {
                    self.open_source(side, index, requested);
                }
            }
            ReaderState::Open {
                requested: before, ..
            } if (before != requested && !ours.is_empty()) || returned => {
                self.reopen_source(side, index, requested, now);
            }
            ReaderState::Open { slot, .. } => self
                .inbox
                .retain_writers(slot, |writer| writers.iter().any(|w| w.guid == *writer)),
        }
        let wanted = requested.policies();
        let offers: Vec<_> = ours
            .iter()
            .map(|writer| (writer.guid, Incompatibility::between(&writer.qos, &wanted)))
            .collect();
        self.set_live(side, index, !ours.is_empty());
        let about = || {
            let source = self.list.get(index);
            let topics = source.into_iter().flat_map(|source| &source.values);
            let topics = topics.map(|(topic, _)| *topic).collect();
            let dds_topic = source.map(|source| source.dds_topic.clone());
            (dds_topic.unwrap_or_default(), topics, "publisher")
        };
        side.note_incompatible(about, offers);
        if let Some(stranger) = strange.filter(|_| settled) {
            self.tell_stranger(side, index, &stranger);
        }
    }

    /// Selects the definition of a source's type; returns `false` while a node is asked. Closes a
    /// reader that uses another definition, so that a new reader can be created.
    fn settle_source(&mut self, side: &mut Ros2Side, index: usize, now: Instant) -> bool {
        let Some(source) = self.list.get(index) else {
            return false;
        };
        let (name, current) = (source.message_type.clone(), source.announced);
        let dds_type = name.dds();
        let writers = side.graph.writers(&source.dds_topic);
        let read_so = |writer: &RemoteEndpoint| writer.is_of(&dds_type, current);
        // Only while the source is read with the definition of the hash: a built-in definition
        // precedes a hash that no node describes.
        let known = source.definition.as_ref().map(|it| it.hash) == Some(current);
        if current.is_some() && known && writers.iter().any(read_so) {
            return true;
        }
        let writers = writers.to_vec();
        let Some(hash) = side.hash_that_counts(&name, &writers, current, now) else {
            return false;
        };
        let found = side.definitions.announced(&name, hash).ok();
        let Some(source) = self.list.get_mut(index) else {
            return false;
        };
        let same = |(a, b): (&TypeDefinition, &TypeDefinition)| a.is_same(b);
        let read = source.definition.as_ref().zip(found.as_ref());
        if let ReaderState::Open { slot, .. } = source.reading
            && !read.is_none_or(same)
        {
            // The reader holds samples of the former definition; the new definition would misread
            // them.
            source.meet(&writers);
            for taken in self.inbox.drain(slot) {
                self.handle(side, taken);
            }
            self.close_source(side, index, slot);
        }
        if let Some(source) = self.list.get_mut(index) {
            source.announced = hash.or(current);
        }
        true
    }

    /// Closes the reader of a source because its publishers use another definition of its type.
    fn close_source(&mut self, side: &mut Ros2Side, index: usize, slot: SlotId) {
        drop(self.inbox.remove(slot));
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        source.reading = ReaderState::Pending;
        source.live = false;
        // Samples of the former definition must not be repeated with the new definition.
        let unbound = source.values.iter();
        side.events
            .extend(unbound.map(|(topic, _)| PortEvent::Unbound { topic: *topic }));
        info!(
            topic = source.dds_topic,
            message_type = %source.message_type,
            "the publishers use another definition of the type now"
        );
    }

    fn open_source(&mut self, side: &mut Ros2Side, index: usize, requested: Requested) {
        let Some(source) = self.list.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        let definition = match side.definitions.announced(&name, source.announced) {
            Ok(definition) => definition,
            Err(error) => {
                let values: Vec<_> = source.values.iter().map(|(topic, _)| *topic).collect();
                let first = side.tell_unknown_type(&topic, "cannot bridge the topic", &error);
                if first {
                    let uncrossed = values.into_iter();
                    side.events.extend(
                        uncrossed.map(|topic| lost(topic, (Reason::Untyped, UNKNOWN_TYPE), 1)),
                    );
                }
                return;
            }
        };
        side.announce_type(&definition);
        let Some(reader) = side.make(|domain| domain.reader(&topic, &name.dds(), requested)) else {
            return;
        };
        let slot = self.inbox.insert(index, reader);
        if let Some(source) = self.list.get_mut(index) {
            source.reading = ReaderState::Open { slot, requested };
            source.announced = source.announced.or(definition.hash);
            info!(topic = shown_topic(&topic), message_type = %name, definition = %definition.from, %requested, "subscribed");
            for (topic, selection) in &source.values {
                side.events.push_back(PortEvent::Bound {
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
    fn reopen_source(
        &mut self,
        side: &mut Ros2Side,
        index: usize,
        requested: Requested,
        now: Instant,
    ) {
        let Some(source) = self.list.get(index) else {
            return;
        };
        let ReaderState::Open { slot, .. } = source.reading else {
            return;
        };
        let (topic, dds_type) = (source.dds_topic.clone(), source.message_type.dds());
        if let Some(definition) = &source.definition {
            side.announce_type(definition);
        }
        let Some(reader) = side.make(|domain| domain.reader(&topic, &dds_type, requested)) else {
            return;
        };
        if let Some(before) = self.inbox.replace(slot, reader) {
            self.retired.push_back((now + RETIRE_AFTER, before));
        }
        if let Some(source) = self.list.get_mut(index) {
            source.reading = ReaderState::Open { slot, requested };
            if requested.is_transient_local() {
                for writer in source.returned(side.graph.writers(&topic)) {
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

    fn set_live(&mut self, side: &mut Ros2Side, index: usize, live: bool) {
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        if source.live == live || source.reading == ReaderState::Pending {
            return;
        }
        source.live = live;
        for (topic, _) in &source.values {
            side.events.push_back(PortEvent::Live {
                topic: *topic,
                live,
            });
        }
    }

    fn tell_stranger(&mut self, side: &mut Ros2Side, index: usize, stranger: &RemoteEndpoint) {
        let Some(source) = self.list.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        if let Some((theirs, ours)) = stranger.type_hash.zip(source.announced)
            && stranger.type_name == name.dds()
        {
            let owner = side.domain.owner(stranger.guid);
            side.policy.told.once(&topic, OTHER_DEFINITION, || {
                format!(
                    "messages of a publisher of {} are dropped: its definition of {name} has the hash \
                     {theirs}, but the topic uses {ours}; build both sides from the same definition",
                    owner.as_deref().unwrap_or("an unnamed node"),
                )
            });
            return;
        }
        let owner = side.domain.owner(stranger.guid);
        side.policy.told.once(&topic, OTHER_TYPE, || {
            let theirs = TypeName::from_dds(&stranger.type_name);
            format!(
                "messages of {} are dropped: it publishes {}, but the topic uses {name}",
                owner.as_deref().unwrap_or("an unnamed node"),
                theirs.map_or_else(|_| stranger.type_name.clone(), |theirs| theirs.to_string())
            )
        });
    }
}

/// How long a replaced reader keeps receiving.
const RETIRE_AFTER: Duration = Duration::from_secs(2);
