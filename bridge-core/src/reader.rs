//! What is remembered of one DataSetWriter of another space.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use uadp::Timestamp;

use crate::counters::Reason;

/// The state of a topic we receive.
#[derive(Debug)]
pub(crate) struct Reader {
    /// Sequence number of the newest DataSetMessage taken.
    sequence: Option<u16>,
    /// Its Timestamp.
    stamp: Option<Timestamp>,
    /// Who sent it.
    from: SocketAddr,
    /// When anything was last heard of the writer, keep-alives included.
    heard: Instant,
    /// Whether the writer is held to be silent.
    silent: bool,
    /// The stamp of the sample that was last handed on, if it was fine enough to tell samples apart.
    delivered: Option<Timestamp>,
    /// A sample that waits for its local type.
    pub(crate) held: Option<Held>,
    /// When the port was last asked for the local type.
    pub(crate) asked: Option<Instant>,
}

/// A sample that came before its local type was known; the newest one is kept.
#[derive(Debug)]
pub(crate) struct Held {
    pub(crate) fields: Vec<u8>,
    pub(crate) source: Option<Timestamp>,
    pub(crate) status: u16,
    pub(crate) arrived: Timestamp,
}

/// What the header of a DataSetMessage says of its place among the others.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) sequence: Option<u16>,
    pub(crate) stamp: Option<Timestamp>,
    /// Whether the stamp has PicoSeconds, as all bridges send: two samples of one writer then never share it.
    pub(crate) fine: bool,
    pub(crate) from: SocketAddr,
}

impl Reader {
    pub(crate) fn new(from: SocketAddr, now: Instant) -> Self {
        Self {
            sequence: None,
            stamp: None,
            from,
            heard: now,
            silent: false,
            delivered: None,
            held: None,
            asked: None,
        }
    }

    /// Takes note that the writer lives, and says whether it was silent before.
    pub(crate) fn heard(&mut self, now: Instant) -> bool {
        self.heard = now;
        std::mem::take(&mut self.silent)
    }

    /// Whether the writer has just been silent for `timeout`. True once per silence.
    pub(crate) fn fell_silent(&mut self, now: Instant, timeout: Duration) -> bool {
        let fell = !self.silent && now.saturating_duration_since(self.heard) >= timeout;
        self.silent |= fell;
        fell
    }

    /// When silence is to be looked for again; `None` while the writer is silent.
    pub(crate) fn due(&self, timeout: Duration) -> Option<Instant> {
        (!self.silent).then(|| self.heard + timeout)
    }

    /// Admits a key frame into the sequence and gives the number of messages missing before it.
    ///
    /// The arithmetic is that of OPC 10000-14 7.2.3: ahead by less than a quarter of the range is newer, behind by
    /// less than a quarter is old. A writer that starts over looks old by its numbers; its stamps or its new address
    /// tell.
    pub(crate) fn admit(&mut self, place: Place) -> Result<u16, Reason> {
        let restarted = place.from != self.from
            || matches!((place.stamp, self.stamp), (Some(new), Some(last)) if new > last);
        let missing = match (self.sequence, place.sequence) {
            (Some(last), Some(sequence)) => match sequence.wrapping_sub(last) {
                0 if !restarted => return Err(Reason::Duplicate),
                0 => 0,
                ahead @ 1..=QUARTER => ahead - 1,
                OLD.. if !restarted => return Err(Reason::Stale),
                _ => 0,
            },
            (_, _) => 0,
        };
        self.sequence = place.sequence;
        self.stamp = place.stamp.or(self.stamp);
        self.from = place.from;
        if place.fine && place.stamp.is_some() && place.stamp == self.delivered {
            return Err(Reason::Repeat);
        }
        Ok(missing)
    }

    /// Takes note that the sample of that place was handed on, so that its repetitions are known.
    pub(crate) fn delivered(&mut self, place: Place) {
        self.delivered = place.stamp.filter(|_| place.fine);
    }

    /// Forgets what was handed on: the local type changed, and the next repetition is wanted.
    pub(crate) fn forget_delivered(&mut self) {
        self.delivered = None;
    }
}

/// A quarter of the sequence numbers' range.
const QUARTER: u16 = 0x4000;
/// From here on a number counts as behind the last one.
const OLD: u16 = 0xC000;

#[cfg(test)]
mod tests {
    use super::*;

    fn address(port: u16) -> SocketAddr {
        ([127, 0, 0, 1], port).into()
    }

    fn place(sequence: u16, stamp: i128) -> Place {
        Place {
            sequence: Some(sequence),
            stamp: Some(Timestamp::from_unix_nanos(stamp)),
            fine: true,
            from: address(1),
        }
    }

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn reader() -> (Reader, Instant) {
        let now = Instant::now();
        (Reader::new(address(1), now), now)
    }

    #[test]
    fn numbers_wrap_and_gaps_are_counted() {
        let (mut reader, _) = reader();
        assert_eq!(reader.admit(place(65_534, 1000)), Ok(0));
        assert_eq!(reader.admit(place(65_535, 2000)), Ok(0));
        assert_eq!(reader.admit(place(2, 3000)), Ok(2), "0 and 1 are missing");
    }

    #[test]
    fn old_and_equal_numbers_are_dropped_unless_the_writer_started_over() {
        let (mut reader, _) = reader();
        assert_eq!(reader.admit(place(500, 9000)), Ok(0));
        assert_eq!(reader.admit(place(500, 9000)), Err(Reason::Duplicate));
        assert_eq!(reader.admit(place(499, 8000)), Err(Reason::Stale));
        assert_eq!(
            reader.admit(place(0, 10_000)),
            Ok(0),
            "a newer stamp tells of a restart"
        );
        let moved = Place {
            from: address(2),
            ..place(0, 10_000)
        };
        assert_eq!(
            reader.admit(moved),
            Ok(0),
            "another address tells of a restart"
        );
    }

    #[test]
    fn a_repeated_key_frame_is_known_by_its_stamp() {
        let (mut reader, _) = reader();
        let first = place(1, 1000);
        assert_eq!(reader.admit(first), Ok(0));
        reader.delivered(first);
        assert_eq!(reader.admit(place(2, 1000)), Err(Reason::Repeat));
        assert_eq!(reader.admit(place(3, 2000)), Ok(0), "another sample");
        let (mut coarse, _) = self::reader();
        let stamp_without_picoseconds = Place {
            fine: false,
            ..place(1, 1000)
        };
        assert_eq!(coarse.admit(stamp_without_picoseconds), Ok(0));
        coarse.delivered(stamp_without_picoseconds);
        let next = Place {
            sequence: Some(2),
            ..stamp_without_picoseconds
        };
        assert_eq!(
            coarse.admit(next),
            Ok(0),
            "a coarse stamp may be shared by two samples"
        );
    }

    #[test]
    fn silence_is_told_once_and_ends_with_the_next_message() {
        let (mut reader, start) = reader();
        let timeout = Duration::from_secs(3);
        assert!(!reader.fell_silent(start + Duration::from_millis(2999), timeout));
        assert!(reader.fell_silent(start + timeout, timeout));
        assert!(!reader.fell_silent(start + timeout * 2, timeout));
        assert_eq!(reader.due(timeout), None);
        assert!(reader.heard(start + timeout * 3));
        assert!(!reader.heard(start + timeout * 3));
        assert!(reader.fell_silent(start + timeout * 4, timeout));
    }
}
