//! The Router: verdicts on samples, queues per topic, repetitions and silences.

mod receive;

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Mapping, Overflow, TopicId};
use messages::{MessageType, Plan, PlanError, Selection, Wire};
use uadp::{Fields, Timestamp};

use crate::counters::{Counters, Reason, Verdict, is_told};
use crate::fields;
use crate::hops::{Hop, Hops};
use crate::loop_rule::{Side, may_cross};
use crate::network::{data_set_header, encode, keep_alive};
use crate::output::{Delivery, Notice, Output};
use crate::reader::{Held, Reader};
use crate::settings::{Local, Now, Settings};
use crate::topic::{Item, Role, Topic};
use crate::writer::{Encoded, Idle, Writer};
use receive::Sample;

/// Decides what crosses between one space and UADP. See the crate's page for how it is driven.
#[derive(Debug)]
pub struct Router {
    settings: Settings,
    mapping: Arc<Mapping>,
    topics: HashMap<TopicId, Topic>,
    /// Topics with something in their queue, served in turn: a camera cannot starve a button.
    ready: VecDeque<TopicId>,
    /// What is told besides samples. Bounded by the topics and by [`is_told`].
    told: VecDeque<Output>,
    timers: BinaryHeap<Reverse<(Instant, TopicId)>>,
    /// Buffers given back by [`recycle`](Self::recycle).
    spare: Vec<Vec<u8>>,
    /// Datagrams and messages that belong to no topic.
    others: Counters,
    hops: Hops,
}

impl Router {
    /// A Router for one space. `mapping` says how each topic queues and how often values are repeated.
    #[must_use]
    pub fn new(settings: Settings, mapping: Arc<Mapping>) -> Self {
        Self {
            settings,
            mapping,
            topics: HashMap::new(),
            ready: VecDeque::new(),
            told: VecDeque::new(),
            timers: BinaryHeap::new(),
            spare: Vec::new(),
            others: Counters::default(),
            hops: Hops::new(),
        }
    }

    /// Ties a topic to its local message type, compiled once. A topic bound anew starts afresh with the new type; a
    /// sample that was waiting for a type goes out.
    ///
    /// # Errors
    /// [`PlanError`] when the selection is not in the type; the topic stays as it was.
    pub fn bind(
        &mut self,
        topic: TopicId,
        message_type: &Arc<MessageType>,
        selection: &Selection,
        now: Now,
    ) -> Result<(), PlanError> {
        let wire = match self.settings.local {
            Local::Ros1 => Wire::Ros1,
            Local::Cdr => Wire::Cdr,
            // A side that speaks in fields needs no plan.
            Local::Fields => return Ok(()),
        };
        let plan = Plan::compile(message_type, selection, wire)?;
        let Some(entry) = self.entry(topic, None, now) else {
            return Ok(());
        };
        entry.plan = Some(plan);
        let held = match &mut entry.role {
            Role::Theirs(reader) => {
                reader.forget_delivered();
                reader.held.take()
            }
            Role::Ours(_) => None,
        };
        if let Some(held) = held
            && let Ok(fields) = Fields::parse(&held.fields)
        {
            let Held {
                source,
                status,
                arrived,
                ..
            } = held;
            let sample = Sample {
                fields,
                source,
                status,
                arrived,
            };
            self.deliver(topic, &sample);
        }
        Ok(())
    }

    /// A sample was heard on the local side. `received` is when it came.
    pub fn handle_local(
        &mut self,
        topic: TopicId,
        payload: &[u8],
        received: Timestamp,
        now: Now,
    ) -> Verdict {
        if !may_cross(self.settings.own, Side::Local, topic.space) {
            return self.refuse(topic, Reason::Looped, String::new());
        }
        let mut encoded = Encoded {
            bytes: self.buffer(),
            ..Encoded::default()
        };
        let local = self.settings.local;
        let Some(Topic {
            role: Role::Ours(writer),
            plan,
            overflow,
            ..
        }) = self.entry(topic, None, now)
        else {
            let detail = format!("more than {MAX_TOPICS} topics are in the space");
            return self.refuse(topic, Reason::TooManyTopics, detail);
        };
        let sample = match (local, plan) {
            (Local::Fields, _) => fields::Payload::Block(payload),
            (Local::Ros1 | Local::Cdr, Some(plan)) => fields::Payload::Ros(plan, payload),
            (Local::Ros1 | Local::Cdr, None) => {
                let detail = "its message type is not known yet".to_owned();
                return self.refuse(topic, Reason::Untyped, detail);
            }
        };
        let stamp = writer.stamp(received);
        let header = data_set_header(writer.expected_sequence(), stamp);
        match encode(&mut encoded, topic, &header, now.utc, &sample) {
            Ok(()) => {}
            Err((reason, detail)) => {
                self.recycle(encoded.bytes);
                return self.refuse(topic, reason, detail);
            }
        }
        // The number is used up only by a message that goes out.
        writer.next_sequence();
        let keep = *overflow == Overflow::KeepLatest;
        writer.sent(&encoded, keep, now.monotonic);
        self.hops.record(Hop::Out, received, now.utc);
        self.schedule(topic);
        if self.push(topic, Item::Datagram(encoded)) {
            Verdict::ForwardAfterDroppingOldest
        } else {
            Verdict::Forward
        }
    }

    /// Whether a topic of our own space has a producer. Without one its value is no longer repeated, so that
    /// readers see it fall silent; the next sample revives it.
    pub fn set_live(&mut self, topic: TopicId, live: bool, now: Now) {
        if let Some(Topic {
            role: Role::Ours(writer),
            ..
        }) = self.entry(topic, None, now)
        {
            writer.set_live(live);
            self.schedule(topic);
        }
    }

    /// Repeats values, sends keep-alives and notices silences that are due by `now`.
    pub fn handle_timeout(&mut self, now: Now) {
        while let Some(Reverse((at, topic))) = self.timers.peek().copied() {
            if at > now.monotonic {
                break;
            }
            self.timers.pop();
            let Some(entry) = self.topics.get_mut(&topic) else {
                continue;
            };
            if entry.timer != Some(at) {
                // An entry that a later one replaced.
                continue;
            }
            entry.timer = None;
            self.handle_due(topic, now);
            self.schedule(topic);
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) is wanted next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.timers.peek().map(|Reverse((at, _))| *at)
    }

    /// The next thing to do, topic by topic in turn. `None`: nothing until the next `handle_*`.
    pub fn poll_output(&mut self, now: Now) -> Option<Output> {
        if let Some(told) = self.told.pop_front() {
            return Some(told);
        }
        while let Some(topic) = self.ready.pop_front() {
            let Some(entry) = self.topics.get_mut(&topic) else {
                continue;
            };
            let item = entry.queue.pop();
            entry.ready = !entry.queue.is_empty();
            if entry.ready {
                self.ready.push_back(topic);
            }
            match item {
                Some(Item::Datagram(mut datagram)) => {
                    entry.counters.sent += 1;
                    datagram.stamp(now.utc);
                    return Some(Output::Datagram {
                        topic,
                        bytes: datagram.bytes,
                    });
                }
                Some(Item::Delivery(delivery)) => {
                    entry.counters.delivered += 1;
                    return Some(Output::Delivery(delivery));
                }
                None => {}
            }
        }
        None
    }

    /// The local side took a delivery: its time in this program ends at `now`.
    pub fn published(&mut self, arrived: Timestamp, now: Now) {
        self.hops.record(Hop::In, arrived, now.utc);
    }

    /// An output could not be carried out: counts it under `reason`, with what was said.
    pub fn failed(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        if let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get_mut(&topic)
        {
            // It was not delivered after all, so its repetition is welcome.
            reader.forget_delivered();
        }
        self.count(About::topic(topic), reason, 1, || detail.to_owned());
    }

    /// Samples that were lost before the Router saw them, in a queue of the port or the kernel.
    pub fn lost(&mut self, topic: Option<TopicId>, count: u64, why: &'static str) {
        self.count(About { topic, from: None }, Reason::Overflow, count, || {
            why.to_owned()
        });
    }

    /// Takes back the buffer of a datagram or payload that has been used, so that the next one needs no allocation.
    pub fn recycle(&mut self, mut buffer: Vec<u8>) {
        if self.spare.len() < SPARE_BUFFERS && buffer.capacity() <= SPARE_CAPACITY {
            buffer.clear();
            self.spare.push(buffer);
        }
    }

    /// The counters of each topic, in no order.
    pub fn topics(&self) -> impl Iterator<Item = (TopicId, &Counters)> {
        self.topics
            .iter()
            .map(|(topic, entry)| (*topic, &entry.counters))
    }

    /// The counters of datagrams and messages that belong to no topic.
    #[must_use]
    pub const fn others(&self) -> &Counters {
        &self.others
    }

    /// The delays seen so far.
    #[must_use]
    pub const fn hops(&self) -> &Hops {
        &self.hops
    }

    fn handle_due(&mut self, topic: TopicId, now: Now) {
        let (key_frames, keep_alives, silence) = self.periods();
        let buffer = self.buffer();
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        match &mut entry.role {
            Role::Theirs(reader) => {
                if reader.fell_silent(now.monotonic, silence) {
                    self.told.push_back(Output::Silent {
                        topic,
                        silent: true,
                    });
                }
            }
            Role::Ours(writer) => {
                let Some((at, idle)) = writer.due(key_frames, keep_alives) else {
                    return;
                };
                if at > now.monotonic {
                    return;
                }
                let datagram = match idle {
                    Idle::Repeat => {
                        entry.counters.repeated += 1;
                        writer.repeat(now.monotonic, buffer)
                    }
                    Idle::KeepAlive => {
                        entry.counters.keep_alives += 1;
                        writer.sent_keep_alive(now.monotonic);
                        keep_alive(buffer, topic, writer.expected_sequence(), now.utc)
                    }
                };
                // A fresh sample that waits in the queue says more than a repetition of the one before.
                if let (Some(datagram), true) = (datagram, entry.queue.is_empty()) {
                    self.push(topic, Item::Datagram(datagram));
                }
            }
        }
    }

    /// Puts the topic on the timer list at the time it wants to be looked at.
    fn schedule(&mut self, topic: TopicId) {
        let (key_frames, keep_alives, silence) = self.periods();
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        let due = match &entry.role {
            Role::Ours(writer) => writer.due(key_frames, keep_alives).map(|(at, _)| at),
            Role::Theirs(reader) => reader.due(silence),
        };
        // An earlier entry stays: it finds nothing due and asks again, which spares the list an entry per sample.
        if let Some(due) = due
            && entry.timer.is_none_or(|at| due < at)
        {
            entry.timer = Some(due);
            self.timers.push(Reverse((due, topic)));
        }
    }

    fn periods(&self) -> (Duration, Duration, Duration) {
        let pubsub = self.mapping.pubsub();
        (
            pubsub.key_frame_period,
            pubsub.keep_alive_period,
            pubsub.receive_timeout,
        )
    }

    /// The topic's entry, made when it is new and there is room.
    fn entry(&mut self, topic: TopicId, from: Option<SocketAddr>, now: Now) -> Option<&mut Topic> {
        if !self.topics.contains_key(&topic) {
            if self.topics.len() >= MAX_TOPICS {
                return None;
            }
            let overflow = self
                .mapping
                .variable(topic)
                .map_or(Overflow::KeepLatest, |found| found.overflow);
            let role = if topic.space == self.settings.own {
                Role::Ours(Writer::new(now.monotonic))
            } else {
                let from = from.unwrap_or_else(|| SocketAddr::from(([0, 0, 0, 0], 0)));
                Role::Theirs(Reader::new(from, now.monotonic))
            };
            self.topics.insert(topic, Topic::new(role, overflow));
            if from.is_some() {
                self.schedule(topic);
            }
        }
        self.topics.get_mut(&topic)
    }

    /// Queues an item, and says whether the oldest one had to go for it.
    fn push(&mut self, topic: TopicId, item: Item) -> bool {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return false;
        };
        let dropped = entry.queue.push(item);
        if !entry.ready {
            entry.ready = true;
            self.ready.push_back(topic);
        }
        let (Some(Item::Datagram(Encoded { bytes, .. }))
        | Some(Item::Delivery(Delivery { payload: bytes, .. }))) = dropped
        else {
            return false;
        };
        self.recycle(bytes);
        self.count(About::topic(topic), Reason::Overflow, 1, || {
            "the queue was full, its oldest sample was dropped".to_owned()
        });
        true
    }

    /// Counts a sample of the local side that does not cross.
    fn refuse(&mut self, topic: TopicId, reason: Reason, detail: String) -> Verdict {
        self.count(About::topic(topic), reason, 1, || detail);
        Verdict::Drop(reason)
    }

    /// Counts drops, and tells of them at their 1st, 10th, 100th ... occurrence.
    fn count(
        &mut self,
        About { topic, from }: About,
        reason: Reason,
        count: u64,
        detail: impl FnOnce() -> String,
    ) {
        let counters = topic
            .and_then(|topic| self.topics.get_mut(&topic))
            .map_or(&mut self.others, |entry| &mut entry.counters);
        let before = counters.dropped(reason);
        let total = counters.add(reason, count);
        let told = !reason.is_routine() && (before + 1..=total).take(MAX_TOLD_STEPS).any(is_told);
        if told {
            let detail = detail();
            if !detail.is_empty() {
                self.told.push_back(Output::Notice(Notice {
                    topic,
                    from,
                    reason,
                    total,
                    detail,
                }));
            }
        }
    }

    fn buffer(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }
}

/// What a drop is about.
#[derive(Clone, Copy)]
struct About {
    topic: Option<TopicId>,
    from: Option<SocketAddr>,
}

impl About {
    const fn topic(topic: TopicId) -> Self {
        Self {
            topic: Some(topic),
            from: None,
        }
    }

    const fn sender(from: SocketAddr) -> Self {
        Self {
            topic: None,
            from: Some(from),
        }
    }
}

/// Topics followed at a time. Triples are free to invent for whoever sends to the group; memory is not.
const MAX_TOPICS: usize = 16_384;
/// Buffers kept for reuse, and how large each may have grown.
const SPARE_BUFFERS: usize = 64;
const SPARE_CAPACITY: usize = 128 * 1024;
/// How far a sudden jump of a counter is searched for a decade to be told at.
const MAX_TOLD_STEPS: usize = 1_000;
