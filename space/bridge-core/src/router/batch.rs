//! Several DataSetMessages in one datagram.

use mappings::{Overflow, TopicId};

use super::{About, Router};
use crate::counters::Reason;
use crate::guard::Guard;
use crate::network::join;
use crate::output::Output;
use crate::settings::Now;
use crate::writer::Encoded;

impl Router {
    /// The datagram of a sample, and of what else waits in its WriterGroup as far as the mapping lets them share one.
    pub(super) fn datagram(
        &mut self,
        topic: TopicId,
        mut first: Encoded,
        now: Now,
    ) -> Option<Output> {
        let others = self.gather(topic, &first);
        let with = others.iter().map(|(topic, _)| *topic).collect();
        if others.is_empty() {
            first.stamp(now.utc);
            return Some(Output::Datagram {
                topic,
                with,
                bytes: first.bytes,
            });
        }
        let mut bytes = self.buffer();
        let messages = others.iter().map(|(topic, other)| (*topic, other));
        let all = std::iter::once((topic, &first)).chain(messages);
        let written = join(&mut bytes, now.utc, all);
        self.recycle(first.bytes);
        for (_, other) in others {
            self.recycle(other.bytes);
        }
        match written {
            Ok(()) => Some(Output::Datagram { topic, with, bytes }),
            Err(error) => {
                for topic in std::iter::once(topic).chain(with) {
                    self.count(About::topic(topic), Reason::TooBig, 1, || error.to_string());
                }
                None
            }
        }
    }

    /// Takes what can go with `first` from the topics that are ready, in the order they are; the others stay in theirs.
    fn gather(&mut self, topic: TopicId, first: &Encoded) -> Vec<(TopicId, Encoded)> {
        let mut gathered = Vec::new();
        let pubsub = self.mapping.pubsub();
        let most = usize::from(pubsub.messages_per_datagram);
        let overhead = self.guard.as_ref().map_or(0, |_| Guard::OVERHEAD);
        let room = usize::from(pubsub.max_datagram)
            .min(ETHERNET)
            .saturating_sub(overhead);
        // That there are several costs the first one its place among the Sizes.
        let mut len = first.bytes.len() + SIZE;
        let mut passed = Vec::new();
        while 1 + gathered.len() < most && passed.len() < MAX_PASSED {
            let Some(left) = room.checked_sub(len + ID + SIZE) else {
                break;
            };
            let Some(next) = self.ready.pop_front() else {
                break;
            };
            let joins = next.triple().1 == topic.triple().1
                && !(self.keeps_latest(next) && is_in(next, topic, &gathered));
            let taken = self
                .topics
                .get_mut(&next)
                .filter(|_| joins)
                .and_then(|entry| {
                    let taken = entry.take_within(left, &mut self.spare)?;
                    entry.counters.sent += 1;
                    entry.ready = entry.has_more();
                    Some((taken, entry.ready))
                });
            match taken {
                Some((taken, has_more)) => {
                    len += ID + SIZE + taken.data_set_message().len();
                    gathered.push((next, taken));
                    if has_more {
                        self.ready.push_back(next);
                    }
                }
                None => passed.push(next),
            }
        }
        for topic in passed.into_iter().rev() {
            self.ready.push_front(topic);
        }
        gathered
    }

    fn keeps_latest(&self, topic: TopicId) -> bool {
        self.topics
            .get(&topic)
            .is_some_and(|entry| entry.overflow == Overflow::KeepLatest)
    }
}

/// Whether the datagram has a sample of `topic`. A second one of a topic that keeps the latest would take the place of
/// the first as soon as the datagram is read, and of several latched publishers only one would ever be heard.
fn is_in(topic: TopicId, first: TopicId, others: &[(TopicId, Encoded)]) -> bool {
    topic == first || others.iter().any(|(other, _)| *other == topic)
}

/// The UDP payload that fits an Ethernet frame: what shares a datagram is not to be lost together for being cut up by IP.
const ETHERNET: usize = 1472;
/// Bytes of a DataSetWriterId in the payload header, and of a place in the Sizes.
const ID: usize = 2;
const SIZE: usize = 2;
/// Topics that wait and cannot join, looked at for one datagram.
const MAX_PASSED: usize = 64;
