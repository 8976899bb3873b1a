//! The server's state of its goals: the known goals, their transitions, and the clients that wait
//! for results.
//!
//! The module uses no clock and no network: decisions and times come in, messages to send come out.
//! The states follow `rcl_action_transition_goal_state`, and the meaning of cancel requests follows
//! `rcl_action_process_cancel_request`.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;
use tokio::time::Instant;

use super::types::{CancelCode, CancelWhat, GoalId, GoalInfo, GoalStatusCode};
use crate::clock::Ros2Time;

/// The end of a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    Succeed,
    Abort,
    Cancel,
}

/// The reason for which a decision about a goal was refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum GoalError {
    /// The goal's status does not allow the transition.
    #[error("the goal {goal} is {from:?}: it cannot be {wanted}")]
    NotFrom {
        /// The id of the goal.
        goal: GoalId,
        /// The status of the goal, which stays.
        from: GoalStatusCode,
        /// The requested state.
        wanted: &'static str,
    },
    /// The goal is no longer known: it has ended and its result has expired, or the client of the
    /// cancel request no longer waits.
    #[error("the goal {0} has expired")]
    Forgotten(GoalId),
    /// The message is not little-endian CDR with its encapsulation header.
    #[error("the message for the goal {0} is not little-endian CDR")]
    Message(GoalId),
    /// The server was dropped.
    #[error("the action server was closed")]
    Closed,
}

/// Counters of requests that a server could not use, and of lost messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerCounters {
    /// Requests that could not be decoded. Their clients get no reply, because no reply expresses
    /// this fault.
    pub malformed: u64,
    /// Goals and cancel requests rejected because too many are open.
    pub refused: u64,
    /// Goals rejected because a goal with the same id exists.
    pub repeated: u64,
    /// Ended goals that were removed early to make room.
    pub forgotten: u64,
    /// Requests for a result that get no reply because too many requests wait for the same goal.
    pub displaced: u64,
    /// Feedback messages dropped because readers did not keep up.
    pub feedback_dropped: u64,
}

/// Identifies a goal and distinguishes it from a later goal with the same id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ticket {
    pub(super) id: GoalId,
    key: u64,
}

/// The decision about a new goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NewGoalDecision {
    /// The user has to accept or reject the goal.
    New(Ticket),
    /// A goal with this id exists.
    Known,
    /// The server has no room for the goal.
    Full,
}

/// The result of a request for a goal's result.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum ResultRequest<W> {
    /// The goal is unknown.
    Unknown,
    /// The goal has ended with this result.
    Ended(Bytes),
    /// The request waits for the end of the goal; it displaced the request in this field.
    Waits(Option<W>),
}

/// All goals, with the requests that wait for their results, each a `W`.
#[derive(Debug)]
pub(super) struct ServerGoals<W> {
    goals: BTreeMap<GoalId, ServerGoalState<W>>,
    most: usize,
    /// `None` keeps results until room is needed.
    result_timeout: Option<Duration>,
    next_key: u64,
    pub(super) counters: ServerCounters,
}

#[derive(Debug)]
struct ServerGoalState<W> {
    /// Increases in the order of arrival.
    key: u64,
    stamp: Ros2Time,
    phase: Phase<W>,
}

#[derive(Debug)]
enum Phase<W> {
    /// Neither accepted nor rejected. Clients see the goal as unknown.
    Offered,
    Open {
        status: GoalStatusCode,
        waiting: VecDeque<W>,
    },
    Ended {
        status: GoalStatusCode,
        result: Bytes,
        since: Instant,
    },
}

impl<W> ServerGoals<W> {
    /// Returns a registry for at most `most` goals, which keeps ended goals for `result_timeout`.
    pub(super) fn new(most: usize, result_timeout: Option<Duration>) -> Self {
        Self {
            goals: BTreeMap::new(),
            most,
            result_timeout,
            next_key: 0,
            counters: ServerCounters::default(),
        }
    }

    /// Registers a new goal.
    pub(super) fn arrive(&mut self, id: GoalId) -> NewGoalDecision {
        if self.goals.contains_key(&id) {
            self.counters.repeated += 1;
            return NewGoalDecision::Known;
        }
        if !self.has_room() {
            self.counters.refused += 1;
            return NewGoalDecision::Full;
        }
        let key = self.next_key;
        self.next_key += 1;
        let goal = ServerGoalState {
            key,
            stamp: Ros2Time::default(),
            phase: Phase::Offered,
        };
        self.goals.insert(id, goal);
        NewGoalDecision::New(Ticket { id, key })
    }

    /// Accepts an offered goal.
    pub(super) fn accept(&mut self, ticket: Ticket, stamp: Ros2Time) -> Result<(), GoalError> {
        let goal = self.goal(ticket)?;
        if !matches!(goal.phase, Phase::Offered) {
            return Err(goal.refuses(ticket.id, "accepted"));
        }
        goal.stamp = stamp;
        goal.phase = Phase::Open {
            status: GoalStatusCode::Accepted,
            waiting: VecDeque::new(),
        };
        Ok(())
    }

    /// Removes an offered goal; an accepted goal stays.
    pub(super) fn reject(&mut self, ticket: Ticket) {
        let offered = |goal: &mut ServerGoalState<W>| matches!(goal.phase, Phase::Offered);
        if self.goal(ticket).is_ok_and(offered) {
            self.goals.remove(&ticket.id);
        }
    }

    /// Starts work on an accepted goal.
    pub(super) fn execute(&mut self, ticket: Ticket) -> Result<(), GoalError> {
        self.step(ticket, GoalStatusCode::Executing, "executed", |from| {
            matches!(from, GoalStatusCode::Accepted)
        })
    }

    /// Agrees to cancel a goal. An earlier request may have started the cancellation.
    pub(super) fn cancel(&mut self, ticket: Ticket) -> Result<(), GoalError> {
        self.step(ticket, GoalStatusCode::Canceling, "cancelled", |from| {
            matches!(
                from,
                GoalStatusCode::Accepted | GoalStatusCode::Executing | GoalStatusCode::Canceling
            )
        })
    }

    fn step(
        &mut self,
        ticket: Ticket,
        to: GoalStatusCode,
        wanted: &'static str,
        allowed: impl Fn(GoalStatusCode) -> bool,
    ) -> Result<(), GoalError> {
        let goal = self.goal(ticket)?;
        match &mut goal.phase {
            Phase::Open { status, .. } if allowed(*status) => {
                *status = to;
                Ok(())
            }
            Phase::Open { .. } | Phase::Offered | Phase::Ended { .. } => {
                Err(goal.refuses(ticket.id, wanted))
            }
        }
    }

    /// Returns the terminal status for this end, or an error if the goal cannot end in this way.
    pub(super) fn may_end(
        &mut self,
        ticket: Ticket,
        end: End,
    ) -> Result<GoalStatusCode, GoalError> {
        let goal = self.goal(ticket)?;
        match (end, goal.status()) {
            (End::Succeed, GoalStatusCode::Executing | GoalStatusCode::Canceling) => {
                Ok(GoalStatusCode::Succeeded)
            }
            (End::Abort, GoalStatusCode::Executing | GoalStatusCode::Canceling) => {
                Ok(GoalStatusCode::Aborted)
            }
            (End::Cancel, GoalStatusCode::Canceling) => Ok(GoalStatusCode::Canceled),
            (End::Succeed | End::Abort | End::Cancel, _) => {
                Err(goal.refuses(ticket.id, end.name()))
            }
        }
    }

    /// Ends a goal with its result, which is kept. Returns the requests that wait for the result.
    pub(super) fn end(
        &mut self,
        ticket: Ticket,
        end: End,
        result: Bytes,
        now: Instant,
    ) -> Result<Vec<W>, GoalError> {
        let status = self.may_end(ticket, end)?;
        let ended = Phase::Ended {
            status,
            result,
            since: now,
        };
        match std::mem::replace(&mut self.goal(ticket)?.phase, ended) {
            Phase::Open { waiting, .. } => Ok(waiting.into()),
            Phase::Offered | Phase::Ended { .. } => Ok(Vec::new()),
        }
    }

    /// Prepares a dropped goal for its abort: starts an accepted goal. Returns whether the goal has
    /// not ended, so that it has to be aborted.
    pub(super) fn abandon(&mut self, ticket: Ticket) -> bool {
        // Only an executing or canceling goal can be aborted; for other states than accepted the
        // error of `execute` does not matter.
        drop(self.execute(ticket));
        self.may_end(ticket, End::Abort).is_ok()
    }

    /// Returns the goals that a cancel request selects, each to be agreed to, or the reason for
    /// which it selects no goal.
    pub(super) fn to_cancel(
        &self,
        what: CancelWhat,
    ) -> Result<Vec<(Ticket, GoalInfo)>, CancelCode> {
        if let CancelWhat::Goal(id) = what {
            let goal = self.goals.get(&id).filter(|goal| goal.is_accepted());
            let goal = goal.ok_or(CancelCode::UnknownGoal)?;
            return if goal.is_cancelable() {
                Ok(vec![goal.named(id)])
            } else {
                Err(CancelCode::Terminated)
            };
        }
        let meant = |id: GoalId, goal: &ServerGoalState<W>| match what {
            CancelWhat::All => true,
            CancelWhat::Goal(one) => id == one,
            CancelWhat::Until(stamp) => goal.stamp <= stamp,
            CancelWhat::GoalAndUntil(one, stamp) => id == one || goal.stamp <= stamp,
        };
        let goals = self.goals.iter();
        let mut found: Vec<_> = goals
            .filter(|(id, goal)| goal.is_cancelable() && meant(**id, goal))
            .map(|(id, goal)| goal.named(*id))
            .collect();
        found.sort_by_key(|(ticket, _)| ticket.key);
        Ok(found)
    }

    /// Handles a client's request for a result.
    pub(super) fn ask(&mut self, id: GoalId, who: impl FnOnce() -> W) -> ResultRequest<W> {
        match self.goals.get_mut(&id).map(|goal| &mut goal.phase) {
            None | Some(Phase::Offered) => ResultRequest::Unknown,
            Some(Phase::Ended { result, .. }) => ResultRequest::Ended(result.clone()),
            Some(Phase::Open { waiting, .. }) => {
                let displaced = (waiting.len() >= MOST_WAITING)
                    .then(|| waiting.pop_front())
                    .flatten();
                self.counters.displaced += u64::from(displaced.is_some());
                waiting.push_back(who());
                ResultRequest::Waits(displaced)
            }
        }
    }

    /// Returns the status of a known goal.
    pub(super) fn status(&self, ticket: Ticket) -> Option<GoalStatusCode> {
        let goal = self.goals.get(&ticket.id)?;
        (goal.key == ticket.key).then(|| goal.status())
    }

    /// Returns the status list to publish: the accepted goals in the order of arrival.
    pub(super) fn list(&self) -> Vec<(GoalInfo, GoalStatusCode)> {
        let accepted = self.goals.iter().filter(|(_, goal)| goal.is_accepted());
        let mut found: Vec<_> = accepted.collect();
        found.sort_by_key(|(_, goal)| goal.key);
        let said = |(id, goal): (&GoalId, &ServerGoalState<W>)| (goal.named(*id).1, goal.status());
        found.into_iter().map(said).collect()
    }

    /// Removes the ended goals after their time limit. Returns whether any was removed.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let Some(timeout) = self.result_timeout else {
            return false;
        };
        let before = self.goals.len();
        self.goals.retain(|_, goal| match &goal.phase {
            Phase::Ended { since, .. } => now.saturating_duration_since(*since) <= timeout,
            Phase::Offered | Phase::Open { .. } => true,
        });
        self.goals.len() < before
    }

    fn goal(&mut self, ticket: Ticket) -> Result<&mut ServerGoalState<W>, GoalError> {
        let goal = self.goals.get_mut(&ticket.id);
        goal.filter(|goal| goal.key == ticket.key)
            .ok_or(GoalError::Forgotten(ticket.id))
    }

    /// Makes room by removing the goal that ended first. Returns false if all goals are open.
    fn has_room(&mut self) -> bool {
        if self.goals.len() < self.most {
            return true;
        }
        let ended = self.goals.iter().filter_map(|(id, goal)| match goal.phase {
            Phase::Ended { since, .. } => Some((since, goal.key, *id)),
            Phase::Offered | Phase::Open { .. } => None,
        });
        let Some((_, _, id)) = ended.min() else {
            return false;
        };
        self.goals.remove(&id);
        self.counters.forgotten += 1;
        true
    }
}

impl<W> ServerGoalState<W> {
    const fn status(&self) -> GoalStatusCode {
        match self.phase {
            Phase::Offered => GoalStatusCode::Unknown,
            Phase::Open { status, .. } | Phase::Ended { status, .. } => status,
        }
    }

    const fn is_accepted(&self) -> bool {
        !matches!(self.phase, Phase::Offered)
    }

    const fn is_cancelable(&self) -> bool {
        matches!(
            self.status(),
            GoalStatusCode::Accepted | GoalStatusCode::Executing
        )
    }

    const fn named(&self, id: GoalId) -> (Ticket, GoalInfo) {
        let info = GoalInfo {
            id,
            stamp: self.stamp,
        };
        (Ticket { id, key: self.key }, info)
    }

    const fn refuses(&self, goal: GoalId, wanted: &'static str) -> GoalError {
        GoalError::NotFrom {
            goal,
            from: self.status(),
            wanted,
        }
    }
}

impl End {
    const fn name(self) -> &'static str {
        match self {
            Self::Succeed => "succeeded",
            Self::Abort => "aborted",
            Self::Cancel => "ended as cancelled",
        }
    }
}

/// Maximum number of requests that wait for the result of one goal. Beyond it, the oldest gets no
/// reply: its client has waited longest and may have left.
pub(super) const MOST_WAITING: usize = 8;

#[cfg(test)]
mod tests;
