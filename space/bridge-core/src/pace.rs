//! How fast chunks go out.

use std::time::{Duration, Instant};

/// Spreads the chunks of large messages over time, so that they overrun neither a link nor a receiver's socket
/// buffer. What fits into one datagram is not paced.
///
/// The pace is [`RATE`](Self::RATE) on average, with up to [`BURST`](Self::BURST) ahead of it.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    /// When all that was sent would have gone out at just the rate.
    done: Option<Instant>,
}

impl Pace {
    /// Bytes per second: what a gigabit link carries with something to spare.
    pub(crate) const RATE: u64 = 100_000_000;
    /// Bytes that may go at once: what accumulates while a timer rings some milliseconds late. The socket buffers the
    /// bridges ask for hold many times that; those a system grants by default hold about half of it.
    const BURST: u64 = 256 << 10;

    /// When the next chunk may go.
    pub(crate) fn opens(&self) -> Option<Instant> {
        self.done?.checked_sub(Self::time_of(Self::BURST))
    }

    pub(crate) fn is_open(&self, now: Instant) -> bool {
        self.opens().is_none_or(|opens| opens <= now)
    }

    /// Takes note of bytes sent.
    pub(crate) fn spend(&mut self, bytes: usize, now: Instant) {
        let time = Self::time_of(u64::try_from(bytes).unwrap_or(u64::MAX));
        let from = self.done.map_or(now, |done| done.max(now));
        self.done = Some(from + time);
    }

    /// How long so many bytes take.
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
