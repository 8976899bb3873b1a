//! What crosses between a space and UADP, and what does not.
//!
//! The [`Router`] is sans-IO: time and bytes go in through `handle_*`, values come out of
//! [`poll_output`](Router::poll_output), and [`poll_timeout`](Router::poll_timeout) says when to come back. There is
//! no socket, clock or task in here. After every `handle_*` drain `poll_output`; when `poll_timeout` has passed, call
//! [`handle_timeout`](Router::handle_timeout). Where samples may share datagrams, those that are there are handled first, but
//! for one whose topic [is full](Router::is_full).
//!
//! The checks run in the order header, loop, route, payload, so that looped and unmapped traffic costs a header read
//! and no allocation.

mod application;
mod base;
mod block;
mod call;
mod call_announcement;
mod call_plan;
mod confirm;
mod constant;
mod counters;
mod description;
mod fields;
mod gate;
mod guard;
mod hops;
mod layout;
mod learned;
mod loop_rule;
mod loss;
mod network;
mod output;
mod pace;
mod place;
mod plans;
mod queue;
mod reader;
mod room;
mod router;
mod settings;
mod takes;
mod topic;
mod transcoder;
mod writer;

pub use application::{Application, Endpoint};
pub use call::{
    ActionFamily, Answered, AskError, AskErrorKind, AskId, CallCounters, CallDescription,
    CallField, CallMap, CallRole, CallStructure, Executed, Execution, Offered, OfferedType,
    ValueDescription, ValueNote, split_name,
};
pub use confirm::{Arrival, Handover};
pub use counters::{Counters, Reason, Verdict};
pub use description::Described;
pub use fields::{decode_fields, encode_fields};
pub use guard::{GroupState, Guard, KeyDelivery, Unopened, policy_of};
pub use hops::{Delays, Hop, Hops};
pub use loop_rule::{Owned, Side, What, may_cross};
pub use output::{Delivery, Heard, Kept, Notice, Output, PublisherKey};
pub use room::Room;
pub use router::Router;
pub use settings::{Local, Now, Settings};
pub use uadp::action::{ExecutionId, Refusal};
pub use uadp::discovery::MessageSecurityMode;
