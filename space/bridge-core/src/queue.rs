//! The bounded queue of a topic.

use std::collections::VecDeque;

use mappings::Overflow;

/// The samples of a topic that wait to be polled, bounded in number and in bytes. A full queue
/// drops its oldest samples, never the newest, and never blocks a producer.
#[derive(Debug)]
pub(crate) struct SampleQueue<T> {
    items: VecDeque<(T, usize)>,
    depth: usize,
    bytes: usize,
}

impl<T> SampleQueue<T> {
    pub(crate) fn new(overflow: Overflow) -> Self {
        let depth = match overflow {
            Overflow::KeepLatest => 1,
            Overflow::DropOldest(depth) => usize::from(depth.get()),
        };
        Self {
            items: VecDeque::new(),
            depth,
            bytes: 0,
        }
    }

    /// Appends a sample of `bytes` bytes and returns the oldest samples that were dropped for it.
    pub(crate) fn push(&mut self, item: T, bytes: usize) -> Vec<T> {
        let mut dropped = Vec::new();
        while self.items.len() >= self.depth
            || (!self.items.is_empty() && self.bytes.saturating_add(bytes) > MAX_BYTES)
        {
            dropped.extend(self.pop());
        }
        self.bytes += bytes;
        self.items.push_back((item, bytes));
        dropped
    }

    pub(crate) fn pop(&mut self) -> Option<T> {
        let (item, bytes) = self.items.pop_front()?;
        self.bytes -= bytes;
        Some(item)
    }

    /// Returns the next item of [`pop`](Self::pop).
    pub(crate) fn front(&self) -> Option<&T> {
        self.items.front().map(|(item, _)| item)
    }

    /// Returns whether the next push drops an older sample even if the new sample is small.
    pub(crate) fn is_full(&self) -> bool {
        self.items.len() >= self.depth
    }

    /// Returns the number of waiting samples.
    pub(crate) fn len(&self) -> usize {
        self.items.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }
}

/// The maximum size of a queue in bytes, unless its newest sample alone is larger: twice the
/// default maximum message size.
const MAX_BYTES: usize = 128 << 20;

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;

    use super::*;

    #[test]
    fn the_latest_samples_stay_in_order() {
        let mut queue = SampleQueue::new(Overflow::DropOldest(NonZeroU16::new(2).unwrap()));
        let dropped: Vec<_> = (1..=4).flat_map(|sample| queue.push(sample, 1)).collect();
        assert_eq!(dropped, [1, 2]);
        assert_eq!(
            (queue.pop(), queue.pop(), queue.pop()),
            (Some(3), Some(4), None)
        );
    }

    #[test]
    fn keep_latest_keeps_one() {
        let mut queue = SampleQueue::new(Overflow::KeepLatest);
        assert_eq!((queue.push(1, 1), queue.push(2, 1)), (vec![], vec![1]));
        assert_eq!((queue.pop(), queue.pop()), (Some(2), None));
    }

    #[test]
    fn large_samples_give_way_before_their_number_is_reached() {
        let mut queue = SampleQueue::new(Overflow::DropOldest(NonZeroU16::new(100).unwrap()));
        let half = MAX_BYTES / 2;
        assert_eq!(queue.push(1, half), [0; 0]);
        assert_eq!(queue.push(2, half), [0; 0]);
        assert_eq!(queue.push(3, 10), [1]);
        assert_eq!(queue.push(4, 2 * MAX_BYTES), [2, 3], "the newest stays");
        assert_eq!(queue.push(5, 10), [4]);
        assert_eq!((queue.pop(), queue.pop(), queue.bytes), (Some(5), None, 0));
    }
}
