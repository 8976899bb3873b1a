//! The schedule of the periodic work of the port.

use std::collections::BTreeSet;
use std::pin::Pin;
use std::task::Context;
use std::time::Duration;

use mappings::TopicId;
use tokio::time::{Instant, Sleep};

/// The times of the next pass and of the next flush.
pub(super) struct Schedule {
    timer: Pin<Box<Sleep>>,
    pub(super) reconciled: Instant,
    /// Something changed: reconcile soon.
    pub(super) changed: bool,
    /// Endpoints remain to be created.
    pub(super) unfinished: bool,
    /// The topics with samples that wait in their outlets.
    waiting: BTreeSet<TopicId>,
    /// The change count of the domain and the time of the last pass over all topics; `None` forces
    /// the next pass.
    looked: Option<(u64, Instant)>,
}

impl Schedule {
    pub(super) fn new() -> Self {
        Self {
            timer: Box::pin(tokio::time::sleep(Duration::ZERO)),
            reconciled: Instant::now(),
            changed: true,
            unfinished: false,
            waiting: BTreeSet::new(),
            looked: None,
        }
    }

    /// Returns whether a pass over all topics is due for this change count; always true without a
    /// count.
    pub(super) fn is_look_due(&self, domain: Option<u64>, now: Instant) -> bool {
        let alike = self.looked.is_some_and(|(before, at)| {
            domain == Some(before) && now.saturating_duration_since(at) < LOOK
        });
        self.changed || self.unfinished || self.is_waiting() || !alike
    }

    /// Returns whether samples wait in an outlet.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Records whether samples of a topic wait in its outlet.
    pub(super) fn note_waiting(&mut self, topic: TopicId, waits: bool) {
        if waits {
            self.waiting.insert(topic);
        } else if self.is_waiting() {
            self.waiting.remove(&topic);
        }
    }

    /// Returns the topics with waiting samples. [`note_waiting`](Self::note_waiting) removes topics
    /// without a waiting sample.
    pub(super) fn waiting(&self) -> Vec<TopicId> {
        self.waiting.iter().copied().collect()
    }

    /// Records the start of a pass over all topics.
    pub(super) fn looks(&mut self, domain: Option<u64>, now: Instant) {
        self.changed = false;
        self.unfinished = false;
        self.looked = domain.map(|domain| (domain, now));
    }

    /// Forces the next pass, even if the domain has not changed.
    pub(super) fn look_next(&mut self) {
        self.looked = None;
    }

    /// Returns the time of the next reconciliation.
    pub(super) fn next_reconcile(&self) -> Instant {
        let pause = match (self.unfinished, self.changed) {
            (true, _) => BATCH_PAUSE,
            (false, true) => SETTLE,
            (false, false) if self.looked.is_none() => POLL,
            (false, false) => return idle_ticks::next(self.reconciled, IDLE_POLL),
        };
        self.reconciled + pause
    }

    fn next(&self, now: Instant) -> Instant {
        let reconcile = self.next_reconcile();
        if self.is_waiting() {
            reconcile.min(now + FLUSH)
        } else {
            reconcile
        }
    }

    /// Resets the timer after the due work is done.
    pub(super) fn arm(&mut self, now: Instant) {
        let next = self.next(now);
        self.timer.as_mut().reset(next);
    }

    /// Returns whether work is due; otherwise the task is woken when it is.
    pub(super) fn is_due(&mut self, cx: &mut Context<'_>) -> bool {
        // `publish` and discovery move the time forward.
        let is_looked = self.looked.is_some();
        if self.changed || self.unfinished || self.is_waiting() || !is_looked {
            let now = Instant::now();
            if self.next(now) < self.timer.deadline() {
                self.arm(now);
            }
        }
        self.timer.as_mut().poll(cx).is_ready()
    }
}

/// The interval of passes while changes are not reported, or wait for a reply.
const POLL: Duration = Duration::from_millis(200);
/// The interval of passes while no change is reported.
const IDLE_POLL: Duration = Duration::from_millis(500);
/// The interval of passes over all topics in an unchanged domain, for changes that depend on time
/// only and may be noticed late. Shorter than the time after which a type is of no interest (3 s).
const LOOK: Duration = Duration::from_secs(2);
/// The delay after a change, to collect further changes.
const SETTLE: Duration = Duration::from_millis(20);
/// The pause between two batches of endpoints.
const BATCH_PAUSE: Duration = Duration::from_millis(100);
/// The retry interval for a full send window.
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
        let topic = "ua_1_2_3".parse().unwrap();
        schedule.note_waiting(topic, true);
        assert_eq!(schedule.waiting(), [topic]);
        assert!(schedule.is_look_due(Some(1), later));
        // An unchanged domain is polled less often.
        schedule.reconciled = now;
        assert!(schedule.next_reconcile() >= now + IDLE_POLL);
        schedule.look_next();
        assert_eq!(schedule.next_reconcile(), now + POLL);
        // The published RustDDS provides no change count.
        schedule.note_waiting(topic, false);
        assert!(!schedule.is_waiting());
        schedule.looks(None, now);
        assert!(schedule.is_look_due(None, later));
    }
}
