//! Requests that wait for a service.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use mappings::Overflow;
use tokio::sync::Notify;

/// The bounded queue between the port and the task that calls one service. When it is full, the oldest gives way.
///
/// `None` stands for a value that calls nothing: of a state it says that no earlier one is to be called for any more, of
/// events nothing.
#[derive(Debug)]
pub(super) struct Pending {
    depth: usize,
    is_state: bool,
    waiting: Mutex<VecDeque<Option<Bytes>>>,
    changed: Notify,
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
        }
    }

    /// Queues a request and says how many requests had to go for it.
    pub(super) fn push(&self, request: Option<Bytes>) -> u64 {
        if request.is_none() && !self.is_state {
            return 0;
        }
        let mut waiting = self.lock();
        let oldest = if waiting.len() >= self.depth {
            waiting.pop_front().flatten()
        } else {
            None
        };
        waiting.push_back(request);
        drop(waiting);
        self.changed.notify_one();
        u64::from(oldest.is_some())
    }

    /// The oldest, when there is one. Cancel-safe: it is taken only when it is returned.
    pub(super) async fn take(&self) -> Option<Bytes> {
        loop {
            let next = self.lock().pop_front();
            if let Some(request) = next {
                return request;
            }
            self.changed.notified().await;
        }
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Option<Bytes>>> {
        // The queue is whole between statements.
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
            assert_eq!(pending.take().await.as_ref(), Some(&requests[first]));
        }
    }
}
