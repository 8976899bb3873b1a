//! Supervision: endpoints that are probed periodically.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::loss::ServerLoss;
use crate::network::place;

/// An endpoint to probe: open a connection to it, and pass the result to
/// [`ServerRegistry::probed`](crate::ServerRegistry::probed).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointProbe {
    /// The URL as registered or announced.
    pub url: String,
}

/// Result of a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProbeOutcome {
    /// The server answers, with the StartTime of its ServerStatus if it was read, in 100 ns since
    /// 1601.
    Alive {
        /// `None` if only the connection was probed.
        start_time: Option<i64>,
    },
    /// The host refuses the connection: the program has ended.
    Refused,
    /// The host does not answer.
    Silent,
    /// The host accepts the connection, and the program does not answer: it hangs or is stopped.
    Hanging,
    /// The probe was not possible, for example because the host name cannot be resolved: the state
    /// of the server is unknown.
    Untried,
}

/// Conclusion from a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sign {
    /// Nothing new.
    Nothing,
    /// The program was restarted.
    Restarted,
    /// The server has ended, or has not answered for too long.
    Lost(ServerLoss),
}

/// Time limits of the supervision.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    /// Period of the probes of an endpoint, while there are few endpoints.
    pub(crate) every: Duration,
    /// Time limit for a silent host.
    pub(crate) silent: Duration,
    /// Time limit for a silent program that answers during calls, while its host is available.
    pub(crate) hanging: Duration,
    /// Time limit for any other silent program.
    pub(crate) busy: Duration,
}

/// The supervised endpoints, by host and port: URLs that differ only in their path are one
/// endpoint, which is probed once.
#[derive(Debug, Default)]
pub(crate) struct EndpointWatch {
    endpoints: BTreeMap<String, Watched>,
    pauses: BTreeMap<String, Pause>,
    /// End of the time that is used by the previous probes.
    taken_until: Option<Instant>,
}

/// Time without probes of a host and port after failed probes. The pause outlives its records, so
/// that a record that is repeated under other names does not reset it.
#[derive(Debug, Clone, Copy)]
struct Pause {
    failures: u32,
    /// End of the last probe.
    probed: Instant,
    until: Instant,
    has_answered: bool,
}

#[derive(Debug)]
struct Watched {
    /// The URL that is probed.
    url: String,
    answered: Instant,
    /// Whether the endpoint has ever answered; before that, `answered` is the time of its first
    /// announcement or registration.
    has_answered: bool,
    /// Whether an announcement contained its start time: the program was running then.
    has_announced: bool,
    try_at: Instant,
    start_time: Option<i64>,
    /// Whether the server answers while it executes methods.
    answers_during_calls: bool,
}

impl EndpointWatch {
    /// Supervises the endpoint of a URL. An announcement is a sign of life only the first time,
    /// because it outlives its server. The first probes of many new endpoints are spread.
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
        // A server that is back is found soon; forged records cause a probe per `every` there.
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

    /// Returns whether the endpoint has answered a probe during its supervision.
    pub(crate) fn has_answered(&self, url: &str) -> bool {
        self.has_answered_at(&place(url))
    }

    /// Returns the same by host and port.
    pub(crate) fn has_answered_at(&self, place: &str) -> bool {
        let watched = self.endpoints.get(place);
        watched.is_some_and(|watched| watched.has_answered)
    }

    /// Returns whether probes of the endpoint failed and its pause is not over.
    pub(crate) fn is_paused(&self, url: &str, now: Instant) -> bool {
        let pause = self.pauses.get(&place(url));
        pause.is_some_and(|pause| pause.failures > 0 && pause.until > now)
    }

    /// Returns the period of the probes, which is longer with many endpoints. Endpoints that never
    /// answered do not slow down the probes of live endpoints.
    fn pace(&self, every: Duration) -> Duration {
        let live = self.endpoints.values().filter(|one| one.has_answered);
        let count = u32::try_from(live.count()).unwrap_or(u32::MAX);
        every.max(LEAST_APART.saturating_mul(count))
    }

    pub(crate) fn remove(&mut self, url: &str) {
        self.endpoints.remove(&place(url));
    }

    /// Returns the next endpoint to probe, if any is due; its next probe is after `every`, or later
    /// with many endpoints. Live endpoints come first.
    pub(crate) fn next(&mut self, every: Duration, now: Instant) -> Option<EndpointProbe> {
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
        Some(EndpointProbe { url })
    }

    /// Schedules the probe of a URL for the next opportunity.
    pub(crate) fn hasten(&mut self, url: &str) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.try_at = watched.answered;
        }
    }

    /// Excludes a time in which no answer could be received.
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

    /// Sets the start time of the known run, from another source: this is not a restart.
    pub(crate) fn started(&mut self, url: &str, start_time: i64) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.start_time = Some(start_time);
        }
    }

    /// Records that the server at this URL answers while it executes methods.
    pub(crate) fn answers_during_calls(&mut self, url: &str) {
        if let Some(watched) = self.endpoints.get_mut(&place(url)) {
            watched.answers_during_calls = true;
        }
    }

    pub(crate) fn is_concurrent(&self, url: &str) -> bool {
        let watched = self.endpoints.get(&place(url));
        watched.is_some_and(|watched| watched.answers_during_calls)
    }

    /// Handles the start time in an announcement. It proves nothing, but a changed start time is
    /// another run, which is probed at once.
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

    /// Handles the result of a probe.
    pub(crate) fn probed(
        &mut self,
        url: &str,
        outcome: ProbeOutcome,
        patience: Patience,
        now: Instant,
    ) -> Sign {
        let place = place(url);
        let is_alive = matches!(outcome, ProbeOutcome::Alive { .. });
        let had_answered = self
            .endpoints
            .get(&place)
            .is_some_and(|watched| watched.has_answered);
        // A live endpoint is probed twice before it is lost.
        if is_alive || !had_answered {
            self.pause(&place, is_alive, patience.every, now);
        }
        let Some(watched) = self.endpoints.get_mut(&place) else {
            return Sign::Nothing;
        };
        match outcome {
            ProbeOutcome::Alive { start_time } => {
                watched.answered = now;
                watched.has_answered = true;
                let before = watched.start_time;
                watched.start_time = start_time.or(before);
                match (before, start_time) {
                    (Some(before), Some(after)) if before != after => Sign::Restarted,
                    _ => Sign::Nothing,
                }
            }
            ProbeOutcome::Refused => Sign::Lost(ServerLoss::Unreachable),
            ProbeOutcome::Silent => {
                // Probed again soon, so that two probes that time out fit into the time limit.
                let again = patience.every / 10;
                watched.waits(
                    patience.silent,
                    ServerLoss::Unreachable,
                    (patience.every, again),
                    now,
                )
            }
            ProbeOutcome::Hanging => {
                let is_running = watched.has_answered || watched.has_announced;
                let (most, again) = match (watched.answers_during_calls, is_running) {
                    (true, true) => (patience.hanging, patience.every / 10),
                    // A server that has never answered may be starting: it listens, and serves a
                    // while later.
                    (true, false) => (patience.hanging * STARTING, patience.every / 10),
                    // A busy server accepts no connections, and its queue is short.
                    (false, _) => (patience.busy, patience.every),
                };
                watched.waits(most, ServerLoss::Hanging, (patience.every, again), now)
            }
            ProbeOutcome::Untried => {
                // An unknown name is not resolved each second.
                watched.try_at = now + patience.every * UNTRIED;
                Sign::Nothing
            }
        }
    }

    /// Doubles the pause of a host and port with each failure after the first failures, and ends it
    /// with an answer.
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
        let longest = if has_answered {
            LONGEST_PAUSE_KNOWN
        } else {
            LONGEST_PAUSE
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
    /// Returns the time of the next probe.
    fn due(&self, pause: Option<&Pause>) -> Instant {
        let pause = pause.filter(|pause| pause.failures > 0);
        pause.map_or(self.try_at, |pause| pause.until.max(self.try_at))
    }

    /// Handles a missing answer, which is accepted within a time limit; the server is probed again
    /// later.
    fn waits(
        &mut self,
        most: Duration,
        loss: ServerLoss,
        (every, again): (Duration, Duration),
        now: Instant,
    ) -> Sign {
        // A probe that ends shortly before the limit counts: the next probe would take its time
        // once more.
        if now.saturating_duration_since(self.answered) + every / 4 >= most {
            return Sign::Lost(loss);
        }
        self.try_at = now + again;
        Sign::Nothing
    }
}

/// Returns a fraction for each URL, from a tenth to one, always the same (FNV-1a). It spreads
/// actions of many servers that would otherwise happen at the same time.
#[must_use]
pub fn spread(url: &str) -> f64 {
    let mix = |hash: u32, byte: u8| (hash ^ u32::from(byte)).wrapping_mul(16_777_619);
    let hash = url.bytes().fold(2_166_136_261, mix);
    0.1 + 0.9 * f64::from(hash >> 8) / f64::from(u32::MAX >> 8)
}

/// Limits the probes to 500 a second.
const LEAST_APART: Duration = Duration::from_millis(2);
/// Number of probes at once, as a time: ten.
const BURST: Duration = Duration::from_millis(20);
const UNTRIED: u32 = 10;
const STARTING: u32 = 10;
/// Number of consecutive failures without a pause. A server that fails before its first answer is
/// thus lost as soon as a server that has answered: silent after two probes, hanging after three.
const FAILURES_WITHOUT_PAUSE: u32 = 2;
/// The longest pause, as a power of two of the time between probes: 64 s.
const LONGEST_PAUSE: u32 = 6;
/// The longest pause of an endpoint that has answered before: 2 s.
const LONGEST_PAUSE_KNOWN: u32 = 1;
/// Maximum number of stored pauses; the pause that ends first is removed.
const MOST_PAUSES: usize = 4096;
/// Time after a pause without probes, after which the failures are counted from zero.
const FORGET_PAUSE: Duration = Duration::from_secs(300);
