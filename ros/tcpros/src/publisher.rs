//! Publishing: a topic, its subscribers, and the messages for late subscribers.

mod latched;
mod topic;

use std::sync::Arc;

use bytes::Bytes;

pub use self::latched::{Latched, MAX_LATCHED};
pub(crate) use self::topic::{Joined, PublishedTopic, Subscriber};
use crate::node::Inner;

/// The type of a topic, as publishers and subscribers compare it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicType {
    /// Name, such as `std_msgs/String`.
    pub name: String,
    /// Checksum of the definition, 32 hexadecimal digits.
    pub md5sum: String,
    /// Text of the definition followed by the texts of the contained types, as `rosbag` needs it.
    pub definition: String,
}

/// Options of a publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublisherOptions {
    /// Whether late subscribers receive the last message.
    pub latch: bool,
    /// Maximum number of messages waiting for a subscriber; beyond it the oldest are dropped.
    pub queue_messages: usize,
    /// Maximum number of bytes waiting for a subscriber; beyond it the oldest messages are
    /// dropped. The newest message is always kept. Subscribers that are slow at the same time share
    /// the waiting messages, which are stored once. In addition, each subscriber needs memory for
    /// the data being written: 64 KiB or a longer message.
    pub queue_bytes: usize,
    /// Whether messages for subscribers out of reach wait until they are within reach. For messages
    /// that do no harm when they are late.
    pub keep_cut_off: bool,
}

impl Default for PublisherOptions {
    /// Returns options without latching, for 1000 messages and 16 MiB.
    fn default() -> Self {
        Self {
            latch: false,
            queue_messages: 1000,
            queue_bytes: 16 * 1024 * 1024,
            keep_cut_off: false,
        }
    }
}

/// Outcome of publishing a message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct Published {
    /// Number of subscribers that the message was queued for.
    pub sent_to: usize,
    /// Number of older messages that were dropped for it, over all subscribers.
    pub dropped_oldest: u64,
    /// Number of subscribers that do not receive it because they are out of reach.
    pub cut_off: usize,
}

/// Publishes on a topic. Dropping it withdraws the topic; queued messages are still sent within a
/// second.
#[derive(Debug)]
pub struct Publisher {
    hub: Arc<PublishedTopic>,
    node: Arc<Inner>,
}

impl Publisher {
    pub(crate) const fn new(hub: Arc<PublishedTopic>, node: Arc<Inner>) -> Self {
        Self { hub, node }
    }

    /// Queues a serialized message, without its length, for every subscriber. Never waits: a slow
    /// subscriber loses its own oldest messages only. A message of more than 4 GiB cannot be
    /// encoded: it is not sent, and the error is logged.
    pub fn publish(&self, message: Bytes) -> Published {
        self.hub.publish(message, Latched::Alone(0))
    }

    /// Publishes like [`publish`](Self::publish), for topics on which late subscribers receive the
    /// last messages of several sources. `latched` selects the messages that are kept. Without
    /// `latch` no message is kept.
    pub fn publish_latched(&self, message: Bytes, latched: Latched) -> Published {
        self.hub.publish(message, latched)
    }

    /// Keeps a message for late subscribers under `key` beside others. It is also sent to the
    /// subscribers that joined after its publication and did not receive it, and to no other
    /// subscriber.
    pub fn latch(&self, key: u64, message: Bytes) {
        self.hub.latch(key, message);
    }

    /// Removes the message latched under `key`.
    pub fn forget_latched(&self, key: u64) {
        self.hub.forget_latched(key);
    }

    /// Removes all latched messages.
    pub fn forget_all_latched(&self) {
        self.hub.forget_all_latched();
    }

    /// Changes whether late subscribers receive the last message. Switching off removes all latched
    /// messages.
    pub fn set_latching(&self, latch: bool) {
        self.hub.set_latching(latch);
    }

    /// Returns the number of connected subscribers.
    pub fn subscribers(&self) -> usize {
        self.hub.subscribers()
    }

    /// Returns whether the node of this resolved name is connected and not cut off.
    pub fn is_subscribed_by(&self, node: &str) -> bool {
        self.hub.is_subscribed_by(node)
    }

    /// Returns whether the node of this resolved name requested the topic without TCPROS among its
    /// protocols.
    pub fn asks_for_udp(&self, node: &str) -> bool {
        self.hub.is_without_tcpros(node)
    }

    /// Returns the resolved name of the topic.
    pub fn topic(&self) -> &str {
        &self.hub.topic
    }

    /// Returns the type of the last subscriber that was refused for its type, such as
    /// `std_msgs/Float32`.
    pub fn refused_type(&self) -> Option<String> {
        self.hub.refused_type()
    }

    /// Returns the number of lost messages: dropped for slow subscribers, dropped for late
    /// subscribers with a queue too small for all latched messages, and latched messages beyond
    /// [`MAX_LATCHED`].
    pub fn dropped(&self) -> u64 {
        self.hub.dropped()
    }

    /// Returns the number of messages dropped because a subscriber was out of reach, over all
    /// subscribers.
    pub fn cut_off(&self) -> u64 {
        self.hub.cut_off()
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.hub.close();
        self.node.withdraw_publication(&self.hub);
    }
}
