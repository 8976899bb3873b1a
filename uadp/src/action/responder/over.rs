//! Finished requests: a hash of each, kept for as long as the network may delay a repetition.

use alloc::collections::{BTreeMap, VecDeque};
use core::hash::{Hash, Hasher};
use core::time::Duration;

use super::entry::ActionRequestKey;
use super::{RequestDrop, RequestOrigin, ResponderSettings};
use crate::hashing::{DefaultHasher, HashSet};

/// Set of finished requests, each stored as the hash of its key. A hash collision among about
/// 100000 requests is not expected; it would cause the second request to be dropped, not executed
/// twice.
#[derive(Debug)]
pub(super) struct Over<P> {
    hashes: HashSet<u64>,
    /// Expiry times and hashes in the order of insertion.
    queue: VecDeque<(Duration, u64, RequestOrigin<P>)>,
    counts: RequestCounts<P>,
}

/// Number of requests of each sender and of each group.
#[derive(Debug)]
pub(super) struct RequestCounts<P> {
    senders: BTreeMap<RequestOrigin<P>, usize>,
    groups: BTreeMap<usize, usize>,
}

impl<P: Ord + Clone> RequestCounts<P> {
    pub(super) const fn new() -> Self {
        Self {
            senders: BTreeMap::new(),
            groups: BTreeMap::new(),
        }
    }

    /// Checks that the group and the sender have space for another request.
    pub(super) fn check(
        &self,
        origin: &RequestOrigin<P>,
        (of_group, of_sender): (usize, usize),
    ) -> Result<(), RequestDrop> {
        let count = |count: Option<&usize>| count.copied().unwrap_or_default();
        if count(self.senders.get(origin)) >= of_sender {
            return Err(RequestDrop::SenderFull);
        }
        if count(self.groups.get(&origin.group)) >= of_group {
            return Err(RequestDrop::Full);
        }
        Ok(())
    }

    pub(super) fn add(&mut self, origin: &RequestOrigin<P>) {
        *self.senders.entry(origin.clone()).or_default() += 1;
        *self.groups.entry(origin.group).or_default() += 1;
    }

    pub(super) fn remove(&mut self, origin: &RequestOrigin<P>) {
        if let Some(count) = self.senders.get_mut(origin) {
            *count -= 1;
            if *count == 0 {
                self.senders.remove(origin);
            }
        }
        if let Some(count) = self.groups.get_mut(&origin.group) {
            *count -= 1;
            if *count == 0 {
                self.groups.remove(&origin.group);
            }
        }
    }
}

impl<P: Ord + Clone> Over<P> {
    pub(super) fn new() -> Self {
        Self {
            hashes: HashSet::new(),
            queue: VecDeque::new(),
            counts: RequestCounts::new(),
        }
    }

    /// Returns true if the request is in the set.
    pub(super) fn has(&self, key: &ActionRequestKey) -> bool {
        !self.hashes.is_empty() && self.hashes.contains(&hash(key))
    }

    /// Keeps a request until the given time.
    pub(super) fn keep(
        &mut self,
        (key, origin): (&ActionRequestKey, &RequestOrigin<P>),
        until: Duration,
        settings: &ResponderSettings,
    ) -> Result<(), RequestDrop> {
        let limits = (settings.max_over, settings.max_over_per_sender);
        self.counts.check(origin, limits)?;
        let hash = hash(key);
        if self.hashes.insert(hash) {
            self.queue.push_back((until, hash, origin.clone()));
            self.counts.add(origin);
        }
        Ok(())
    }

    /// Removes expired requests. A request behind another that expires later waits for that.
    pub(super) fn forget_until(&mut self, now: Duration) {
        while let Some((until, ..)) = self.queue.front()
            && *until <= now
            && let Some((_, hash, origin)) = self.queue.pop_front()
        {
            self.hashes.remove(&hash);
            self.counts.remove(&origin);
        }
    }

    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }
}

pub(super) fn hash(key: &ActionRequestKey) -> u64 {
    let mut hasher = DefaultHasher::new();
    key.hash(&mut hasher);
    hasher.finish()
}

/// Approximate bytes that a request uses.
pub(super) const COST: usize = 100;
