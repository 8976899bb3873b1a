//! The intervals at which a client looks for its servers.

use std::time::Duration;

use tokio::time::Instant;

use super::{BUSY, IDLE};

/// The condition that the calls of a client wait for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AwaitedCondition {
    /// No call waits, or all calls wait for replies only.
    Nothing,
    /// No server is known.
    Server,
    /// A server is known, and has to discover the client or to process earlier requests.
    Turn,
}

/// The interval of the next poll. Each poll of the peers copies the discovery data of RustDDS, so
/// the polls for an absent server become less frequent. A server that starts together with its
/// client is still found at once.
#[derive(Debug)]
pub(super) struct Pace {
    next: Duration,
    awaited: AwaitedCondition,
}

impl Pace {
    pub(super) fn new() -> Self {
        Self {
            next: BUSY,
            awaited: AwaitedCondition::Nothing,
        }
    }

    /// Records a poll.
    pub(super) fn looked(&mut self, awaited: AwaitedCondition) {
        self.next = match (self.awaited, awaited) {
            (AwaitedCondition::Server, AwaitedCondition::Server) => IDLE.min(self.next * 2),
            _ => BUSY,
        };
        self.awaited = awaited;
    }

    /// Returns the time until the next poll.
    pub(super) fn pause(&self, awaited: AwaitedCondition) -> Duration {
        match awaited {
            AwaitedCondition::Nothing => IDLE,
            AwaitedCondition::Server => self.next,
            AwaitedCondition::Turn => BUSY,
        }
    }

    /// Returns the maximum age of the peers' snapshot at that poll.
    pub(super) fn age(&self, awaited: AwaitedCondition) -> Duration {
        match awaited {
            AwaitedCondition::Nothing => IDLE,
            AwaitedCondition::Turn => FRESH,
            AwaitedCondition::Server => self.next,
        }
    }
}

/// The maximum age of the peers' snapshot when a request is sent: the known server may be dead
/// while its lease still runs, and its successor present.
pub(super) const FRESH: Duration = Duration::from_millis(20);

/// Returns whether another request may be sent at `now`, given the send times of the unanswered
/// requests, newest first.
///
/// A server of rmw keeps the last ten requests that it has not taken yet
/// (`rmw_qos_profile_services_default`), even with reliable delivery: of twenty simultaneous
/// requests the first ten are lost without a report. The server has taken all answered requests. A
/// request with a late reply, such as for the result of a goal, has most likely been taken as well.
pub(super) fn may_ask(unanswered: impl Iterator<Item = Instant>, now: Instant) -> bool {
    let recent = unanswered.take_while(|sent| now.saturating_duration_since(*sent) < TAKEN);
    recent.take(AT_ONCE).count() < AT_ONCE
}

/// Maximum number of requests that a server has to keep.
const AT_ONCE: usize = 8;
/// The time after which a server has taken a request, answered or not.
const TAKEN: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_not_sent_more_than_it_keeps_until_it_answers_or_some_time_is_over() {
        let now = Instant::now();
        let ago = |millis| now - Duration::from_millis(millis);
        assert!(may_ask(std::iter::empty(), now));
        assert!(may_ask((0..7).map(ago), now));
        assert!(!may_ask((0..8).map(ago), now));
        // Requests sent 100 ms ago or earlier do not count.
        assert!(may_ask((93..900).map(ago), now));
        assert!(!may_ask((92..900).map(ago), now));
    }

    /// Returns the times of the polls within a period, for a constant condition.
    fn looks(pace: &mut Pace, awaited: AwaitedCondition, within: Duration) -> Vec<Duration> {
        let mut at = Duration::ZERO;
        let mut all = Vec::new();
        while at < within {
            all.push(at);
            pace.looked(awaited);
            at += pace.pause(awaited);
        }
        all
    }

    #[test]
    fn an_absent_server_is_looked_for_often_at_first_and_five_times_a_second_later() {
        let all = looks(
            &mut Pace::new(),
            AwaitedCondition::Server,
            Duration::from_secs(10),
        );
        let of_100_ms = |from: u64| {
            let from = Duration::from_millis(from);
            let to = from + Duration::from_millis(100);
            all.iter().filter(|at| (from..to).contains(at)).count()
        };
        assert!(of_100_ms(0) >= 4, "{all:?}");
        assert!(all.len() < 60, "{} looks in 10 s", all.len());
        let last = all.last().unwrap();
        assert!(*last >= Duration::from_millis(9_790), "{last:?}");
    }

    #[test]
    fn a_server_that_is_known_is_asked_at_once_by_what_is_known_by_then() {
        let mut pace = Pace::new();
        looks(&mut pace, AwaitedCondition::Server, Duration::from_secs(2));
        pace.looked(AwaitedCondition::Turn);
        assert_eq!(pace.pause(AwaitedCondition::Turn), BUSY);
        assert_eq!(pace.age(AwaitedCondition::Turn), FRESH);
        // The search for the next absent server starts at the same interval as the first search.
        pace.looked(AwaitedCondition::Server);
        assert_eq!(pace.pause(AwaitedCondition::Server), BUSY);
    }
}
