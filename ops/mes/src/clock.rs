//! The time of this host, in ms since 1970.

use std::time::SystemTime;

/// Returns the time in ms since 1970.
#[expect(
    clippy::disallowed_methods,
    reason = "this is the shell; what plans and records takes its time from here"
)]
pub(crate) fn now() -> u64 {
    since_1970(SystemTime::now())
}

/// Converts a time to ms since 1970.
pub(crate) fn since_1970(at: SystemTime) -> u64 {
    let since = at
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}
