//! The action client: sends goals and follows the state of each goal.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use thiserror::Error;
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep_until, timeout};

use super::client_goals::{
    ActionlibClientCounters, ActionlibClientGoals, ActionlibGoalEvent, CommState, Feedback,
    GoalLimits, GoalLoss, GoalResult, ServerTopic,
};
use super::events::UnusableData;
use super::types::{
    ActionlibError, ActionlibGoalId, ClientType, GoalStatus, check_wrapper, goal_id_type,
    goal_status_array_type, wanted,
};
use super::wire;
use crate::clock;
use crate::inbox::{Inbox, InboxEvent, InboxMessage};
use crate::node::{Node, NodeError};
use crate::outbox::lock;
use crate::publisher::{Publisher, PublisherOptions};
use crate::subscription::{SubscriberOptions, Subscription};
use crate::time::Ros1Clock;
use crate::time::Ros1Time;

/// Time limits, in steady time, and queue sizes of an [`ActionlibClient`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionlibClientOptions {
    /// Limit from sending a goal until a server must have listed it.
    pub acknowledge_timeout: Duration,
    /// Limit without a status of the server, after which its goals are lost. Servers send five
    /// statuses a second; roscpp and rospy servers do so by ROS time. If a simulation may pause,
    /// set this limit to the longest pause.
    pub silence_timeout: Duration,
    /// Limit from the end of the connection to the server until its goals are lost. Goals survive
    /// if the server reconnects sooner.
    pub reconnect_timeout: Duration,
    /// Limit from the status that a goal has ended until its result must have been received.
    pub result_timeout: Duration,
    /// Delay between receiving a result and reporting it. Feedback that was sent before the result
    /// uses another connection and may be received after the result.
    pub feedback_grace: Duration,
    /// Maximum number of queued feedback messages per goal; beyond it the oldest are dropped.
    pub feedback_messages: usize,
    /// Maximum number of queued feedback bytes per goal; beyond it the oldest messages are dropped.
    /// The newest message is always kept.
    pub feedback_bytes: usize,
}

impl Default for ActionlibClientOptions {
    /// Returns limits of five seconds, except 1 second for a lost connection and 10 ms for
    /// overtaken feedback. Queues hold 100 feedback messages and 16 MiB.
    fn default() -> Self {
        let five = Duration::from_secs(5);
        Self {
            acknowledge_timeout: five,
            silence_timeout: five,
            reconnect_timeout: Duration::from_secs(1),
            result_timeout: five,
            feedback_grace: Duration::from_millis(10),
            feedback_messages: 100,
            feedback_bytes: 16 * 1024 * 1024,
        }
    }
}

/// Sends goals to the server of an action. Dropping the client ends its goals as lost; it does not
/// cancel them.
#[derive(Debug)]
pub struct ActionlibClient {
    shared: Arc<Shared>,
    task: AbortHandle,
    _subscriptions: [Subscription; 3],
}

impl ActionlibClient {
    /// Opens the topics of the action. The server may start later, stop and restart.
    ///
    /// `name` is the name of the action, such as `arm/move`; it is resolved like the name of a
    /// topic. Must be called inside the runtime of the node.
    ///
    /// # Errors
    /// Fails if the name is not a valid ROS name, if this node already has a client of the action,
    /// or if the type of the goal is incomplete or not an `ActionGoal`.
    pub fn new(
        node: &Node,
        name: &str,
        action: impl Into<ClientType>,
        options: ActionlibClientOptions,
    ) -> Result<Self, ActionlibError> {
        let action = action.into();
        check_wrapper(&action.goal.name, "ActionGoal")?;
        let name = node.resolve(name).map_err(NodeError::from)?;
        let inbox = Inbox::new();
        let subscribe = |topic, wanted, source| {
            let queues = SubscriberOptions {
                // The result of a goal is sent once.
                keep_cut_off: topic == "result",
                ..SubscriberOptions::default()
            };
            node.subscribe(&format!("{name}/{topic}"), wanted, queues, source, &inbox)
        };
        let status = wanted(goal_status_array_type());
        let subscriptions = [
            subscribe("status", status, ServerTopic::Status)?,
            subscribe("feedback", action.feedback, ServerTopic::Feedback)?,
            subscribe("result", action.result, ServerTopic::Result)?,
        ];
        let advertise = |topic, topic_type| {
            let options = PublisherOptions {
                // A late cancel request stops what it would have stopped before.
                keep_cut_off: topic == "cancel",
                ..PublisherOptions::default()
            };
            node.advertise(&format!("{name}/{topic}"), topic_type, options)
        };
        let outputs = Outputs {
            goal: advertise("goal", action.goal)?,
            cancel: advertise("cancel", goal_id_type())?,
            seq: 0,
        };
        let state = State {
            goals: ActionlibClientGoals::new(limits(&options)),
            outputs: Some(outputs),
            faults: UnusableData::new(),
        };
        let shared = Arc::new(Shared {
            name,
            node: node.name().to_owned(),
            clock: node.clock(),
            state: Mutex::new(state),
            deadline_moved: Notify::new(),
        });
        let task = tokio::spawn(run(Arc::clone(&shared), inbox)).abort_handle();
        Ok(Self {
            shared,
            task,
            _subscriptions: subscriptions,
        })
    }

    /// Sends a goal, the serialized `XGoal`. Never waits and never fails: a goal without any
    /// subscriber is lost at once, see [`GoalLoss::NoServer`]. To send a goal to a server that is
    /// starting, wait for the server first.
    pub fn send_goal(&self, body: &[u8]) -> ActionlibGoal {
        let goal_id = self.shared.new_id();
        self.send(lock(&self.shared.state), goal_id, body)
    }

    /// Sends a goal as [`Self::send_goal`] does, with an id chosen by the caller and with the stamp
    /// 0. The id must be unique among all past and present goals of the action. A server then
    /// stamps the goal by its own clock, as actionlib does. A `SimpleActionServer` rejects a goal
    /// with an earlier stamp than the last goal, and the clocks of two hosts differ.
    ///
    /// # Errors
    /// [`GoalIdInUse`] while a handle of a goal with that id exists; then nothing is sent.
    pub fn send_goal_as(&self, id: String, body: &[u8]) -> Result<ActionlibGoal, GoalIdInUse> {
        let state = lock(&self.shared.state);
        if state.goals.goal(&id).is_some() {
            return Err(GoalIdInUse { id });
        }
        let stamp = Ros1Time::default();
        Ok(self.send(state, ActionlibGoalId { stamp, id }, body))
    }

    fn send(
        &self,
        mut state: MutexGuard<'_, State>,
        goal_id: ActionlibGoalId,
        body: &[u8],
    ) -> ActionlibGoal {
        let wake = Arc::new(Notify::new());
        let id = goal_id.id.clone();
        state
            .goals
            .sent(id.clone(), clock::now(), Arc::clone(&wake));
        let sent_to = state.outputs.as_mut().map_or(0, |outputs| {
            outputs.seq = outputs.seq.wrapping_add(1);
            let now = self.shared.clock.now();
            let message = wire::goal(outputs.seq, now, &goal_id, body);
            outputs.goal.publish(message).sent_to
        });
        if sent_to == 0 {
            let topic = format!("{}/goal", self.shared.name);
            state.goals.lose(&id, GoalLoss::NoServer { topic });
        }
        drop(state);
        self.shared.deadline_moved.notify_one();
        ActionlibGoal {
            shared: Arc::clone(&self.shared),
            goal_id,
            wake,
        }
    }

    /// Requests the server to cancel a goal, as [`ActionlibGoal::cancel`] does.
    pub fn cancel_goal(&self, id: &str) -> CancelSent {
        let mut state = lock(&self.shared.state);
        let Some(goal) = state.goals.goal(id) else {
            return CancelSent::NotFollowed;
        };
        match goal.state {
            CommState::WaitingForResult | CommState::Done | CommState::Lost => CancelSent::Ended,
            CommState::Recalling | CommState::Preempting => CancelSent::Asked,
            CommState::WaitingForGoalAck
            | CommState::Pending
            | CommState::Active
            | CommState::WaitingForCancelAck => {
                let _wanted = state.goals.cancel(id);
                drop(state);
                let request = ActionlibGoalId {
                    stamp: Ros1Time::default(),
                    id: id.to_owned(),
                };
                match self.shared.send_cancel(&request) {
                    0 => CancelSent::NoServer,
                    _ => CancelSent::Asked,
                }
            }
        }
    }

    /// Returns the ids of the goals that have a handle and have not ended.
    pub fn open_goals(&self) -> Vec<String> {
        lock(&self.shared.state).goals.open()
    }

    /// Requests the server to cancel all goals of the action, including the goals of other clients.
    /// Returns the number of nodes that the request was sent to. The goals report the outcome.
    pub fn cancel_all(&self) -> usize {
        self.shared.send_cancel(&ActionlibGoalId::default())
    }

    /// Requests the server to cancel all goals with a stamp of `time` or earlier, including the
    /// goals of other clients. Stamps are by the clocks of the clients. The server also recalls
    /// later goals with such a stamp. Returns the number of nodes that the request was sent to.
    ///
    /// The time zero stands for all goals, as with [`Self::cancel_all`].
    pub fn cancel_before(&self, time: Ros1Time) -> usize {
        self.shared.send_cancel(&ActionlibGoalId {
            stamp: time,
            id: String::new(),
        })
    }

    /// Returns the node that serves the action. A server is ready when it publishes feedback and
    /// results, its status came after both connections were made, and it subscribes to goals and
    /// cancel requests.
    pub fn server(&self) -> Result<String, NoActionlibServer> {
        let state = lock(&self.shared.state);
        let missing = |reason| NoActionlibServer {
            action: self.shared.name.clone(),
            reason,
        };
        let server = state.goals.ready_server(clock::now()).map_err(missing)?;
        let takes = |topic: fn(&Outputs) -> &Publisher| {
            let outputs = state.outputs.as_ref();
            outputs.is_some_and(|outputs| topic(outputs).is_subscribed_by(server))
        };
        if !takes(|outputs| &outputs.goal) {
            Err(missing(
                "the server has not connected to the goal topic, or uses another goal type",
            ))
        } else if !takes(|outputs| &outputs.cancel) {
            Err(missing("the server has not connected to the cancel topic"))
        } else {
            Ok(server.to_owned())
        }
    }

    /// Waits until [`Self::server`] succeeds. Cancel-safe.
    ///
    /// # Errors
    /// Fails with the missing part if no server is ready within `limit`.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<String, NoActionlibServer> {
        let found = async {
            loop {
                if let Ok(server) = self.server() {
                    return server;
                }
                // Publishers do not report their subscribers.
                tokio::time::sleep(SERVER_POLL).await;
            }
        };
        match timeout(limit, found).await {
            Ok(server) => Ok(server),
            Err(_) => self.server(),
        }
    }

    /// Returns the resolved name of the action.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// Returns the counts of received data that could not be used.
    pub fn counters(&self) -> ActionlibClientCounters {
        lock(&self.shared.state).goals.counters
    }
}

impl Drop for ActionlibClient {
    fn drop(&mut self) {
        self.task.abort();
        let mut state = lock(&self.shared.state);
        state.goals.lose_all(&GoalLoss::ClientClosed);
        let outputs = state.outputs.take();
        drop(state);
        drop(outputs);
    }
}

/// Outcome of a request to cancel a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CancelSent {
    /// The request was sent, or the server already knows of a request. The goal reports the
    /// outcome.
    Asked,
    /// The goal has ended.
    Ended,
    /// No node subscribes to cancel requests.
    NoServer,
    /// No goal with that id has a handle.
    NotFollowed,
}

/// A goal with that id has a handle already.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("a goal `{id}` already exists")]
pub struct GoalIdInUse {
    id: String,
}

/// No server is ready to receive goals.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("no server of the action {action}: {reason}")]
pub struct NoActionlibServer {
    action: String,
    reason: &'static str,
}

/// A goal that was sent. Dropping the handle ends the events of the goal; it does not cancel the
/// goal.
#[derive(Debug)]
pub struct ActionlibGoal {
    shared: Arc<Shared>,
    goal_id: ActionlibGoalId,
    wake: Arc<Notify>,
}

impl ActionlibGoal {
    /// Returns the id of the goal and the time it was sent. Generated ids have the form
    /// `<node>-<count>-<seconds>.<nanoseconds>`. A goal with an id of the caller has the time 0.
    pub fn goal_id(&self) -> &ActionlibGoalId {
        &self.goal_id
    }

    /// Returns the state of the goal.
    pub fn state(&self) -> CommState {
        let state = lock(&self.shared.state);
        let goal = state.goals.goal(&self.goal_id.id);
        goal.map_or(CommState::Lost, |goal| goal.state)
    }

    /// Returns the last status from the server: pending before the first status, lost if the goal
    /// is lost.
    pub fn status(&self) -> GoalStatus {
        let state = lock(&self.shared.state);
        let goal = state.goals.goal(&self.goal_id.id);
        GoalStatus {
            goal_id: self.goal_id.clone(),
            status: goal.map_or(super::ActionlibStatus::Lost, |goal| goal.status),
            text: goal.map(|goal| goal.text.clone()).unwrap_or_default(),
        }
    }

    /// Returns the next event in order, or `None` after the last event. The last event always
    /// arrives within the time limits of the client after its server has stopped sending.
    /// Cancel-safe.
    pub async fn recv(&mut self) -> Option<ActionlibGoalEvent> {
        loop {
            let rung = self.wake.notified();
            {
                let mut state = lock(&self.shared.state);
                let event = state.goals.next_event(&self.goal_id.id);
                if event.is_some() {
                    return event;
                }
                let goal = state.goals.goal(&self.goal_id.id);
                if goal.is_none_or(|goal| goal.outcome.is_some()) {
                    return None;
                }
            }
            rung.await;
        }
    }

    /// Waits for the end of the goal and discards all other events. May be called again.
    /// Cancel-safe.
    pub async fn outcome(&mut self) -> Result<GoalResult, GoalLoss> {
        while self.recv().await.is_some() {}
        let state = lock(&self.shared.state);
        let goal = state.goals.goal(&self.goal_id.id);
        goal.and_then(|goal| goal.outcome.clone())
            .unwrap_or(Err(GoalLoss::ClientClosed))
    }

    /// Requests the server to cancel the goal. The goal continues until the server reports the
    /// outcome, which may be success. Returns false if the request was not sent: the goal has
    /// ended, its server already knows, or no server is connected.
    pub fn cancel(&self) -> bool {
        let wanted = lock(&self.shared.state).goals.cancel(&self.goal_id.id);
        wanted
            && self.shared.send_cancel(&ActionlibGoalId {
                stamp: Ros1Time::default(),
                id: self.goal_id.id.clone(),
            }) > 0
    }
}

impl Drop for ActionlibGoal {
    fn drop(&mut self) {
        lock(&self.shared.state).goals.forget(&self.goal_id.id);
    }
}

/// State shared by the client, its task and its goals.
#[derive(Debug)]
struct Shared {
    name: String,
    node: String,
    clock: Ros1Clock,
    state: Mutex<State>,
    deadline_moved: Notify,
}

#[derive(Debug)]
struct State {
    goals: ActionlibClientGoals,
    /// `None` once the client is dropped.
    outputs: Option<Outputs>,
    faults: UnusableData,
}

#[derive(Debug)]
struct Outputs {
    goal: Publisher,
    cancel: Publisher,
    seq: u32,
}

impl Shared {
    fn new_id(&self) -> ActionlibGoalId {
        // Shared by all clients of the process: two clients of a node must not create the same
        // id.
        static COUNT: AtomicU64 = AtomicU64::new(1);
        let stamp = self.clock.now();
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let id = format!("{}-{count}-{}.{:09}", self.node, stamp.secs, stamp.nsecs);
        ActionlibGoalId { stamp, id }
    }

    fn send_cancel(&self, id: &ActionlibGoalId) -> usize {
        let state = lock(&self.state);
        let outputs = state.outputs.as_ref();
        outputs.map_or(0, |outputs| {
            outputs.cancel.publish(wire::cancel(id)).sent_to
        })
    }

    fn take(&self, source: ServerTopic, event: InboxEvent) {
        let now = clock::now();
        let mut guard = lock(&self.state);
        let state = &mut *guard;
        match event {
            InboxEvent::Message(message) => {
                if let Err(error) = state.message(source, &message, now) {
                    state.goals.counters.malformed += 1;
                    let topic = message.peer.header.get("topic").unwrap_or(&self.name);
                    state
                        .faults
                        .malformed(topic, &message.peer.caller_id, &error);
                }
            }
            InboxEvent::Peer {
                connected, peer, ..
            } => state
                .goals
                .connection(&peer.caller_id, source, connected, now),
            InboxEvent::Dropped(lost) => {
                state.goals.counters.overrun += lost;
                state.faults.overrun(&self.name, lost);
            }
        }
    }
}

impl State {
    fn message(
        &mut self,
        source: ServerTopic,
        message: &InboxMessage,
        now: Instant,
    ) -> Result<(), wire::MalformedAction> {
        let peer = || Arc::clone(&message.peer);
        match source {
            ServerTopic::Status => {
                let list = wire::read_status_array(&message.bytes)?;
                self.goals.status(&message.peer.caller_id, &list, now);
            }
            ServerTopic::Feedback => {
                let (status, body) = wire::read_reply(&message.bytes)?;
                let feedback = Feedback { body, peer: peer() };
                self.goals.feedback(&status.id, feedback);
            }
            ServerTopic::Result => {
                let (status, body) = wire::read_reply(&message.bytes)?;
                self.goals.result(&status, body, peer(), now);
            }
        }
        Ok(())
    }
}

/// Receives the messages of the server and ends goals after their time limits, until aborted.
async fn run(shared: Arc<Shared>, mut inbox: Inbox<ServerTopic>) {
    loop {
        let deadline = lock(&shared.state).goals.deadline();
        let due = async {
            match deadline {
                Some(at) => sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            (source, event) = inbox.recv() => shared.take(source, event),
            () = shared.deadline_moved.notified() => {}
            () = due => {}
        }
        let mut taken = 0;
        while let Some((source, event)) = inbox.try_recv() {
            shared.take(source, event);
            taken += 1;
            if taken == BATCH {
                break;
            }
        }
        // Time limits are checked only when no message waits to be read.
        if taken < BATCH {
            lock(&shared.state).goals.expire(clock::now());
        } else {
            tokio::task::yield_now().await;
        }
    }
}

const fn limits(options: &ActionlibClientOptions) -> GoalLimits {
    GoalLimits {
        acknowledge: options.acknowledge_timeout,
        silence: options.silence_timeout,
        reconnect: options.reconnect_timeout,
        result: options.result_timeout,
        feedback_grace: options.feedback_grace,
        feedback_messages: options.feedback_messages,
        feedback_bytes: options.feedback_bytes,
    }
}

const SERVER_POLL: Duration = Duration::from_millis(20);
const BATCH: usize = 256;
