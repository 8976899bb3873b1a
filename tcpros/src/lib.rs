//! A ROS 1 node on tokio.
//!
//! A [`Node`] registers with a ROS master, publishes and subscribes topics and offers and calls services of any type
//! as bytes, and answers the slave API. It knows no message type: types are given with their checksum and text, or
//! learned from the peer's [`ConnectionHeader`].
//!
//! - It needs no master to start: it registers when one comes, and again after a restart. Connections between nodes
//!   do not depend on the master and stay.
//! - Every queue is bounded in messages and in bytes, drops its oldest messages and counts them. A slow peer costs
//!   nobody but itself.
//! - What peers send is checked; a peer that breaks the protocol loses its connection, with a line in the log.
//! - What peers can open leaves file descriptors for the node itself: of `RLIMIT_NOFILE` subscribers and clients have three
//!   eighths, callers of the slave API one, and publishers three. A process with several nodes needs a limit for all.
//! - It runs on a `current_thread` runtime as well as on several threads. A consumer on a `current_thread` runtime
//!   is served fastest when it is a spawned task: waking the future given to `block_on` costs a system call.
//!
//! To read the code: `node` has the state, `registrar` the master's side of it, `publisher` and `topic_server` what
//! goes out, `subscription` and `link` what comes in, `inbox` where it is taken, `service` what is called,
//! `crowd` who may be connected, `parameters` what the master keeps. [`actionlib`] stands on topics alone.

pub mod actionlib;
mod clock;
mod core;
mod crowd;
mod events;
mod frame;
mod header;
mod inbox;
mod link;
mod master;
mod names;
mod node;
mod options;
mod outbox;
mod parameters;
mod publisher;
mod registrar;
mod rpc;
mod service;
mod slave;
mod subscription;
mod time;
mod topic_server;
mod xmlrpc;

pub use crate::core::Core;
pub use crate::header::{ConnectionHeader, HeaderError};
pub use crate::inbox::{Inbox, InboxEvent, Message, Peer};
pub use crate::master::{Graph, MasterError};
pub use crate::names::NameError;
pub use crate::node::{GraphReader, MasterState, Node, NodeError};
pub use crate::options::{ArgumentError, NodeOptions};
pub use crate::parameters::{ParamError, ParamSubscription, ParamValue, Parameters};
pub use crate::publisher::{
    Latched, MAX_LATCHED, Published, Publisher, PublisherOptions, TopicType,
};
pub use crate::rpc::RpcError;
pub use crate::service::{
    CallPhase, ServiceClient, ServiceClientOptions, ServiceError, ServiceOptions, ServiceRequest,
    ServiceServer, ServiceType,
};
pub use crate::subscription::{SubscriberOptions, Subscription, Wanted};
pub use crate::time::{RosClock, RosTime};
pub use crate::xmlrpc::{Fault, XmlError};
