//! actionlib: goals that take time, report progress and can be cancelled, over five topics.
//!
//! An action `name` has the topics `name/goal` and `name/cancel` towards its server, and
//! `name/status`, `name/feedback` and `name/result` from its server. [`ActionlibClient`] sends
//! goals, and a [`ActionlibGoal`] follows each goal. [`ActionlibServer`] receives goals as
//! [`ActionlibServerGoal`]s; [`SimpleActionServer`] does so for one goal at a time.
//!
//! Goals, results and feedback are opaque bytes to this module: the serialized `XGoal`, `XResult`
//! and `XFeedback`. The module reads and writes only the wrappers `XActionGoal`, `XActionResult`
//! and `XActionFeedback`.
//!
//! - Goals are identified by their id alone, never by a clock of another machine. Time limits use
//!   steady time.
//! - A goal always ends: with its result, or as lost with the [`GoalLoss`]. After the loss of its
//!   server, a client continues by itself when a server is back.
//! - Feedback waits in a bounded queue that drops and counts the oldest messages. Results are never
//!   dropped there.
//! - Each topic is a connection of its own: a result may overtake the last feedback, which then is
//!   dropped and counted.
//! - Messages of peers are checked; messages that cannot be decoded are counted and logged.
//!
//! The behaviour is that of the ROS package actionlib 1.14
//! (<https://wiki.ros.org/actionlib/DetailedDescription>), and both ends interoperate with its
//! clients and servers. Guide to the code: `client_goals` and `server_goals` are the rules, without
//! clock and network; `client` and `server` connect the rules to the topics; `wire` is the message
//! format.

mod client;
mod client_goals;
mod events;
mod server;
mod server_goals;
mod simple;
mod types;
mod wire;

pub use client::{
    ActionlibClient, ActionlibClientOptions, ActionlibGoal, CancelSent, GoalIdInUse,
    NoActionlibServer,
};
pub use client_goals::{
    ActionlibClientCounters, ActionlibGoalEvent, CommState, Feedback, GoalLoss, GoalResult,
};
pub use server::{
    ActionlibServer, ActionlibServerEvent, ActionlibServerGoal, ActionlibServerOptions,
};
pub use server_goals::{ActionlibGoalError, ActionlibServerCounters};
pub use simple::SimpleActionServer;
pub use types::{
    ActionlibError, ActionlibGoalId, ActionlibStatus, ActionlibTypes, ClientType, GoalStatus,
    goal_id_type, goal_status_array_type,
};
