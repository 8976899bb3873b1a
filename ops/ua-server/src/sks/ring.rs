//! The keys of a group in the order of their SecurityTokenIds: past keys, the current key, and
//! future keys.

use std::collections::VecDeque;
use std::fmt;
use std::time::{Duration, Instant};

use bridge_core::Now;

/// The keys of a group, and the start of use of the current key.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Ring {
    lifetime: Duration,
    /// The SecurityTokenId of the first key, or of the next key if there are no keys.
    first: u32,
    keys: VecDeque<Vec<u8>>,
    /// Number of keys before the current key.
    past: usize,
    since: Instant,
}

/// The keys for a client.
#[derive(PartialEq, Eq)]
pub(super) struct Handed {
    pub(super) first_token_id: u32,
    pub(super) keys: Vec<Vec<u8>>,
    pub(super) time_to_next: Duration,
    pub(super) lifetime: Duration,
}

impl Ring {
    /// Creates a ring without keys.
    pub(super) const fn new(lifetime: Duration, now: Now) -> Self {
        Self {
            lifetime,
            first: 1,
            keys: VecDeque::new(),
            past: 0,
            since: now.monotonic,
        }
    }

    /// Creates a ring without keys. Its SecurityTokenIds continue after the keys of another ring,
    /// which are not accepted any more.
    pub(super) fn after(before: &Self, lifetime: Duration, now: Now) -> Self {
        Self {
            first: before.token(before.keys.len()),
            ..Self::new(lifetime, now)
        }
    }

    /// Restores a stored ring. The key at index `past` of `keys` has been in use for `used`.
    pub(super) fn kept(
        lifetime: Duration,
        (first, keys): (u32, VecDeque<Vec<u8>>),
        past: usize,
        used: Duration,
        now: Now,
    ) -> Self {
        Self {
            lifetime,
            first,
            past: past.min(keys.len().saturating_sub(1)),
            keys,
            since: now.monotonic.checked_sub(used).unwrap_or(now.monotonic),
        }
    }

    /// Changes the lifetime of the keys. The current key ends after this lifetime at the latest.
    pub(super) fn set_lifetime(&mut self, lifetime: Duration, now: Now) {
        if self.used(now.monotonic) > lifetime {
            let since = now.monotonic.checked_sub(lifetime);
            self.since = since.unwrap_or(now.monotonic);
        }
        self.lifetime = lifetime;
    }

    /// Advances to the current key and creates the next keys. The SecurityTokenId increases with
    /// each elapsed lifetime, even if no client requests keys. Returns false if nothing has
    /// changed.
    pub(super) fn advance(&mut self, now: Instant, mut make: impl FnMut() -> Vec<u8>) -> bool {
        let used = now.saturating_duration_since(self.since);
        let over = used.as_nanos() / self.lifetime.as_nanos().max(1);
        let over = u32::try_from(over).unwrap_or(u32::MAX);
        let mut changed = false;
        if over > 0 && !self.keys.is_empty() {
            changed = true;
            self.since += self.lifetime.saturating_mul(over);
            let next = self
                .past
                .saturating_add(usize::try_from(over).unwrap_or(usize::MAX));
            if next < self.keys.len() {
                self.past = next;
            } else {
                // Keys that were not distributed were not used, and their numbers are skipped.
                self.first = self.token(next);
                self.keys.clear();
                self.past = 0;
            }
        } else if over > 0 {
            self.since = now;
        }
        while self.past > PAST {
            self.keys.pop_front();
            self.first = self.token(1);
            self.past -= 1;
            changed = true;
        }
        let wanted = self.past + 1 + usize::try_from(FUTURE).unwrap_or(0);
        while self.keys.len() < wanted {
            self.keys.push_back(make());
            changed = true;
        }
        changed
    }

    /// Returns keys from the SecurityTokenId `starting` on, from the current key for 0, or from the
    /// oldest key if the id is unknown. `count` keys are returned, but at least one (OPC 10000-14,
    /// 8.3.2). Returns `None` before there are keys.
    pub(super) fn hand_out(&self, starting: u32, count: u32, now: Instant) -> Option<Handed> {
        let at = match starting {
            0 => self.past,
            token => (0..self.keys.len())
                .find(|at| self.token(*at) == token)
                .unwrap_or(0),
        };
        // The first key, and `count` keys after it.
        let count = usize::try_from(count)
            .unwrap_or(usize::MAX)
            .saturating_add(1);
        let keys: Vec<_> = self.keys.iter().skip(at).take(count).cloned().collect();
        let used = now.saturating_duration_since(self.since);
        (!keys.is_empty()).then(|| Handed {
            first_token_id: self.token(at),
            keys,
            time_to_next: self.lifetime.saturating_sub(used),
            lifetime: self.lifetime,
        })
    }

    /// Returns the SecurityTokenId of the key at an index. The id 0 is reserved: the largest id is
    /// followed by 1.
    fn token(&self, at: usize) -> u32 {
        let at = u64::try_from(at).unwrap_or(u64::MAX);
        let all = u64::from(u32::MAX);
        let behind = (u64::from(self.first.max(1)) - 1 + at % all) % all;
        u32::try_from(behind + 1).unwrap_or(1)
    }

    pub(super) const fn lifetime(&self) -> Duration {
        self.lifetime
    }

    /// Returns the SecurityTokenId of the first key, and all keys.
    pub(super) const fn keys(&self) -> (u32, &VecDeque<Vec<u8>>) {
        (self.first, &self.keys)
    }

    pub(super) const fn past(&self) -> usize {
        self.past
    }

    /// Returns how long the current key has been in use.
    pub(super) fn used(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.since)
    }
}

impl fmt::Debug for Ring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ring")
            .field("first", &self.first)
            .field("keys", &self.keys.len())
            .field("past", &self.past)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Handed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Handed")
            .field("first_token_id", &self.first_token_id)
            .field("keys", &self.keys.len())
            .finish_non_exhaustive()
    }
}

/// Number of past keys that are kept.
const PAST: usize = 2;
/// Number of keys that are created in advance.
pub(super) const FUTURE: u32 = 4;

#[cfg(test)]
mod tests {
    use bridge_node::now;

    use super::*;

    const HOUR: Duration = Duration::from_secs(3600);

    /// Creates keys with consecutive numbers.
    fn maker() -> impl FnMut() -> Vec<u8> {
        let mut count = 0_u8;
        move || {
            count += 1;
            vec![count]
        }
    }

    fn tokens(ring: &Ring, starting: u32, count: u32, now: Instant) -> (u32, Vec<u8>) {
        let handed = ring.hand_out(starting, count, now).unwrap();
        let keys = handed.keys.into_iter().map(|key| key[0]).collect();
        (handed.first_token_id, keys)
    }

    #[test]
    fn each_lifetime_has_the_next_key_and_those_before_can_be_asked_for() {
        let start = now();
        let mut ring = Ring::new(HOUR, start);
        let mut make = maker();
        assert!(ring.advance(start.monotonic, &mut make));
        assert!(!ring.advance(start.monotonic + HOUR / 2, &mut make));
        assert_eq!(tokens(&ring, 0, 2, start.monotonic), (1, vec![1, 2, 3]));
        assert_eq!(tokens(&ring, 0, 0, start.monotonic), (1, vec![1]));
        assert_eq!(
            tokens(&ring, 0, 99, start.monotonic),
            (1, vec![1, 2, 3, 4, 5])
        );
        let later = start.monotonic + HOUR * 3 + HOUR / 4;
        assert!(ring.advance(later, &mut make));
        assert_eq!(tokens(&ring, 0, 1, later), (4, vec![4, 5]));
        assert_eq!(tokens(&ring, 3, 1, later), (3, vec![3, 4]));
        assert_eq!(
            tokens(&ring, 1, 0, later),
            (2, vec![2]),
            "the oldest there is"
        );
        let handed = ring.hand_out(0, 0, later).unwrap();
        assert_eq!(handed.time_to_next, HOUR * 3 / 4);
    }

    #[test]
    fn numbers_go_on_while_nobody_asks_for_longer_than_there_are_keys() {
        let start = now();
        let mut ring = Ring::new(HOUR, start);
        let mut make = maker();
        ring.advance(start.monotonic, &mut make);
        let later = start.monotonic + HOUR * 1000;
        ring.advance(later, &mut make);
        assert_eq!(tokens(&ring, 0, 1, later), (1001, vec![6, 7]));
    }

    #[test]
    fn behind_the_last_number_comes_the_first() {
        let start = now();
        let keys = VecDeque::from([vec![0]]);
        let mut ring = Ring::kept(HOUR, (u32::MAX, keys), 0, HOUR / 2, start);
        ring.advance(start.monotonic, maker());
        let next = ring.hand_out(1, 0, start.monotonic).unwrap();
        assert_eq!((next.first_token_id, next.keys), (1, vec![vec![1]]));
        assert_eq!(next.time_to_next, HOUR / 2);
    }

    #[test]
    fn keys_of_another_policy_have_other_numbers() {
        let start = now();
        let mut ring = Ring::new(HOUR, start);
        ring.advance(start.monotonic, maker());
        let mut after = Ring::after(&ring, HOUR, start);
        after.advance(start.monotonic, maker());
        assert_eq!(tokens(&after, 0, 0, start.monotonic), (6, vec![1]));
    }

    #[test]
    fn a_shorter_lifetime_ends_the_current_key_and_no_more() {
        let start = now();
        let mut ring = Ring::new(HOUR, start);
        let mut make = maker();
        ring.advance(start.monotonic, &mut make);
        let later = Now {
            monotonic: start.monotonic + HOUR / 2,
            ..start
        };
        ring.set_lifetime(HOUR / 60, later);
        ring.advance(later.monotonic, &mut make);
        assert_eq!(tokens(&ring, 0, 0, later.monotonic), (2, vec![2]));
    }
}
