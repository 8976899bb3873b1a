//! When the port does what nobody asked for.

use std::pin::Pin;
use std::task::Context;
use std::time::Duration;

use tokio::time::{Instant, Sleep};

/// When to look again.
pub(super) struct Schedule {
    timer: Pin<Box<Sleep>>,
    pub(super) reconciled: Instant,
    /// Something changed: reconcile soon.
    pub(super) changed: bool,
    /// Endpoints are left to be made.
    pub(super) unfinished: bool,
    /// Samples wait in an outlet.
    pub(super) waiting: bool,
}

impl Schedule {
    pub(super) fn new() -> Self {
        Self {
            timer: Box::pin(tokio::time::sleep(Duration::ZERO)),
            reconciled: Instant::now(),
            changed: true,
            unfinished: false,
            waiting: false,
        }
    }

    /// When the domain is to be looked at.
    pub(super) fn next_reconcile(&self) -> Instant {
        self.reconciled
            + match (self.unfinished, self.changed) {
                (true, _) => BATCH_PAUSE,
                (false, true) => SETTLE,
                (false, false) => POLL,
            }
    }

    fn next(&self, now: Instant) -> Instant {
        let reconcile = self.next_reconcile();
        if self.waiting {
            reconcile.min(now + FLUSH)
        } else {
            reconcile
        }
    }

    /// Sets the timer anew, after what was due is done.
    pub(super) fn arm(&mut self, now: Instant) {
        let next = self.next(now);
        self.timer.as_mut().reset(next);
    }

    /// Whether there is something to do; otherwise the task is woken when there is.
    pub(super) fn is_due(&mut self, cx: &mut Context<'_>) -> bool {
        // `publish` and discovery make it earlier than it was set for.
        if self.changed || self.unfinished || self.waiting {
            let now = Instant::now();
            if self.next(now) < self.timer.deadline() {
                self.arm(now);
            }
        }
        self.timer.as_mut().poll(cx).is_ready()
    }
}

/// How often the domain is looked at when nothing is reported.
const POLL: Duration = Duration::from_millis(200);
/// After a change: how long to let further ones come.
const SETTLE: Duration = Duration::from_millis(20);
/// Between two batches of endpoints.
const BATCH_PAUSE: Duration = Duration::from_millis(100);
/// How often a full send window is tried again.
const FLUSH: Duration = Duration::from_millis(2);
