//! The outputs of a Router.

use std::net::SocketAddr;
use std::sync::Arc;

use mappings::TopicId;
use uadp::action::ExecutionId;
use uadp::{BuiltinType, Timestamp};

use crate::call::{AskId, CallDescription, CallExecution, CallResponse};
use crate::confirm::ConfirmedArrival;
use crate::counters::Reason;
use crate::description::TopicMetaData;
use crate::redundancy::RoleChange;

/// An action that the Router requests from its caller.
#[derive(Debug)]
pub enum Output {
    /// A NetworkMessage to send. Return the buffer with
    /// [`Router::recycle`](crate::Router::recycle).
    Datagram {
        /// The topic of the first DataSetMessage.
        topic: TopicId,
        /// The topics of the other DataSetMessages in their order, if the mapping lets several
        /// share a datagram. A topic with several DataSetMessages is listed once for each of them.
        with: Vec<TopicId>,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// A discovery NetworkMessage to send in the same way as a [`Datagram`](Self::Datagram): a
    /// metadata announcement or a probe for metadata.
    Discovery {
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// The heartbeat of a redundant bridge, to send before everything else. Report the result with
    /// [`heartbeat_sent`](crate::Router::heartbeat_sent).
    Heartbeat {
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// The role of this program among the redundant bridges of its space has changed, to log.
    Role(RoleChange),
    /// A sample of another space to publish.
    Delivery(Delivery),
    /// A value of another space was received with an unknown local type, or its writer announced a
    /// changed type. Find a type and [`bind`](crate::Router::bind) it.
    Unbound {
        /// The topic of the value.
        topic: TopicId,
        /// The builtin type of each field, and whether the field is an array. Null counts as a
        /// scalar [`BuiltinType::Variant`].
        shape: Vec<(BuiltinType, bool)>,
        /// The announced description, if the values match it.
        described: Option<Arc<TopicMetaData>>,
    },
    /// A topic of another space has had no good value for `receive_timeout`, or has a good value
    /// again. Good are samples that the local side accepted
    /// ([`Router::published`](crate::Router::published)), their repetitions, and keep-alives
    /// without a dropped value before them.
    Silent {
        /// The topic of the value.
        topic: TopicId,
        /// Whether the topic is silent.
        silent: bool,
        /// The reason why the last value was dropped, if the writer is received nevertheless. Only
        /// a value ends such a silence.
        dropped: Option<Reason>,
    },
    /// The commander of a topic has ended or timed out. The reaction under `on_loss` in the mapping
    /// is delivered.
    CommanderLost {
        /// The topic of the value.
        topic: TopicId,
    },
    /// A value of a topic with several simultaneous values is not repeated any more. Late joiners
    /// must not receive it.
    Retired {
        /// The topic of the value.
        topic: TopicId,
        /// [`Delivery::instance`] of the value.
        instance: Timestamp,
    },
    /// A request or response to send in the same way as a [`Datagram`](Self::Datagram).
    Action {
        /// The topic of the call.
        topic: TopicId,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// The outcome of a request of the local side. Each request has exactly one outcome, unless it
    /// was given up.
    Answer {
        /// The identifier of the request.
        ask: AskId,
        /// The topic of the call.
        topic: TopicId,
        /// The response, or the reason why there is no response.
        answer: CallResponse,
    },
    /// A call of another program can be requested, or its description has changed.
    CallKnown {
        /// The topic of the call.
        topic: TopicId,
        /// The arguments and results of the call.
        description: Arc<CallDescription>,
    },
    /// The call has no executor any more.
    CallGone {
        /// The topic of the call.
        topic: TopicId,
    },
    /// A request for the local side to execute. End each execution with
    /// [`Router::executed`](crate::Router::executed).
    Execute(CallExecution),
    /// The requestor does not need the execution any more. Cancel it if possible, and end it in any
    /// case.
    Abandoned {
        /// The identifier of the execution.
        execution: ExecutionId,
        /// The topic of the call.
        topic: TopicId,
    },
    /// The outcome of the newest event of an own topic that bridges
    /// [confirm](mappings::Variable::confirmed_within).
    Settled {
        /// The topic of the event.
        topic: TopicId,
        /// The outcome.
        arrival: ConfirmedArrival,
    },
    /// A value that the local side accepted needs a confirmation. Report its handover with
    /// [`Router::handed`](crate::Router::handed).
    HandoverWanted {
        /// The topic of the value.
        topic: TopicId,
        /// [`Delivery::instance`] of the value.
        instance: Timestamp,
    },
    /// Another sender writes an own namespace. The Router sends nothing in this namespace in the
    /// meantime.
    Taken {
        /// The number of the namespace.
        namespace: u16,
        /// The address of the other sender; `None` when it has stopped.
        by: Option<SocketAddr>,
        /// The name of the other program; empty if it is unknown.
        name: String,
    },
    /// The keys of a secured group are out of date: a message uses an unknown key, or the next key
    /// is missing.
    KeysWanted {
        /// The SecurityGroupId of the group.
        group: String,
    },
    /// An event to log.
    Notice(DropNotice),
}

impl Output {
    /// Returns the NetworkMessage of an output for the network, with the topic that counts its
    /// drops. All other outputs are for this program.
    pub(crate) const fn message_mut(&mut self) -> Option<(&mut Vec<u8>, Option<TopicId>)> {
        match self {
            Self::Datagram { topic, bytes, .. } | Self::Action { topic, bytes } => {
                Some((bytes, Some(*topic)))
            }
            Self::Discovery { bytes } | Self::Heartbeat { bytes } => Some((bytes, None)),
            Self::Role(_)
            | Self::Delivery(_)
            | Self::Unbound { .. }
            | Self::Silent { .. }
            | Self::CommanderLost { .. }
            | Self::Retired { .. }
            | Self::Answer { .. }
            | Self::CallKnown { .. }
            | Self::CallGone { .. }
            | Self::Execute(_)
            | Self::Abandoned { .. }
            | Self::Settled { .. }
            | Self::HandoverWanted { .. }
            | Self::Taken { .. }
            | Self::KeysWanted { .. }
            | Self::Notice(_) => None,
        }
    }
}

/// The samples of an own topic that are not sent yet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unsent {
    /// The number of samples in the queue, without a message that is partly sent.
    pub queued: usize,
    /// Whether a sample before the queue is partly sent, or waits for the pace of large messages.
    pub is_sending: bool,
    /// Whether the newest sample waits for its time behind the queue, because of `at_most`.
    pub is_held: bool,
}

impl Unsent {
    /// Returns the number of samples, without the one that waits for its time.
    #[must_use]
    pub fn all(self) -> usize {
        self.queued.saturating_add(usize::from(self.is_sending))
    }
}

/// Identifies a latched publisher of the local side among the publishers of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PublisherKey(pub u32);

/// A message received on the local side.
#[derive(Debug, Clone, Copy)]
pub struct LocalMessage<'a> {
    /// The topic of the value.
    pub topic: TopicId,
    /// The message in the local encoding.
    pub payload: &'a [u8],
    /// The time of reception.
    pub received: Timestamp,
    /// The publisher, if it latches. Its last message then stays available for late joiners, beside
    /// the messages of other publishers, until [`Router::left`](crate::Router::left). Of all
    /// messages without a latching publisher, only the last stays.
    pub latched_by: Option<PublisherKey>,
}

/// The relation of a value to the other values of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ValueRelation {
    /// The value replaces all previous values, as for a state.
    Alone,
    /// The value exists beside others, as for several latched publishers, until it is
    /// [retired](Output::Retired).
    Beside,
    /// As `Beside`, but the value was already delivered: it is for late joiners only.
    Again,
}

/// A value of another space for the local side.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery {
    /// The topic of the value.
    pub topic: TopicId,
    /// The bytes of the value in the local encoding.
    pub payload: Vec<u8>,
    /// The time at which the producing bridge took the sample: the DataSetMessage Timestamp, or the
    /// SourceTimestamp of the DataValue that is the value.
    pub source: Option<Timestamp>,
    /// The upper 16 bits of an OPC UA StatusCode; 0 is Good. It is the DataSetMessage Status, or
    /// the worse Status of the DataValue that is the value.
    pub status: u16,
    /// The arrival time of the datagram. For a sample that waited for its local type, the time at
    /// which the type became known.
    pub arrived: Timestamp,
    /// The DataSetMessage Timestamp, if it distinguishes this value from all other values of the
    /// topic.
    pub instance: Option<Timestamp>,
    /// The relation to the other values of the topic.
    pub kept: ValueRelation,
    /// Whether late joiners receive the value: true for a state, false for an event.
    pub lasting: bool,
}

/// A drop to log. Repetitions for the same cause are reported at the 1st, 10th, 100th ...
/// occurrence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DropNotice {
    /// The topic, if the drop concerns a topic.
    pub topic: Option<TopicId>,
    /// The sender, if the dropped value was received in a datagram.
    pub from: Option<SocketAddr>,
    /// The reason of the drop.
    pub reason: Reason,
    /// The number of drops for this cause so far.
    pub total: u64,
    /// The details in words.
    pub detail: String,
}

/// The upper 16 bits of the StatusCode Good.
pub(crate) const GOOD: u16 = 0;
