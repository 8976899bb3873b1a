//! actionlib: goals that take time, report progress and can be cancelled, over five topics.
//!
//! An action `name` is the topics `name/goal` and `name/cancel` towards its server, and `name/status`,
//! `name/feedback` and `name/result` from it. [`ActionClient`] sends goals and follows each by its [`GoalHandle`];
//! [`ActionServer`] takes them as [`ServerGoal`]s, and [`SimpleActionServer`] does so one at a time.
//!
//! Goals, results and feedback are bytes to this module: the serialized `XGoal`, `XResult` and `XFeedback`. It reads
//! and writes what `XActionGoal`, `XActionResult` and `XActionFeedback` put around them.
//!
//! - Goals are followed by their id alone, never by a clock of another machine. Time limits use steady time.
//! - A goal always ends: with its result, or as lost with the [`LostReason`]. A client whose server went away goes on
//!   when one comes back, without being asked to.
//! - Feedback waits in a bounded queue whose oldest give way and are counted. Results are never dropped there.
//! - Each topic is a connection of its own: a result may overtake the last feedback, which then is dropped and counted.
//! - What peers send is checked; messages that do not read are counted and logged.
//!
//! The behaviour is that of the ROS package actionlib 1.14 (<https://wiki.ros.org/actionlib/DetailedDescription>),
//! and both ends work with its clients and servers. To read the code: `client_goals` and `server_goals` are the
//! rules, without clock and network; `client` and `server` tie them to the topics; `wire` is the messages.

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
