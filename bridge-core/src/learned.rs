//! What writers of other spaces announced of their topics, within bounds.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::TopicId;

/// What is known of topics from their DataSetMetaData. Whoever sends to the group can announce, so what is kept is
/// bounded in number and bytes, and forgotten when it is not announced again.
#[derive(Debug)]
pub(crate) struct Learned<T> {
    known: HashMap<TopicId, Known<T>>,
    weight: usize,
}

#[derive(Debug)]
struct Known<T> {
    described: Arc<T>,
    until: Instant,
}

/// What takes up memory.
pub(crate) trait Weight {
    /// Roughly the bytes it takes up.
    fn weight(&self) -> usize;
}

impl<T> Default for Learned<T> {
    fn default() -> Self {
        Self {
            known: HashMap::new(),
            weight: 0,
        }
    }
}

/// What is new about an announcement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum News {
    /// It says what is known already.
    Same,
    /// It says something new.
    Other,
    /// There is no room for it.
    Full,
}

impl<T: Weight + PartialEq> Learned<T> {
    /// Takes note of what a topic is, for some time. Where there is no room, one that is read has precedence over all
    /// that are not.
    pub(crate) fn learn(
        &mut self,
        topic: TopicId,
        described: T,
        (now, period): (Instant, Duration),
        is_read: impl Fn(TopicId) -> bool,
    ) -> News {
        let until = now + period.saturating_mul(MISSED).max(LEAST);
        if let Some(known) = self.known.get_mut(&topic)
            && *known.described == described
        {
            known.until = until;
            return News::Same;
        }
        let weight = described.weight();
        self.forget(topic);
        if !self.has_room(weight) {
            self.retain(|_, known| known.until > now);
        }
        if !self.has_room(weight) && is_read(topic) {
            self.retain(|topic, _| is_read(topic));
        }
        if !self.has_room(weight) {
            return News::Full;
        }
        self.weight += weight;
        let described = Arc::new(described);
        self.known.insert(topic, Known { described, until });
        News::Other
    }

    /// What is known of a topic.
    pub(crate) fn get(&self, topic: TopicId, now: Instant) -> Option<&Arc<T>> {
        let known = self.known.get(&topic)?;
        (known.until > now).then_some(&known.described)
    }

    /// What was said of a topic last, be it long ago.
    pub(crate) fn last(&self, topic: TopicId) -> Option<&Arc<T>> {
        self.known.get(&topic).map(|known| &known.described)
    }

    pub(crate) fn forget(&mut self, topic: TopicId) {
        if let Some(known) = self.known.remove(&topic) {
            self.weight -= known.described.weight();
        }
    }

    fn has_room(&self, weight: usize) -> bool {
        self.known.len() < MAX_TOPICS && self.weight.saturating_add(weight) <= MAX_WEIGHT
    }

    fn retain(&mut self, is_kept: impl Fn(TopicId, &Known<T>) -> bool) {
        let weight = &mut self.weight;
        self.known.retain(|topic, known| {
            let keep = is_kept(*topic, known);
            if !keep {
                *weight -= known.described.weight();
            }
            keep
        });
    }
}

/// Topics described at a time.
const MAX_TOPICS: usize = 4096;
/// Bytes of all descriptions.
const MAX_WEIGHT: usize = 8 << 20;
/// Announcements that may be lost before what they say is forgotten.
const MISSED: u32 = 3;
/// Writers may announce more rarely than we do.
const LEAST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use crate::description::Described;

    use super::*;

    fn described(name: &str) -> Described {
        Described {
            message_type: name.parse().unwrap(),
            bytes: true,
            fields: Vec::new(),
        }
    }

    fn topic(number: usize) -> TopicId {
        let number = u16::try_from(number + 1).unwrap();
        TopicId::new(2, 1, number).unwrap()
    }

    #[test]
    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn no_more_is_kept_than_there_is_room_for_and_the_old_gives_way_when_it_is_not_repeated() {
        let start = Instant::now();
        let mut learned = Learned::default();
        let mut learn = |number: usize, at: Instant| {
            let what = described("std_msgs/Bool");
            learned.learn(topic(number), what, (at, Duration::from_secs(30)), |_| true)
        };
        for number in 0..MAX_TOPICS {
            assert_eq!(learn(number, start), News::Other);
        }
        assert_eq!(learn(MAX_TOPICS, start), News::Full);
        assert_eq!(learn(0, start + LEAST / 2), News::Same);
        assert_eq!(learn(MAX_TOPICS, start + LEAST), News::Other);
        assert!(learned.get(topic(0), start + LEAST).is_some(), "repeated");
        assert!(learned.get(topic(1), start + LEAST).is_none());
        let weight: usize = learned
            .known
            .values()
            .map(|one| one.described.weight())
            .sum();
        assert_eq!((learned.known.len(), learned.weight), (2, weight));
    }

    #[test]
    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn what_is_read_has_precedence_over_what_is_not() {
        let at = (Instant::now(), Duration::from_secs(30));
        let mut learned = Learned::default();
        let read = [topic(0), topic(MAX_TOPICS)];
        let mut learn = |number: usize| {
            let what = described("std_msgs/Bool");
            learned.learn(topic(number), what, at, |topic| read.contains(&topic))
        };
        for number in 0..MAX_TOPICS {
            assert_eq!(learn(number), News::Other);
        }
        assert_eq!(learn(MAX_TOPICS + 1), News::Full);
        assert_eq!(learn(MAX_TOPICS), News::Other);
        assert_eq!(learn(0), News::Same);
        assert_eq!(learned.known.len(), 2);
    }
}
