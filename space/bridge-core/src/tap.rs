//! The way of each sample of a tapped topic, so that an operator sees why a value does not cross.

use std::collections::VecDeque;
use std::net::SocketAddr;

use mappings::TopicId;

use crate::counters::{DropCause, Reason};
use crate::hops::Hop;

/// The tapped topics and the events that were not taken yet.
#[derive(Debug, Default)]
pub(crate) struct TappedTopics {
    topics: Vec<TopicId>,
    events: VecDeque<Tapped>,
    /// The number of events for which there was no room.
    lost: u64,
}

/// An event of a sample of a tapped topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tapped {
    /// The topic.
    pub topic: TopicId,
    /// The event.
    pub crossing: Crossing,
}

/// A step of a sample on its way.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Crossing {
    /// The local side has given a sample of the own space to the program.
    Taken {
        /// The size of the sample in the encoding of the local side.
        bytes: usize,
    },
    /// A sample of the own space went into the PubSub network.
    Sent {
        /// Whether it was sent before: for late joiners, or in case it was lost.
        repeated: bool,
    },
    /// A message of another space has arrived.
    Received {
        /// The address of the sender.
        from: SocketAddr,
        /// The sequence number.
        sequence: Option<u16>,
        /// Whether the message has no value.
        keep_alive: bool,
    },
    /// A received message belongs to a route between carriers.
    Forwarded {
        /// The reason why it was not forwarded; `None` if it was forwarded.
        refused: Option<&'static str>,
    },
    /// The local side has published a sample of another space.
    Published {
        /// The time from the arrival of the datagram, in nanoseconds.
        after: i128,
    },
    /// The delay of a hop of a sample was measured.
    Measured {
        /// The hop.
        hop: Hop,
        /// The delay in nanoseconds; negative between hosts whose clocks differ.
        nanos: i128,
    },
    /// Samples were dropped.
    Dropped {
        /// The counted reason.
        reason: Reason,
        /// The case of the reason; empty if there is only one.
        case: &'static str,
        /// The details in words; may be empty.
        detail: String,
        /// The sender, if the sample was received.
        from: Option<SocketAddr>,
        /// The number of samples.
        count: u64,
    },
}

impl TappedTopics {
    /// Sets the tapped topics. Without topics, nothing is recorded.
    pub(crate) fn set(&mut self, topics: &[TopicId]) {
        if self.topics == topics {
            return;
        }
        self.topics = topics.to_vec();
        self.events.retain(|event| topics.contains(&event.topic));
        if topics.is_empty() {
            *self = Self::default();
        }
    }

    /// Returns whether topics are tapped.
    pub(crate) const fn is_on(&self) -> bool {
        !self.topics.is_empty()
    }

    /// Returns whether the topic is tapped.
    pub(crate) fn taps(&self, topic: TopicId) -> bool {
        self.topics.contains(&topic)
    }

    /// Takes the oldest event.
    pub(crate) fn next(&mut self) -> Option<Tapped> {
        self.events.pop_front()
    }

    /// Takes the number of events for which there was no room.
    pub(crate) const fn take_lost(&mut self) -> u64 {
        std::mem::replace(&mut self.lost, 0)
    }

    /// Records an event of a topic, if the topic is tapped.
    #[inline]
    pub(crate) fn note(&mut self, topic: TopicId, crossing: impl FnOnce() -> Crossing) {
        if self.is_on() && self.taps(topic) {
            self.push(topic, crossing());
        }
    }

    /// Records the drop of samples, if the topic is tapped.
    pub(crate) fn note_drop(
        &mut self,
        (topic, from): (TopicId, Option<SocketAddr>),
        DropCause { reason, case }: DropCause,
        (count, detail): (u64, &str),
    ) {
        self.note(topic, || Crossing::Dropped {
            reason,
            case,
            detail: detail.to_owned(),
            from,
            count,
        });
    }

    fn push(&mut self, topic: TopicId, crossing: Crossing) {
        if self.events.len() >= MOST_EVENTS {
            self.events.pop_front();
            self.lost += 1;
        }
        self.events.push_back(Tapped { topic, crossing });
    }
}

/// The run loop takes events after each datagram.
const MOST_EVENTS: usize = 1_024;
