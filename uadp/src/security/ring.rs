//! The keys of a SecurityGroup in the order of their SecurityTokenIds: past, current and future
//! keys.

use super::{KeyError, TokenKeys};
use alloc::vec::Vec;

/// Keys, each with a state that starts as its default and is removed with the key.
#[derive(Debug)]
pub(super) struct TokenKeyRing<S> {
    /// Oldest first.
    entries: Vec<KeyEntry<S>>,
    /// SecurityTokenId of the current key, 0 without keys.
    current: u32,
    /// Maximum number of past keys.
    max_past: usize,
    /// Newest key that was removed as too old.
    retired: Option<u32>,
}

#[derive(Debug)]
pub(super) struct KeyEntry<S> {
    pub(super) token_id: u32,
    pub(super) keys: TokenKeys,
    pub(super) state: S,
}

/// Maximum number of keys in an update.
const MAX_KEYS: usize = 64;

impl<S: Default> TokenKeyRing<S> {
    pub(super) const fn new(max_past: usize) -> Self {
        Self {
            entries: Vec::new(),
            current: 0,
            max_past,
            retired: None,
        }
    }

    /// Adds keys with consecutive SecurityTokenIds from `first` on.
    ///
    /// If any of the keys is known, the keys are merged, and the newer of `first` and the current
    /// key becomes current. Otherwise the new keys replace all present keys (OPC 10000-14,
    /// 9.1.3.3). A known key keeps its state, because a new state would permit replayed messages or
    /// repeated nonces. For the same reason a merge does not add removed keys again.
    pub(super) fn update(
        &mut self,
        first: u32,
        keys: impl IntoIterator<Item = TokenKeys>,
    ) -> Result<(), KeyError> {
        if first == 0 {
            return Err(KeyError::TokenId);
        }
        let mut token_id = first;
        let mut given = Vec::new();
        for keys in keys.into_iter().take(MAX_KEYS + 1) {
            given.push(KeyEntry {
                token_id,
                keys,
                state: S::default(),
            });
            token_id = next(token_id);
        }
        if given.is_empty() || given.len() > MAX_KEYS {
            return Err(KeyError::Count(given.len()));
        }
        if given.iter().any(|entry| self.holds(entry)) {
            self.merge(first, given);
        } else {
            self.replace(first, given);
        }
        Ok(())
    }

    fn merge(&mut self, first: u32, given: Vec<KeyEntry<S>>) {
        for entry in given {
            if !self.holds(&entry) && !self.is_retired(entry.token_id) {
                self.entries.retain(|old| old.token_id != entry.token_id);
                self.entries.push(entry);
            }
        }
        let current = self.current;
        self.entries
            .sort_by_key(|entry| place(entry.token_id, current));
        self.advance(first);
        self.drop_past();
    }

    fn replace(&mut self, first: u32, given: Vec<KeyEntry<S>>) {
        let newest = self.entries.last().map(|entry| entry.token_id);
        // Lower ids come from a restarted service, and may occur again.
        self.retired = newest.filter(|newest| is_newer(first, *newest));
        self.entries = given;
        self.current = first;
    }

    /// Makes a newer key current. Returns true if the current key changed.
    pub(super) fn advance(&mut self, token_id: u32) -> bool {
        if token_id == self.current || !is_newer(token_id, self.current) {
            return false;
        }
        self.current = token_id;
        self.drop_past();
        true
    }

    fn drop_past(&mut self) {
        let past = self
            .entries
            .iter()
            .take_while(|entry| entry.token_id != self.current)
            .count();
        let surplus = past.saturating_sub(self.max_past);
        if let Some(last) = self.entries.drain(..surplus).last() {
            self.retired = Some(last.token_id);
        }
    }
}

impl<S> TokenKeyRing<S> {
    pub(super) fn get_mut(&mut self, token_id: u32) -> Option<&mut KeyEntry<S>> {
        self.entries
            .iter_mut()
            .find(|entry| entry.token_id == token_id)
    }

    pub(super) fn current(&self) -> Option<&KeyEntry<S>> {
        self.entries
            .iter()
            .find(|entry| entry.token_id == self.current)
    }

    pub(super) fn current_mut(&mut self) -> Option<&mut KeyEntry<S>> {
        self.get_mut(self.current)
    }

    /// Returns the SecurityTokenId of the current key.
    pub(super) fn current_token_id(&self) -> Option<u32> {
        (self.current != 0).then_some(self.current)
    }

    /// Returns the SecurityTokenId of the key after the current key, if there is one.
    pub(super) fn next_token_id(&self) -> Option<u32> {
        self.entries
            .iter()
            .map(|entry| entry.token_id)
            .skip_while(|token_id| *token_id != self.current)
            .nth(1)
    }

    /// Returns true for the newest removed key and all older keys.
    pub(super) fn is_retired(&self, token_id: u32) -> bool {
        self.retired.is_some_and(|retired| {
            token_id != 0 && (token_id == retired || is_newer(retired, token_id))
        })
    }

    fn holds(&self, other: &KeyEntry<S>) -> bool {
        self.entries
            .iter()
            .any(|entry| entry.token_id == other.token_id && entry.keys == other.keys)
    }
}

/// Returns the next SecurityTokenId. The highest id is followed by 1 (OPC 10000-14, 9.1.3.3).
const fn next(token_id: u32) -> u32 {
    match token_id.checked_add(1) {
        Some(next) => next,
        None => 1,
    }
}

/// Returns the number of steps from `base` to `token_id`, with wrap-around.
fn ahead(token_id: u32, base: u32) -> u32 {
    match token_id.checked_sub(base) {
        Some(ahead) => ahead,
        // The id 0 is skipped.
        None => u32::MAX - (base - token_id),
    }
}

/// Returns true if the shorter way from `base` to `token_id` leads forward.
fn is_newer(token_id: u32, base: u32) -> bool {
    (1..=HALF).contains(&ahead(token_id, base))
}

/// Returns the position of a SecurityTokenId in the order of age around `middle`.
fn place(token_id: u32, middle: u32) -> u64 {
    let ahead = u64::from(ahead(token_id, middle));
    (ahead + u64::from(HALF)) % u64::from(u32::MAX)
}

const HALF: u32 = u32::MAX / 2;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SecurityPolicy;

    fn key(byte: u8) -> TokenKeys {
        TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &[byte; 52]).unwrap()
    }

    fn keys(bytes: impl IntoIterator<Item = u8>) -> Vec<TokenKeys> {
        bytes.into_iter().map(key).collect()
    }

    fn tokens(ring: &TokenKeyRing<u8>) -> Vec<u32> {
        ring.entries.iter().map(|entry| entry.token_id).collect()
    }

    #[test]
    fn behind_the_highest_token_comes_1() {
        assert_eq!(next(u32::MAX), 1);
        assert!(is_newer(1, u32::MAX) && !is_newer(u32::MAX, 1));
        assert_eq!(ahead(1, u32::MAX), 1);
        assert_eq!(ahead(3, u32::MAX - 1), 4);
        assert!(!is_newer(7, 7));
        for base in [1, 2, 1000, HALF, HALF + 1, u32::MAX - 1, u32::MAX] {
            assert!(is_newer(next(base), base) && !is_newer(base, next(base)));
            assert!(place(next(base), base) > place(base, base));
            assert!(place(base, next(base)) < place(base, base));
        }
    }

    #[test]
    fn keys_are_merged_across_the_end_of_the_token_ids() {
        let mut ring = TokenKeyRing::<u8>::new(1);
        ring.update(u32::MAX - 1, keys([1, 2, 3])).unwrap();
        assert_eq!(tokens(&ring), [u32::MAX - 1, u32::MAX, 1]);
        ring.update(1, keys([3, 4])).unwrap();
        assert_eq!(tokens(&ring), [u32::MAX, 1, 2]);
        assert_eq!(ring.current_token_id(), Some(1));
        assert!(ring.is_retired(u32::MAX - 1) && !ring.is_retired(u32::MAX));
    }

    #[test]
    fn a_key_given_again_keeps_its_state_and_another_of_its_token_id_does_not() {
        let mut ring = TokenKeyRing::<u8>::new(1);
        ring.update(5, keys([1, 2])).unwrap();
        ring.get_mut(5).unwrap().state = 50;
        ring.get_mut(6).unwrap().state = 60;
        ring.update(5, keys([1, 9])).unwrap();
        assert_eq!(ring.get_mut(5).unwrap().state, 50);
        assert_eq!(ring.get_mut(6).unwrap().state, 0);
    }

    #[test]
    fn a_merge_neither_goes_back_nor_brings_back() {
        let mut ring = TokenKeyRing::<u8>::new(1);
        ring.update(5, keys([5, 6, 7])).unwrap();
        assert!(ring.advance(7));
        assert_eq!(tokens(&ring), [6, 7]);
        ring.update(4, keys([4, 5, 6, 7, 8])).unwrap();
        assert_eq!(tokens(&ring), [6, 7, 8]);
        assert_eq!(ring.current_token_id(), Some(7));
        assert!(!ring.advance(6) && !ring.advance(7));
        assert!(ring.is_retired(5) && ring.is_retired(1));
        assert!(!ring.is_retired(0), "0 is no token");
    }

    #[test]
    fn older_keys_never_held_are_taken_as_far_as_past_ones_are_kept() {
        let mut ring = TokenKeyRing::<u8>::new(2);
        ring.update(5, keys([5, 6])).unwrap();
        ring.update(2, keys([2, 3, 4, 5])).unwrap();
        assert_eq!(tokens(&ring), [3, 4, 5, 6]);
        assert_eq!(ring.current_token_id(), Some(5));
    }

    #[test]
    fn keys_without_one_in_common_replace_all() {
        let mut ring = TokenKeyRing::<u8>::new(4);
        ring.update(5, keys([5, 6])).unwrap();
        ring.update(9, keys([9, 10])).unwrap();
        assert_eq!(tokens(&ring), [9, 10]);
        ring.update(6, keys([6, 7, 8, 9])).unwrap();
        assert_eq!(tokens(&ring), [7, 8, 9, 10], "6 was let go");
        ring.update(1, keys([21, 22])).unwrap();
        assert_eq!(tokens(&ring), [1, 2]);
        assert_eq!(ring.current_token_id(), Some(1));
        assert!(!ring.is_retired(5), "the service counts anew");
    }

    #[test]
    fn no_keys_too_many_and_token_id_0_leave_the_ring_alone() {
        let mut ring = TokenKeyRing::<u8>::new(1);
        ring.update(5, keys([5])).unwrap();
        assert_eq!(ring.update(0, keys([1])), Err(KeyError::TokenId));
        assert_eq!(ring.update(1, keys([])), Err(KeyError::Count(0)));
        assert_eq!(ring.update(1, keys(0..200)), Err(KeyError::Count(65)));
        assert_eq!(tokens(&ring), [5]);
        assert_eq!(ring.update(5, keys(5..69)), Ok(()));
        assert_eq!(ring.next_token_id(), Some(6));
    }
}
