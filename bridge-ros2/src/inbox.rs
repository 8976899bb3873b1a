//! All readers behind one wait: whoever has a sample queues up, and is served one sample a turn.
//!
//! What is bounded: a reader's history (the queue proper, [`crate::qos::READER_DEPTH`] samples per topic, oldest
//! lost), and the queue of who is ready (one place per reader). Samples that were overwritten unread show as a gap in
//! their writer's sequence numbers, and are reported with the sample after the gap.

use std::collections::{BTreeMap, VecDeque};
use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use futures_util::task::AtomicWaker;
use rustdds::GUID;

use crate::raw::{Payload, Reader};

/// Readers by a key of the owner's choice.
#[derive(Debug)]
pub struct Inbox<K> {
    /// In Boxes, because the nodes of a map that grows at its end stay half empty.
    slots: BTreeMap<u64, Box<Slot<K>>>,
    next_slot: u64,
    ready: Arc<Ready>,
}

/// Where a reader sits in an [`Inbox`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SlotId(u64);

/// What a turn brought.
#[derive(Debug)]
pub enum Taken<K> {
    /// A sample that was not delivered before.
    Sample {
        /// The reader's key.
        key: K,
        /// Its bytes.
        payload: Payload,
        /// Who wrote it.
        writer: GUID,
        /// How many samples of this writer are missing between the last one delivered and this.
        missing: u64,
    },
    /// A sample RustDDS received and could not hand out.
    Unreadable {
        /// The reader's key.
        key: K,
        /// Why, from RustDDS.
        why: String,
    },
}

impl<K: Clone> Inbox<K> {
    /// An inbox without readers; its [`recv`](Self::recv) pends.
    #[must_use]
    pub fn new() -> Self {
        Self {
            slots: BTreeMap::new(),
            next_slot: 0,
            ready: Arc::default(),
        }
    }

    /// Adds a reader; what it already holds is delivered.
    pub fn insert(&mut self, key: K, reader: Reader) -> SlotId {
        let id = self.next_slot;
        self.next_slot += 1;
        let wakeup = Arc::new(Wakeup {
            slot: id,
            queued: AtomicBool::new(false),
            ready: Arc::clone(&self.ready),
        });
        wakeup.wake_by_ref();
        self.slots.insert(
            id,
            Box::new(Slot {
                key,
                reader,
                delivered: BTreeMap::new(),
                waker: Waker::from(Arc::clone(&wakeup)),
                wakeup,
            }),
        );
        SlotId(id)
    }

    /// Puts another reader of the same topic in a slot and returns the one before; samples both received are
    /// delivered once.
    pub fn replace(&mut self, id: SlotId, reader: Reader) -> Option<Reader> {
        let slot = self.slots.get_mut(&id.0)?;
        slot.reader.set_waker(None);
        let before = std::mem::replace(&mut slot.reader, reader);
        slot.wakeup.wake_by_ref();
        Some(before)
    }

    /// Who the reader in a slot is to others.
    #[must_use]
    pub fn guid(&self, id: SlotId) -> Option<GUID> {
        self.slots.get(&id.0).map(|slot| slot.reader.guid())
    }

    /// Takes a reader out.
    pub fn remove(&mut self, id: SlotId) -> Option<Reader> {
        self.slots.remove(&id.0).map(|slot| slot.reader)
    }

    /// What the reader in a slot holds and was not delivered: its history at most.
    pub fn drain(&mut self, id: SlotId) -> Vec<Taken<K>> {
        let Some(slot) = self.slots.get_mut(&id.0) else {
            return Vec::new();
        };
        std::iter::from_fn(|| slot.take()).collect()
    }

    /// Forgets writers of a slot that are not in `alive`, once there are many of them: what they wrote stays in the
    /// cache of the topic, and another reader of it would hand it out again.
    pub fn retain_writers(&mut self, id: SlotId, mut alive: impl FnMut(&GUID) -> bool) {
        if let Some(slot) = self.slots.get_mut(&id.0)
            && slot.delivered.len() > MAX_WRITERS
        {
            slot.delivered.retain(|writer, _| alive(writer));
        }
    }

    /// Has the last sample of a writer delivered once more, should the reader in that slot get it again.
    pub fn repeat_last(&mut self, id: SlotId, writer: GUID) {
        let slot = self.slots.get_mut(&id.0);
        if let Some(last) = slot.and_then(|slot| slot.delivered.get_mut(&writer)) {
            *last = last.saturating_sub(1);
        }
    }

    /// The next sample of any reader. Cancel-safe: a sample is only taken in the poll that returns it.
    pub async fn recv(&mut self) -> Taken<K> {
        poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// As [`recv`](Self::recv), for a hand-written future.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<Taken<K>> {
        self.ready.consumer.register(cx.waker());
        while let Some(id) = self.ready.pop() {
            let Some(slot) = self.slots.get_mut(&id) else {
                continue;
            };
            slot.wakeup.queued.store(false, Ordering::Release);
            if let Some(taken) = slot.take() {
                slot.wakeup.wake_by_ref();
                return Poll::Ready(taken);
            }
        }
        Poll::Pending
    }
}

impl<K: Clone> Default for Inbox<K> {
    fn default() -> Self {
        Self::new()
    }
}

struct Slot<K> {
    key: K,
    reader: Reader,
    /// The last sequence number delivered, by writer.
    delivered: BTreeMap<GUID, i64>,
    wakeup: Arc<Wakeup>,
    waker: Waker,
}

impl<K: std::fmt::Debug> std::fmt::Debug for Slot<K> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Slot")
            .field("key", &self.key)
            .field("reader", &self.reader.guid())
            .finish_non_exhaustive()
    }
}

impl<K: Clone> Slot<K> {
    /// The next sample, or `None` with the waker armed.
    fn take(&mut self) -> Option<Taken<K>> {
        let mut armed = false;
        loop {
            match self.reader.try_take_one() {
                Ok(Some(change)) => {
                    let sequence = i64::from(change.sequence_number);
                    let writer = change.writer_guid();
                    if let Some(missing) = self.advance(writer, sequence) {
                        return Some(Taken::Sample {
                            key: self.key.clone(),
                            payload: change.into_value(),
                            writer,
                            missing,
                        });
                    }
                }
                Ok(None) if armed => return None,
                // What arrives between a take and the arming would wake nobody, hence another look.
                Ok(None) => {
                    self.reader.set_waker(Some(self.waker.clone()));
                    armed = true;
                }
                Err(error) => {
                    return Some(Taken::Unreadable {
                        key: self.key.clone(),
                        why: error.to_string(),
                    });
                }
            }
        }
    }

    /// How many samples of `writer` were skipped before this one; `None` when it was delivered already, which happens
    /// after a reader was replaced, as all readers of a topic share one cache in RustDDS.
    fn advance(&mut self, writer: GUID, sequence: i64) -> Option<u64> {
        let last = self
            .delivered
            .entry(writer)
            .or_insert_with(|| sequence.saturating_sub(1));
        let missing = u64::try_from(sequence.saturating_sub(*last).saturating_sub(1)).ok()?;
        *last = sequence;
        Some(missing.min(MAX_MISSING))
    }
}

/// Writers whose last sample is remembered, the dead ones included.
const MAX_WRITERS: usize = 1024;
/// The most one gap counts: a peer says by itself how many it has written.
const MAX_MISSING: u64 = 1 << 16;

/// Who has something to read, in the order they said so.
#[derive(Debug, Default)]
struct Ready {
    queue: Mutex<VecDeque<u64>>,
    consumer: AtomicWaker,
}

impl Ready {
    fn pop(&self) -> Option<u64> {
        self.queue
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .pop_front()
    }
}

/// One reader's waker: puts the reader into the queue, once.
#[derive(Debug)]
struct Wakeup {
    slot: u64,
    queued: AtomicBool,
    ready: Arc<Ready>,
}

impl Wake for Wakeup {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.queued.swap(true, Ordering::AcqRel) {
            self.ready
                .queue
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .push_back(self.slot);
            self.ready.consumer.wake();
        }
    }
}
