//! The clocks of the senders in the group, as far as their messages show them.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use uadp::Timestamp;

use crate::settings::Now;

/// The clocks of the senders in the group.
///
/// For each sender, the smallest difference between the arrival and the sending of its messages is
/// kept: the offset of its clock plus the shortest delay of the network. A message that the network
/// held back is recognised by a larger difference. No clocks of two hosts are compared.
#[derive(Debug)]
pub(crate) struct SenderClocks {
    /// The origin of the arrival times.
    start: Instant,
    senders: HashMap<SocketAddr, SenderClock>,
}

#[derive(Debug)]
struct SenderClock {
    /// The time of the first message.
    since: Instant,
    /// The begin of the current window.
    window: Instant,
    /// The smallest differences in nanoseconds in the current and in the previous window.
    smallest: i128,
    before: Option<i128>,
    /// The time of the last message.
    last: Instant,
}

impl SenderClocks {
    pub(crate) fn new(now: Now) -> Self {
        Self {
            start: now.monotonic,
            senders: HashMap::new(),
        }
    }

    /// Records the arrival of a message. Call it after the message was processed, so that a message
    /// is not compared with itself.
    pub(crate) fn note(&mut self, from: SocketAddr, sent: Timestamp, now: Instant) {
        let difference = self.since_start(now) - sent.unix_nanos();
        if let Some(clock) = self.senders.get_mut(&from) {
            if now.saturating_duration_since(clock.window) >= WINDOW {
                clock.before = Some(clock.smallest);
                (clock.window, clock.smallest) = (now, difference);
            }
            clock.smallest = clock.smallest.min(difference);
            clock.last = now;
            return;
        }
        if self.senders.len() >= MOST_SENDERS {
            let oldest = self.senders.iter().min_by_key(|(_, clock)| clock.last);
            if let Some(oldest) = oldest.map(|(from, _)| *from) {
                self.senders.remove(&oldest);
            }
        }
        let clock = SenderClock {
            since: now,
            window: now,
            smallest: difference,
            before: None,
            last: now,
        };
        self.senders.insert(from, clock);
    }

    /// Returns the time at which the sender sent a message, plus the shortest delay of the network.
    /// `None` if no message of the sender arrived before `known`.
    pub(crate) fn sent_at(
        &self,
        from: SocketAddr,
        sent: Timestamp,
        known: Instant,
    ) -> Option<SentAt> {
        let clock = self.senders.get(&from).filter(|of| of.since < known)?;
        let smallest = clock.before.unwrap_or(i128::MAX).min(clock.smallest);
        let since = sent.unix_nanos().checked_add(smallest)?;
        Some(match u64::try_from(since) {
            Ok(since) => SentAt::Since(self.start.checked_add(Duration::from_nanos(since))?),
            Err(_) => SentAt::BeforeStart,
        })
    }

    fn since_start(&self, now: Instant) -> i128 {
        let since = now.saturating_duration_since(self.start);
        i128::try_from(since.as_nanos()).unwrap_or(i128::MAX)
    }
}

/// The time of sending on the own clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SentAt {
    /// Before the start of this program.
    BeforeStart,
    /// At this time.
    Since(Instant),
}

/// The time for which a smallest difference counts at least. Clocks drift apart by less than a
/// millisecond in this time.
const WINDOW: Duration = Duration::from_secs(5);
/// The maximum number of senders. It is limited, because any sender in an unsecured group can send.
const MOST_SENDERS: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn start() -> Now {
        Now {
            monotonic: Instant::now(),
            utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
        }
    }

    const MS: i128 = 1_000_000;
    /// The sender's clock is far ahead.
    const AHEAD: i128 = 1_900_000_000_000_000_000;

    fn from() -> SocketAddr {
        ([10, 0, 0, 7], 4_000).into()
    }

    fn sent(ms: i128) -> Timestamp {
        Timestamp::from_unix_nanos(AHEAD + ms * MS)
    }

    #[test]
    fn a_message_that_the_network_held_back_has_its_time_of_sending() {
        let start = start();
        let at = |ms: u64| start.monotonic + Duration::from_millis(ms);
        let mut clocks = SenderClocks::new(start);
        // The delays are 3, 1 and 200 ms.
        clocks.note(from(), sent(100), at(103));
        clocks.note(from(), sent(200), at(201));
        clocks.note(from(), sent(300), at(500));
        let sent_at = |ms: i128| clocks.sent_at(from(), sent(ms), at(600));
        assert_eq!(sent_at(550), Some(SentAt::Since(at(551))));
        assert_eq!(sent_at(-10), Some(SentAt::BeforeStart));
        let unknown = SocketAddr::from(([10, 0, 0, 8], 4_000));
        assert_eq!(clocks.sent_at(unknown, sent(550), at(600)), None);
        assert_eq!(clocks.sent_at(from(), sent(550), at(103)), None);
    }

    #[test]
    fn a_clock_that_was_set_back_is_followed_after_two_windows() {
        let start = start();
        let at = |ms: u64| start.monotonic + Duration::from_millis(ms);
        let mut clocks = SenderClocks::new(start);
        clocks.note(from(), sent(0), at(1));
        for ms in (1_000..12_000).step_by(500) {
            clocks.note(from(), sent(i128::from(ms) - 700), at(ms + 1));
        }
        let found = clocks.sent_at(from(), sent(11_300), at(20_000));
        assert_eq!(found, Some(SentAt::Since(at(12_001))));
    }

    #[test]
    fn the_senders_are_limited_and_the_oldest_gives_way() {
        let start = start();
        let at = |ms: u64| start.monotonic + Duration::from_millis(ms);
        let mut clocks = SenderClocks::new(start);
        let address = |number: u16| SocketAddr::from(([10, 0, 0, 9], number));
        for number in 0..300 {
            clocks.note(address(number), sent(1), at(u64::from(number)));
        }
        assert_eq!(clocks.senders.len(), MOST_SENDERS);
        assert_eq!(clocks.sent_at(address(0), sent(1), at(900)), None);
        assert!(clocks.sent_at(address(299), sent(1), at(900)).is_some());
    }
}
