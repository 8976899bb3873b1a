//! Who still answers: endpoints that are tried again and again.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// An endpoint to try now: open a connection to it, and tell [`Registry::probed`](crate::Registry::probed) what came of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Probe {
    /// The URL as it was told.
    pub url: String,
}

/// What came of a try.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// It answers. With the StartTime of its ServerStatus where that was read, in 100 ns since 1601.
    Alive {
        /// `None` where only the connection was tried.
        start_time: Option<i64>,
    },
    /// The host says that nobody listens there: the program is gone.
    Refused,
    /// Nothing came back.
    Silent,
    /// It could not be tried, as when the name of the host is not known here: that says nothing of the server.
    Untried,
}

/// What a try says of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sign {
    /// Nothing that is new.
    Nothing,
    /// It is another run of the program.
    Restarted,
    /// It has not answered for too long.
    Lost,
}

/// The endpoints under watch.
#[derive(Debug, Default)]
pub(crate) struct Watch(BTreeMap<String, Watched>);

#[derive(Debug)]
struct Watched {
    answered: Instant,
    try_at: Instant,
    start_time: Option<i64>,
}

impl Watch {
    /// Looks after a URL from now on. What is heard of a server is a sign of life only the first time: an announcement
    /// outlives its server.
    pub(crate) fn add(&mut self, url: &str, every: Duration, now: Instant) {
        if !self.0.contains_key(url) {
            let watched = Watched {
                answered: now,
                try_at: now + every,
                start_time: None,
            };
            self.0.insert(url.to_owned(), watched);
        }
    }

    pub(crate) fn remove(&mut self, url: &str) {
        self.0.remove(url);
    }

    /// The endpoint whose turn it is, if any; its next turn is after `every`.
    pub(crate) fn next(&mut self, every: Duration, now: Instant) -> Option<Probe> {
        let (url, watched) = self
            .0
            .iter_mut()
            .filter(|(_, watched)| watched.try_at <= now)
            .min_by_key(|(_, watched)| watched.try_at)?;
        watched.try_at = now + every;
        Some(Probe { url: url.clone() })
    }

    /// Has a URL tried at the next opportunity.
    pub(crate) fn hasten(&mut self, url: &str) {
        if let Some(watched) = self.0.get_mut(url) {
            watched.try_at = watched.answered;
        }
    }

    pub(crate) fn due(&self) -> Option<Instant> {
        self.0.values().map(|watched| watched.try_at).min()
    }

    /// Takes note of what came of a try.
    pub(crate) fn probed(
        &mut self,
        url: &str,
        outcome: Outcome,
        (every, lost_after): (Duration, Duration),
        now: Instant,
    ) -> Sign {
        let Some(watched) = self.0.get_mut(url) else {
            return Sign::Nothing;
        };
        match outcome {
            Outcome::Alive { start_time } => {
                watched.answered = now;
                let before = watched.start_time;
                watched.start_time = start_time.or(before);
                match (before, start_time) {
                    (Some(before), Some(after)) if before != after => Sign::Restarted,
                    _ => Sign::Nothing,
                }
            }
            Outcome::Refused => Sign::Lost,
            Outcome::Silent if now.saturating_duration_since(watched.answered) >= lost_after => {
                Sign::Lost
            }
            Outcome::Silent => {
                // Tried again soon, so that two tries that wait fit into the time.
                watched.try_at = now + every / 10;
                Sign::Nothing
            }
            Outcome::Untried => Sign::Nothing,
        }
    }
}
