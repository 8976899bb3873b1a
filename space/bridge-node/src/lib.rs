//! Shared parts of the bridge programs: the port trait, the run loop and arguments. What other
//! programs need too, such as logging and status pages, is in `service`.
//!
//! A program implements [`Program`] and [`Port`], and its `main` is [`run`]. This crate is
//! independent of the ROS version (the port handles it) and of the UADP encoding (`bridge-core`
//! handles it).

pub mod actions;
mod arguments;
mod awaited;
mod busy_poll;
mod calls;
mod carrier;
mod cell;
mod clock;
mod definitions;
mod executing;
mod graph_error;
mod host;
mod keys;
mod mapping_file;
mod observer;
pub mod policy;
mod port;
mod present;
mod program;
mod redundancy;
mod ros_requests;
mod run;
mod services;
mod signals;
mod stamp;
mod status;
mod tap;

pub use actions::{ActionGraph, BridgeActions};
pub use arguments::{Arguments, Flags, WithoutMapping};
pub use awaited::{AwaitedPeers, near};
pub use bridge_core::{
    ActionFamily, Application, AskError, AskErrorKind, AskId, CallDescription, CallField, CallMap,
    CallResponse, CallRole, CallStructure, ConfirmedArrival, Counters, Executed, ExecutionId,
    Handover, OfferedCall, OfferedType, Owned, PublisherKey, Reason, RedundancyRank, Refusal, Room,
    Router, TopicMetaData, Unsent, ValueDescription, ValueNote, ValueRelation, Verdict,
};
pub use busy_poll::BusyPoll;
pub use calls::{Asker, CallGraph, SpaceCalls};
pub use carrier::{carrier_rules, open_shared_memory};
pub use cell::{ProgramSet, SharedProgram, check_mapping, run_together};
pub use clock::{now, timestamp};
pub use definitions::Definitions;
pub use executing::{ExecutedServices, ExecutorGraph};
pub use graph_error::GraphError;
pub use keys::{Fetched, Fetching, KeyFetchError, KeyRequest, KeyService};
pub use mapping_file::{ConfigurationFile, NodeSetReader};
pub use mappings::harmless_json;
pub use observer::Observer;
pub use port::{Execution, LinkState, LocalDelivery, Port, PortEvent};
pub use present::Present;
pub use program::{Carried, Context, Made, Program, run};
pub use redundancy::{NoRank, RedundancyArguments, rank};
pub use ros_requests::RosRequests;
pub use service::logging::hear_log;
pub use service::restart::{restart, stop};
pub use service::{
    BoxFuture, Failure, FailureKind, PageBody, Secure, Site, Statuses, Stream, Visit, full,
    serve_secure,
};
pub use services::{
    BridgeServiceCalls, CallFault, MayHaveRun, ServiceCall, ServiceGraph, ServiceOutcome,
};
pub use stamp::wants_stamp;
pub use type_files::{RosEnvironment, TypePaths, read_bounded, read_text_file};
