//! Withdrawn goals: a goal that its client cancels before the server has decided about it is
//! cancelled as soon as it is accepted.
//!
//! The module uses no clock and no network: times and responses come in, cancel requests come out.

use std::time::Duration;

use tokio::time::Instant;

use super::types::CancelCode;

/// The state of a withdrawn goal until its end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Withdrawal {
    since: Instant,
    stage: Stage,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// The server has not decided about the goal.
    Undecided,
    /// The server has accepted the goal. The next cancel request is due at this time.
    Due(Instant),
    /// A cancel request is pending.
    Asked,
    /// The server cancels the goal, or has ended it.
    Agreed,
    /// The server does not cancel the goal.
    Refused,
}

impl Withdrawal {
    pub(super) const fn new(now: Instant) -> Self {
        Self {
            since: now,
            stage: Stage::Undecided,
        }
    }

    /// Records that the server has accepted the goal.
    pub(super) const fn accepted(&mut self, now: Instant) {
        if matches!(self.stage, Stage::Undecided) {
            self.stage = Stage::Due(now);
        }
    }

    /// Returns the time at which the next cancel request is due.
    pub(super) const fn due(&self) -> Option<Instant> {
        match self.stage {
            Stage::Due(at) => Some(at),
            Stage::Undecided | Stage::Asked | Stage::Agreed | Stage::Refused => None,
        }
    }

    /// Returns true once for each cancel request that is due at `now`.
    pub(super) fn take_due(&mut self, now: Instant) -> bool {
        let is_due = self.due().is_some_and(|at| at <= now);
        if is_due {
            self.stage = Stage::Asked;
        }
        is_due
    }

    /// Records the response to a cancel request. Without a response, the request is sent again.
    /// Returns true if the server refuses for the first time.
    pub(super) fn answered(&mut self, answer: Option<CancelCode>, now: Instant) -> bool {
        let before = self.stage;
        self.stage = match answer {
            Some(CancelCode::None | CancelCode::Terminated) => Stage::Agreed,
            Some(CancelCode::Rejected) => Stage::Refused,
            // A server with several threads may process the request before it has registered the
            // goal.
            Some(CancelCode::UnknownGoal) | None => Stage::Due(now + AGAIN),
        };
        self.stage == Stage::Refused && before != Stage::Refused
    }

    /// Returns the time since the withdrawal of the goal.
    pub(super) fn age(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.since)
    }
}

/// The pause before a cancel request is sent again.
const AGAIN: Duration = Duration::from_millis(200);

#[cfg(test)]
mod tests {
    use super::*;

    fn begin() -> (Withdrawal, Instant) {
        let now = Instant::now();
        (Withdrawal::new(now), now)
    }

    #[test]
    fn a_request_to_cancel_is_sent_once_the_goal_is_accepted() {
        let (mut goal, now) = begin();
        let late = now + Duration::from_secs(3);
        assert!(!goal.take_due(late), "the server has not decided");
        goal.accepted(late);
        assert_eq!(goal.due(), Some(late));
        assert!(goal.take_due(late));
        assert!(!goal.take_due(late), "one request at a time");
        assert!(!goal.answered(Some(CancelCode::None), late));
        goal.accepted(late);
        assert_eq!((goal.due(), goal.age(late)), (None, late - now));
    }

    #[test]
    fn a_request_without_an_answer_is_sent_again() {
        for answer in [None, Some(CancelCode::UnknownGoal)] {
            let (mut goal, now) = begin();
            goal.accepted(now);
            assert!(goal.take_due(now));
            assert!(!goal.answered(answer, now));
            assert!(!goal.take_due(now));
            assert!(goal.take_due(now + AGAIN));
            assert!(!goal.answered(Some(CancelCode::Terminated), now));
            assert!(!goal.take_due(now + AGAIN + AGAIN));
        }
    }

    #[test]
    fn a_refusal_is_reported_once() {
        let (mut goal, now) = begin();
        goal.accepted(now);
        assert!(goal.take_due(now));
        assert!(goal.answered(Some(CancelCode::Rejected), now));
        assert!(!goal.answered(Some(CancelCode::Rejected), now));
        assert_eq!(goal.due(), None);
    }
}
