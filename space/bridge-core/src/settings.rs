//! What a Router is told about its place.

use std::net::SocketAddr;
use std::time::Instant;

use mappings::SpaceId;
use uadp::Timestamp;

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
    /// A block of OPC UA fields as [`Fields::bytes`](uadp::Fields::bytes) gives it: an OPC UA server's side.
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
