//! The published topics, with the values of other spaces that are written to them.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::policy::{Admission, NO_SUBSCRIBER, Policy, PortStep, Word};
use bridge_node::{Handover, LocalDelivery, PortEvent, Reason, TopicMetaData, ValueRelation, now};
use mappings::TopicId;
use messages::{ActionCalls, DefinitionError, Selection, TextKind, TypeName};
use tcpros::{Latched, MasterGraph, TopicType};
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info};
use uadp::{BuiltinType, Timestamp};

use super::side::Ros1Side;
use crate::sink::{OpenPublisher, Ros1Sink, TopicOpening};

/// The published topics.
#[derive(Debug, Default)]
pub(super) struct AdvertisedTopics {
    topics: HashMap<TopicId, Ros1Sink>,
    /// When to look at events that wait for subscribers to connect.
    flush_at: Option<Instant>,
    /// The values with such events.
    opening: BTreeSet<TopicId>,
}

impl AdvertisedTopics {
    /// Returns the values with their topics.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&TopicId, &Ros1Sink)> {
        self.topics.iter()
    }

    /// Returns the resolved names of the topics.
    pub(super) fn names(&self, side: &Ros1Side) -> HashSet<String> {
        let sinks = self.topics.values();
        sinks
            .filter_map(|sink| side.node.resolve(&sink.ros_topic).ok())
            .collect()
    }

    /// Publishes the values of another space on the topic of the mapping.
    pub(super) fn take_up(&mut self, side: &mut Ros1Side, topic: TopicId) {
        let sink = Ros1Sink::new(side.policy.destination(topic));
        self.topics.insert(topic, sink);
        self.open(side, topic);
    }

    /// Publishes the values of the new mapping that are not published yet.
    pub(super) fn take_up_written(&mut self, side: &mut Ros1Side) {
        for topic in side.policy.written() {
            if !self.topics.contains_key(&topic) {
                self.take_up(side, topic);
            }
        }
    }

    /// Publishes a value, or queues it while subscribers connect.
    ///
    /// # Errors
    /// The reason for which the value was not published.
    pub(super) fn publish(
        &mut self,
        side: &mut Ros1Side,
        sample: LocalDelivery,
    ) -> Result<(), &'static str> {
        let variable = side.policy.mapping().variable(sample.topic);
        let is_confirmed = variable.is_some_and(|variable| variable.confirmed_within.is_some());
        let Some(Ros1Sink {
            open: Some(open), ..
        }) = self.topics.get_mut(&sample.topic)
        else {
            return Err("no publisher yet");
        };
        let payload = open.stamped(sample.payload, side.node.now());
        let key = sample.instance.map_or(0, latch_key);
        let mut lost = match sample.lasting {
            // Before the topic is latched: late subscribers get no events.
            true => open.end_opening(),
            false => 0,
        };
        open.publisher.set_latching(sample.lasting);
        let latched = match sample.kept {
            ValueRelation::Alone => Latched::Alone(key),
            ValueRelation::Beside => Latched::Beside(key),
            ValueRelation::Again => {
                open.publisher.latch(key, payload);
                return Ok(());
            }
        };
        // Losses of slow subscribers are reported with the next comparison with the graph.
        let event = (payload, latched);
        if sample.lasting || is_confirmed {
            // The router hands a command over again until a subscriber has it.
            lost += open.end_opening();
            let (payload, latched) = event;
            let published = open.publisher.publish_latched(payload, latched);
            open.reached = published.sent_to > 0;
        } else {
            lost += open.publish_once(event, now().monotonic);
            open.reached = lost == 0 && open.opening.is_none();
        }
        let is_waiting = open.opening.as_ref().is_some_and(|of| !of.is_empty());
        if is_waiting {
            self.opening.insert(sample.topic);
            self.flush_at.get_or_insert_with(|| Instant::now() + FLUSH);
        }
        side.lost(sample.topic, UNHEARD, lost.saturating_sub(1));
        match lost {
            0 => Ok(()),
            _ => Err(NO_SUBSCRIBER),
        }
    }

    /// Returns whether a subscriber has received the last value of a topic.
    pub(super) fn handover(&self, topic: TopicId) -> Handover {
        let sink = self.topics.get(&topic).and_then(|sink| sink.open.as_ref());
        match sink {
            Some(open) if open.reached => Handover::Done,
            Some(_) | None => Handover::Nobody,
        }
    }

    /// Handles the request for a type of a value, with the builtin types of its fields and the
    /// announced description.
    pub(super) fn wanted(
        &mut self,
        side: &mut Ros1Side,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&TopicMetaData>,
    ) {
        if !self.take_in(side, topic) {
            return;
        }
        let standard = match shape {
            [(builtin, array)] => side
                .definitions
                .known
                .registry()
                .standard_type(*builtin, *array),
            _ => None,
        };
        let word = Word {
            described: described.cloned(),
            learned: described.and_then(|described| learned(side, topic, described)),
            standard,
        };
        let Some(sink) = self.topics.get_mut(&topic) else {
            return;
        };
        let open = sink.open.as_ref();
        let written = open.map(|open| (open.message_type.name(), open.publisher.subscribers() > 0));
        match sink.choice.hear(word, written) {
            PortStep::Stay => {}
            PortStep::Open => self.open(side, topic),
            PortStep::Select(selection) => {
                let Some(open) = &mut sink.open else { return };
                open.stamps = sink.choice.stamps(&open.message_type);
                side.events.push_back(PortEvent::Bound {
                    topic,
                    message_type: Arc::clone(&open.message_type),
                    selection,
                });
            }
        }
    }

    /// Records that the writer of a value has ended or has returned.
    pub(super) fn silent(&mut self, topic: TopicId, silent: bool) {
        debug!(%topic, silent, "the writer in the space");
        if let Some(sink) = self.topics.get_mut(&topic) {
            // Subscribers keep the value, and new subscribers do not receive it.
            if let Some(open) = sink.open.as_ref().filter(|_| silent) {
                open.publisher.forget_all_latched();
            }
            sink.silent = silent.then(|| now().monotonic);
        }
    }

    /// Removes a latched value.
    pub(super) fn retired(&self, topic: TopicId, instance: Timestamp) {
        if let Some(Ros1Sink {
            open: Some(open), ..
        }) = self.topics.get(&topic)
        {
            open.publisher.forget_latched(latch_key(instance));
        }
    }

    /// Drops the waiting events and the latched values, because another bridge publishes.
    pub(super) fn drop_waiting(&mut self, side: &mut Ros1Side) {
        self.drop_opening(side);
        for open in self.topics.values().filter_map(|sink| sink.open.as_ref()) {
            open.publisher.forget_all_latched();
        }
    }

    /// Returns at the time of the next [`flush`](Self::flush), or never.
    pub(super) async fn wait(&self) {
        match self.flush_at {
            Some(at) => sleep_until(at).await,
            None => std::future::pending().await,
        }
    }

    /// Reports losses of slow subscribers, and opens topics in a better type.
    pub(super) fn reconcile(&mut self, side: &mut Ros1Side) {
        let topics: Vec<TopicId> = self.topics.keys().copied().collect();
        for topic in topics {
            self.reconcile_topic(side, topic);
        }
    }

    /// Publishes events that need not wait for subscribers any longer.
    pub(super) fn flush(&mut self, side: &mut Ros1Side) {
        let now = now().monotonic;
        let mut unheard = Vec::new();
        let sinks = &mut self.topics;
        self.opening.retain(|topic| {
            let sink = sinks.get_mut(topic);
            let Some(open) = sink.and_then(|sink| sink.open.as_mut()) else {
                return false;
            };
            unheard.push((*topic, open.look_at_opening(now)));
            open.opening.as_ref().is_some_and(|of| !of.is_empty())
        });
        for (topic, count) in unheard {
            side.lost(topic, UNHEARD, count);
        }
        self.flush_at = (!self.opening.is_empty()).then(|| Instant::now() + FLUSH);
    }

    /// Drops events that wait for subscribers, because another bridge publishes.
    fn drop_opening(&mut self, side: &mut Ros1Side) {
        for (topic, sink) in &mut self.topics {
            let opening = sink.open.as_mut().and_then(|open| open.opening.as_mut());
            let count = opening.map_or(0, |opening| opening.drop_waiting());
            side.lost(*topic, (Reason::Takeover, "waited for a subscriber"), count);
        }
        self.flush_at = None;
        self.opening.clear();
    }

    fn reconcile_topic(&mut self, side: &mut Ros1Side, topic: TopicId) {
        let Some(sink) = self.topics.get_mut(&topic) else {
            return;
        };
        if let Some(open) = &mut sink.open {
            let count = open.publisher.dropped().saturating_sub(open.reported);
            if count > 0 {
                open.reported += count;
                let why = "subscriber too slow or late";
                side.lost(topic, (Reason::Overflow, why), count);
            }
            let count = open
                .publisher
                .cut_off()
                .saturating_sub(open.reported_cut_off);
            if count > 0 {
                open.reported_cut_off += count;
                let why = "the link to the subscriber is down";
                side.lost(topic, (Reason::NotPublished, why), count);
            }
        }
        if !sink.serves() {
            self.open(side, topic);
        }
    }

    /// Opens a sink with the best available type. A sink that is open with another type is
    /// reopened.
    fn open(&mut self, side: &mut Ros1Side, topic: TopicId) {
        let Some(sink) = self.topics.get(&topic) else {
            return;
        };
        let ros_topic = sink.ros_topic.clone();
        // Once the topic is published by this node, the master returns the type of this node.
        let subscribed = sink.open.is_none() && side.graph.subscribers.contains_key(&ros_topic);
        let asked_for = side.graph.types.get(&ros_topic).filter(|_| subscribed);
        let mut found = None;
        for name in sink.candidates(asked_for.map(String::as_str)) {
            match side.definitions.get(&name) {
                Ok(message_type) => {
                    found = Some(message_type);
                    break;
                }
                Err(error) => tell_unknown(
                    side,
                    &ros_topic,
                    "the requested type cannot hold the value",
                    &error,
                ),
            }
        }
        let Some(message_type) = found else { return };
        let Some(sink) = self.topics.get_mut(&topic) else {
            return;
        };
        let open_as = sink.open.as_ref().map(|open| open.message_type.name());
        if open_as == Some(message_type.name()) {
            return;
        }
        // The node publishes a topic with a single type.
        sink.open = None;
        let topic_type = TopicType {
            name: message_type.name().to_string(),
            md5sum: message_type.md5().to_owned(),
            definition: message_type.definition().to_owned(),
        };
        match side.node.advertise(&ros_topic, topic_type, sink.options()) {
            Ok(publisher) => {
                info!(
                    topic = publisher.topic(),
                    message_type = %message_type.name(),
                    definition = side.definitions.known.source(message_type.name()),
                    "advertised"
                );
                let open = OpenPublisher {
                    message_type: Arc::clone(&message_type),
                    publisher,
                    reported: 0,
                    reported_cut_off: 0,
                    reached: false,
                    stamps: sink.choice.stamps(&message_type),
                    opening: TopicOpening::of(
                        side.graph.subscribers.get(&ros_topic),
                        side.node.name(),
                        now().monotonic,
                    ),
                };
                sink.open = Some(open);
                let selection = sink.choice.selection(message_type.name());
                side.events.push_back(PortEvent::Bound {
                    topic,
                    message_type,
                    selection,
                });
            }
            Err(error) => {
                side.policy
                    .told
                    .once(&ros_topic, "not published", || error.to_string());
            }
        }
    }

    /// Ensures that the value has a topic. Returns false if the value is unknown here and the limit
    /// is reached.
    fn take_in(&mut self, side: &mut Ros1Side, topic: TopicId) -> bool {
        if self.topics.contains_key(&topic) {
            return true;
        }
        let sink = Ros1Sink::new(side.policy.destination(topic));
        if side
            .policy
            .is_stray(topic, is_subscribed(&sink, &side.graph))
            && !self.take_place(side)
        {
            side.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values without an entry in the mapping and without a subscriber",
                count: 1,
            });
            return false;
        }
        self.topics.insert(topic, sink);
        true
    }

    fn take_place(&mut self, side: &mut Ros1Side) -> bool {
        let (sinks, graph) = (&self.topics, &side.graph);
        let strays = |policy: &Policy| {
            let strays = sinks
                .iter()
                .filter(|(topic, sink)| policy.is_stray(**topic, is_subscribed(sink, graph)));
            let strays = strays.map(|(topic, sink)| (sink.silent, *topic));
            strays.collect::<Vec<_>>()
        };
        let now = now().monotonic;
        let Admission { admitted, gone } = side.policy.admit_stray(now, strays);
        let mut names = BTreeSet::new();
        for topic in gone {
            if let Some(sink) = self.topics.remove(&topic) {
                names.extend([topic.to_string(), sink.ros_topic]);
            }
            side.events.push_back(PortEvent::Unbound { topic });
        }
        // If these values return, their problems are logged again.
        side.policy.told.forget(&names);
        admitted
    }

    /// Removes the topics that the new mapping does not write.
    pub(super) fn give_up(&mut self, side: &mut Ros1Side) {
        let (policy, definitions) = (&side.policy, &mut side.definitions);
        let gone = self.topics.extract_if(|topic, sink| {
            // The definition may have changed when the files were read again.
            let outdated = sink.open.as_ref().is_some_and(|open| {
                let now = definitions.get(open.message_type.name());
                now.is_ok_and(|now| now.md5() != open.message_type.md5())
            });
            policy.is_for_service(*topic)
                || outdated
                || !sink.is_like(&Ros1Sink::new(policy.destination(*topic)))
        });
        // The publishers end here, so their topics can be advertised with another type.
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        side.events.extend(gone);
    }
}

/// Returns the local type that a writer announces for its value, if the type is known and has
/// the announced fields.
fn learned(
    side: &mut Ros1Side,
    topic: TopicId,
    described: &TopicMetaData,
) -> Option<(TypeName, Selection)> {
    if ActionCalls::is_value(&described.message_type) {
        // Values of actions are handled by the action server.
        return None;
    }
    match side.definitions.get(&described.message_type) {
        Ok(message_type) => side.policy.learned(topic, described, &message_type),
        Err(error) => {
            let said = "the type that the writer announces cannot be used";
            tell_unknown(side, &topic.to_string(), said, &error);
            None
        }
    }
}

/// Logs once per topic that a type is unknown.
fn tell_unknown(side: &mut Ros1Side, topic: &str, what: &str, error: &DefinitionError) {
    let definitions = &mut side.definitions;
    side.policy.told.once(topic, "unknown type", || {
        let why = definitions.known.explain(TextKind::Message, error);
        format!("{what}: {why}")
    });
}

fn is_subscribed(sink: &Ros1Sink, graph: &MasterGraph) -> bool {
    let open = sink.open.as_ref();
    open.is_some_and(|open| open.publisher.subscribers() > 0)
        || graph.subscribers.contains_key(&sink.ros_topic)
}

/// Returns the key of a latched value: the time at which the value was taken, which also orders the
/// values.
fn latch_key(instance: Timestamp) -> u64 {
    u64::try_from(instance.unix_nanos()).unwrap_or_default()
}

/// The reason for events without a subscriber.
const UNHEARD: (Reason, &str) = (Reason::NoSubscriber, NO_SUBSCRIBER);
/// How often events look for the subscribers that they wait for.
const FLUSH: Duration = Duration::from_millis(10);
