//! What comes out of a Router.

use std::net::SocketAddr;

use mappings::TopicId;
use uadp::{BuiltinType, Timestamp};

use crate::counters::Reason;

/// What the Router wants done.
#[derive(Debug)]
#[non_exhaustive]
pub enum Output {
    /// A NetworkMessage to send. Give the buffer back with [`Router::recycle`](crate::Router::recycle).
    Datagram {
        /// The topic it carries.
        topic: TopicId,
        /// The whole UDP payload.
        bytes: Vec<u8>,
    },
    /// A sample of another space to publish.
    Delivery(Delivery),
    /// A value of another space came whose local type is not known: find one and [`bind`](crate::Router::bind) it.
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
