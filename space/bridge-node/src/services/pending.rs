//! Queued requests of a service.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use bridge_core::Handover;
use bytes::Bytes;
use mappings::Overflow;
use tokio::sync::Notify;

/// The bounded queue between the port and the task that calls one service. When it is full, the
/// oldest request is dropped.
///
/// `None` stands for a value that calls nothing. For a state it replaces earlier requests, so that
/// they are not sent any more; for events it has no effect.
#[derive(Debug)]
pub(super) struct Pending {
    depth: usize,
    is_state: bool,
    waiting: Mutex<Waiting>,
    changed: Notify,
    /// The number of the newest request that the service has received.
    taken: AtomicU64,
    /// The number of the newest request that no service has received.
    refused: AtomicU64,
}

/// Queued requests with their numbers, which count from 1.
#[derive(Debug, Default)]
struct Waiting {
    requests: VecDeque<(u64, Option<Bytes>)>,
    /// The number of the newest request.
    last: u64,
}

impl Pending {
    pub(super) fn new(overflow: Overflow) -> Self {
        let depth = match overflow {
            Overflow::KeepLatest => 1,
            Overflow::DropOldest(depth) => usize::from(depth.get()),
        };
        Self {
            depth,
            is_state: overflow == Overflow::KeepLatest,
            waiting: Mutex::default(),
            changed: Notify::new(),
            taken: AtomicU64::new(0),
            refused: AtomicU64::new(0),
        }
    }

    /// Queues a request and returns the number of requests that were dropped for it.
    pub(super) fn push(&self, request: Option<Bytes>) -> u64 {
        let mut waiting = self.lock();
        waiting.last += 1;
        let number = waiting.last;
        if request.is_none() && !self.is_state {
            self.took(number);
            return 0;
        }
        let oldest = if waiting.requests.len() >= self.depth {
            waiting.requests.pop_front().and_then(|(_, oldest)| oldest)
        } else {
            None
        };
        waiting.requests.push_back((number, request));
        drop(waiting);
        self.changed.notify_one();
        u64::from(oldest.is_some())
    }

    /// Records that the service has received a request.
    pub(super) fn took(&self, number: u64) {
        self.taken.fetch_max(number, Ordering::AcqRel);
    }

    /// Records that no service has received a request.
    pub(super) fn refused(&self, number: u64) {
        self.refused.fetch_max(number, Ordering::AcqRel);
    }

    /// Returns the handover of the newest request.
    pub(super) fn handover(&self) -> Handover {
        let last = self.lock().last;
        if self.taken.load(Ordering::Acquire) >= last {
            Handover::Done
        } else if self.refused.load(Ordering::Acquire) >= last {
            Handover::Nobody
        } else {
            Handover::Waiting
        }
    }

    /// Waits for the oldest request and returns it with its number. Cancel-safe: the request is
    /// removed only when it is returned.
    pub(super) async fn take(&self) -> (u64, Option<Bytes>) {
        loop {
            let next = self.lock().requests.pop_front();
            if let Some(request) = next {
                return request;
            }
            self.changed.notified().await;
        }
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // The queue is consistent between statements.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn of_states_the_newest_waits_and_of_events_as_many_as_the_mapping_says() {
        let requests: Vec<Bytes> = (0..4u8).map(|n| Bytes::from(vec![n])).collect();
        for (overflow, dropped, first) in [
            (Overflow::KeepLatest, 3, 3),
            (Overflow::DropOldest(3.try_into().unwrap()), 1, 1),
        ] {
            let pending = Pending::new(overflow);
            let gone: u64 = requests
                .iter()
                .map(|request| pending.push(Some(request.clone())))
                .sum();
            assert_eq!(gone, dropped);
            if overflow != Overflow::KeepLatest {
                assert_eq!(pending.push(None), 0, "what calls nothing takes no place");
            }
            let (_, oldest) = pending.take().await;
            assert_eq!(oldest.as_ref(), Some(&requests[first]));
        }
    }
    #[tokio::test]
    async fn the_newest_request_has_arrived_when_its_service_has_it() {
        let pending = Pending::new(Overflow::DropOldest(2.try_into().unwrap()));
        let request = || Some(Bytes::from_static(b"x"));
        pending.push(request());
        assert_eq!(pending.handover(), Handover::Waiting);
        let (first, _) = pending.take().await;
        pending.push(request());
        pending.took(first);
        assert_eq!(pending.handover(), Handover::Waiting, "a newer one waits");
        let (second, _) = pending.take().await;
        pending.refused(second);
        assert_eq!(pending.handover(), Handover::Nobody);
        pending.push(request());
        let (third, _) = pending.take().await;
        pending.took(third);
        assert_eq!(pending.handover(), Handover::Done);
        pending.push(None);
        assert_eq!(pending.handover(), Handover::Done, "it calls nothing");
    }
}
