//! The client's state of its goals: the status of each goal and its waiting events.
//!
//! The module uses no clock and no network: replies, statuses, feedback and results come in, events
//! come out.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::error::LostReason;
use super::types::{CancelCode, GoalId, GoalStatusCode};
use super::withdrawal::Withdrawal;
use crate::clock::Ros2Time;

/// An event of a sent goal, in the order of delivery.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum GoalEvent {
    /// A server accepted the goal at this time of the server's clock. The first event, unless the
    /// goal ends before.
    Accepted(Ros2Time),
    /// The goal changed to [`GoalStatusCode::Executing`] or [`GoalStatusCode::Canceling`]. A short
    /// state may be skipped.
    Status(GoalStatusCode),
    /// Feedback of the server: the `X_Feedback`, CDR with its encapsulation header, in the server's
    /// byte order.
    Feedback(Bytes),
    /// The number of feedback messages dropped for newer feedback after the last event.
    FeedbackDropped(u64),
    /// The server did not decide within this time. The goal is withdrawn: it is cancelled as soon
    /// as it is accepted. May come before [`Accepted`](Self::Accepted).
    Overdue(Duration),
    /// The goal was withdrawn, and the server accepted it and refuses to cancel it.
    CancelRefused,
    /// The goal ended. The last event.
    Ended(Outcome),
}

/// The outcome of a goal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The server rejected the goal.
    Rejected,
    /// The server ended the goal.
    Done {
        /// Succeeded, canceled or aborted.
        status: GoalStatusCode,
        /// The `X_GetResult_Response`: CDR with its encapsulation header, in the server's byte
        /// order, status first.
        result: Bytes,
    },
    /// The client receives nothing more about the goal.
    Lost(LostReason),
}

/// Counters of samples that a client could not use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClientCounters {
    /// Feedback and statuses that could not be decoded.
    pub malformed: u64,
    /// Feedback for goals of other clients, or for ended goals.
    pub others_feedback: u64,
    /// Feedback messages dropped for newer feedback because they were not received in time.
    pub feedback_dropped: u64,
}

/// The limits of the client: open goals, and waiting feedback per goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ClientGoalLimits {
    pub(super) goals: usize,
    pub(super) feedback_messages: usize,
    pub(super) feedback_bytes: usize,
}

/// The goals that have a handle or are withdrawn.
#[derive(Debug)]
pub(super) struct ClientGoals {
    goals: BTreeMap<GoalId, ClientGoalState>,
    limits: ClientGoalLimits,
    pub(super) counters: ClientCounters,
}

#[derive(Debug)]
struct ClientGoalState {
    answer: GoalReply,
    status: GoalStatusCode,
    events: VecDeque<GoalEvent>,
    /// The number of feedback messages in `events`.
    messages: usize,
    bytes: usize,
    dropped: u64,
    outcome: Option<Outcome>,
    wake: Arc<Notify>,
    /// Notifies the goal's task that the goal is accepted or withdrawn.
    changed: Arc<Notify>,
    withdrawal: Option<Withdrawal>,
    /// The time limit that the server exceeded, until it is reported.
    overdue: Option<Duration>,
    /// The handle was dropped: the goal is kept for its withdrawal.
    is_left: bool,
}

/// Whether the server has replied. Earlier events are kept and delivered after the reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum GoalReply {
    Awaited,
    Had,
}

impl ClientGoals {
    pub(super) fn new(limits: ClientGoalLimits) -> Self {
        Self {
            goals: BTreeMap::new(),
            limits,
            counters: ClientCounters::default(),
        }
    }

    /// Adds a goal that is about to be sent. `wake` is notified for each event.
    pub(super) fn sent(&mut self, id: GoalId, wake: Arc<Notify>) {
        let open = self.goals.values().filter(|goal| goal.outcome.is_none());
        let full = open.count() >= self.limits.goals;
        let goal = ClientGoalState {
            answer: GoalReply::Awaited,
            status: GoalStatusCode::Unknown,
            events: VecDeque::new(),
            messages: 0,
            bytes: 0,
            dropped: 0,
            outcome: None,
            wake,
            changed: Arc::default(),
            withdrawal: None,
            overdue: None,
            is_left: false,
        };
        self.goals.insert(id, goal);
        if full {
            let busy = LostReason::Busy(self.limits.goals);
            let _is_left = self.end(id, Outcome::Lost(busy));
        }
    }

    /// Returns whether a goal with this id has a handle, even if the goal has ended.
    pub(super) fn is_held(&self, id: GoalId) -> bool {
        self.goals.contains_key(&id)
    }

    /// Records that a server accepted the goal.
    pub(super) fn accepted(&mut self, id: GoalId, stamp: Ros2Time, now: Instant) {
        if let Some(goal) = self.open(id)
            && goal.answer == GoalReply::Awaited
        {
            if let Some(withdrawal) = &mut goal.withdrawal {
                withdrawal.accepted(now);
            }
            goal.changed.notify_waiters();
            goal.answer = GoalReply::Had;
            if goal.status == GoalStatusCode::Unknown {
                goal.status = GoalStatusCode::Accepted;
            }
            goal.events.push_front(GoalEvent::Accepted(stamp));
            goal.wake.notify_one();
        }
    }

    /// Records a status from the server's list. The list may be older than the known status,
    /// because samples of other topics can overtake it. A goal in the list is accepted, even if the
    /// reply to it is lost.
    pub(super) fn status(
        &mut self,
        id: GoalId,
        (status, stamp): (GoalStatusCode, Ros2Time),
        now: Instant,
    ) {
        if status != GoalStatusCode::Unknown {
            self.accepted(id, stamp, now);
        }
        let Some(goal) = self.open(id) else {
            return;
        };
        if rank(status) <= rank(goal.status) {
            return;
        }
        goal.status = status;
        if matches!(
            status,
            GoalStatusCode::Executing | GoalStatusCode::Canceling
        ) {
            goal.tell(GoalEvent::Status(status));
        }
    }

    /// Records feedback of the server.
    pub(super) fn feedback(&mut self, id: GoalId, body: Bytes) {
        let ClientGoalLimits {
            feedback_messages,
            feedback_bytes,
            ..
        } = self.limits;
        let Some(goal) = self.open(id) else {
            self.counters.others_feedback += 1;
            return;
        };
        goal.messages += 1;
        goal.bytes += body.len();
        goal.tell(GoalEvent::Feedback(body));
        let mut dropped = 0;
        while goal.messages > 1
            && (goal.messages > feedback_messages || goal.bytes > feedback_bytes)
        {
            goal.drop_oldest();
            dropped += 1;
        }
        goal.dropped += dropped;
        self.counters.feedback_dropped += dropped;
    }

    /// Withdraws the goal, so that it is not sent, or is cancelled as soon as it is accepted.
    /// Returns false if the server has decided about the goal, or the goal is unknown.
    pub(super) fn withdraw(&mut self, id: GoalId, now: Instant) -> bool {
        let goal = self.open(id);
        let Some(goal) = goal.filter(|goal| goal.answer == GoalReply::Awaited) else {
            return false;
        };
        goal.withdrawal.get_or_insert_with(|| Withdrawal::new(now));
        goal.changed.notify_waiters();
        true
    }

    /// Returns the goals that no server has decided about.
    pub(super) fn undecided(&self) -> Vec<GoalId> {
        let open = self
            .goals
            .iter()
            .filter(|(_, goal)| goal.outcome.is_none() && goal.answer == GoalReply::Awaited);
        open.map(|(id, _)| *id).collect()
    }

    /// Withdraws a goal for which the server did not decide within `limit`.
    pub(super) fn overdue(&mut self, id: GoalId, limit: Duration, now: Instant) {
        if self.withdraw(id, now)
            && let Some(goal) = self.open(id)
        {
            goal.overdue = Some(limit);
            goal.wake.notify_one();
        }
    }

    /// Returns whether the goal is to be cancelled once it is accepted.
    pub(super) fn is_withdrawn(&self, id: GoalId) -> bool {
        self.goals
            .get(&id)
            .is_some_and(|goal| goal.withdrawal.is_some())
    }

    /// Returns whether a server has accepted the goal.
    pub(super) fn is_accepted(&self, id: GoalId) -> bool {
        let goal = self.goals.get(&id);
        goal.is_some_and(|goal| goal.answer == GoalReply::Had)
    }

    /// Returns the notification for the acceptance or withdrawal of the goal.
    pub(super) fn changed(&self, id: GoalId) -> Arc<Notify> {
        let goal = self.goals.get(&id);
        goal.map(|goal| Arc::clone(&goal.changed))
            .unwrap_or_default()
    }

    /// Returns the withdrawal of a goal that has not ended.
    pub(super) fn withdrawal(&mut self, id: GoalId) -> Option<&mut Withdrawal> {
        self.open(id)?.withdrawal.as_mut()
    }

    /// Returns the time of the next cancel request for a withdrawn goal.
    pub(super) fn cancel_due(&self, id: GoalId) -> Option<Instant> {
        self.goals.get(&id)?.withdrawal.as_ref()?.due()
    }

    /// Records the server's response to a cancel request for a withdrawn goal.
    pub(super) fn cancel_answered(&mut self, id: GoalId, answer: Option<CancelCode>, now: Instant) {
        let Some(goal) = self.open(id) else {
            return;
        };
        let withdrawal = goal.withdrawal.as_mut();
        if withdrawal.is_some_and(|withdrawal| withdrawal.answered(answer, now)) {
            goal.tell(GoalEvent::CancelRefused);
        }
    }

    /// Returns the withdrawn goals that have not ended, and the age of each withdrawal.
    pub(super) fn pending(&self, now: Instant) -> Vec<(GoalId, Duration)> {
        let open = self.goals.iter().filter(|(_, goal)| goal.outcome.is_none());
        let withdrawn =
            open.filter_map(|(id, goal)| Some((*id, goal.withdrawal.as_ref()?.age(now))));
        withdrawn.collect()
    }

    /// Ends a goal. Returns true if its handle was dropped, so that the goal is removed.
    pub(super) fn end(&mut self, id: GoalId, outcome: Outcome) -> bool {
        let Some(goal) = self.open(id) else {
            return false;
        };
        if goal.is_left {
            self.goals.remove(&id);
            return true;
        }
        match &outcome {
            Outcome::Rejected => goal.forget_events(),
            Outcome::Done { status, .. } => goal.status = *status,
            Outcome::Lost(_) if goal.answer == GoalReply::Awaited => goal.forget_events(),
            Outcome::Lost(_) => {}
        }
        goal.answer = GoalReply::Had;
        goal.outcome = Some(outcome.clone());
        goal.tell(GoalEvent::Ended(outcome));
        false
    }

    /// Ends all goals.
    pub(super) fn end_all(&mut self, outcome: &Outcome) {
        for id in self.goals.keys().copied().collect::<Vec<_>>() {
            let _is_left = self.end(id, outcome.clone());
        }
    }

    /// Returns the next event of a goal.
    pub(super) fn next_event(&mut self, id: GoalId) -> Option<GoalEvent> {
        let goal = self.goals.get_mut(&id)?;
        if let Some(limit) = goal.overdue.take() {
            return Some(GoalEvent::Overdue(limit));
        }
        if goal.answer == GoalReply::Awaited {
            return None;
        }
        // Dropped feedback is older than the waiting events, except for the acceptance.
        if goal.dropped > 0 && !matches!(goal.events.front(), Some(GoalEvent::Accepted(_))) {
            return Some(GoalEvent::FeedbackDropped(std::mem::take(
                &mut goal.dropped,
            )));
        }
        let event = goal.events.pop_front()?;
        if let GoalEvent::Feedback(body) = &event {
            goal.messages -= 1;
            goal.bytes -= body.len();
        }
        Some(event)
    }

    /// Returns the known status of a goal: unknown before the server's reply.
    pub(super) fn known_status(&self, id: GoalId) -> GoalStatusCode {
        let goal = self.goals.get(&id);
        let goal = goal.filter(|goal| goal.answer == GoalReply::Had);
        goal.map_or(GoalStatusCode::Unknown, |goal| goal.status)
    }

    /// Returns the outcome of an ended goal.
    pub(super) fn outcome(&self, id: GoalId) -> Option<&Outcome> {
        self.goals.get(&id)?.outcome.as_ref()
    }

    /// Records that the handle was dropped. Returns false if the goal is withdrawn and has not
    /// ended: it is kept until its end.
    pub(super) fn forget(&mut self, id: GoalId) -> bool {
        if let Some(goal) = self.open(id)
            && goal.withdrawal.is_some()
        {
            goal.is_left = true;
            goal.forget_events();
            return false;
        }
        self.goals.remove(&id);
        true
    }

    fn open(&mut self, id: GoalId) -> Option<&mut ClientGoalState> {
        let goal = self.goals.get_mut(&id);
        goal.filter(|goal| goal.outcome.is_none())
    }
}

impl ClientGoalState {
    fn tell(&mut self, event: GoalEvent) {
        if self.is_left {
            return;
        }
        self.events.push_back(event);
        self.wake.notify_one();
    }

    fn drop_oldest(&mut self) {
        let is_feedback = |event: &GoalEvent| matches!(event, GoalEvent::Feedback(_));
        let oldest = self.events.iter().position(is_feedback);
        if let Some(GoalEvent::Feedback(body)) = oldest.and_then(|at| self.events.remove(at)) {
            self.messages -= 1;
            self.bytes -= body.len();
        }
    }

    fn forget_events(&mut self) {
        self.events.clear();
        (self.messages, self.bytes, self.dropped) = (0, 0, 0);
    }
}

/// Returns the order of a status; all terminal states are equal.
const fn rank(status: GoalStatusCode) -> u8 {
    match status {
        GoalStatusCode::Unknown => 0,
        GoalStatusCode::Accepted => 1,
        GoalStatusCode::Executing => 2,
        GoalStatusCode::Canceling => 3,
        GoalStatusCode::Succeeded | GoalStatusCode::Canceled | GoalStatusCode::Aborted => 4,
    }
}

#[cfg(test)]
mod tests;
