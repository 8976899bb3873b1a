//! The Router: verdicts on samples, queues per topic, repetitions and silences.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Mapping, Overflow, PublisherIdRule, SpaceId, TopicId};
use messages::{MessageType, Plan, PlanError, Selection, Wire};
use uadp::{
    BuiltinType, DataSetHeader, DataSetMessage, DecodeError, Fields, GroupHeader, MessageKind,
    NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId, Timestamp,
};

use crate::counters::{Counters, Reason, Verdict, is_told};
use crate::fields;
use crate::hops::{Hop, Hops};
use crate::loop_rule::{Side, may_cross};
use crate::reader::{Held, Place, Reader};
use crate::topic::{Item, Role, Topic};
use crate::writer::{Encoded, Idle, Writer};

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

/// Who a Router works for.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The space it serves.
    pub own: SpaceId,
    /// What the payloads of its local side are.
    pub local: Local,
    /// The address its own datagrams come from; an unspecified IP matches any. With it, a second bridge of the same
    /// space is noticed.
    pub source: Option<SocketAddr>,
}

/// What a payload of the local side is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Local {
    /// A ROS 1 message body, without its length.
    Ros1,
    /// A CDR with its 4 byte encapsulation header.
    Cdr,
    /// A block of OPC UA fields as [`Fields::bytes`] gives it: an OPC UA server's side.
    Fields,
}

/// The two clocks, read once per turn of the shell.
#[derive(Debug, Clone, Copy)]
pub struct Now {
    /// For waiting.
    pub monotonic: Instant,
    /// For the stamps on the wire.
    pub utc: Timestamp,
}

/// What the Router wants done.
#[derive(Debug)]
#[non_exhaustive]
pub enum Output {
    /// A NetworkMessage to send. Give the buffer back with [`Router::recycle`].
    Datagram {
        /// The topic it carries.
        topic: TopicId,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// A sample of another space to publish.
    Delivery(Delivery),
    /// A value of another space came whose local type is not known: find one and [`bind`](Router::bind) it.
    Unbound {
        /// Which value.
        topic: TopicId,
        /// Builtin type, and whether it is an array, of each of its fields. Null counts as a scalar
        /// [`BuiltinType::Variant`].
        shape: Vec<(BuiltinType, bool)>,
    },
    /// The writer of a topic of another space fell silent, or speaks again.
    Silent {
        /// Which value.
        topic: TopicId,
        /// Whether it is silent now.
        silent: bool,
    },
    /// Something to log.
    Notice(Notice),
}

/// One value of another space on its way to the local side.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery {
    /// Which value.
    pub topic: TopicId,
    /// Its bytes in the local encoding.
    pub payload: Vec<u8>,
    /// The DataSetMessage Timestamp: when the producer's bridge took the sample.
    pub source: Option<Timestamp>,
    /// The DataSetMessage Status: the upper 16 bits of an OPC UA StatusCode, 0 is Good.
    pub status: u16,
    /// When its datagram arrived here.
    pub arrived: Timestamp,
}

/// A drop worth a line in the log. A repeated one is told at its 1st, 10th, 100th ... occurrence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notice {
    /// The topic, if it is about one.
    pub topic: Option<TopicId>,
    /// Who sent it, if it came as a datagram.
    pub from: Option<SocketAddr>,
    /// Why.
    pub reason: Reason,
    /// How often it happened by now.
    pub total: u64,
    /// What exactly, in words.
    pub detail: String,
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
        let Some(entry) = self.entry(topic, None, now) else { return Ok(()) };
        entry.plan = Some(plan);
        let held = match &mut entry.role {
            Role::Theirs(reader) => {
                reader.forget_delivered();
                reader.held.take()
            }
            Role::Ours(_) => None,
        };
        if let Some(held) = held {
            // Counted and told like any other when the type does not fit.
            let _verdict = self.deliver(topic, &held);
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
            return self.drop_one(Some(topic), None, Reason::Looped, String::new);
        }
        let mut encoded = Encoded { bytes: self.buffer(), ..Encoded::default() };
        let local = self.settings.local;
        let Some(Topic { role: Role::Ours(writer), plan, overflow, .. }) =
            self.entry(topic, None, now)
        else {
            return self.drop_one(Some(topic), None, Reason::TooManyTopics, String::new);
        };
        let sample = match (local, plan) {
            (Local::Fields, _) => fields::Payload::Block(payload),
            (Local::Ros1 | Local::Cdr, Some(plan)) => fields::Payload::Ros(plan, payload),
            (Local::Ros1 | Local::Cdr, None) => {
                return self.drop_one(Some(topic), None, Reason::Untyped, || {
                    "its message type is not known yet".to_owned()
                });
            }
        };
        let header = data_set_header(writer.expected_sequence(), received);
        match encode(&mut encoded, topic, &header, now.utc, &sample) {
            Ok(()) => {}
            Err((reason, detail)) => {
                self.recycle(encoded.bytes);
                return self.drop_one(Some(topic), None, reason, || detail);
            }
        }
        // The number is used up only by a message that goes out.
        writer.next_sequence();
        let keep = *overflow == Overflow::KeepLatest;
        writer.sent(&encoded, keep, now.monotonic);
        self.hops.record(Hop::Out, received, now.utc);
        self.schedule(topic);
        self.push(topic, Item::Datagram(encoded))
    }

    /// Whether a topic of our own space has a producer. Without one its value is no longer repeated, so that
    /// readers see it fall silent; the next sample revives it.
    pub fn set_live(&mut self, topic: TopicId, live: bool, now: Now) {
        if let Some(Topic { role: Role::Ours(writer), .. }) = self.entry(topic, None, now) {
            writer.set_live(live);
            self.schedule(topic);
        }
    }

    /// A datagram came from the UA side. What its messages hold is queued; what is wrong with it is counted.
    pub fn handle_datagram(&mut self, datagram: &[u8], from: SocketAddr, now: Now) {
        let message = match NetworkMessage::decode(datagram) {
            Ok(message) => message,
            Err(error) => {
                self.drop_undecoded(None, from, &error);
                return;
            }
        };
        let header = message.header();
        let (Some(space), Some(namespace)) = (
            self.space_of(header, from),
            header.group.and_then(|group| group.writer_group_id),
        ) else {
            return;
        };
        if !may_cross(self.settings.own, Side::Ua, space) {
            self.drop_own(from);
            return;
        }
        let sent = header.timestamp.map(|time| Timestamp {
            time,
            picoseconds: header.picoseconds.unwrap_or_default(),
        });
        for message in message.messages() {
            match message {
                Ok(message) => {
                    let writer_id = message.writer_id.unwrap_or_default();
                    let id = TopicId::new(u16::from(space.get()), namespace, writer_id);
                    let verdict = match id {
                        Some(topic) => self.handle_message(topic, &message, (from, sent), now),
                        None => self.drop_one(None, Some(from), Reason::NotInSpace, String::new),
                    };
                    // The verdict is counted already, and a datagram has no one answer to give.
                    drop(verdict);
                }
                Err(error) => self.drop_undecoded(None, from, &error),
            }
        }
    }

    /// Repeats values, sends keep-alives and notices silences that are due by `now`.
    pub fn handle_timeout(&mut self, now: Now) {
        while let Some(Reverse((at, topic))) = self.timers.peek().copied() {
            if at > now.monotonic {
                break;
            }
            self.timers.pop();
            let Some(entry) = self.topics.get_mut(&topic) else { continue };
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
            let Some(entry) = self.topics.get_mut(&topic) else { continue };
            let item = entry.queue.pop();
            entry.ready = !entry.queue.is_empty();
            if entry.ready {
                self.ready.push_back(topic);
            }
            match item {
                Some(Item::Datagram(mut datagram)) => {
                    entry.counters.sent += 1;
                    datagram.stamp(now.utc);
                    return Some(Output::Datagram { topic, bytes: datagram.bytes });
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
        if let Some(Topic { role: Role::Theirs(reader), .. }) = self.topics.get_mut(&topic) {
            // It was not delivered after all, so its repetition is welcome.
            reader.forget_delivered();
        }
        drop(self.drop_one(Some(topic), None, reason, || detail.to_owned()));
    }

    /// Samples that were lost before the Router saw them, in a queue of the port or the kernel.
    pub fn lost(&mut self, topic: Option<TopicId>, count: u64, why: &'static str) {
        self.count(topic, None, Reason::Overflow, count, || why.to_owned());
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
        self.topics.iter().map(|(topic, entry)| (*topic, &entry.counters))
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

    /// Gives the space a NetworkMessage comes from, or counts why it is none of ours to read.
    fn space_of(&mut self, header: &NetworkHeader<'_>, from: SocketAddr) -> Option<SpaceId> {
        let (number, exact) = match header.publisher_id {
            Some(PublisherId::UInt16(number)) => (u64::from(number), true),
            Some(PublisherId::Byte(number)) => (u64::from(number), false),
            Some(PublisherId::UInt32(number)) => (u64::from(number), false),
            Some(PublisherId::UInt64(number)) => (number, false),
            Some(PublisherId::String(_)) | None => (u64::MAX, false),
        };
        let Some(space) = u16::try_from(number).ok().and_then(SpaceId::new) else {
            drop(self.drop_one(None, Some(from), Reason::NotInSpace, String::new));
            return None;
        };
        if exact || self.mapping.pubsub().publisher_id == PublisherIdRule::AnyWidth {
            return Some(space);
        }
        drop(self.drop_one(None, Some(from), Reason::PublisherWidth, || {
            format!(
                "PublisherId {number} is not a UInt16; if that writer is meant to be space {space}, \
                 set `publisher_id: any_width`"
            )
        }));
        None
    }

    /// Counts a datagram with our own PublisherId: our own, or that of a rival.
    fn drop_own(&mut self, from: SocketAddr) {
        let own = self.settings.own;
        let ours = self.settings.source.is_none_or(|source| {
            source.port() == from.port()
                && (source.ip().is_unspecified() || source.ip() == from.ip())
        });
        let reason = if ours { Reason::Looped } else { Reason::SpaceTaken };
        drop(self.drop_one(None, Some(from), reason, || {
            format!("another program sends as space {own}: every sample is doubled; end one of them")
        }));
    }

    fn handle_message(
        &mut self,
        topic: TopicId,
        message: &DataSetMessage<'_>,
        (from, sent): (SocketAddr, Option<Timestamp>),
        now: Now,
    ) -> Verdict {
        if !message.header.valid {
            return self.drop_one(Some(topic), Some(from), Reason::Invalid, || {
                "the writer marked its DataSetMessage as invalid".to_owned()
            });
        }
        let Some(Topic { role: Role::Theirs(reader), counters, .. }) =
            self.entry(topic, Some(from), now)
        else {
            return self.drop_one(None, Some(from), Reason::TooManyTopics, || {
                format!("more than {MAX_TOPICS} topics are in the space; {topic} is not followed")
            });
        };
        if reader.heard(now.monotonic) {
            self.told.push_back(Output::Silent { topic, silent: false });
            self.schedule(topic);
            return self.handle_message(topic, message, (from, sent), now);
        }
        match message.kind {
            // It said that the writer lives, and that was all.
            MessageKind::KeepAlive => return Verdict::Drop(Reason::Repeat),
            MessageKind::KeyFrame => {}
            #[expect(unreachable_patterns, reason = "uadp may learn to read further kinds")]
            _ => {
                return self.drop_one(Some(topic), Some(from), Reason::Unsupported, || {
                    "only key frames and keep-alives are read".to_owned()
                });
            }
        }
        let place = place(&message.header, from);
        match reader.admit(place) {
            Ok(missing) => counters.missing += u64::from(missing),
            Err(reason) => return self.drop_one(Some(topic), Some(from), reason, String::new),
        }
        let fields = match message.fields() {
            Ok(fields) => fields,
            Err(error) => {
                self.drop_undecoded(Some(topic), from, &error);
                return Verdict::Drop(reason_of(&error));
            }
        };
        self.record_way(place.stamp, sent, now);
        let sample = Held {
            fields: fields.bytes().to_vec(),
            source: place.stamp,
            status: message.header.status.unwrap_or_default(),
            arrived: now.utc,
        };
        self.route(topic, fields, sample, (place, now))
    }

    /// Hands a sample on, or keeps it until its local type is known.
    fn route(
        &mut self,
        topic: TopicId,
        fields: Fields<'_>,
        sample: Held,
        (place, now): (Place, Now),
    ) -> Verdict {
        let typed = self.settings.local == Local::Fields;
        let Some(Topic { role: Role::Theirs(reader), plan, .. }) = self.topics.get_mut(&topic)
        else {
            return Verdict::Drop(Reason::TooManyTopics);
        };
        if typed || plan.is_some() {
            reader.delivered(place);
            return self.deliver(topic, &sample);
        }
        let ask = reader.asked.is_none_or(|asked| now.monotonic >= asked + ASK_AGAIN);
        if ask {
            reader.asked = Some(now.monotonic);
            let shape = fields.filter_map(Result::ok).map(|field| fields::shape(&field)).collect();
            self.told.push_back(Output::Unbound { topic, shape });
        }
        reader.held = (sample.fields.len() <= MAX_HELD).then_some(sample);
        // Not yet a loss: the newest one waits. It is not told, since the port names topics without a type.
        self.count(Some(topic), None, Reason::Untyped, 1, String::new);
        Verdict::Drop(Reason::Untyped)
    }

    fn deliver(&mut self, topic: TopicId, sample: &Held) -> Verdict {
        let mut payload = self.buffer();
        let result = match self.topics.get(&topic).and_then(|entry| entry.plan.as_ref()) {
            Some(plan) => fields::write(plan, &sample.fields, &mut payload),
            None => {
                payload.extend_from_slice(&sample.fields);
                Ok(())
            }
        };
        if let Err((reason, detail)) = result {
            self.recycle(payload);
            return self.drop_one(Some(topic), None, reason, || detail);
        }
        let Held { source, status, arrived, .. } = *sample;
        self.push(topic, Item::Delivery(Delivery { topic, payload, source, status, arrived }))
    }

    fn record_way(&mut self, taken: Option<Timestamp>, sent: Option<Timestamp>, now: Now) {
        // Stacks that never fill the stamps send zeros.
        let filled = |stamp: &Timestamp| stamp.time.0 != 0;
        let Some(sent) = sent.filter(filled) else { return };
        self.hops.record(Hop::Network, sent, now.utc);
        if let Some(taken) = taken.filter(filled) {
            self.hops.record(Hop::Origin, taken, sent);
        }
    }

    fn handle_due(&mut self, topic: TopicId, now: Now) {
        let (key_frames, keep_alives, silence) = self.periods();
        let buffer = self.buffer();
        let Some(entry) = self.topics.get_mut(&topic) else { return };
        match &mut entry.role {
            Role::Theirs(reader) => {
                if reader.fell_silent(now.monotonic, silence) {
                    self.told.push_back(Output::Silent { topic, silent: true });
                }
            }
            Role::Ours(writer) => {
                let Some((at, idle)) = writer.due(key_frames, keep_alives) else { return };
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
                    drop(self.push(topic, Item::Datagram(datagram)));
                }
            }
        }
    }

    /// Puts the topic on the timer list at the time it wants to be looked at.
    fn schedule(&mut self, topic: TopicId) {
        let (key_frames, keep_alives, silence) = self.periods();
        let Some(entry) = self.topics.get_mut(&topic) else { return };
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
        (pubsub.key_frame_period, pubsub.keep_alive_period, pubsub.receive_timeout)
    }

    /// The topic's entry, made when it is new and there is room.
    fn entry(&mut self, topic: TopicId, from: Option<SocketAddr>, now: Now) -> Option<&mut Topic> {
        if !self.topics.contains_key(&topic) {
            if self.topics.len() >= MAX_TOPICS {
                return None;
            }
            let overflow =
                self.mapping.variable(topic).map_or(Overflow::KeepLatest, |found| found.overflow);
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

    fn push(&mut self, topic: TopicId, item: Item) -> Verdict {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return Verdict::Drop(Reason::TooManyTopics);
        };
        let dropped = entry.queue.push(item);
        if !entry.ready {
            entry.ready = true;
            self.ready.push_back(topic);
        }
        match dropped {
            Some(Item::Datagram(Encoded { bytes, .. }) | Item::Delivery(Delivery { payload: bytes, .. })) => {
                self.recycle(bytes);
                self.count(Some(topic), None, Reason::Overflow, 1, || {
                    "the queue was full, its oldest sample was dropped".to_owned()
                });
                Verdict::ForwardAfterDroppingOldest
            }
            None => Verdict::Forward,
        }
    }

    fn drop_undecoded(&mut self, topic: Option<TopicId>, from: SocketAddr, error: &DecodeError) {
        drop(self.drop_one(topic, Some(from), reason_of(error), || error.to_string()));
    }

    fn drop_one(
        &mut self,
        topic: Option<TopicId>,
        from: Option<SocketAddr>,
        reason: Reason,
        detail: impl FnOnce() -> String,
    ) -> Verdict {
        self.count(topic, from, reason, 1, detail);
        Verdict::Drop(reason)
    }

    /// Counts drops, and tells of them at their 1st, 10th, 100th ... occurrence.
    fn count(
        &mut self,
        topic: Option<TopicId>,
        from: Option<SocketAddr>,
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
                self.told.push_back(Output::Notice(Notice { topic, from, reason, total, detail }));
            }
        }
    }

    fn buffer(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }
}

/// Writes the one NetworkMessage of a sample. The stamp of sending is patched in when it is polled.
fn encode(
    encoded: &mut Encoded,
    topic: TopicId,
    header: &DataSetHeader,
    utc: Timestamp,
    sample: &fields::Payload<'_>,
) -> Result<(), (Reason, String)> {
    let too_big = |error: uadp::EncodeError| (Reason::TooBig, error.to_string());
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(&mut encoded.bytes, &network, Some(&[identifier]))
        .map_err(too_big)?;
    let timestamp_at = message.timestamp_offset();
    let mut frame = message.key_frame(header).map_err(too_big)?;
    let sequence_at = frame.sequence_offset();
    fields::read(sample, namespace, &mut frame)?;
    frame.finish().map_err(too_big)?;
    message.finish().map_err(too_big)?;
    encoded.timestamp_at = timestamp_at.unwrap_or(usize::MAX);
    encoded.sequence_at = sequence_at.unwrap_or(usize::MAX);
    if encoded.bytes.len() > MAX_DATAGRAM {
        let detail = format!(
            "{} bytes are more than one UDP datagram carries ({MAX_DATAGRAM})",
            encoded.bytes.len()
        );
        return Err((Reason::TooBig, detail));
    }
    Ok(())
}

fn keep_alive(
    mut bytes: Vec<u8>,
    topic: TopicId,
    expected_sequence: u16,
    utc: Timestamp,
) -> Option<Encoded> {
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message =
        NetworkMessageEncoder::new(&mut bytes, &network, Some(&[identifier])).ok()?;
    let timestamp_at = message.timestamp_offset().unwrap_or(usize::MAX);
    let header =
        DataSetHeader { sequence_number: Some(expected_sequence), ..DataSetHeader::default() };
    message.keep_alive(&header).ok()?;
    message.finish().ok()?;
    Some(Encoded { bytes, timestamp_at, sequence_at: usize::MAX })
}

fn network_header(space: u16, namespace: u16, utc: Timestamp) -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader { writer_group_id: Some(namespace), ..GroupHeader::default() }),
        timestamp: Some(utc.time),
        picoseconds: Some(utc.picoseconds),
        ..NetworkHeader::default()
    }
}

fn data_set_header(sequence: u16, taken: Timestamp) -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(taken.time),
        picoseconds: Some(taken.picoseconds),
        status: Some(0),
        ..DataSetHeader::default()
    }
}

fn place(header: &DataSetHeader, from: SocketAddr) -> Place {
    Place {
        sequence: header.sequence_number,
        stamp: header.timestamp.map(|time| Timestamp {
            time,
            picoseconds: header.picoseconds.unwrap_or_default(),
        }),
        fine: header.picoseconds.is_some(),
        from,
    }
}

const fn reason_of(error: &DecodeError) -> Reason {
    match error {
        DecodeError::Unsupported(_) => Reason::Unsupported,
        _ => Reason::Malformed,
    }
}

/// Topics followed at a time. Triples are free to invent for whoever sends to the group; memory is not.
const MAX_TOPICS: usize = 16_384;
/// A sample that waits for its type is kept up to this size.
const MAX_HELD: usize = 65_536;
/// How long the port is left alone with a topic it found no type for.
const ASK_AGAIN: Duration = Duration::from_secs(1);
/// The largest UDP payload over IPv4.
const MAX_DATAGRAM: usize = 65_507;
/// Buffers kept for reuse, and how large each may have grown.
const SPARE_BUFFERS: usize = 64;
const SPARE_CAPACITY: usize = 128 * 1024;
/// How far a sudden jump of a counter is searched for a decade to be told at.
const MAX_TOLD_STEPS: usize = 1_000;
