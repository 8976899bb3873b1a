//! The state of the calls of other programs and of their executors.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::call::CallDescription;

/// The known state of a call.
#[derive(Debug)]
pub(super) struct CallState {
    pub(super) description: Arc<CallDescription>,
    /// The address of the executor.
    pub(super) from: SocketAddr,
    /// The ActionTargetId in the current instance of the executor.
    pub(super) target: u16,
    /// The time of the last announcement.
    pub(super) said: Instant,
    /// The time of the last change of the description.
    pub(super) changed: Instant,
    /// Whether the port was informed that the call is gone.
    pub(super) gone: bool,
}

/// The executor of the calls of a namespace: a single program, which usually also sends values in
/// the namespace.
#[derive(Debug)]
pub(super) struct NamespaceExecutor {
    pub(super) from: SocketAddr,
    /// The time of the last announcement of a call.
    pub(super) said: Instant,
    /// The time of the last received value. `None` if the program sends no values, or announced its
    /// calls after its values had ended.
    pub(super) heard: Option<Instant>,
    /// Whether the program is lost.
    pub(super) gone: bool,
    /// The time of the first unanswered probe: another program announces the calls, or the program
    /// does not execute requests.
    pub(super) doubted: Option<Instant>,
    /// Whether the program was probed because its values are missing.
    pub(super) asked: bool,
}

impl NamespaceExecutor {
    /// Returns whether the program must be probed because its values are missing. Its values also
    /// end when their producer leaves, while the program still executes calls.
    pub(super) fn is_to_be_asked(&self, now: Instant, missing: Duration) -> bool {
        !self.gone && !self.asked && self.lacks_values(now, missing)
    }

    fn lacks_values(&self, now: Instant, missing: Duration) -> bool {
        self.heard
            .is_some_and(|heard| now.saturating_duration_since(heard) >= missing)
    }

    /// Records an announcement of a call. If values are missing, the program is treated as a
    /// program without values until the next value is received.
    pub(super) fn lives(&mut self, now: Instant, missing: Duration) {
        if self.lacks_values(now, missing) {
            self.heard = None;
        }
        (self.said, self.gone) = (now, false);
        (self.doubted, self.asked) = (None, false);
    }

    /// Returns whether the program is lost.
    pub(super) fn is_silent(
        &self,
        now: Instant,
        (silence, forgotten): (Duration, Duration),
    ) -> bool {
        let since = |at: Instant| now.saturating_duration_since(at);
        if self.doubted.is_some_and(|at| since(at) >= silence) {
            return true;
        }
        match self.heard {
            Some(heard) => since(heard) >= silence,
            None => since(self.said) >= forgotten,
        }
    }
}
