//! The messages that wait for the broker.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use transport::SendError;

/// A message to publish.
#[derive(Debug, Clone)]
pub(crate) struct QueuedPublish {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) retained: bool,
    /// Whether the broker confirms the message (QoS 1).
    pub(crate) confirmed: bool,
    /// Whether a newer message of the topic replaces the message.
    pub(crate) replaceable: bool,
    /// The time after which the message must not be delivered.
    pub(crate) within: Option<Duration>,
    /// User property `UAMessageType` of MQTT 5.
    pub(crate) message_type: &'static str,
    /// Content Type of MQTT 5.
    pub(crate) content_type: &'static str,
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
}

impl SendQueue {
    pub(crate) fn push(
        &mut self,
        publication: QueuedPublish,
        now: Instant,
    ) -> Result<(), SendError> {
        let until = publication.within.map(|within| now + within);
        if publication.replaceable
            && let Some((older, of)) = self
                .waiting
                .iter_mut()
                .find(|(older, _)| older.replaceable && older.topic == publication.topic)
        {
            self.bytes = self.bytes - older.payload.len() + publication.payload.len();
            (*older, *of) = (publication, until);
            self.replaced += 1;
            return Ok(());
        }
        let bytes = self.bytes + publication.payload.len();
        if self.waiting.len() >= MAX_WAITING || bytes > MAX_BYTES {
            return Err(SendError::Busy);
        }
        self.bytes = bytes;
        self.waiting.push_back((publication, until));
        Ok(())
    }

    /// Returns the next message that has not expired.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<QueuedMessage> {
        while let Some((publication, until)) = self.waiting.pop_front() {
            self.bytes = self.bytes.saturating_sub(publication.payload.len());
            if until.is_none_or(|until| now <= until) {
                return Some((publication, until));
            }
            self.expired += 1;
        }
        None
    }

    /// Returns the next message to its place, because the broker confirms too slowly.
    pub(crate) fn unpop(&mut self, waiting: QueuedMessage) {
        self.bytes += waiting.0.payload.len();
        self.waiting.push_front(waiting);
    }

    /// Discards all messages: after a reconnection they would be late.
    pub(crate) fn discard(&mut self) {
        self.discarded += u64::try_from(self.waiting.len()).unwrap_or(u64::MAX);
        self.waiting.clear();
        self.bytes = 0;
    }
}

const MAX_WAITING: usize = 4096;
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
            within: within.map(Duration::from_millis),
            message_type: "ua-data",
            content_type: "application/opcua+uadp",
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
        assert_eq!(queue.pop(later).unwrap().0.topic, "metadata");
        assert_eq!((queue.pop(later).is_none(), queue.expired), (true, 1));
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
            std::iter::from_fn(|| queue.pop(start).map(|of| of.0.topic)).collect();
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
        queue.discard();
        assert!(queue.waiting.is_empty());
        assert_eq!(queue.discarded, u64::try_from(MAX_WAITING).unwrap());
        queue.push(publication("a", None, false), start).unwrap();
    }
}
