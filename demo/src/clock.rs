//! The wall clock. All processes of the demo run on the same machine, so their timestamps are
//! comparable.

use std::time::{SystemTime, UNIX_EPOCH};

/// Returns the nanoseconds since 1970 UTC.
pub(crate) fn wall_nanos() -> i64 {
    #[expect(
        clippy::disallowed_methods,
        reason = "the one reading of the wall clock"
    )]
    let now = SystemTime::now();
    let since = now.duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Converts nanoseconds to milliseconds for people.
pub(crate) fn millis(nanos: i64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "a time for people to see")]
    let millis = nanos as f64 / 1e6;
    millis
}
