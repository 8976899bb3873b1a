//! Limits for state that any sender on the network can create.

use std::time::{Duration, Instant};

/// A limit for items that any sender can create, such as names of topics. When the limit is
/// reached, the owner looks for items to remove. Because this takes time, it happens at most once
/// per interval instead of for each new item.
#[derive(Debug, Clone)]
pub struct Room {
    most: usize,
    left: usize,
    /// The earliest time of the next search.
    look_at: Option<Instant>,
}

impl Room {
    /// Creates a limit of `most` items.
    #[must_use]
    pub const fn new(most: usize) -> Self {
        Self {
            most,
            left: most,
            look_at: None,
        }
    }

    /// Returns whether the owner should look for items to remove: the limit is reached, and the
    /// interval after the last search has passed.
    #[must_use]
    pub fn wants_look(&self, now: Instant) -> bool {
        self.left == 0 && self.look_at.is_none_or(|at| now >= at)
    }

    /// Records a search of the owner that left `there` items.
    pub fn looked(&mut self, there: usize, now: Instant) {
        self.left = self.most.saturating_sub(there);
        self.look_at = Some(now + LOOK_AGAIN);
    }

    /// Takes a free item. Returns false if the limit is reached.
    #[must_use]
    pub const fn take(&mut self) -> bool {
        match self.left.checked_sub(1) {
            Some(left) => {
                self.left = left;
                true
            }
            None => false,
        }
    }
}

const LOOK_AGAIN: Duration = Duration::from_secs(1);
