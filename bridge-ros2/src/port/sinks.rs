//! The topics of the domain that this bridge writes, with the values of other spaces.

mod writers;

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::Arc;

use bridge_node::policy::{NO_SUBSCRIBER, PortStep, Word, is_bad};
use bridge_node::{Handover, LocalDelivery, PortEvent, Reason, TopicMetaData, ValueRelation, now};
use mappings::TopicId;
use messages::{ActionCalls, Selection, TypeName};
use ros2_node::clock::Ros2Clock;
use ros2_node::graph::Graph;
use ros2_node::limits;
use ros2_node::outlet::{Former, Outlet, OutletProgress, OutletRefusal};
use ros2_node::raw::Payload;
use rustdds::GUID;
use tokio::time::Instant;
use tracing::debug;
use uadp::BuiltinType;

use super::side::{Ros2Side, lost};
use crate::sink::{OpenWriter, Ros2Sink};

/// The topics that this bridge writes.
pub(super) struct WrittenTopics {
    /// The sinks are boxed because the table reserves room for up to twice the number of entries.
    topics: HashMap<TopicId, Box<Ros2Sink>>,
    /// Writers that were given up while their readers may still miss samples.
    former: VecDeque<Former>,
    /// Remote readers that were logged and counted because their definition of a type differs from
    /// ours.
    misreading: BTreeSet<GUID>,
    clock: Ros2Clock,
}

impl WrittenTopics {
    pub(super) fn new(clock: Ros2Clock) -> Self {
        Self {
            topics: HashMap::new(),
            former: VecDeque::new(),
            misreading: BTreeSet::new(),
            clock,
        }
    }

    /// Returns the values with their topics.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&TopicId, &Ros2Sink)> {
        self.topics.iter().map(|(topic, sink)| (topic, &**sink))
    }

    /// Returns whether values of other spaces are written to the topic.
    pub(super) fn is_written(&self, dds_topic: &str) -> bool {
        self.topics.values().any(|sink| sink.dds_topic == dds_topic)
    }

    /// Adds sinks for the values of other spaces that the mapping binds to topics of this domain.
    pub(super) fn take_up(&mut self, side: &Ros2Side) {
        for topic in side.policy.written() {
            let sink = || Box::new(Ros2Sink::new(side.policy.destination(topic)));
            self.topics.entry(topic).or_insert_with(sink);
        }
    }

    /// Removes the topics that the new mapping does not write.
    pub(super) fn give_up(&mut self, side: &mut Ros2Side) {
        let (policy, definitions) = (&side.policy, &mut side.definitions);
        let gone = self.topics.extract_if(|topic, sink| {
            let outdated = sink.open.as_ref().is_some_and(|open| {
                !definitions.is_current(&open.definition, open.definition.hash)
            });
            policy.is_for_service(*topic)
                || outdated
                || !sink.is_like(&Ros2Sink::new(policy.destination(*topic)))
        });
        // Their writers are disposed here, or once their readers have received all samples.
        let now = Instant::now();
        for (topic, sink) in gone {
            if let Some(open) = sink.open {
                side.events.extend(unwritten(topic, &open));
                self.former.extend(open.outlet.give_up(now));
            }
            side.events.push_back(PortEvent::Unbound { topic });
        }
        let too_many = self.former.len().saturating_sub(MOST_FORMER);
        drop(self.former.drain(..too_many));
    }

    /// Sends waiting samples as the send windows allow.
    pub(super) fn flush(&mut self, side: &mut Ros2Side, now: Instant) {
        for topic in side.schedule.waiting() {
            let sink = self.topics.get_mut(&topic);
            let Some(open) = sink.and_then(|sink| sink.open.as_mut()) else {
                side.schedule.note_waiting(topic, false);
                continue;
            };
            if let Err(refusal) = open.outlet.flush(now) {
                side.events.push_back(lost(topic, cause(refusal), 1));
            }
            side.schedule.note_waiting(topic, open.outlet.is_waiting());
        }
    }

    /// Writes a value, or queues it while its readers are not ready.
    ///
    /// # Errors
    /// The reason for which the value was not written.
    pub(super) fn publish(
        &mut self,
        side: &mut Ros2Side,
        sample: LocalDelivery,
    ) -> Result<(), &'static str> {
        let LocalDelivery {
            topic,
            payload,
            source,
            status,
            kept,
            lasting,
            ..
        } = sample;
        if kept == ValueRelation::Again {
            // A writer of depth 1 has room for the newest value only.
            let sink = self.topics.get(&topic).and_then(|sink| sink.open.as_ref());
            let stores_newer =
                sink.is_none_or(|open| open.outlet.stores_newer_than(source.map(dds_time)));
            if !lasting || stores_newer {
                return Ok(());
            }
        }
        if is_bad(status) {
            return Err("bad status");
        }
        if side.is_at_home(topic.space) {
            // Subscribers of this domain receive from the node that produces the value.
            return Err("served by another bridge of this domain");
        }
        let Some(Ros2Sink {
            open: Some(open),
            dds_topic,
            ..
        }) = self.topics.get_mut(&topic).map(Box::as_mut)
        else {
            return Err("no writer yet");
        };
        let payload = open.stamped(payload, || self.clock.now());
        let payload = Payload::to_write(payload).map_err(|error| error.label())?;
        let size = payload.len();
        let (source, now) = (source.map(dds_time), Instant::now());
        let variable = side.policy.mapping().variable(topic);
        let confirmed = variable.and_then(|variable| variable.confirmed_within);
        let offered = match (lasting, confirmed) {
            (true, _) => open.outlet.offer(payload, source, now),
            (false, None) => open.outlet.offer_once(payload, source, now),
            (false, Some(within)) => open.outlet.offer_in_time(payload, source, (now, within)),
        };
        side.schedule.note_waiting(topic, open.outlet.is_waiting());
        let offered = match offered {
            // An older sample was lost: the new sample must not be offered again.
            Err(OutletRefusal::Overflow) if confirmed.is_some() => {
                let cause = cause(OutletRefusal::Overflow);
                side.events.push_back(lost(topic, cause, 1));
                Ok(())
            }
            offered => offered,
        };
        if let Err(OutletRefusal::TooLarge(limit)) = offered {
            let dds_topic = dds_topic.clone();
            side.policy.told.once(&dds_topic, "too large", || {
                format!(
                    "a message of {size} bytes is not sent: subscribers of this topic may not be able to \
                     reassemble more than {limit} bytes ({})",
                    limits::RUSTDDS
                )
            });
        }
        offered.map_err(|refusal| cause(refusal).1)
    }

    /// Handles the request for a type of a value, with the builtin types of its fields and the
    /// announced description.
    pub(super) fn wanted(
        &mut self,
        side: &mut Ros2Side,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&TopicMetaData>,
    ) {
        side.schedule.look_next();
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
            learned: described.and_then(|described| self.learned(side, topic, described)),
            standard,
        };
        let Some(sink) = self.topics.get_mut(&topic) else {
            return;
        };
        let open = sink.open.as_ref().map(|open| {
            let subscribed = !side.graph.readers(&sink.dds_topic).is_empty();
            (open.definition.name(), subscribed)
        });
        match sink.choice.hear(word, open) {
            PortStep::Stay => {}
            PortStep::Open => self.open_sink(side, topic, Instant::now()),
            PortStep::Select(selection) => {
                let Some(open) = &mut sink.open else { return };
                let message_type = Arc::clone(&open.definition.message_type);
                open.stamps = sink.choice.stamps(&message_type);
                side.events.push_back(PortEvent::Bound {
                    topic,
                    message_type,
                    selection,
                });
            }
        }
    }

    /// Returns the local type that a publisher of the space names, if the type is known and has the
    /// named fields.
    fn learned(
        &mut self,
        side: &mut Ros2Side,
        topic: TopicId,
        described: &TopicMetaData,
    ) -> Option<(TypeName, Selection)> {
        let name = &described.message_type;
        if ActionCalls::is_value(name) {
            // The action server takes this value.
            return None;
        }
        match side.definitions.get(name) {
            Ok(found) => side.policy.learned(topic, described, &found.message_type),
            Err(error) => {
                let dds_topic = self.topics.get(&topic).map(|sink| sink.dds_topic.as_str());
                let readers = side.graph.readers(dds_topic.unwrap_or_default());
                let dds_type = name.dds();
                // Nodes that serve type descriptions are asked when the sink is opened.
                if !readers
                    .iter()
                    .any(|r| r.type_name == dds_type && r.type_hash.is_some())
                {
                    let said = "the type that the writer announces cannot be used";
                    side.tell_unknown_type(&topic.to_string(), said, &error);
                }
                None
            }
        }
    }

    /// Returns the handover of the newest value of a topic.
    pub(super) fn handover(&self, topic: TopicId) -> Handover {
        let sink = self.topics.get(&topic).and_then(|sink| sink.open.as_ref());
        sink.map_or(Handover::Nobody, |open| handover(open.outlet.progress()))
    }

    /// Records that the writer of a value has ended or has returned.
    pub(super) fn silent(&mut self, side: &mut Ros2Side, topic: TopicId, silent: bool) {
        debug!(%topic, silent, "the writer in the space");
        if let Some(sink) = self.topics.get_mut(&topic) {
            // The value stays with the subscribers that have it and is sent to no further
            // subscriber.
            if let Some(open) = sink.open.as_mut().filter(|_| silent) {
                open.outlet.forget_stored(Instant::now());
                side.schedule.note_waiting(topic, open.outlet.is_waiting());
            }
            sink.silent = silent.then(|| now().monotonic);
        }
    }

    /// Drops the waiting samples, because another bridge publishes. With `at_once` the present
    /// readers do not receive written samples either.
    pub(super) fn drop_waiting(&mut self, side: &mut Ros2Side, at_once: bool) {
        let cause = (Reason::Takeover, "waited in its writer");
        self.drop_samples(side, cause, |outlet, now| outlet.drop_waiting(at_once, now));
    }

    /// Drops the events that readers have not received for a while, because a link is down or was
    /// down. States are delivered when it is up.
    pub(super) fn drop_unreceived(&mut self, side: &mut Ros2Side, is_lost: bool) {
        let cause = (Reason::NotPublished, "the link to the subscriber is down");
        self.drop_samples(side, cause, |outlet, now| {
            outlet.drop_unreceived_events(is_lost, now)
        });
    }

    /// Drops samples of each writer, as `drop_of` does, and reports their number.
    fn drop_samples(
        &mut self,
        side: &mut Ros2Side,
        cause: (Reason, &'static str),
        drop_of: impl Fn(&mut Outlet, Instant) -> u64,
    ) {
        let now = Instant::now();
        for (topic, sink) in &mut self.topics {
            let Some(open) = sink.open.as_mut() else {
                continue;
            };
            let count = drop_of(&mut open.outlet, now);
            side.schedule.note_waiting(*topic, open.outlet.is_waiting());
            if count > 0 {
                side.events.push_back(lost(*topic, cause, count));
            }
        }
    }

    /// Drops replaced writers after their readers have received all samples.
    pub(super) fn drop_former(&mut self, now: Instant) {
        self.former.retain(|former| !former.is_done(now));
    }

    /// Reconciles the writers with the subscribers of the domain.
    pub(super) fn reconcile(&mut self, side: &mut Ros2Side, now: Instant) {
        let topics: Vec<TopicId> = self.topics.keys().copied().collect();
        for topic in topics {
            self.reconcile_sink(side, topic, now);
        }
    }

    /// Forgets the readers that have left.
    pub(super) fn forget_left(&mut self, graph: &Graph) {
        self.misreading.retain(|guid| graph.holds(*guid));
    }

    /// Recreates the writers that RustDDS left out of its announcements. Returns their number.
    pub(super) fn announce_anew(
        &mut self,
        side: &mut Ros2Side,
        lost: &BTreeSet<GUID>,
        now: Instant,
    ) -> usize {
        let is_lost = |sink: &Ros2Sink| {
            let open = sink.open.as_ref();
            open.is_some_and(|open| lost.contains(&open.outlet.guid()))
        };
        let sinks = self.topics.iter().filter(|(_, sink)| is_lost(sink));
        let sinks: Vec<TopicId> = sinks.map(|(topic, _)| *topic).collect();
        let anew = sinks
            .into_iter()
            .filter_map(|topic| self.advertise_anew(side, topic, now));
        anew.count()
    }

    /// Returns the number of clock messages that could not be read.
    pub(super) fn malformed_clocks(&self) -> u64 {
        self.clock.malformed()
    }
}

impl std::fmt::Debug for WrittenTopics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_map().entries(self.iter()).finish()
    }
}

/// Returns the counter and the label under which a refusal is counted.
fn cause(refusal: OutletRefusal) -> (Reason, &'static str) {
    match refusal {
        OutletRefusal::Overflow => (Reason::Overflow, refusal.label()),
        OutletRefusal::NoReader => (Reason::NoSubscriber, NO_SUBSCRIBER),
        OutletRefusal::TooLarge(_) | OutletRefusal::Late | OutletRefusal::Failed => {
            (Reason::NotPublished, refusal.label())
        }
    }
}

/// Returns the handover of a value by the progress of its writer.
const fn handover(progress: OutletProgress) -> Handover {
    match progress {
        OutletProgress::NoReader => Handover::Nobody,
        OutletProgress::Waiting => Handover::Waiting,
        OutletProgress::Written => Handover::Done,
    }
}

/// Returns the loss of the values that still wait in a writer that is given up.
fn unwritten(topic: TopicId, open: &OpenWriter) -> Option<PortEvent> {
    let waiting = open.outlet.waiting();
    (waiting > 0).then(|| {
        lost(
            topic,
            (Reason::Overflow, "the writer of the topic was replaced"),
            waiting,
        )
    })
}

/// Maximum number of former writers that are kept for a while.
const MOST_FORMER: usize = 256;

/// Converts a time to RTPS: seconds since 1970 and fractions of 2^-32 s (RTPS 2.5, 9.3.2.1). Times
/// outside the range are clamped.
fn dds_time(time: uadp::Timestamp) -> rustdds::Timestamp {
    let nanos = u64::try_from(time.unix_nanos().max(0)).unwrap_or(u64::MAX);
    let seconds = (nanos / NANOS).min(u64::from(u32::MAX) - 1);
    let fraction = ((nanos % NANOS) << 32) / NANOS;
    rustdds::Timestamp::from_ticks((seconds << 32) | fraction)
}

const NANOS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_time_keeps_its_nanoseconds() {
        let nanos = 1_700_000_000_123_456_789_i128;
        let ticks = dds_time(uadp::Timestamp::from_unix_nanos(nanos)).to_ticks();
        let back = u128::from(ticks >> 32) * 1_000_000_000
            + ((u128::from(ticks & 0xffff_ffff) * 1_000_000_000) >> 32);
        assert!(nanos.unsigned_abs().abs_diff(back) <= 1, "{back}");
    }
}
