//! Bounded storage for the announcements of other spaces about their topics.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::TopicId;

/// The announced metadata of topics. Each sender in the group can announce, so the storage is
/// bounded in number and bytes, and announcements expire if they are not repeated.
#[derive(Debug)]
pub(crate) struct Learned<T> {
    known: HashMap<TopicId, LearnedTopic<T>>,
    weight: usize,
    /// The last time an announcement of this rank found no room. Announcements of this rank or
    /// lower are rejected without another search for a short time after it.
    full: Option<(Instant, TopicPrecedence)>,
}

/// The precedence of topics. Later variants take precedence over earlier variants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum TopicPrecedence {
    /// The values of the topic are not received, or not received any more.
    Stray,
    /// The values of the topic are received.
    Heard,
    /// The mapping contains the topic.
    Mapped,
}

#[derive(Debug)]
struct LearnedTopic<T> {
    described: Arc<T>,
    until: Instant,
}

/// An object that occupies memory.
pub(crate) trait Weight {
    /// Returns the approximate size in bytes.
    fn weight(&self) -> usize;
}

impl<T> Default for Learned<T> {
    fn default() -> Self {
        Self {
            known: HashMap::new(),
            weight: 0,
            full: None,
        }
    }
}

/// The effect of an announcement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AnnouncementEffect {
    /// The announcement equals the stored announcement.
    Same,
    /// The announcement is new or differs.
    Other,
    /// There is no room for the announcement.
    Full,
}

impl<T: Weight + PartialEq> Learned<T> {
    /// Stores the description of a topic for a limited time. If there is no room, expired
    /// announcements are removed first, and then announcements of lower ranks, beginning with the
    /// lowest rank.
    pub(crate) fn learn(
        &mut self,
        topic: TopicId,
        described: T,
        (now, period): (Instant, Duration),
        rank: impl Fn(TopicId) -> TopicPrecedence,
    ) -> AnnouncementEffect {
        let until = now + period.saturating_mul(MISSED).max(LEAST);
        if let Some(known) = self.known.get_mut(&topic)
            && *known.described == described
        {
            known.until = until;
            return AnnouncementEffect::Same;
        }
        let weight = described.weight();
        self.forget(topic);
        if !self.has_room(weight) {
            let own = rank(topic);
            if matches!(self.full, Some((at, of)) if own <= of && now < at + LOOK_AGAIN) {
                return AnnouncementEffect::Full;
            }
            self.retain(|_, known| known.until > now);
            for lower in [TopicPrecedence::Stray, TopicPrecedence::Heard] {
                if lower < own && !self.has_room(weight) {
                    self.retain(|topic, _| rank(topic) > lower);
                }
            }
            if !self.has_room(weight) {
                self.full = Some((now, own));
                return AnnouncementEffect::Full;
            }
        }
        self.weight += weight;
        let described = Arc::new(described);
        self.known.insert(topic, LearnedTopic { described, until });
        AnnouncementEffect::Other
    }

    /// Returns the description of a topic, unless it has expired.
    pub(crate) fn get(&self, topic: TopicId, now: Instant) -> Option<&Arc<T>> {
        let known = self.known.get(&topic)?;
        (known.until > now).then_some(&known.described)
    }

    /// Returns the last description of a topic, even if it has expired.
    pub(crate) fn last(&self, topic: TopicId) -> Option<&Arc<T>> {
        self.known.get(&topic).map(|known| &known.described)
    }

    /// Returns the descriptions that have not expired, in no particular order.
    pub(crate) fn iter(&self, now: Instant) -> impl Iterator<Item = (TopicId, &T)> {
        let known = self
            .known
            .iter()
            .filter(move |(_, known)| known.until > now);
        known.map(|(topic, known)| (*topic, &*known.described))
    }

    pub(crate) fn forget(&mut self, topic: TopicId) {
        if let Some(known) = self.known.remove(&topic) {
            self.weight -= known.described.weight();
        }
    }

    fn has_room(&self, weight: usize) -> bool {
        self.known.len() < MAX_TOPICS && self.weight.saturating_add(weight) <= MAX_WEIGHT
    }

    fn retain(&mut self, is_kept: impl Fn(TopicId, &LearnedTopic<T>) -> bool) {
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

/// The maximum number of described topics.
const MAX_TOPICS: usize = 4096;
/// The maximum number of bytes of all descriptions.
const MAX_WEIGHT: usize = 8 << 20;
/// The time without another search after no room was found.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// The number of consecutive announcements that may be lost before a description expires.
const MISSED: u32 = 3;
/// The minimum lifetime of a description, because writers may announce more rarely than this
/// bridge.
const LEAST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use crate::description::TopicMetaData;

    use super::*;

    fn described(name: &str) -> TopicMetaData {
        TopicMetaData {
            message_type: name.parse().unwrap(),
            bytes: true,
            name: String::new(),
            about: String::new(),
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
            learned.learn(topic(number), what, (at, Duration::from_secs(30)), |_| {
                TopicPrecedence::Heard
            })
        };
        for number in 0..MAX_TOPICS {
            assert_eq!(learn(number, start), AnnouncementEffect::Other);
        }
        assert_eq!(learn(MAX_TOPICS, start), AnnouncementEffect::Full);
        assert_eq!(learn(0, start + LEAST / 2), AnnouncementEffect::Same);
        assert_eq!(learn(MAX_TOPICS, start + LEAST), AnnouncementEffect::Other);
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
    fn what_is_heard_has_precedence_over_what_is_not_and_the_mapping_over_both() {
        let start = Instant::now();
        let mut learned = Learned::default();
        let mut learn = |number: usize, seconds: u64, heard: &[usize], mapped: &[usize]| {
            let of = |numbers: &[usize], it| numbers.iter().any(|number| topic(*number) == it);
            let rank = |it| match (of(mapped, it), of(heard, it)) {
                (true, _) => TopicPrecedence::Mapped,
                (false, true) => TopicPrecedence::Heard,
                (false, false) => TopicPrecedence::Stray,
            };
            let what = described("std_msgs/Bool");
            let at = start + Duration::from_secs(seconds);
            let news = learned.learn(topic(number), what, (at, Duration::from_secs(30)), rank);
            (news, learned.known.len())
        };
        let all: Vec<usize> = (0..MAX_TOPICS).collect();
        for number in &all {
            assert_eq!(
                learn(*number, 0, &all, &[]),
                (AnnouncementEffect::Other, number + 1)
            );
        }
        let stranger = MAX_TOPICS;
        assert_eq!(
            learn(stranger, 0, &all, &[]),
            (AnnouncementEffect::Full, MAX_TOPICS)
        );
        let mapped = MAX_TOPICS + 1;
        assert_eq!(
            learn(mapped, 0, &all, &[mapped]),
            (AnnouncementEffect::Other, 1),
            "of a higher rank it is looked for room at once"
        );
        for number in &all[1..] {
            assert_eq!(
                learn(*number, 1, &[], &[mapped]).0,
                AnnouncementEffect::Other
            );
        }
        let heard = learn(stranger, 2, &[0, stranger], &[mapped]);
        assert_eq!(
            heard,
            (AnnouncementEffect::Other, 2),
            "those that fell silent give way"
        );
        assert_eq!(learn(mapped, 2, &[], &[mapped]).0, AnnouncementEffect::Same);
    }
}
