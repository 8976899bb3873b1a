//! Recognises the copies of events. An event is sent several times, so that a lost datagram does
//! not lose it; a viewer needs it once.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use mappings::TopicId;

use super::book::ReceivedSample;

/// The last value of each topic.
#[derive(Debug, Default)]
pub(super) struct Copies {
    last: BTreeMap<TopicId, Last>,
}

/// A value as its writer identifies it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Identity {
    from: SocketAddr,
    sequence: Option<u16>,
    /// The time at which the writer took the value, in nanoseconds since 1970.
    taken: i128,
}

#[derive(Debug)]
struct Last {
    identity: Identity,
    /// The arrival of its first copy.
    first: Duration,
}

impl Copies {
    /// Returns whether a value arrived before, a short time ago. A state that is repeated for late
    /// joiners is no copy, because a viewer may be one of them.
    pub(super) fn is_copy(&mut self, sample: &ReceivedSample<'_>, now: Duration) -> bool {
        sample.taken().is_some_and(|taken| {
            let identity = Identity {
                from: sample.from,
                sequence: sample.message.sequence_number(),
                taken,
            };
            self.is_known(sample.topic, identity, now)
        })
    }

    fn is_known(&mut self, topic: TopicId, identity: Identity, now: Duration) -> bool {
        let is_known = self.last.get(&topic).is_some_and(|last| {
            last.identity == identity && now.saturating_sub(last.first) <= COPIES_WITHIN
        });
        let has_room = self.last.len() < MOST_TOPICS || self.last.contains_key(&topic);
        if !is_known && has_room {
            let first = now;
            self.last.insert(topic, Last { identity, first });
        }
        is_known
    }
}

/// Copies of an event are sent within 100 ms; states are repeated after 500 ms or more.
const COPIES_WITHIN: Duration = Duration::from_millis(300);
/// Maximum number of topics; of further topics each copy counts as a value.
const MOST_TOPICS: usize = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_copy_comes_soon_and_is_the_same_value_of_the_same_sender() {
        let topic: TopicId = "ua_1_2_10".parse().unwrap();
        let other: TopicId = "ua_1_2_11".parse().unwrap();
        let event = Identity {
            from: SocketAddr::from(([10, 0, 0, 1], 4000)),
            sequence: Some(7),
            taken: 1_000,
        };
        let ms = Duration::from_millis;
        let mut copies = Copies::default();
        assert!(!copies.is_known(topic, event, ms(0)));
        assert!(copies.is_known(topic, event, ms(20)));
        assert!(!copies.is_known(other, event, ms(30)));
        assert!(copies.is_known(topic, event, ms(100)));
        assert!(!copies.is_known(topic, event, ms(1000)), "a repetition");
        for new in [
            Identity {
                sequence: Some(8),
                ..event
            },
            Identity {
                taken: 1_001,
                ..event
            },
            Identity {
                from: SocketAddr::from(([10, 0, 0, 2], 4000)),
                ..event
            },
        ] {
            assert!(!copies.is_known(topic, new, ms(1010)), "{new:?}");
            assert!(copies.is_known(topic, new, ms(1020)), "{new:?}");
        }
    }
}
