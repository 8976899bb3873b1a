//! Log messages of this module, with a function per event.

use std::fmt::Display;
use std::time::Duration;

use log_limit::Throttle;
use tracing::warn;

use crate::clock;

/// Rate limits for logs of unusable data: an entry per kind in ten seconds.
#[derive(Debug)]
pub(super) struct UnusableData {
    malformed: Throttle,
    overrun: Throttle,
    full: Throttle,
}

impl UnusableData {
    pub(super) const fn new() -> Self {
        let every = Duration::from_secs(10);
        Self {
            malformed: Throttle::new(every),
            overrun: Throttle::new(every),
            full: Throttle::new(every),
        }
    }

    pub(super) fn malformed(&mut self, topic: &str, node: &str, error: &dyn Display) {
        if let Some(suppressed) = self.malformed.admit(clock::now()) {
            warn!(topic, node, %error, suppressed, "dropped a malformed message of an action");
        }
    }

    pub(super) fn overrun(&mut self, topic: &str, lost: u64) {
        if let Some(suppressed) = self.overrun.admit(clock::now()) {
            warn!(
                topic,
                lost, suppressed, "messages of an action were lost: this process is too slow"
            );
        }
    }

    pub(super) fn full(&mut self, goal: &str) {
        if let Some(suppressed) = self.full.admit(clock::now()) {
            warn!(
                goal,
                suppressed, "rejected a goal or a cancel request: too many are open"
            );
        }
    }
}
