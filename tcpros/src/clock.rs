//! The one place that reads clocks.

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
}
