//! Requests that are over: enough of each to know it again, for as long as the network may hold one back.

use std::collections::{BTreeMap, HashSet, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::Duration;

use super::entry::Key;
use super::{RequestDrop, ResponderSettings};
use crate::OwnedPublisherId;

/// By a hash of what each is known by: two that fall together among some 100000 are not to be expected, and of those the
/// second would be dropped and not executed twice.
#[derive(Debug, Default)]
pub(super) struct Over {
    hashes: HashSet<u64>,
    /// In the order in which they were put in, and until when each is kept.
    queue: VecDeque<(Duration, u64, Option<OwnedPublisherId>)>,
    by_requestor: BTreeMap<Option<OwnedPublisherId>, usize>,
}

impl Over {
    /// Whether it is one of them.
    pub(super) fn has(&self, key: &Key) -> bool {
        !self.hashes.is_empty() && self.hashes.contains(&hash(key))
    }

    /// Keeps one until then.
    pub(super) fn keep(
        &mut self,
        key: &Key,
        until: Duration,
        settings: &ResponderSettings,
    ) -> Result<(), RequestDrop> {
        if self.queue.len() >= settings.max_over {
            return Err(RequestDrop::Full);
        }
        let kept = self.by_requestor.get(&key.requestor_id);
        if kept.is_some_and(|kept| *kept >= settings.max_over_per_requestor) {
            return Err(RequestDrop::RequestorFull);
        }
        let hash = hash(key);
        if self.hashes.insert(hash) {
            let requestor = key.requestor_id.clone();
            self.queue.push_back((until, hash, requestor.clone()));
            *self.by_requestor.entry(requestor).or_default() += 1;
        }
        Ok(())
    }

    /// Forgets those that are old enough. One behind another that is kept for longer waits for that.
    pub(super) fn forget_until(&mut self, now: Duration) {
        while let Some((until, ..)) = self.queue.front()
            && *until <= now
            && let Some((_, hash, requestor)) = self.queue.pop_front()
        {
            self.hashes.remove(&hash);
            if let Some(kept) = self.by_requestor.get_mut(&requestor) {
                *kept -= 1;
                if *kept == 0 {
                    self.by_requestor.remove(&requestor);
                }
            }
        }
    }

    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }
}

fn hash(key: &Key) -> u64 {
    let mut hasher = DefaultHasher::new();
    key.hash(&mut hasher);
    hasher.finish()
}

/// About the bytes that one takes up.
pub(super) const COST: usize = 100;
