//! The only module that reads clocks.

use std::time::{Duration, SystemTime};

use tokio::time::Instant;

/// Returns the wall clock time, for the stamp of a received message.
#[expect(
    clippy::disallowed_methods,
    reason = "the stamp of a message is taken where its last byte is read"
)]
pub(crate) fn utc() -> SystemTime {
    SystemTime::now()
}

/// Returns the steady time, for time limits.
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// Returns the end of a time limit. A limit that exceeds the range of the clock ends in thirty
/// years, which is effectively never.
pub(crate) fn after(start: Instant, limit: Duration) -> Instant {
    start.checked_add(limit).unwrap_or_else(|| start + FOREVER)
}

/// Thirty years, which is within the range of every clock that counts from the start of the
/// machine.
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
        // Ends that are computed from other ends stay in range as well.
        assert!(after(after(start, Duration::MAX), Duration::MAX) > start + year);
    }
}
