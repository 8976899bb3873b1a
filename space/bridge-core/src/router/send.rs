//! From the queues to the datagrams: topic by topic in turn, large messages in chunks at their pace.

use mappings::TopicId;

use super::{About, Router};
use crate::counters::Reason;
use crate::network::chunk;
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Item, Role, Sending};
use crate::writer::Message;

impl Router {
    /// The next thing to do, topic by topic in turn. `None`: nothing until the next `handle_*`.
    pub fn poll_output(&mut self, now: Now) -> Option<Output> {
        loop {
            let output = self.next_output(now)?;
            if self.guard.is_none() {
                return Some(output);
            }
            if let Some(output) = self.sealed(output) {
                return Some(output);
            }
        }
    }

    /// As [`poll_output`](Self::poll_output), in clear.
    fn next_output(&mut self, now: Now) -> Option<Output> {
        if let Some(told) = self.told.pop_front() {
            return Some(told);
        }
        if let Some(settled) = self.next_arrival() {
            return Some(settled);
        }
        if self.calls.is_none() {
            return self.next_value(now);
        }
        // In turn, and a value first: what an action reports before its end is not overtaken by that.
        self.value_first = !self.value_first;
        let next = if self.value_first {
            self.next_value(now).or_else(|| self.next_action(now))
        } else {
            self.next_action(now).or_else(|| self.next_value(now))
        };
        if next.is_none() {
            self.value_first = false;
        }
        next
    }

    /// What is told of values, and what is sent and delivered of them.
    fn next_value(&mut self, now: Now) -> Option<Output> {
        // In turn, so that many topics nobody knows do not keep the values of the others waiting.
        self.news_first = !self.news_first;
        let next = if self.news_first {
            self.next_news(now).or_else(|| self.next_item(now))
        } else {
            self.next_item(now).or_else(|| self.next_news(now))
        };
        next.or_else(|| self.told.pop_front())
    }

    /// The next thing of the queues.
    fn next_item(&mut self, now: Now) -> Option<Output> {
        // One for one: among those that are ready it waits its turn again.
        if !self.paced.is_empty() && self.pace.is_open(now.monotonic) {
            self.ready.extend(self.paced.pop_front());
        }
        while let Some(topic) = self.ready.pop_front() {
            if let Some(news) = self.news_of(topic, now) {
                self.ready.push_front(topic);
                return Some(news);
            }
            if let Some(output) = self.take_turn(topic, now) {
                return Some(output);
            }
        }
        None
    }

    /// Whether so many samples of the topic wait to be polled that the next one makes the oldest give way.
    #[must_use]
    pub fn is_full(&self, topic: TopicId) -> bool {
        let entry = self.topics.get(&topic);
        entry.is_some_and(|entry| entry.queue.is_full())
    }

    /// Takes one thing of a topic, and puts it back in line if it has more.
    fn take_turn(&mut self, topic: TopicId, now: Now) -> Option<Output> {
        if self.claims.is_some() && self.is_withheld(topic) {
            self.withhold(topic);
            return None;
        }
        let entry = self.topics.get_mut(&topic)?;
        let item = match entry.sending {
            Some(_) => None,
            None => entry.take(&mut self.spare),
        };
        let (datagram, delivery) = match item {
            Some(Item::Message(Message::Datagram(datagram))) => {
                entry.counters.sent += 1;
                (Some(datagram), None)
            }
            Some(Item::Delivery(delivery)) => {
                entry.counters.delivered += 1;
                (None, Some(delivery))
            }
            Some(Item::Message(Message::Large(message))) => {
                entry.sending = Some(Sending { message, offset: 0 });
                return self.send_chunk(topic, now);
            }
            None if entry.sending.is_some() => return self.send_chunk(topic, now),
            None => (None, None),
        };
        entry.ready = entry.has_more();
        if entry.ready {
            self.ready.push_back(topic);
        }
        match datagram {
            Some(datagram) => self.datagram(topic, datagram, now),
            None => delivery.map(Output::Delivery),
        }
    }

    /// The next chunk of the topic's large message, if the pace lets it go.
    fn send_chunk(&mut self, topic: TopicId, now: Now) -> Option<Output> {
        if !self.pace.is_open(now.monotonic) {
            self.paced.push_back(topic);
            return None;
        }
        let (max_datagram, _) = self.sizes();
        let mut bytes = self.buffer();
        let entry = self.topics.get_mut(&topic)?;
        let Sending { message, offset } = entry.sending.take()?;
        let written = chunk(&mut bytes, topic, (&message, offset), max_datagram, now.utc);
        if let Ok(offset) = written {
            if offset < message.data_set_message().len() {
                entry.sending = Some(Sending { message, offset });
            } else {
                entry.counters.sent += 1;
            }
        }
        if let Role::Ours(writer) = &mut entry.role {
            writer.spoke(now.monotonic);
        }
        entry.ready = entry.has_more();
        if entry.ready {
            self.ready.push_back(topic);
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
                self.count(About::topic(topic), Reason::TooBig, 1, || error.to_string());
                None
            }
        }
    }

    /// A datagram could not be sent: counts it under `reason`, with what was said, for one of its topics. What is left of
    /// a large message is not sent either.
    pub fn not_sent(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        if let Some(entry) = self.topics.get_mut(&topic) {
            entry.sending = None;
        }
        self.count(About::topic(topic), (reason, "socket"), 1, || {
            detail.to_owned()
        });
    }
}
