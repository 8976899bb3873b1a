//! The way of each sample of a tapped topic, so that an operator sees why a value does not cross.

use std::collections::VecDeque;
use std::net::SocketAddr;

use mappings::TopicId;

use super::{Router, Values};
use crate::counters::{Cause, Reason};

/// The tapped topics and the events that were not taken yet.
#[derive(Debug, Default)]
pub(super) struct Tap {
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
    /// The local side has published a sample of another space.
    Published {
        /// The time from the arrival of the datagram, in nanoseconds.
        after: i128,
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

impl Router {
    /// Sets the tapped topics. Without topics, nothing is recorded.
    pub fn tap(&mut self, topics: &[TopicId]) {
        if topics.is_empty() {
            self.values.tap = None;
            return;
        }
        let tap = self.values.tap.get_or_insert_default();
        if tap.topics != topics {
            tap.topics = topics.to_vec();
            tap.events.retain(|event| topics.contains(&event.topic));
        }
    }

    /// Returns whether topics are tapped.
    #[must_use]
    pub const fn is_tapped(&self) -> bool {
        self.values.tap.is_some()
    }

    /// Takes the oldest event of the tapped topics.
    pub fn next_tapped(&mut self) -> Option<Tapped> {
        self.values.tap.as_mut()?.events.pop_front()
    }

    /// Takes the number of events for which there was no room.
    pub fn take_lost_taps(&mut self) -> u64 {
        let tap = self.values.tap.as_mut();
        tap.map_or(0, |tap| std::mem::take(&mut tap.lost))
    }
}

impl Values {
    /// Records an event of a topic, if the topic is tapped.
    pub(super) fn note(&mut self, topic: TopicId, crossing: impl FnOnce() -> Crossing) {
        let Some(tap) = &mut self.tap else {
            return;
        };
        if !tap.topics.contains(&topic) {
            return;
        }
        if tap.events.len() >= MOST_EVENTS {
            tap.events.pop_front();
            tap.lost += 1;
        }
        let crossing = crossing();
        tap.events.push_back(Tapped { topic, crossing });
    }

    /// Records the drop of samples, if the topic is tapped.
    pub(super) fn note_drop(
        &mut self,
        (topic, from): (TopicId, Option<SocketAddr>),
        Cause { reason, case }: Cause,
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

    /// Returns whether the topic is tapped.
    pub(super) fn taps(&self, topic: TopicId) -> bool {
        let tap = self.tap.as_ref();
        tap.is_some_and(|tap| tap.topics.contains(&topic))
    }
}

/// The run loop takes events after each datagram.
const MOST_EVENTS: usize = 1_024;
