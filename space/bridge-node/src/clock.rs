//! The one place that reads the clocks.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bridge_core::Now;
use uadp::Timestamp;

/// Both clocks, now.
#[must_use]
#[expect(clippy::disallowed_methods, reason = "the shell's one clock read")]
pub fn now() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: timestamp(SystemTime::now()),
    }
}

/// A system time as OPC UA has it. Times before 1970 are taken as 1970.
#[must_use]
pub fn timestamp(at: SystemTime) -> Timestamp {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_unix_nanos(i128::try_from(since.as_nanos()).unwrap_or(i128::MAX))
}

/// Returns the fault of a clock that is not set, such as that of a computer without a battery before it has asked a
/// time server. Values get wrong times then, and certificates of others are not valid yet.
#[must_use]
pub(crate) fn fault(utc: Timestamp) -> Option<String> {
    let first_day = timestamp(UNIX_EPOCH + PLAUSIBLE);
    (utc < first_day).then(|| {
        "the clock of this computer is not set (it shows a day before 2026): times of values are wrong, and certificates of \
         others are not valid yet; set it, or wait for the time server"
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
