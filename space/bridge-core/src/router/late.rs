//! Messages that a broker delivered late.

use std::time::Duration;

use mappings::{Lasting, TopicId};
use uadp::{NetworkHeader, Timestamp};

use super::{Router, Values};
use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::place::Place;
use crate::settings::{Now, Relay};

/// The case and details of a late message.
type Late = (&'static str, String);

impl Router {
    /// Sets the properties of the broker between the programs, or `None` for a network that does
    /// not store messages.
    ///
    /// A received message that is older than [`Relay::within`] is dropped: a broker may deliver a
    /// message after its sender has given it up. Messages that act but carry no time are dropped
    /// too.
    pub const fn set_relay(&mut self, relay: Option<Relay>) {
        self.values.relay = relay;
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
        self.values.is_command(topic)
    }
}

impl Values {
    fn is_command(&self, topic: TopicId) -> bool {
        let entry = self.topics.get(&topic);
        entry.is_some_and(|entry| entry.confirming.is_some())
    }

    /// Returns whether the repetitions of a value carry the time of its first transmission. A
    /// broker could deliver a repetition after the command was given up.
    pub(super) fn keeps_time(&self, topic: TopicId) -> bool {
        self.relay.is_some() && self.is_command(topic)
    }

    /// Returns the headers of a request or a response. Over a broker they contain
    /// the time of sending.
    pub(super) fn action_header(&self, now: Now) -> NetworkHeader<'static> {
        match self.relay {
            None => NetworkHeader::default(),
            Some(_) => NetworkHeader {
                timestamp: Some(now.utc.time),
                picoseconds: Some(now.utc.picoseconds),
                ..NetworkHeader::default()
            },
        }
    }

    /// Returns whether the caller of a request has stopped waiting while a broker had the request:
    /// `left` is its TimeoutHint.
    pub(super) fn is_given_up(
        &self,
        header: &NetworkHeader<'_>,
        left: Option<Duration>,
        now: Now,
    ) -> bool {
        let (Some(_), Some(time), Some(left)) = (self.relay, header.timestamp, left) else {
            return false;
        };
        let age = now.utc.unix_nanos() - Timestamp::from(time).unix_nanos();
        age > i128::try_from(left.as_nanos()).unwrap_or(i128::MAX)
    }

    /// Returns whether a request without a time of sending was received over a broker.
    pub(super) const fn is_untimed(&self, header: &NetworkHeader<'_>) -> bool {
        self.relay.is_some() && header.timestamp.is_none()
    }
}

impl Relay {
    /// Returns the reason why a message is late.
    pub(crate) fn judge_message(self, sent: Option<Timestamp>, now: Timestamp) -> Option<Late> {
        aged(sent?, now, self.within)
    }

    /// Returns the reason why a DataSetMessage is late. Commands have their own limit.
    pub(crate) fn judge_value(
        self,
        place: &Place,
        (confirming, lasting): (Option<&Confirming>, Lasting),
        now: Timestamp,
    ) -> Option<Late> {
        // A client of an OPC UA server has its own clock.
        let taken = place.stamp.filter(|_| !place.by_clients);
        let Some(confirming) = confirming else {
            let is_timed = place.sent.is_some() || place.stamp.is_some();
            if !is_timed && lasting != Lasting::State {
                return Some((UNTIMED, NO_TIME.to_owned()));
            }
            // Late joiners get states that were taken long ago, so only the time of sending counts
            // for a state.
            let time = match lasting {
                Lasting::State => place.sent?,
                Lasting::Event | Lasting::AsSource => place.sent.or(place.stamp)?,
            };
            return aged(time, now, self.within);
        };
        let within = confirming.within().min(self.within);
        if place.sent.is_none() && taken.is_none() {
            return Some((UNTIMED, NO_TIME.to_owned()));
        }
        let times = [place.sent, taken].into_iter().flatten();
        times.filter_map(|time| aged(time, now, within)).next()
    }
}

/// Returns the reason why a message of this time is late. A time in the future cannot be judged:
/// the clocks differ.
fn aged(time: Timestamp, now: Timestamp, within: Duration) -> Option<Late> {
    let age = now.unix_nanos() - time.unix_nanos();
    let limit = i128::try_from(within.as_nanos()).unwrap_or(i128::MAX);
    if age.abs() <= limit {
        return None;
    }
    let millis = age.abs() / 1_000_000;
    let within = within.as_millis();
    Some(match age > 0 {
        true => (
            "old",
            format!(
                "it was sent {millis} ms ago, and at most {within} ms are allowed; is the broker slow, or do the clocks differ?"
            ),
        ),
        false => (
            "future",
            format!(
                "it was sent {millis} ms in the future, so its age is unknown; synchronise the clocks of the hosts"
            ),
        ),
    })
}

/// The cause of [`Reason::Late`] for a message without a time.
pub(super) const GIVEN_UP: &str = "given_up";
pub(super) const UNTIMED: &str = "untimed";
pub(super) const NO_TIME: &str =
    "it carries no time, and a broker may deliver it late; its sender must set the Timestamp";

/// Returns the counted cause of a late message.
pub(super) const fn cause(case: &'static str) -> (Reason, &'static str) {
    (Reason::Late, case)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: i128) -> Timestamp {
        Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + millis * 1_000_000)
    }

    #[test]
    fn a_message_is_late_after_its_time_and_if_its_time_is_in_the_future() {
        let within = Duration::from_secs(1);
        for (sent, case) in [
            (0, None),
            (-1000, None),
            (1000, None),
            (-1001, Some("old")),
            (1001, Some("future")),
        ] {
            let late = aged(at(sent), at(0), within);
            assert_eq!(late.map(|(case, _)| case), case, "{sent}");
        }
    }
}
