//! The client's side of goals: the state of each goal, derived from the messages of its server, and
//! the rules for lost goals.
//!
//! This module uses no clock and no network. Its inputs are messages and steady time, its outputs
//! are events of goals. A goal enters each state at most once, so that only the feedback events
//! need a bound.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use thiserror::Error;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::types::Status;
use super::wire::StatusEntry;
use crate::clock;
use crate::inbox::Peer;

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
    /// Ended without a result, see [`LostReason`].
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
pub enum GoalEvent {
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
    Lost(LostReason),
}

/// Progress of a goal.
#[derive(Clone, Debug)]
pub struct Feedback {
    /// The serialized `XFeedback`.
    pub body: Bytes,
    /// The server, with the type of the topic in its header.
    pub peer: Arc<Peer>,
}

/// The end of a goal.
#[derive(Clone, Debug)]
pub struct GoalResult {
    /// Final status. `Lost` stands for a code of the server that is not terminal.
    pub status: Status,
    /// Text of the server about the result, for people.
    pub text: String,
    /// The serialized `XResult`.
    pub body: Bytes,
    /// The server, with the type of the topic in its header.
    pub peer: Arc<Peer>,
}

/// Reason for which a goal is lost. The server may still work on a goal that it received.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LostReason {
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
        status: Status,
        /// Time limit that was exceeded.
        waited: Duration,
    },
    /// This process closed the client.
    #[error("the action client was closed")]
    ClientClosed,
}

/// Counts of received data that a client could not use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClientCounters {
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
pub(super) struct Limits {
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
pub(super) enum Source {
    Status,
    Feedback,
    Result,
}

/// All goals that still have a handle, and the known servers.
#[derive(Debug)]
pub(super) struct ClientGoals {
    limits: Limits,
    goals: HashMap<String, Goal>,
    servers: HashMap<String, Server>,
    pub(super) counters: ClientCounters,
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

impl ClientGoals {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits,
            goals: HashMap::new(),
            servers: HashMap::new(),
            counters: ClientCounters::default(),
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

    pub(super) fn next_event(&mut self, id: &str) -> Option<GoalEvent> {
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
                goal.lose(LostReason::Forgotten { server });
            }
        }
    }

    /// Applies a result, which may be received before the status that announces it.
    pub(super) fn result(
        &mut self,
        entry: &StatusEntry,
        body: Bytes,
        peer: Arc<Peer>,
        now: Instant,
    ) {
        let Some(goal) = self.goals.get_mut(&entry.id) else {
            return;
        };
        if goal.state.is_end() || goal.result.is_some() {
            self.counters.late_results += 1;
            return;
        }
        let status = Status::from_code(entry.code).filter(|status| status.is_terminal());
        if !goal.follow(entry, now) || status.is_none() {
            self.counters.invalid_transitions += 1;
        }
        let status = status.unwrap_or(Status::Lost);
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
    pub(super) fn connection(&mut self, node: &str, topic: Source, made: bool, now: Instant) {
        let server = self.server(node);
        let count = match topic {
            Source::Status => &mut server.status,
            Source::Feedback => &mut server.feedback,
            Source::Result => &mut server.result,
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

    pub(super) fn lose(&mut self, id: &str, reason: LostReason) {
        if let Some(goal) = self.goals.get_mut(id) {
            goal.lose(reason);
        }
    }

    pub(super) fn lose_all(&mut self, reason: &LostReason) {
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
    limits: &Limits,
) -> Option<(Instant, LostReason)> {
    if goal.state.is_end() {
        return None;
    }
    let Some(node) = &goal.server else {
        let reason = LostReason::NotAcknowledged(limits.acknowledge);
        return Some((clock::after(goal.sent, limits.acknowledge), reason));
    };
    let server = servers.get(node);
    let node = || node.clone();
    let heard = server.and_then(|s| s.last_status).unwrap_or(goal.sent);
    let silent = LostReason::Silent {
        server: node(),
        silence: limits.silence,
    };
    let gone = server.and_then(|server| server.gone).map(|at| {
        let reason = LostReason::Disconnected { server: node() };
        (clock::after(at, limits.reconnect), reason)
    });
    let waiting = goal.ended.map(|at| {
        let reason = LostReason::NoResult {
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

/// A goal from the moment it is sent.
#[derive(Debug)]
pub(super) struct Goal {
    pub(super) state: CommState,
    pub(super) status: Status,
    pub(super) text: String,
    pub(super) outcome: Option<Result<GoalResult, LostReason>>,
    sent: Instant,
    /// The node that has listed the goal.
    server: Option<String>,
    /// Start of the wait for the result.
    ended: Option<Instant>,
    /// The result, and the end of the wait for feedback that was sent before it on another
    /// connection.
    result: Option<(Instant, GoalResult)>,
    events: VecDeque<GoalEvent>,
    feedback_messages: usize,
    feedback_bytes: usize,
    unreported: u64,
    wake: Arc<Notify>,
}

impl Goal {
    fn new(sent: Instant, wake: Arc<Notify>) -> Self {
        Self {
            state: CommState::WaitingForGoalAck,
            status: Status::Pending,
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
    fn follow(&mut self, entry: &StatusEntry, now: Instant) -> bool {
        let Some(status) = Status::from_code(entry.code) else {
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

    fn go(&mut self, state: CommState) {
        self.state = state;
        self.push(GoalEvent::State(state));
    }

    fn done(&mut self, result: GoalResult) {
        self.state = CommState::Done;
        self.status = result.status;
        self.text.clone_from(&result.text);
        self.outcome = Some(Ok(result.clone()));
        self.push(GoalEvent::Done(result));
    }

    fn lose(&mut self, reason: LostReason) {
        if let Some((_, result)) = self.result.take() {
            return self.done(result);
        }
        if self.state.is_end() {
            return;
        }
        self.state = CommState::Lost;
        self.status = Status::Lost;
        self.outcome = Some(Err(reason.clone()));
        self.push(GoalEvent::Lost(reason));
    }

    fn feedback(&mut self, feedback: Feedback, limits: &Limits) -> u64 {
        let len = feedback.body.len();
        let mut dropped = 0;
        while self.feedback_messages > 0
            && (self.feedback_messages >= limits.feedback_messages.max(1)
                || self.feedback_bytes.saturating_add(len) > limits.feedback_bytes)
        {
            let oldest = |event: &GoalEvent| matches!(event, GoalEvent::Feedback(_));
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
        self.push(GoalEvent::Feedback(feedback));
        dropped
    }

    fn push(&mut self, event: GoalEvent) {
        self.events.push_back(event);
        self.wake.notify_one();
    }

    fn next_event(&mut self) -> Option<GoalEvent> {
        if self.unreported > 0 {
            return Some(GoalEvent::FeedbackDropped(std::mem::take(
                &mut self.unreported,
            )));
        }
        let event = self.events.pop_front()?;
        self.taken(&event);
        Some(event)
    }

    fn taken(&mut self, event: &GoalEvent) {
        if let GoalEvent::Feedback(feedback) = event {
            self.feedback_messages -= 1;
            self.feedback_bytes -= feedback.body.len();
        }
    }
}

/// Returns the states that a goal enters when its server reports `status`; the list is empty if the
/// status is not new. Statuses arrive a few times a second and may skip states: the goal enters the
/// skipped states as well. Returns `None` if the status cannot follow the state, as when messages
/// of different topics overtake each other.
const fn path(state: CommState, status: Status) -> Option<&'static [CommState]> {
    use CommState as C;
    use Status as S;
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

/// How much later than the last of the connections a status shows that the server uses all of them.
const STATUS_AFTER: Duration = Duration::from_millis(50);
/// How long such a status is waited for. Servers send five a second, unless they are told
/// otherwise.
const SETTLES_WITHIN: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::clock;
    use crate::header::ConnectionHeader;

    const SECOND: Duration = Duration::from_secs(1);
    const LIMITS: Limits = Limits {
        acknowledge: Duration::from_secs(5),
        silence: Duration::from_secs(5),
        reconnect: SECOND,
        result: Duration::from_secs(5),
        feedback_grace: Duration::ZERO,
        feedback_messages: 2,
        feedback_bytes: 1000,
    };

    fn entry(id: &str, status: Status) -> StatusEntry {
        StatusEntry {
            id: id.to_owned(),
            code: status.code(),
            text: format!("{status:?}"),
        }
    }

    fn peer() -> Arc<Peer> {
        Arc::new(Peer {
            caller_id: "/server".to_owned(),
            header: ConnectionHeader::default(),
        })
    }

    /// Returns goals with a goal `g` sent at `start`, and a connected server.
    fn sent() -> (ClientGoals, Instant) {
        let start = clock::now();
        let mut goals = ClientGoals::new(LIMITS);
        for topic in [Source::Status, Source::Feedback, Source::Result] {
            goals.connection("/server", topic, true, start);
        }
        goals.sent("g".to_owned(), start, Arc::default());
        (goals, start)
    }

    fn status(goals: &mut ClientGoals, status: Status, now: Instant) {
        goals.status("/server", &[entry("g", status)], now);
    }

    fn states(goals: &mut ClientGoals) -> Vec<CommState> {
        let mut states = Vec::new();
        while let Some(event) = goals.next_event("g") {
            match event {
                GoalEvent::State(state) => states.push(state),
                GoalEvent::Done(_) => states.push(CommState::Done),
                GoalEvent::Lost(_) => states.push(CommState::Lost),
                GoalEvent::Feedback(_) | GoalEvent::FeedbackDropped(_) => {}
            }
        }
        states
    }

    fn lost(goals: &ClientGoals) -> Option<LostReason> {
        goals.goal("g")?.outcome.clone()?.err()
    }

    #[test]
    fn a_goal_goes_through_its_states_to_its_result() {
        let (mut goals, now) = sent();
        for step in [
            Status::Pending,
            Status::Active,
            Status::Active,
            Status::Succeeded,
        ] {
            status(&mut goals, step, now);
        }
        let body = Bytes::from_static(b"r");
        goals.result(&entry("g", Status::Succeeded), body, peer(), now);
        use CommState as C;
        assert_eq!(
            states(&mut goals),
            [C::Pending, C::Active, C::WaitingForResult, C::Done]
        );
        let result = goals.goal("g").unwrap().outcome.clone().unwrap().unwrap();
        assert_eq!(
            (result.status, &*result.body),
            (Status::Succeeded, b"r".as_slice())
        );
        assert_eq!(result.text, "Succeeded");
    }

    #[test]
    fn a_result_that_overtakes_its_status_passes_the_states_between() {
        let (mut goals, now) = sent();
        goals.result(&entry("g", Status::Preempted), Bytes::new(), peer(), now);
        status(&mut goals, Status::Preempted, now);
        use CommState as C;
        assert_eq!(
            states(&mut goals),
            [C::Active, C::Preempting, C::WaitingForResult, C::Done]
        );
    }

    #[test]
    fn what_comes_after_the_end_changes_nothing_and_is_counted() {
        let (mut goals, now) = sent();
        for end in [Status::Aborted, Status::Succeeded] {
            let body = Bytes::new();
            goals.feedback("g", Feedback { body, peer: peer() });
            goals.result(&entry("g", end), Bytes::new(), peer(), now);
        }
        assert_eq!(goals.goal("g").unwrap().status, Status::Aborted);
        let counted = (goals.counters.late_results, goals.counters.late_feedback);
        assert_eq!(counted, (1, 1));
    }

    #[test]
    fn feedback_that_its_result_overtakes_is_told_before_it() {
        let grace = Duration::from_millis(10);
        for lost in [false, true] {
            let (mut goals, now) = sent();
            goals.limits.feedback_grace = grace;
            status(&mut goals, Status::Active, now);
            goals.result(&entry("g", Status::Succeeded), Bytes::new(), peer(), now);
            let body = Bytes::from_static(b"f");
            goals.feedback("g", Feedback { body, peer: peer() });
            assert_eq!(goals.deadline(), Some(now + grace));
            goals.expire(now + grace - Duration::from_millis(1));
            assert!(goals.goal("g").unwrap().outcome.is_none());
            if lost {
                goals.lose("g", LostReason::NotAcknowledged(grace));
            } else {
                goals.expire(now + grace);
            }
            let events = std::iter::from_fn(|| goals.next_event("g"));
            let told: Vec<bool> = events
                .filter_map(|event| match event {
                    GoalEvent::Feedback(_) => Some(false),
                    GoalEvent::Done(_) => Some(true),
                    GoalEvent::State(_) | GoalEvent::FeedbackDropped(_) | GoalEvent::Lost(_) => {
                        None
                    }
                })
                .collect();
            assert_eq!(told, [false, true]);
        }
    }

    #[test]
    fn a_result_that_says_active_ends_the_goal_as_lost_with_its_body() {
        let (mut goals, now) = sent();
        goals.result(
            &entry("g", Status::Active),
            Bytes::from_static(b"r"),
            peer(),
            now,
        );
        let result = goals.goal("g").unwrap().outcome.clone().unwrap().unwrap();
        assert_eq!((result.status, result.body.len()), (Status::Lost, 1));
        assert_eq!(goals.counters.invalid_transitions, 1);
    }

    #[test]
    fn a_goal_that_no_server_lists_is_lost_after_its_time_and_not_before() {
        let (mut goals, start) = sent();
        goals.status("/server", &[], start + 4 * SECOND);
        assert_eq!(goals.deadline(), Some(start + 5 * SECOND));
        goals.expire(start + 5 * SECOND - Duration::from_millis(1));
        assert_eq!(lost(&goals), None);
        goals.expire(start + 5 * SECOND);
        assert_eq!(lost(&goals), Some(LostReason::NotAcknowledged(5 * SECOND)));
        assert_eq!(goals.deadline(), None);
    }

    #[test]
    fn a_goal_that_was_listed_and_is_missing_is_lost_at_once() {
        let (mut goals, now) = sent();
        status(&mut goals, Status::Active, now);
        goals.status("/other", &[], now);
        assert_eq!(lost(&goals), None);
        goals.status(
            "/server",
            &[entry("of another client", Status::Active)],
            now,
        );
        assert!(matches!(lost(&goals), Some(LostReason::Forgotten { .. })));
    }

    #[test]
    fn cancelling_before_the_first_status_does_not_lose_the_goal() {
        let (mut goals, now) = sent();
        assert!(goals.cancel("g"));
        goals.status("/server", &[], now);
        assert_eq!(lost(&goals), None);
        status(&mut goals, Status::Active, now);
        assert_eq!(
            goals.goal("g").unwrap().state,
            CommState::WaitingForCancelAck
        );
        status(&mut goals, Status::Preempting, now);
        assert!(!goals.cancel("g"), "the server knows");
    }

    #[test]
    fn a_silent_server_loses_its_goals_and_one_that_speaks_does_not() {
        let (mut goals, start) = sent();
        for second in 0..20 {
            status(&mut goals, Status::Active, start + second * SECOND);
            goals.expire(start + second * SECOND);
        }
        assert_eq!(lost(&goals), None);
        goals.expire(start + 24 * SECOND);
        assert!(
            matches!(lost(&goals), Some(LostReason::Silent { server, .. }) if server == "/server")
        );
    }

    #[test]
    fn a_connection_that_comes_back_in_time_loses_nothing() {
        let (mut goals, now) = sent();
        status(&mut goals, Status::Active, now);
        goals.connection("/server", Source::Status, false, now);
        assert_eq!(goals.deadline(), Some(now + SECOND));
        goals.connection("/server", Source::Status, true, now);
        goals.expire(now + SECOND);
        assert_eq!(lost(&goals), None);
        for topic in [Source::Status, Source::Feedback, Source::Result] {
            goals.connection("/server", topic, false, now);
        }
        goals.expire(now + SECOND);
        assert!(matches!(
            lost(&goals),
            Some(LostReason::Disconnected { .. })
        ));
        assert_eq!(goals.servers.len(), 0);
    }

    #[test]
    fn an_end_without_its_result_is_lost_even_when_the_server_forgets_the_goal() {
        let (mut goals, start) = sent();
        status(&mut goals, Status::Succeeded, start);
        for second in 0..5 {
            goals.status("/server", &[], start + second * SECOND);
        }
        goals.expire(start + 4 * SECOND);
        assert_eq!(lost(&goals), None);
        goals.expire(start + 5 * SECOND);
        let status = Status::Succeeded;
        let waited = 5 * SECOND;
        assert_eq!(lost(&goals), Some(LostReason::NoResult { status, waited }));
    }

    #[test]
    fn feedback_gives_way_to_newer_and_never_a_result_or_a_state() {
        let (mut goals, now) = sent();
        status(&mut goals, Status::Active, now);
        for n in 0..5u8 {
            let body = Bytes::from(vec![n]);
            goals.feedback("g", Feedback { body, peer: peer() });
        }
        goals.result(&entry("g", Status::Succeeded), Bytes::new(), peer(), now);
        let mut seen = Vec::new();
        while let Some(event) = goals.next_event("g") {
            seen.push(match event {
                GoalEvent::State(state) => format!("{state:?}"),
                GoalEvent::Feedback(feedback) => format!("{}", feedback.body[0]),
                GoalEvent::FeedbackDropped(lost) => format!("-{lost}"),
                GoalEvent::Done(_) => "Done".to_owned(),
                GoalEvent::Lost(_) => "Lost".to_owned(),
            });
        }
        assert_eq!(seen, ["-3", "Active", "3", "4", "WaitingForResult", "Done"]);
        assert_eq!(goals.counters.feedback_dropped, 3);
    }

    #[test]
    fn a_server_is_ready_with_all_three_topics_and_a_status() {
        let now = clock::now();
        let mut goals = ClientGoals::new(LIMITS);
        goals.connection("/server", Source::Status, true, now);
        assert!(goals.ready_server(now).unwrap_err().contains("status"));
        goals.status("/server", &[], now);
        assert!(goals.ready_server(now).unwrap_err().contains("feedback"));
        goals.connection("/server", Source::Feedback, true, now);
        goals.connection("/other", Source::Result, true, now);
        assert!(goals.ready_server(now).unwrap_err().contains("result"));
        goals.connection("/server", Source::Result, true, now);
        goals.status("/server", &[], now + STATUS_AFTER);
        assert_eq!(goals.ready_server(now + STATUS_AFTER), Ok("/server"));
    }

    #[test]
    fn a_server_is_not_ready_before_it_uses_its_connections() {
        let now = clock::now();
        let mut goals = ClientGoals::new(LIMITS);
        for topic in [Source::Status, Source::Feedback, Source::Result] {
            goals.connection("/server", topic, true, now);
        }
        // The latched status, which may have been sent before the other connections were made.
        goals.status("/server", &[], now);
        let soon = now + STATUS_AFTER;
        assert!(goals.ready_server(soon).unwrap_err().contains("status"));
        goals.status("/server", &[], soon);
        assert_eq!(goals.ready_server(soon), Ok("/server"));
        goals.connection("/server", Source::Result, false, soon);
        goals.connection("/server", Source::Result, true, soon);
        assert!(goals.ready_server(soon).unwrap_err().contains("status"));
        // A server that sends its status on change only.
        assert_eq!(goals.ready_server(soon + SETTLES_WITHIN), Ok("/server"));
    }

    /// Possible inputs, for a goal of this client or of another client.
    #[derive(Clone, Copy, Debug)]
    enum Input {
        Status(u8, bool),
        Result(u8, bool),
        Feedback,
        Cancel,
        Connection(bool),
        Wait(u64),
    }

    fn input() -> impl Strategy<Value = Input> {
        prop_oneof![
            (0u8..12, any::<bool>()).prop_map(|(code, ours)| Input::Status(code, ours)),
            (0u8..12, any::<bool>()).prop_map(|(code, ours)| Input::Result(code, ours)),
            Just(Input::Feedback),
            Just(Input::Cancel),
            any::<bool>().prop_map(Input::Connection),
            (0u64..3000).prop_map(Input::Wait),
        ]
    }

    fn feed(goals: &mut ClientGoals, input: Input, now: Instant) {
        let entry = |code, ours: bool| StatusEntry {
            id: if ours { "g" } else { "other" }.to_owned(),
            code,
            text: String::new(),
        };
        match input {
            Input::Status(code, ours) => goals.status("/server", &[entry(code, ours)], now),
            Input::Result(code, ours) => {
                goals.result(&entry(code, ours), Bytes::new(), peer(), now)
            }
            Input::Feedback => goals.feedback(
                "g",
                Feedback {
                    body: Bytes::from_static(b"f"),
                    peer: peer(),
                },
            ),
            Input::Cancel => drop(goals.cancel("g")),
            Input::Connection(made) => goals.connection("/server", Source::Status, made, now),
            Input::Wait(_) => {}
        }
    }

    proptest! {
        #[test]
        fn whatever_comes_a_goal_enters_each_state_once_and_ends_with_one_last_event(
            inputs in prop::collection::vec(input(), 0..60)
        ) {
            let (mut goals, mut now) = sent();
            for input in inputs {
                if let Input::Wait(millis) = input {
                    now += Duration::from_millis(millis);
                }
                feed(&mut goals, input, now);
                goals.expire(now);
                let queue = &goals.goal("g").unwrap().events;
                prop_assert!(queue.len() <= 7 + LIMITS.feedback_messages);
                let ended = goals.goal("g").unwrap().state.is_end();
                prop_assert_eq!(goals.deadline().is_none(), ended);
            }
            // Time alone ends the goal.
            goals.expire(now + 6 * SECOND);
            prop_assert!(goals.goal("g").unwrap().outcome.is_some());
            let states = states(&mut goals);
            let unique: std::collections::HashSet<_> = states.iter().collect();
            prop_assert_eq!(unique.len(), states.len());
            let ends = states.iter().filter(|state| state.is_end()).count();
            prop_assert_eq!(ends, 1);
            prop_assert!(states.last().unwrap().is_end());
        }
    }
}
