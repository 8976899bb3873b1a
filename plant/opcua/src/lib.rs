//! OPC UA for the programs of the plant: servers whose address space is made of NodeSets and of instances of their
//! types, and clients that come back by themselves. It knows no skills, no discovery, no space and no ROS.
//!
//! Reading order: `limits` (the bounds of both sides), `endpoint`, `pair`, `own` and `pki`, `certificates`, `known`, `judge` and `door` (who gets
//! in), `nodeset` (types from files), `users`, `supervision`, `audit` and `changes`, `server` and `client`, `file`, `trust_file`, `directory` and
//! `configuration` (a server's certificates as clients manage them), `enrolment` (as a Global Discovery Server issues them).

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
pub mod file;
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

/// What programs hide of the logs of the OPC UA libraries, in the syntax of `tracing` filters: they say at level info
/// what they do for each peer, and at level error what a bad peer did, or that there is no certificate where none is
/// needed. Certificates that are refused are told by the servers here.
///
/// A connection that is opened and closed is somebody looking whether the server is there, and no error.
pub const QUIET: &str = "opcua_server=warn,opcua_server::session::controller=off,opcua_client=off,\
    opcua_crypto=off,opcua_core=warn,opcua_core::comms::secure_channel=off,opcua_nodes=warn,opcua_types=off";
