//! The bounded queue of one topic.

use std::collections::VecDeque;

use mappings::Overflow;

/// Samples of one topic that wait to be polled. When full, the oldest gives way: nothing ever blocks a producer.
#[derive(Debug)]
pub(crate) struct Queue<T> {
    items: VecDeque<T>,
    depth: usize,
}

impl<T> Queue<T> {
    pub(crate) fn new(overflow: Overflow) -> Self {
        let depth = match overflow {
            Overflow::KeepLatest => 1,
            Overflow::DropOldest(depth) => usize::from(depth.get()),
        };
        Self {
            items: VecDeque::new(),
            depth,
        }
    }

    /// Appends a sample and gives back the oldest one if it had to go.
    pub(crate) fn push(&mut self, item: T) -> Option<T> {
        let dropped = if self.items.len() >= self.depth {
            self.items.pop_front()
        } else {
            None
        };
        self.items.push_back(item);
        dropped
    }

    pub(crate) fn pop(&mut self) -> Option<T> {
        self.items.pop_front()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;

    use super::*;

    #[test]
    fn the_latest_samples_stay_in_order() {
        let mut queue = Queue::new(Overflow::DropOldest(NonZeroU16::new(2).unwrap()));
        let dropped: Vec<_> = (1..=4).filter_map(|sample| queue.push(sample)).collect();
        assert_eq!(dropped, [1, 2]);
        assert_eq!(
            (queue.pop(), queue.pop(), queue.pop()),
            (Some(3), Some(4), None)
        );
    }

    #[test]
    fn keep_latest_keeps_one() {
        let mut queue = Queue::new(Overflow::KeepLatest);
        assert_eq!((queue.push(1), queue.push(2)), (None, Some(1)));
        assert_eq!((queue.pop(), queue.pop()), (Some(2), None));
    }
}
