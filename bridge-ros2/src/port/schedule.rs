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
    /// What the domain was like when all topics were looked at, and when that was; none where they are to be looked at again.
    looked: Option<(u64, Instant)>,
}

impl Schedule {
    pub(super) fn new() -> Self {
        Self {
            timer: Box::pin(tokio::time::sleep(Duration::ZERO)),
            reconciled: Instant::now(),
            changed: true,
            unfinished: false,
            waiting: false,
            looked: None,
        }
    }

    /// Whether all topics are to be looked at, in a domain like that; always where nobody says whether it is another.
    pub(super) fn is_look_due(&self, domain: Option<u64>, now: Instant) -> bool {
        let alike = self.looked.is_some_and(|(before, at)| {
            domain == Some(before) && now.saturating_duration_since(at) < LOOK
        });
        self.changed || self.unfinished || self.waiting || !alike
    }

    /// They are being looked at.
    pub(super) fn looks(&mut self, domain: Option<u64>, now: Instant) {
        self.changed = false;
        self.unfinished = false;
        self.looked = domain.map(|domain| (domain, now));
    }

    /// Has them looked at the next time, although the domain may be what it was.
    pub(super) fn look_next(&mut self) {
        self.looked = None;
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
/// How often all topics are looked at when the domain is what it was: for what only time changes, and that may come late.
/// More often than a type is taken to be of no interest any more (3 s).
const LOOK: Duration = Duration::from_secs(2);
/// After a change: how long to let further ones come.
const SETTLE: Duration = Duration::from_millis(20);
/// Between two batches of endpoints.
const BATCH_PAUSE: Duration = Duration::from_millis(100);
/// How often a full send window is tried again.
const FLUSH: Duration = Duration::from_millis(2);

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn topics_are_looked_at_when_something_is_another_and_now_and_then() {
        let (mut schedule, now) = (Schedule::new(), Instant::now());
        assert!(schedule.is_look_due(Some(1), now));
        schedule.looks(Some(1), now);
        let later = now + POLL;
        assert!(!schedule.is_look_due(Some(1), later));
        assert!(schedule.is_look_due(Some(2), later));
        assert!(schedule.is_look_due(Some(1), now + LOOK));
        for stir in [
            |schedule: &mut Schedule| schedule.changed = true,
            |schedule: &mut Schedule| schedule.unfinished = true,
            |schedule: &mut Schedule| schedule.look_next(),
        ] {
            stir(&mut schedule);
            assert!(schedule.is_look_due(Some(1), later));
            schedule.looks(Some(1), now);
            assert!(!schedule.is_look_due(Some(1), later));
        }
        schedule.waiting = true;
        assert!(schedule.is_look_due(Some(1), later));
        // RustDDS as published does not say it.
        schedule.waiting = false;
        schedule.looks(None, now);
        assert!(schedule.is_look_due(None, later));
    }
}
