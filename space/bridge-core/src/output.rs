//! What comes out of a Router.

use std::net::SocketAddr;
use std::sync::Arc;

use mappings::TopicId;
use uadp::action::ExecutionId;
use uadp::{BuiltinType, Timestamp};

use crate::call::{Answered, AskId, CallDescription, Execution};
use crate::confirm::Arrival;
use crate::counters::Reason;
use crate::description::Described;

/// What the Router wants done.
#[derive(Debug)]
#[non_exhaustive]
pub enum Output {
    /// A NetworkMessage to send. Give the buffer back with [`Router::recycle`](crate::Router::recycle).
    Datagram {
        /// The topic it carries.
        topic: TopicId,
        /// The topics of its other DataSetMessages, in their order, where the mapping lets several share a datagram. One
        /// that has several of them is here as often.
        with: Vec<TopicId>,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// A discovery NetworkMessage to send, as a [`Datagram`](Self::Datagram) is: what a topic consists of, or the question
    /// for that.
    Discovery {
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// A sample of another space to publish.
    Delivery(Delivery),
    /// A value of another space came whose local type is not known, or its writer says anew what it is: find a type and
    /// [`bind`](crate::Router::bind) it.
    Unbound {
        /// Which value.
        topic: TopicId,
        /// Builtin type, and whether it is an array, of each of its fields. Null counts as a scalar
        /// [`BuiltinType::Variant`].
        shape: Vec<(BuiltinType, bool)>,
        /// What its writer says it is, if that is what the values are.
        described: Option<Arc<Described>>,
    },
    /// A topic of another space has had no good value for `receive_timeout`, or has one again. Good is a sample that the
    /// local side took ([`Router::published`](crate::Router::published)), its repetition, or a keep-alive with nothing dropped
    /// before it.
    Silent {
        /// Which value.
        topic: TopicId,
        /// Whether it is silent now.
        silent: bool,
        /// Why the last value was dropped, where the writer is heard all the same. Only a value ends such a silence.
        dropped: Option<Reason>,
    },
    /// The commander of a topic has ended or timed out: what the mapping says under `on_loss` is delivered.
    CommanderLost {
        /// Which value.
        topic: TopicId,
    },
    /// Of the values a topic of another space has side by side, one is no longer repeated: who comes late is not to
    /// get it any more.
    Retired {
        /// Which topic.
        topic: TopicId,
        /// [`Delivery::instance`] of the value.
        instance: Timestamp,
    },
    /// A request or response to send, as a [`Datagram`](Self::Datagram) is.
    Action {
        /// The call.
        topic: TopicId,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// What became of a request of the local side. Each has one, unless it was given up.
    Answer {
        /// Which request.
        ask: AskId,
        /// Of which call.
        topic: TopicId,
        /// The response, or why there is none.
        answer: Answered,
    },
    /// A call of another program can be asked for, or is another than before.
    CallKnown {
        /// Which call.
        topic: TopicId,
        /// What it takes and gives.
        description: Arc<CallDescription>,
    },
    /// Nobody executes that call any longer.
    CallGone {
        /// Which call.
        topic: TopicId,
    },
    /// A request for the local side to execute. Each is to be ended with [`Router::executed`](crate::Router::executed).
    Execute(Execution),
    /// Who asked does not want it any longer: it is to be cancelled where that can be done, and ended all the same.
    Abandoned {
        /// Which execution.
        execution: ExecutionId,
        /// Of which call.
        topic: TopicId,
    },
    /// The outcome of the newest event of a topic of ours that bridges [confirm](mappings::Variable::confirmed_within).
    Settled {
        /// Which value.
        topic: TopicId,
        /// The outcome.
        arrival: Arrival,
    },
    /// A value that the local side accepted is to be confirmed: report its handover with
    /// [`Router::handed`](crate::Router::handed).
    HandoverWanted {
        /// Which value.
        topic: TopicId,
        /// [`Delivery::instance`] of the value.
        instance: Timestamp,
    },
    /// Somebody else writes a namespace of ours: nothing of ours is sent in it as long as that is so.
    Taken {
        /// Which namespace.
        namespace: u16,
        /// Who; nobody any more without one.
        by: Option<SocketAddr>,
    },
    /// The keys of a secured group are out of date: somebody uses one that is not known here, or there is no next one.
    KeysWanted {
        /// Its SecurityGroupId.
        group: String,
    },
    /// Something to log.
    Notice(Notice),
}

/// A latched publisher of the local side, among those of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PublisherKey(pub u32);

/// A message heard on the local side.
#[derive(Debug, Clone, Copy)]
pub struct Heard<'a> {
    /// Which value it is.
    pub topic: TopicId,
    /// It, in the local encoding.
    pub payload: &'a [u8],
    /// When it came.
    pub received: Timestamp,
    /// The publisher, if it latches: its last message then stays for late joiners beside those of others, until
    /// [`Router::left`](crate::Router::left). Of all messages without, the last one stays.
    pub latched_by: Option<PublisherKey>,
}

/// What a value is to the others of its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// It takes the place of all before it, as the values of a state do.
    Alone,
    /// It lives beside others, as the messages of several latched publishers do, until it is
    /// [retired](Output::Retired).
    Beside,
    /// As `Beside`, and it was handed out before: for late joiners only.
    Again,
}

/// One value of another space on its way to the local side.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery {
    /// Which value.
    pub topic: TopicId,
    /// Its bytes in the local encoding.
    pub payload: Vec<u8>,
    /// When the producer's bridge took the sample: the DataSetMessage Timestamp, or the SourceTimestamp of the DataValue that
    /// is the value.
    pub source: Option<Timestamp>,
    /// The DataSetMessage Status, or that of the DataValue that is the value if that is worse: the upper 16 bits of an OPC UA
    /// StatusCode, 0 is Good.
    pub status: u16,
    /// When its datagram arrived here; of a sample that waited for its local type, when that was known.
    pub arrived: Timestamp,
    /// The DataSetMessage Timestamp, where it tells this value from all others of the topic.
    pub instance: Option<Timestamp>,
    /// What it is to the others.
    pub kept: Kept,
    /// Whether subscribers that come late get it: it is a state, and no event.
    pub lasting: bool,
}

/// A drop worth a line in the log. One that is repeated for the same cause is told at its 1st, 10th, 100th ... occurrence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notice {
    /// The topic, if it is about one.
    pub topic: Option<TopicId>,
    /// Who sent it, if it came as a datagram.
    pub from: Option<SocketAddr>,
    /// Why.
    pub reason: Reason,
    /// How often it happened for that cause by now.
    pub total: u64,
    /// What exactly, in words.
    pub detail: String,
}
