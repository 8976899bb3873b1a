//! Messages that a broker delivered late.

use std::time::Duration;

use mappings::{Lasting, TopicId};
use uadp::{NetworkHeader, Timestamp};

use super::{Router, TopicQueues};
use crate::confirm::Confirming;
use crate::settings::{Forwarding, Now, Relay};
use crate::topic::Topic;
use crate::topics::Handle;

impl Router {
    /// Sets the properties of the broker between the programs, or `None` for a network that does
    /// not store messages.
    ///
    /// A received message that is older than [`Relay::within`] is dropped: a broker may deliver a
    /// message after its sender has given it up. Messages that act but carry no time are dropped
    /// too.
    pub const fn set_relay(&mut self, relay: Option<Relay>) {
        self.values.relay = relay;
        self.values.arrival = relay;
    }

    /// Sets the largest message in bytes that the network takes; `None` if only the mapping limits
    /// it.
    pub const fn set_limit(&mut self, limit: Option<u16>) {
        self.values.limit = limit;
    }

    /// Sets the properties of the network by which the next message is received, if the program
    /// has several networks. [`set_relay`](Self::set_relay) sets the same for all.
    pub const fn set_arrival(&mut self, relay: Option<Relay>, forwarding: Forwarding) {
        self.values.arrival = relay;
        self.values.forwarding = forwarding;
    }

    /// Returns the time after which a message of the topic must not be delivered any more; `None`
    /// without a broker.
    #[must_use]
    pub fn expiry(&self, topic: TopicId) -> Option<Duration> {
        let relay = self.values.relay?;
        let confirming = self.values.topics.get(&topic)?.confirming.as_deref();
        let within = confirming.map_or(relay.within, Confirming::within);
        Some(within.min(relay.within))
    }

    /// Returns whether a newer value of the topic replaces an older one, as for a state.
    #[must_use]
    pub fn is_state(&self, topic: TopicId) -> bool {
        let entry = self.values.topics.get(&topic);
        entry.is_some_and(|entry| entry.lasting == Lasting::State)
    }

    /// Returns whether bridges confirm the values of the topic.
    #[must_use]
    pub fn is_command(&self, topic: TopicId) -> bool {
        let entry = self.values.topics.get(&topic);
        entry.is_some_and(|entry| entry.confirming.is_some())
    }
}

impl TopicQueues {
    /// Returns whether the repetitions of a value carry the time of its first transmission. A
    /// broker could deliver a repetition after the command was given up. A program that forwards
    /// sealed messages to a broker cannot recognise repetitions.
    pub(super) fn keeps_time(&self, at: Handle) -> bool {
        let is_command = |entry: &Topic| entry.confirming.is_some();
        let is_stored = self.relay.is_some() || self.seals();
        is_stored && self.topics.at(at).is_some_and(is_command)
    }

    /// Returns whether messages of a group are sealed.
    pub(super) const fn seals(&self) -> bool {
        self.overhead > 0
    }

    /// Returns whether each repetition of a request or a response in chunks has its own time of
    /// sending, as over a broker. On UDP it has the time of the first transmission: its chunks
    /// replace lost chunks of the first transmission, so both must be equal.
    pub(super) const fn dates_repetitions(&self) -> bool {
        self.relay.is_some()
    }

    /// Returns whether the caller of a request has stopped waiting while a broker had the request:
    /// `left` is its TimeoutHint.
    pub(super) fn is_given_up(
        &self,
        header: &NetworkHeader<'_>,
        left: Option<Duration>,
        now: Now,
    ) -> bool {
        let (Some(_), Some(time), Some(left)) = (self.arrival, header.timestamp, left) else {
            return false;
        };
        let age = now.utc.unix_nanos() - Timestamp::from(time).unix_nanos();
        age > i128::try_from(left.as_nanos()).unwrap_or(i128::MAX)
    }

    /// Returns whether a request without a time of sending was received over a broker.
    pub(super) const fn is_untimed(&self, header: &NetworkHeader<'_>) -> bool {
        self.arrival.is_some() && header.timestamp.is_none()
    }
}

/// Returns headers with the time of sending. A program may forward the message to a broker, whose
/// receivers judge the age.
pub(super) fn timed_header(now: Now) -> NetworkHeader<'static> {
    NetworkHeader {
        timestamp: Some(now.utc.time),
        picoseconds: Some(now.utc.picoseconds),
        ..NetworkHeader::default()
    }
}
