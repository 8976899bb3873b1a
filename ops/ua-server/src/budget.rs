//! Limits of the memory of decoded values for clients: values in responses, and values queued in
//! subscriptions.
//!
//! The server copies the values it receives and does not report when it releases them. The
//! accounting is therefore an upper bound.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use opcua::server::MonitoredItemHandle;

/// The responses of the last [`ANSWERED`].
#[derive(Debug, Default)]
pub(crate) struct Answers {
    given: VecDeque<(Instant, usize)>,
    bytes: usize,
}

impl Answers {
    /// Reserves memory for a response of `bytes`. Returns false if there is not enough left.
    pub(crate) fn take(&mut self, bytes: usize, now: Instant) -> bool {
        while let Some((at, given)) = self.given.front().copied()
            && now.saturating_duration_since(at) >= ANSWERED
        {
            self.given.pop_front();
            self.bytes -= given;
        }
        let room = MOST_ANSWERED.saturating_sub(self.bytes);
        let fits = bytes <= room;
        if fits {
            self.given.push_back((now, bytes));
            self.bytes += bytes;
        }
        fits
    }
}

/// The monitored items and the memory of their large values.
#[derive(Debug, Default)]
pub(crate) struct MonitoredMemory {
    items: HashMap<MonitoredItemHandle, Item>,
    bytes: usize,
}

#[derive(Debug)]
struct Item {
    unfiltered: bool,
    /// Size of the queue of the item, in values.
    queue: usize,
    /// Bytes that are reserved for the item.
    bytes: usize,
    /// Number of smaller values after the last large value.
    smaller: usize,
}

impl Item {
    const fn copies(&self) -> usize {
        self.queue.saturating_add(BESIDE_THE_QUEUE)
    }
}

impl MonitoredMemory {
    /// Adds a monitored item. Items beyond the limit are not notified if only the status changes,
    /// and get no large values.
    pub(crate) fn insert(&mut self, handle: MonitoredItemHandle, unfiltered: bool, queue: usize) {
        if self.items.len() < MOST_ITEMS {
            let item = Item {
                unfiltered,
                queue,
                bytes: 0,
                smaller: 0,
            };
            self.items.insert(handle, item);
        }
    }

    /// Changes the queue size of an item.
    pub(crate) fn resize(&mut self, handle: MonitoredItemHandle, queue: usize) {
        if let Some(item) = self.items.get_mut(&handle) {
            item.queue = queue;
        }
    }

    pub(crate) fn remove(&mut self, handle: MonitoredItemHandle) {
        if let Some(item) = self.items.remove(&handle) {
            self.bytes -= item.bytes;
        }
    }

    pub(crate) fn is_unfiltered(&self, handle: MonitoredItemHandle) -> bool {
        self.items.get(&handle).is_some_and(|item| item.unfiltered)
    }

    /// Reserves memory for a value of `bytes` in all copies that the item keeps. Returns false if
    /// there is not enough left.
    pub(crate) fn take(&mut self, handle: MonitoredItemHandle, bytes: usize) -> bool {
        let Some(item) = self.items.get_mut(&handle) else {
            return bytes <= SMALL;
        };
        let wanted = match bytes {
            ..=SMALL => 0,
            _ => bytes.saturating_mul(item.copies()),
        };
        if wanted < item.bytes {
            // The larger values occupy memory until smaller values have replaced all their copies.
            item.smaller += 1;
            if item.smaller < item.copies() {
                return true;
            }
        }
        let others = self.bytes - item.bytes;
        if wanted > MOST_WATCHED.saturating_sub(others) {
            return false;
        }
        (item.bytes, item.smaller) = (wanted, 0);
        self.bytes = others + wanted;
        true
    }
}

/// Values up to this size are not counted. The limits of sessions, items and queue sizes suffice
/// for them.
pub(crate) const SMALL: usize = 64 << 10;
/// The largest decoded value in a response. It is large enough for the largest ByteString.
pub(crate) const LARGEST: usize = 128 << 20;
const MOST_ANSWERED: usize = 512 << 20;
/// Time within which a response is expected to be encoded. Responses are encoded as soon as their
/// session has a thread.
const ANSWERED: Duration = Duration::from_millis(500);
const MOST_WATCHED: usize = 512 << 20;
/// Copies beside the queue: the value to compare with, the value being sent, and values that were
/// not acknowledged yet.
const BESIDE_THE_QUEUE: usize = 4;
const MOST_ITEMS: usize = 100_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn item(monitored_item_id: u32) -> MonitoredItemHandle {
        MonitoredItemHandle {
            subscription_id: 1,
            monitored_item_id,
        }
    }

    const MIB: usize = 1 << 20;

    #[test]
    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn answers_have_room_again_when_the_ones_before_have_gone_out() {
        let (mut answers, start) = (Answers::default(), Instant::now());
        for _ in 0..4 {
            assert!(answers.take(128 * MIB, start));
        }
        assert!(!answers.take(1, start + ANSWERED / 2));
        assert!(answers.take(512 * MIB, start + ANSWERED));
    }

    #[test]
    fn watchers_of_large_values_get_them_while_there_is_room_for_all_their_copies() {
        let mut watched = MonitoredMemory::default();
        for id in 0..5 {
            watched.insert(item(id), true, 1);
        }
        let large = 20 * MIB;
        let got: Vec<bool> = (0..6).map(|id| watched.take(item(id), large)).collect();
        assert_eq!(
            got,
            [true, true, true, true, true, false],
            "5 times 5 copies"
        );
        watched.resize(item(0), 10);
        assert!(!watched.take(item(0), large), "10 more do not fit");
        watched.remove(item(1));
        watched.remove(item(2));
        assert!(watched.take(item(0), large));
    }

    #[test]
    fn a_large_value_counts_until_all_its_copies_have_given_way() {
        let mut watched = MonitoredMemory::default();
        watched.insert(item(1), true, 1);
        assert!(watched.take(item(1), 100 * MIB));
        for _ in 0..4 {
            assert!(watched.take(item(1), 1));
            assert_eq!(watched.bytes, 500 * MIB);
        }
        assert!(watched.take(item(1), 1));
        assert_eq!(watched.bytes, 0);
    }
}
