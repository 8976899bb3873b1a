//! The settings of a Router.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::Timestamp;

/// The space and local side of a Router.
#[derive(Debug, Clone)]
pub struct RouterSettings {
    /// The space that the Router serves.
    pub own: SpaceId,
    /// The payload format of the local side.
    pub local: Local,
    /// The source address of the own datagrams; an unspecified IP matches any. It is needed to
    /// detect a second bridge of the same space.
    pub source: Option<SocketAddr>,
}

/// The properties of a network with a broker, which stores messages and hides their senders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Relay {
    /// The age at which a received message is dropped.
    pub within: Duration,
    /// Whether the broker decides who may send a request. Otherwise only secured groups and calls
    /// that are open to all may be requested.
    pub authorized: bool,
}

/// Whether a received message belongs to a route between carriers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Forwarding {
    /// It belongs to no route.
    #[default]
    None,
    /// It was forwarded.
    Forwarded,
    /// It was not forwarded, for this reason.
    Refused(&'static str),
}

/// The capacity of the network for the chunks of large messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkCapacity {
    /// The speed is unknown, as of a wireless link or behind a broker.
    Unknown,
    /// A network interface of this speed.
    Wire {
        /// Bytes per second.
        speed: u64,
    },
    /// All programs are on this host.
    Host {
        /// Bytes of datagrams that the receive buffer of a program holds.
        receive_buffer: u64,
    },
}

/// The payload format of a local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Local {
    /// A ROS 1 message body without its length.
    Ros1,
    /// A CDR with its 4 byte encapsulation header.
    Cdr,
    /// A block of OPC UA fields as returned by [`Fields::bytes`](uadp::Fields::bytes), for an OPC
    /// UA server.
    Fields,
}

/// The two clocks. The caller reads them once per iteration.
#[derive(Debug, Clone, Copy)]
pub struct Now {
    /// The clock for timers.
    pub monotonic: Instant,
    /// The clock for timestamps in messages.
    pub utc: Timestamp,
}
