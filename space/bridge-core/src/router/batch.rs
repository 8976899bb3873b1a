//! Datagrams with several DataSetMessages.

use std::time::Instant;

use mappings::{Overflow, TopicId};

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::message::EncodedSample;
use crate::network::join;
use crate::output::Output;
use crate::settings::Now;
use crate::tap::Crossing;
use crate::topics::Handle;

impl TopicQueues {
    /// Returns the datagram of a sample, together with other waiting samples of its WriterGroup if
    /// the mapping allows it.
    pub(super) fn datagram(
        &mut self,
        at: Handle,
        mut first: EncodedSample,
        now: Now,
    ) -> Option<Output> {
        let topic = at.topic();
        // Each topic of a broker has its own messages. A message of several writers has the time of
        // its transmission.
        let others = if self.relay.is_some() || self.keeps_time(at) {
            Vec::new()
        } else {
            self.gather(topic, &first, now.monotonic)
        };
        let with = others.iter().map(|(topic, _)| *topic).collect();
        if others.is_empty() {
            if !self.keeps_time(at) {
                first.stamp(now.utc);
            }
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
                    self.count(DropSite::topic(topic), Reason::TooBig, 1, || {
                        error.to_string()
                    });
                }
                None
            }
        }
    }

    /// Takes samples that fit into the datagram of `first` from the ready topics in their order.
    /// Other topics keep their position.
    fn gather(
        &mut self,
        topic: TopicId,
        first: &EncodedSample,
        now: Instant,
    ) -> Vec<(TopicId, EncodedSample)> {
        let mut gathered = Vec::new();
        let seals = self.seals();
        let pubsub = self.mapping.pubsub();
        let most = usize::from(pubsub.messages_per_datagram);
        let room = usize::from(pubsub.max_datagram)
            .min(ETHERNET)
            .saturating_sub(self.overhead);
        // With several messages, the first message also has an entry in Sizes.
        let mut len = first.bytes.len() + SIZE;
        let mut passed = Vec::new();
        while 1 + gathered.len() < most && passed.len() < MAX_PASSED {
            let Some(left) = room.checked_sub(len + ID + SIZE) else {
                break;
            };
            let Some(next) = self.ready.pop_front() else {
                break;
            };
            let Some(entry) = self.topics.at_mut(next) else {
                continue;
            };
            let is_alone = entry.overflow == Overflow::KeepLatest;
            let keeps_time = seals && entry.confirming.is_some();
            let joins = !keeps_time
                && next.topic().triple().1 == topic.triple().1
                && !(is_alone && is_in(next.topic(), topic, &gathered));
            let before = entry.counters.repeated;
            let taken = if joins {
                entry.take_within(left, &mut self.buffers)
            } else {
                None
            };
            let taken = taken.map(|taken| {
                let repeated = entry.counters.repeated != before;
                if !repeated {
                    entry.note_value(now);
                }
                entry.counters.sent += 1;
                entry.ready = entry.has_more();
                (taken, entry.ready, repeated)
            });
            match taken {
                Some((taken, has_more, repeated)) => {
                    self.tap.note(next.topic(), || Crossing::Sent { repeated });
                    len += ID + SIZE + taken.data_set_message().len();
                    gathered.push((next.topic(), taken));
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
}

/// Returns whether the datagram already contains a sample of `topic`. In a topic that keeps the
/// latest sample, a second sample would replace the first as soon as the datagram is read. Of
/// several latched publishers, only the last would then be received.
fn is_in(topic: TopicId, first: TopicId, others: &[(TopicId, EncodedSample)]) -> bool {
    topic == first || others.iter().any(|(other, _)| *other == topic)
}

/// The UDP payload that fits into an Ethernet frame. Larger datagrams are fragmented by IP, and the
/// loss of a fragment loses all samples in the datagram.
const ETHERNET: usize = 1472;
/// The size in bytes of a DataSetWriterId in the payload header, and of an entry in Sizes.
const ID: usize = 2;
const SIZE: usize = 2;
/// The maximum number of ready topics that are skipped for a datagram.
const MAX_PASSED: usize = 64;
