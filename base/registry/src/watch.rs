//! Who still answers: endpoints that are tried again and again.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::loss::Loss;
use crate::network::place;

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
    /// The host takes the connection, and the program behind it says nothing: it hangs, or is stopped.
    Hanging,
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
    /// It is not there, or has not answered for too long.
    Lost(Loss),
}

/// How patient a watch is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    /// How often an endpoint is tried, while there are few.
    pub(crate) every: Duration,
    /// How long a host may be silent.
    pub(crate) silent: Duration,
    /// How long a program that answers during calls may be silent while its host is there.
    pub(crate) hanging: Duration,
    /// How long any other program may be.
    pub(crate) busy: Duration,
}

/// The endpoints under watch, by host and port: URLs that differ in their path only are one endpoint, which is probed once.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    endpoints: BTreeMap<String, Watched>,
    pauses: BTreeMap<String, Pause>,
    /// Until when the tries that were made take up what may be tried.
    taken_until: Option<Instant>,
}

/// How long a host and port is left alone after failed probes. The pause outlives its records, so that a record that is
/// repeated under other names does not reset it.
#[derive(Debug, Clone, Copy)]
struct Pause {
    failures: u32,
    /// When the last probe ended.
    probed: Instant,
    until: Instant,
    has_answered: bool,
}

#[derive(Debug)]
struct Watched {
    /// The URL that is probed.
    url: String,
    answered: Instant,
    /// Whether it ever did; before, `answered` is when it was heard of.
    has_answered: bool,
    /// Whether an announcement named its start time: the program was running then.
    has_announced: bool,
    try_at: Instant,
    start_time: Option<i64>,
    /// Whether the server answers while it executes methods.
    answers_during_calls: bool,
}

impl Watch {
    /// Watches the endpoint of a URL. What is heard of a server is a sign of life only the first time: an announcement
    /// outlives its server. Many that appear together are not tried together.
    pub(crate) fn add(&mut self, url: &str, every: Duration, now: Instant) {
        let first_try = now + every.mul_f64(spread(url));
        let watched = || Watched {
            url: url.to_owned(),
            answered: now,
            has_answered: false,
            has_announced: false,
            try_at: first_try,
            start_time: None,
            answers_during_calls: false,
        };
        let place = place(url);
        // A server that comes back is found soon; forged records cause one probe per `every` there.
        if let Some(pause) = self.pauses.get_mut(&place)
            && pause.has_answered
        {
            pause.until = pause.until.min(pause.probed + every);
        }
        self.endpoints.entry(place).or_insert_with(watched);
    }

    pub(crate) fn contains(&self, url: &str) -> bool {
        self.endpoints.contains_key(&place(url))
    }

    /// Returns whether the endpoint has answered a probe since it is under watch.
    pub(crate) fn has_answered(&self, url: &str) -> bool {
        self.has_answered_at(&place(url))
    }

    /// The same by host and port.
    pub(crate) fn has_answered_at(&self, place: &str) -> bool {
        let watched = self.endpoints.get(place);
        watched.is_some_and(|watched| watched.has_answered)
    }

    /// Returns whether probes of the endpoint failed and its pause is not over.
    pub(crate) fn is_paused(&self, url: &str, now: Instant) -> bool {
        let pause = self.pauses.get(&place(url));
        pause.is_some_and(|pause| pause.failures > 0 && pause.until > now)
    }

    /// How often each of them is tried: less often where there are many. Endpoints that never answered do not slow down
    /// the probes of live ones.
    fn pace(&self, every: Duration) -> Duration {
        let live = self.endpoints.values().filter(|one| one.has_answered);
        let count = u32::try_from(live.count()).unwrap_or(u32::MAX);
        every.max(LEAST_APART.saturating_mul(count))
    }

    pub(crate) fn remove(&mut self, url: &str) {
        self.endpoints.remove(&place(url));
    }

    /// The endpoint whose turn it is, if any; its next turn is after `every`, or later where there are many. Live endpoints
    /// come first.
    pub(crate) fn next(&mut self, every: Duration, now: Instant) -> Option<Probe> {
        let every = self.pace(every);
        if self.taken_until.is_some_and(|until| until > now + BURST) {
            return None;
        }
        let Self {
            endpoints, pauses, ..
        } = self;
        let (_, watched) = endpoints
            .iter_mut()
            .filter(|(place, watched)| watched.due(pauses.get(*place)) <= now)
            .min_by_key(|(_, watched)| (!watched.has_answered, watched.try_at))?;
        watched.try_at = now + every;
        let url = watched.url.clone();
        let from = self.taken_until.map_or(now, |until| until.max(now));
        self.taken_until = Some(from + LEAST_APART);
        Some(Probe { url })
    }

    /// Has a URL tried at the next opportunity.
    pub(crate) fn hasten(&mut self, url: &str) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.try_at = watched.answered;
        }
    }

    /// Nobody could have answered meanwhile.
    pub(crate) fn stood_still(&mut self, how_long: Duration) {
        for watched in self.endpoints.values_mut() {
            watched.answered += how_long;
        }
    }

    pub(crate) fn due(&self) -> Option<Instant> {
        let due = self
            .endpoints
            .iter()
            .map(|(place, watched)| watched.due(self.pauses.get(place)))
            .min()?;
        let free = self.taken_until.and_then(|until| until.checked_sub(BURST));
        Some(free.map_or(due, |free| free.max(due)))
    }

    /// The run that is known started then, as it is told another way: that is no other run.
    pub(crate) fn started(&mut self, url: &str, start_time: i64) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.start_time = Some(start_time);
        }
    }

    /// The server at this URL answers while it executes methods.
    pub(crate) fn answers_during_calls(&mut self, url: &str) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.answers_during_calls = true;
        }
    }

    pub(crate) fn is_concurrent(&self, url: &str) -> bool {
        let watched = self.endpoints.get(&place(url));
        watched.is_some_and(|watched| watched.answers_during_calls)
    }

    /// An announcement names a start time. It proves nothing, but another start time than before is another run, which is
    /// probed at once.
    pub(crate) fn announced_start(&mut self, url: &str, start_time: i64) -> Sign {
        let Some(watched) = self.endpoints.get_mut(&place(url)) else {
            return Sign::Nothing;
        };
        watched.has_announced = true;
        match watched.start_time.replace(start_time) {
            Some(before) if before != start_time => {
                watched.try_at = watched.answered;
                Sign::Restarted
            }
            _ => Sign::Nothing,
        }
    }

    /// Takes note of what came of a try.
    pub(crate) fn probed(
        &mut self,
        url: &str,
        outcome: Outcome,
        patience: Patience,
        now: Instant,
    ) -> Sign {
        let place = place(url);
        let is_alive = matches!(outcome, Outcome::Alive { .. });
        let had_answered = self
            .endpoints
            .get(&place)
            .is_some_and(|watched| watched.has_answered);
        // A live endpoint is tried twice before it is lost.
        if is_alive || !had_answered {
            self.pause(&place, is_alive, patience.every, now);
        }
        let Some(watched) = self.endpoints.get_mut(&place) else {
            return Sign::Nothing;
        };
        match outcome {
            Outcome::Alive { start_time } => {
                watched.answered = now;
                watched.has_answered = true;
                let before = watched.start_time;
                watched.start_time = start_time.or(before);
                match (before, start_time) {
                    (Some(before), Some(after)) if before != after => Sign::Restarted,
                    _ => Sign::Nothing,
                }
            }
            Outcome::Refused => Sign::Lost(Loss::Unreachable),
            Outcome::Silent => {
                // Tried again soon, so that two tries that wait fit into the time.
                let again = patience.every / 10;
                watched.waits(
                    patience.silent,
                    Loss::Unreachable,
                    (patience.every, again),
                    now,
                )
            }
            Outcome::Hanging => {
                let is_running = watched.has_answered || watched.has_announced;
                let (most, again) = match (watched.answers_during_calls, is_running) {
                    (true, true) => (patience.hanging, patience.every / 10),
                    // Who has never answered may be starting: it listens, and serves a while later.
                    (true, false) => (patience.hanging * STARTING, patience.every / 10),
                    // A busy server accepts no connections, and its queue has room for few.
                    (false, _) => (patience.busy, patience.every),
                };
                watched.waits(most, Loss::Hanging, (patience.every, again), now)
            }
            Outcome::Untried => {
                // A name that nobody knows is not asked for each second.
                watched.try_at = now + patience.every * UNTRIED;
                Sign::Nothing
            }
        }
    }

    /// Doubles the pause of a host and port with each failure after the first ones, and ends it with an answer.
    fn pause(&mut self, place: &str, is_alive: bool, every: Duration, now: Instant) {
        let before = self.pauses.get(place).copied();
        if before.is_none() && self.pauses.len() >= MOST_PAUSES {
            let oldest = self.pauses.iter().min_by_key(|(_, pause)| pause.until);
            if let Some(oldest) = oldest.map(|(place, _)| place.clone()) {
                self.pauses.remove(&oldest);
            }
        }
        let has_answered = is_alive || before.is_some_and(|pause| pause.has_answered);
        let failures = match (is_alive, before) {
            (true, _) => 0,
            (false, Some(pause)) if now < pause.until + FORGET_PAUSE => pause.failures + 1,
            (false, _) => 1,
        };
        let longest = match has_answered {
            true => LONGEST_PAUSE_KNOWN,
            false => LONGEST_PAUSE,
        };
        let until = match failures.checked_sub(FAILURES_WITHOUT_PAUSE + 1) {
            None => now,
            Some(doubled) => now + every * (1 << doubled.min(longest)),
        };
        let pause = Pause {
            failures,
            probed: now,
            until,
            has_answered,
        };
        self.pauses.insert(place.to_owned(), pause);
    }
}

impl Watched {
    /// When it may be tried next.
    fn due(&self, pause: Option<&Pause>) -> Instant {
        let pause = pause.filter(|pause| pause.failures > 0);
        pause.map_or(self.try_at, |pause| pause.until.max(self.try_at))
    }

    /// No answer came, which may last so long; the server is tried again a while later.
    fn waits(
        &mut self,
        most: Duration,
        loss: Loss,
        (every, again): (Duration, Duration),
        now: Instant,
    ) -> Sign {
        // A try that ends a moment before counts: the next one would take its time once more.
        if now.saturating_duration_since(self.answered) + every / 4 >= most {
            return Sign::Lost(loss);
        }
        self.try_at = now + again;
        Sign::Nothing
    }
}

/// A share of a time for each URL, of a tenth to all of it, the same each time (FNV-1a): what many do at the same time
/// otherwise is done one after the other.
#[must_use]
pub fn spread(url: &str) -> f64 {
    let mix = |hash: u32, byte: u8| (hash ^ u32::from(byte)).wrapping_mul(16_777_619);
    let hash = url.bytes().fold(2_166_136_261, mix);
    0.1 + 0.9 * f64::from(hash >> 8) / f64::from(u32::MAX >> 8)
}

/// 500 tries a second are made at most.
const LEAST_APART: Duration = Duration::from_millis(2);
/// How many may be made at once: ten.
const BURST: Duration = Duration::from_millis(20);
const UNTRIED: u32 = 10;
const STARTING: u32 = 10;
/// Failures in a row that cause no pause. The probes of a server that fails before it has answered are made in time to
/// miss it as soon as one that has: silent after two, hanging after three of them.
const FAILURES_WITHOUT_PAUSE: u32 = 2;
/// The longest pause, as a power of two of the time between probes: 64 s.
const LONGEST_PAUSE: u32 = 6;
/// The longest pause of an endpoint that has answered before: 2 s.
const LONGEST_PAUSE_KNOWN: u32 = 1;
/// Pauses that are remembered; the one that ends first gives way.
const MOST_PAUSES: usize = 4096;
/// An endpoint that is left alone for that long after its pause starts anew.
const FORGET_PAUSE: Duration = Duration::from_secs(300);
