//! The messages that a topic keeps for late subscribers.

use std::collections::VecDeque;

use bytes::Bytes;

/// Selects how a message is kept for late subscribers. They receive the kept messages in the order
/// of their keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Latched {
    /// The message replaces all other kept messages.
    Alone(u64),
    /// The message is kept beside others and replaces the message with the same key. Beyond
    /// [`MAX_LATCHED`] messages the first other message is dropped.
    Beside(u64),
}

impl Latched {
    /// Returns the key of the message.
    pub(super) const fn key(self) -> u64 {
        match self {
            Self::Alone(key) | Self::Beside(key) => key,
        }
    }
}

/// The latched messages of a topic, and which messages were published last.
#[derive(Debug, Default)]
pub(super) struct LatchedMessages {
    /// Ordered by key.
    kept: Vec<(u64, Bytes)>,
    /// Number of messages published so far.
    count: u64,
    /// The keys of the last published messages, each with the count before it; at most
    /// [`MAX_LATCHED`].
    recent: VecDeque<(u64, u64)>,
}

/// What a subscriber received when it joined.
#[derive(Debug)]
pub(super) struct LatchedAtJoin {
    /// The topic's count of messages.
    count: u64,
    /// The keys of the messages that were latched.
    keys: Vec<u64>,
}

/// A message that is latched again after others with the same key were published.
pub(super) struct LatchedAgain {
    key: u64,
    /// The count of messages before the last one with this key.
    before: u64,
}

impl LatchedAgain {
    /// Returns whether a subscriber joined after the publication and did not receive the message.
    pub(super) fn was_missed_since(&self, join: &LatchedAtJoin) -> bool {
        join.count > self.before && !join.keys.contains(&self.key)
    }
}

impl LatchedMessages {
    /// Records a message that is sent to all connected subscribers.
    pub(super) fn note(&mut self, key: u64) {
        // A source often sends several messages in a row: they use a single entry.
        if self.recent.back().is_some_and(|(last, _)| *last == key) {
            self.recent.pop_back();
        } else if self.recent.len() >= MAX_LATCHED {
            self.recent.pop_front();
        }
        self.recent.push_back((key, self.count));
        self.count += 1;
    }

    /// Returns which subscribers did not receive a message that is not kept, but was published
    /// under this key recently.
    pub(super) fn again(&self, key: u64) -> Option<LatchedAgain> {
        let kept = self.kept.binary_search_by_key(&key, |(key, _)| *key);
        let mut recent = self.recent.iter().rev();
        let (_, before) = recent.find(|(other, _)| kept.is_err() && *other == key)?;
        let before = *before;
        Some(LatchedAgain { key, before })
    }

    /// Keeps a message for late subscribers. Returns the number of messages dropped for lack of
    /// space.
    pub(super) fn keep(&mut self, message: Bytes, latched: Latched) -> u64 {
        if let Latched::Alone(_) = latched {
            self.kept.clear();
        }
        let key = latched.key();
        match self.kept.binary_search_by_key(&key, |(key, _)| *key) {
            Ok(at) => {
                if let Some((_, before)) = self.kept.get_mut(at) {
                    *before = message;
                }
                0
            }
            Err(at) => {
                self.kept.insert(at, (key, message));
                if self.kept.len() <= MAX_LATCHED {
                    return 0;
                }
                // Never removes the new message, which may be the first itself.
                self.kept.remove(usize::from(at == 0));
                1
            }
        }
    }

    /// Removes the message kept under a key.
    pub(super) fn forget(&mut self, key: u64) {
        self.kept.retain(|(other, _)| *other != key);
    }

    /// Removes all kept messages.
    pub(super) fn clear(&mut self) {
        self.kept.clear();
    }

    /// Returns the kept messages in the order of their keys, for a subscriber that joins.
    pub(super) fn kept(&self) -> impl Iterator<Item = &Bytes> {
        self.kept.iter().map(|(_, message)| message)
    }

    /// Returns what a subscriber receives that joins now.
    pub(super) fn at_join(&self) -> LatchedAtJoin {
        LatchedAtJoin {
            count: self.count,
            keys: self.kept.iter().map(|(key, _)| *key).collect(),
        }
    }
}

/// Maximum number of latched messages of a topic.
pub const MAX_LATCHED: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(messages: &LatchedMessages) -> Vec<u64> {
        messages.at_join().keys
    }

    #[test]
    fn beyond_the_maximum_another_message_than_the_newest_is_dropped_and_counted() {
        let mut messages = LatchedMessages::default();
        let mut keep = |key| messages.keep(Bytes::new(), Latched::Beside(key));
        assert_eq!((1..=64).map(&mut keep).sum::<u64>(), 0);
        assert_eq!(keep(0), 1);
        assert_eq!(keys(&messages)[..2], [0, 2]);
        assert_eq!(messages.keep(Bytes::new(), Latched::Beside(99)), 1);
        let kept = keys(&messages);
        assert_eq!((kept[0], kept[63], kept.len()), (2, 99, MAX_LATCHED));
    }

    #[test]
    fn a_message_kept_alone_replaces_all_others_and_one_beside_only_that_of_its_key() {
        let mut messages = LatchedMessages::default();
        for (text, latched) in [
            ("a", Latched::Beside(1)),
            ("b", Latched::Beside(2)),
            ("c", Latched::Beside(1)),
        ] {
            assert_eq!(messages.keep(Bytes::from(text), latched), 0);
        }
        assert!(messages.kept().eq(["c", "b"]));
        messages.forget(2);
        assert!(messages.kept().eq(["c"]));
        messages.keep(Bytes::from("d"), Latched::Alone(7));
        assert!(messages.kept().eq(["d"]));
        messages.clear();
        assert_eq!(messages.kept().count(), 0);
    }

    #[test]
    fn only_subscribers_that_joined_after_a_publication_and_did_not_find_it_kept_missed_it() {
        let mut messages = LatchedMessages::default();
        let before = messages.at_join();
        messages.note(1);
        let after = messages.at_join();
        let again = messages.again(1).unwrap();
        assert!(!again.was_missed_since(&before));
        assert!(again.was_missed_since(&after));
        assert!(messages.again(2).is_none(), "it was never published");
        messages.keep(Bytes::new(), Latched::Beside(1));
        assert!(messages.again(1).is_none(), "it is kept");
        let found = messages.at_join();
        messages.forget(1);
        assert!(!messages.again(1).unwrap().was_missed_since(&found));
    }
}
