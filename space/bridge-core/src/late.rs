//! The age of messages that a broker stored.

use std::time::Duration;

use mappings::Lasting;
use uadp::Timestamp;

use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::place::SequencePosition;
use crate::settings::Relay;

/// The case and details of a late message.
type Late = (&'static str, String);

impl Relay {
    /// Returns the reason why a message is late.
    pub(crate) fn judge_message(self, sent: Option<Timestamp>, now: Timestamp) -> Option<Late> {
        aged(sent?, now, self.within)
    }

    /// Returns the reason why a DataSetMessage is late. Commands have their own limit.
    pub(crate) fn judge_value(
        self,
        place: &SequencePosition,
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

/// Returns whether a message of this time is late, or dated too far in the future to judge.
#[must_use]
pub fn is_aged(time: Timestamp, now: Timestamp, within: Duration) -> bool {
    aged(time, now, within).is_some()
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
    Some(if age > 0 {
        (
            "old",
            format!(
                "it was sent {millis} ms ago, but at most {within} ms are allowed; the broker is slow, or the clocks of the hosts differ"
            ),
        )
    } else {
        (
            "future",
            format!(
                "it was sent {millis} ms in the future, so its age is unknown; synchronise the clocks of the hosts"
            ),
        )
    })
}

/// The cause of [`Reason::Late`] for a message without a time.
pub(crate) const GIVEN_UP: &str = "given_up";
pub(crate) const UNTIMED: &str = "untimed";
/// The cause of [`Reason::Late`] for a command that waited for a stopped program.
pub(crate) const WAITED: &str = "waited";
pub(crate) const NO_TIME: &str =
    "it carries no time, and a broker may deliver it late; its sender must set the Timestamp";

/// Returns the details of a command or request that waited for this program.
pub(crate) fn waited(waited: Duration) -> String {
    let millis = waited.as_millis();
    format!(
        "it waited {millis} ms for this program, which was stopped or overloaded, and its sender has given it up"
    )
}

/// Returns the counted cause of a late message.
pub(crate) const fn cause(case: &'static str) -> (Reason, &'static str) {
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
