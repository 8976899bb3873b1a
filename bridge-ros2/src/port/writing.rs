//! Manages the topics that the bridge writes: their type, their definition and their readers.

use std::sync::Arc;

use bridge_node::policy::NO_SUBSCRIBER;
use bridge_node::{Handover, PortEvent, Reason};
use mappings::TopicId;
use messages::Selection;
use ros2_node::compatibility::Incompatibility;
use ros2_node::graph::Endpoint;
use ros2_node::outlet::{Outlet, Progress, Refusal};
use tokio::time::Instant;
use tracing::{info, warn};

use super::reconcile::Side;
use super::{Ros2Port, lost};
use crate::sink::{Open, shortest_deadline};

impl Ros2Port {
    pub(super) fn reconcile_sink(&mut self, topic: TopicId, now: Instant) {
        let at_home = self.is_at_home(topic.space);
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        if at_home {
            // Another bridge serves the space in this domain. A value written here would compete
            // with its values and become stale.
            let given_up = sink.open.take();
            let dds_topic = sink.dds_topic.clone();
            if let Some(open) = given_up {
                self.events.extend(unwritten(topic, &open));
                self.policy.told.once(&dds_topic, "at home", || {
                    format!(
                        "another bridge of this domain serves space {}: this bridge does not write values of the space",
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
                Err(refusal) => self.events.push_back(lost(topic, cause(refusal), 1)),
            }
            self.schedule.note_waiting(topic, open.outlet.is_waiting());
            if open.outlet.is_repairing() {
                self.schedule.look_next();
            }
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
            let dds_type = open.definition.name().dds();
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
        if sink.serves(readers) {
            self.note_others(topic);
        } else {
            self.open_sink(topic, now);
        }
    }

    /// Logs the readers that the written type does not serve: readers of another type and, counted
    /// once each, readers with another definition of the type.
    fn note_others(&mut self, topic: TopicId) {
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let Some(open) = &sink.open else { return };
        let (name, ours) = (open.definition.name().clone(), open.definition.hash);
        let dds_type = name.dds();
        let readers = self.graph.readers(&sink.dds_topic);
        let of_another_type = readers.iter().find(|reader| reader.type_name != dds_type);
        let of_another_type = of_another_type.map(|reader| reader.type_name.clone());
        let other =
            |reader: &&Endpoint| reader.type_name == dds_type && !reader.is_of(&dds_type, ours);
        let others: Vec<Endpoint> = readers.iter().filter(other).cloned().collect();
        let dds_topic = sink.dds_topic.clone();
        if let Some(other) = of_another_type {
            self.policy.told.once(&dds_topic, "subscriber of another type", || {
                format!(
                    "a subscriber requests the type {other}, but the topic has the type {dds_type}: the \
                     subscriber receives no values"
                )
            });
        }
        for reader in others {
            let (Some(theirs), Some(ours)) = (reader.type_hash, ours) else {
                continue;
            };
            if !self.misreading.insert(reader.guid) {
                continue;
            }
            self.events
                .push_back(lost(topic, (Reason::Mismatch, OTHER_DEFINITION_READ), 1));
            let owner = self.domain.owner(reader.guid);
            self.policy.told.once(&dds_topic, OTHER_DEFINITION_READ, || {
                format!(
                    "a subscriber of {} may misread the values: its definition of {name} has the hash \
                     {theirs}, but the bridge writes with {ours}; build both sides from the same definition",
                    owner.as_deref().unwrap_or("an unnamed node"),
                )
            });
        }
    }

    /// Replaces the writer, so that a reader that acknowledges nothing does not block the value for
    /// other readers.
    fn replace_writer(&mut self, topic: TopicId, now: Instant) {
        if let Some(dds_topic) = self.advertise_anew(topic, now) {
            warn!(
                topic = dds_topic,
                "a subscriber does not acknowledge values; advertised the topic again for the other subscribers"
            );
        }
    }

    /// Replaces the writer: a reader that requests a deadline matches only a writer that offers it.
    fn offer_deadline(&mut self, topic: TopicId, before: Option<rustdds::Duration>, now: Instant) {
        if let Some(dds_topic) = self.advertise_anew(topic, now) {
            info!(
                topic = dds_topic,
                "advertised the topic again with the deadline that a subscriber requests"
            );
        } else if let Some(open) = self
            .sinks
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            // The existing writer keeps its offered deadline; the next pass tries again.
            open.deadline = before;
        }
    }

    /// Replaces the writer of a sink; returns the topic.
    pub(super) fn advertise_anew(&mut self, topic: TopicId, now: Instant) -> Option<String> {
        let sink = self.sinks.get(&topic)?;
        let open = sink.open.as_ref()?;
        let dds_topic = sink.dds_topic.clone();
        let qos = sink.offered.with_deadline(open.deadline);
        let dds_type = open.definition.name().dds();
        self.announce_type(&open.definition);
        let writer = self.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))?;
        if let Some(open) = self
            .sinks
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            open.outlet.replace_writer(writer, now);
            self.schedule.note_waiting(topic, open.outlet.is_waiting());
        }
        self.schedule.look_next();
        Some(dds_topic)
    }

    /// Opens a sink in the best known type, or reopens a sink that is open in a lesser type.
    ///
    /// While a node is asked for the type of one subscriber, the subscriber of another type does
    /// not wait: the sink stays with the type that is served. A type without a subscriber is not
    /// opened before the response.
    pub(super) fn open_sink(&mut self, topic: TopicId, now: Instant) {
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let (dds_topic, offered) = (sink.dds_topic.clone(), sink.offered);
        let readers = self.graph.readers(&dds_topic).to_vec();
        let mut found = None;
        let mut asking = false;
        for name in sink.candidates(&readers) {
            let open = self.sinks.get(&topic).and_then(|sink| sink.open.as_ref());
            let open = open.filter(|open| *open.definition.name() == name);
            let is_open = open.is_some();
            let current = open.and_then(|open| open.definition.hash);
            let Some(hash) = self.hash_that_counts(&name, &readers, current, now) else {
                if is_open {
                    return;
                }
                asking = true;
                continue;
            };
            match self.definitions.announced(&name, hash) {
                Ok(definition) => {
                    found = Some(definition);
                    break;
                }
                Err(error) => {
                    let what = "the requested type cannot hold the value";
                    self.tell_unknown_type(&dds_topic, what, &error);
                }
            }
        }
        let Some(definition) = found else {
            return;
        };
        let dds_type = definition.name().dds();
        if asking && !readers.iter().any(|reader| reader.type_name == dds_type) {
            return;
        }
        let open = self.sinks.get(&topic).and_then(|sink| sink.open.as_ref());
        if open.is_some_and(|open| {
            open.definition.name() == definition.name() && open.definition.is_same(&definition)
        }) {
            self.note_others(topic);
            return;
        }
        let deadline = shortest_deadline(&readers);
        let qos = offered.with_deadline(deadline);
        self.announce_type(&definition);
        let Some(writer) = self.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))
        else {
            return;
        };
        info!(topic = dds_topic, message_type = %definition.name(), definition = %definition.from, %offered, "advertised");
        let mut outlet = Outlet::new(writer, offered, self.domain.joined());
        if let Err(refusal) = outlet.set_readers(&readers, Instant::now()) {
            self.events.push_back(lost(topic, cause(refusal), 1));
        }
        let message_type = Arc::clone(&definition.message_type);
        let mut selection = Selection::Whole;
        if let Some(sink) = self.sinks.get_mut(&topic) {
            let before = sink.open.as_ref();
            self.events
                .extend(before.and_then(|open| unwritten(topic, open)));
            sink.choice.learn_from(&message_type);
            selection = sink.choice.selection(message_type.name());
            sink.open = Some(Open {
                definition,
                outlet,
                deadline,
                tightened: 0,
                stamps: sink.choice.stamps(&message_type),
            });
        }
        self.events.push_back(PortEvent::Bound {
            topic,
            message_type,
            selection,
        });
    }
}

/// Returns the counter and the label under which a refusal is counted.
pub(super) fn cause(refusal: Refusal) -> (Reason, &'static str) {
    match refusal {
        Refusal::Overflow => (Reason::Overflow, refusal.label()),
        Refusal::NoReader => (Reason::NoSubscriber, NO_SUBSCRIBER),
        Refusal::TooLarge(_) | Refusal::Late | Refusal::Failed => {
            (Reason::NotPublished, refusal.label())
        }
    }
}

/// Returns the handover of a value by the progress of its writer.
pub(super) const fn handover(progress: Progress) -> Handover {
    match progress {
        Progress::NoReader => Handover::Nobody,
        Progress::Waiting => Handover::Waiting,
        Progress::Written => Handover::Done,
    }
}

/// Returns the loss of the values that still wait in a writer that is given up.
pub(super) fn unwritten(topic: TopicId, open: &Open) -> Option<PortEvent> {
    let waiting = open.outlet.waiting();
    (waiting > 0).then(|| {
        lost(
            topic,
            (Reason::Overflow, "the writer of the topic was replaced"),
            waiting,
        )
    })
}

/// The reason for counting a reader with another type hash than the written type.
const OTHER_DEFINITION_READ: &str = "subscriber of another definition";
