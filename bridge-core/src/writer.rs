//! What is remembered of one DataSetWriter of our own space.

use std::time::{Duration, Instant};

use uadp::Timestamp;

/// The state of a topic we send.
#[derive(Debug)]
pub(crate) struct Writer {
    /// The sequence number of the next DataSetMessage.
    sequence: u16,
    /// When the last sample was taken, as its message says.
    taken: Option<Timestamp>,
    /// When anything was last sent for it.
    sent: Instant,
    /// When its value was last sent.
    value_sent: Instant,
    /// Whether the topic has a producer. Without one nothing is repeated, so that readers see it fall silent.
    live: bool,
    /// The last sample as it went out, for repeating. `None` for topics of events, and before the first sample.
    last: Option<Encoded>,
    /// Whether anything was sent at all.
    started: bool,
}

/// A NetworkMessage with one DataSetMessage, and where its numbers stand.
#[derive(Debug, Clone, Default)]
pub(crate) struct Encoded {
    pub(crate) bytes: Vec<u8>,
    /// Position of the NetworkMessage Timestamp, which PicoSeconds follow.
    pub(crate) timestamp_at: usize,
    /// Position of the DataSetMessage's sequence number.
    pub(crate) sequence_at: usize,
}

/// What a writer does next, left alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Idle {
    Repeat,
    KeepAlive,
}

impl Encoded {
    /// Sets the NetworkMessage Timestamp and PicoSeconds.
    pub(crate) fn stamp(&mut self, at: Timestamp) {
        patch(&mut self.bytes, self.timestamp_at, &at.time.0.to_le_bytes());
        patch(
            &mut self.bytes,
            self.timestamp_at + 8,
            &at.picoseconds.to_le_bytes(),
        );
    }

    fn number(&mut self, sequence: u16) {
        patch(&mut self.bytes, self.sequence_at, &sequence.to_le_bytes());
    }
}

impl Writer {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            sequence: 0,
            taken: None,
            sent: now,
            value_sent: now,
            live: true,
            last: None,
            started: false,
        }
    }

    /// The number for the next DataSetMessage.
    pub(crate) const fn next_sequence(&mut self) -> u16 {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        sequence
    }

    /// The stamp for a sample taken at `taken`: that, or just after the sample before if it is not later.
    ///
    /// Two samples never share a stamp, since readers know repetitions by it. A clock that was set back is followed.
    pub(crate) fn stamp(&mut self, taken: Timestamp) -> Timestamp {
        let stamp = match self.taken.map(|last| last.unix_nanos()) {
            Some(last) if (0..STEP_BACK).contains(&(last - taken.unix_nanos())) => {
                Timestamp::from_unix_nanos(last + 1)
            }
            _ => taken,
        };
        self.taken = Some(stamp);
        stamp
    }

    /// The number a keep-alive carries: that of the next message to expect (OPC 10000-14 7.2.4.5.8).
    pub(crate) const fn expected_sequence(&self) -> u16 {
        self.sequence
    }

    /// Takes note of a sample sent; `keep` for topics whose last value is repeated.
    pub(crate) fn sent(&mut self, sample: &Encoded, keep: bool, now: Instant) {
        self.sent = now;
        self.value_sent = now;
        self.live = true;
        self.started = true;
        if keep {
            let last = self.last.get_or_insert_default();
            last.bytes.clone_from(&sample.bytes);
            last.timestamp_at = sample.timestamp_at;
            last.sequence_at = sample.sequence_at;
        }
    }

    pub(crate) const fn sent_keep_alive(&mut self, now: Instant) {
        self.sent = now;
    }

    /// The last sample with a fresh sequence number, to be sent again.
    pub(crate) fn repeat(&mut self, now: Instant, mut buffer: Vec<u8>) -> Option<Encoded> {
        let sequence = self.sequence;
        let last = self.last.as_ref()?;
        buffer.clone_from(&last.bytes);
        let mut again = Encoded {
            bytes: buffer,
            ..*last
        };
        again.number(sequence);
        self.sequence = sequence.wrapping_add(1);
        self.sent = now;
        self.value_sent = now;
        Some(again)
    }

    pub(crate) const fn set_live(&mut self, live: bool) {
        self.live = live;
    }

    /// When the writer has to speak again, and how.
    pub(crate) fn due(
        &self,
        key_frames: Duration,
        keep_alives: Duration,
    ) -> Option<(Instant, Idle)> {
        if !self.live || !self.started {
            return None;
        }
        let keep_alive = (self.sent + keep_alives, Idle::KeepAlive);
        let repeat = (self.value_sent + key_frames, Idle::Repeat);
        // A repeated key frame says all that a keep-alive says.
        let repeats_first = self.last.is_some() && repeat.0 <= keep_alive.0;
        Some(if repeats_first { repeat } else { keep_alive })
    }
}

/// Samples of one topic come from several publishers, whose stamps may cross by as much; in nanoseconds.
const STEP_BACK: i128 = 1_000_000_000;

fn patch(bytes: &mut [u8], at: usize, with: &[u8]) {
    if let Some(place) = bytes.get_mut(at..at.saturating_add(with.len())) {
        place.copy_from_slice(with);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Encoded {
        Encoded {
            bytes: vec![0; 20],
            timestamp_at: 2,
            sequence_at: 16,
        }
    }

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn writer() -> (Writer, Instant) {
        let now = Instant::now();
        (Writer::new(now), now)
    }

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_repetition_has_a_number_of_its_own_and_the_same_value() {
        let (mut writer, now) = writer();
        assert_eq!(writer.next_sequence(), 0);
        writer.sent(&sample(), true, now);
        let again = writer.repeat(now + SECOND, Vec::new()).unwrap();
        assert_eq!(again.bytes[16..18], [1, 0]);
        assert_eq!(writer.expected_sequence(), 2);
    }

    #[test]
    fn values_are_repeated_with_keep_alives_between_when_those_are_more_frequent() {
        let (mut writer, now) = writer();
        assert_eq!(
            writer.due(SECOND, SECOND),
            None,
            "nothing to repeat before the first value"
        );
        writer.sent(&sample(), true, now);
        assert_eq!(
            writer.due(SECOND, SECOND),
            Some((now + SECOND, Idle::Repeat))
        );
        assert_eq!(
            writer.due(SECOND * 2, SECOND),
            Some((now + SECOND, Idle::KeepAlive))
        );
        writer.sent_keep_alive(now + SECOND);
        assert_eq!(
            writer.due(SECOND * 2, SECOND),
            Some((now + SECOND * 2, Idle::Repeat))
        );
    }

    #[test]
    fn events_are_not_repeated_and_a_topic_without_producer_falls_silent() {
        let (mut writer, now) = writer();
        writer.sent(&sample(), false, now);
        assert_eq!(
            writer.due(SECOND, SECOND),
            Some((now + SECOND, Idle::KeepAlive))
        );
        writer.set_live(false);
        assert_eq!(writer.due(SECOND, SECOND), None);
        writer.sent(&sample(), false, now);
        assert!(
            writer.due(SECOND, SECOND).is_some(),
            "a sample shows that it has one again"
        );
    }

    #[test]
    fn two_samples_never_share_a_stamp_and_a_clock_set_back_is_followed() {
        let (mut writer, _) = writer();
        let at = |nanos: i128| Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + nanos);
        let stamps = [5, 5, 3, 900].map(|nanos| writer.stamp(at(nanos)));
        assert_eq!(stamps, [at(5), at(6), at(7), at(900)]);
        let an_hour_back = at(-3_600_000_000_000);
        assert_eq!(writer.stamp(an_hour_back), an_hour_back);
    }

    #[test]
    fn the_send_time_is_written_where_the_header_has_it() {
        let mut encoded = sample();
        encoded.stamp(Timestamp {
            time: uadp::DateTime(0x0102),
            picoseconds: 0x0304,
        });
        assert_eq!(encoded.bytes[2..12], [2, 1, 0, 0, 0, 0, 0, 0, 4, 3]);
    }
}
