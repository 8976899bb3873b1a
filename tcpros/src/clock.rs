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

/// Lets one of a run of equal log lines through per period, or a few, and counts the others.
#[derive(Debug)]
pub(crate) struct Throttle {
    period: Duration,
    most: u32,
    /// When the period began, and how many lines it has let through.
    began: Option<(Instant, u32)>,
    suppressed: u64,
}

impl Throttle {
    pub(crate) const fn new(period: Duration) -> Self {
        Self::several(1, period)
    }

    /// Lets so many through per period.
    pub(crate) const fn several(most: u32, period: Duration) -> Self {
        Self {
            period,
            most,
            began: None,
            suppressed: 0,
        }
    }

    /// The number of lines held back since the last one, when this one is due.
    pub(crate) fn admit(&mut self, now: Instant) -> Option<u64> {
        let (began, used) = match self.began {
            Some((began, used)) if now.duration_since(began) < self.period => (began, used),
            _ => (now, 0),
        };
        if used < self.most {
            self.began = Some((began, used + 1));
            Some(std::mem::take(&mut self.suppressed))
        } else {
            self.suppressed += 1;
            None
        }
    }

    /// How many were held back since the last one.
    pub(crate) const fn suppressed(&self) -> u64 {
        self.suppressed
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

    #[test]
    fn of_several_per_period_the_rest_is_counted() {
        let start = now();
        let mut throttle = Throttle::several(2, Duration::from_secs(10));
        let lines = [0, 1, 2, 9].map(|at| throttle.admit(start + Duration::from_secs(at)));
        assert_eq!(lines, [Some(0), Some(0), None, None]);
        assert_eq!(throttle.suppressed(), 2);
        let lines = [10, 11, 12].map(|at| throttle.admit(start + Duration::from_secs(at)));
        assert_eq!(lines, [Some(2), Some(0), None]);
    }
}
