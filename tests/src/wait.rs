//! Waiting for a condition, with an end.

use std::time::{Duration, Instant};

const POLL: Duration = Duration::from_millis(5);

/// Asks `condition` until it answers, and gives the answer.
///
/// # Panics
/// After `deadline`, with `what` in the message.
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

/// Watches a condition that has to stay true for the whole of `window`: the one way to see that nothing happens.
///
/// # Panics
/// As soon as `condition` is false, with `what` in the message.
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
