//! The rate limit for chunks.

use std::time::{Duration, Instant};

/// Spreads the chunks of large messages over time, so that they overrun neither a link nor the
/// socket buffer of a receiver. Messages in a single datagram are not limited.
///
/// The average rate is [`RATE`](Self::RATE), with bursts of up to [`BURST`](Self::BURST).
#[derive(Debug, Default)]
pub(crate) struct Pace {
    /// The time at which all sent bytes would have been transmitted at exactly `RATE`.
    done: Option<Instant>,
}

impl Pace {
    /// Bytes per second: below the capacity of a gigabit link.
    pub(crate) const RATE: u64 = 100_000_000;
    /// Bytes of a burst: the amount that accumulates while a timer is some milliseconds late. The
    /// socket buffers that the bridges request hold many times this amount; default socket buffers
    /// hold about half of it.
    const BURST: u64 = 256 << 10;

    /// Returns the time at which the next chunk may be sent.
    pub(crate) fn opens(&self) -> Option<Instant> {
        self.done?.checked_sub(Self::time_of(Self::BURST))
    }

    pub(crate) fn is_open(&self, now: Instant) -> bool {
        self.opens().is_none_or(|opens| opens <= now)
    }

    /// Records sent bytes.
    pub(crate) fn spend(&mut self, bytes: usize, now: Instant) {
        let time = Self::time_of(u64::try_from(bytes).unwrap_or(u64::MAX));
        let from = self.done.map_or(now, |done| done.max(now));
        self.done = Some(from + time);
    }

    /// Returns the transmission time of `bytes` bytes.
    pub(crate) fn time_of(bytes: u64) -> Duration {
        Duration::from_nanos(bytes.saturating_mul(1_000_000_000 / Self::RATE))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn a_burst_goes_at_once_and_the_rest_at_the_rate_however_late_the_timer_rings() {
        let start = Instant::now();
        let mut pace = Pace::default();
        let mut at_once = 0;
        while pace.is_open(start) {
            pace.spend(65_507, start);
            at_once += 65_507;
        }
        assert!(
            (262_144..262_144 + 65_507 + 1).contains(&at_once),
            "{at_once}"
        );
        let (mut now, mut sent) = (start, at_once);
        while sent < 10_000_000 {
            now = pace.opens().unwrap() + Duration::from_millis(1);
            while pace.is_open(now) {
                pace.spend(65_507, now);
                sent += 65_507;
            }
        }
        let took = now - start;
        assert!(
            (Duration::from_millis(90)..Duration::from_millis(101)).contains(&took),
            "{took:?}"
        );
    }
}
