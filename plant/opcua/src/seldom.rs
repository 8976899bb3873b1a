//! What peers bring about again and again, told seldom: a client in a loop must not fill the log.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Tells the same thing once in a while, and counts it meanwhile.
#[derive(Debug)]
pub struct Seldom {
    every: Duration,
    /// When each was told last, and how often it was not since.
    told: HashMap<String, (Instant, u64)>,
}

impl Seldom {
    /// One that tells the same thing once in that time.
    #[must_use]
    pub fn every(every: Duration) -> Self {
        Self {
            every,
            told: HashMap::new(),
        }
    }

    /// Whether something is to be told now: then how often it was not told since it was last. Of more than [`MOST`] things in
    /// that time the others are not told.
    pub fn another(&mut self, what: &str, now: Instant) -> Option<u64> {
        let is_soon = |told: Instant| now.saturating_duration_since(told) < self.every;
        if let Some((told, untold)) = self.told.get_mut(what) {
            if is_soon(*told) {
                *untold += 1;
                return None;
            }
            *told = now;
            return Some(std::mem::take(untold));
        }
        if self.told.len() >= MOST {
            self.told.retain(|_, (told, _)| is_soon(*told));
        }
        if self.told.len() >= MOST {
            return None;
        }
        self.told.insert(what.to_owned(), (now, 0));
        Some(0)
    }
}

/// So many things are told apart.
pub const MOST: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_is_told_once_in_that_time_with_the_number_of_the_others() {
        let (mut seldom, first) = (
            Seldom::every(Duration::from_secs(1)),
            tokio::time::Instant::now().into_std(),
        );
        let after = |ms| first + Duration::from_millis(ms);
        assert_eq!(seldom.another("a", first), Some(0));
        assert_eq!(seldom.another("a", after(1)), None);
        assert_eq!(
            seldom.another("b", after(2)),
            Some(0),
            "another one is told"
        );
        assert_eq!(seldom.another("a", after(999)), None);
        assert_eq!(seldom.another("a", after(1000)), Some(2));
        assert_eq!(seldom.another("a", after(3000)), Some(0));
    }

    #[test]
    fn ever_other_things_take_up_no_more_room_and_are_told_again_later() {
        let (mut seldom, first) = (
            Seldom::every(Duration::from_secs(1)),
            tokio::time::Instant::now().into_std(),
        );
        let told =
            (0..10_000).filter(|number| seldom.another(&number.to_string(), first).is_some());
        assert_eq!(told.count(), MOST);
        let later = first + Duration::from_secs(2);
        assert_eq!(seldom.another("10000", later), Some(0));
        assert_eq!(seldom.told.len(), 1);
    }
}
