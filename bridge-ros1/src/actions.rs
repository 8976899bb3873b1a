//! Actions of the ROS 1 graph (actionlib): sends goals of other spaces to action servers of the
//! graph, and offers action servers for actions of other spaces.
//!
//! actionlib identifies a goal by a text, the space by 16 bytes. A goal of the space has the
//! hexadecimal digits of its bytes as its text. A goal of the graph with any other text has the MD5
//! sum of the text as its bytes. actionlib has no response to a goal: a goal counts as accepted
//! once its server lists it as active.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use bridge_node::actions::{
    ActionGraph, GraphActionClient, GraphActionServer, GraphCancelRequest, GraphCancelResponse,
    GraphCancelSelection, GraphGoalEvent, GraphGoalId, GraphNewGoal, GraphServerEvent, SentGoal,
    ServedGoal, Waits,
};
use bridge_node::{CallFault, GraphError, MayHaveRun};
use bytes::Bytes;
use md5::{Digest, Md5};
use messages::{
    ActionCalls, ActionType, DefinitionError, MessagePlan, MessageType, NoFields, Selection,
    TextKind, TypeName, Wire,
};
use tcpros::TopicType;
use tcpros::actionlib::{
    ActionlibClientOptions, ActionlibGoal, ActionlibServerGoal, ActionlibServerOptions,
    ActionlibStatus, CancelSent, CommState, GoalLoss, GoalResult,
};
use tokio::sync::Mutex;
use tokio::time::{Instant, timeout_at};
use tracing::warn;

use crate::definitions::Ros1Definitions;
use crate::ends::{self, SharedActionServer};
use crate::services::Ros1Graph;

impl ActionGraph for Ros1Graph<'_> {
    type Sender = GoalSender;
    type Taker = Taker;

    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, GraphError> {
        let calls = self.definitions.known.find_action_calls(name);
        calls.map_err(|error| unknown(self.definitions, name, &error))
    }

    fn action_client(
        &mut self,
        action: &str,
        type_name: &TypeName,
        waits: Waits,
    ) -> Result<GoalSender, GraphError> {
        let found = self.definitions.known.find_action(type_name);
        let action_type = found.map_err(|error| unknown(self.definitions, type_name, &error))?;
        let options = ActionlibClientOptions {
            acknowledge_timeout: waits.answer,
            silence_timeout: waits.silence,
            reconnect_timeout: waits.silence.min(RECONNECT),
            ..ActionlibClientOptions::default()
        };
        let md5 = action_type.action().md5();
        let client = ends::shared(&mut self.ends.clients, (action, md5), || {
            let types = types(&action_type);
            tcpros::actionlib::ActionlibClient::new(self.node, action, types, options)
        })?;
        let unsent = Unsent::default();
        Ok(GoalSender {
            client,
            waits,
            unsent,
        })
    }

    fn serve_action(&mut self, action: &str, type_name: &TypeName) -> Result<Taker, GraphError> {
        let found = self.definitions.known.find_action(type_name);
        let action_type = found.map_err(|error| unknown(self.definitions, type_name, &error))?;
        let empty_result = empty(action_type.result())?;
        let md5 = action_type.action().md5();
        let server = ends::shared(&mut self.ends.servers, (action, md5), || {
            let options = ActionlibServerOptions::new(empty_result.clone());
            let types = types(&action_type);
            tcpros::actionlib::ActionlibServer::new(self.node, action, types, options)
                .map(Mutex::new)
        })?;
        Ok(Taker {
            server,
            empty_result,
        })
    }
}

fn unknown(
    definitions: &mut Ros1Definitions,
    name: &TypeName,
    error: &DefinitionError,
) -> GraphError {
    let wanted = format!(
        "action connections do not carry the definition of the goal: a folder below ROS_PACKAGE_PATH must \
         contain {}/action/{}.action",
        name.package(),
        name.name()
    );
    let of = (TextKind::Action, name);
    GraphError::MissingType(definitions.known.explain_missing(of, error, &wanted))
}

/// Returns the types of the topics of an action.
fn types(action: &ActionType) -> tcpros::actionlib::ActionlibTypes {
    let of = |message_type: &MessageType| TopicType {
        name: message_type.name().to_string(),
        md5sum: message_type.md5().to_owned(),
        definition: message_type.definition().to_owned(),
    };
    tcpros::actionlib::ActionlibTypes {
        goal: of(action.action_goal()),
        result: of(action.action_result()),
        feedback: of(action.action_feedback()),
    }
}

/// Returns a message of the type with default values.
fn empty(message_type: &Arc<MessageType>) -> Result<Bytes, GraphError> {
    let nothing = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::new(),
    };
    let plan = MessagePlan::compile(message_type, &nothing, Wire::Ros1)?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes)?;
    Ok(bytes.into())
}

/// Returns the text of a goal id of the space in actionlib.
fn spelled(id: GraphGoalId) -> String {
    use std::fmt::Write as _;
    id.iter().fold(String::with_capacity(32), |mut text, byte| {
        // Writing to a String does not fail.
        let _written = write!(text, "{byte:02x}");
        text
    })
}

/// Returns the 16 bytes of a goal id of the graph.
fn read(id: &str) -> GraphGoalId {
    let is_ours = id.len() == 32
        && id
            .bytes()
            .all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
    match u128::from_str_radix(id, 16) {
        Ok(number) if is_ours => number.to_be_bytes(),
        Ok(_) | Err(_) => Md5::digest(id).into(),
    }
}

/// Sends goals to an action server.
#[derive(Debug)]
pub(crate) struct GoalSender {
    client: Arc<tcpros::actionlib::ActionlibClient>,
    waits: Waits,
    unsent: Unsent,
}

/// The goals that wait for the connection of their server, and whether each was withdrawn in the
/// meantime.
#[derive(Debug, Clone, Default)]
struct Unsent(Arc<std::sync::Mutex<BTreeMap<GraphGoalId, bool>>>);

impl Unsent {
    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeMap<GraphGoalId, bool>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Withdraws a goal. Returns false for a goal that is not waiting.
    fn withdraw(&self, id: GraphGoalId) -> bool {
        let mut waiting = self.lock();
        waiting.get_mut(&id).is_some_and(|withdrawn| {
            *withdrawn = true;
            true
        })
    }

    /// Ends the wait of a goal. Returns true if the goal was withdrawn in the meantime.
    fn take(&self, id: GraphGoalId) -> bool {
        self.lock().remove(&id).unwrap_or_default()
    }
}

impl GraphActionClient for GoalSender {
    type Goal = SentActionlibGoal;

    fn send_goal(
        &self,
        id: GraphGoalId,
        body: &[u8],
        start_by: std::time::Instant,
    ) -> SentActionlibGoal {
        self.unsent.lock().insert(id, false);
        let mut goal = SentActionlibGoal {
            client: Arc::clone(&self.client),
            id,
            unsent: self.unsent.clone(),
            patience: PENDING.min(self.waits.answer / 2),
            stage: Stage::Waiting {
                body: Bytes::copy_from_slice(body),
                until: after(self.waits.answer.min(CONNECTS)),
                start_by,
            },
            accepted: false,
            undecided: None,
            events: VecDeque::new(),
        };
        if self.client.server().is_ok() {
            goal.send();
        }
        goal
    }

    async fn cancel(&self, what: GraphCancelSelection) -> Result<GraphCancelResponse, CallFault> {
        let unheard = || CallFault {
            text: format!(
                "no node subscribes to requests to cancel goals of {}",
                self.client.name()
            ),
            may_pass: true,
            ran: MayHaveRun::No,
        };
        let (code, goals) = match what {
            GraphCancelSelection::All => {
                self.unsent
                    .lock()
                    .values_mut()
                    .for_each(|withdrawn| *withdrawn = true);
                let open = self.client.open_goals();
                if self.client.cancel_all() == 0 {
                    return Err(unheard());
                }
                (0, open.iter().map(|id| read(id)).collect())
            }
            GraphCancelSelection::Goal(id) => match self.client.cancel_goal(&spelled(id)) {
                CancelSent::Asked => (0, vec![id]),
                CancelSent::NotFollowed if self.unsent.withdraw(id) => (0, vec![id]),
                CancelSent::NotFollowed => (2, Vec::new()),
                CancelSent::Ended => (3, Vec::new()),
                CancelSent::NoServer => return Err(unheard()),
            },
        };
        Ok(GraphCancelResponse { code, goals })
    }
}

/// A goal that is sent to a server, or waits for it.
#[derive(Debug)]
pub(crate) struct SentActionlibGoal {
    client: Arc<tcpros::actionlib::ActionlibClient>,
    id: GraphGoalId,
    unsent: Unsent,
    /// How long the server may leave the goal pending.
    patience: Duration,
    stage: Stage,
    accepted: bool,
    /// The time at which a goal that is pending at its server counts as accepted.
    undecided: Option<Instant>,
    events: VecDeque<GraphGoalEvent>,
}

#[derive(Debug)]
enum Stage {
    /// The goal waits for its server, which connects to new clients within moments.
    Waiting {
        body: Bytes,
        until: Instant,
        /// The time after which the goal is not sent.
        start_by: std::time::Instant,
    },
    Sent(ActionlibGoal),
    Ended,
}

impl SentGoal for SentActionlibGoal {
    async fn recv(&mut self) -> Option<GraphGoalEvent> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            match &mut self.stage {
                Stage::Waiting { until, .. } => {
                    let left = until.saturating_duration_since(after(Duration::ZERO));
                    match self.client.wait_for_server(left).await {
                        Ok(_) => self.send(),
                        Err(error) => self.lose(error.to_string(), MayHaveRun::No),
                    }
                }
                Stage::Sent(handle) => {
                    let undecided = self.undecided.filter(|_| !self.accepted);
                    let heard = match undecided {
                        Some(until) => timeout_at(until, handle.recv()).await,
                        None => Ok(handle.recv().await),
                    };
                    match heard {
                        Ok(Some(event)) => self.heard(event),
                        Ok(None) => self.stage = Stage::Ended,
                        Err(_) => self.accept(),
                    }
                }
                Stage::Ended => return None,
            }
        }
    }
}

impl Drop for SentActionlibGoal {
    fn drop(&mut self) {
        self.unsent.take(self.id);
    }
}

impl SentActionlibGoal {
    fn send(&mut self) {
        let stage = std::mem::replace(&mut self.stage, Stage::Ended);
        let Stage::Waiting { body, start_by, .. } = stage else {
            return;
        };
        if self.unsent.take(self.id) {
            return self.lose(
                "the goal was withdrawn before it was sent".to_owned(),
                MayHaveRun::No,
            );
        }
        if bridge_node::now().monotonic > start_by {
            return self.lose(
                "the goal was not sent: the time until which it may start has passed".to_owned(),
                MayHaveRun::No,
            );
        }
        match self.client.send_goal_as(spelled(self.id), &body) {
            Ok(handle) => self.stage = Stage::Sent(handle),
            Err(error) => self
                .events
                .push_back(GraphGoalEvent::Rejected(error.to_string())),
        }
    }

    fn lose(&mut self, text: String, ran: MayHaveRun) {
        self.stage = Stage::Ended;
        self.events.push_back(GraphGoalEvent::Lost { text, ran });
    }

    fn accept(&mut self) {
        if !self.accepted {
            self.accepted = true;
            let now = bridge_node::now().utc;
            self.events.push_back(GraphGoalEvent::Accepted(now));
        }
    }

    fn heard(&mut self, event: tcpros::actionlib::ActionlibGoalEvent) {
        use tcpros::actionlib::ActionlibGoalEvent as Heard;
        match event {
            Heard::State(state) => self.went(state),
            Heard::Feedback(feedback) => {
                // Feedback has a connection of its own and may arrive before the status.
                self.accept();
                self.events
                    .push_back(GraphGoalEvent::Feedback(feedback.body));
            }
            Heard::FeedbackDropped(count) => {
                warn!(
                    action = self.client.name(),
                    count,
                    "dropped the oldest feedback: it arrived faster than the other space could receive it"
                );
            }
            Heard::Done(result) => self.done(result),
            Heard::Lost(reason) => {
                let unsent = matches!(reason, GoalLoss::NoServer { .. });
                let ran = if unsent {
                    MayHaveRun::No
                } else {
                    MayHaveRun::Perhaps
                };
                self.lose(reason.to_string(), ran);
            }
        }
    }

    fn went(&mut self, state: CommState) {
        match state {
            // A busy SimpleActionServer keeps the next goal pending until the current goal has
            // stopped.
            CommState::Pending => self.undecided = Some(after(self.patience)),
            CommState::Active => {
                self.accept();
                self.events.push_back(GraphGoalEvent::Status(EXECUTING));
            }
            CommState::Preempting => {
                self.accept();
                self.events.push_back(GraphGoalEvent::Status(CANCELING));
            }
            CommState::Recalling if self.accepted => {
                self.events.push_back(GraphGoalEvent::Status(CANCELING));
            }
            CommState::WaitingForGoalAck
            | CommState::WaitingForCancelAck
            | CommState::Recalling
            | CommState::WaitingForResult
            | CommState::Done
            | CommState::Lost => {}
        }
    }

    fn done(&mut self, ended: GoalResult) {
        let said = |otherwise: &str| match ended.text.as_str() {
            "" => otherwise.to_owned(),
            text => text.to_owned(),
        };
        let status = match ended.status {
            ActionlibStatus::Succeeded => SUCCEEDED,
            ActionlibStatus::Preempted => CANCELED,
            ActionlibStatus::Recalled if self.accepted => CANCELED,
            ActionlibStatus::Aborted => ABORTED,
            ActionlibStatus::Rejected if self.accepted => ABORTED,
            ActionlibStatus::Recalled => {
                let why = said("the goal was cancelled before its server started it");
                self.events.push_back(GraphGoalEvent::Rejected(why));
                return;
            }
            ActionlibStatus::Rejected => {
                let why = said("the action server rejected the goal");
                self.events.push_back(GraphGoalEvent::Rejected(why));
                return;
            }
            ActionlibStatus::Pending
            | ActionlibStatus::Active
            | ActionlibStatus::Preempting
            | ActionlibStatus::Recalling
            | ActionlibStatus::Lost => {
                let text = format!(
                    "the server of {} sent a result for a goal that has not ended",
                    self.client.name()
                );
                self.lose(text, MayHaveRun::Perhaps);
                return;
            }
        };
        self.accept();
        self.events.push_back(GraphGoalEvent::Ended {
            status,
            message: ended.text,
            result: ended.body,
        });
    }
}

fn after(wait: Duration) -> Instant {
    let now = Instant::from_std(bridge_node::now().monotonic);
    now.checked_add(wait).unwrap_or(now)
}

/// An action server for an action of another space.
#[derive(Debug)]
pub(crate) struct Taker {
    server: Arc<SharedActionServer>,
    empty_result: Bytes,
}

impl GraphActionServer for Taker {
    type New = NewGraphGoal;
    type Cancel = GoalCancel;

    async fn recv(&mut self) -> GraphServerEvent<NewGraphGoal, GoalCancel> {
        let event = self.server.lock().await.recv().await;
        match event {
            tcpros::actionlib::ActionlibServerEvent::Goal(goal) => {
                GraphServerEvent::Goal(NewGraphGoal {
                    goal: Some(goal),
                    empty_result: self.empty_result.clone(),
                })
            }
            tcpros::actionlib::ActionlibServerEvent::Cancel(id) => {
                GraphServerEvent::Cancel(GoalCancel(read(&id.id)))
            }
        }
    }
}

/// A goal of the graph that is not accepted or rejected yet.
#[derive(Debug)]
pub(crate) struct NewGraphGoal {
    /// `None` once the goal is accepted or rejected.
    goal: Option<ActionlibServerGoal>,
    empty_result: Bytes,
}

impl GraphNewGoal for NewGraphGoal {
    type Goal = ServedActionlibGoal;

    fn id(&self) -> GraphGoalId {
        let goal = self.goal.as_ref();
        goal.map(|goal| read(&goal.goal_id().id))
            .unwrap_or_default()
    }

    fn body(&self) -> &Bytes {
        static NOTHING: Bytes = Bytes::new();
        self.goal
            .as_ref()
            .map_or(&NOTHING, ActionlibServerGoal::body)
    }

    async fn accept(mut self) -> Result<ServedActionlibGoal, GraphError> {
        let goal = self.goal.take().ok_or(GraphError::GoalAnswered)?;
        goal.accept("").map_err(GraphError::library)?;
        Ok(ServedActionlibGoal {
            goal,
            empty_result: std::mem::take(&mut self.empty_result),
        })
    }

    fn reject(mut self, why: &str) {
        if let Some(goal) = self.goal.take() {
            reject(&goal, why);
        }
    }
}

impl Drop for NewGraphGoal {
    fn drop(&mut self) {
        if let Some(goal) = self.goal.take() {
            reject(&goal, "the goal was neither accepted nor rejected in time");
        }
    }
}

fn reject(goal: &ActionlibServerGoal, why: &str) {
    // A goal that was recalled in the meantime has already ended.
    if let Err(error) = goal.reject(why) {
        tracing::debug!("cannot reject a goal: {error}");
    }
}

/// A request of a client to cancel its goal. actionlib has no response to this request; the client
/// sees how the goal ends.
#[derive(Debug)]
pub(crate) struct GoalCancel(GraphGoalId);

impl GraphCancelRequest for GoalCancel {
    fn id(&self) -> GraphGoalId {
        self.0
    }

    fn accept(self) -> Result<(), GraphError> {
        Ok(())
    }

    fn reject(self) {}
}

/// A goal of the graph that another space executes.
#[derive(Debug)]
pub(crate) struct ServedActionlibGoal {
    goal: ActionlibServerGoal,
    empty_result: Bytes,
}

impl ServedGoal for ServedActionlibGoal {
    // The goal is active from its acceptance.
    fn execute(&self) {}

    fn feedback(&self, body: &[u8]) -> Result<(), GraphError> {
        let told = self.goal.feedback(body);
        told.map_err(GraphError::library)
    }

    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), GraphError> {
        let ended = match status {
            SUCCEEDED => self
                .goal
                .succeed(result.unwrap_or(&self.empty_result), message),
            CANCELED => self.goal.cancelled(result, message),
            _ => self.goal.abort(result, message),
        };
        ended.map_err(GraphError::library)
    }
}

// The statuses of `action_msgs/GoalStatus`.
const EXECUTING: i8 = 2;
const CANCELING: i8 = 3;
const SUCCEEDED: i8 = 4;
const CANCELED: i8 = 5;
const ABORTED: i8 = 6;

/// How long a server may keep a goal pending until it counts as accepted.
const PENDING: Duration = Duration::from_secs(1);
/// How long a server registered at the master may take to connect. A killed server stays registered
/// and never connects.
const CONNECTS: Duration = Duration::from_secs(5);
/// Time between the loss of the connection to a server and the loss of its goals.
const RECONNECT: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests;
