//! Decides whether an unresponsive server is busy or lost.
//!
//! A server that handles one request at a time does not answer while it executes a method, so
//! requests on its session do not show the difference. Its host does answer: the kernel accepts TCP
//! connections for a busy program. The loss of a host is detected within two seconds.

use std::io::ErrorKind;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

use crate::endpoint::EndpointUrl;

/// The keep-alives that a server did not answer.
#[derive(Debug)]
pub(super) struct Silence {
    patience: Duration,
    answered: Instant,
    missed: u32,
    not_running: u32,
}

impl Silence {
    pub(super) fn new(patience: Duration, now: Instant) -> Self {
        Self {
            patience,
            answered: now,
            missed: 0,
            not_running: 0,
        }
    }

    /// Records the answer to a keep-alive.
    pub(super) fn answered(&mut self, now: Instant) {
        self.answered = now;
        self.missed = 0;
        self.not_running = 0;
    }

    /// Records a keep-alive that timed out.
    pub(super) fn missed(&mut self) {
        self.missed += 1;
    }

    /// Records an answer of a server that is not in the state Running.
    pub(super) fn not_running(&mut self) {
        self.not_running += 1;
    }

    /// Returns whether the server is unresponsive but still within the patience.
    pub(super) fn is_tolerated(&self, now: Instant) -> bool {
        self.missed > 0 && now.saturating_duration_since(self.answered) < self.patience
    }

    /// Returns whether the connection is lost. With `is_calling`, a call waits for its result, and
    /// has its own timeout.
    pub(super) fn is_too_long(&self, is_calling: bool, now: Instant) -> bool {
        if self.not_running >= MOST_MISSED {
            return true;
        }
        self.missed >= MOST_MISSED && !is_calling && !self.is_tolerated(now)
    }
}

/// Probes the host of a busy server with TCP connections.
#[derive(Debug)]
pub(super) struct Reach {
    url: String,
    tries: JoinSet<bool>,
    state: State,
}

/// The state of the probes. Callers pass the time.
#[derive(Debug, Default)]
struct State {
    /// When the host answered last, or when the probes started; `None` without probes.
    reached: Option<Instant>,
    made: u32,
}

/// The next step of the probes.
#[derive(Debug, PartialEq, Eq)]
enum Step {
    Nothing,
    Connect,
    Lost,
}

impl State {
    fn look(&mut self, is_busy: bool, now: Instant) -> Step {
        if !is_busy {
            *self = Self::default();
            return Step::Nothing;
        }
        let reached = *self.reached.get_or_insert(now);
        if self.made >= MOST_TRIES {
            // The accept queue of the program may be full. The TCP connection of the session still
            // detects a lost host.
            return Step::Nothing;
        }
        if now.saturating_duration_since(reached) >= LOST_AFTER {
            return Step::Lost;
        }
        self.made += 1;
        Step::Connect
    }

    fn answered(&mut self, now: Instant) {
        if let Some(reached) = &mut self.reached {
            *reached = now;
        }
    }
}

impl Reach {
    pub(super) fn new(url: &str) -> Self {
        Self {
            url: url.to_owned(),
            tries: JoinSet::new(),
            state: State::default(),
        }
    }

    /// Starts the next probe if the server is busy. To be called every half second. Returns `false`
    /// if the host has not answered for too long.
    pub(super) fn look(&mut self, is_busy: bool, now: Instant) -> bool {
        match self.state.look(is_busy, now) {
            Step::Nothing => {}
            Step::Connect => drop(self.tries.spawn(is_reached(self.url.clone()))),
            Step::Lost => return false,
        }
        true
    }

    /// Records an answer of the host or of the server.
    pub(super) fn answered(&mut self, now: Instant) {
        self.state.answered(now);
    }

    /// Waits until a probe reaches the host. Cancel safe.
    pub(super) async fn tried(&mut self) {
        loop {
            match self.tries.join_next().await {
                Some(Ok(true)) => return,
                Some(_) => {}
                None => std::future::pending().await,
            }
        }
    }
}

/// Connects and closes the connection at once.
async fn is_reached(url: String) -> bool {
    let Ok(endpoint) = url.parse::<EndpointUrl>() else {
        return false;
    };
    match timeout(TRY_LIMIT, TcpStream::connect(endpoint.authority())).await {
        Ok(Ok(_)) => true,
        // The host refuses connections for a program that accepts no more.
        Ok(Err(error)) => matches!(
            error.kind(),
            ErrorKind::ConnectionRefused | ErrorKind::ConnectionReset
        ),
        Err(_) => false,
    }
}

/// Maximum number of consecutive keep-alives that may be missed.
const MOST_MISSED: u32 = 2;
/// Longest time without an answer of the host: time for three probes.
const LOST_AFTER: Duration = Duration::from_millis(1_700);
const TRY_LIMIT: Duration = Duration::from_secs(1);
/// Maximum number of probes. Servers commonly have an accept queue of 100 connections.
const MOST_TRIES: u32 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn a_busy_server_is_kept_while_its_host_answers_and_lost_within_two_seconds_after() {
        let now = Instant::now();
        let mut state = State::default();
        assert_eq!(state.look(false, now), Step::Nothing, "nothing is called");
        // The host answers each probe for 8 s.
        let mut at = now;
        for _ in 0..16 {
            assert_eq!(state.look(true, at), Step::Connect);
            state.answered(at);
            at += 500 * MS;
        }
        // The cable is cut just after the last answer.
        let cut = at - 500 * MS;
        let lost = loop {
            match state.look(true, at) {
                Step::Lost => break at,
                Step::Nothing | Step::Connect => at += 500 * MS,
            }
        };
        assert!(lost - cut <= 2_000 * MS, "{:?}", lost - cut);
        assert_eq!(state.look(false, at), Step::Nothing);
        assert_eq!(
            state.look(true, at),
            Step::Connect,
            "the next call begins anew"
        );
    }

    #[test]
    fn the_tries_of_one_busy_phase_do_not_fill_the_queue_of_the_server() {
        let mut now = Instant::now();
        let mut state = State::default();
        let made = (0..1_000).filter(|_| {
            now += 500 * MS;
            state.answered(now);
            state.look(true, now) == Step::Connect
        });
        assert_eq!(made.count(), 64);
    }

    #[test]
    fn silence_ends_a_connection_unless_a_call_goes_on_or_the_client_is_patient() {
        let now = Instant::now();
        let mut silence = Silence::new(Duration::ZERO, now);
        silence.missed();
        assert!(!silence.is_too_long(false, now));
        silence.missed();
        assert!(silence.is_too_long(false, now));
        assert!(!silence.is_too_long(true, now + 60_000 * MS));
        let mut silence = Silence::new(60_000 * MS, now);
        silence.missed();
        silence.missed();
        assert!(!silence.is_too_long(false, now + 59_000 * MS));
        assert!(silence.is_too_long(false, now + 60_000 * MS));
        silence.answered(now + 60_000 * MS);
        assert!(!silence.is_too_long(false, now + 60_000 * MS));
        silence.not_running();
        silence.not_running();
        assert!(
            silence.is_too_long(true, now),
            "it says that it does not run"
        );
    }
}
