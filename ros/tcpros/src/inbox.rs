//! A consumer for the messages of many subscriptions.

use std::collections::{HashMap, VecDeque};
use std::future::poll_fn;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::SystemTime;

use bytes::Bytes;

use crate::header::ConnectionHeader;
use crate::outbox::{Limit, lock};

/// A message received from a publisher.
#[derive(Clone, Debug)]
pub struct InboxMessage {
    /// The serialized message, without its length.
    pub bytes: Bytes,
    /// The publisher.
    pub peer: Arc<ConnectionPeer>,
    /// Time at which the last byte of the message was read. Messages from the same read differ by a
    /// nanosecond, so that the time also identifies a message.
    pub received: SystemTime,
}

/// The node at the other end of a connection: a publisher, or a client of a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConnectionPeer {
    /// Resolved name of the node.
    pub caller_id: String,
    /// Connection header of the node, which describes the node and the topic or service.
    pub header: ConnectionHeader,
}

/// Event of a subscription.
#[derive(Clone, Debug)]
pub enum InboxEvent {
    /// A message, in the order of its publisher.
    Message(InboxMessage),
    /// A connection to a publisher was made or ended.
    Peer {
        /// True if the connection was made.
        connected: bool,
        /// Number of publishers that this subscription is connected to.
        publishers: usize,
        /// The publisher.
        peer: Arc<ConnectionPeer>,
    },
    /// Number of messages lost since the last event because the consumer did not keep up. The
    /// oldest messages are dropped.
    Dropped(u64),
}

/// Receives in turns from many subscriptions, each with a bounded queue of its own. `K` identifies
/// the subscription.
///
/// A subscription with too many messages fills only its own queue and gets one turn in a round.
#[derive(Debug)]
pub struct Inbox<K> {
    shared: Arc<Shared<K>>,
}

impl<K: Clone + Send + 'static> Inbox<K> {
    /// Creates an inbox without subscriptions: `recv` waits until a subscription has an event.
    pub fn new() -> Self {
        let state = State {
            slots: HashMap::new(),
            ready: VecDeque::new(),
            waker: None,
            next_id: 0,
        };
        Self {
            shared: Arc::new(Shared {
                state: Mutex::new(state),
            }),
        }
    }

    /// Returns the next event. Cancel-safe: an event is removed only when it is returned.
    pub async fn recv(&mut self) -> (K, InboxEvent) {
        poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// Polls for the next event, for callers with a poll loop of their own.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<(K, InboxEvent)> {
        let mut state = lock(&self.shared.state);
        if let Some(event) = state.next() {
            return Poll::Ready(event);
        }
        if !state
            .waker
            .as_ref()
            .is_some_and(|waker| waker.will_wake(cx.waker()))
        {
            state.waker = Some(cx.waker().clone());
        }
        Poll::Pending
    }

    /// Returns the next event if an event is queued.
    pub fn try_recv(&mut self) -> Option<(K, InboxEvent)> {
        lock(&self.shared.state).next()
    }

    pub(crate) fn open(&self, key: K, limit: Limit) -> Entrance<K> {
        let mut state = lock(&self.shared.state);
        let id = state.next_id;
        state.next_id += 1;
        state.slots.insert(id, Slot::new(key, limit));
        Entrance {
            shared: Arc::clone(&self.shared),
            id,
        }
    }
}

impl<K: Clone + Send + 'static> Default for Inbox<K> {
    fn default() -> Self {
        Self::new()
    }
}

/// Receiver for the messages of a subscription's connections.
pub(crate) trait Deliver: Send + Sync {
    /// Queues a message and returns the number of older messages that were dropped.
    fn message(&self, message: InboxMessage) -> u64;
    fn peer(&self, connected: bool, publishers: usize, peer: Arc<ConnectionPeer>);
    /// Removes the subscription and its queue.
    fn close(&self);
}

/// Entry of one subscription into an inbox.
pub(crate) struct Entrance<K> {
    shared: Arc<Shared<K>>,
    id: u64,
}

impl<K: Clone + Send + 'static> Deliver for Entrance<K> {
    fn message(&self, message: InboxMessage) -> u64 {
        self.put(|slot| slot.message(message))
    }

    fn peer(&self, connected: bool, publishers: usize, peer: Arc<ConnectionPeer>) {
        self.put(|slot| {
            slot.peer(InboxEvent::Peer {
                connected,
                publishers,
                peer,
            });
            0
        });
    }

    fn close(&self) {
        let mut state = lock(&self.shared.state);
        let removed = state.slots.remove(&self.id);
        state.ready.retain(|id| *id != self.id);
        drop(state);
        // Keys and messages may have destructors of their own, which must not run under the lock.
        drop(removed);
    }
}

impl<K> Entrance<K> {
    fn put(&self, into: impl FnOnce(&mut Slot<K>) -> u64) -> u64 {
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        let Some(slot) = state.slots.get_mut(&self.id) else {
            return 0;
        };
        let dropped = into(slot);
        if !slot.in_turn {
            slot.in_turn = true;
            state.ready.push_back(self.id);
        }
        let waker = state.waker.take();
        drop(guard);
        if let Some(waker) = waker {
            waker.wake();
        }
        dropped
    }
}

#[derive(Debug)]
struct Shared<K> {
    state: Mutex<State<K>>,
}

#[derive(Debug)]
struct State<K> {
    slots: HashMap<u64, Slot<K>>,
    /// The slots with queued events, in the order of their turns.
    ready: VecDeque<u64>,
    waker: Option<Waker>,
    next_id: u64,
}

impl<K: Clone> State<K> {
    fn next(&mut self) -> Option<(K, InboxEvent)> {
        loop {
            let id = self.ready.pop_front()?;
            let Some(slot) = self.slots.get_mut(&id) else {
                continue;
            };
            let event = slot.next();
            slot.in_turn = slot.has_more();
            if slot.in_turn {
                self.ready.push_back(id);
            }
            if let Some(event) = event {
                return Some((slot.key.clone(), event));
            }
        }
    }
}

#[derive(Debug)]
struct Slot<K> {
    key: K,
    limit: Limit,
    /// Messages and peer events in order, with at most `limit.messages` messages and `MAX_PEERS`
    /// peer events.
    queue: VecDeque<InboxEvent>,
    messages: usize,
    bytes: usize,
    unreported: u64,
    in_turn: bool,
}

impl<K> Slot<K> {
    const fn new(key: K, limit: Limit) -> Self {
        Self {
            key,
            limit,
            queue: VecDeque::new(),
            messages: 0,
            bytes: 0,
            unreported: 0,
            in_turn: false,
        }
    }

    fn message(&mut self, message: InboxMessage) -> u64 {
        let mut dropped = 0;
        while self.messages > 0
            && (self.messages >= self.limit.messages.max(1)
                || self.bytes.saturating_add(message.bytes.len()) > self.limit.bytes)
        {
            self.drop_oldest();
            dropped += 1;
        }
        self.unreported += dropped;
        self.messages += 1;
        self.bytes += message.bytes.len();
        self.queue.push_back(InboxEvent::Message(message));
        dropped
    }

    fn drop_oldest(&mut self) {
        let oldest = self
            .queue
            .iter()
            .position(|event| matches!(event, InboxEvent::Message(_)));
        if let Some(InboxEvent::Message(message)) = oldest.and_then(|at| self.queue.remove(at)) {
            self.messages -= 1;
            self.bytes -= message.bytes.len();
        }
    }

    /// Queues a peer event. A peer that reconnects often while nothing is consumed must not fill
    /// the memory: the oldest peer events are dropped, as the publisher count is absolute.
    fn peer(&mut self, event: InboxEvent) {
        if self.queue.len() - self.messages >= MAX_PEERS {
            let oldest = self
                .queue
                .iter()
                .position(|event| matches!(event, InboxEvent::Peer { .. }));
            if let Some(at) = oldest {
                self.queue.remove(at);
            }
        }
        self.queue.push_back(event);
    }

    fn next(&mut self) -> Option<InboxEvent> {
        if self.unreported > 0 {
            return Some(InboxEvent::Dropped(std::mem::take(&mut self.unreported)));
        }
        let event = self.queue.pop_front();
        if let Some(InboxEvent::Message(message)) = &event {
            self.messages -= 1;
            self.bytes -= message.bytes.len();
        }
        event
    }

    fn has_more(&self) -> bool {
        self.unreported > 0 || !self.queue.is_empty()
    }
}

const MAX_PEERS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn message(content: &[u8]) -> InboxMessage {
        let peer = Arc::new(ConnectionPeer {
            caller_id: "/p".to_owned(),
            header: ConnectionHeader::default(),
        });
        InboxMessage {
            bytes: Bytes::copy_from_slice(content),
            peer,
            received: SystemTime::UNIX_EPOCH,
        }
    }

    fn content(event: &InboxEvent) -> &[u8] {
        match event {
            InboxEvent::Message(message) => &message.bytes,
            other @ (InboxEvent::Peer { .. } | InboxEvent::Dropped(_)) => {
                panic!("{other:?} instead of a message")
            }
        }
    }

    const ROOMY: Limit = Limit {
        messages: 100,
        bytes: 1000,
    };

    #[tokio::test]
    async fn subscriptions_are_served_in_turns() {
        let mut inbox = Inbox::new();
        let (a, b) = (inbox.open('a', ROOMY), inbox.open('b', ROOMY));
        for n in 0..3 {
            a.message(message(&[n]));
        }
        b.message(message(&[9]));
        let mut order = Vec::new();
        for _ in 0..4 {
            let (key, event) = inbox.recv().await;
            order.push((key, content(&event)[0]));
        }
        assert_eq!(order, [('a', 0), ('b', 9), ('a', 1), ('a', 2)]);
        assert!(inbox.try_recv().is_none());
    }

    #[tokio::test]
    async fn a_full_queue_loses_the_oldest_and_says_how_many() {
        let mut inbox = Inbox::new();
        let a = inbox.open(
            (),
            Limit {
                messages: 2,
                bytes: 1000,
            },
        );
        for n in 0..5 {
            a.message(message(&[n]));
        }
        assert!(matches!(inbox.recv().await.1, InboxEvent::Dropped(3)));
        assert_eq!(content(&inbox.recv().await.1), [3]);
        assert_eq!(content(&inbox.recv().await.1), [4]);
    }

    #[tokio::test]
    async fn bytes_are_bounded_too() {
        let mut inbox = Inbox::new();
        let a = inbox.open(
            (),
            Limit {
                messages: 100,
                bytes: 10,
            },
        );
        assert_eq!(a.message(message(&[1; 8])), 0);
        assert_eq!(a.message(message(&[2; 8])), 1);
        assert!(matches!(inbox.recv().await.1, InboxEvent::Dropped(1)));
        assert_eq!(content(&inbox.recv().await.1), [2; 8]);
    }

    #[tokio::test]
    async fn a_connection_is_reported_before_its_messages_and_its_end_after_them() {
        let mut inbox = Inbox::new();
        let a = inbox.open((), ROOMY);
        let peer = message(b"").peer;
        a.peer(true, 1, Arc::clone(&peer));
        a.message(message(b"x"));
        a.peer(false, 0, peer);
        assert!(matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: true,
                publishers: 1,
                ..
            }
        ));
        assert_eq!(content(&inbox.recv().await.1), b"x");
        assert!(matches!(
            inbox.recv().await.1,
            InboxEvent::Peer {
                connected: false,
                publishers: 0,
                ..
            }
        ));
    }

    #[tokio::test]
    async fn a_flapping_peer_keeps_the_queue_bounded_and_the_last_count_right() {
        let mut inbox = Inbox::new();
        let a = inbox.open((), ROOMY);
        let peer = message(b"").peer;
        for n in 0..1000 {
            a.peer(true, n, Arc::clone(&peer));
        }
        let mut last = None;
        let mut seen = 0;
        while let Some((_, InboxEvent::Peer { publishers, .. })) = inbox.try_recv() {
            last = Some(publishers);
            seen += 1;
        }
        assert_eq!((seen, last), (MAX_PEERS, Some(999)));
    }

    #[tokio::test]
    async fn a_closed_subscription_says_nothing_more() {
        let mut inbox = Inbox::new();
        let (a, b) = (inbox.open('a', ROOMY), inbox.open('b', ROOMY));
        a.message(message(b"1"));
        a.close();
        a.message(message(b"2"));
        b.message(message(b"3"));
        assert_eq!(inbox.recv().await.0, 'b');
        assert!(inbox.try_recv().is_none());
    }

    #[tokio::test]
    async fn a_receive_that_was_cancelled_loses_nothing() {
        let mut inbox = Inbox::new();
        let a = inbox.open((), ROOMY);
        tokio::select! {
            biased;
            _ = inbox.recv() => panic!("nothing was sent"),
            () = std::future::ready(()) => {}
        }
        a.message(message(b"x"));
        assert_eq!(content(&inbox.recv().await.1), b"x");
    }
}
