//! actionlib: goals that take time, report progress and can be cancelled, over five topics.
//!
//! An action `name` has the topics `name/goal` and `name/cancel` towards its server, and
//! `name/status`, `name/feedback` and `name/result` from its server. [`ActionClient`] sends goals,
//! and a [`GoalHandle`] follows each goal. [`ActionServer`] receives goals as [`ServerGoal`]s;
//! [`SimpleActionServer`] does so for one goal at a time.
//!
//! Goals, results and feedback are opaque bytes to this module: the serialized `XGoal`, `XResult`
//! and `XFeedback`. The module reads and writes only the wrappers `XActionGoal`, `XActionResult`
//! and `XActionFeedback`.
//!
//! - Goals are identified by their id alone, never by a clock of another machine. Time limits use
//!   steady time.
//! - A goal always ends: with its result, or as lost with the [`LostReason`]. After the loss of its
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

pub use client::{ActionClient, ActionClientOptions, CancelSent, GoalHandle, IdInUse, NoServer};
pub use client_goals::{ClientCounters, CommState, Feedback, GoalEvent, GoalResult, LostReason};
pub use server::{ActionServer, ActionServerOptions, ServerEvent, ServerGoal};
pub use server_goals::{GoalError, ServerCounters};
pub use simple::SimpleActionServer;
pub use types::{
    ActionError, ActionType, ClientType, GoalId, GoalStatus, Status, goal_id_type,
    goal_status_array_type,
};
