//! The one place that reads clocks, and what follows from them: how often a repeated fault is logged.

use std::time::{Duration, SystemTime};

use tokio::time::Instant;

/// Wall clock time, for the stamp of a received message.
#[expect(
    clippy::disallowed_methods,
    reason = "the stamp of a message is taken where its last byte is read"
)]
pub(crate) fn utc() -> SystemTime {
    SystemTime::now()
}

/// Steady time, for time limits.
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// When a time limit ends. One too long for the clock ends so late that it is none.
pub(crate) fn after(start: Instant, limit: Duration) -> Instant {
    start.checked_add(limit).unwrap_or_else(|| start + FOREVER)
}

/// Thirty years: no clock that counts from the start of the machine ends before.
const FOREVER: Duration = Duration::from_secs(30 * 365 * 24 * 3600);

/// Lets one of a run of equal log lines through per period and counts the others.
#[derive(Debug)]
pub(crate) struct Throttle {
    period: Duration,
    last: Option<Instant>,
    suppressed: u64,
}

impl Throttle {
    pub(crate) const fn new(period: Duration) -> Self {
        Self {
            period,
            last: None,
            suppressed: 0,
        }
    }

    /// The number of lines held back since the last one, when this one is due.
    pub(crate) fn admit(&mut self, now: Instant) -> Option<u64> {
        let due = self
            .last
            .is_none_or(|last| now.duration_since(last) >= self.period);
        if due {
            self.last = Some(now);
            Some(std::mem::take(&mut self.suppressed))
        } else {
            self.suppressed += 1;
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_longer_than_the_clock_is_far_away_and_no_fault() {
        let start = now();
        assert_eq!(
            after(start, Duration::from_secs(3)),
            start + Duration::from_secs(3)
        );
        let year = Duration::from_secs(365 * 24 * 3600);
        assert!(after(start, Duration::MAX) > start + year);
        // Ends that are computed from one another stay in range as well.
        assert!(after(after(start, Duration::MAX), Duration::MAX) > start + year);
    }

    #[test]
    fn one_line_per_period_passes_and_tells_how_many_did_not() {
        let start = now();
        let mut throttle = Throttle::new(Duration::from_secs(10));
        assert_eq!(throttle.admit(start), Some(0));
        assert_eq!(throttle.admit(start + Duration::from_secs(1)), None);
        assert_eq!(throttle.admit(start + Duration::from_secs(9)), None);
        assert_eq!(throttle.admit(start + Duration::from_secs(10)), Some(2));
    }
}
