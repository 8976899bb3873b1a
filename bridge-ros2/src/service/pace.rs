//! How often a client looks for its servers.

use std::time::Duration;

use tokio::time::Instant;

use super::{BUSY, IDLE};

/// What the calls of a client wait for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Awaited {
    /// No call waits, or only for replies.
    Nothing,
    /// No server is known.
    Server,
    /// A server is known, and is to learn of us or to take what it was sent.
    Turn,
}

/// When to look again. Each look at the peers copies what RustDDS has discovered, so one for a server that is not there
/// comes later each time; a server that starts with its client is found at once nevertheless.
#[derive(Debug)]
pub(super) struct Pace {
    next: Duration,
    awaited: Awaited,
}

impl Pace {
    pub(super) fn new() -> Self {
        Self {
            next: BUSY,
            awaited: Awaited::Nothing,
        }
    }

    /// To be told at each look.
    pub(super) fn looked(&mut self, awaited: Awaited) {
        self.next = match (self.awaited, awaited) {
            (Awaited::Server, Awaited::Server) => IDLE.min(self.next * 2),
            _ => BUSY,
        };
        self.awaited = awaited;
    }

    /// The time to the next look.
    pub(super) fn pause(&self, awaited: Awaited) -> Duration {
        match awaited {
            Awaited::Nothing => IDLE,
            Awaited::Server => self.next,
            Awaited::Turn => BUSY,
        }
    }

    /// How old what is known of the peers may be at that look.
    pub(super) fn age(&self, awaited: Awaited) -> Duration {
        match awaited {
            Awaited::Nothing => IDLE,
            Awaited::Turn => FRESH,
            Awaited::Server => self.next,
        }
    }
}

/// How old what is known of the peers may be when a server is asked: the one that is known may be dead, with its lease
/// still running, and its successor there.
pub(super) const FRESH: Duration = Duration::from_millis(20);

/// Whether one more request may be sent now, given when those that are unanswered were sent, newest first.
///
/// A server of rmw keeps the last ten requests that it has not taken yet (`rmw_qos_profile_services_default`), also where
/// delivery is reliable: of twenty at once the first ten are gone, and nobody is told. Those that are answered it has taken.
/// One that it answers late, such as for the result of a goal, it has taken by then most likely.
pub(super) fn may_ask(unanswered: impl Iterator<Item = Instant>, now: Instant) -> bool {
    let recent = unanswered.take_while(|sent| now.saturating_duration_since(*sent) < TAKEN);
    recent.take(AT_ONCE).count() < AT_ONCE
}

/// Requests that a server has to keep, at most.
const AT_ONCE: usize = 8;
/// After that time a server has taken a request, answered or not.
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
        // One of eight is from long ago, and so is what came before.
        assert!(may_ask((93..900).map(ago), now));
        assert!(!may_ask((92..900).map(ago), now));
    }

    /// The times of the looks within so long, while that is awaited.
    fn looks(pace: &mut Pace, awaited: Awaited, within: Duration) -> Vec<Duration> {
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
        let all = looks(&mut Pace::new(), Awaited::Server, Duration::from_secs(10));
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
        looks(&mut pace, Awaited::Server, Duration::from_secs(2));
        pace.looked(Awaited::Turn);
        assert_eq!(pace.pause(Awaited::Turn), BUSY);
        assert_eq!(pace.age(Awaited::Turn), FRESH);
        // The next server that is absent is looked for as the first was.
        pace.looked(Awaited::Server);
        assert_eq!(pace.pause(Awaited::Server), BUSY);
    }
}
