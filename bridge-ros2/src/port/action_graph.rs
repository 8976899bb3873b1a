//! Implements [`ActionGraph`], the view that the policy of both bridges has of actions, for ROS 2.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::actions::{
    ActionGraph, GraphActionClient as Sends, GraphActionServer as Takes, GraphCancelRequest,
    GraphCancelResponse, GraphCancelSelection, GraphGoalEvent, GraphGoalId, GraphNewGoal,
    GraphServerEvent, SentGoal, ServedGoal, Waits,
};
use bridge_node::{CallFault, GraphError, MayHaveRun};
use bytes::Bytes;
use messages::{
    ActionCalls, MessagePlan, MessageType, NoFields, Selection, TextKind, TypeName, Wire,
};
use ros2_node::action::{
    self, ActionClientOptions, ActionName, ActionServerOptions, GoalError, GoalHandle,
    GoalStatusCode, LostReason, Outcome,
};
use ros2_node::clock::Ros2Time;
use tracing::debug;
use uadp::Timestamp;

use super::services::Ros2Graph;

impl ActionGraph for Ros2Graph<'_> {
    type Sender = DomainActionClient;
    type Taker = DomainActionServer;

    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, GraphError> {
        let found = self.definitions.known.find_action_calls(name);
        found.map_err(|error| {
            let wanted = format!(
                "discovery does not carry the definition of an action: a prefix in AMENT_PREFIX_PATH or a \
                 folder of type_paths must contain {}/action/{}.action",
                name.package(),
                name.name()
            );
            let of = (TextKind::Action, name);
            GraphError::MissingType(self.definitions.known.explain_missing(of, &error, &wanted))
        })
    }

    fn action_client(
        &mut self,
        action: &str,
        type_name: &TypeName,
        waits: Waits,
    ) -> Result<DomainActionClient, GraphError> {
        let action = self.action(action, type_name);
        let options = ActionClientOptions {
            server_timeout: waits.silence,
            answer_timeout: Some(waits.answer),
            cancel_timeout: waits.answer,
            ..ActionClientOptions::default()
        };
        action::ActionClient::open(self.domain, self.peers, &action, options)
            .map(DomainActionClient)
            .map_err(GraphError::library)
    }

    fn serve_action(
        &mut self,
        action: &str,
        type_name: &TypeName,
    ) -> Result<DomainActionServer, GraphError> {
        let messages = self.definitions.known.find_action_messages(type_name)?;
        let empty_result = empty(messages.result_response())?;
        let action = self.action(action, type_name);
        let options = ActionServerOptions {
            result_timeout: Some(KEPT),
            cancel_timeout: CANCEL_TIMEOUT,
            ..ActionServerOptions::new(empty_result)
        };
        action::ActionServer::open(self.domain, self.peers, &action, options)
            .map(DomainActionServer)
            .map_err(GraphError::library)
    }
}

impl Ros2Graph<'_> {
    /// Returns the action; its type hashes are announced in the domain.
    fn action(&self, name: &str, type_name: &TypeName) -> ActionName {
        let action = ActionName::new(name, type_name);
        if let Some(hashes) = self.definitions.action_type_hashes(type_name) {
            action.announce(self.domain, &hashes);
        }
        action
    }
}

/// Encodes a message without field values, as little-endian CDR.
fn empty(message: &Arc<MessageType>) -> Result<Bytes, GraphError> {
    let nothing = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::new(),
    };
    let plan = MessagePlan::compile(message, &nothing, Wire::Cdr)?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes)?;
    Ok(bytes.into())
}

/// Sends goals to an action of the domain.
#[derive(Debug)]
pub(super) struct DomainActionClient(action::ActionClient);

impl Sends for DomainActionClient {
    type Goal = DomainGoal;

    fn send_goal(&self, id: GraphGoalId, body: &[u8], start_by: Instant) -> DomainGoal {
        let id = action::GoalId::from_bytes(id);
        match self.0.send_goal_by(id, body, Some(start_by.into())) {
            Ok(handle) => DomainGoal::Sent(handle),
            Err(in_use) => DomainGoal::NotSent(Some(in_use.to_string())),
        }
    }

    async fn cancel(&self, what: GraphCancelSelection) -> Result<GraphCancelResponse, CallFault> {
        let what = match what {
            GraphCancelSelection::All => action::CancelWhat::All,
            GraphCancelSelection::Goal(id) => {
                action::CancelWhat::Goal(action::GoalId::from_bytes(id))
            }
        };
        let answer = self.0.cancel(what).await.map_err(|error| CallFault {
            text: error.to_string(),
            may_pass: false,
            ran: match error.may_have_run() {
                true => MayHaveRun::Perhaps,
                false => MayHaveRun::No,
            },
        })?;
        Ok(GraphCancelResponse {
            code: answer.code.code(),
            goals: answer.goals.iter().map(|goal| goal.id.to_bytes()).collect(),
        })
    }
}

/// A goal of this bridge at an action server of the domain.
#[derive(Debug)]
pub(super) enum DomainGoal {
    Sent(GoalHandle),
    /// The goal was not sent. Holds the reason until it is reported.
    NotSent(Option<String>),
}

impl SentGoal for DomainGoal {
    async fn recv(&mut self) -> Option<GraphGoalEvent> {
        let handle = match self {
            Self::Sent(handle) => handle,
            Self::NotSent(why) => return why.take().map(GraphGoalEvent::Rejected),
        };
        loop {
            let event = match handle.recv().await? {
                action::GoalEvent::Accepted(stamp) => GraphGoalEvent::Accepted(timestamp(stamp)),
                action::GoalEvent::Status(status) => GraphGoalEvent::Status(status.code()),
                action::GoalEvent::Feedback(body) => GraphGoalEvent::Feedback(body),
                action::GoalEvent::FeedbackDropped(count) => {
                    let goal = handle.id();
                    debug!(%goal, count, "dropped feedback in favour of newer feedback");
                    continue;
                }
                action::GoalEvent::Overdue(limit) => GraphGoalEvent::Overdue(format!(
                    "the action server has not accepted or rejected the goal within {limit:?}; the bridge \
                     cancels it as soon as it is accepted"
                )),
                action::GoalEvent::CancelRefused => GraphGoalEvent::CancelRefused,
                action::GoalEvent::Ended(outcome) => ended(outcome),
            };
            return Some(event);
        }
    }
}

fn ended(outcome: Outcome) -> GraphGoalEvent {
    match outcome {
        Outcome::Rejected => {
            GraphGoalEvent::Rejected("the action server rejected the goal".to_owned())
        }
        Outcome::Done { status, result } => GraphGoalEvent::Ended {
            status: status.code(),
            message: String::new(),
            result,
        },
        Outcome::Lost(reason) => lost(&reason),
    }
}

fn lost(reason: &LostReason) -> GraphGoalEvent {
    GraphGoalEvent::Lost {
        text: reason.to_string(),
        ran: match reason.may_run() {
            true => MayHaveRun::Perhaps,
            false => MayHaveRun::No,
        },
    }
}

/// Converts a time; times outside the range of OPC UA are clamped.
fn timestamp(time: Ros2Time) -> Timestamp {
    let nanos = i128::from(time.sec) * NANOS + i128::from(time.nanosec);
    Timestamp::from_unix_nanos(nanos)
}

/// Receives goals from the domain.
#[derive(Debug)]
pub(super) struct DomainActionServer(action::ActionServer);

impl Takes for DomainActionServer {
    type New = NewDomainGoal;
    type Cancel = DomainCancel;

    async fn recv(&mut self) -> GraphServerEvent<NewDomainGoal, DomainCancel> {
        match self.0.recv().await {
            action::ServerEvent::Goal(goal) => GraphServerEvent::Goal(NewDomainGoal(goal)),
            action::ServerEvent::Cancel(request) => GraphServerEvent::Cancel(DomainCancel(request)),
        }
    }
}

/// A goal of an action client of the domain.
#[derive(Debug)]
pub(super) struct NewDomainGoal(action::NewGoal);

impl GraphNewGoal for NewDomainGoal {
    type Goal = ServedDomainGoal;

    fn id(&self) -> GraphGoalId {
        self.0.id().to_bytes()
    }

    fn body(&self) -> &Bytes {
        self.0.body()
    }

    async fn accept(self) -> Result<ServedDomainGoal, GraphError> {
        let goal = self.0.accept().await.map_err(GraphError::library)?;
        Ok(ServedDomainGoal(goal))
    }

    fn reject(self, why: &str) {
        // Clients receive the rejection without its reason.
        debug!(goal = %self.0.id(), why, "rejected a goal");
        self.0.reject();
    }
}

/// A cancel request of an action client of the domain.
#[derive(Debug)]
pub(super) struct DomainCancel(action::CancelRequest);

impl GraphCancelRequest for DomainCancel {
    fn id(&self) -> GraphGoalId {
        self.0.id().to_bytes()
    }

    fn accept(self) -> Result<(), GraphError> {
        self.0.accept().map_err(GraphError::library)
    }

    fn reject(self) {
        self.0.reject();
    }
}

/// A goal of an action client of the domain that another space executes.
#[derive(Debug)]
pub(super) struct ServedDomainGoal(action::ServerGoal);

impl ServedDomainGoal {
    /// Takes the transitions before a terminal state: a goal does not end from accepted, and
    /// becomes canceled from canceling only.
    fn step(&self, status: i8) -> Result<(), GoalError> {
        if self.0.status() == GoalStatusCode::Accepted {
            self.0.execute()?;
        }
        match status {
            CANCELED => self.0.cancel_unasked(),
            _ => Ok(()),
        }
    }
}

impl ServedGoal for ServedDomainGoal {
    fn execute(&self) {
        if self.0.status() == GoalStatusCode::Accepted
            && let Err(error) = self.0.execute()
        {
            debug!(%error, "work on a goal that has ended");
        }
    }

    fn feedback(&self, body: &[u8]) -> Result<(), GraphError> {
        self.0.feedback(body).map_err(GraphError::library)
    }

    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), GraphError> {
        if !message.is_empty() {
            // Results of ROS 2 carry no message.
            debug!(goal = %self.0.id(), status, message, "a goal ends");
        }
        let end = || {
            self.step(status)?;
            match (status, result) {
                (SUCCEEDED, Some(result)) => self.0.succeed(result),
                (SUCCEEDED, None) => self.0.succeed(&self.0.empty_result()),
                (CANCELED, Some(result)) => self.0.canceled(result),
                (CANCELED, None) => self.0.canceled(&self.0.empty_result()),
                (_, Some(result)) => self.0.abort(result),
                (_, None) => self.0.abort(&self.0.empty_result()),
            }
        };
        end().map_err(GraphError::library)
    }
}

const SUCCEEDED: i8 = GoalStatusCode::Succeeded.code();
const CANCELED: i8 = GoalStatusCode::Canceled.code();
/// How long results are kept; the same time applies to results of the space.
const KEPT: Duration = Duration::from_secs(15 * 60);
/// How long the executing server of another space may take to decide about a cancel request.
const CANCEL_TIMEOUT: Duration = Duration::from_secs(10);
const NANOS: i128 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use messages::{Dialect, TypeRegistry};

    use super::*;

    #[test]
    fn an_empty_result_has_all_its_fields() {
        let name = "demo_msgs/Count".parse().unwrap();
        let mut registry = TypeRegistry::bundle(Dialect::Ros2);
        let text = "int32 order\n---\nint32[] sequence\nfloat64 share\n---\nint32 done\n";
        registry.add_action(&name, text).unwrap();
        let messages = registry.action_messages(&name).unwrap();
        let bytes = empty(messages.result_response()).unwrap();
        // The status, the count of the sequence after three bytes of padding, and the share.
        assert_eq!(bytes.as_ref(), [&[0, 1, 0, 0][..], &[0; 16]].concat());
    }

    #[test]
    fn what_nobody_had_did_not_run() {
        for (reason, ran) in [
            (LostReason::Busy(1), MayHaveRun::No),
            (LostReason::Unknown, MayHaveRun::Perhaps),
        ] {
            let text = reason.to_string();
            assert_eq!(lost(&reason), GraphGoalEvent::Lost { text, ran });
        }
    }

    #[test]
    fn a_time_before_1970_is_one() {
        let time = Ros2Time {
            sec: -1,
            nanosec: 500,
        };
        assert_eq!(timestamp(time).unix_nanos(), -999_999_500);
    }
}
