//! The messages that wait for the broker.

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use transport::SendError;

use crate::json::PromotedTexts;

/// A message to publish.
#[derive(Debug, Clone)]
pub(crate) struct QueuedPublish {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) retained: bool,
    /// Whether the broker confirms the message (QoS 1).
    pub(crate) confirmed: bool,
    /// Whether a newer message of the topic replaces the message. A [series](Self::is_series) is
    /// replaced only if the queue is full.
    pub(crate) replaceable: bool,
    /// Whether the newest message of the topic waits for the next connection if the broker is lost:
    /// a state, but no command.
    pub(crate) outlasts: bool,
    /// The time after which the message must not be delivered.
    pub(crate) within: Option<Duration>,
    /// User property `UAMessageType` of MQTT 5.
    pub(crate) message_type: &'static str,
    /// Content Type of MQTT 5.
    pub(crate) content_type: &'static str,
    /// Promoted fields, as further user properties of MQTT 5.
    pub(crate) promoted: PromotedTexts,
}

impl QueuedPublish {
    /// Returns whether each message of the topic is to arrive in its time, and not the newest only:
    /// a state that the broker confirms. The broker may confirm nothing for seconds.
    const fn is_series(&self) -> bool {
        self.confirmed && self.outlasts
    }

    /// Returns the number of bytes that count for the limit of the queue.
    fn size(&self) -> usize {
        self.payload.len() + self.promoted.size()
    }
}

/// A message and the time at which it expires.
pub(crate) type QueuedMessage = (QueuedPublish, Option<Instant>);

/// A bounded queue. Messages leave it in their order, unless they have expired.
#[derive(Debug, Default)]
pub(crate) struct SendQueue {
    waiting: VecDeque<QueuedMessage>,
    bytes: usize,
    /// Number of messages that expired or were replaced, or that a lost connection discarded.
    pub(crate) expired: u64,
    pub(crate) replaced: u64,
    pub(crate) discarded: u64,
    /// Number of messages that a lost connection left without a confirmation, and that are not sent
    /// again.
    pub(crate) unconfirmed: u64,
    /// Number of messages that no packet could carry.
    pub(crate) refused: u64,
}

impl SendQueue {
    pub(crate) fn push(
        &mut self,
        publication: QueuedPublish,
        now: Instant,
    ) -> Result<(), SendError> {
        let until = publication.within.map(|within| now + within);
        if publication.replaceable
            && !publication.is_series()
            && let Some((older, of)) = self
                .waiting
                .iter_mut()
                .find(|(older, _)| older.replaceable && older.topic == publication.topic)
        {
            self.bytes = self.bytes - older.size() + publication.size();
            (*older, *of) = (publication, until);
            self.replaced += 1;
            return Ok(());
        }
        if !self.make_room(&publication, now) {
            return Err(SendError::Busy);
        }
        self.bytes += publication.size();
        self.waiting.push_back((publication, until));
        Ok(())
    }

    /// Makes room for a message in a full queue: expired messages leave it, and then the oldest
    /// states of which newer states wait. [`FREED`] states leave at once, so that the next messages
    /// need no search. Returns whether the message fits.
    fn make_room(&mut self, publication: &QueuedPublish, now: Instant) -> bool {
        if self.has_room(publication) {
            return true;
        }
        self.remove_expired(now);
        if self.has_room(publication) {
            return true;
        }
        let size = publication.size();
        let mut superseded = self.superseded(publication);
        let mut oldest = superseded.pop();
        let (mut at, mut removed) = (0, 0);
        self.waiting.retain(|(older, _)| {
            let leaves = oldest == Some(at) && (removed < FREED || self.bytes + size > MAX_BYTES);
            at += 1;
            if leaves {
                self.bytes = self.bytes.saturating_sub(older.size());
                removed += 1;
                oldest = superseded.pop();
            }
            !leaves
        });
        self.replaced += count(removed);
        self.has_room(publication)
    }

    fn remove_expired(&mut self, now: Instant) {
        self.waiting.retain(|(publication, until)| {
            let is_expired = until.is_some_and(|until| now > until);
            if is_expired {
                self.bytes = self.bytes.saturating_sub(publication.size());
                self.expired += 1;
            }
            !is_expired
        });
    }

    /// Returns the places of the states of which a newer state waits or is `next`, the oldest last.
    fn superseded(&self, next: &QueuedPublish) -> Vec<usize> {
        let next = next.is_series().then_some(next.topic.as_str());
        let mut newer: BTreeSet<&str> = next.into_iter().collect();
        let mut superseded = Vec::new();
        for (at, (publication, _)) in self.waiting.iter().enumerate().rev() {
            if publication.is_series() && !newer.insert(&publication.topic) {
                superseded.push(at);
            }
        }
        superseded
    }

    /// Returns the next message that has not expired. Messages to be confirmed stay while
    /// `may_confirm` is false, because the broker confirms too slowly.
    pub(crate) fn pop(&mut self, now: Instant, may_confirm: bool) -> Option<QueuedMessage> {
        let mut at = 0;
        while let Some((publication, until)) = self.waiting.get(at) {
            let is_expired = until.is_some_and(|until| now > until);
            if !is_expired && publication.confirmed && !may_confirm {
                at += 1;
                continue;
            }
            let message = self.waiting.remove(at)?;
            self.bytes = self.bytes.saturating_sub(message.0.size());
            if !is_expired {
                return Some(message);
            }
            self.expired += 1;
        }
        None
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Discards the messages of a lost connection: they would be late after a reconnection. The
    /// newest state of each topic waits for the next connection until it expires, and so do older
    /// states that the broker confirms: a reader drops those that it has received. `in_flight` are
    /// the messages without a confirmation, `unwritten` the number of messages that were not
    /// written and need no confirmation.
    pub(crate) fn lose(&mut self, in_flight: Vec<QueuedMessage>, unwritten: usize) {
        let waiting = std::mem::take(&mut self.waiting);
        self.bytes = 0;
        self.discarded += count(unwritten);
        let mut newest: BTreeSet<String> = BTreeSet::new();
        let all = in_flight.into_iter().map(|message| (true, message));
        let all: Vec<_> = all
            .chain(waiting.into_iter().map(|of| (false, of)))
            .collect();
        for (is_in_flight, message) in all.into_iter().rev() {
            let publication = &message.0;
            let waits = publication.is_series()
                || (publication.outlasts && newest.insert(publication.topic.clone()));
            if waits {
                self.bytes += publication.size();
                self.waiting.push_front(message);
                continue;
            }
            // The carrier publishes its retained messages with each connection.
            let is_kept = publication.retained && !publication.payload.is_empty();
            match is_in_flight {
                _ if is_kept => {}
                true => self.unconfirmed += 1,
                false => self.discarded += 1,
            }
        }
    }

    /// Discards all messages, at the end of the program.
    pub(crate) fn discard(&mut self) {
        self.discarded += count(self.waiting.len());
        self.waiting.clear();
        self.bytes = 0;
    }

    /// Puts messages in front of the waiting states, for a new connection.
    pub(crate) fn begin<'a>(
        &mut self,
        first: impl Iterator<Item = &'a QueuedPublish>,
        now: Instant,
    ) {
        let states = std::mem::take(&mut self.waiting);
        self.bytes = 0;
        for publication in first {
            // A publication that does not fit is published again later.
            let _full = self.push(publication.clone(), now).is_err();
        }
        for state in states {
            if self.make_room(&state.0, now) {
                self.bytes += state.0.size();
                self.waiting.push_back(state);
            } else {
                self.discarded += 1;
            }
        }
    }

    fn has_room(&self, publication: &QueuedPublish) -> bool {
        self.waiting.len() < MAX_WAITING && self.bytes + publication.size() <= MAX_BYTES
    }
}

fn count(number: usize) -> u64 {
    u64::try_from(number).unwrap_or(u64::MAX)
}

const MAX_WAITING: usize = 4096;
/// The number of states that leave a full queue at once.
const FREED: usize = MAX_WAITING / 16;
const MAX_BYTES: usize = 64 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn publication(topic: &str, within: Option<u64>, replaceable: bool) -> QueuedPublish {
        QueuedPublish {
            topic: topic.to_owned(),
            payload: vec![0; 10],
            retained: false,
            confirmed: false,
            replaceable,
            outlasts: false,
            within: within.map(Duration::from_millis),
            message_type: "ua-data",
            content_type: "application/opcua+uadp",
            promoted: PromotedTexts::default(),
        }
    }

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn start() -> Instant {
        Instant::now()
    }

    #[test]
    fn a_command_that_waits_too_long_is_not_sent() {
        let mut queue = SendQueue::default();
        let start = start();
        queue
            .push(publication("stop", Some(1000), false), start)
            .unwrap();
        queue
            .push(publication("metadata", None, false), start)
            .unwrap();
        let later = start + Duration::from_millis(1001);
        assert_eq!(queue.pop(later, true).unwrap().0.topic, "metadata");
        assert_eq!((queue.pop(later, true).is_none(), queue.expired), (true, 1));
    }

    #[test]
    fn a_state_replaces_the_waiting_state_of_its_topic_only() {
        let mut queue = SendQueue::default();
        let start = start();
        for topic in ["a", "b", "a"] {
            queue.push(publication(topic, None, true), start).unwrap();
        }
        queue.push(publication("a", None, false), start).unwrap();
        let order: Vec<String> =
            std::iter::from_fn(|| queue.pop(start, true).map(|of| of.0.topic)).collect();
        assert_eq!(order, ["a", "b", "a"]);
        assert_eq!((queue.replaced, queue.bytes), (1, 0));
    }

    #[test]
    fn a_full_queue_refuses_messages_and_a_lost_connection_empties_it() {
        let mut queue = SendQueue::default();
        let start = start();
        for _ in 0..MAX_WAITING {
            queue.push(publication("a", None, false), start).unwrap();
        }
        let refused = queue.push(publication("a", None, false), start);
        assert_eq!(refused, Err(SendError::Busy));
        queue.lose(Vec::new(), 2);
        assert!(queue.is_empty());
        assert_eq!(queue.discarded, count(MAX_WAITING) + 2);
        queue.push(publication("a", None, false), start).unwrap();
    }

    /// Returns a state with its number as payload, and the time at which it expires.
    fn state(topic: &str, number: u8, until: Instant) -> QueuedMessage {
        let state = QueuedPublish {
            payload: vec![number],
            outlasts: true,
            ..publication(topic, Some(1000), true)
        };
        (state, Some(until))
    }

    #[test]
    fn after_a_lost_connection_the_newest_state_of_each_topic_is_sent_again_until_it_expires() {
        let mut queue = SendQueue::default();
        let start = start();
        let within = Duration::from_millis(1000);
        queue.push(state("a", 3, start).0, start).unwrap();
        queue
            .push(publication("stop", Some(1000), false), start)
            .unwrap();
        let early = start + within / 2;
        let in_flight = vec![
            state("a", 1, start),
            state("b", 1, early),
            state("a", 2, start),
            state("b", 2, early),
            (publication("event", None, false), None),
        ];
        queue.lose(in_flight, 0);
        // Two states of the topic a and one of b were not confirmed, and are older; the event is
        // not sent again, nor is the command that waited.
        assert_eq!((queue.unconfirmed, queue.discarded), (4, 1));

        let kept = QueuedPublish {
            retained: true,
            ..publication("metadata", None, true)
        };
        queue.begin(std::iter::once(&kept), start);
        let sent = std::iter::from_fn(|| queue.pop(early, true));
        let sent: Vec<(String, usize)> = sent
            .map(|(of, _)| {
                (
                    of.topic,
                    of.payload.first().copied().unwrap_or_default().into(),
                )
            })
            .collect();
        let wanted = [("metadata", 0), ("b", 2), ("a", 3)];
        assert_eq!(
            sent,
            wanted.map(|(topic, number)| (topic.to_owned(), number))
        );
        assert_eq!((queue.bytes, queue.expired), (0, 0));

        queue.lose(vec![state("b", 2, early)], 0);
        assert!(queue.pop(early + within, true).is_none());
        assert_eq!((queue.expired, queue.unconfirmed), (1, 4));
    }

    /// Returns a state that the broker confirms.
    fn confirmed(topic: &str, number: u8) -> QueuedPublish {
        let at = start();
        QueuedPublish {
            confirmed: true,
            ..state(topic, number, at).0
        }
    }

    #[test]
    fn states_that_the_broker_confirms_all_wait_and_are_sent_again_in_their_order() {
        let mut queue = SendQueue::default();
        let start = start();
        for number in 1..=3 {
            queue.push(confirmed("a", number), start).unwrap();
        }
        assert_eq!(queue.replaced, 0);
        let first = queue.pop(start, true).unwrap();
        let second = queue.pop(start, true).unwrap();
        queue.lose(vec![first, second], 0);
        queue.begin(std::iter::empty(), start);
        let sent = std::iter::from_fn(|| queue.pop(start, true).map(|of| of.0.payload));
        assert_eq!(sent.flatten().collect::<Vec<u8>>(), [1, 2, 3]);
        assert_eq!((queue.unconfirmed, queue.discarded, queue.bytes), (0, 0, 0));
    }

    #[test]
    fn of_states_that_the_broker_does_not_confirm_the_oldest_leave_a_full_queue() {
        let mut queue = SendQueue::default();
        let start = start();
        queue.push(confirmed("seldom", 1), start).unwrap();
        queue
            .push(publication("event", None, false), start)
            .unwrap();
        for _ in 0..MAX_WAITING {
            queue.push(confirmed("often", 2), start).unwrap();
        }
        let waiting = MAX_WAITING + 2 - FREED;
        assert_eq!(queue.waiting.len(), waiting);
        assert_eq!(queue.replaced, count(FREED));
        queue.push(confirmed("another", 3), start).unwrap();
        let topics: Vec<&str> = queue.waiting.iter().map(|(of, _)| &of.topic[..]).collect();
        assert_eq!(topics[..3], ["seldom", "event", "often"]);
        assert_eq!(topics[waiting - 1..], ["often", "another"]);
        // The bytes are bounded too, and a message that cannot fit is refused.
        let large = |topic, bytes| QueuedPublish {
            payload: vec![0; bytes],
            ..confirmed(topic, 4)
        };
        queue.push(large("often", MAX_BYTES / 2), start).unwrap();
        queue
            .push(large("often", MAX_BYTES / 2 + 1), start)
            .unwrap();
        assert!(queue.bytes <= MAX_BYTES);
        let refused = queue.push(large("other", MAX_BYTES), start);
        assert_eq!(refused, Err(SendError::Busy));
    }

    #[test]
    fn promoted_fields_count_for_the_bytes_of_the_queue() {
        let mut queue = SendQueue::default();
        let start = start();
        let promoted = |topic, text: &str| QueuedPublish {
            promoted: std::iter::once(("v", text)).collect(),
            ..publication(topic, Some(1000), true)
        };
        queue.push(promoted("a", "long text"), start).unwrap();
        queue.push(promoted("a", "text"), start).unwrap();
        // A payload of 10 bytes, and a property of 5 bytes with its name and its text.
        assert_eq!((queue.bytes, queue.replaced), (20, 1));
        let popped = queue.pop(start, true);
        assert_eq!((popped.is_some(), queue.bytes), (true, 0));
        let text = "x".repeat(MAX_BYTES);
        let refused = queue.push(promoted("b", &text), start);
        assert_eq!(refused, Err(SendError::Busy));

        let state = QueuedPublish {
            outlasts: true,
            ..promoted("a", "text")
        };
        queue.lose(vec![(state, None)], 0);
        assert_eq!(queue.bytes, 20);
        queue.begin(std::iter::empty(), start);
        assert_eq!(queue.bytes, 20);
    }

    #[test]
    fn expired_messages_leave_a_full_queue_before_states_do() {
        let mut queue = SendQueue::default();
        let start = start();
        for _ in 2..MAX_WAITING {
            queue
                .push(publication("stop", Some(1000), false), start)
                .unwrap();
        }
        let later = start + Duration::from_millis(1001);
        queue.push(confirmed("a", 1), later).unwrap();
        queue.push(confirmed("a", 2), later).unwrap();
        queue.push(confirmed("a", 3), later).unwrap();
        assert_eq!(queue.expired, count(MAX_WAITING - 2));
        assert_eq!((queue.replaced, queue.bytes), (0, 3));
    }

    #[test]
    fn a_command_does_not_wait_behind_states_that_the_broker_does_not_confirm() {
        let mut queue = SendQueue::default();
        let start = start();
        queue.push(confirmed("a", 1), start).unwrap();
        queue
            .push(publication("stop", Some(1000), false), start)
            .unwrap();
        assert_eq!(queue.pop(start, false).unwrap().0.topic, "stop");
        assert!(queue.pop(start, false).is_none());
        assert_eq!(queue.pop(start, true).unwrap().0.topic, "a");
    }
}
