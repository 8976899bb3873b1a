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
    fn one_line_per_period_passes_and_tells_how_many_did_not() {
        let start = now();
        let mut throttle = Throttle::new(Duration::from_secs(10));
        assert_eq!(throttle.admit(start), Some(0));
        assert_eq!(throttle.admit(start + Duration::from_secs(1)), None);
        assert_eq!(throttle.admit(start + Duration::from_secs(9)), None);
        assert_eq!(throttle.admit(start + Duration::from_secs(10)), Some(2));
    }
}
