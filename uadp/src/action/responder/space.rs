//! The space that remembered requests use, for each sender and for each group of senders.

use alloc::collections::{BTreeMap, BTreeSet};

use super::entry::Phase;
use super::settings::{RequestOrigin, ResponderSettings};

/// The space that remembered requests use. The limits of senders and groups are independent.
#[derive(Debug)]
pub(super) struct RequestSpace<P> {
    senders: BTreeMap<RequestOrigin<P>, Usage>,
    groups: BTreeMap<usize, Usage>,
}

/// Whether there is space for another request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SpaceLeft {
    /// There is space.
    Enough,
    /// There may be space when this request, the oldest of the closed requests, is reduced.
    Behind(u64),
    /// There is no space and no closed request.
    Full,
}

/// Used space.
#[derive(Debug, Default)]
struct Usage {
    requests: usize,
    bytes: usize,
    executing: usize,
    /// Closed requests, oldest first.
    closed: BTreeSet<u64>,
}

impl Usage {
    fn left(&self, is_full: bool) -> SpaceLeft {
        match (is_full, self.closed.first()) {
            (false, _) => SpaceLeft::Enough,
            (true, Some(oldest)) => SpaceLeft::Behind(*oldest),
            (true, None) => SpaceLeft::Full,
        }
    }
}

impl<P: Ord + Clone> RequestSpace<P> {
    pub(super) const fn new() -> Self {
        Self {
            senders: BTreeMap::new(),
            groups: BTreeMap::new(),
        }
    }

    /// Returns the number of requests and the bytes that they use.
    pub(super) fn used(&self) -> (usize, usize) {
        let groups = self.groups.values();
        groups.fold((0, 0), |(requests, bytes), group| {
            (requests + group.requests, bytes + group.bytes)
        })
    }

    /// Returns true if the sender or its group has reached the limit of concurrent executions.
    pub(super) fn is_busy(&self, origin: &RequestOrigin<P>, settings: &ResponderSettings) -> bool {
        let executing = |usage: Option<&Usage>| usage.map_or(0, |usage| usage.executing);
        executing(self.senders.get(origin)) >= settings.max_executing_per_sender
            || executing(self.groups.get(&origin.group)) >= settings.max_executing
    }

    /// Returns whether the sender has space for a request of `cost` bytes.
    pub(super) fn of_sender(
        &self,
        origin: &RequestOrigin<P>,
        cost: usize,
        settings: &ResponderSettings,
    ) -> SpaceLeft {
        self.senders.get(origin).map_or(SpaceLeft::Enough, |used| {
            used.left(
                used.requests >= settings.max_requests_per_sender
                    || used.bytes + cost > settings.max_bytes_per_sender,
            )
        })
    }

    /// Returns whether the group of the sender has space for a request of `cost` bytes.
    pub(super) fn of_group(
        &self,
        origin: &RequestOrigin<P>,
        cost: usize,
        settings: &ResponderSettings,
    ) -> SpaceLeft {
        let group = self.groups.get(&origin.group);
        group.map_or(SpaceLeft::Enough, |used| {
            used.left(
                used.requests >= settings.max_requests || used.bytes + cost > settings.max_bytes,
            )
        })
    }

    /// Returns whether there is space for a response of `bytes` to a request of the sender.
    pub(super) fn has_room_for(
        &self,
        origin: &RequestOrigin<P>,
        bytes: usize,
        settings: &ResponderSettings,
    ) -> bool {
        let used = |usage: Option<&Usage>| usage.map_or(0, |usage| usage.bytes);
        let (sender, group) = (
            used(self.senders.get(origin)),
            used(self.groups.get(&origin.group)),
        );
        bytes <= settings.max_answer
            && group + bytes <= settings.max_bytes
            && sender + bytes <= settings.max_bytes_per_sender
    }

    /// Accounts for a new request.
    pub(super) fn admit(
        &mut self,
        origin: &RequestOrigin<P>,
        (id, phase): (u64, &Phase),
        cost: usize,
    ) {
        let executing = usize::from(matches!(phase, Phase::Executing { .. }));
        let is_closed = matches!(phase, Phase::Closed);
        self.account(origin, |usage| {
            usage.requests += 1;
            usage.bytes += cost;
            usage.executing += executing;
            if is_closed {
                usage.closed.insert(id);
            }
        });
    }

    /// Accounts for the end of an execution with a response of `bytes`.
    pub(super) fn conclude(&mut self, origin: &RequestOrigin<P>, bytes: usize) {
        self.account(origin, |usage| {
            usage.executing -= 1;
            usage.bytes += bytes;
        });
    }

    /// Accounts for a request that is closed: the `bytes` of its response are free.
    pub(super) fn close(&mut self, origin: &RequestOrigin<P>, id: u64, bytes: usize) {
        self.account(origin, |usage| {
            usage.bytes -= bytes;
            usage.closed.insert(id);
        });
    }

    /// Accounts for a request that is removed, and the `bytes` that it used.
    pub(super) fn forget(
        &mut self,
        origin: &RequestOrigin<P>,
        (id, phase): (u64, &Phase),
        bytes: usize,
    ) {
        let executing = usize::from(matches!(phase, Phase::Executing { .. }));
        self.account(origin, |usage| {
            usage.executing -= executing;
            usage.requests -= 1;
            usage.bytes -= bytes;
            usage.closed.remove(&id);
        });
    }

    fn account(&mut self, origin: &RequestOrigin<P>, change: impl Fn(&mut Usage)) {
        let usage = self.senders.entry(origin.clone()).or_default();
        change(usage);
        if usage.requests == 0 {
            self.senders.remove(origin);
        }
        let total = self.groups.entry(origin.group).or_default();
        change(total);
        if total.requests == 0 {
            self.groups.remove(&origin.group);
        }
    }
}
