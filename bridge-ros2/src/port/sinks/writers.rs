//! The writers of the topics: opened and replaced as the subscribers of the domain require.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Instant as StdInstant;

use bridge_node::policy::{Admission, Policy, longest_silent};
use bridge_node::{PortEvent, Reason, now};
use mappings::TopicId;
use messages::Selection;
use ros2_node::compatibility::Incompatibility;
use ros2_node::graph::{Graph, RemoteEndpoint};
use ros2_node::outlet::Outlet;
use tokio::time::Instant;
use tracing::{info, warn};

use super::super::side::{Ros2Side, lost, shown_topic};
use super::{WrittenTopics, cause, unwritten};
use crate::sink::{OpenWriter, Ros2Sink, shortest_deadline};

impl WrittenTopics {
    /// Opens the writer of a topic, or adapts it to the subscribers.
    pub(super) fn reconcile_sink(&mut self, side: &mut Ros2Side, topic: TopicId, now: Instant) {
        let at_home = side.is_at_home(topic.space);
        let Some(sink) = self.topics.get_mut(&topic) else {
            return;
        };
        if at_home {
            // Another bridge serves the space in this domain. A value written here would compete
            // with its values and become stale.
            let given_up = sink.open.take();
            let dds_topic = sink.dds_topic.clone();
            if let Some(open) = given_up {
                side.events.extend(unwritten(topic, &open));
                side.policy.told.once(&dds_topic, "at home", || {
                    format!(
                        "another bridge of this domain serves space {}: this bridge does not write values of the space",
                        topic.space
                    )
                });
            }
            return;
        }
        let readers = side.graph.readers(&sink.dds_topic);
        if let Some(open) = &mut sink.open {
            match open.outlet.set_readers(readers, now) {
                Ok(()) => {}
                Err(refusal) => side.events.push_back(lost(topic, cause(refusal), 1)),
            }
            side.schedule.note_waiting(topic, open.outlet.is_waiting());
            if open.outlet.is_repairing() {
                side.schedule.look_next();
            }
            if open.outlet.is_stuck(now) {
                self.replace_writer(side, topic, now);
                return;
            }
            if let Some(deadline) = open.shorter_deadline(readers) {
                let before = open.deadline.replace(deadline);
                open.tightened += 1;
                self.offer_deadline(side, topic, before, now);
                return;
            }
            let offered = sink.offered.with_deadline(open.deadline);
            let dds_type = open.definition.name().dds();
            let asks: Vec<_> = readers
                .iter()
                .filter(|reader| reader.type_name == dds_type)
                .map(|reader| (reader.guid, Incompatibility::between(&offered, &reader.qos)))
                .collect();
            let dds_topic = &sink.dds_topic;
            let about = || (dds_topic.clone(), vec![topic], "subscriber");
            side.note_incompatible(about, asks);
        }
        let Some(sink) = self.topics.get(&topic) else {
            return;
        };
        let readers = side.graph.readers(&sink.dds_topic);
        if sink.serves(readers) {
            self.note_others(side, topic);
        } else {
            self.open_sink(side, topic, now);
        }
    }

    /// Logs the readers that the written type does not serve: readers of another type and, counted
    /// once each, readers with another definition of the type.
    fn note_others(&mut self, side: &mut Ros2Side, topic: TopicId) {
        let Some(sink) = self.topics.get(&topic) else {
            return;
        };
        let Some(open) = &sink.open else { return };
        let (name, ours) = (open.definition.name().clone(), open.definition.hash);
        let dds_type = name.dds();
        let readers = side.graph.readers(&sink.dds_topic);
        let of_another_type = readers.iter().find(|reader| reader.type_name != dds_type);
        let of_another_type = of_another_type.map(|reader| reader.type_name.clone());
        let other = |reader: &&RemoteEndpoint| {
            reader.type_name == dds_type && !reader.is_of(&dds_type, ours)
        };
        let others: Vec<RemoteEndpoint> = readers.iter().filter(other).cloned().collect();
        let dds_topic = sink.dds_topic.clone();
        if let Some(other) = of_another_type {
            side.policy.told.once(&dds_topic, "subscriber of another type", || {
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
            side.events
                .push_back(lost(topic, (Reason::Mismatch, OTHER_DEFINITION_READ), 1));
            let owner = side.domain.owner(reader.guid);
            side.policy.told.once(&dds_topic, OTHER_DEFINITION_READ, || {
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
    fn replace_writer(&mut self, side: &mut Ros2Side, topic: TopicId, now: Instant) {
        if let Some(dds_topic) = self.advertise_anew(side, topic, now) {
            warn!(
                topic = dds_topic,
                "a subscriber does not acknowledge values; advertised the topic again for the other subscribers"
            );
        }
    }

    /// Replaces the writer: a reader that requests a deadline matches only a writer that offers it.
    fn offer_deadline(
        &mut self,
        side: &mut Ros2Side,
        topic: TopicId,
        before: Option<rustdds::Duration>,
        now: Instant,
    ) {
        if let Some(dds_topic) = self.advertise_anew(side, topic, now) {
            info!(
                topic = dds_topic,
                "advertised the topic again with the deadline that a subscriber requests"
            );
        } else if let Some(open) = self
            .topics
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            // The existing writer keeps its offered deadline; the next pass tries again.
            open.deadline = before;
        }
    }

    /// Replaces the writer of a sink; returns the topic.
    pub(super) fn advertise_anew(
        &mut self,
        side: &mut Ros2Side,
        topic: TopicId,
        now: Instant,
    ) -> Option<String> {
        let sink = self.topics.get(&topic)?;
        let open = sink.open.as_ref()?;
        let dds_topic = sink.dds_topic.clone();
        let qos = sink.offered.with_deadline(open.deadline);
        let dds_type = open.definition.name().dds();
        side.announce_type(&open.definition);
        let writer = side.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))?;
        if let Some(open) = self
            .topics
            .get_mut(&topic)
            .and_then(|sink| sink.open.as_mut())
        {
            open.outlet.replace_writer(writer, now);
            side.schedule.note_waiting(topic, open.outlet.is_waiting());
        }
        side.schedule.look_next();
        Some(dds_topic)
    }

    /// Opens a sink in the best known type, or reopens a sink that is open in a lesser type.
    ///
    /// While a node is asked for the type of one subscriber, the subscriber of another type does
    /// not wait: the sink stays with the type that is served. A type without a subscriber is not
    /// opened before the response.
    pub(super) fn open_sink(&mut self, side: &mut Ros2Side, topic: TopicId, now: Instant) {
        let Some(sink) = self.topics.get(&topic) else {
            return;
        };
        let (dds_topic, offered) = (sink.dds_topic.clone(), sink.offered);
        let readers = side.graph.readers(&dds_topic).to_vec();
        let mut found = None;
        let mut asking = false;
        for name in sink.candidates(&readers) {
            let open = self.topics.get(&topic).and_then(|sink| sink.open.as_ref());
            let open = open.filter(|open| *open.definition.name() == name);
            let is_open = open.is_some();
            let current = open.and_then(|open| open.definition.hash);
            let Some(hash) = side.hash_that_counts(&name, &readers, current, now) else {
                if is_open {
                    return;
                }
                asking = true;
                continue;
            };
            match side.definitions.announced(&name, hash) {
                Ok(definition) => {
                    found = Some(definition);
                    break;
                }
                Err(error) => {
                    let what = "the requested type cannot hold the value";
                    side.tell_unknown_type(&dds_topic, what, &error);
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
        let open = self.topics.get(&topic).and_then(|sink| sink.open.as_ref());
        if open.is_some_and(|open| {
            open.definition.name() == definition.name() && open.definition.is_same(&definition)
        }) {
            self.note_others(side, topic);
            return;
        }
        let deadline = shortest_deadline(&readers);
        let qos = offered.with_deadline(deadline);
        side.announce_type(&definition);
        let Some(writer) = side.make(|domain| domain.open_writer(&dds_topic, &dds_type, &qos))
        else {
            return;
        };
        info!(topic = shown_topic(&dds_topic), message_type = %definition.name(), definition = %definition.from, %offered, "advertised");
        let mut outlet = Outlet::new(writer, offered, side.domain.joined());
        if let Err(refusal) = outlet.set_readers(&readers, Instant::now()) {
            side.events.push_back(lost(topic, cause(refusal), 1));
        }
        let message_type = Arc::clone(&definition.message_type);
        let mut selection = Selection::Whole;
        if let Some(sink) = self.topics.get_mut(&topic) {
            let before = sink.open.as_ref();
            side.events
                .extend(before.and_then(|open| unwritten(topic, open)));
            sink.choice.learn_from(&message_type);
            selection = sink.choice.selection(message_type.name());
            sink.open = Some(OpenWriter {
                definition,
                outlet,
                deadline,
                tightened: 0,
                stamps: sink.choice.stamps(&message_type),
            });
        }
        side.events.push_back(PortEvent::Bound {
            topic,
            message_type,
            selection,
        });
    }

    /// Creates a sink for the value; returns false if there is no room for a value without a
    /// mapping and subscriber.
    pub(super) fn take_in(&mut self, side: &mut Ros2Side, topic: TopicId) -> bool {
        if self.topics.contains_key(&topic) {
            return true;
        }
        let sink = Ros2Sink::new(side.policy.destination(topic));
        let subscribed = is_subscribed(&sink, &side.graph);
        let is_stray = side.policy.is_stray(topic, subscribed);
        if is_stray && !self.has_descriptors(side) {
            let (sinks, graph) = (&self.topics, &side.graph);
            let silent = longest_silent(strays(&side.policy, sinks, graph));
            self.let_go(side, silent);
        }
        if is_stray && !self.has_descriptors(side) {
            side.tell_scarce();
            side.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "not enough file descriptors for the value",
                count: 1,
            });
            return false;
        }
        if is_stray && !self.take_place(side) {
            side.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values without an entry in the mapping and without a subscriber",
                count: 1,
            });
            return false;
        }
        self.topics.insert(topic, Box::new(sink));
        true
    }

    /// Returns whether the process has file descriptors for another writer of a value that the
    /// mapping does not name.
    fn has_descriptors(&self, side: &Ros2Side) -> bool {
        let sinks = self.topics.values();
        let pending = sinks.filter(|sink| sink.open.is_none()).count();
        pending < side.descriptors.free().found
    }

    fn take_place(&mut self, side: &mut Ros2Side) -> bool {
        let (sinks, graph) = (&self.topics, &side.graph);
        let strays = |policy: &Policy| strays(policy, sinks, graph);
        let now = now().monotonic;
        let Admission { admitted, gone } = side.policy.admit_stray(now, strays);
        self.let_go(side, gone);
        admitted
    }

    /// Closes the writers of strays that are replaced.
    fn let_go(&mut self, side: &mut Ros2Side, gone: Vec<TopicId>) {
        let mut names = BTreeSet::new();
        for topic in gone {
            if let Some(sink) = self.topics.remove(&topic) {
                // No reader receives their values.
                let unwritten = sink.open.as_ref().and_then(|open| unwritten(topic, open));
                side.events.extend(unwritten);
                names.extend([topic.to_string(), sink.dds_topic]);
            }
            side.events.push_back(PortEvent::Unbound { topic });
        }
        // If the values return, their anomalies are logged again.
        side.policy.told.forget(&names);
    }
}

/// Returns the values that neither the mapping names nor a reader subscribes to, each with the time
/// at which its publisher in the space fell silent.
fn strays(
    policy: &Policy,
    sinks: &HashMap<TopicId, Box<Ros2Sink>>,
    graph: &Graph,
) -> Vec<(Option<StdInstant>, TopicId)> {
    let strays = sinks.iter();
    let strays = strays.filter(|(topic, sink)| {
        let subscribed = is_subscribed(sink, graph);
        policy.is_stray(**topic, subscribed)
    });
    let strays = strays.map(|(topic, sink)| (sink.silent, *topic));
    strays.collect()
}

fn is_subscribed(sink: &Ros2Sink, graph: &Graph) -> bool {
    !graph.readers(&sink.dds_topic).is_empty()
}

/// The reason for counting a reader with another type hash than the written type.
const OTHER_DEFINITION_READ: &str = "subscriber of another definition";
