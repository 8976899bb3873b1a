//! The state of a single goal, and the events that its handle has not received.

use std::collections::VecDeque;
use std::sync::Arc;

use tokio::sync::Notify;
use tokio::time::Instant;

use super::super::types::ActionlibStatus;
use super::super::wire::StatusEntry;
use super::{ActionlibGoalEvent, CommState, Feedback, GoalLimits, GoalLoss, GoalResult};

/// A goal from the moment it is sent.
#[derive(Debug)]
pub(in crate::actionlib) struct Goal {
    pub(in crate::actionlib) state: CommState,
    pub(in crate::actionlib) status: ActionlibStatus,
    pub(in crate::actionlib) text: String,
    pub(in crate::actionlib) outcome: Option<Result<GoalResult, GoalLoss>>,
    pub(super) sent: Instant,
    /// The node that has listed the goal.
    pub(super) server: Option<String>,
    /// Start of the wait for the result.
    pub(super) ended: Option<Instant>,
    /// The result, and the end of the wait for feedback that was sent before it on another
    /// connection.
    pub(super) result: Option<(Instant, GoalResult)>,
    pub(super) events: VecDeque<ActionlibGoalEvent>,
    feedback_messages: usize,
    feedback_bytes: usize,
    unreported: u64,
    wake: Arc<Notify>,
}

impl Goal {
    pub(super) fn new(sent: Instant, wake: Arc<Notify>) -> Self {
        Self {
            state: CommState::WaitingForGoalAck,
            status: ActionlibStatus::Pending,
            text: String::new(),
            outcome: None,
            sent,
            server: None,
            ended: None,
            result: None,
            events: VecDeque::new(),
            feedback_messages: 0,
            feedback_bytes: 0,
            unreported: 0,
            wake,
        }
    }

    /// Enters the states that a status of the server leads to. Returns false if the status cannot
    /// follow the current state.
    pub(super) fn follow(&mut self, entry: &StatusEntry, now: Instant) -> bool {
        let Some(status) = ActionlibStatus::from_code(entry.code) else {
            return false;
        };
        let Some(path) = path(self.state, status) else {
            return false;
        };
        self.status = status;
        self.text.clone_from(&entry.text);
        for state in path {
            self.go(*state);
        }
        if self.state == CommState::WaitingForResult {
            self.ended.get_or_insert(now);
        }
        true
    }

    pub(super) fn go(&mut self, state: CommState) {
        self.state = state;
        self.push(ActionlibGoalEvent::State(state));
    }

    pub(super) fn done(&mut self, result: GoalResult) {
        self.state = CommState::Done;
        self.status = result.status;
        self.text.clone_from(&result.text);
        self.outcome = Some(Ok(result.clone()));
        self.push(ActionlibGoalEvent::Done(result));
    }

    pub(super) fn lose(&mut self, reason: GoalLoss) {
        if let Some((_, result)) = self.result.take() {
            return self.done(result);
        }
        if self.state.is_end() {
            return;
        }
        self.state = CommState::Lost;
        self.status = ActionlibStatus::Lost;
        self.outcome = Some(Err(reason.clone()));
        self.push(ActionlibGoalEvent::Lost(reason));
    }

    pub(super) fn feedback(&mut self, feedback: Feedback, limits: &GoalLimits) -> u64 {
        let len = feedback.body.len();
        let mut dropped = 0;
        while self.feedback_messages > 0
            && (self.feedback_messages >= limits.feedback_messages.max(1)
                || self.feedback_bytes.saturating_add(len) > limits.feedback_bytes)
        {
            let oldest =
                |event: &ActionlibGoalEvent| matches!(event, ActionlibGoalEvent::Feedback(_));
            let at = self.events.iter().position(oldest);
            let Some(event) = at.and_then(|at| self.events.remove(at)) else {
                break;
            };
            self.taken(&event);
            dropped += 1;
        }
        self.unreported += dropped;
        self.feedback_messages += 1;
        self.feedback_bytes += len;
        self.push(ActionlibGoalEvent::Feedback(feedback));
        dropped
    }

    fn push(&mut self, event: ActionlibGoalEvent) {
        self.events.push_back(event);
        self.wake.notify_one();
    }

    pub(super) fn next_event(&mut self) -> Option<ActionlibGoalEvent> {
        if self.unreported > 0 {
            return Some(ActionlibGoalEvent::FeedbackDropped(std::mem::take(
                &mut self.unreported,
            )));
        }
        let event = self.events.pop_front()?;
        self.taken(&event);
        Some(event)
    }

    fn taken(&mut self, event: &ActionlibGoalEvent) {
        if let ActionlibGoalEvent::Feedback(feedback) = event {
            self.feedback_messages -= 1;
            self.feedback_bytes -= feedback.body.len();
        }
    }
}

/// Returns the states that a goal enters when its server reports `status`; the list is empty if the
/// status is not new. Statuses arrive a few times a second and may skip states: the goal enters the
/// skipped states as well. Returns `None` if the status cannot follow the state, as when messages
/// of different topics overtake each other.
const fn path(state: CommState, status: ActionlibStatus) -> Option<&'static [CommState]> {
    use ActionlibStatus as S;
    use CommState as C;
    Some(match (state, status) {
        (C::Done | C::Lost, _)
        | (C::Pending, S::Pending)
        | (C::Active, S::Active)
        | (C::WaitingForCancelAck, S::Pending | S::Active)
        | (C::Recalling, S::Recalling)
        | (C::Preempting, S::Preempting)
        | (
            C::WaitingForResult,
            S::Active | S::Preempted | S::Succeeded | S::Aborted | S::Rejected | S::Recalled,
        ) => &[],
        (_, S::Lost)
        | (C::Active, S::Pending | S::Rejected | S::Recalling | S::Recalled)
        | (C::WaitingForResult, S::Pending | S::Recalling | S::Preempting)
        | (C::Recalling, S::Pending | S::Active)
        | (C::Preempting, S::Pending | S::Active | S::Rejected | S::Recalling | S::Recalled) => {
            return None;
        }
        (C::WaitingForGoalAck, S::Pending) => &[C::Pending],
        (C::WaitingForGoalAck | C::Pending, S::Active) => &[C::Active],
        (C::WaitingForGoalAck, S::Rejected | S::Recalled) => &[C::Pending, C::WaitingForResult],
        (C::WaitingForGoalAck, S::Recalling) => &[C::Pending, C::Recalling],
        (C::WaitingForGoalAck | C::Pending, S::Preempting) => &[C::Active, C::Preempting],
        (C::WaitingForGoalAck | C::Pending, S::Preempted) => {
            &[C::Active, C::Preempting, C::WaitingForResult]
        }
        (C::WaitingForGoalAck | C::Pending, S::Succeeded | S::Aborted) => {
            &[C::Active, C::WaitingForResult]
        }
        (C::Pending | C::WaitingForCancelAck, S::Recalling) => &[C::Recalling],
        (C::Pending | C::WaitingForCancelAck, S::Recalled) => &[C::Recalling, C::WaitingForResult],
        (C::Active | C::WaitingForCancelAck | C::Recalling, S::Preempting) => &[C::Preempting],
        (C::Active | C::WaitingForCancelAck | C::Recalling, S::Preempted)
        | (C::WaitingForCancelAck | C::Recalling, S::Succeeded | S::Aborted) => {
            &[C::Preempting, C::WaitingForResult]
        }
        (C::Active, S::Succeeded | S::Aborted)
        | (C::Pending | C::WaitingForCancelAck | C::Recalling, S::Rejected)
        | (C::Recalling, S::Recalled)
        | (C::Preempting, S::Preempted | S::Succeeded | S::Aborted) => &[C::WaitingForResult],
    })
}
