//! The client's side of goals: the state of each goal, derived from the messages of its server, and
//! the rules for lost goals.
//!
//! This module uses no clock and no network. Its inputs are messages and steady time, its outputs
//! are events of goals. A goal enters each state at most once, so that only the feedback events
//! need a bound.

mod goal;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::Notify;
use tokio::time::Instant;

use self::goal::Goal;
use super::types::ActionlibStatus;
use super::wire::StatusEntry;
use crate::clock;
use crate::inbox::ConnectionPeer;

/// State of a goal between its client and its server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CommState {
    /// Sent, and not yet in a status of the server.
    WaitingForGoalAck,
    /// Received by the server, which has not decided yet.
    Pending,
    /// The server works on the goal.
    Active,
    /// The goal has ended; the result is not received yet.
    WaitingForResult,
    /// The client requested to cancel the goal, and the server has not reacted.
    WaitingForCancelAck,
    /// The server knows of the cancel request and has not started the goal.
    Recalling,
    /// The server knows of the cancel request and still works on the goal.
    Preempting,
    /// Ended with its result.
    Done,
    /// Ended without a result, see [`GoalLoss`].
    Lost,
}

impl CommState {
    /// Returns whether the state is final.
    pub const fn is_end(self) -> bool {
        match self {
            Self::Done | Self::Lost => true,
            Self::WaitingForGoalAck
            | Self::Pending
            | Self::Active
            | Self::WaitingForResult
            | Self::WaitingForCancelAck
            | Self::Recalling
            | Self::Preempting => false,
        }
    }
}

/// Event of a goal.
#[derive(Clone, Debug)]
pub enum ActionlibGoalEvent {
    /// The goal has entered another state, with an event for each state on the way. `Done` and
    /// `Lost` have events of their own.
    State(CommState),
    /// The server reports progress.
    Feedback(Feedback),
    /// Number of feedback messages dropped in favour of newer messages since the last event.
    FeedbackDropped(u64),
    /// The last event of a goal that ended with a result.
    Done(GoalResult),
    /// The last event of a goal that is lost.
    Lost(GoalLoss),
}

/// Progress of a goal.
#[derive(Clone, Debug)]
pub struct Feedback {
    /// The serialized `XFeedback`.
    pub body: Bytes,
    /// The server, with the type of the topic in its header.
    pub peer: Arc<ConnectionPeer>,
}

/// The end of a goal.
#[derive(Clone, Debug)]
pub struct GoalResult {
    /// Final status. `Lost` stands for a code of the server that is not terminal.
    pub status: ActionlibStatus,
    /// Text of the server about the result, for people.
    pub text: String,
    /// The serialized `XResult`.
    pub body: Bytes,
    /// The server, with the type of the topic in its header.
    pub peer: Arc<ConnectionPeer>,
}

/// Reason for which a goal is lost. The server may still work on a goal that it received.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum GoalLoss {
    /// No node subscribes to the goals.
    #[error(
        "the goal was not sent: no node subscribes to {topic}; start the action server, or check its name"
    )]
    NoServer {
        /// The resolved topic.
        topic: String,
    },
    /// The goal was sent and was never in a status of a server.
    #[error("no server accepted the goal within {0:?}")]
    NotAcknowledged(Duration),
    /// The server is connected and sends no status.
    #[error("the server {server} has sent no status for {silence:?}")]
    Silent {
        /// Name of the server's node.
        server: String,
        /// Time limit that was exceeded.
        silence: Duration,
    },
    /// The connection to the server ended and was not restored.
    #[error("the connection to the server {server} ended")]
    Disconnected {
        /// Name of the server's node.
        server: String,
    },
    /// The server no longer lists the goal.
    #[error("the server {server} no longer knows the goal; it may have been restarted")]
    Forgotten {
        /// Name of the server's node.
        server: String,
    },
    /// The server listed the goal as ended and sent no result.
    #[error("the goal ended as {status:?}, and no result came within {waited:?}")]
    NoResult {
        /// Final status of the goal.
        status: ActionlibStatus,
        /// Time limit that was exceeded.
        waited: Duration,
    },
    /// This process closed the client.
    #[error("the action client was closed")]
    ClientClosed,
}

/// Counts of received data that a client could not use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActionlibClientCounters {
    /// Messages that cannot be decoded.
    pub malformed: u64,
    /// Statuses that cannot follow the state of the goal, or with an unknown code.
    pub invalid_transitions: u64,
    /// Results of goals that had ended already.
    pub late_results: u64,
    /// Feedback of goals that had ended already.
    pub late_feedback: u64,
    /// Feedback messages dropped in favour of newer messages, over all goals.
    pub feedback_dropped: u64,
    /// Messages of all topics that were lost because this process did not keep up.
    pub overrun: u64,
}

/// The time limits and queues of a client's goals.
#[derive(Clone, Copy, Debug)]
pub(super) struct GoalLimits {
    pub(super) acknowledge: Duration,
    pub(super) silence: Duration,
    pub(super) reconnect: Duration,
    pub(super) result: Duration,
    pub(super) feedback_grace: Duration,
    pub(super) feedback_messages: usize,
    pub(super) feedback_bytes: usize,
}

/// A topic that the server publishes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ServerTopic {
    Status,
    Feedback,
    Result,
}

/// All goals that still have a handle, and the known servers.
#[derive(Debug)]
pub(super) struct ActionlibClientGoals {
    limits: GoalLimits,
    goals: HashMap<String, Goal>,
    servers: HashMap<String, Server>,
    pub(super) counters: ActionlibClientCounters,
}

/// The connections to a node that publishes at least one topic of the action.
#[derive(Debug, Default)]
struct Server {
    status: usize,
    feedback: usize,
    result: usize,
    last_status: Option<Instant>,
    /// Start of the period with a connection for each of the three topics.
    complete: Option<Instant>,
    /// Start of the period without a connection for its status.
    gone: Option<Instant>,
}

impl Server {
    /// Whether the server is known to use its connections. rospy answers the header of a connection
    /// before it adds the connection to its publisher, and what is published in between is lost to
    /// it.
    fn is_settled(&self, now: Instant) -> bool {
        self.complete.is_some_and(|since| {
            let heard = self.last_status >= Some(clock::after(since, STATUS_AFTER));
            heard || now >= clock::after(since, SETTLES_WITHIN)
        })
    }
}

impl ActionlibClientGoals {
    pub(super) fn new(limits: GoalLimits) -> Self {
        Self {
            limits,
            goals: HashMap::new(),
            servers: HashMap::new(),
            counters: ActionlibClientCounters::default(),
        }
    }

    /// Adds a goal that is being sent. Its events notify `wake`.
    pub(super) fn sent(&mut self, id: String, now: Instant, wake: Arc<Notify>) {
        self.goals.insert(id, Goal::new(now, wake));
    }

    /// Removes a goal.
    pub(super) fn forget(&mut self, id: &str) {
        self.goals.remove(id);
    }

    pub(super) fn goal(&self, id: &str) -> Option<&Goal> {
        self.goals.get(id)
    }

    /// Returns the ids of the goals that have not ended.
    pub(super) fn open(&self) -> Vec<String> {
        let open = self.goals.iter().filter(|(_, goal)| !goal.state.is_end());
        open.map(|(id, _)| id.clone()).collect()
    }

    pub(super) fn next_event(&mut self, id: &str) -> Option<ActionlibGoalEvent> {
        self.goals.get_mut(id)?.next_event()
    }

    /// Records a cancel request. Returns false if the request would have no effect: the goal has
    /// ended, or its server knows already.
    pub(super) fn cancel(&mut self, id: &str) -> bool {
        let Some(goal) = self.goals.get_mut(id) else {
            return false;
        };
        match goal.state {
            CommState::WaitingForGoalAck | CommState::Pending | CommState::Active => {
                goal.go(CommState::WaitingForCancelAck);
                true
            }
            CommState::WaitingForCancelAck => true,
            CommState::WaitingForResult
            | CommState::Recalling
            | CommState::Preempting
            | CommState::Done
            | CommState::Lost => false,
        }
    }

    /// Applies a server's list of the goals it knows.
    pub(super) fn status(&mut self, from: &str, list: &[StatusEntry], now: Instant) {
        self.server(from).last_status = Some(now);
        let by_id: HashMap<&str, &StatusEntry> = list
            .iter()
            .map(|entry| (entry.id.as_str(), entry))
            .collect();
        for (id, goal) in &mut self.goals {
            if goal.state.is_end() {
                continue;
            }
            if let Some(entry) = by_id.get(id.as_str()) {
                if goal.server.as_deref() != Some(from) {
                    goal.server = Some(from.to_owned());
                }
                if !goal.follow(entry, now) {
                    self.counters.invalid_transitions += 1;
                }
            } else if goal.server.as_deref() == Some(from)
                // A server may forget an ended goal before its result is received.
                && goal.state != CommState::WaitingForResult
            {
                let server = from.to_owned();
                goal.lose(GoalLoss::Forgotten { server });
            }
        }
    }

    /// Applies a result, which may be received before the status that announces it.
    pub(super) fn result(
        &mut self,
        entry: &StatusEntry,
        body: Bytes,
        peer: Arc<ConnectionPeer>,
        now: Instant,
    ) {
        let Some(goal) = self.goals.get_mut(&entry.id) else {
            return;
        };
        if goal.state.is_end() || goal.result.is_some() {
            self.counters.late_results += 1;
            return;
        }
        let status = ActionlibStatus::from_code(entry.code).filter(|status| status.is_terminal());
        if !goal.follow(entry, now) || status.is_none() {
            self.counters.invalid_transitions += 1;
        }
        let status = status.unwrap_or(ActionlibStatus::Lost);
        let server = self.servers.get(&peer.caller_id);
        let reports = server.is_some_and(|server| server.feedback > 0);
        let result = GoalResult {
            status,
            text: entry.text.clone(),
            body,
            peer,
        };
        if reports && !self.limits.feedback_grace.is_zero() {
            let due = clock::after(now, self.limits.feedback_grace);
            goal.result = Some((due, result));
        } else {
            goal.done(result);
        }
    }

    pub(super) fn feedback(&mut self, id: &str, feedback: Feedback) {
        match self.goals.get_mut(id) {
            Some(goal) if goal.state.is_end() => self.counters.late_feedback += 1,
            Some(goal) => self.counters.feedback_dropped += goal.feedback(feedback, &self.limits),
            None => {}
        }
    }

    /// Records that a connection to a publisher of the action was made or ended.
    pub(super) fn connection(&mut self, node: &str, topic: ServerTopic, made: bool, now: Instant) {
        let server = self.server(node);
        let count = match topic {
            ServerTopic::Status => &mut server.status,
            ServerTopic::Feedback => &mut server.feedback,
            ServerTopic::Result => &mut server.result,
        };
        *count = if made {
            *count + 1
        } else {
            count.saturating_sub(1)
        };
        server.gone = (server.status == 0).then(|| server.gone.unwrap_or(now));
        let is_complete = server.status > 0 && server.feedback > 0 && server.result > 0;
        server.complete = is_complete.then(|| server.complete.unwrap_or(now));
        self.forget_servers();
    }

    /// Returns the connected server with the latest status, or a description of the missing part.
    pub(super) fn ready_server(&self, now: Instant) -> Result<&str, &'static str> {
        let latest = self
            .servers
            .iter()
            .filter(|(_, server)| server.status > 0)
            .filter_map(|(node, server)| Some((server.last_status?, node, server)))
            .max_by_key(|(at, ..)| *at);
        match latest {
            None => Err("no server has published its status"),
            Some((_, _, server)) if server.feedback == 0 => Err("the server publishes no feedback"),
            Some((_, _, server)) if server.result == 0 => Err("the server publishes no result"),
            Some((_, _, server)) if !server.is_settled(now) => {
                Err("the server has not published its status since the connection")
            }
            Some((_, node, _)) => Ok(node),
        }
    }

    /// Ends the goals after their time limits.
    pub(super) fn expire(&mut self, now: Instant) {
        for goal in self.goals.values_mut() {
            if let Some((_, result)) = goal.result.take_if(|(at, _)| *at <= now) {
                goal.done(result);
            }
            let due = next_loss(goal, &self.servers, &self.limits).filter(|(at, _)| *at <= now);
            if let Some((_, reason)) = due {
                goal.lose(reason);
            }
        }
        self.forget_servers();
    }

    /// Returns the next time at which [`Self::expire`] has an effect if nothing is received.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let goals = self.goals.values();
        let losses = goals
            .clone()
            .filter_map(|goal| next_loss(goal, &self.servers, &self.limits))
            .map(|(at, _)| at);
        let ends = goals.filter_map(|goal| goal.result.as_ref().map(|(at, _)| *at));
        losses.chain(ends).min()
    }

    pub(super) fn lose(&mut self, id: &str, reason: GoalLoss) {
        if let Some(goal) = self.goals.get_mut(id) {
            goal.lose(reason);
        }
    }

    pub(super) fn lose_all(&mut self, reason: &GoalLoss) {
        for goal in self.goals.values_mut() {
            goal.lose(reason.clone());
        }
    }

    fn server(&mut self, node: &str) -> &mut Server {
        self.servers.entry(node.to_owned()).or_default()
    }

    /// Removes the servers that are neither connected nor working on a goal of this client.
    fn forget_servers(&mut self) {
        let goals = &self.goals;
        self.servers.retain(|node, server| {
            let of = |goal: &Goal| !goal.state.is_end() && goal.server.as_ref() == Some(node);
            server.status + server.feedback + server.result > 0 || goals.values().any(of)
        });
    }
}

/// Returns the time at which a goal is lost if nothing more is received, and the reason.
fn next_loss(
    goal: &Goal,
    servers: &HashMap<String, Server>,
    limits: &GoalLimits,
) -> Option<(Instant, GoalLoss)> {
    if goal.state.is_end() {
        return None;
    }
    let Some(node) = &goal.server else {
        let reason = GoalLoss::NotAcknowledged(limits.acknowledge);
        return Some((clock::after(goal.sent, limits.acknowledge), reason));
    };
    let server = servers.get(node);
    let node = || node.clone();
    let heard = server.and_then(|s| s.last_status).unwrap_or(goal.sent);
    let silent = GoalLoss::Silent {
        server: node(),
        silence: limits.silence,
    };
    let gone = server.and_then(|server| server.gone).map(|at| {
        let reason = GoalLoss::Disconnected { server: node() };
        (clock::after(at, limits.reconnect), reason)
    });
    let waiting = goal.ended.map(|at| {
        let reason = GoalLoss::NoResult {
            status: goal.status,
            waited: limits.result,
        };
        (clock::after(at, limits.result), reason)
    });
    [
        Some((clock::after(heard, limits.silence), silent)),
        gone,
        waiting,
    ]
    .into_iter()
    .flatten()
    .min_by_key(|(at, _)| *at)
}

/// How much later than the last of the connections a status shows that the server uses all of them.
const STATUS_AFTER: Duration = Duration::from_millis(50);
/// How long such a status is waited for. Servers send five a second, unless they are told
/// otherwise.
const SETTLES_WITHIN: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
