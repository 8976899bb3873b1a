//! Combines all readers into one wait: a reader with samples queues up and delivers a single sample
//! per turn.
//!
//! Two queues are bounded: the history of each reader ([`crate::qos::READER_DEPTH`] samples per
//! topic, oldest lost), and the queue of ready readers (one entry per reader). Samples that were
//! overwritten unread show as a gap in their writer's sequence numbers, and are reported with the
//! sample after the gap.

use std::collections::{BTreeMap, VecDeque};
use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use futures_util::task::AtomicWaker;
use rustdds::GUID;

use crate::raw::{Payload, PayloadReader};

/// Readers with a key chosen by the owner.
#[derive(Debug)]
pub struct Inbox<K> {
    /// Boxed, because the nodes of a map that grows at its end stay half empty.
    slots: BTreeMap<u64, Box<Slot<K>>>,
    next_slot: u64,
    ready: Arc<Ready>,
}

/// The slot of a reader in an [`Inbox`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SlotId(u64);

/// The result of a turn.
#[derive(Debug)]
pub enum InboxTurn<K> {
    /// A sample that was not delivered before.
    Sample {
        /// The key of the reader.
        key: K,
        /// The payload of the sample.
        payload: Payload,
        /// The writer of the sample.
        writer: GUID,
        /// The number of samples of this writer that are missing between the last delivered sample
        /// and this sample.
        missing: u64,
    },
    /// A sample that RustDDS received and could not deliver.
    Unreadable {
        /// The key of the reader.
        key: K,
        /// The error of RustDDS.
        why: String,
    },
}

impl<K: Clone> Inbox<K> {
    /// Creates an inbox without readers; its [`recv`](Self::recv) pends.
    #[must_use]
    pub fn new() -> Self {
        Self {
            slots: BTreeMap::new(),
            next_slot: 0,
            ready: Arc::default(),
        }
    }

    /// Adds a reader; its existing samples are delivered.
    pub fn insert(&mut self, key: K, reader: PayloadReader) -> SlotId {
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

    /// Replaces the reader in a slot by another reader of the same topic and returns the former
    /// reader; samples that both received are delivered once.
    pub fn replace(&mut self, id: SlotId, reader: PayloadReader) -> Option<PayloadReader> {
        let slot = self.slots.get_mut(&id.0)?;
        slot.reader.set_waker(None);
        let before = std::mem::replace(&mut slot.reader, reader);
        slot.wakeup.wake_by_ref();
        Some(before)
    }

    /// Returns the GUID of the reader in a slot.
    #[must_use]
    pub fn guid(&self, id: SlotId) -> Option<GUID> {
        self.slots.get(&id.0).map(|slot| slot.reader.guid())
    }

    /// Removes a reader.
    pub fn remove(&mut self, id: SlotId) -> Option<PayloadReader> {
        self.slots.remove(&id.0).map(|slot| slot.reader)
    }

    /// Returns the undelivered samples of the reader in a slot, at most its history.
    pub fn drain(&mut self, id: SlotId) -> Vec<InboxTurn<K>> {
        let Some(slot) = self.slots.get_mut(&id.0) else {
            return Vec::new();
        };
        std::iter::from_fn(|| slot.take()).collect()
    }

    /// Removes the writers of a slot that are not in `alive`, if the slot has many: their samples
    /// stay in the cache of the topic, and another reader of the topic would deliver them again.
    pub fn retain_writers(&mut self, id: SlotId, mut alive: impl FnMut(&GUID) -> bool) {
        if let Some(slot) = self.slots.get_mut(&id.0)
            && slot.delivered.len() > MAX_WRITERS
        {
            slot.delivered.retain(|writer, _| alive(writer));
        }
    }

    /// Allows the last sample of a writer to be delivered again if the reader in the slot receives
    /// it again.
    pub fn repeat_last(&mut self, id: SlotId, writer: GUID) {
        let slot = self.slots.get_mut(&id.0);
        if let Some(last) = slot.and_then(|slot| slot.delivered.get_mut(&writer)) {
            *last = last.saturating_sub(1);
        }
    }

    /// Returns the next sample of any reader. Cancel-safe: a sample is only taken in the poll that
    /// returns it.
    pub async fn recv(&mut self) -> InboxTurn<K> {
        poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// Polls for the next sample as [`recv`](Self::recv) does, for a hand-written future.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<InboxTurn<K>> {
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
    reader: PayloadReader,
    /// The last delivered sequence number, by writer.
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
    /// Takes the next sample, or returns `None` with the waker armed.
    fn take(&mut self) -> Option<InboxTurn<K>> {
        let mut armed = false;
        loop {
            match self.reader.try_take_one() {
                Ok(Some(change)) => {
                    let sequence = i64::from(change.sequence_number);
                    let writer = change.writer_guid();
                    if let Some(missing) = self.advance(writer, sequence) {
                        return Some(InboxTurn::Sample {
                            key: self.key.clone(),
                            payload: change.into_value(),
                            writer,
                            missing,
                        });
                    }
                }
                Ok(None) if armed => return None,
                // A sample that arrives between the take and the arming would wake no task, hence
                // another take.
                Ok(None) => {
                    self.reader.set_waker(Some(self.waker.clone()));
                    armed = true;
                }
                Err(error) => {
                    return Some(InboxTurn::Unreadable {
                        key: self.key.clone(),
                        why: error.to_string(),
                    });
                }
            }
        }
    }

    /// Returns the number of samples of `writer` that were skipped before this sample. Returns
    /// `None` if the sample was delivered already, which happens after a reader was replaced,
    /// because all readers of a topic share one cache in RustDDS.
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

/// Maximum number of writers with a remembered sequence number, including lost writers.
const MAX_WRITERS: usize = 1024;
/// The maximum count of one gap: a peer chooses its sequence numbers freely.
const MAX_MISSING: u64 = 1 << 16;

/// The slots of ready readers, in the order of their wakes.
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

/// The waker of a reader: queues the reader once.
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
