//! Timers, ordered by time.

use alloc::collections::BTreeSet;
use core::time::Duration;

/// A set with a timer per id.
#[derive(Debug)]
pub(super) struct Timers {
    at: BTreeSet<(Duration, u64)>,
}

impl Timers {
    pub(super) const fn new() -> Self {
        Self {
            at: BTreeSet::new(),
        }
    }

    /// Moves the timer of `id` from `wake` to `next`.
    pub(super) fn move_to(&mut self, id: u64, wake: &mut Duration, next: Duration) {
        self.at.remove(&(*wake, id));
        self.at.insert((next, id));
        *wake = next;
    }

    pub(super) fn remove(&mut self, id: u64, wake: Duration) {
        self.at.remove(&(wake, id));
    }

    /// Returns the time of the first timer.
    pub(super) fn next(&self) -> Option<Duration> {
        self.at.first().map(|(at, _)| *at)
    }

    /// Returns the id of the first timer if it is due.
    pub(super) fn due(&self, now: Duration) -> Option<u64> {
        let (at, id) = self.at.first()?;
        (*at <= now).then_some(*id)
    }
}
