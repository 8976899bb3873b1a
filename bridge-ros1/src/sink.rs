//! A topic of the graph to which values of other spaces are written.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::policy::{Choice, Destination};
use bytes::{Bytes, BytesMut};
use mappings::Lasting;
use messages::{MessageType, TypeName};
use tcpros::{Latched, Publisher, PublisherOptions, Ros1Time};

/// The destination of the values of a topic of another space.
#[derive(Debug)]
pub(crate) struct Ros1Sink {
    pub(crate) ros_topic: String,
    /// The choice of the message type.
    pub(crate) choice: Choice,
    /// The publisher of the topic, if it is open.
    pub(crate) open: Option<OpenPublisher>,
    /// The time at which the writer in the space timed out.
    pub(crate) silent: Option<Instant>,
    lasting: Lasting,
}

/// A publisher and its type.
#[derive(Debug)]
pub(crate) struct OpenPublisher {
    pub(crate) message_type: Arc<MessageType>,
    pub(crate) publisher: Publisher,
    /// Number of reported losses of slow subscribers.
    pub(crate) reported: u64,
    /// Number of reported losses of subscribers out of reach.
    pub(crate) reported_cut_off: u64,
    /// True if a subscriber was present for the last value.
    pub(crate) reached: bool,
    /// True if the bridge sets the stamp of the header: the value is a single field of the message
    /// other than the stamp.
    pub(crate) stamps: bool,
    /// Events that wait for subscribers to connect.
    pub(crate) opening: Option<TopicOpening>,
}

/// Events of a topic that was advertised a moment ago. The master knew subscribers of the topic by
/// then, which have yet to connect.
#[derive(Debug)]
pub(crate) struct TopicOpening {
    subscribers: Vec<String>,
    until: Instant,
    waiting: VecDeque<(Bytes, Latched)>,
}

impl TopicOpening {
    /// Returns `None` where the topic has no subscriber but the node `own`.
    pub(crate) fn of(subscribers: Option<&Vec<String>>, own: &str, now: Instant) -> Option<Self> {
        let others = subscribers
            .into_iter()
            .flatten()
            .filter(|node| *node != own);
        let subscribers: Vec<String> = others.cloned().collect();
        (!subscribers.is_empty()).then(|| Self {
            subscribers,
            until: now + CONNECTED_WITHIN,
            waiting: VecDeque::new(),
        })
    }

    /// Queues an event. Returns the event if there is no room.
    pub(crate) fn queue(&mut self, event: (Bytes, Latched)) -> Result<(), (Bytes, Latched)> {
        if self.waiting.len() >= MOST_WAITING {
            return Err(event);
        }
        self.waiting.push_back(event);
        Ok(())
    }

    /// Whether all subscribers are connected, or have had the time to.
    pub(crate) fn is_over(&self, is_connected: impl Fn(&str) -> bool, now: Instant) -> bool {
        now >= self.until || self.subscribers.iter().all(|node| is_connected(node))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Drops the events and returns their number.
    pub(crate) fn drop_waiting(&mut self) -> u64 {
        let count = self.waiting.drain(..).count();
        u64::try_from(count).unwrap_or(u64::MAX)
    }
}

impl OpenPublisher {
    /// Publishes an event, or queues it while subscribers connect. Returns the number of events
    /// that had no subscriber.
    pub(crate) fn publish_once(&mut self, event: (Bytes, Latched), now: Instant) -> u64 {
        let lost = self.look_at_opening(now);
        let unqueued = match &mut self.opening {
            None => Err(event),
            Some(opening) => opening.queue(event),
        };
        match unqueued {
            Ok(()) => lost,
            // The event follows the waiting events.
            Err(event) => lost + self.end_opening() + self.send(event),
        }
    }

    /// Publishes the events that wait, once they need not. Returns the number of events that had no
    /// subscriber.
    pub(crate) fn look_at_opening(&mut self, now: Instant) -> u64 {
        let publisher = &self.publisher;
        let is_over = self
            .opening
            .as_ref()
            .is_some_and(|opening| opening.is_over(|node| publisher.is_subscribed_by(node), now));
        if is_over { self.end_opening() } else { 0 }
    }

    /// Publishes the events that wait. Returns the number of events that had no subscriber.
    pub(crate) fn end_opening(&mut self) -> u64 {
        let opening = self.opening.take();
        let waiting = opening.map(|opening| opening.waiting).unwrap_or_default();
        waiting.into_iter().map(|event| self.send(event)).sum()
    }

    fn send(&self, (message, latched): (Bytes, Latched)) -> u64 {
        let published = self.publisher.publish_latched(message, latched);
        u64::from(published.sent_to == 0 && published.cut_off == 0)
    }

    /// Returns the message with the time in its header, if the header is not part of the value.
    pub(crate) fn stamped(&self, message: Bytes, now: Ros1Time) -> Bytes {
        if !self.stamps {
            return message;
        }
        let mut message = message
            .try_into_mut()
            .unwrap_or_else(|shared| BytesMut::from(shared.as_ref()));
        // std_msgs/Header: seq, then stamp, then frame_id.
        if let Some(stamp) = message.get_mut(4..12) {
            let (secs, nsecs) = stamp.split_at_mut(4);
            secs.copy_from_slice(&now.secs.to_le_bytes());
            nsecs.copy_from_slice(&now.nsecs.to_le_bytes());
        }
        message.freeze()
    }
}

impl Ros1Sink {
    pub(crate) fn new(destination: Destination) -> Self {
        let Destination {
            ros_topic,
            mapped,
            lasting,
            ..
        } = destination;
        Self {
            ros_topic,
            choice: Choice::new(mapped),
            open: None,
            silent: None,
            lasting,
        }
    }

    /// Returns true if the mapping defines both sinks in the same way.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        self.ros_topic == other.ros_topic
            && self.choice.mapped() == other.choice.mapped()
            && self.lasting == other.lasting
    }

    /// Returns the possible types, best first. `asked_for` is the type registered at the master.
    pub(crate) fn candidates(&self, asked_for: Option<&str>) -> Vec<TypeName> {
        let refused = self
            .open
            .as_ref()
            .and_then(|open| open.publisher.refused_type());
        let asked_for = asked_for.map(str::to_owned).into_iter().chain(refused);
        let asked_for = asked_for.filter_map(|name| name.parse().ok());
        self.choice.candidates(asked_for)
    }

    /// Returns true if the open publisher has subscribers, or no subscriber requested another type;
    /// then it is kept.
    pub(crate) fn serves(&self) -> bool {
        self.open.as_ref().is_some_and(|open| {
            open.publisher.subscribers() > 0 || open.publisher.refused_type().is_none()
        })
    }

    /// Returns the publisher options. The queue of the Router limits waiting values; the publisher
    /// uses the default queue for slow subscribers. If the source decides whether a topic is
    /// latched, this is known with its first state.
    pub(crate) fn options(&self) -> PublisherOptions {
        PublisherOptions {
            latch: self.lasting == Lasting::State,
            ..PublisherOptions::default()
        }
    }
}

/// How long the events of a topic that was advertised wait for subscribers that the master knows.
/// One that was killed stays known, and never connects.
const CONNECTED_WITHIN: Duration = Duration::from_secs(1);
/// Events that may wait for them.
const MOST_WAITING: usize = 512;

#[cfg(test)]
mod tests {
    use bridge_node::policy::{PortStep, Word};
    use mappings::Overflow;
    use messages::Selection;

    use super::*;

    #[test]
    fn a_subscriber_decides_before_the_standard_type() {
        let mut sink = Ros1Sink::new(Destination {
            ros_topic: "/ua_2_2_3".to_owned(),
            mapped: None,
            overflow: Overflow::KeepLatest,
            lasting: Lasting::State,
        });
        let word = Word {
            standard: Some("std_msgs/Float64".parse().unwrap()),
            ..Word::default()
        };
        assert_eq!(sink.choice.hear(word, None), PortStep::Open);
        assert_eq!(sink.candidates(None), ["std_msgs/Float64".parse().unwrap()]);
        let asked: [TypeName; 2] = [
            "std_msgs/Float32".parse().unwrap(),
            "std_msgs/Float64".parse().unwrap(),
        ];
        assert_eq!(sink.candidates(Some("std_msgs/Float32")), asked);
        assert_eq!(sink.candidates(Some("*")).len(), 1);
        assert!(sink.options().latch);
    }

    #[test]
    fn an_event_is_not_latched() {
        let sink = Ros1Sink::new(Destination {
            ros_topic: "/button".to_owned(),
            mapped: Some(("std_msgs/Bool".parse().unwrap(), Selection::Whole)),
            overflow: Overflow::DropOldest(8.try_into().unwrap()),
            lasting: Lasting::Event,
        });
        assert!(!sink.options().latch);
    }

    #[test]
    fn events_wait_until_the_subscribers_that_the_master_knows_are_connected() {
        let now = bridge_node::now().monotonic;
        let nodes = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        assert!(TopicOpening::of(None, "/bridge", now).is_none());
        assert!(TopicOpening::of(Some(&nodes(&["/bridge"])), "/bridge", now).is_none());
        let known = nodes(&["/arm", "/bridge", "/gripper"]);
        let mut opening = TopicOpening::of(Some(&known), "/bridge", now).unwrap();
        assert!(!opening.is_over(|_| false, now));
        assert!(!opening.is_over(|node| node == "/arm", now));
        assert!(opening.is_over(|node| node != "/bridge", now));
        assert!(opening.is_over(|_| false, now + CONNECTED_WITHIN));
        let event = || (Bytes::from_static(b"stop"), Latched::Alone(0));
        for _ in 0..MOST_WAITING {
            opening.queue(event()).unwrap();
        }
        assert!(opening.queue(event()).is_err());
        assert_eq!(opening.drop_waiting(), u64::try_from(MOST_WAITING).unwrap());
        assert!(opening.is_empty());
    }
}
