//! The Router: checks samples, queues them per topic, repeats values, and detects silent topics.

mod announce;
mod announcements;
mod batch;
mod by_name;
mod calls;
mod chunks;
mod claims;
mod confirm;
mod content;
mod discovery;
mod follow;
mod guarded;
mod held;
mod inquiries;
mod late;
mod metadata;
mod own;
mod reassembly;
mod receive;
mod redundant;
mod reload;
mod security;
mod send;
mod tap;
mod told;
mod values;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Lasting, Mapping, SpaceId, TopicId};
use messages::{Dialect, MessageType, PlanError, Selection, Wire};
use uadp::Timestamp;

use crate::confirm::Handover;
use crate::counters::{Cause, Counters, Reason, Verdict};
use crate::fields;
use crate::gate::{Passage, Waiting};
use crate::hops::{Hop, Hops};
use crate::loop_rule::{Side, What};
use crate::loss::{Loss, Reaction, Stop, trigger};
use crate::network::{check_size, data_set_header, encode, keep_alive};
use crate::output::{Delivery, Heard, Kept, Output, PublisherKey};
use crate::settings::{Local, Now, Settings};
use crate::topic::{Item, Role, Topic};
use crate::transcoder::Transcoder;
use crate::writer::{Encoded, Idle, MAX_KEPT, Message};
use announcements::Announcements;
pub(crate) use by_name::ByName;
use calls::Calls;
use reassembly::Reassembly;
use redundant::ActiveSender;
pub use redundant::MutedSamples;
use security::Security;
pub use tap::{Crossing, Tapped};
use told::About;
use values::Values;

/// Decides which messages cross between a space and UADP. The crate documentation describes its
/// use.
#[derive(Debug)]
pub struct Router {
    values: Values,
    reassembly: Reassembly,
    announcements: Announcements,
    /// Requested and executed calls; `None` before the first use.
    calls: Option<Box<Calls>>,
    /// Random bytes that distinguish own requests from requests of other programs.
    instance: [u8; 16],
    security: Security,
    /// The redundant bridges of other spaces.
    redundant_senders: BTreeMap<SpaceId, ActiveSender>,
    /// Whether a value was polled before a call last time.
    value_first: bool,
}

impl Router {
    /// Creates a Router for a space. `mapping` defines the queue of each topic and the period of
    /// repetitions.
    #[must_use]
    pub fn new(settings: Settings, mapping: Arc<Mapping>) -> Self {
        let security = Security::new(mapping.security());
        let overhead = security.overhead();
        let own = settings.own;
        Self {
            values: Values::new(settings, mapping, overhead),
            reassembly: Reassembly::default(),
            announcements: Announcements::new(own),
            calls: None,
            instance: [0; 16],
            security,
            redundant_senders: BTreeMap::new(),
            value_first: false,
        }
    }

    /// Binds a topic to its local message type and compiles the plan. Binding again restarts the
    /// topic with the new type. A sample that waited for a type is delivered.
    ///
    /// # Errors
    /// Returns a [`PlanError`] if the selection is not in the type; the topic is then unchanged.
    pub fn bind(
        &mut self,
        topic: TopicId,
        message_type: &Arc<MessageType>,
        selection: &Selection,
        now: Now,
    ) -> Result<(), PlanError> {
        let is_own = self
            .values
            .bind_type(topic, (message_type, selection), now)?;
        if is_own {
            self.describe(topic, Some((message_type, selection)), now);
        }
        self.inquire(now);
        Ok(())
    }

    /// Handles a sample received on the local side.
    pub fn handle_local(&mut self, heard: Heard<'_>, now: Now) -> Verdict {
        self.handle_local_as(heard, GOOD, now)
    }

    /// Handles a sample as [`handle_local`](Self::handle_local) does, with the quality of the
    /// sample: the upper 16 bits of a StatusCode, which are sent as the Status of the
    /// DataSetMessage (OPC 10000-14, 7.2.4.5.4).
    pub fn handle_local_as(&mut self, heard: Heard<'_>, status: u16, now: Now) -> Verdict {
        let topic = heard.topic;
        let verdict = self.values.take_local(heard, status, now);
        self.inquire(now);
        self.values.settle_verdict(topic, verdict);
        verdict
    }

    /// Removes a latched publisher of a topic of the own space. Its last message is not repeated
    /// any more.
    pub fn left(&mut self, topic: TopicId, publisher: PublisherKey, now: Now) {
        let held = self
            .values
            .topics
            .get_mut(&topic)
            .and_then(|entry| entry.gate.as_mut())
            .and_then(|gate| gate.left(publisher, now.monotonic));
        self.values.let_go(topic, held, now);
        if let Some(Topic {
            role: Role::Ours(writer),
            ..
        }) = self.values.topics.get_mut(&topic)
        {
            writer.forget(publisher);
            self.values.schedule(topic);
        }
        self.inquire(now);
    }

    /// Sets whether a topic of the own space has a producer. Without a producer its value is not
    /// repeated, so that readers detect the silence. The next sample sets a producer again.
    pub fn set_live(&mut self, topic: TopicId, live: bool, now: Now) {
        if !live {
            // The waiting sample is the last sample.
            let held = self
                .values
                .topics
                .get_mut(&topic)
                .and_then(|entry| entry.gate.as_mut())
                .and_then(|gate| gate.hurry(now.monotonic));
            self.values.let_go(topic, held, now);
        }
        if let Some(Topic {
            role: Role::Ours(writer),
            ..
        }) = self.values.follow(topic, None, now)
        {
            let revived = live && !writer.is_live();
            writer.set_live(live);
            if revived && let Some(entry) = self.values.topics.get_mut(&topic) {
                entry.announce_at = entry.announce_at.map(|_| now.monotonic);
            }
            if live && self.values.settings.local == Local::Fields {
                // No local type will describe the topic.
                self.describe(topic, None, now);
            }
            self.values.settle_arrival(topic);
            self.values.schedule(topic);
        }
        self.inquire(now);
    }

    /// Repeats values, sends keep-alives, and detects silent topics that are due by `now`.
    pub fn handle_timeout(&mut self, now: Now) {
        self.look_at_redundancy(now);
        while let Some(Reverse((at, topic))) = self.values.timers.peek().copied() {
            if at > now.monotonic {
                break;
            }
            self.values.timers.pop();
            let Some(entry) = self.values.topics.get_mut(&topic) else {
                continue;
            };
            if entry.timer != Some(at) {
                // A later entry has replaced this entry.
                continue;
            }
            entry.timer = None;
            self.announcements
                .announce_again(&mut self.values, topic, now);
            self.values.handle_due(topic, now);
            self.values.settle_arrival(topic);
            self.values.schedule(topic);
        }
        self.look_at_claims(now);
        self.look_at_calls(now);
        self.inquire(now);
        self.announce_due(now);
        self.reassembly.expire(&mut self.values, now);
        self.security.turn(now.monotonic);
        self.want_keys(now);
    }

    /// Returns the time of the next [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let timer = self.values.timers.peek().map(|Reverse((at, _))| *at);
        let pace = match self.values.paced.is_empty() && !self.is_chunking() {
            true => None,
            false => self.values.pace.opens(),
        };
        let chunks = self.reassembly.due();
        let announcements = self.announcements.due();
        let calls = self.calls.as_ref().and_then(|calls| calls.due());
        let (_, _, silence) = self.values.periods();
        let claims = self.values.claims.due(silence);
        let keys = self.security.due();
        let redundancy = self.redundancy_due();
        [
            timer,
            pace,
            chunks,
            announcements,
            calls,
            claims,
            keys,
            redundancy,
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// Records that the local side published a delivery of the topic at `now`. The value is good.
    pub fn published(&mut self, topic: TopicId, arrived: Timestamp, now: Now) {
        self.values.hops.record(Hop::In, arrived, now.utc);
        self.values.note(topic, || Crossing::Published {
            after: now.utc.unix_nanos() - arrived.unix_nanos(),
        });
        self.values.is_good(topic, now);
    }

    /// Records that the local side did not publish a delivery with the topic and instance. Its
    /// repetition will be delivered.
    pub fn not_published(
        &mut self,
        topic: TopicId,
        instance: Option<Timestamp>,
        why: &'static str,
    ) {
        self.values.forget(topic, instance);
        self.handed(topic, instance, Handover::Nobody);
        self.values
            .count(About::topic(topic), (Reason::NotPublished, why), 1, || {
                why.to_owned()
            });
    }

    /// Records that a service did not accept a value of the topic, or did not respond.
    pub fn call_failed(&mut self, topic: TopicId, detail: &str) {
        self.values
            .count(About::topic(topic), Reason::CallFailed, 1, || {
                detail.to_owned()
            });
    }

    /// Records a publisher or subscriber of the topic with QoS policies that are incompatible with
    /// the local side.
    pub fn unmatched(&mut self, topic: TopicId) {
        self.values
            .count(About::topic(topic), Reason::IncompatibleQos, 1, String::new);
    }

    /// Counts samples that were lost before they reached the Router, such as in a queue of the port
    /// or the kernel. They do not affect the state of a writer.
    pub fn lost(
        &mut self,
        topic: Option<TopicId>,
        count: u64,
        (reason, why): (Reason, &'static str),
    ) {
        self.values
            .count_only(About { topic, from: None }, (reason, why), count, || {
                why.to_owned()
            });
    }

    /// Counts drops of a port that belong to no topic.
    pub fn dropped(&mut self, reason: Reason, count: u64, why: &'static str) {
        let about = About {
            topic: None,
            from: None,
        };
        self.values
            .count(about, (reason, why), count, || why.to_owned());
    }

    /// Takes back the buffer of a datagram or payload after use, so that the next output needs no
    /// allocation.
    pub fn recycle(&mut self, buffer: Vec<u8>) {
        self.values.recycle(buffer);
    }

    /// Returns the counters of each topic in no particular order.
    pub fn topics(&self) -> impl Iterator<Item = (TopicId, &Counters)> {
        self.values
            .topics
            .iter()
            .map(|(topic, entry)| (*topic, &entry.counters))
    }

    /// Returns the counters of datagrams and messages without a topic, and of removed topics.
    #[must_use]
    pub const fn others(&self) -> &Counters {
        &self.values.others
    }

    /// Returns the measured delays.
    #[must_use]
    pub const fn hops(&self) -> &Hops {
        &self.values.hops
    }
}

impl Values {
    /// Takes back the buffer of a datagram or payload.
    fn recycle(&mut self, mut buffer: Vec<u8>) {
        if self.spare.len() < SPARE_BUFFERS && buffer.capacity() <= SPARE_CAPACITY {
            buffer.clear();
            self.spare.push(buffer);
        }
    }

    /// Binds a topic as [`Router::bind`] does. Returns whether it is a topic of the own space,
    /// which is announced with its type.
    pub(super) fn bind_type(
        &mut self,
        topic: TopicId,
        (message_type, selection): (&Arc<MessageType>, &Selection),
        now: Now,
    ) -> Result<bool, PlanError> {
        let wire = match self.settings.local {
            Local::Ros1 => Wire::Ros1,
            Local::Cdr => Wire::Cdr,
            // A local side with fields as payload needs no plan.
            Local::Fields => return Ok(false),
        };
        let plan = self.plans.plan(message_type, selection, wire)?;
        let reactions = self.reactions(topic, (message_type, selection), wire)?;
        // A message as bytes has the encoding of its origin. Bytes from an OPC UA origin are used
        // without conversion.
        let origin = match topic.space {
            SpaceId::UA => None,
            space if space.is_ros2() => Some(Dialect::Ros2),
            _ => Some(Dialect::Ros1),
        };
        let transcoder = origin
            .filter(|origin| *selection == Selection::Bytes && *origin != message_type.dialect())
            .map(|origin| {
                let (_, namespace, _) = topic.triple();
                Box::new(Transcoder::compile(origin, message_type, namespace))
            });
        let Some(entry) = self.follow(topic, None, now) else {
            return Ok(false);
        };
        entry.plan = Some(plan);
        entry.transcoder = transcoder;
        entry.bound = Some(Box::new((Arc::clone(message_type), selection.clone())));
        entry.react(reactions);
        let Role::Theirs(reader) = &mut entry.role else {
            return Ok(true);
        };
        reader.forget_all();
        let held = reader.held.take();
        self.drop_deliveries(topic, "its local type is another now");
        if let Some(held) = held {
            self.deliver_held(topic, &held, now);
        }
        Ok(false)
    }

    /// Returns the reactions of a topic of another space to the loss of a commander.
    fn reactions(
        &self,
        topic: TopicId,
        of: (&Arc<MessageType>, &Selection),
        wire: Wire,
    ) -> Result<(Option<Loss>, Option<Stop>), PlanError> {
        if self.is_home(topic) {
            return Ok((None, None));
        }
        let loss = Loss::new(&self.mapping, topic, of, wire)?;
        Ok((loss, trigger(&self.mapping, topic, of.0, wire)?))
    }

    fn take_local(&mut self, heard: Heard<'_>, status: u16, now: Now) -> Verdict {
        let Heard {
            topic,
            payload,
            received,
            latched_by,
        } = heard;
        self.note(topic, || Crossing::Taken {
            bytes: payload.len(),
        });
        if !self.may_cross(Side::Local, What::Value, topic) {
            return self.refuse(topic, Reason::Looped, String::new());
        }
        let mut encoded = Encoded {
            bytes: self.buffer(),
            ..Encoded::default()
        };
        let local = self.settings.local;
        let (max_datagram, max_message) = self.sizes();
        let Some(Topic {
            role: Role::Ours(writer),
            plan,
            gate,
            description,
            ..
        }) = self.follow(topic, None, now)
        else {
            // Not a topic of the own space.
            return Verdict::Drop(Reason::Looped);
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
        let version = description.as_ref().map(|said| said.major_version());
        let header = data_set_header(writer.expected_sequence(), (stamp, status), version);
        let mut written = encode(&mut encoded, topic, &header, now.utc, &sample);
        let large = encoded.bytes.len() > usize::from(max_datagram);
        if written.is_ok() && large {
            written = check_size(&encoded, max_message)
                .map_err(|detail| ((Reason::TooBig, "max_message").into(), detail));
        }
        if let Err((cause, detail)) = written {
            self.recycle(encoded.bytes);
            return self.refuse(topic, cause, detail);
        }
        let (passage, outpaced) = gate.as_mut().map_or((Passage::Passes, None), |gate| {
            gate.judge(&encoded, latched_by, now.monotonic)
        });
        self.outpaced(topic, outpaced);
        match passage {
            Passage::Passes => self.forward(topic, encoded, (received, latched_by), now),
            Passage::Unchanged => {
                self.recycle(encoded.bytes);
                self.refuse(topic, Reason::Unchanged, String::new())
            }
            Passage::TooEarly => {
                if let Some(Topic {
                    role: Role::Ours(writer),
                    ..
                }) = self.topics.get_mut(&topic)
                {
                    writer.supersede();
                }
                let outpaced = self
                    .topics
                    .get_mut(&topic)
                    .and_then(|entry| entry.gate.as_mut())
                    .and_then(|gate| gate.hold((encoded, latched_by)));
                self.outpaced(topic, outpaced);
                self.schedule(topic);
                Verdict::Forward
            }
        }
    }

    /// Counts a waiting sample that a newer sample replaced.
    fn outpaced(&mut self, topic: TopicId, sample: Option<Waiting>) {
        if let Some((outpaced, _)) = sample {
            self.recycle(outpaced.bytes);
            self.count(About::topic(topic), Reason::Outpaced, 1, String::new);
        }
    }

    /// Queues an encoded sample under the next sequence number.
    fn forward(
        &mut self,
        topic: TopicId,
        mut encoded: Encoded,
        (received, latched_by): (Timestamp, Option<PublisherKey>),
        now: Now,
    ) -> Verdict {
        let (max_datagram, _) = self.sizes();
        let large = encoded.bytes.len() > usize::from(max_datagram);
        let muted = self.is_muted();
        let Some(Topic {
            role: Role::Ours(writer),
            lasting,
            confirming,
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return Verdict::Drop(Reason::Looped);
        };
        // Only a sent message uses up a sequence number.
        let sequence = match muted {
            true => writer.expected_sequence(),
            false => writer.next_sequence(),
        };
        encoded.number(sequence);
        let message = if large {
            Message::Large(Arc::new(encoded))
        } else {
            Message::Datagram(encoded)
        };
        writer.sent(now.monotonic);
        let is_state = match lasting {
            Lasting::State => true,
            Lasting::Event => false,
            Lasting::AsSource => latched_by.is_some(),
        };
        let is_kept = *lasting != Lasting::Event;
        let gave_way = is_kept && writer.keep((latched_by, is_state), &message);
        let is_confirmed = confirming.is_some();
        writer.send_again(
            &message,
            (is_state, is_kept),
            confirming.as_deref(),
            now.monotonic,
        );
        if is_confirmed {
            self.look_for_confirmers(topic);
        }
        if muted {
            self.adopt_followed(topic);
        }
        if gave_way {
            self.count(About::topic(topic), Reason::TooManyPublishers, 1, || {
                format!(
                    "it has more than {MAX_KEPT} latched publishers: late joiners get the last message of those that \
                     spoke last"
                )
            });
        }
        self.hops.record(Hop::Out, received, now.utc);
        self.schedule(topic);
        if self.push(topic, Item::Message(message)) {
            Verdict::ForwardAfterDroppingOldest
        } else {
            Verdict::Forward
        }
    }

    fn handle_due(&mut self, topic: TopicId, now: Now) {
        self.expire_held(topic, now);
        let (key_frames, keep_alives, silence) = self.periods();
        let muted = self.is_muted();
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        match &mut entry.role {
            Role::Theirs(reader) => {
                if reader.fell_silent(now.monotonic, silence) {
                    if self.settings.local != Local::Fields {
                        reader.withdraw();
                    }
                    self.tell_silence(topic);
                    self.forget_base(topic);
                    self.lose(topic, now);
                } else if (entry.loss.as_ref().and_then(|loss| loss.due()))
                    .is_some_and(|at| at <= now.monotonic)
                {
                    self.lose(topic, now);
                }
            }
            Role::Ours(writer) => {
                if let Some(held) = entry
                    .gate
                    .as_mut()
                    .and_then(|gate| gate.release(now.monotonic))
                {
                    self.let_go(topic, Some(held), now);
                    return;
                }
                if writer.look_again(now.monotonic) && !entry.ready {
                    entry.ready = true;
                    self.ready.push_back(topic);
                }
                let Some((at, idle)) = writer.due(key_frames, keep_alives) else {
                    return;
                };
                if at > now.monotonic {
                    return;
                }
                match idle {
                    Idle::Repeat => writer.begin_round(now.monotonic),
                    Idle::KeepAlive => {
                        writer.spoke(now.monotonic);
                        let expected = writer.expected_sequence();
                        // Waiting items contain more information than a keep-alive.
                        let buffer = self.spare.pop().unwrap_or_default();
                        if !muted
                            && !entry.has_more()
                            && let Some(datagram) = keep_alive(buffer, topic, expected, now.utc)
                        {
                            entry.counters.keep_alives += 1;
                            let item = Item::Message(Message::Datagram(datagram));
                            let bytes = item.bytes();
                            // The queue is empty, so nothing is dropped.
                            drop(entry.queue.push(item, bytes));
                        }
                    }
                }
                if !entry.ready && entry.has_more() {
                    entry.ready = true;
                    self.ready.push_back(topic);
                }
            }
        }
    }

    /// Sends a sample that waited.
    fn let_go(&mut self, topic: TopicId, held: Option<Waiting>, now: Now) {
        if let Some((held, latched_by)) = held {
            // `forward` counts drops itself.
            let _verdict = self.forward(topic, held, (now.utc, latched_by), now);
        }
    }

    /// Delivers the reaction to the loss of a commander from the mapping, if a value was delivered
    /// after the last reaction.
    pub(super) fn lose(&mut self, topic: TopicId, now: Now) {
        let loss = self.topics.get_mut(&topic).and_then(|of| of.loss.as_mut());
        let Some(reaction) = loss.and_then(|loss| loss.take()) else {
            return;
        };
        let (of, stop) = match reaction {
            Reaction::Publish(stop) => (topic, Some(stop)),
            Reaction::Call(by) => {
                let trigger = self.topics.get(&by).and_then(|of| of.trigger.as_deref());
                (by, trigger.cloned())
            }
        };
        let muted = self.is_muted_locally();
        if !muted {
            self.tell(Output::CommanderLost { topic });
        }
        let mut payload = self.buffer();
        let written = match stop {
            Some(stop) => stop.write(now.utc, &mut payload),
            None => Err(format!("the service of {by} is not known here", by = of)),
        };
        if let Err(detail) = written {
            self.recycle(payload);
            self.count(
                About::topic(topic),
                (Reason::NotPublished, "on_loss"),
                1,
                || format!("`on_loss`: {detail}"),
            );
            return;
        }
        let delivery = Delivery {
            topic: of,
            payload,
            source: Some(now.utc),
            status: GOOD,
            arrived: now.utc,
            instance: None,
            kept: Kept::Alone,
            lasting: false,
        };
        if muted {
            self.mute_loss(delivery, now);
        } else {
            self.push(of, Item::Delivery(delivery));
        }
    }

    /// Adds the topic to the timer list with its next due time.
    fn schedule(&mut self, topic: TopicId) {
        let (key_frames, keep_alives, silence) = self.periods();
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        let due = match &entry.role {
            Role::Ours(writer) => {
                let held = entry.gate.as_ref().and_then(|gate| gate.due());
                let idle = writer.due(key_frames, keep_alives).map(|(at, _)| at);
                let announce = entry.announce_at;
                let again = writer.again_at();
                let due = held.into_iter().chain(idle).chain(announce);
                due.chain(again).min()
            }
            Role::Theirs(reader) => {
                let hold = entry.loss.as_ref().and_then(|loss| loss.due());
                let held = reader.held.as_ref().and_then(|held| held.expires());
                let due = reader.due(silence).into_iter().chain(hold);
                due.chain(held).min()
            }
        };
        // An earlier entry stays: it finds nothing due and schedules the topic again. This avoids a
        // new entry for each sample.
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

    /// Queues an item. Returns whether older items were dropped for it.
    fn push(&mut self, topic: TopicId, item: Item) -> bool {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return false;
        };
        let bytes = item.bytes();
        let dropped = entry.queue.push(item, bytes);
        if !entry.ready {
            entry.ready = true;
            self.ready.push_back(topic);
        }
        if dropped.is_empty() {
            return false;
        }
        let count = dropped.len().try_into().unwrap_or(u64::MAX);
        for item in dropped {
            match item {
                Item::Message(Message::Datagram(Encoded { bytes, .. })) => self.recycle(bytes),
                // The message is kept for repetition, or freed with its last reference.
                Item::Message(Message::Large(_)) => {}
                Item::Delivery(Delivery {
                    payload, instance, ..
                }) => {
                    self.recycle(payload);
                    self.forget(topic, instance);
                }
            }
        }
        let keeps_latest = self.keeps_latest(topic);
        let reason = match keeps_latest && self.is_withheld(topic) {
            true => Reason::Outpaced,
            false => Reason::Overflow,
        };
        self.count(About::topic(topic), reason, count, || {
            "the queue was full, its oldest sample was dropped".to_owned()
        });
        true
    }

    /// Records that a value was not delivered.
    fn forget(&mut self, topic: TopicId, instance: Option<Timestamp>) {
        if let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get_mut(&topic)
        {
            reader.forget(instance);
        }
    }

    fn sizes(&self) -> (u16, u32) {
        let pubsub = self.mapping.pubsub();
        let room = u16::try_from(self.overhead).unwrap_or_default();
        let limit = self.relay.and_then(|relay| relay.limit);
        let most = limit.map_or(pubsub.max_datagram, |limit| limit.min(pubsub.max_datagram));
        let max_datagram = most.saturating_sub(room);
        (max_datagram, pubsub.max_message)
    }

    /// Counts a dropped sample of the local side.
    fn refuse(&mut self, topic: TopicId, cause: impl Into<Cause>, detail: String) -> Verdict {
        let cause = cause.into();
        self.count(About::topic(topic), cause, 1, || detail);
        Verdict::Drop(cause.reason)
    }

    fn buffer(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }
}

/// The upper 16 bits of the StatusCode Good.
const GOOD: u16 = 0;
/// The maximum number of buffers kept for reuse, and the maximum capacity of each.
const SPARE_BUFFERS: usize = 64;
const SPARE_CAPACITY: usize = 128 * 1024;
