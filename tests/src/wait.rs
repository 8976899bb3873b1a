//! Waits for conditions, with a timeout.

use std::time::{Duration, Instant};

const POLL: Duration = Duration::from_millis(5);

/// Polls `condition` until it returns a value, and returns this value.
///
/// # Panics
/// Panics after `deadline`, with the text `what` in the message.
pub fn eventually<T>(
    what: &str,
    deadline: Duration,
    mut condition: impl FnMut() -> Option<T>,
) -> T {
    let start = Instant::now();
    loop {
        if let Some(answer) = condition() {
            return answer;
        }
        assert!(
            start.elapsed() < deadline,
            "within {deadline:?} this did not happen: {what}"
        );
        std::thread::sleep(POLL);
    }
}

/// Checks that a condition stays true for the whole of `window`, which is the only way to see that
/// nothing happens.
///
/// # Panics
/// Panics as soon as `condition` is false, with the text `what` in the message.
pub fn holds_for(what: &str, window: Duration, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while start.elapsed() < window {
        assert!(
            condition(),
            "after {:?} this was no longer so: {what}",
            start.elapsed()
        );
        std::thread::sleep(POLL);
    }
}
