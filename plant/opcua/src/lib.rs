//! OPC UA for the programs of the plant: servers with an address space of NodeSets and of instances
//! of their types, and clients that reconnect. This crate does not depend on skills, discovery,
//! spaces or ROS.
//!
//! Reading order: `limits` (the limits of both sides), `endpoint`, `pair`, `own` and `pki`,
//! `certificates`, `known`, `judge` and `door` (access), `nodeset` (types from files), `users`,
//! `supervision`, `audit` and `changes`, `server` and `client`, `file`, `trust_file`, `directory`
//! and `configuration` (certificate management by clients), `enrolment` (certificates of a Global
//! Discovery Server), `job_control` (structures of job orders).

#[cfg(feature = "server")]
pub mod audit;
pub mod certificates;
#[cfg(feature = "server")]
pub mod changes;
pub mod client;
#[cfg(feature = "server")]
pub mod configuration;
#[cfg(feature = "server")]
pub mod directory;
#[cfg(feature = "server")]
pub mod door;
pub mod endpoint;
#[cfg(feature = "server")]
pub mod enrolment;
#[cfg(feature = "server")]
mod event;
#[cfg(feature = "server")]
pub mod file;
#[cfg(feature = "server")]
pub mod job_control;
pub mod judge;
pub mod known;
pub mod limits;
#[cfg(feature = "server")]
pub mod nodeset;
pub mod own;
mod pair;
#[cfg(feature = "server")]
pub mod patches;
pub mod pki;
#[cfg(feature = "server")]
pub mod server;
#[cfg(feature = "server")]
pub mod supervision;
pub mod synced;
#[cfg(feature = "server")]
pub mod trust_file;
#[cfg(feature = "server")]
pub mod users;

pub use opcua::types;

/// The `tracing` filter that programs apply to the OPC UA libraries. The libraries log their work
/// for each peer at level info. They log faults of peers at level error, and also a missing
/// certificate that is not needed. The servers of this crate log refused certificates themselves.
///
/// A TCP connection that is opened and closed is a probe of the server, and no error.
pub const QUIET: &str = "opcua_server=warn,opcua_server::session::controller=off,opcua_client=off,\
    opcua_crypto=off,opcua_core=warn,opcua_core::comms::secure_channel=off,opcua_nodes=warn,opcua_types=off";
