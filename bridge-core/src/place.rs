//! The place of a DataSetMessage among the others of its writer.

use std::net::SocketAddr;

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
}

/// How many nanoseconds after it was taken a sample is sent at most that is no repetition; those that a rate held back or
/// that are long in their chunks are not among them.
const FRESH: i128 = 100_000_000;
