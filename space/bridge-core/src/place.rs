//! The position of a DataSetMessage in the sequence of its writer.

use std::net::SocketAddr;
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use uadp::{DataSetMessage, MessageKind, Timestamp};

/// The position of a DataSetMessage in the sequence of its writer, from its headers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SequencePosition {
    pub(crate) sequence: Option<u16>,
    pub(crate) stamp: Option<Timestamp>,
    /// Whether the stamp has PicoSeconds. All bridges send them, and two samples of one writer then
    /// never share a stamp.
    pub(crate) fine: bool,
    /// The time at which the NetworkMessage was sent.
    pub(crate) sent: Option<Timestamp>,
    pub(crate) from: SocketAddr,
    /// Whether a broker delivered the message.
    pub(crate) is_relayed: bool,
    /// The maximum time for which the writer may hold back a sample before sending it.
    pub(crate) held_back: Duration,
    /// Whether the stamps may come from clients of an OPC UA server, which have their own clocks.
    pub(crate) by_clients: bool,
}

impl SequencePosition {
    /// Returns the position of a message of a topic, which a sender sent at a time, if that is
    /// known. The time for which the writer may hold back a sample is not in the message.
    pub(crate) fn of(
        topic: TopicId,
        message: &DataSetMessage<'_>,
        (from, sent): (SocketAddr, Option<Timestamp>),
        is_relayed: bool,
    ) -> Self {
        let header = message.header();
        Self {
            sequence: header.sequence_number,
            stamp: header.timestamp.map(|time| Timestamp {
                time,
                picoseconds: header.picoseconds.unwrap_or_default(),
            }),
            // Only key frames are repeated.
            fine: header.picoseconds.is_some() && message.kind == MessageKind::KeyFrame,
            sent,
            from,
            is_relayed,
            held_back: Duration::ZERO,
            by_clients: topic.space == SpaceId::UA,
        }
    }

    /// Returns the stamp if it distinguishes the sample from all other samples of the writer.
    pub(crate) fn instance(&self) -> Option<Timestamp> {
        self.stamp.filter(|_| self.fine)
    }

    /// Returns whether the sample was taken just before it was sent. False for repetitions.
    pub(crate) fn is_fresh(&self) -> bool {
        let (Some(stamp), Some(sent)) = (self.stamp, self.sent) else {
            return false;
        };
        (0..FRESH).contains(&(sent.unix_nanos() - stamp.unix_nanos()))
    }

    /// Returns whether the sample is a stored value, because it was taken long before it was sent.
    /// Both stamps are from the writer, so no clocks are compared. Stamps that were never filled in
    /// are not evaluated.
    pub(crate) fn is_stored(&self) -> bool {
        let (Some(stamp), Some(sent), true) = (self.stamp, self.sent, self.fine) else {
            return false;
        };
        let held_back = i128::try_from(self.held_back.as_nanos()).unwrap_or(i128::MAX);
        stamp.time.0 != 0
            && sent.unix_nanos() - stamp.unix_nanos() >= STORED.saturating_add(held_back)
    }
}

/// The maximum time in nanoseconds between taking and sending a sample that is not a repetition.
/// Samples that a rate limit held back and samples with long transmission in chunks exceed it.
const FRESH: i128 = 100_000_000;
/// The minimum time in nanoseconds between taking and sending a stored value.
const STORED: i128 = 500_000_000;
