//! The only module that reads the clocks.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

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
