//! The bounded queue between a publisher and the task that writes to a subscriber.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::sync::Notify;

/// Messages waiting for a subscriber. When the queue is full the oldest messages are dropped. The
/// newest message is always kept, so a message larger than the byte limit waits alone.
#[derive(Debug)]
pub(crate) struct SubscriberQueue {
    limit: Limit,
    state: Mutex<State>,
    changed: Notify,
    ended: Notify,
}

/// Capacity of a queue.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limit {
    pub(crate) messages: usize,
    pub(crate) bytes: usize,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<Bytes>,
    bytes: usize,
    dropped: u64,
    closed: bool,
}

impl SubscriberQueue {
    pub(crate) fn new(limit: Limit) -> Self {
        Self {
            limit,
            state: Mutex::default(),
            changed: Notify::new(),
            ended: Notify::new(),
        }
    }

    /// Queues a message and returns the number of older messages that were dropped. A closed queue
    /// ignores the message.
    pub(crate) fn push(&self, message: Bytes) -> u64 {
        let mut state = lock(&self.state);
        if state.closed {
            return 0;
        }
        let mut dropped = 0;
        while !state.queue.is_empty()
            && (state.queue.len() >= self.limit.messages.max(1)
                || state.bytes.saturating_add(message.len()) > self.limit.bytes)
        {
            if let Some(oldest) = state.queue.pop_front() {
                state.bytes -= oldest.len();
                dropped += 1;
            }
        }
        state.dropped += dropped;
        state.bytes += message.len();
        state.queue.push_back(message);
        drop(state);
        self.changed.notify_one();
        dropped
    }

    /// Drops all messages and returns their number.
    pub(crate) fn clear(&self) -> u64 {
        let mut state = lock(&self.state);
        let count = u64::try_from(state.queue.len()).unwrap_or(u64::MAX);
        state.queue.clear();
        state.bytes = 0;
        state.dropped = state.dropped.saturating_add(count);
        count
    }

    /// Moves up to `batch` bytes of messages, and at least one message, to `into`. Waits for the
    /// first message. Returns false if the queue is closed and empty. Cancel-safe: no message is
    /// removed before the function returns.
    pub(crate) async fn take(&self, into: &mut Vec<Bytes>, batch: usize) -> bool {
        loop {
            {
                let mut state = lock(&self.state);
                let mut taken = 0;
                while let Some(next) = state.queue.front()
                    && (into.is_empty() || taken + next.len() + 4 <= batch)
                    && let Some(message) = state.queue.pop_front()
                {
                    taken += message.len() + 4;
                    state.bytes -= message.len();
                    into.push(message);
                }
                if !into.is_empty() {
                    return true;
                }
                if state.closed {
                    return false;
                }
            }
            self.changed.notified().await;
        }
    }

    /// Closes the queue for new messages; queued messages may still be taken.
    pub(crate) fn close(&self) {
        lock(&self.state).closed = true;
        self.changed.notify_one();
        self.ended.notify_waiters();
    }

    /// Waits for `close`.
    pub(crate) async fn closed(&self) {
        let mut notified = std::pin::pin!(self.ended.notified());
        // Registered before the check, so that a close in between is not missed.
        notified.as_mut().enable();
        if !lock(&self.state).closed {
            notified.await;
        }
    }

    pub(crate) fn dropped(&self) -> u64 {
        lock(&self.state).dropped
    }
}

/// Locks a mutex even after a panic of another thread: the state behind the locks of this crate is
/// consistent between statements.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outbox(messages: usize, bytes: usize) -> SubscriberQueue {
        SubscriberQueue::new(Limit { messages, bytes })
    }

    #[tokio::test]
    async fn the_oldest_messages_give_way_when_the_count_is_reached() {
        let outbox = outbox(2, 1000);
        let dropped: Vec<u64> = (0..4u8)
            .map(|n| outbox.push(Bytes::from(vec![n])))
            .collect();
        assert_eq!(dropped, [0, 0, 1, 1]);
        let mut taken = Vec::new();
        assert!(outbox.take(&mut taken, 1000).await);
        assert_eq!(taken, [Bytes::from_static(&[2]), Bytes::from_static(&[3])]);
        assert_eq!(outbox.dropped(), 2);
    }

    #[tokio::test]
    async fn the_bytes_are_bounded_but_the_newest_message_is_kept() {
        let outbox = outbox(100, 10);
        outbox.push(Bytes::from(vec![1; 6]));
        assert_eq!(outbox.push(Bytes::from(vec![2; 6])), 1);
        assert_eq!(outbox.push(Bytes::from(vec![3; 60])), 1);
        let mut taken = Vec::new();
        assert!(outbox.take(&mut taken, 1).await);
        assert_eq!(taken, [Bytes::from(vec![3; 60])]);
    }

    #[tokio::test]
    async fn a_closed_queue_gives_what_it_has_and_then_ends() {
        let outbox = outbox(4, 100);
        outbox.push(Bytes::from_static(b"a"));
        outbox.close();
        assert_eq!(outbox.push(Bytes::from_static(b"b")), 0);
        let mut taken = Vec::new();
        assert!(outbox.take(&mut taken, 64).await);
        assert_eq!(taken, [Bytes::from_static(b"a")]);
        taken.clear();
        assert!(!outbox.take(&mut taken, 64).await);
    }

    #[tokio::test]
    async fn a_batch_ends_before_the_message_that_does_not_fit() {
        let outbox = outbox(10, 1000);
        for _ in 0..3 {
            outbox.push(Bytes::from(vec![0; 40]));
        }
        let mut taken = Vec::new();
        assert!(outbox.take(&mut taken, 100).await);
        assert_eq!(taken.len(), 2);
    }
}
