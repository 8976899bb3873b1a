//! Reads the clocks.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Returns the time of the monotonic clock.
#[expect(
    clippy::disallowed_methods,
    reason = "limits of log lines need a clock"
)]
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// Returns the fault of the clock of this host, if it is not set.
#[expect(clippy::disallowed_methods, reason = "whether the clock is set")]
pub(crate) fn fault_of_host() -> Option<String> {
    fault(SystemTime::now())
}

/// Returns the fault of a clock that is not set, such as the clock of a computer without a battery
/// before it has reached a time server. Values then get wrong times, and certificates of other
/// participants are not valid yet.
fn fault(at: SystemTime) -> Option<String> {
    (at < UNIX_EPOCH + PLAUSIBLE).then(|| {
        "the clock of this host is not set (it shows a date before 2026): timestamps of values are wrong, \
         and certificates of other programs are not valid yet; set the clock, or wait for the time server"
            .to_owned()
    })
}

/// The first day that a clock can show: 2026-01-01, before this version was made.
const PLAUSIBLE: Duration = Duration::from_secs(1_767_225_600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_starts_in_1970_is_a_fault_until_it_is_set() {
        let day = Duration::from_secs(86_400);
        assert!(fault(UNIX_EPOCH + day).is_some());
        assert_eq!(fault(UNIX_EPOCH + PLAUSIBLE), None);
    }
}
