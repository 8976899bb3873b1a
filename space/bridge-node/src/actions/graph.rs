//! What a ROS graph with actions is to the policy: clients that send goals, servers that take them.
//!
//! Bytes are messages of that ROS, as its port has them: bodies of ROS 1 without length, CDR in little endian with its
//! encapsulation header.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use messages::{ActionCalls, TypeName};
use uadp::Timestamp;

use crate::ServiceGraph;
use crate::services::{CallFault, Ran};

/// Tells a goal from all others. In ROS 2 the UUID; in ROS 1, where ids are texts, 32 hex digits of these bytes, and of any
/// other text its MD5.
pub type GoalId = [u8; 16];

/// The id of no goal.
pub const NO_GOAL: GoalId = [0; 16];

/// A ROS graph with actions, as a port has it. How its messages are on the wire is [`ServiceGraph::WIRE`].
pub trait ActionGraph: ServiceGraph {
    /// Sends goals to one action.
    type Sender: ActionClient;
    /// Takes goals for one action.
    type Taker: ActionServer;

    /// The calls and values that an action of that type is.
    ///
    /// # Errors
    /// Why the type is not known, for people.
    fn action_calls(&mut self, name: &TypeName) -> Result<Arc<ActionCalls>, String>;

    /// What sends goals to the server of an action. The server is there, or was a moment ago.
    ///
    /// # Errors
    /// Why there can be none, for people.
    fn action_client(
        &mut self,
        action: &str,
        type_name: &TypeName,
        waits: Waits,
    ) -> Result<Self::Sender, String>;

    /// Serves an action, until what is given back is dropped.
    ///
    /// # Errors
    /// Why it cannot be served, for people.
    fn serve_action(&mut self, action: &str, type_name: &TypeName) -> Result<Self::Taker, String>;
}

/// How long who sends goals waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Waits {
    /// For the server's word on a goal, or on a request to cancel.
    pub answer: Duration,
    /// For a server that is not heard any more, until its goals are lost.
    pub silence: Duration,
}

/// What happened to a goal that was sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GoalEvent {
    /// Its server works on it, or will. Once, and before what follows.
    Accepted(Timestamp),
    /// How far it is, as `action_msgs/GoalStatus` has it: 1 accepted, 2 executing, 3 canceling.
    Status(i8),
    /// An `X_Feedback`.
    Feedback(Bytes),
    /// Its server has not decided about it for as long as it may take. It is withdrawn: cancelled as soon as it is accepted.
    /// What becomes of it follows. With the reason, for people.
    Overdue(String),
    /// It was withdrawn, and its server, which has accepted it, refuses to cancel it.
    CancelRefused,
    /// It has ended: the last event.
    Ended {
        /// As `action_msgs/GoalStatus` has it: 4 succeeded, 5 canceled, 6 aborted.
        status: i8,
        /// What the server says of it, for people; may be empty.
        message: String,
        /// In ROS 1 an `XResult`. In ROS 2 an `X_GetResult_Response`, since what follows a status is aligned by it.
        result: Bytes,
    },
    /// Its server does not take it: the last event.
    Rejected(String),
    /// Nothing more will be heard of it: the last event.
    Lost {
        /// Why, for people.
        text: String,
        /// Whether the server has, or had, it.
        ran: Ran,
    },
}

/// Which goals to cancel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CancelWhat {
    /// All that the server has.
    All,
    /// This one.
    Goal(GoalId),
}

/// What a server says to a request to cancel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CancelAnswer {
    /// As `action_msgs/CancelGoal` has it: 0 none, 1 rejected, 2 unknown goal, 3 terminated.
    pub code: i8,
    /// The goals that are being cancelled, as far as they are known.
    pub goals: Vec<GoalId>,
}

/// Sends goals to one action. Its goals go on when it is dropped.
pub trait ActionClient: Send + Sync + 'static {
    /// A goal that was sent.
    type Goal: SentGoal;

    /// Sends a goal, an `X_Goal`, under that id. Never waits: what becomes of it is told by the goal. Called on a tokio
    /// runtime.
    fn send_goal(&self, id: GoalId, body: &[u8]) -> Self::Goal;

    /// Asks the server to cancel goals. Ends within [`Waits::answer`]. A goal that the server has not decided about is
    /// withdrawn: it is not sent, or is cancelled as soon as it is accepted. The answer then is that it is being cancelled.
    ///
    /// # Errors
    /// [`CallFault`], where there is no answer.
    fn cancel(
        &self,
        what: CancelWhat,
    ) -> impl Future<Output = Result<CancelAnswer, CallFault>> + Send;
}

/// A goal that was sent. Dropping it ends the interest in it, and does not cancel it.
pub trait SentGoal: Send + 'static {
    /// The next event; `None` after the last. Cancel-safe. Ends within [`Waits::silence`] and a little more once the server
    /// is not heard any more.
    fn recv(&mut self) -> impl Future<Output = Option<GoalEvent>> + Send;
}

/// What clients want of a server.
#[derive(Debug)]
pub enum ServerEvent<N, C> {
    /// A new goal, to be accepted or rejected.
    Goal(N),
    /// A goal should be cancelled, which is to be agreed to or not.
    Cancel(C),
}

/// Takes goals for one action. Dropping it withdraws the action.
pub trait ActionServer: Send + 'static {
    /// A goal to decide about.
    type New: NewGoal;
    /// A request to cancel a goal.
    type Cancel: CancelRequest;

    /// The next event. Cancel-safe.
    fn recv(&mut self) -> impl Future<Output = ServerEvent<Self::New, Self::Cancel>> + Send;
}

/// A goal to decide about. One that is dropped is rejected.
pub trait NewGoal: Send + 'static {
    /// A goal that was accepted.
    type Goal: ServedGoal;

    /// The goal's id.
    fn id(&self) -> GoalId;

    /// The `X_Goal`.
    fn body(&self) -> &Bytes;

    /// Accepts it.
    ///
    /// # Errors
    /// Why that cannot be, for people.
    fn accept(self) -> impl Future<Output = Result<Self::Goal, String>> + Send;

    /// Rejects it, with the reason where the client can be told.
    fn reject(self, why: &str);
}

/// A request to cancel a goal. One that is dropped is rejected: the goal goes on.
pub trait CancelRequest: Send + 'static {
    /// Of which goal.
    fn id(&self) -> GoalId;

    /// Agrees to it; the goal is to be ended all the same.
    ///
    /// # Errors
    /// Why that cannot be, for people.
    fn accept(self) -> Result<(), String>;

    /// Does not agree.
    fn reject(self);
}

/// A goal that was accepted. One that is dropped before its end is aborted.
pub trait ServedGoal: Send + Sync + 'static {
    /// Work has begun; of no consequence where it has already.
    fn execute(&self);

    /// Reports progress, an `X_Feedback`. Never waits.
    ///
    /// # Errors
    /// Why it cannot be, for people.
    fn feedback(&self, body: &[u8]) -> Result<(), String>;

    /// Ends it: 4 succeeded, 5 canceled, anything else aborted. One that ended as canceled without its clients having
    /// asked for that is aborted where the ROS knows no such end. `result` is as in [`GoalEvent::Ended`]; without one the
    /// client has the empty one.
    ///
    /// # Errors
    /// Why it cannot be, for people; the goal is not ended then.
    fn end(&self, status: i8, message: &str, result: Option<&[u8]>) -> Result<(), String>;
}
