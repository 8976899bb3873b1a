//! Everything the Router keeps for one topic.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{Lasting, Overflow};
use messages::{MessageType, Plan, Selection};

use crate::call::ValueDescription;
use crate::confirm::Confirming;
use crate::counters::Counters;
use crate::description::Description;
use crate::gate::Gate;
use crate::loss::{Loss, Stop};
use crate::output::Delivery;
use crate::queue::Queue;
use crate::reader::Reader;
use crate::router::ByName;
use crate::takes::Takes;
use crate::transcoder::Transcoder;
use crate::writer::{Encoded, Message, Writer};

/// One topic of the space, seen from one bridge: of our own space, or of another.
#[derive(Debug)]
pub(crate) struct Topic {
    pub(crate) role: Role,
    /// How its bytes become fields or the other way. `None` until the local type is known, and for a local side
    /// that speaks in fields.
    pub(crate) plan: Option<Arc<Plan>>,
    /// The type and selection that the plan was made of.
    pub(crate) bound: Option<Box<(Arc<MessageType>, Selection)>>,
    /// For bytes of the other ROS, what makes them ours, or why nothing does.
    pub(crate) transcoder: Option<Box<Result<Transcoder, String>>>,
    /// What makes the message of the fields by their names, where no mapping names the value.
    pub(crate) by_name: Option<Box<ByName>>,
    pub(crate) queue: Queue<Item>,
    /// A large message of which chunks are still to be sent, before anything of the queue.
    pub(crate) sending: Option<Sending>,
    pub(crate) overflow: Overflow,
    /// Whether its last value is stored for readers that come late.
    pub(crate) lasting: Lasting,
    /// What of the fields of messages of another space is taken.
    pub(crate) takes: Takes,
    /// How long its writer may hold a sample back for its rate.
    pub(crate) held_back: Duration,
    /// The reaction to the loss of its commander.
    pub(crate) loss: Option<Box<Loss>>,
    /// The value that calls the service of the topic, where that is the reaction to the loss of a commander.
    pub(crate) trigger: Option<Box<Stop>>,
    /// The spaces that confirm its events.
    pub(crate) confirming: Option<Box<Confirming>>,
    /// What holds samples of our own space back.
    pub(crate) gate: Option<Box<Gate>>,
    /// What is announced of it, if it is of our own space and its type is known.
    pub(crate) description: Option<Box<Description>>,
    /// What the local side says it is, where it speaks in fields.
    pub(crate) said: Option<Box<ValueDescription>>,
    /// When it is to be announced again.
    pub(crate) announce_at: Option<Instant>,
    pub(crate) counters: Counters,
    /// Whether it stands in the Router's list of topics with something to poll.
    pub(crate) ready: bool,
    /// The instant the Router's timer list holds for it.
    pub(crate) timer: Option<Instant>,
}

// In Boxes, because the Router's table of topics has room for up to twice as many as there are.
#[derive(Debug)]
pub(crate) enum Role {
    /// Produced here: we are its DataSetWriter.
    Ours(Box<Writer>),
    /// Produced elsewhere.
    Theirs(Box<Reader>),
}

/// A sample on its way out.
#[derive(Debug)]
pub(crate) enum Item {
    Message(Message),
    Delivery(Delivery),
}

/// A large message on its way.
#[derive(Debug)]
pub(crate) struct Sending {
    pub(crate) message: Arc<Encoded>,
    /// Where in its DataSetMessage the next chunk begins.
    pub(crate) offset: usize,
}

impl Item {
    /// How much of the queue's bytes it takes.
    pub(crate) fn bytes(&self) -> usize {
        match self {
            Self::Message(Message::Datagram(encoded)) => encoded.bytes.len(),
            Self::Message(Message::Large(encoded)) => encoded.bytes.len(),
            Self::Delivery(delivery) => delivery.payload.len(),
        }
    }
}

impl Topic {
    pub(crate) fn new(role: Role, (overflow, lasting): (Overflow, Lasting)) -> Self {
        Self {
            role,
            plan: None,
            bound: None,
            transcoder: None,
            by_name: None,
            queue: Queue::new(overflow),
            sending: None,
            overflow,
            lasting,
            takes: Takes::default(),
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

    /// The next thing of the queue, or of the round of repetitions, which are written into `spare` buffers.
    pub(crate) fn take(&mut self, spare: &mut Vec<Vec<u8>>) -> Option<Item> {
        if let Some(item) = self.queue.pop() {
            return Some(item);
        }
        let Role::Ours(writer) = &mut self.role else {
            return None;
        };
        let again = writer.repeat(|| spare.pop().unwrap_or_default())?;
        self.counters.repeated += 1;
        Some(Item::Message(again))
    }

    /// As [`take`](Self::take), if that is a datagram whose DataSetMessage has so many bytes at most.
    pub(crate) fn take_within(&mut self, most: usize, spare: &mut Vec<Vec<u8>>) -> Option<Encoded> {
        self.next_size().filter(|size| *size <= most)?;
        match self.take(spare) {
            Some(Item::Message(Message::Datagram(datagram))) => Some(datagram),
            Some(_) | None => None,
        }
    }

    /// Bytes of the DataSetMessage of what is taken next, if that is a datagram.
    fn next_size(&self) -> Option<usize> {
        if self.sending.is_some() {
            return None;
        }
        let next = match (self.queue.front(), &self.role) {
            (Some(Item::Message(message)), _) => message,
            (None, Role::Ours(writer)) => writer.next_repeated()?,
            (Some(Item::Delivery(_)), _) | (None, Role::Theirs(_)) => return None,
        };
        match next {
            Message::Datagram(datagram) => Some(datagram.data_set_message().len()),
            Message::Large(_) => None,
        }
    }

    /// Takes over what is done when a commander is lost. A value that moves the robot stays known.
    pub(crate) fn react(&mut self, (loss, trigger): (Option<Loss>, Option<Stop>)) {
        let before = self.loss.take();
        let loss = loss.map(|loss| loss.following(before.as_deref()));
        self.loss = loss.map(Box::new);
        self.trigger = trigger.map(Box::new);
    }

    /// Whether there is something to poll.
    pub(crate) fn has_more(&self) -> bool {
        !self.queue.is_empty()
            || self.sending.is_some()
            || matches!(&self.role, Role::Ours(writer) if writer.repeats())
    }
}
