//! The server's side of goals: which it knows, what may follow on what, and whom a result is owed.
//!
//! No clock and no network: decisions and time come in, what is to be sent comes out. The states are those of
//! `rcl_action_transition_goal_state`, and what a request to cancel means those of
//! `rcl_action_process_cancel_request`.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;
use tokio::time::Instant;

use super::types::{CancelCode, CancelWhat, GoalId, GoalInfo, Status};
use crate::clock::RosTime;

/// How a goal ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    Succeed,
    Abort,
    Cancel,
}

/// Why a goal did not take a decision.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum GoalError {
    /// It cannot follow on the goal's status.
    #[error("the goal {goal} is {from:?}: it cannot be {wanted}")]
    NotFrom {
        /// The goal.
        goal: GoalId,
        /// Its status, which stays.
        from: Status,
        /// What was asked for.
        wanted: &'static str,
    },
    /// It is not known any more: it has ended and its time is over, or the client that asked to cancel it waits no
    /// longer.
    #[error("the goal {0} is forgotten")]
    Forgotten(GoalId),
    /// The message is not CDR in little endian with its encapsulation header.
    #[error("the message for the goal {0} is not CDR in little endian")]
    Message(GoalId),
    /// The server was dropped.
    #[error("the action server was closed")]
    Closed,
}

/// What a server has received and could not use, or lost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerCounters {
    /// Requests that do not read. Their clients get no answer, as there is none that says so.
    pub malformed: u64,
    /// Goals rejected, and requests to cancel a goal, because too many are open.
    pub refused: u64,
    /// Goals rejected because there is one of the same id.
    pub repeated: u64,
    /// Ended goals that were forgotten early to make room.
    pub forgotten: u64,
    /// Requests for a result that get no answer because too many wait for that of the same goal.
    pub displaced: u64,
    /// Reports of progress that were dropped because readers did not keep up.
    pub feedback_dropped: u64,
}

/// Names a goal, and tells it from a later one of the same id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ticket {
    pub(super) id: GoalId,
    key: u64,
}

/// What becomes of a goal that arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// It is the user's to decide.
    New(Ticket),
    /// There is one of that id.
    Known,
    /// There is no room for it.
    Full,
}

/// What becomes of a request for a result.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Asked<W> {
    /// The goal is unknown.
    Unknown,
    /// It has ended with this.
    Ended(Bytes),
    /// It waits for the end; this one gave way to it.
    Waits(Option<W>),
}

/// All goals, with those who wait for their results, each a `W`.
#[derive(Debug)]
pub(super) struct ServerGoals<W> {
    goals: BTreeMap<GoalId, Goal<W>>,
    most: usize,
    /// `None` keeps results until there is no room.
    result_timeout: Option<Duration>,
    next_key: u64,
    pub(super) counters: ServerCounters,
}

#[derive(Debug)]
struct Goal<W> {
    /// In the order of arrival.
    key: u64,
    stamp: RosTime,
    phase: Phase<W>,
}

#[derive(Debug)]
enum Phase<W> {
    /// Neither accepted nor rejected. To clients it is unknown.
    Offered,
    Open {
        status: Status,
        waiting: VecDeque<W>,
    },
    Ended {
        status: Status,
        result: Bytes,
        since: Instant,
    },
}

impl<W> ServerGoals<W> {
    /// Knows at most `most` goals, ended ones for as long as `result_timeout`.
    pub(super) fn new(most: usize, result_timeout: Option<Duration>) -> Self {
        Self {
            goals: BTreeMap::new(),
            most,
            result_timeout,
            next_key: 0,
            counters: ServerCounters::default(),
        }
    }

    /// A goal arrives.
    pub(super) fn arrive(&mut self, id: GoalId) -> Arrival {
        if self.goals.contains_key(&id) {
            self.counters.repeated += 1;
            return Arrival::Known;
        }
        if !self.has_room() {
            self.counters.refused += 1;
            return Arrival::Full;
        }
        let key = self.next_key;
        self.next_key += 1;
        let goal = Goal {
            key,
            stamp: RosTime::default(),
            phase: Phase::Offered,
        };
        self.goals.insert(id, goal);
        Arrival::New(Ticket { id, key })
    }

    /// Accepts a goal that was offered.
    pub(super) fn accept(&mut self, ticket: Ticket, stamp: RosTime) -> Result<(), GoalError> {
        let goal = self.goal(ticket)?;
        if !matches!(goal.phase, Phase::Offered) {
            return Err(goal.refuses(ticket.id, "accepted"));
        }
        goal.stamp = stamp;
        goal.phase = Phase::Open {
            status: Status::Accepted,
            waiting: VecDeque::new(),
        };
        Ok(())
    }

    /// Forgets a goal that was offered; one that was accepted stays.
    pub(super) fn reject(&mut self, ticket: Ticket) {
        let offered = |goal: &mut Goal<W>| matches!(goal.phase, Phase::Offered);
        if self.goal(ticket).is_ok_and(offered) {
            self.goals.remove(&ticket.id);
        }
    }

    /// Begins work on an accepted goal.
    pub(super) fn execute(&mut self, ticket: Ticket) -> Result<(), GoalError> {
        self.step(ticket, Status::Executing, "executed", |from| {
            matches!(from, Status::Accepted)
        })
    }

    /// Agrees to cancel a goal. It may be on its way there by an earlier request.
    pub(super) fn cancel(&mut self, ticket: Ticket) -> Result<(), GoalError> {
        self.step(ticket, Status::Canceling, "cancelled", |from| {
            matches!(
                from,
                Status::Accepted | Status::Executing | Status::Canceling
            )
        })
    }

    fn step(
        &mut self,
        ticket: Ticket,
        to: Status,
        wanted: &'static str,
        allowed: impl Fn(Status) -> bool,
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

    /// The status with which a goal would end so, unless it may not.
    pub(super) fn may_end(&mut self, ticket: Ticket, end: End) -> Result<Status, GoalError> {
        let goal = self.goal(ticket)?;
        match (end, goal.status()) {
            (End::Succeed, Status::Executing | Status::Canceling) => Ok(Status::Succeeded),
            (End::Abort, Status::Executing | Status::Canceling) => Ok(Status::Aborted),
            (End::Cancel, Status::Canceling) => Ok(Status::Canceled),
            (End::Succeed | End::Abort | End::Cancel, _) => {
                Err(goal.refuses(ticket.id, end.name()))
            }
        }
    }

    /// Ends a goal with its result, which is kept, and returns those who wait for it.
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

    /// Whether nobody decides about a goal that has not ended: then it has to be ended as aborted.
    pub(super) fn abandon(&mut self, ticket: Ticket) -> bool {
        // What was not begun cannot be aborted. Whether it was begun before does not matter.
        drop(self.execute(ticket));
        self.may_end(ticket, End::Abort).is_ok()
    }

    /// The goals that a request to cancel is about, each to be agreed to, or why it is about none.
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
        let meant = |id: GoalId, goal: &Goal<W>| match what {
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

    /// A client asks for a result.
    pub(super) fn ask(&mut self, id: GoalId, who: impl FnOnce() -> W) -> Asked<W> {
        match self.goals.get_mut(&id).map(|goal| &mut goal.phase) {
            None | Some(Phase::Offered) => Asked::Unknown,
            Some(Phase::Ended { result, .. }) => Asked::Ended(result.clone()),
            Some(Phase::Open { waiting, .. }) => {
                let displaced = (waiting.len() >= MOST_WAITING)
                    .then(|| waiting.pop_front())
                    .flatten();
                self.counters.displaced += u64::from(displaced.is_some());
                waiting.push_back(who());
                Asked::Waits(displaced)
            }
        }
    }

    /// A goal's status while it is known.
    pub(super) fn status(&self, ticket: Ticket) -> Option<Status> {
        let goal = self.goals.get(&ticket.id)?;
        (goal.key == ticket.key).then(|| goal.status())
    }

    /// What to publish: the accepted goals in the order they came.
    pub(super) fn list(&self) -> Vec<(GoalInfo, Status)> {
        let accepted = self.goals.iter().filter(|(_, goal)| goal.is_accepted());
        let mut found: Vec<_> = accepted.collect();
        found.sort_by_key(|(_, goal)| goal.key);
        let said = |(id, goal): (&GoalId, &Goal<W>)| (goal.named(*id).1, goal.status());
        found.into_iter().map(said).collect()
    }

    /// Forgets what has ended long enough ago. Returns whether there was any.
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

    fn goal(&mut self, ticket: Ticket) -> Result<&mut Goal<W>, GoalError> {
        let goal = self.goals.get_mut(&ticket.id);
        goal.filter(|goal| goal.key == ticket.key)
            .ok_or(GoalError::Forgotten(ticket.id))
    }

    /// Makes room by forgetting what has ended first. False when all are open.
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

impl<W> Goal<W> {
    const fn status(&self) -> Status {
        match self.phase {
            Phase::Offered => Status::Unknown,
            Phase::Open { status, .. } | Phase::Ended { status, .. } => status,
        }
    }

    const fn is_accepted(&self) -> bool {
        !matches!(self.phase, Phase::Offered)
    }

    const fn is_cancelable(&self) -> bool {
        matches!(self.status(), Status::Accepted | Status::Executing)
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

/// Requests that may wait for the result of one goal. When they are more, the oldest gets no answer: its client has
/// waited longest, and may have gone.
pub(super) const MOST_WAITING: usize = 8;

#[cfg(test)]
mod tests;
