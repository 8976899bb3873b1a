//! The interface of a ROS graph with actions: clients that send goals, servers that receive them.
//!
//! Payloads are messages of that ROS, as its port encodes them: ROS 1 bodies without length, or CDR
//! in little endian with the encapsulation header.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use messages::{ActionCalls, TypeName};
use uadp::Timestamp;

use crate::services::{CallFault, MayHaveRun};
use crate::{GraphError, ServiceGraph};

/// Identifies a goal. In ROS 2 it is the UUID. In ROS 1, where ids are strings, it is the value of
/// an id of 32 hex digits, or the MD5 of any other id.
pub type GraphGoalId = [u8; 16];

/// The id that means "no goal".
pub const NO_GOAL: GraphGoalId = [0; 16];

/// A ROS graph with actions, as implemented by a port. [`ServiceGraph::WIRE`] is the encoding of
/// its messages.
pub trait ActionGraph: ServiceGraph {
    /// The client of an action.
    type Sender: GraphActionClient;
    /// The server of an action.
    type Taker: GraphActionServer;

    /// Returns the calls and values of an action type.
    ///
    /// # Errors
    /// The reason why the type is not known.
    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, GraphError>;

    /// Creates a client of an action. The server is present, or was a moment ago.
    ///
    /// # Errors
    /// The reason why the client cannot be created.
    fn action_client(
        &mut self,
        action: &str,
        type_name: &TypeName,
        waits: Waits,
    ) -> Result<Self::Sender, GraphError>;

    /// Serves an action until the returned server is dropped.
    ///
    /// # Errors
    /// The reason why the action cannot be served.
    fn serve_action(
        &mut self,
        action: &str,
        type_name: &TypeName,
    ) -> Result<Self::Taker, GraphError>;
}

/// Timeouts of an action client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Waits {
    /// Timeout of the server's decision on a goal, and of its response to a request to cancel.
    pub answer: Duration,
    /// Timeout of a silent server, after which its goals are lost.
    pub silence: Duration,
}

/// An event of a goal that was sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GraphGoalEvent {
    /// The server has accepted the goal. Reported once, before the events below.
    Accepted(Timestamp),
    /// The status of the goal as in `action_msgs/GoalStatus`: 1 accepted, 2 executing, 3 canceling.
    Status(i8),
    /// An `X_Feedback`.
    Feedback(Bytes),
    /// The server has not decided about the goal in time. The goal is withdrawn: it is cancelled as
    /// soon as it is accepted. The outcome follows. Carries the reason.
    Overdue(String),
    /// The goal was withdrawn, and the server, which has accepted it, refuses to cancel it.
    CancelRefused,
    /// The goal has ended: the last event.
    Ended {
        /// Status as in `action_msgs/GoalStatus`: 4 succeeded, 5 canceled, 6 aborted.
        status: i8,
        /// Message of the server, as text for the user; may be empty.
        message: String,
        /// In ROS 1 an `XResult`. In ROS 2 an `X_GetResult_Response`, because the status affects
        /// the alignment of the fields behind it.
        result: Bytes,
    },
    /// The server has rejected the goal: the last event.
    Rejected(String),
    /// No further event of the goal can be received: the last event.
    Lost {
        /// The reason.
        text: String,
        /// Whether the server has, or had, the goal.
        ran: MayHaveRun,
    },
}

/// The goals of a request to cancel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GraphCancelSelection {
    /// All goals of the server.
    All,
    /// A single goal.
    Goal(GraphGoalId),
}

/// The response of a server to a request to cancel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GraphCancelResponse {
    /// Code as in `action_msgs/CancelGoal`: 0 none, 1 rejected, 2 unknown goal, 3 terminated.
    pub code: i8,
    /// The goals that are being cancelled, as far as they are known.
    pub goals: Vec<GraphGoalId>,
}

/// Sends goals to one action. The goals go on when the client is dropped.
pub trait GraphActionClient: Send + Sync + 'static {
    /// A goal that was sent.
    type Goal: SentGoal;

    /// Sends a goal, an `X_Goal`, with an id. Never waits: the returned goal reports the events. A
    /// goal that cannot be sent until `start_by` is lost, and never runs. Called on a tokio
    /// runtime.
    fn send_goal(&self, id: GraphGoalId, body: &[u8], start_by: Instant) -> Self::Goal;

    /// Requests the server to cancel goals. Ends within [`Waits::answer`]. A goal that the server
    /// has not decided about is withdrawn: it is not sent, or is cancelled as soon as it is
    /// accepted. The response is then that the goal is being cancelled.
    ///
    /// # Errors
    /// [`CallFault`], if there is no response.
    fn cancel(
        &self,
        what: GraphCancelSelection,
    ) -> impl Future<Output = Result<GraphCancelResponse, CallFault>> + Send;
}

/// A goal that was sent. Dropping it ends the reports of its events, and does not cancel it.
pub trait SentGoal: Send + 'static {
    /// Returns the next event; `None` after the last. Cancel-safe. Ends shortly after
    /// [`Waits::silence`] if the server is silent.
    fn recv(&mut self) -> impl Future<Output = Option<GraphGoalEvent>> + Send;
}

/// A request of a client to a server.
#[derive(Debug)]
pub enum GraphServerEvent<N, C> {
    /// A new goal, to be accepted or rejected.
    Goal(N),
    /// A request to cancel a goal, to be accepted or rejected.
    Cancel(C),
}

/// Receives goals for one action. Dropping it withdraws the action.
pub trait GraphActionServer: Send + 'static {
    /// A goal to decide about.
    type New: GraphNewGoal;
    /// A request to cancel a goal.
    type Cancel: GraphCancelRequest;

    /// Returns the next event. Cancel-safe.
    fn recv(&mut self) -> impl Future<Output = GraphServerEvent<Self::New, Self::Cancel>> + Send;
}

/// A goal to decide about. Dropping it rejects the goal.
pub trait GraphNewGoal: Send + 'static {
    /// A goal that was accepted.
    type Goal: ServedGoal;

    /// Returns the id of the goal.
    fn id(&self) -> GraphGoalId;

    /// Returns the `X_Goal`.
    fn body(&self) -> &Bytes;

    /// Accepts the goal.
    ///
    /// # Errors
    /// The reason why the goal cannot be accepted.
    fn accept(self) -> impl Future<Output = Result<Self::Goal, GraphError>> + Send;

    /// Rejects the goal, with the reason if the client can receive it.
    fn reject(self, why: &str);
}

/// A request to cancel a goal. Dropping it rejects the request: the goal goes on.
pub trait GraphCancelRequest: Send + 'static {
    /// Returns the id of the goal.
    fn id(&self) -> GraphGoalId;

    /// Accepts the request; the goal still has to be ended by [`ServedGoal::end`].
    ///
    /// # Errors
    /// The reason why the request cannot be accepted.
    fn accept(self) -> Result<(), GraphError>;

    /// Rejects the request.
    fn reject(self);
}

/// An accepted goal. Dropping it before its end aborts the goal.
pub trait ServedGoal: Send + Sync + 'static {
    /// Marks the goal as executing; no effect if it is executing already.
    fn execute(&self);

    /// Publishes feedback, an `X_Feedback`. Never waits.
    ///
    /// # Errors
    /// The reason why the feedback cannot be published.
    fn feedback(&self, body: &[u8]) -> Result<(), GraphError>;

    /// Ends the goal: 4 succeeded, 5 canceled, any other value aborted. If no client has requested
    /// to cancel the goal, 5 aborts it in a ROS without such an end. `result` is as in
    /// [`GraphGoalEvent::Ended`]; without a result the client receives the empty result.
    ///
    /// # Errors
    /// The reason why the goal cannot be ended; the goal is not ended then.
    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), GraphError>;
}
