//! Shared parts of the bridge programs: the port trait, the run loop, arguments, logging and
//! metrics.
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
mod descriptors;
mod executing;
mod exit;
mod host;
mod keys;
mod logging;
mod mapping_file;
mod metrics;
mod observer;
pub mod policy;
mod port;
mod present;
mod program;
mod redundancy;
mod restart;
mod ros_requests;
mod run;
mod service;
mod service_manager;
mod services;
mod signals;
mod stamp;
mod status;
mod tap;

pub use actions::{ActionGraph, Actions};
pub use arguments::{Arguments, Flags, WithoutMapping};
pub use awaited::{AwaitedPeers, near};
pub use bridge_core::{
    ActionFamily, Answered, Application, Arrival, AskError, AskErrorKind, AskId, CallDescription,
    CallField, CallMap, CallRole, CallStructure, Counters, Described, Executed, ExecutionId,
    Handover, Kept, Offered, OfferedType, Owned, PublisherKey, Rank, Reason, Refusal, Room, Router,
    Unsent, ValueDescription, ValueNote, Verdict,
};
pub use busy_poll::BusyPoll;
pub use calls::{Asker, CallGraph, Calls};
pub use carrier::carrier_rules;
pub use cell::{ProgramSet, SharedProgram, check_mapping, run_together};
pub use clock::{now, timestamp};
pub use definitions::Definitions;
pub use executing::{Executing, ExecutorGraph};
pub use exit::{Failure, FailureKind};
pub use keys::{Fetched, Fetching, KeyRequest, KeyService};
pub use log_limit::{LogRecord, LogSink};
pub use logging::{LogFormat, hear_log};
pub use mapping_file::{ConfigurationFile, NodeSetReader};
pub use mappings::harmless_json;
pub use metrics::{
    BoxFuture, PageBody, Requests, Secure, Site, Statuses, Stream, Told, Visit, full, serve_pages,
    serve_secure,
};
pub use observer::Observer;
pub use port::{Delivery, Execution, LinkState, Port, PortEvent};
pub use present::Present;
pub use program::{Carried, Context, Made, Program, run};
pub use redundancy::{RedundancyArguments, rank};
pub use restart::{restart, stop};
pub use ros_requests::RosRequests;
pub use service::{Service, run_service};
pub use service_manager::ready;
pub use services::{CallFault, Outcome, Ran, ServiceCall, ServiceGraph, Services};
pub use stamp::wants_stamp;
pub use type_files::{Environment, TypePaths, read_bounded, read_text_file};
