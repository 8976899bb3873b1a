//! The action server: receives goals and cancel requests, and publishes the state of the goals.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{Notify, watch};
use tokio::task::AbortHandle;
use tokio::time::sleep_until;

use super::events::UnusableData;
use super::server_goals::{
    ActionlibGoalError, ActionlibServerCounters, ActionlibServerGoals, Decision, GoalArrival,
    GoalKey,
};
use super::types::{
    ActionlibError, ActionlibGoalId, ActionlibStatus, ActionlibTypes, GoalStatus, check_wrapper,
    goal_id_type, goal_status_array_type, wanted,
};
use super::wire;
use crate::clock;
use crate::inbox::{Inbox, InboxEvent, InboxMessage};
use crate::node::{Node, NodeError};
use crate::outbox::lock;
use crate::publisher::{Publisher, PublisherOptions};
use crate::subscription::{SubscriberOptions, Subscription};
use crate::time::Ros1Clock;

/// Reporting periods, in steady time, and capacity of an [`ActionlibServer`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionlibServerOptions {
    /// The serialized `XResult` without content, for goals that end without a result of the user:
    /// recalled before they arrive, rejected, or dropped. Clients have to be able to decode it.
    pub empty_result: Bytes,
    /// Period between two statuses when nothing happens. Clients treat a server without a status
    /// for five seconds as lost.
    pub status_period: Duration,
    /// Time for which an ended goal stays in the status.
    pub status_list_timeout: Duration,
    /// Maximum number of goals in the status. When it is full, ended goals leave it early; when all
    /// goals are open, new goals are rejected.
    pub max_goals: usize,
}

impl ActionlibServerOptions {
    /// Returns options with five statuses a second, ended goals kept for five seconds, and 1000
    /// goals.
    pub const fn new(empty_result: Bytes) -> Self {
        Self {
            empty_result,
            status_period: Duration::from_millis(200),
            status_list_timeout: Duration::from_secs(5),
            max_goals: 1000,
        }
    }
}

/// Request of a client to a server.
#[derive(Debug)]
pub enum ActionlibServerEvent {
    /// A new goal, to be accepted or rejected.
    Goal(ActionlibServerGoal),
    /// A client requests to cancel the open goal with this id. The server decides.
    Cancel(ActionlibGoalId),
}

/// Receives the goals of an action. Dropping the server aborts the goals that have not ended.
#[derive(Debug)]
pub struct ActionlibServer {
    shared: Arc<Shared>,
    task: AbortHandle,
    _subscriptions: [Subscription; 2],
}

impl ActionlibServer {
    /// Opens the topics of the action and starts to publish its status.
    ///
    /// `name` is the name of the action, such as `arm/move`; it is resolved like the name of a
    /// topic. Must be called inside the runtime of the node.
    ///
    /// # Errors
    /// Fails if the name is not a valid ROS name, if this node serves the action already, or if a
    /// type is incomplete or is not the wrapper message with goal id or status.
    pub fn new(
        node: &Node,
        name: &str,
        action: ActionlibTypes,
        options: ActionlibServerOptions,
    ) -> Result<Self, ActionlibError> {
        check_wrapper(&action.goal.name, "ActionGoal")?;
        check_wrapper(&action.result.name, "ActionResult")?;
        check_wrapper(&action.feedback.name, "ActionFeedback")?;
        let name = node.resolve(name).map_err(NodeError::from)?;
        let advertise = |topic, topic_type, latch| {
            let options = PublisherOptions {
                latch,
                // A client waits for the result of its goal without end.
                keep_cut_off: topic == "result",
                ..PublisherOptions::default()
            };
            node.advertise(&format!("{name}/{topic}"), topic_type, options)
        };
        let outputs = Outputs {
            status: advertise("status", goal_status_array_type(), true)?,
            feedback: advertise("feedback", action.feedback, false)?,
            result: advertise("result", action.result, false)?,
            empty_result: options.empty_result,
            seq: 0,
        };
        let inbox = Inbox::new();
        let subscribe = |topic, wanted, source| {
            let queues = SubscriberOptions {
                // A late request to cancel stops what it would have stopped before.
                keep_cut_off: topic == "cancel",
                ..SubscriberOptions::default()
            };
            node.subscribe(&format!("{name}/{topic}"), wanted, queues, source, &inbox)
        };
        let subscriptions = [
            subscribe("goal", wanted(action.goal), Source::Goal)?,
            subscribe("cancel", wanted(goal_id_type()), Source::Cancel)?,
        ];
        let state = State {
            goals: ActionlibServerGoals::new(options.max_goals, options.status_list_timeout),
            outputs: Some(outputs),
            arrived: VecDeque::new(),
            faults: UnusableData::new(),
        };
        let shared = Arc::new(Shared {
            name,
            node: node.name().to_owned(),
            clock: node.clock(),
            state: Mutex::new(state),
            arrival: Notify::new(),
            changed: watch::Sender::new(()),
        });
        let period = options.status_period.max(SHORTEST_PERIOD);
        let task = tokio::spawn(run(Arc::clone(&shared), inbox, period)).abort_handle();
        Ok(Self {
            shared,
            task,
            _subscriptions: subscriptions,
        })
    }

    /// Waits for the next event. Cancel-safe. The queue holds at most twice as many events as there
    /// are open goals.
    pub async fn recv(&mut self) -> ActionlibServerEvent {
        loop {
            if let Some(event) = self.try_recv() {
                return event;
            }
            self.shared.arrival.notified().await;
        }
    }

    /// Returns the next event if an event is queued.
    pub fn try_recv(&mut self) -> Option<ActionlibServerEvent> {
        let mut state = lock(&self.shared.state);
        loop {
            match state.arrived.pop_front()? {
                Arrived::Goal(key, goal_id, body) => {
                    return Some(ActionlibServerEvent::Goal(ActionlibServerGoal {
                        shared: Arc::clone(&self.shared),
                        key,
                        goal_id,
                        body,
                    }));
                }
                Arrived::Cancel(key) => {
                    let status = state.goals.status(key);
                    // The goal may have ended in the meantime.
                    if let Some(status) = status.filter(|status| !status.status.is_terminal()) {
                        return Some(ActionlibServerEvent::Cancel(status.goal_id.clone()));
                    }
                }
            }
        }
    }

    /// Returns the resolved name of the action.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// Returns the counts of received data that could not be used.
    pub fn counters(&self) -> ActionlibServerCounters {
        lock(&self.shared.state).goals.counters
    }
}

impl Drop for ActionlibServer {
    fn drop(&mut self) {
        self.task.abort();
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        for key in state.goals.open() {
            if let Some(status) = state.goals.abandon(key, SERVER_CLOSED, clock::now()) {
                self.shared.publish_result(state, &status, None);
            }
        }
        let left = (state.outputs.take(), std::mem::take(&mut state.arrived));
        drop(guard);
        drop(left);
        self.shared.changed.send_replace(());
    }
}

/// A goal to decide about. Decisions are published at once and never wait. A goal that is dropped
/// before its end is aborted.
#[derive(Debug)]
pub struct ActionlibServerGoal {
    shared: Arc<Shared>,
    key: GoalKey,
    goal_id: ActionlibGoalId,
    body: Bytes,
}

impl ActionlibServerGoal {
    /// Returns the id of the goal and the time of the request, by the clock of its client.
    pub const fn goal_id(&self) -> &ActionlibGoalId {
        &self.goal_id
    }

    /// Returns the serialized `XGoal`.
    pub const fn body(&self) -> &Bytes {
        &self.body
    }

    /// Returns the status of the goal: `Lost` if the goal has ended and left the status of the
    /// server.
    pub fn status(&self) -> ActionlibStatus {
        let state = lock(&self.shared.state);
        let status = state.goals.status(self.key);
        status.map_or(ActionlibStatus::Lost, |status| status.status)
    }

    /// Starts work: changes pending to active, and recalling to preempting.
    pub fn accept(&self, text: &str) -> Result<(), ActionlibGoalError> {
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        state.open()?;
        state
            .goals
            .decide(self.key, Decision::Accept, text, clock::now())?;
        self.shared.publish_status(state);
        drop(guard);
        self.shared.changed.send_replace(());
        Ok(())
    }

    /// Ends a goal that was not accepted, with the empty result.
    pub fn reject(&self, text: &str) -> Result<(), ActionlibGoalError> {
        self.end(Decision::Reject, None, text)
    }

    /// Ends an accepted goal that was reached, with the serialized `XResult`.
    pub fn succeed(&self, result: &[u8], text: &str) -> Result<(), ActionlibGoalError> {
        self.end(Decision::Succeed, Some(result), text)
    }

    /// Ends an accepted goal that failed, with the serialized `XResult` or, for `None`, the empty
    /// result.
    pub fn abort(&self, result: Option<&[u8]>, text: &str) -> Result<(), ActionlibGoalError> {
        self.end(Decision::Abort, result, text)
    }

    /// Ends a goal as cancelled, requested or not, with the serialized `XResult` or, for `None`,
    /// the empty result. An accepted goal ends as preempted, any other goal as recalled.
    pub fn cancelled(&self, result: Option<&[u8]>, text: &str) -> Result<(), ActionlibGoalError> {
        self.end(Decision::Cancelled, result, text)
    }

    /// Reports progress, the serialized `XFeedback`. Fails once the goal has ended.
    pub fn feedback(&self, body: &[u8]) -> Result<(), ActionlibGoalError> {
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        let outputs = state.outputs.as_mut().ok_or(ActionlibGoalError::Closed)?;
        let status = state
            .goals
            .status(self.key)
            .ok_or(ActionlibGoalError::Forgotten)?;
        if status.status.is_terminal() {
            return Err(ActionlibGoalError::NotFrom {
                goal: self.goal_id.id.clone(),
                from: status.status,
                wanted: "given feedback",
            });
        }
        let seq = outputs.next_seq();
        let message = wire::reply(seq, self.shared.clock.now(), status, body);
        send(&outputs.feedback, message);
        Ok(())
    }

    /// Returns whether a client requested to cancel the goal and the goal has not ended.
    pub fn is_cancel_requested(&self) -> bool {
        matches!(
            self.status(),
            ActionlibStatus::Recalling | ActionlibStatus::Preempting
        )
    }

    /// Waits until a client requests to cancel the goal, or the goal has ended. Cancel-safe.
    pub async fn cancel_requested(&self) {
        let mut changed = self.shared.changed.subscribe();
        while !self.is_cancel_requested() && !self.status().is_terminal() {
            // The sender lives as long as this goal.
            if changed.changed().await.is_err() {
                return;
            }
        }
    }

    fn end(
        &self,
        decision: Decision,
        result: Option<&[u8]>,
        text: &str,
    ) -> Result<(), ActionlibGoalError> {
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        state.open()?;
        let status = state.goals.decide(self.key, decision, text, clock::now())?;
        self.shared.publish_result(state, &status, result);
        drop(guard);
        self.shared.changed.send_replace(());
        Ok(())
    }
}

impl Drop for ActionlibServerGoal {
    fn drop(&mut self) {
        let mut guard = lock(&self.shared.state);
        let state = &mut *guard;
        let ended = state.goals.abandon(self.key, DROPPED, clock::now());
        if let Some(status) = ended {
            self.shared.publish_result(state, &status, None);
        }
    }
}

/// A topic that clients publish.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Goal,
    Cancel,
}

/// State shared by the server, its task and its goals.
#[derive(Debug)]
struct Shared {
    name: String,
    node: String,
    clock: Ros1Clock,
    state: Mutex<State>,
    /// Notifies [`ActionlibServer::recv`].
    arrival: Notify,
    /// Notifies all goals that a goal has changed.
    changed: watch::Sender<()>,
}

#[derive(Debug)]
struct State {
    goals: ActionlibServerGoals,
    /// `None` once the server is dropped.
    outputs: Option<Outputs>,
    arrived: VecDeque<Arrived>,
    faults: UnusableData,
}

#[derive(Debug)]
enum Arrived {
    Goal(GoalKey, ActionlibGoalId, Bytes),
    Cancel(GoalKey),
}

#[derive(Debug)]
struct Outputs {
    status: Publisher,
    feedback: Publisher,
    result: Publisher,
    empty_result: Bytes,
    seq: u32,
}

impl Outputs {
    const fn next_seq(&mut self) -> u32 {
        self.seq = self.seq.wrapping_add(1);
        self.seq
    }
}

impl State {
    const fn open(&self) -> Result<(), ActionlibGoalError> {
        match self.outputs {
            Some(_) => Ok(()),
            None => Err(ActionlibGoalError::Closed),
        }
    }
}

impl Shared {
    /// Returns an id and a stamp for a goal that was received without them.
    fn new_id(&self) -> ActionlibGoalId {
        static COUNT: AtomicU64 = AtomicU64::new(1);
        let stamp = self.clock.now();
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let id = format!("{}-{count}-{}.{:09}", self.node, stamp.secs, stamp.nsecs);
        ActionlibGoalId { stamp, id }
    }

    fn take(&self, source: Source, event: InboxEvent) {
        let mut guard = lock(&self.state);
        let state = &mut *guard;
        match event {
            InboxEvent::Message(message) => {
                let read = match source {
                    Source::Goal => self.goal(state, &message),
                    Source::Cancel => self.cancel(state, &message),
                };
                if let Err(error) = read {
                    state.goals.counters.malformed += 1;
                    let topic = message.peer.header.get("topic").unwrap_or(&self.name);
                    state
                        .faults
                        .malformed(topic, &message.peer.caller_id, &error);
                }
            }
            InboxEvent::Peer { .. } => {}
            InboxEvent::Dropped(lost) => {
                state.goals.counters.overrun += lost;
                state.faults.overrun(&self.name, lost);
            }
        }
    }

    fn goal(&self, state: &mut State, message: &InboxMessage) -> Result<(), wire::MalformedAction> {
        let (id, body) = wire::read_goal(&message.bytes)?;
        let refused = state.goals.counters.refused;
        match state.goals.goal(id, self.new_id(), clock::now()) {
            GoalArrival::New(key, id) => {
                state.arrived.push_back(Arrived::Goal(key, id, body));
                self.arrival.notify_one();
                self.publish_status(state);
            }
            GoalArrival::Ended(status) => {
                if state.goals.counters.refused > refused {
                    state.faults.full(&status.goal_id.id);
                }
                self.publish_result(state, &status, None);
            }
            GoalArrival::Known => {}
        }
        Ok(())
    }

    fn cancel(
        &self,
        state: &mut State,
        message: &InboxMessage,
    ) -> Result<(), wire::MalformedAction> {
        let request = wire::read_cancel(&message.bytes)?;
        let refused = state.goals.counters.refused;
        let told = state.goals.cancel(&request, clock::now());
        if state.goals.counters.refused > refused {
            state.faults.full(&request.id);
        }
        if !told.is_empty() {
            state.arrived.extend(told.into_iter().map(Arrived::Cancel));
            self.arrival.notify_one();
            self.changed.send_replace(());
            self.publish_status(state);
        }
        Ok(())
    }

    /// Publishes the result before the status, so that a client that reads the end in the status
    /// can expect the result.
    fn publish_result(&self, state: &mut State, status: &GoalStatus, result: Option<&[u8]>) {
        if let Some(outputs) = &mut state.outputs {
            let seq = outputs.next_seq();
            let result = result.unwrap_or(&outputs.empty_result);
            let message = wire::reply(seq, self.clock.now(), status, result);
            send(&outputs.result, message);
            self.publish_status(state);
        }
    }

    fn publish_status(&self, state: &mut State) {
        if let Some(outputs) = &mut state.outputs {
            let list = state.goals.list(clock::now());
            let message = wire::status_array(outputs.next_seq(), self.clock.now(), list);
            send(&outputs.status, message);
        }
    }
}

/// Receives goals and cancel requests, and publishes the status, until aborted.
async fn run(shared: Arc<Shared>, mut inbox: Inbox<Source>, period: Duration) {
    let mut next = clock::now();
    loop {
        tokio::select! {
            // The status is first, so that a flood of goals does not delay it.
            biased;
            () = sleep_until(next) => {
                shared.publish_status(&mut lock(&shared.state));
                next = clock::after(clock::now(), period);
            }
            (source, event) = inbox.recv() => shared.take(source, event),
        }
    }
}

/// Publishes a message. Publishers count the losses of slow subscribers themselves.
fn send(publisher: &Publisher, message: Bytes) {
    let _published = publisher.publish(message);
}

const SHORTEST_PERIOD: Duration = Duration::from_millis(1);
const DROPPED: &str = "the server abandoned the goal without a result";
const SERVER_CLOSED: &str = "the server was stopped";
