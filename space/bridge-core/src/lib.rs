//! Conversion between the local side of a space and OPC UA PubSub (UADP), and the rules for the
//! messages that may cross.
//!
//! The [`Router`] is sans-IO: time and bytes go in through `handle_*`, outputs come out of
//! [`poll_output`](Router::poll_output), and [`poll_timeout`](Router::poll_timeout) returns the
//! time of the next [`handle_timeout`](Router::handle_timeout). The crate has no sockets, clocks or
//! tasks. Drain `poll_output` after each `handle_*`, and call `handle_timeout` when the time of
//! `poll_timeout` has passed. If samples may share datagrams, handle all waiting samples before
//! draining `poll_output`, except samples of a topic that [is full](Router::is_full).
//!
//! The checks run in the order header, loop, route, payload, so that looped and unmapped traffic
//! costs a header read and no allocation.

mod application;
mod base;
mod block;
mod bridge_message;
mod buffers;
mod by_name;
mod call;
mod call_announcement;
mod call_plan;
mod concern;
mod confirm;
mod constant;
mod counters;
mod deadline;
mod description;
mod fields;
mod gate;
mod guard;
mod hops;
mod interest;
mod late;
mod layout;
mod learned;
mod loop_rule;
mod loss;
mod message;
mod network;
mod output;
mod pace;
mod part;
mod place;
mod plans;
mod queue;
mod reader;
mod redundancy;
mod room;
mod router;
mod settings;
mod takes;
mod tap;
mod topic;
mod topics;
mod transcoder;
mod writer;

pub use application::{Application, ApplicationEndpoint};
pub use call::{
    ActionFamily, AskError, AskErrorKind, AskId, CallCounters, CallDescription, CallExecution,
    CallField, CallMap, CallResponse, CallRole, CallStructure, CallTypeError, Executed, FieldNote,
    OfferedCall, OfferedType, ValueDescription, ValueNote, split_name,
};
pub use confirm::{ConfirmedArrival, Handover};
pub use constant::ConstantFault;
pub use counters::{Counters, Reason, Verdict};
pub use description::{ROS_TOPICS, TopicMetaData};
pub use fields::{decode_fields, encode_fields};
pub use guard::{GroupState, Guard, KeyDelivery, Unopened, policy_of};
pub use hops::{Delays, Hop, Hops, RecentDelays};
pub use interest::Interest;
pub use late::is_aged;
pub use loop_rule::{Crosses, Owned, Side, may_cross};
pub use output::{Delivery, DropNotice, LocalMessage, Output, PublisherKey, Unsent, ValueRelation};
pub use redundancy::{
    Heartbeat, LocalSide, MuteCause, Redundancy, RedundancyCounts, RedundancyRank, RedundancyRole,
    RedundantPeer, RoleChange, SwitchRefusal, Takeover, TakeoverCause,
};
pub use room::Room;
pub use router::{MutedSamples, Router};
pub use settings::{Forwarding, LinkCapacity, Local, Now, Relay, RouterSettings};
pub use tap::{Crossing, Tapped};
pub use uadp::action::{ExecutionId, Refusal};
pub use uadp::discovery::MessageSecurityMode;
