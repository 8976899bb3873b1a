//! Output from the queues to datagrams: topics in turn, large messages in chunks at their pace.

use mappings::TopicId;

use super::{DropSite, Router, TopicQueues};
use crate::counters::Reason;
use crate::message::SampleMessage;
use crate::network::chunk;
use crate::output::{Output, Unsent};
use crate::settings::{LinkCapacity, Now};
use crate::tap::Crossing;
use crate::topic::{PolledSample, Sending, TopicSide};
use crate::topics::Handle;

impl Router {
    /// Returns the next output, topic by topic in turn. `None`: no output until the next
    /// `handle_*`.
    pub fn poll_output(&mut self, now: Now) -> Option<Output> {
        let output = self.next_sealed(now);
        self.inquire(now);
        output
    }

    fn next_sealed(&mut self, now: Now) -> Option<Output> {
        self.check_lease(now);
        loop {
            let output = self.next_output(now)?;
            if self.values.redundant.is_some() && self.values.mutes(&output) {
                self.values.drop_muted(output);
                continue;
            }
            if !self.security.is_on() {
                return Some(output);
            }
            let is_heartbeat = matches!(output, Output::Heartbeat { .. });
            if let Some(output) = self.security.seal(&mut self.values, output) {
                return Some(output);
            }
            if is_heartbeat {
                self.roles().heartbeat_not_sealed(now);
            }
        }
    }

    /// Returns the next output of [`poll_output`](Self::poll_output) before it is sealed.
    fn next_output(&mut self, now: Now) -> Option<Output> {
        if let Some(told) = self.values.told.pop_front() {
            return Some(told);
        }
        if let Some(settled) = self.values.next_arrival() {
            return Some(settled);
        }
        if self.calls.is_none() {
            return self.values.next_value(now);
        }
        // Values and calls alternate, beginning with a value, so that the result of an action does
        // not overtake its last feedback.
        self.value_first = !self.value_first;
        let next = if self.value_first {
            self.values
                .next_value(now)
                .or_else(|| self.call_traffic().next_action(now))
        } else {
            self.call_traffic()
                .next_action(now)
                .or_else(|| self.values.next_value(now))
        };
        if next.is_none() {
            self.value_first = false;
        }
        next
    }

    /// Sets the capacity of the network, which determines the pace of chunks.
    pub fn set_link(&mut self, link: LinkCapacity) {
        self.values.pace.follow(link);
    }

    /// Returns whether the queue of the topic is full, so that the next sample drops the oldest.
    #[must_use]
    pub fn is_full(&self, topic: TopicId) -> bool {
        let entry = self.values.topics.get(&topic);
        entry.is_some_and(|entry| entry.queue.is_full())
    }

    /// Returns the samples of a topic that wait to be sent.
    #[must_use]
    pub fn unsent(&self, topic: TopicId) -> Unsent {
        let entry = self.values.topics.get(&topic);
        entry.map_or_else(Unsent::default, |entry| Unsent {
            queued: entry.queue.len(),
            is_sending: entry
                .sending
                .as_ref()
                .is_some_and(|sending| !sending.is_repeat),
            is_held: entry.gate.as_ref().is_some_and(|gate| gate.holds()),
        })
    }

    /// Records a datagram that could not be sent, and counts it under `reason` with `detail` for
    /// one of its topics. The rest of a large message is not sent either.
    pub fn not_sent(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        if let Some(entry) = self.values.topics.get_mut(&topic) {
            entry.sending = None;
            if let Some(gate) = &mut entry.gate {
                gate.forget_last();
            }
        }
        self.values
            .count(DropSite::topic(topic), (reason, "socket"), 1, || {
                detail.to_owned()
            });
    }
}

impl TopicQueues {
    /// Returns the next notification about a topic, or the next sample to send or deliver.
    fn next_value(&mut self, now: Now) -> Option<Output> {
        // They alternate, so that many unknown topics do not block the values of other topics.
        self.news_first = !self.news_first;
        let next = if self.news_first {
            self.next_news(now).or_else(|| self.next_item(now))
        } else {
            self.next_item(now).or_else(|| self.next_news(now))
        };
        next.or_else(|| self.told.pop_front())
    }

    /// Returns the next item of the queues.
    fn next_item(&mut self, now: Now) -> Option<Output> {
        // A single topic per call; it then waits for its turn among the ready topics.
        if !self.paced.is_empty() && self.pace.is_open(now.monotonic) {
            self.ready.extend(self.paced.pop_front());
        }
        while let Some(at) = self.ready.pop_front() {
            if let Some(news) = self.news_of(at, now) {
                self.ready.push_front(at);
                return Some(news);
            }
            if let Some(output) = self.take_turn(at, now) {
                return Some(output);
            }
        }
        None
    }

    /// Takes an item of a topic, and requeues the topic if it has more items.
    fn take_turn(&mut self, at: Handle, now: Now) -> Option<Output> {
        if !self.claims.is_empty() && self.is_withheld(at.topic()) {
            self.withhold(at);
            return None;
        }
        if self.redundant.is_some() && self.mute_topic(at.topic(), now) {
            return None;
        }
        let entry = self.topics.at_mut(at)?;
        let repeated = entry.counters.repeated;
        let item = match entry.sending {
            Some(_) => None,
            None => entry.take(&mut self.buffers),
        };
        let is_repeat = entry.counters.repeated != repeated;
        let (datagram, delivery) = match item {
            Some(PolledSample::Message(SampleMessage::Datagram(datagram))) => {
                entry.counters.sent += 1;
                (Some(datagram), None)
            }
            Some(PolledSample::Delivery(delivery)) => {
                entry.counters.delivered += 1;
                (None, Some(delivery))
            }
            Some(PolledSample::Message(SampleMessage::Large(message))) => {
                entry.sending = Some(Sending {
                    message,
                    offset: 0,
                    is_repeat,
                });
                return self.send_chunk(at, now);
            }
            None if entry.sending.is_some() => return self.send_chunk(at, now),
            None => (None, None),
        };
        if !is_repeat && (datagram.is_some() || delivery.is_some()) {
            entry.note_value(now.monotonic);
        }
        entry.ready = entry.has_more();
        if entry.ready {
            self.ready.push_back(at);
        }
        if datagram.is_some() {
            self.tap.note(at.topic(), || Crossing::Sent {
                repeated: is_repeat,
            });
        }
        match datagram {
            Some(datagram) => self.datagram(at, datagram, now),
            None => delivery.map(Output::Delivery),
        }
    }

    /// Returns the next chunk of the topic's large message, if the pace allows it.
    fn send_chunk(&mut self, at: Handle, now: Now) -> Option<Output> {
        if !self.pace.is_open(now.monotonic) {
            self.paced.push_back(at);
            return None;
        }
        let topic = at.topic();
        let (max_datagram, _) = self.sizes();
        let mut bytes = self.buffer();
        let keeps_time = self.keeps_time(at);
        let entry = self.topics.at_mut(at)?;
        let Sending {
            message,
            offset,
            is_repeat,
        } = entry.sending.take()?;
        let first = message.time().filter(|_| keeps_time);
        let time = first.unwrap_or(now.utc);
        let written = chunk(&mut bytes, topic, (&message, offset), max_datagram, time);
        if let Ok(offset) = written {
            if offset < message.data_set_message().len() {
                entry.sending = Some(Sending {
                    message,
                    offset,
                    is_repeat,
                });
            } else {
                entry.counters.sent += 1;
                entry.note_value(now.monotonic);
            }
        }
        let is_whole = entry.sending.is_none();
        if let TopicSide::Ours(writer) = &mut entry.role {
            writer.spoke(now.monotonic);
        }
        entry.ready = entry.has_more();
        if entry.ready {
            self.ready.push_back(at);
        }
        if is_whole && written.is_ok() {
            self.tap.note(topic, || Crossing::Sent { repeated: false });
        }
        match written {
            Ok(_) => {
                self.pace.spend(bytes.len(), now.monotonic);
                Some(Output::Datagram {
                    topic,
                    with: Vec::new(),
                    bytes,
                })
            }
            Err(error) => {
                self.count(DropSite::topic(topic), Reason::TooBig, 1, || {
                    error.to_string()
                });
                None
            }
        }
    }
}
