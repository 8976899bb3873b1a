//! Room for what whoever is on the network can make up.

use std::time::{Duration, Instant};

/// Places for things that strangers can make up, such as names of topics. When they are used up, the owner looks which of
/// those there are can go, but not at every stranger that comes: looking takes time.
#[derive(Debug, Clone)]
pub struct Room {
    most: usize,
    left: usize,
    /// When the owner may look again.
    look_at: Option<Instant>,
}

impl Room {
    /// As many places.
    #[must_use]
    pub const fn new(most: usize) -> Self {
        Self {
            most,
            left: most,
            look_at: None,
        }
    }

    /// Whether it is time to look what can go: no place is left, and the last look was a while ago.
    #[must_use]
    pub fn wants_look(&self, now: Instant) -> bool {
        self.left == 0 && self.look_at.is_none_or(|at| now >= at)
    }

    /// The owner looked: so many are there now.
    pub fn looked(&mut self, there: usize, now: Instant) {
        self.left = self.most.saturating_sub(there);
        self.look_at = Some(now + LOOK_AGAIN);
    }

    /// Takes a place, if one is left.
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
