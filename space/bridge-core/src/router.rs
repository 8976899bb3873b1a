//! The Router: verdicts on samples, queues per topic, repetitions and silences.

mod announce;
mod applications;
mod batch;
mod by_name;
mod calls;
mod chunks;
mod confirm;
mod content;
mod discovery;
mod follow;
mod guarded;
mod held;
mod own;
mod receive;
mod reload;
mod roll;
mod send;
mod told;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Lasting, Mapping, SpaceId, TopicId};
use messages::{Dialect, MessageType, PlanError, Selection, Wire};
use uadp::Timestamp;

use crate::confirm::{Confirmer, Handover};
use crate::counters::{Cause, Counters, Reason, Verdict};
use crate::fields;
use crate::gate::{Passage, Waiting};
use crate::guard::Guard;
use crate::hops::{Hop, Hops};
use crate::loop_rule::{Owned, Side, What};
use crate::loss::{Loss, Reaction, Stop, trigger};
use crate::network::{check_size, data_set_header, encode, keep_alive};
use crate::output::{Delivery, Heard, Kept, Output, PublisherKey};
use crate::pace::Pace;
use crate::plans::Plans;
use crate::room::Room;
use crate::settings::{Local, Now, Settings};
use crate::topic::{Item, Role, Topic};
use crate::transcoder::Transcoder;
use crate::writer::{Encoded, Idle, MAX_KEPT, Message};
pub(crate) use by_name::ByName;
use calls::Calls;
use chunks::Chunks;
use discovery::Discovery;
use own::Claims;
use told::About;

/// Decides what crosses between one space and UADP. See the crate's page for how it is driven.
#[derive(Debug)]
pub struct Router {
    settings: Settings,
    owned: Owned,
    mapping: Arc<Mapping>,
    topics: HashMap<TopicId, Topic>,
    /// For topics that nobody here knows.
    room: Room,
    plans: Plans,
    /// Topics with something in their queue, served in turn: a camera cannot starve a button.
    ready: VecDeque<TopicId>,
    /// Topics in the midst of a large message, which wait for `pace`.
    paced: VecDeque<TopicId>,
    pace: Pace,
    /// Chunks of large messages of other spaces; `None` before the first one.
    chunks: Option<Box<Chunks>>,
    /// What topics consist of, announced and learned; `None` before there is any.
    discovery: Option<Box<Discovery>>,
    /// Calls asked for and executed; `None` before there is any.
    calls: Option<Box<Calls>>,
    /// Random bytes that tell our requests from those of others.
    instance: [u8; 16],
    /// The namespaces of ours in which nothing is sent; `None` where there is none.
    claims: Option<Box<Claims>>,
    /// The secured groups; `None` where there is none.
    guard: Option<Box<Guard>>,
    /// Whether what is handled came in clear.
    in_clear: bool,
    /// Who confirms for each other space.
    confirmers: BTreeMap<SpaceId, Confirmer>,
    /// Topics of ours of which it is known what became of the newest event.
    settled: VecDeque<TopicId>,
    /// What is told besides samples.
    told: VecDeque<Output>,
    /// Topics of other spaces of which the port is to be told something, each once.
    news: VecDeque<TopicId>,
    /// Whether they have the next turn, before those that are ready.
    news_first: bool,
    /// Whether a value went before a call the last time.
    value_first: bool,
    timers: BinaryHeap<Reverse<(Instant, TopicId)>>,
    /// Bytes of the key frames kept for delta frames.
    base_bytes: usize,
    /// Topics of which a large sample may wait for its local type.
    large_held: Vec<TopicId>,
    /// Buffers given back by [`recycle`](Self::recycle).
    spare: Vec<Vec<u8>>,
    /// Datagrams and messages that belong to no topic, and topics that are no longer followed.
    others: Counters,
    hops: Hops,
}

impl Router {
    /// A Router for one space. `mapping` says how each topic queues and how often values are repeated.
    #[must_use]
    pub fn new(settings: Settings, mapping: Arc<Mapping>) -> Self {
        let guard = Guard::new(mapping.security()).map(Box::new);
        Self {
            settings,
            owned: Owned::All,
            mapping,
            topics: HashMap::new(),
            room: Room::new(follow::MAX_STRAYS),
            plans: Plans::default(),
            ready: VecDeque::new(),
            paced: VecDeque::new(),
            pace: Pace::default(),
            chunks: None,
            discovery: None,
            calls: None,
            instance: [0; 16],
            claims: None,
            guard,
            in_clear: true,
            confirmers: BTreeMap::new(),
            settled: VecDeque::new(),
            told: VecDeque::new(),
            news: VecDeque::new(),
            news_first: false,
            value_first: false,
            timers: BinaryHeap::new(),
            base_bytes: 0,
            large_held: Vec::new(),
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
        let plan = self.plans.plan(message_type, selection, wire)?;
        let reactions = self.reactions(topic, (message_type, selection), wire)?;
        // A message as bytes is in the dialect of its origin; that of an OPC UA origin is taken as it is.
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
            return Ok(());
        };
        entry.plan = Some(plan);
        entry.transcoder = transcoder;
        entry.bound = Some(Box::new((Arc::clone(message_type), selection.clone())));
        entry.react(reactions);
        let held = match &mut entry.role {
            Role::Theirs(reader) => {
                reader.forget_all();
                let held = reader.held.take();
                self.drop_deliveries(topic, "its local type is another now");
                held
            }
            Role::Ours(_) => {
                self.describe(topic, Some((message_type, selection)), now);
                None
            }
        };
        if let Some(held) = held {
            self.deliver_held(topic, &held, now);
        }
        Ok(())
    }

    /// What is done about a topic of another space when a commander is lost.
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

    /// A sample was heard on the local side.
    pub fn handle_local(&mut self, heard: Heard<'_>, now: Now) -> Verdict {
        self.handle_local_as(heard, GOOD, now)
    }

    /// As [`handle_local`](Self::handle_local), of a side that knows the quality of its samples: the upper 16 bits of a
    /// StatusCode, which go out as the Status of the DataSetMessage (OPC 10000-14, 7.2.4.5.4).
    pub fn handle_local_as(&mut self, heard: Heard<'_>, status: u16, now: Now) -> Verdict {
        let topic = heard.topic;
        let verdict = self.take_local(heard, status, now);
        self.settle_verdict(topic, verdict);
        verdict
    }

    fn take_local(&mut self, heard: Heard<'_>, status: u16, now: Now) -> Verdict {
        let Heard {
            topic,
            payload,
            received,
            latched_by,
        } = heard;
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
            // None of our own space.
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

    /// Counts a sample that waited until a newer one made it old.
    fn outpaced(&mut self, topic: TopicId, sample: Option<Waiting>) {
        if let Some((outpaced, _)) = sample {
            self.recycle(outpaced.bytes);
            self.count(About::topic(topic), Reason::Outpaced, 1, String::new);
        }
    }

    /// Queues a sample that is encoded, under the next sequence number.
    fn forward(
        &mut self,
        topic: TopicId,
        mut encoded: Encoded,
        (received, latched_by): (Timestamp, Option<PublisherKey>),
        now: Now,
    ) -> Verdict {
        let (max_datagram, _) = self.sizes();
        let large = encoded.bytes.len() > usize::from(max_datagram);
        let Some(Topic {
            role: Role::Ours(writer),
            lasting,
            confirming,
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return Verdict::Drop(Reason::Looped);
        };
        // The number is used up only by a message that goes out.
        encoded.number(writer.next_sequence());
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
            self.look_for_confirmers(topic, now);
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

    /// A latched publisher of a topic of our own space has gone for good: its last message is no longer repeated.
    pub fn left(&mut self, topic: TopicId, publisher: PublisherKey, now: Now) {
        let held = self
            .topics
            .get_mut(&topic)
            .and_then(|entry| entry.gate.as_mut())
            .and_then(|gate| gate.left(publisher, now.monotonic));
        self.let_go(topic, held, now);
        if let Some(Topic {
            role: Role::Ours(writer),
            ..
        }) = self.topics.get_mut(&topic)
        {
            writer.forget(publisher);
            self.schedule(topic);
        }
    }

    /// Whether a topic of our own space has a producer. Without one its value is no longer repeated, so that
    /// readers see it fall silent; the next sample revives it.
    pub fn set_live(&mut self, topic: TopicId, live: bool, now: Now) {
        if !live {
            // What waits is the last there is.
            let held = self
                .topics
                .get_mut(&topic)
                .and_then(|entry| entry.gate.as_mut())
                .and_then(|gate| gate.hurry(now.monotonic));
            self.let_go(topic, held, now);
        }
        if let Some(Topic {
            role: Role::Ours(writer),
            ..
        }) = self.follow(topic, None, now)
        {
            let revived = live && !writer.is_live();
            writer.set_live(live);
            if revived && let Some(entry) = self.topics.get_mut(&topic) {
                entry.announce_at = entry.announce_at.map(|_| now.monotonic);
            }
            if live && self.settings.local == Local::Fields {
                // No local type will say what it is.
                self.describe(topic, None, now);
            }
            self.settle_arrival(topic);
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
            self.announce_again(topic, now);
            self.handle_due(topic, now);
            self.settle_arrival(topic);
            self.schedule(topic);
        }
        self.look_at_claims(now);
        self.look_at_calls(now);
        self.discover(now);
        self.expire_chunks(now);
        if let Some(guard) = &mut self.guard {
            guard.turn(now.monotonic);
            self.want_keys(now);
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) is wanted next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let timer = self.timers.peek().map(|Reverse((at, _))| *at);
        let pace = match self.paced.is_empty() && !self.is_chunking() {
            true => None,
            false => self.pace.opens(),
        };
        let chunks = self.chunks.as_ref().and_then(|chunks| chunks.due());
        let discovery = self.discovery_due();
        let calls = self.calls.as_ref().and_then(|calls| calls.due());
        let claims = self.claims.as_ref();
        let claims = claims.and_then(|claims| claims.due(self.mapping.pubsub().receive_timeout));
        let keys = self.guard.as_ref().and_then(|guard| guard.due());
        [timer, pace, chunks, discovery, calls, claims, keys]
            .into_iter()
            .flatten()
            .min()
    }

    /// The local side took a delivery of the topic: its time in this program ends at `now`, and the value is good.
    pub fn published(&mut self, topic: TopicId, arrived: Timestamp, now: Now) {
        self.hops.record(Hop::In, arrived, now.utc);
        self.is_good(topic, now);
    }

    /// The local side did not take a delivery, given by its topic and instance: its repetition is welcome.
    pub fn not_published(
        &mut self,
        topic: TopicId,
        instance: Option<Timestamp>,
        why: &'static str,
    ) {
        self.forget(topic, instance);
        self.handed(topic, instance, Handover::Nobody);
        self.count(About::topic(topic), (Reason::NotPublished, why), 1, || {
            why.to_owned()
        });
    }

    /// A value of the topic was not taken by the service it is for, or the service that should say it did not answer.
    pub fn call_failed(&mut self, topic: TopicId, detail: &str) {
        self.count(About::topic(topic), Reason::CallFailed, 1, || {
            detail.to_owned()
        });
    }

    /// A publisher or subscriber of the topic cannot be matched on the local side.
    pub fn unmatched(&mut self, topic: TopicId) {
        self.count(About::topic(topic), Reason::IncompatibleQos, 1, String::new);
    }

    /// Counts samples that were lost before the Router saw them, such as in a queue of the port or the kernel. Which values
    /// of its writer are received does not depend on them.
    pub fn lost(
        &mut self,
        topic: Option<TopicId>,
        count: u64,
        (reason, why): (Reason, &'static str),
    ) {
        self.count_only(About { topic, from: None }, (reason, why), count, || {
            why.to_owned()
        });
    }

    /// What a port dropped that belongs to no topic.
    pub fn dropped(&mut self, reason: Reason, count: u64, why: &'static str) {
        let about = About {
            topic: None,
            from: None,
        };
        self.count(about, (reason, why), count, || why.to_owned());
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

    /// The counters of datagrams and messages that belong to no topic, and of topics that are no longer followed.
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
        self.expire_held(topic, now);
        let (key_frames, keep_alives, silence) = self.periods();
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
                        // What waits says more.
                        let buffer = self.spare.pop().unwrap_or_default();
                        if !entry.has_more()
                            && let Some(datagram) = keep_alive(buffer, topic, expected, now.utc)
                        {
                            entry.counters.keep_alives += 1;
                            let item = Item::Message(Message::Datagram(datagram));
                            let bytes = item.bytes();
                            // Nothing waits that could give way.
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
            // Whether it went first or another gave way is counted there.
            let _verdict = self.forward(topic, held, (now.utc, latched_by), now);
        }
    }

    /// The commander of a topic is lost: delivers what the mapping says, if a value was delivered since it did so last.
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
        self.tell(Output::CommanderLost { topic });
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
        self.push(
            of,
            Item::Delivery(Delivery {
                topic: of,
                payload,
                source: Some(now.utc),
                status: GOOD,
                arrived: now.utc,
                instance: None,
                kept: Kept::Alone,
                lasting: false,
            }),
        );
    }

    /// Puts the topic on the timer list at the time it wants to be looked at.
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

    /// Queues an item, and says whether the oldest one had to go for it.
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
                // It is kept for repeating, or its last owner frees it.
                Item::Message(Message::Large(_)) => {}
                Item::Delivery(Delivery {
                    payload, instance, ..
                }) => {
                    self.recycle(payload);
                    self.forget(topic, instance);
                }
            }
        }
        self.count(About::topic(topic), Reason::Overflow, count, || {
            "the queue was full, its oldest sample was dropped".to_owned()
        });
        true
    }

    /// Takes note that a delivery did not get through.
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
        let room = match self.guard {
            // What is sealed is longer.
            Some(_) => u16::try_from(Guard::OVERHEAD).unwrap_or_default(),
            None => 0,
        };
        let max_datagram = pubsub.max_datagram.saturating_sub(room);
        (max_datagram, pubsub.max_message)
    }

    /// Counts a sample of the local side that does not cross.
    fn refuse(&mut self, topic: TopicId, cause: impl Into<Cause>, detail: String) -> Verdict {
        let cause = cause.into();
        self.count(About::topic(topic), cause, 1, || detail);
        Verdict::Drop(cause.reason)
    }

    fn buffer(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }
}

/// The upper half of the StatusCode Good.
const GOOD: u16 = 0;
/// Buffers kept for reuse, and how large each may have grown.
const SPARE_BUFFERS: usize = 64;
const SPARE_CAPACITY: usize = 128 * 1024;
