//! Whether a server that does not answer is busy or lost.
//!
//! A server that serves one request at a time answers nothing while it executes a method, and requests on its session say
//! nothing about it. Its host does answer: the kernel accepts connections for a program that is busy. A host that is gone is
//! noticed within two seconds.

use std::io::ErrorKind;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

use crate::endpoint::EndpointUrl;

/// How long a server has left keep-alives unanswered.
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

    /// The server answered a keep-alive.
    pub(super) fn answered(&mut self, now: Instant) {
        self.answered = now;
        self.missed = 0;
        self.not_running = 0;
    }

    /// A keep-alive was not answered in time.
    pub(super) fn missed(&mut self) {
        self.missed += 1;
    }

    /// The server answered a keep-alive that it does not run.
    pub(super) fn not_running(&mut self) {
        self.not_running += 1;
    }

    /// Returns whether the server is silent, and is given time to answer.
    pub(super) fn is_tolerated(&self, now: Instant) -> bool {
        self.missed > 0 && now.saturating_duration_since(self.answered) < self.patience
    }

    /// Returns whether the connection is to be dropped. `is_calling`: a call waits for its result, which has a limit itself.
    pub(super) fn is_too_long(&self, is_calling: bool, now: Instant) -> bool {
        if self.not_running >= MOST_MISSED {
            return true;
        }
        self.missed >= MOST_MISSED && !is_calling && !self.is_tolerated(now)
    }
}

/// Tries to reach the host of a server that is busy.
#[derive(Debug)]
pub(super) struct Reach {
    url: String,
    tries: JoinSet<bool>,
    state: State,
}

/// What is known of the host; time is given.
#[derive(Debug, Default)]
struct State {
    /// When the host answered last, or the tries began; `None` while there are none.
    reached: Option<Instant>,
    made: u32,
}

/// What is to be done.
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
            // The queue of a program that accepts nothing is full some time; the session's own connection still tells.
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

    /// Makes the next try where the server is busy; to be called every half second.
    ///
    /// # Errors
    /// The host has not answered for too long.
    pub(super) fn look(&mut self, is_busy: bool, now: Instant) -> Result<(), String> {
        match self.state.look(is_busy, now) {
            Step::Nothing => Ok(()),
            Step::Connect => {
                self.tries.spawn(is_reached(self.url.clone()));
                Ok(())
            }
            Step::Lost => Err("the host of the server does not answer".to_owned()),
        }
    }

    /// The host, or the server itself, answered.
    pub(super) fn answered(&mut self, now: Instant) {
        self.state.answered(now);
    }

    /// Ready when a try reached the host. Whoever drops it before loses nothing.
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

/// Connects, and closes the connection at once.
async fn is_reached(url: String) -> bool {
    let Ok(endpoint) = url.parse::<EndpointUrl>() else {
        return false;
    };
    match timeout(TRY_LIMIT, TcpStream::connect(endpoint.authority())).await {
        Ok(Ok(_)) => true,
        // The host answers for a program that takes no more connections.
        Ok(Err(error)) => matches!(
            error.kind(),
            ErrorKind::ConnectionRefused | ErrorKind::ConnectionReset
        ),
        Err(_) => false,
    }
}

/// How many keep-alives in a row may be missed.
const MOST_MISSED: u32 = 2;
/// How long the host may leave connections unanswered; three tries fit in.
const LOST_AFTER: Duration = Duration::from_millis(1_700);
const TRY_LIMIT: Duration = Duration::from_secs(1);
/// Servers commonly have a queue of 100 connections that are not accepted yet.
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
        // The host answers each try for 8 s.
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
