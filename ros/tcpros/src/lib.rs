//! A ROS 1 node on tokio.
//!
//! A [`Node`] registers with a ROS master, publishes and subscribes to topics, offers and calls
//! services, and serves the slave API. Messages of any type are passed as bytes. The node knows no
//! message type: a type is given with its checksum and text, or learned from the peer's
//! [`ConnectionHeader`].
//!
//! - The node starts without a master: it registers when a master is available, and again after a
//!   restart of the master. Connections between nodes do not depend on the master and stay.
//! - Every queue is bounded in messages and in bytes, drops its oldest messages and counts them. A
//!   slow peer affects only itself.
//! - Messages of peers are checked; a peer that violates the protocol is disconnected with a log
//!   entry.
//! - Connections of peers leave file descriptors for the node itself: of `RLIMIT_NOFILE`
//!   subscribers and clients have three eighths, callers of the slave API one eighth, and
//!   publishers three eighths. A process with several nodes needs a limit for all of them.
//! - The node runs on a `current_thread` runtime as well as on several threads. A consumer on a
//!   `current_thread` runtime is served fastest if it is a spawned task: waking the future given to
//!   `block_on` costs a system call.
//!
//! Guide to the code: `node` has the state, and `registrar` keeps the master up to date.
//! `publisher` and `topic_server` send messages; `subscription` and `link` receive messages into an
//! `inbox`. `service` has services, `crowd` the limits of connections, and `parameters` the
//! parameter server. [`actionlib`] is built on topics alone.

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
mod reach;
mod refusal;
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
pub use crate::inbox::{ConnectionPeer, Inbox, InboxEvent, InboxMessage};
pub use crate::master::{MasterError, MasterGraph, MasterState};
pub use crate::names::ResourceNameError;
pub use crate::node::{GraphReader, Node, NodeError};
pub use crate::options::{ArgumentError, NodeOptions};
pub use crate::parameters::{NodeParameters, ParamError, ParamSubscription, ParamValue};
pub use crate::publisher::{
    Latched, MAX_LATCHED, Published, Publisher, PublisherOptions, TopicType,
};
pub use crate::rpc::RpcError;
pub use crate::service::{
    CallPhase, ServiceClient, ServiceClientOptions, ServiceError, ServiceOptions, ServiceRequest,
    ServiceServer, ServiceTypeSum,
};
pub use crate::subscription::{RequestedType, SubscriberOptions, Subscription};
pub use crate::time::{Ros1Clock, Ros1Time};
pub use crate::xmlrpc::{XmlError, XmlRpcFault};
