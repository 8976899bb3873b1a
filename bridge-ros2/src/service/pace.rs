//! How often a client looks for its servers.

use std::time::Duration;

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

#[cfg(test)]
mod tests {
    use super::*;

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
