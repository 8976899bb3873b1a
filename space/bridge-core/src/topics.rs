//! The table of topics.

use std::collections::HashMap;
use std::time::Duration;

use mappings::TopicId;

use crate::counters::Counters;
use crate::reader::ReceivedTopicState;
use crate::topic::{Topic, TopicSide};
use crate::writer::SentTopicState;

/// The topics of a Router. A topic is looked up once for each sample; its [`Handle`] then leads to
/// the entry without another search.
#[derive(Debug, Default)]
pub(crate) struct TopicTable {
    index: HashMap<TopicId, usize>,
    slots: Vec<Option<Slot>>,
    /// The slots without a topic.
    free: Vec<usize>,
    /// Counters of datagrams and messages without a topic, and of removed topics.
    others: Counters,
}

#[derive(Debug)]
struct Slot {
    topic: TopicId,
    entry: Topic,
}

/// The position of a topic in the table, until the topic is removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Handle {
    topic: TopicId,
    slot: usize,
}

impl Handle {
    pub(crate) const fn topic(self) -> TopicId {
        self.topic
    }
}

impl TopicTable {
    /// Looks a topic up.
    pub(crate) fn find(&self, topic: TopicId) -> Option<Handle> {
        let slot = *self.index.get(&topic)?;
        Some(Handle { topic, slot })
    }

    /// Adds a topic that is not in the table.
    pub(crate) fn insert(&mut self, topic: TopicId, entry: Topic) -> Handle {
        let slot = self.free.pop().unwrap_or_else(|| {
            self.slots.push(None);
            self.slots.len() - 1
        });
        if let Some(of) = self.slots.get_mut(slot) {
            *of = Some(Slot { topic, entry });
        }
        self.index.insert(topic, slot);
        Handle { topic, slot }
    }

    /// Removes a topic, and keeps its counters in total.
    pub(crate) fn remove(&mut self, topic: TopicId) -> Option<Topic> {
        let slot = self.index.remove(&topic)?;
        let Slot { entry, .. } = self.slots.get_mut(slot)?.take()?;
        self.free.push(slot);
        self.others.absorb(&entry.counters);
        Some(entry)
    }

    /// Returns the entry of a topic.
    #[inline]
    pub(crate) fn at(&self, at: Handle) -> Option<&Topic> {
        let slot = self.slots.get(at.slot)?.as_ref()?;
        (slot.topic == at.topic).then_some(&slot.entry)
    }

    /// Returns the entry of a topic.
    #[inline]
    pub(crate) fn at_mut(&mut self, at: Handle) -> Option<&mut Topic> {
        let slot = self.slots.get_mut(at.slot)?.as_mut()?;
        (slot.topic == at.topic).then_some(&mut slot.entry)
    }

    /// Returns the reader of a topic of another space.
    #[inline]
    pub(crate) fn reader(&mut self, at: Handle) -> Option<&mut ReceivedTopicState> {
        match &mut self.at_mut(at)?.role {
            TopicSide::Theirs(reader) => Some(reader),
            TopicSide::Ours(_) => None,
        }
    }

    /// Returns the writer of a topic of the own space.
    #[inline]
    pub(crate) fn writer(&mut self, at: Handle) -> Option<&mut SentTopicState> {
        match &mut self.at_mut(at)?.role {
            TopicSide::Ours(writer) => Some(writer),
            TopicSide::Theirs(_) => None,
        }
    }

    /// Looks a topic up, and returns its entry.
    pub(crate) fn get(&self, topic: &TopicId) -> Option<&Topic> {
        self.at(self.find(*topic)?)
    }

    /// Looks a topic up, and returns its entry.
    pub(crate) fn get_mut(&mut self, topic: &TopicId) -> Option<&mut Topic> {
        self.at_mut(self.find(*topic)?)
    }

    /// Looks a topic of another space up, and returns its reader.
    pub(crate) fn reader_of(&mut self, topic: TopicId) -> Option<&mut ReceivedTopicState> {
        self.reader(self.find(topic)?)
    }

    /// Looks a topic of the own space up, and returns its writer.
    pub(crate) fn writer_of(&mut self, topic: TopicId) -> Option<&mut SentTopicState> {
        self.writer(self.find(topic)?)
    }

    /// Returns all topics in no particular order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (TopicId, &Topic)> {
        let slots = self.slots.iter().flatten();
        slots.map(|slot| (slot.topic, &slot.entry))
    }

    /// Returns the handles of all topics in no particular order.
    pub(crate) fn handles(&self) -> Vec<Handle> {
        let slots = self.slots.iter().enumerate();
        slots
            .filter_map(|(slot, of)| {
                let topic = of.as_ref()?.topic;
                Some(Handle { topic, slot })
            })
            .collect()
    }

    /// Returns whether there are so many topics that their repetitions are spread over the period.
    pub(crate) fn is_spread(&self) -> bool {
        self.index.len() >= SPREAD
    }

    /// Returns by how much a topic repeats earlier than after `period`, once. Many topics that
    /// start together are then spread over the period instead of being repeated in a burst.
    pub(crate) fn lead(&self, at: Handle, period: Duration) -> Duration {
        if !self.is_spread() {
            return Duration::ZERO;
        }
        // Multiples of the golden ratio divide the period evenly for any number of slots.
        let slot = u32::try_from(at.slot).unwrap_or_default();
        let share = f64::from(slot.wrapping_mul(GOLDEN)) / (f64::from(u32::MAX) + 1.0);
        period.mul_f64(share)
    }

    /// Returns the counters of datagrams and messages without a topic, and of removed topics.
    pub(crate) const fn others(&self) -> &Counters {
        &self.others
    }

    /// Returns the counters of datagrams and messages without a topic.
    pub(crate) const fn others_mut(&mut self) -> &mut Counters {
        &mut self.others
    }

    /// Returns the counters of a topic, or the common counters if there is no such topic.
    pub(crate) fn counters(&mut self, topic: Option<TopicId>) -> &mut Counters {
        let slot = topic.and_then(|topic| self.index.get(&topic));
        let slot = slot.and_then(|slot| self.slots.get_mut(*slot)?.as_mut());
        slot.map_or(&mut self.others, |slot| &mut slot.entry.counters)
    }
}

/// The number of topics from which on their repetitions are spread.
const SPREAD: usize = 64;
/// The fraction of the golden ratio, times 2 to the 32.
const GOLDEN: u32 = 0x9E37_79B9;

#[cfg(test)]
mod tests {
    use mappings::{Lasting, Overflow};

    use super::*;
    use crate::counters::Reason;

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn topic() -> Topic {
        let writer = SentTopicState::new(std::time::Instant::now());
        let rules = <(Overflow, Lasting)>::default();
        Topic::new(TopicSide::Ours(Box::new(writer)), rules)
    }

    fn id(text: &str) -> TopicId {
        text.parse().unwrap()
    }

    #[test]
    fn a_handle_ends_with_its_topic_even_if_another_topic_takes_the_slot() {
        let mut topics = TopicTable::default();
        let (first, second) = (id("ua_1_1_1"), id("ua_1_1_2"));
        let at = topics.insert(first, topic());
        assert_eq!(topics.find(first), Some(at));
        assert!(topics.writer(at).is_some() && topics.reader(at).is_none());
        assert!(topics.remove(first).is_some());
        assert!(topics.at(at).is_none() && topics.find(first).is_none());
        let other = topics.insert(second, topic());
        assert_eq!(other.slot, at.slot, "the slot is used again");
        assert!(topics.at(at).is_none());
        assert!(topics.at_mut(other).is_some());
        assert_eq!(topics.handles(), [other]);
    }

    #[test]
    fn many_topics_are_spread_over_the_period_and_few_are_not() {
        let mut topics = TopicTable::default();
        let period = Duration::from_secs(1);
        let add = |topics: &mut TopicTable, id: u16| {
            let topic = TopicId::new(1, 5, id).unwrap();
            topics.insert(topic, self::topic())
        };
        let few: Vec<_> = (1..=10).map(|id| add(&mut topics, id)).collect();
        assert!(few.iter().all(|at| topics.lead(*at, period).is_zero()));
        for id in 11..=1000 {
            add(&mut topics, id);
        }
        let mut tenths = [0; 10];
        for at in topics.handles() {
            let lead = topics.lead(at, period);
            assert!(lead < period);
            tenths[usize::try_from(lead.as_millis() / 100).unwrap()] += 1;
        }
        assert!(
            tenths.iter().all(|count| (95..=105).contains(count)),
            "{tenths:?}"
        );
    }

    #[test]
    fn the_counters_of_a_removed_topic_are_kept_in_total() {
        let mut topics = TopicTable::default();
        let first = id("ua_1_1_1");
        topics.insert(first, topic());
        topics.counters(Some(first)).add(Reason::Overflow, 2);
        topics.counters(None).add(Reason::Overflow, 1);
        topics.remove(first);
        topics.counters(Some(first)).add(Reason::Overflow, 1);
        assert_eq!(topics.others().dropped(Reason::Overflow), 4);
    }
}
