//! A goal: its state, and the requests that wait for its acceptance and its result.

use std::time::{Duration, Instant};

use bridge_core::ExecutionId;
use bytes::Bytes;
use uadp::Timestamp;

use super::{CancelProgress, GoalDecision, MOST_WAITING, ResultDecision};
use crate::actions::graph::GraphGoalId;
use crate::actions::wire::GoalAnswer;

/// A goal that was sent to its server.
#[derive(Debug)]
pub(super) struct ExecutedGoal {
    state: State,
    /// Time of acceptance; zero before.
    stamp: Timestamp,
    /// Requests that wait for the result.
    waiting: Vec<Waiting>,
    /// Time of withdrawal: the goal is to be cancelled as soon as its server has accepted it.
    withdrawn: Option<Instant>,
    /// Whether the server refuses to cancel the goal.
    is_refused: bool,
    /// Whether the server has agreed to cancel the goal.
    agreed: bool,
}

#[derive(Debug)]
enum State {
    /// The server has not decided. Holds the requests for the goal.
    Sent(Vec<ExecutionId>),
    /// Holds the status of `action_msgs/GoalStatus`.
    Running(i8),
    Rejected {
        why: String,
        since: Instant,
    },
    /// Holds the response to requests for the result.
    Ended {
        status: i8,
        answer: Bytes,
        since: Instant,
    },
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    execution: ExecutionId,
    /// When the request is refused, so that its caller repeats it.
    until: Instant,
}

impl ExecutedGoal {
    /// Creates a goal that is sent for a request.
    pub(super) fn new(execution: ExecutionId) -> Self {
        Self {
            state: State::Sent(vec![execution]),
            stamp: Timestamp::from_unix_nanos(0),
            waiting: Vec::new(),
            withdrawn: None,
            is_refused: false,
            agreed: false,
        }
    }

    /// Handles a further request for the goal, which has this id.
    pub(super) fn ask_again(&mut self, id: GraphGoalId, execution: ExecutionId) -> GoalDecision {
        let is_withdrawn = self.is_withdrawn();
        match &mut self.state {
            State::Sent(_) if is_withdrawn => GoalDecision::Withdrawn,
            State::Sent(asked) if asked.len() >= MOST_WAITING => GoalDecision::Full,
            State::Sent(asked) => {
                asked.push(execution);
                GoalDecision::Waits
            }
            State::Running(_) | State::Ended { .. } => GoalDecision::Answer(self.answer(id, None)),
            State::Rejected { why, .. } => {
                let why = why.clone();
                GoalDecision::Answer(self.answer(id, Some(why)))
            }
        }
    }

    /// Returns the response to requests for the goal, which has this id. The server accepted it, or
    /// rejected it for a reason.
    pub(super) fn answer(&self, id: GraphGoalId, rejected: Option<String>) -> GoalAnswer {
        GoalAnswer {
            accepted: rejected.is_none(),
            id,
            stamp: self.stamp,
            message: rejected.unwrap_or_default(),
        }
    }

    /// Marks the goal as accepted by the server. Returns the requests for the goal; `None` if the
    /// server has decided before.
    pub(super) fn accept(&mut self, stamp: Timestamp) -> Option<Vec<ExecutionId>> {
        let State::Sent(asked) = &mut self.state else {
            return None;
        };
        let asked = std::mem::take(asked);
        self.state = State::Running(ACCEPTED);
        self.stamp = stamp;
        Some(asked)
    }

    /// Marks the goal as rejected by the server. Returns the requests for the goal; `None` if the
    /// server has decided before.
    pub(super) fn reject(&mut self, why: String, now: Instant) -> Option<Vec<ExecutionId>> {
        let State::Sent(asked) = &mut self.state else {
            return None;
        };
        let asked = std::mem::take(asked);
        self.state = State::Rejected { why, since: now };
        Some(asked)
    }

    /// Sets the status of a running goal. Returns false if the status has not changed.
    pub(super) fn set_status(&mut self, status: i8) -> bool {
        match &mut self.state {
            State::Running(known) => std::mem::replace(known, status) != status,
            State::Sent(_) | State::Rejected { .. } | State::Ended { .. } => false,
        }
    }

    /// Marks the goal as ended. Returns the requests for the goal that were not answered before.
    pub(super) fn end(&mut self, (status, answer): (i8, Bytes), now: Instant) -> Vec<ExecutionId> {
        let asked = self.take_asked();
        self.state = State::Ended {
            status,
            answer,
            since: now,
        };
        asked
    }

    /// Handles a request for the result that waits until `until`, unless the limit of waiting
    /// requests is reached (`is_full`).
    pub(super) fn want(
        &mut self,
        (execution, until): (ExecutionId, Instant),
        is_full: bool,
    ) -> ResultDecision {
        match &self.state {
            State::Rejected { why, .. } => ResultDecision::Rejected(why.clone()),
            State::Ended { answer, .. } => ResultDecision::Answer(answer.clone()),
            State::Sent(_) | State::Running(_) if is_full => ResultDecision::Full,
            State::Sent(_) | State::Running(_) => {
                self.waiting.push(Waiting { execution, until });
                ResultDecision::Waits
            }
        }
    }

    /// Returns the number of requests that wait for the result.
    pub(super) const fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Removes a request for the result. Returns false if the request was not waiting.
    pub(super) fn give_up(&mut self, execution: ExecutionId) -> bool {
        let before = self.waiting.len();
        self.waiting.retain(|one| one.execution != execution);
        self.waiting.len() < before
    }

    /// Removes a request that waits for the decision about the goal, and withdraws a goal without
    /// requests. Returns the number of remaining requests; `None` if the request was not waiting.
    pub(super) fn give_up_asking(&mut self, execution: ExecutionId, now: Instant) -> Option<usize> {
        let State::Sent(asked) = &mut self.state else {
            return None;
        };
        let before = asked.len();
        asked.retain(|one| *one != execution);
        let left = asked.len();
        if left == before {
            return None;
        }
        if left == 0 {
            self.withdrawn.get_or_insert(now);
        }
        Some(left)
    }

    /// Withdraws the goal if its server has not decided about it. Returns the requests for the
    /// goal.
    pub(super) fn withdraw(&mut self, now: Instant) -> Vec<ExecutionId> {
        if self.is_undecided() {
            self.withdrawn.get_or_insert(now);
        }
        self.take_asked()
    }

    /// Notes that the server refuses to cancel the withdrawn goal. Returns false if the goal is
    /// being cancelled: servers refuse a second cancellation.
    pub(super) fn refuse_cancel(&mut self) -> bool {
        if self.is_cancelling() {
            return false;
        }
        self.is_refused = true;
        true
    }

    /// Notes that the server has agreed to cancel the goal.
    pub(super) const fn agree_to_cancel(&mut self) {
        self.agreed = true;
    }

    /// Returns whether the server is cancelling the goal.
    const fn is_cancelling(&self) -> bool {
        self.agreed || matches!(self.state, State::Running(CANCELING))
    }

    /// Returns whether the goal is to be cancelled as soon as it is accepted.
    pub(super) const fn is_withdrawn(&self) -> bool {
        self.withdrawn.is_some()
    }

    /// Returns whether the server has not decided about the goal.
    pub(super) const fn is_undecided(&self) -> bool {
        matches!(self.state, State::Sent(_))
    }

    /// Returns the time of withdrawal of a goal that the server has neither started nor refused to
    /// cancel.
    pub(super) fn pending_since(&self) -> Option<Instant> {
        let is_open = match self.state {
            State::Sent(_) => true,
            State::Running(status) => status != CANCELING,
            State::Rejected { .. } | State::Ended { .. } => false,
        };
        self.withdrawn.filter(|_| is_open && !self.is_refused)
    }

    /// Returns the progress of the goal.
    pub(super) const fn progress(&self) -> CancelProgress {
        let is_pending = self.withdrawn.is_some() && !self.is_refused;
        match &self.state {
            State::Sent(_) => CancelProgress::Undecided,
            State::Running(_) if is_pending || self.is_cancelling() => CancelProgress::Cancelling,
            State::Running(_) => CancelProgress::Open,
            State::Rejected { .. } | State::Ended { .. } => CancelProgress::Ended,
        }
    }

    /// Returns whether the goal runs and was accepted at `until` or before.
    pub(super) fn is_open_until(&self, until: Timestamp) -> bool {
        matches!(self.state, State::Running(_)) && self.stamp.unix_nanos() <= until.unix_nanos()
    }

    /// Returns the status of an accepted goal.
    pub(super) const fn status(&self) -> Option<i8> {
        match &self.state {
            State::Sent(_) | State::Rejected { .. } => None,
            State::Running(status) => Some(*status),
            State::Ended { status, .. } => Some(*status),
        }
    }

    pub(super) const fn has_ended(&self) -> bool {
        match &self.state {
            State::Rejected { .. } | State::Ended { .. } => true,
            State::Sent(_) | State::Running(_) => false,
        }
    }

    /// Returns whether the goal ended so long ago that it is forgotten.
    pub(super) fn is_expired(&self, now: Instant) -> bool {
        match &self.state {
            State::Rejected { since, .. } | State::Ended { since, .. } => *since + KEPT <= now,
            State::Sent(_) | State::Running(_) => false,
        }
    }

    /// Returns the size of the kept result in bytes.
    pub(super) const fn bytes(&self) -> usize {
        match &self.state {
            State::Ended { answer, .. } => answer.len(),
            State::Sent(_) | State::Running(_) | State::Rejected { .. } => 0,
        }
    }

    /// Removes and returns the requests for the result that wait too long.
    pub(super) fn take_late(&mut self, now: Instant) -> impl Iterator<Item = ExecutionId> {
        let late = self.waiting.extract_if(.., move |one| one.until <= now);
        late.map(|one| one.execution)
    }

    /// Removes and returns the requests for the result.
    pub(super) fn take_waiting(&mut self) -> Vec<ExecutionId> {
        let waiting = std::mem::take(&mut self.waiting);
        waiting.into_iter().map(|one| one.execution).collect()
    }

    /// Removes and returns the requests that wait for the decision about the goal.
    pub(super) fn take_asked(&mut self) -> Vec<ExecutionId> {
        match &mut self.state {
            State::Sent(asked) => std::mem::take(asked),
            State::Running(_) | State::Rejected { .. } | State::Ended { .. } => Vec::new(),
        }
    }
}

/// How long a goal is known after its end.
pub(super) const KEPT: Duration = Duration::from_secs(15 * 60);
/// `action_msgs/GoalStatus`, STATUS_ACCEPTED.
const ACCEPTED: i8 = 1;
/// `action_msgs/GoalStatus`, STATUS_CANCELING.
pub(super) const CANCELING: i8 = 3;
