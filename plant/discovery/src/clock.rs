//! The only module that reads the clocks.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Returns the monotonic time, for waiting.
#[expect(clippy::disallowed_methods, reason = "the shell's one clock read")]
pub(crate) fn now() -> Instant {
    Instant::now()
}

/// Returns the wall-clock time, for messages and protocols.
#[expect(clippy::disallowed_methods, reason = "the shell's one clock read")]
pub(crate) fn wall() -> SystemTime {
    SystemTime::now()
}

/// Returns a time as an OPC UA DateTime, in 100 ns since 1601.
pub(crate) fn ticks(at: SystemTime) -> i64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default() + TO_1970;
    i64::try_from(since.as_nanos() / 100).unwrap_or(i64::MAX)
}

/// Returns a time in milliseconds since 1970.
pub(crate) fn millis(at: SystemTime) -> u64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// Returns the time of an OPC UA DateTime.
pub(crate) fn of_ticks(ticks: i64) -> SystemTime {
    let nanos = u128::try_from(ticks).unwrap_or_default() * 100;
    let since = Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX));
    UNIX_EPOCH + since.saturating_sub(TO_1970)
}

/// From 1601 to 1970.
const TO_1970: Duration = Duration::from_secs(11_644_473_600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_those_of_opc_ua() {
        let at = UNIX_EPOCH + Duration::from_millis(1_000_000_000_123);
        assert_eq!(ticks(at), 126_444_736_001_230_000);
        assert_eq!(of_ticks(ticks(at)), at);
        assert_eq!(millis(at), 1_000_000_000_123);
    }
}
