//! The rate limit for chunks.

use std::time::{Duration, Instant};

use crate::settings::LinkCapacity;

/// Spreads the chunks of large messages over time, so that they overrun neither a link nor the
/// socket buffer of a receiver. Messages in a single datagram are not limited.
///
/// It is a token bucket: the average rate and the size of a burst follow from the [`LinkCapacity`].
#[derive(Debug)]
pub(crate) struct ChunkPace {
    /// Bytes per second.
    rate: u64,
    /// Bytes of a burst.
    burst: u64,
    /// The time at which all sent bytes would have been transmitted at exactly `rate`.
    done: Option<Instant>,
}

impl Default for ChunkPace {
    fn default() -> Self {
        Self {
            rate: Self::RATE,
            burst: Self::BURST,
            done: None,
        }
    }
}

impl ChunkPace {
    /// Bytes per second on a link of unknown speed: below the capacity of a gigabit link.
    const RATE: u64 = 100_000_000;
    /// Bytes of a burst on a link: the amount that accumulates while a timer is some milliseconds
    /// late. The socket buffers that the bridges request hold many times this amount; default
    /// socket buffers hold about half of it.
    const BURST: u64 = 256 << 10;
    /// The number of pauses of 16 ms in a second: a receiver on this host may pause for that time
    /// without a loss.
    const PAUSES: u64 = 62;
    /// The share of a receive buffer that a burst may take. Other senders need room, too.
    const SHARE: u64 = 4;

    /// Adopts the rate and the burst of a link.
    pub(crate) fn follow(&mut self, link: LinkCapacity) {
        (self.rate, self.burst) = match link {
            LinkCapacity::Unknown => (Self::RATE, Self::BURST),
            // A fifth of the link is left to other datagrams and to headers.
            LinkCapacity::Wire { speed } => ((speed / 5 * 4).clamp(1, Self::RATE), Self::BURST),
            LinkCapacity::Host { receive_buffer } => (
                receive_buffer.saturating_mul(Self::PAUSES).max(Self::RATE),
                (receive_buffer / Self::SHARE).max(Self::BURST),
            ),
        };
    }

    /// Returns the time at which the next chunk may be sent.
    pub(crate) fn opens(&self) -> Option<Instant> {
        self.done?.checked_sub(Self::time_at(self.rate, self.burst))
    }

    pub(crate) fn is_open(&self, now: Instant) -> bool {
        self.opens().is_none_or(|opens| opens <= now)
    }

    /// Records sent bytes.
    pub(crate) fn spend(&mut self, bytes: usize, now: Instant) {
        let time = Self::time_at(self.rate, u64::try_from(bytes).unwrap_or(u64::MAX));
        let from = self.done.map_or(now, |done| done.max(now));
        self.done = Some(from + time);
    }

    /// Returns the transmission time of `bytes` bytes on a link of unknown speed.
    pub(crate) fn time_of(bytes: u64) -> Duration {
        Self::time_at(Self::RATE, bytes)
    }

    fn time_at(rate: u64, bytes: u64) -> Duration {
        let nanoseconds = u128::from(bytes) * 1_000_000_000 / u128::from(rate.max(1));
        Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHUNK: usize = 65_507;

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn start() -> Instant {
        Instant::now()
    }

    fn pace(link: LinkCapacity) -> ChunkPace {
        let mut pace = ChunkPace::default();
        pace.follow(link);
        pace
    }

    /// Sends chunks while the pace is open, and returns the number of bytes.
    fn fill(pace: &mut ChunkPace, now: Instant) -> usize {
        let mut sent = 0;
        while pace.is_open(now) {
            pace.spend(CHUNK, now);
            sent += CHUNK;
        }
        sent
    }

    /// Sends `bytes` bytes with a timer that is `late`, and returns the time taken and the largest
    /// burst.
    fn send(pace: &mut ChunkPace, bytes: usize, late: Duration) -> (Duration, usize) {
        let start = start();
        let mut largest = fill(pace, start);
        let (mut now, mut sent) = (start, largest);
        while sent < bytes {
            now = pace.opens().unwrap() + late;
            let burst = fill(pace, now);
            largest = largest.max(burst);
            sent += burst;
        }
        (now - start, largest)
    }

    const LATE: Duration = Duration::from_millis(1);

    #[test]
    fn a_burst_goes_at_once_and_the_rest_at_the_rate_however_late_the_timer_rings() {
        let (took, largest) = send(&mut pace(LinkCapacity::Unknown), 10_000_000, LATE);
        assert!(
            (262_144..262_144 + CHUNK + 1).contains(&largest),
            "{largest}"
        );
        assert!(
            (Duration::from_millis(90)..Duration::from_millis(101)).contains(&took),
            "{took:?}"
        );
    }

    #[test]
    fn on_this_host_a_receiver_may_pause_for_16_ms_and_a_burst_takes_a_quarter_of_its_buffer() {
        let receive_buffer = 4 << 20;
        let mut pace = pace(LinkCapacity::Host { receive_buffer });
        let (took, largest) = send(&mut pace, 5_000_000, LATE);
        assert!(
            (1 << 20..(1 << 20) + CHUNK + 1).contains(&largest),
            "{largest}"
        );
        // 260 MB/s behind the burst.
        assert!(
            (Duration::from_millis(13)..Duration::from_millis(17)).contains(&took),
            "{took:?}"
        );
    }

    #[test]
    fn a_small_receive_buffer_and_a_fast_link_keep_the_rate_of_an_unknown_link() {
        for link in [
            LinkCapacity::Host {
                receive_buffer: 106_496,
            },
            LinkCapacity::Wire {
                speed: 1_250_000_000,
            },
        ] {
            let (took, _) = send(&mut pace(link), 10_000_000, LATE);
            assert!(
                (Duration::from_millis(90)..Duration::from_millis(101)).contains(&took),
                "{link:?}: {took:?}"
            );
        }
    }

    #[test]
    fn a_slow_link_gets_four_fifths_of_its_speed_and_no_division_fails_without_speed() {
        let (took, _) = send(
            &mut pace(LinkCapacity::Wire { speed: 12_500_000 }),
            1_000_000,
            LATE,
        );
        assert!(
            (Duration::from_millis(67)..Duration::from_millis(77)).contains(&took),
            "{took:?}"
        );
        let mut stopped = pace(LinkCapacity::Wire { speed: 0 });
        assert!(fill(&mut stopped, start()) > 0);
    }
}
