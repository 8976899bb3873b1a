//! The state of the Router for a topic.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Lasting, Overflow};
use messages::{MessagePlan, MessageType, Selection};

use crate::buffers::Buffers;
use crate::by_name::ByName;
use crate::call::ValueDescription;
use crate::confirm::Confirming;
use crate::counters::Counters;
use crate::deadline::Deadline;
use crate::description::OwnAnnouncements;
use crate::gate::Gate;
use crate::loss::{ConstantMessage, LossReaction};
use crate::message::{EncodedSample, SampleMessage};
use crate::output::Delivery;
use crate::queue::SampleQueue;
use crate::reader::ReceivedTopicState;
use crate::takes::UsedFields;
use crate::transcoder::{TranscodeError, Transcoder};
use crate::writer::SentTopicState;

/// A topic of the own space or of another space.
#[derive(Debug)]
pub(crate) struct Topic {
    pub(crate) role: TopicSide,
    /// Converts between bytes and fields. `None` until the local type is known, and for a local
    /// side with fields as payload.
    pub(crate) plan: Option<Arc<MessagePlan>>,
    /// The type and selection from which the plan was compiled.
    pub(crate) bound: Option<Box<(Arc<MessageType>, Selection)>>,
    /// Converts bytes of the other ROS version to the local type, or the reason why no conversion
    /// exists.
    pub(crate) transcoder: Option<Box<Result<Transcoder, TranscodeError>>>,
    /// Makes the message from fields by their names, for values that are not in the mapping.
    pub(crate) by_name: Option<Box<ByName>>,
    pub(crate) queue: SampleQueue<PolledSample>,
    /// A large message with chunks that are still to be sent. They are sent before all items of the
    /// queue.
    pub(crate) sending: Option<Sending>,
    pub(crate) overflow: Overflow,
    /// Whether the last value is stored for late joiners.
    pub(crate) lasting: Lasting,
    /// The selection of fields from messages of another space.
    pub(crate) takes: UsedFields,
    /// The longest time between two values.
    pub(crate) deadline: Option<Box<Deadline>>,
    /// The maximum time for which the writer may hold back a sample because of its rate limit.
    pub(crate) held_back: Duration,
    /// The reaction to the loss of the commander.
    pub(crate) loss: Option<Box<LossReaction>>,
    /// The value that calls the service of the topic, if this call is the reaction to the loss of a
    /// commander.
    pub(crate) trigger: Option<Box<ConstantMessage>>,
    /// The spaces that confirm the events of the topic.
    pub(crate) confirming: Option<Box<Confirming>>,
    /// Holds back samples of the own space.
    pub(crate) gate: Option<Box<Gate>>,
    /// The metadata to announce, for a topic of the own space with a known type.
    pub(crate) description: Option<Box<OwnAnnouncements>>,
    /// The description from the local side, if its payloads are fields.
    pub(crate) said: Option<Box<ValueDescription>>,
    /// The time of the next announcement.
    pub(crate) announce_at: Option<Instant>,
    pub(crate) counters: Counters,
    /// Whether the topic is in the Router's list of topics with items to poll.
    pub(crate) ready: bool,
    /// The time of the topic's entry in the Router's timer list.
    pub(crate) timer: Option<Instant>,
}

// Boxed, because the capacity of the Router's table of topics is up to twice the number of topics.
#[derive(Debug)]
pub(crate) enum TopicSide {
    /// Produced in this space: the Router is its DataSetWriter.
    Ours(Box<SentTopicState>),
    /// Produced in another space.
    Theirs(Box<ReceivedTopicState>),
}

/// A sample that waits to be polled.
#[derive(Debug)]
pub(crate) enum PolledSample {
    Message(SampleMessage),
    Delivery(Delivery),
}

/// A large message that is partly sent.
#[derive(Debug)]
pub(crate) struct Sending {
    pub(crate) message: Arc<EncodedSample>,
    /// The offset of the next chunk in the DataSetMessage.
    pub(crate) offset: usize,
    /// Whether the message was sent before.
    pub(crate) is_repeat: bool,
}

impl PolledSample {
    /// Returns the number of bytes that count towards the queue's limit.
    pub(crate) fn bytes(&self) -> usize {
        match self {
            Self::Message(SampleMessage::Datagram(encoded)) => encoded.bytes.len(),
            Self::Message(SampleMessage::Large(encoded)) => encoded.bytes.len(),
            Self::Delivery(delivery) => delivery.payload.len(),
        }
    }
}

impl Topic {
    /// Notes a value that is sent or delivered.
    pub(crate) fn note_value(&mut self, now: Instant) {
        let deadline = self.deadline.as_mut();
        if deadline.is_some_and(|deadline| deadline.note(now)) {
            self.counters.deadline_missed += 1;
        }
    }

    pub(crate) fn new(role: TopicSide, (overflow, lasting): (Overflow, Lasting)) -> Self {
        Self {
            role,
            plan: None,
            bound: None,
            transcoder: None,
            by_name: None,
            queue: SampleQueue::new(overflow),
            sending: None,
            overflow,
            lasting,
            takes: UsedFields::default(),
            deadline: None,
            held_back: Duration::ZERO,
            loss: None,
            trigger: None,
            confirming: None,
            gate: None,
            description: None,
            said: None,
            announce_at: None,
            counters: Counters::default(),
            ready: false,
            timer: None,
        }
    }

    /// Returns the next item of the queue, or else the next repetition, which is written into a
    /// buffer of `buffers`.
    pub(crate) fn take(&mut self, buffers: &mut Buffers) -> Option<PolledSample> {
        if let Some(item) = self.queue.pop() {
            return Some(item);
        }
        let TopicSide::Ours(writer) = &mut self.role else {
            return None;
        };
        let again = writer.repeat(|| buffers.take())?;
        self.counters.repeated += 1;
        Some(PolledSample::Message(again))
    }

    /// Returns the next item as [`take`](Self::take) does, if it is a datagram with a
    /// DataSetMessage of at most `most` bytes.
    pub(crate) fn take_within(
        &mut self,
        most: usize,
        buffers: &mut Buffers,
    ) -> Option<EncodedSample> {
        self.next_size().filter(|size| *size <= most)?;
        match self.take(buffers) {
            Some(PolledSample::Message(SampleMessage::Datagram(datagram))) => Some(datagram),
            Some(_) | None => None,
        }
    }

    /// Returns the size in bytes of the next DataSetMessage, if it is sent as a datagram.
    fn next_size(&self) -> Option<usize> {
        if self.sending.is_some() {
            return None;
        }
        let next = match (self.queue.front(), &self.role) {
            (Some(PolledSample::Message(message)), _) => message,
            (None, TopicSide::Ours(writer)) => writer.next_repeated()?,
            (Some(PolledSample::Delivery(_)), _) | (None, TopicSide::Theirs(_)) => return None,
        };
        match next {
            SampleMessage::Datagram(datagram) => Some(datagram.data_set_message().len()),
            SampleMessage::Large(_) => None,
        }
    }

    /// Sets the reaction to the loss of a commander. The time of the last delivered value is kept.
    pub(crate) fn react(
        &mut self,
        (loss, trigger): (Option<LossReaction>, Option<ConstantMessage>),
    ) {
        let before = self.loss.take();
        let loss = loss.map(|loss| loss.following(before.as_deref()));
        self.loss = loss.map(Box::new);
        self.trigger = trigger.map(Box::new);
    }

    /// Returns whether there is an item to poll.
    pub(crate) fn has_more(&self) -> bool {
        !self.queue.is_empty()
            || self.sending.is_some()
            || matches!(&self.role, TopicSide::Ours(writer) if writer.repeats())
    }
}
