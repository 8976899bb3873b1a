//! The only module that reads the clocks.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bridge_core::Now;
use uadp::Timestamp;

/// Reads both clocks.
#[must_use]
#[expect(clippy::disallowed_methods, reason = "the shell's one clock read")]
pub fn now() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: timestamp(SystemTime::now()),
    }
}

/// Converts a system time to an OPC UA time. Times before 1970 become 1970.
#[must_use]
pub fn timestamp(at: SystemTime) -> Timestamp {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_unix_nanos(i128::try_from(since.as_nanos()).unwrap_or(i128::MAX))
}

/// Returns the fault of a clock that is not set, such as the clock of a computer without a battery
/// before it has reached a time server. Values then get wrong times, and certificates of other
/// participants are not valid yet.
#[must_use]
pub(crate) fn fault(utc: Timestamp) -> Option<String> {
    let first_day = timestamp(UNIX_EPOCH + PLAUSIBLE);
    (utc < first_day).then(|| {
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
        assert!(fault(timestamp(UNIX_EPOCH + day)).is_some());
        assert_eq!(fault(timestamp(UNIX_EPOCH + PLAUSIBLE)), None);
    }
}
