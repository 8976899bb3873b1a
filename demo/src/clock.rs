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
