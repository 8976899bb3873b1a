//! The place of a DataSetMessage among the others of its writer.

use std::net::SocketAddr;
use std::time::Duration;

use uadp::Timestamp;

/// What the header of a DataSetMessage says of its place among the others.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) sequence: Option<u16>,
    pub(crate) stamp: Option<Timestamp>,
    /// Whether the stamp has PicoSeconds, as all bridges send: two samples of one writer then never share it.
    pub(crate) fine: bool,
    /// When its NetworkMessage was sent.
    pub(crate) sent: Option<Timestamp>,
    pub(crate) from: SocketAddr,
    /// How long the writer may hold a sample back before it sends it.
    pub(crate) held_back: Duration,
    /// Whether the stamps may be of clients of an OPC UA server, whose clocks are their own.
    pub(crate) by_clients: bool,
}

impl Place {
    /// The stamp, where it tells one sample of the writer from all others.
    pub(crate) fn instance(&self) -> Option<Timestamp> {
        self.stamp.filter(|_| self.fine)
    }

    /// Whether the sample was taken just before it was sent, as no repetition is.
    pub(crate) fn is_fresh(&self) -> bool {
        let (Some(stamp), Some(sent)) = (self.stamp, self.sent) else {
            return false;
        };
        (0..FRESH).contains(&(sent.unix_nanos() - stamp.unix_nanos()))
    }

    /// Whether the sample was taken so long before it was sent that it is a stored value. Both stamps are of the writer, so
    /// no clocks are compared. Stamps that were never filled in say nothing.
    pub(crate) fn is_stored(&self) -> bool {
        let (Some(stamp), Some(sent), true) = (self.stamp, self.sent, self.fine) else {
            return false;
        };
        let held_back = i128::try_from(self.held_back.as_nanos()).unwrap_or(i128::MAX);
        stamp.time.0 != 0
            && sent.unix_nanos() - stamp.unix_nanos() >= STORED.saturating_add(held_back)
    }
}

/// How many nanoseconds after it was taken a sample is sent at most that is no repetition; those that a rate held back or
/// that are long in their chunks are not among them.
const FRESH: i128 = 100_000_000;
/// How many nanoseconds after it was taken a sample is sent at least that is a stored value.
const STORED: i128 = 500_000_000;
