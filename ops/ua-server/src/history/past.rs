//! The last values of each topic, limited for each topic and for all topics together.

use std::collections::{HashMap, VecDeque};

use mappings::TopicId;
use opcua::types::StatusCode;
use uadp::Timestamp;

use super::store::{HistoryFile, StoredValue};
use crate::layout::TopicNode;
use crate::values::ShownValue;

/// Past values, oldest first in each topic.
#[derive(Debug)]
pub(crate) struct Past {
    /// Largest number of values of topics without an own limit.
    most_values: usize,
    /// Limits of single topics.
    own: HashMap<TopicId, usize>,
    /// Largest size of all values, in bytes.
    most_bytes: usize,
    bytes: usize,
    /// The number of the next value.
    next: u64,
    topics: HashMap<TopicId, Kept>,
    /// The file of the values.
    store: Option<HistoryFile>,
}

#[derive(Debug, Default)]
struct Kept {
    values: VecDeque<(u64, ShownValue)>,
    bytes: usize,
}

impl Past {
    /// Creates a store with `most_values` for each topic and `most_bytes` for all topics.
    pub(crate) fn new(most_values: usize, most_bytes: usize) -> Self {
        Self {
            most_values,
            own: HashMap::new(),
            most_bytes,
            bytes: 0,
            next: 0,
            topics: HashMap::new(),
            store: None,
        }
    }

    /// Adds the values of a file, and stores all further values in the file. Each topic gets the
    /// mark `BadDataLost` for the time without the server (OPC 10000-11, 6.7), unless its last
    /// value is such a mark: repeated restarts do not displace the values.
    pub(crate) fn keep_in(&mut self, store: HistoryFile, stored: Vec<StoredValue>) {
        let last = stored.iter().map(|(_, _, shown)| shown.stamp.server).max();
        let next = stored
            .iter()
            .map(|(_, number, _)| number.saturating_add(1))
            .max();
        self.next = self.next.max(next.unwrap_or_default());
        self.store = Some(store);
        for (topic, number, shown) in stored {
            self.insert(topic, number, shown);
        }
        self.enforce();
        let Some(last) = last else { return };
        let mut lost = ShownValue::nothing(StatusCode::BadDataLost);
        lost.stamp.server = last;
        lost.stamp.source = Some(Timestamp {
            time: uadp::DateTime(last.ticks()),
            picoseconds: 0,
        });
        let is_marked = |kept: &Kept| {
            let newest = kept.values.back();
            newest.is_some_and(|(_, shown)| shown.stamp.status == lost.stamp.status)
        };
        let unmarked = self.topics.iter().filter(|(_, kept)| !is_marked(kept));
        let topics: Vec<TopicId> = unmarked.map(|(topic, _)| *topic).collect();
        for topic in topics {
            self.keep(topic, &lost);
        }
    }

    /// Stores the type of a new topic in the file.
    pub(crate) fn describe(&self, topic: &TopicNode) {
        if let Some(store) = &self.store
            && topic.historizing
        {
            store.describe(topic);
        }
    }

    /// Writes the values that are not in the file, and stops storing values there.
    pub(crate) fn close(&mut self) {
        drop(self.store.take());
    }

    fn insert(&mut self, topic: TopicId, number: u64, shown: ShownValue) {
        let size = size(&shown);
        let kept = self.topics.entry(topic).or_default();
        kept.values.push_back((number, shown));
        kept.bytes += size;
        self.bytes += size;
    }

    /// Changes the limits: values of each topic, bytes of all topics, and values of single topics.
    pub(crate) fn limit(
        &mut self,
        (most_values, most_bytes): (usize, usize),
        own: HashMap<TopicId, usize>,
    ) {
        (self.most_values, self.most_bytes, self.own) = (most_values, most_bytes, own);
        self.enforce();
    }

    /// Drops the values beyond the limits.
    fn enforce(&mut self) {
        for (topic, kept) in &mut self.topics {
            let most = self.own.get(topic).copied().unwrap_or(self.most_values);
            let over = kept.values.len().saturating_sub(most);
            self.bytes -= kept.drop_oldest(over, (*topic, self.store.as_ref()));
        }
        while self.bytes > self.most_bytes {
            self.make_room();
        }
    }

    /// Stores the current value of a topic. If the store is full, topics that occupy three quarters
    /// of their share or more drop the older half of their values.
    pub(crate) fn keep(&mut self, topic: TopicId, shown: &ShownValue) {
        let size = size(shown);
        let most = self.own.get(&topic).copied().unwrap_or(self.most_values);
        if most == 0 || size > self.most_bytes {
            return;
        }
        if let Some(store) = &self.store {
            store.keep(topic, self.next, shown);
        }
        self.insert(topic, self.next, shown.clone());
        self.next += 1;
        if let Some(kept) = self.topics.get_mut(&topic)
            && kept.values.len() > most
        {
            self.bytes -= kept.drop_oldest(1, (topic, self.store.as_ref()));
        }
        while self.bytes > self.most_bytes {
            self.make_room();
        }
    }

    /// Topics below three quarters of their share hold less than three quarters of all bytes. Each
    /// pass therefore frees a large part of the rest, and passes are rare.
    fn make_room(&mut self) {
        let share = self.most_bytes / self.topics.len().max(1);
        for (topic, kept) in &mut self.topics {
            if kept.bytes > share / 4 * 3 {
                let half = kept.values.len().div_ceil(2);
                self.bytes -= kept.drop_oldest(half, (*topic, self.store.as_ref()));
            }
        }
    }

    /// Returns the values of a topic in the order of their arrival, each with its unique number.
    pub(crate) fn of(&self, topic: TopicId) -> Vec<(u64, ShownValue)> {
        let kept = self.topics.get(&topic);
        kept.map_or_else(Vec::new, |kept| kept.values.iter().cloned().collect())
    }

    /// Removes a topic.
    pub(crate) fn remove(&mut self, topic: TopicId) {
        if let Some(gone) = self.topics.remove(&topic) {
            self.bytes -= gone.bytes;
        }
        if let Some(store) = &self.store {
            store.remove_before(topic, self.next);
        }
    }
}

impl Kept {
    /// Drops the oldest values, in the file too, and returns the number of freed bytes.
    fn drop_oldest(
        &mut self,
        count: usize,
        (topic, store): (TopicId, Option<&HistoryFile>),
    ) -> usize {
        let gone = self.values.drain(..count.min(self.values.len()));
        let mut behind = None;
        let mut freed = 0;
        for (number, gone) in gone {
            freed += size(&gone);
            behind = Some(number + 1);
        }
        if let (Some(store), Some(behind)) = (store, behind) {
            store.remove_before(topic, behind);
        }
        self.bytes -= freed;
        freed
    }
}

/// Returns the memory size of a value.
fn size(shown: &ShownValue) -> usize {
    shown.block.as_ref().map_or(0, bytes::Bytes::len) + BESIDE
}

/// Size of the stamps, spare capacity for further entries, and the allocation of the bytes.
const BESIDE: usize = 2 * size_of::<(u64, ShownValue)>() + 48;

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use opcua::types::StatusCode;

    use super::*;

    fn value(size: usize, mark: u8) -> ShownValue {
        ShownValue {
            block: Some(Bytes::from(vec![mark; size])),
            ..ShownValue::nothing(StatusCode::Good)
        }
    }

    fn marks(past: &Past, topic: TopicId) -> Vec<u8> {
        let all = past.of(topic);
        all.iter()
            .map(|(_, shown)| shown.block.as_ref().unwrap()[0])
            .collect()
    }

    #[test]
    fn each_topic_keeps_its_last_values() {
        let (one, other) = (
            TopicId::new(1, 2, 3).unwrap(),
            TopicId::new(1, 2, 4).unwrap(),
        );
        let mut past = Past::new(3, 1 << 20);
        for mark in 0..5 {
            past.keep(one, &value(4, mark));
        }
        past.keep(other, &value(4, 9));
        assert_eq!(marks(&past, one), [2, 3, 4]);
        assert_eq!(marks(&past, other), [9]);
        past.remove(one);
        assert_eq!(past.bytes, 4 + BESIDE);
    }

    #[test]
    fn a_topic_with_a_number_of_its_own_keeps_so_many_and_fewer_when_told() {
        let (one, other, none) = (
            TopicId::new(1, 2, 3).unwrap(),
            TopicId::new(1, 2, 4).unwrap(),
            TopicId::new(1, 2, 5).unwrap(),
        );
        let mut past = Past::new(3, 1 << 20);
        past.limit((3, 1 << 20), HashMap::from([(one, 5), (none, 0)]));
        for mark in 0..6 {
            for topic in [one, other, none] {
                past.keep(topic, &value(4, mark));
            }
        }
        assert_eq!(marks(&past, one), [1, 2, 3, 4, 5]);
        assert_eq!(marks(&past, other), [3, 4, 5]);
        assert!(marks(&past, none).is_empty());
        past.limit((2, 1 << 20), HashMap::from([(other, 1)]));
        assert_eq!(marks(&past, one), [4, 5]);
        assert_eq!(marks(&past, other), [5]);
        assert_eq!(past.bytes, 3 * (4 + BESIDE));
    }

    #[test]
    fn values_of_a_file_come_first_and_the_time_without_the_server_is_marked() {
        let topic = TopicId::new(1, 2, 3).unwrap();
        let name = format!("ua-past-{}", std::process::id());
        let file = std::env::temp_dir().join(name);
        let opened = || HistoryFile::open(&file, std::iter::empty()).unwrap();
        let stored = (4..8).map(|number| (topic, number, value(4, 1)));
        let mut past = Past::new(3, 1 << 20);
        past.keep_in(opened().0, stored.collect());
        let kept = past.of(topic);
        let numbers: Vec<u64> = kept.iter().map(|(number, _)| *number).collect();
        assert_eq!(numbers, [6, 7, 8]);
        let (_, mark) = kept.last().unwrap();
        assert_eq!(mark.stamp.status, StatusCode::BadDataLost);
        past.close();
        // The file is free again.
        drop(opened());
        // A second restart without a new value adds no second mark.
        let lost = ShownValue::nothing(StatusCode::BadDataLost);
        let mut past = Past::new(9, 1 << 20);
        past.keep_in(opened().0, vec![(topic, 0, value(4, 1)), (topic, 1, lost)]);
        assert_eq!(past.of(topic).len(), 2);
        past.close();
        drop(std::fs::remove_file(&file));
    }

    #[test]
    fn large_values_of_one_topic_do_not_drive_out_those_of_others() {
        let (small, large) = (
            TopicId::new(1, 2, 3).unwrap(),
            TopicId::new(1, 2, 4).unwrap(),
        );
        let mut past = Past::new(1000, 10 * (1000 + BESIDE));
        for mark in 0..5 {
            past.keep(small, &value(4, mark));
        }
        for mark in 0..100 {
            past.keep(large, &value(1000, mark));
            assert!(past.bytes <= past.most_bytes);
        }
        assert_eq!(marks(&past, small), [0, 1, 2, 3, 4]);
        assert_eq!(marks(&past, large).last(), Some(&99));
        past.keep(large, &value(1 << 20, 1));
        assert_eq!(
            marks(&past, large).last(),
            Some(&99),
            "what is larger than all is not kept"
        );
    }

    #[test]
    fn where_all_topics_want_more_than_their_share_each_has_about_as_much() {
        let topics: Vec<TopicId> = (1..=100)
            .map(|id| TopicId::new(1, 2, id).unwrap())
            .collect();
        let mut past = Past::new(1000, 1000 * (4 + BESIDE));
        for mark in 0..100 {
            for topic in &topics {
                past.keep(*topic, &value(4, mark));
                assert!(past.bytes <= past.most_bytes);
            }
        }
        for topic in topics {
            let kept = marks(&past, topic);
            assert!((4..=11).contains(&kept.len()), "{kept:?}");
            assert_eq!(kept.last(), Some(&99));
        }
    }
}
