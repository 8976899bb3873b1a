//! The values of topics on their way through the program.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Mapping, Overflow, SpaceId, TopicId};
use messages::{Dialect, MessageType, PlanError, Selection, Wire};
use uadp::Timestamp;

use super::about::DropSite;
use super::claims::Claims;
use super::inquiries::Inquiries;
use super::redundant::Redundant;
use crate::buffers::Buffers;
use crate::concern::Concern;
use crate::confirm::Confirmer;
use crate::counters::Reason;
use crate::description::TopicMetaData;
use crate::hops::Hops;
use crate::layout::DataSetLayout;
use crate::learned::Learned;
use crate::loop_rule::Owned;
use crate::loss::{ConstantMessage, LossReaction, trigger};
use crate::message::{EncodedSample, SampleMessage};
use crate::output::{Delivery, Output};
use crate::pace::ChunkPace;
use crate::part::OwnPart;
use crate::plans::Plans;
use crate::room::Room;
use crate::settings::{Forwarding, Local, Now, Relay, RouterSettings};
use crate::tap::TappedTopics;
use crate::topic::{PolledSample, TopicSide};
use crate::topics::{Handle, TopicTable};
use crate::transcoder::Transcoder;

/// The topics of the space with their queues, turns and timers, and the outputs about them.
#[derive(Debug)]
pub(super) struct TopicQueues {
    pub(super) settings: RouterSettings,
    pub(super) owned: Owned,
    pub(super) mapping: Arc<Mapping>,
    pub(super) topics: TopicTable,
    /// The limit for topics that are unknown to the mapping and the local side.
    pub(super) room: Room,
    pub(super) plans: Plans,
    /// Topics with items to poll, served in turn, so that a topic with large messages does not
    /// block a topic with small messages.
    pub(super) ready: VecDeque<Handle>,
    /// Topics with a partly sent large message, which wait for `pace`.
    pub(super) paced: VecDeque<Handle>,
    pub(super) pace: ChunkPace,
    pub(super) claims: Claims,
    /// The redundancy of the own space; `None` without redundancy.
    pub(super) redundant: Option<Box<Redundant>>,
    /// The namespaces of other programs that this program uses.
    pub(super) concern: Concern,
    /// The namespaces that this program carries; `None` for all of them.
    pub(super) part: Option<Box<OwnPart>>,
    /// The broker between the programs; `None` for a network that does not store messages.
    pub(super) relay: Option<Relay>,
    /// The largest message in bytes that the network takes, if it is known.
    pub(super) limit: Option<u16>,
    /// The broker by which the current message was received.
    pub(super) arrival: Option<Relay>,
    /// The route of the current message.
    pub(super) forwarding: Forwarding,
    /// The sender of the confirmations of each other space.
    pub(super) confirmers: BTreeMap<SpaceId, Confirmer>,
    /// The announced types of topics of other spaces.
    pub(super) learned: Learned<TopicMetaData>,
    /// The announced fields, for messages that do not describe their fields.
    pub(super) layouts: Learned<DataSetLayout>,
    /// The probes that became necessary.
    pub(super) inquiries: Inquiries,
    /// The number of bytes that security adds to a datagram.
    pub(super) overhead: usize,
    /// Own topics with an outcome of the newest event that is not reported yet.
    pub(super) settled: VecDeque<TopicId>,
    /// Outputs other than samples and calls.
    pub(super) told: VecDeque<Output>,
    /// Topics of other spaces with notifications for the port, without duplicates.
    pub(super) news: VecDeque<Handle>,
    /// Whether `news` is polled before `ready` next time.
    pub(super) news_first: bool,
    pub(super) timers: BinaryHeap<Reverse<(Instant, Handle)>>,
    /// The size in bytes of the key frames stored for delta frames.
    pub(super) base_bytes: usize,
    /// Topics with a large sample that may wait for its local type.
    pub(super) large_held: Vec<TopicId>,
    pub(super) tap: TappedTopics,
    pub(super) buffers: Buffers,
    pub(super) hops: Hops,
    /// The time at which the kernel received the current datagram, if it is known.
    pub(super) received: Option<Timestamp>,
}

impl TopicQueues {
    pub(super) fn new(settings: RouterSettings, mapping: Arc<Mapping>, overhead: usize) -> Self {
        Self {
            settings,
            owned: Owned::All,
            mapping,
            topics: TopicTable::default(),
            room: Room::new(MAX_STRAYS),
            plans: Plans::default(),
            ready: VecDeque::new(),
            paced: VecDeque::new(),
            pace: ChunkPace::default(),
            claims: Claims::default(),
            redundant: None,
            concern: Concern::default(),
            part: None,
            relay: None,
            limit: None,
            arrival: None,
            forwarding: Forwarding::None,
            confirmers: BTreeMap::new(),
            learned: Learned::default(),
            layouts: Learned::default(),
            inquiries: Inquiries::default(),
            overhead,
            settled: VecDeque::new(),
            told: VecDeque::new(),
            news: VecDeque::new(),
            news_first: false,
            timers: BinaryHeap::new(),
            base_bytes: 0,
            large_held: Vec::new(),
            tap: TappedTopics::default(),
            buffers: Buffers::default(),
            hops: Hops::new(),
            received: None,
        }
    }

    /// Returns the time from which the delays of the current datagram are measured. A time in the
    /// future or long ago is of a clock that was set meanwhile.
    pub(super) fn arrival(&self, now: Now) -> Timestamp {
        let waited = |stamp: &Timestamp| now.utc.unix_nanos() - stamp.unix_nanos();
        let received = self
            .received
            .filter(|stamp| (0..=LONGEST_WAIT).contains(&waited(stamp)));
        received.unwrap_or(now.utc)
    }

    /// Returns how long the current datagram waited for this program, which was stopped or slow.
    /// The network is not in this time, so it needs no synchronised clocks.
    pub(super) fn waited(&self, now: Now) -> Duration {
        let waited = self
            .received
            .map(|stamp| now.utc.unix_nanos() - stamp.unix_nanos());
        let waited = waited.and_then(|nanos| u64::try_from(nanos).ok());
        Duration::from_nanos(waited.unwrap_or_default())
    }

    /// Binds a topic as [`Router::bind`](super::Router::bind) does. Returns whether it is a topic
    /// of the own space, which is announced with its type.
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
        let at = self.follow(topic, now);
        let Some(entry) = self.topics.at_mut(at) else {
            return Ok(false);
        };
        entry.plan = Some(plan);
        entry.transcoder = transcoder;
        entry.bound = Some(Box::new((Arc::clone(message_type), selection.clone())));
        entry.react(reactions);
        let TopicSide::Theirs(reader) = &mut entry.role else {
            return Ok(true);
        };
        reader.forget_all();
        let held = reader.held.take();
        self.drop_deliveries(topic, "its local type has changed");
        if let Some(held) = held {
            self.deliver_held(at, &held, now);
        }
        Ok(false)
    }

    /// Returns the reactions of a topic of another space to the loss of a commander.
    pub(super) fn reactions(
        &self,
        topic: TopicId,
        of: (&Arc<MessageType>, &Selection),
        wire: Wire,
    ) -> Result<(Option<LossReaction>, Option<ConstantMessage>), PlanError> {
        if self.is_home(topic) {
            return Ok((None, None));
        }
        let loss = LossReaction::new(&self.mapping, topic, of, wire)?;
        Ok((loss, trigger(&self.mapping, topic, of.0, wire)?))
    }

    /// Queues an item. Returns whether older items were dropped for it.
    pub(super) fn push(&mut self, at: Handle, item: PolledSample) -> bool {
        let Some(entry) = self.topics.at_mut(at) else {
            return false;
        };
        let bytes = item.bytes();
        let keeps_latest = entry.overflow == Overflow::KeepLatest;
        let dropped = entry.queue.push(item, bytes);
        if !entry.ready {
            entry.ready = true;
            self.ready.push_back(at);
        }
        if dropped.is_empty() {
            return false;
        }
        let topic = at.topic();
        let count = dropped.len().try_into().unwrap_or(u64::MAX);
        for item in dropped {
            match item {
                PolledSample::Message(SampleMessage::Datagram(EncodedSample { bytes, .. })) => {
                    self.recycle(bytes)
                }
                // The message is kept for repetition, or freed with its last reference.
                PolledSample::Message(SampleMessage::Large(_)) => {}
                PolledSample::Delivery(Delivery {
                    payload, instance, ..
                }) => {
                    self.recycle(payload);
                    self.forget(at, instance);
                }
            }
        }
        let reason = if keeps_latest && self.is_withheld(topic) {
            Reason::Outpaced
        } else {
            Reason::Overflow
        };
        self.count(DropSite::topic(topic), reason, count, || {
            "the queue was full, its oldest sample was dropped".to_owned()
        });
        true
    }

    /// Queues an item of a topic by its name.
    pub(super) fn push_to(&mut self, topic: TopicId, item: PolledSample) {
        if let Some(at) = self.topics.find(topic) {
            // `push` counts dropped items itself.
            let _gave_way = self.push(at, item);
        }
    }

    /// Records that a value was not delivered.
    pub(super) fn forget(&mut self, at: Handle, instance: Option<Timestamp>) {
        if let Some(reader) = self.topics.reader(at) {
            reader.forget(instance);
        }
    }

    /// Returns the maximum sizes of a datagram and of a message in bytes.
    pub(super) fn sizes(&self) -> (u16, u32) {
        let pubsub = self.mapping.pubsub();
        let room = u16::try_from(self.overhead).unwrap_or_default();
        let most = self
            .limit
            .map_or(pubsub.max_datagram, |limit| limit.min(pubsub.max_datagram));
        let max_datagram = most.saturating_sub(room);
        (max_datagram, pubsub.max_message)
    }

    /// Returns an empty buffer.
    pub(super) fn buffer(&mut self) -> Vec<u8> {
        self.buffers.take()
    }

    /// Takes back a buffer.
    pub(super) fn recycle(&mut self, buffer: Vec<u8>) {
        self.buffers.give(buffer);
    }

    /// Gives a topic with waiting items a turn.
    pub(super) fn resume(&mut self, at: Handle) {
        if let Some(entry) = self.topics.at_mut(at)
            && !entry.ready
            && entry.has_more()
        {
            entry.ready = true;
            self.ready.push_back(at);
        }
    }
}

/// The maximum number of unknown topics of other spaces. It limits memory, because any sender in
/// the group can invent topics.
pub(super) const MAX_STRAYS: usize = 16_384;
/// The longest time that a datagram waits in the socket, in nanoseconds.
const LONGEST_WAIT: i128 = 10_000_000_000;
