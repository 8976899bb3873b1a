//! Discovery of OPC UA servers: [`registry`] with its sockets.
//!
//! [`announce`] announces a server by mDNS, and registers it with the Local Discovery Server.
//! [`watch`] reports the servers of a network. [`lds`] is the Local Discovery Server itself, the
//! program `ua-lds`.
//!
//! Reading order: `address` (the registered address), `wire` (OPC UA over TCP), `client` (queries),
//! `line` and `liveness` (probes of servers), `keeper` (a registry with its inputs and outputs),
//! `watch`, `scan`, `chosen` and `announce` (the interface for programs), `endpoint`, `connection`,
//! `security` and `services` (the endpoint of the discovery server), `listing` (queries of a Global
//! Discovery Server), `lds`, `embedded` (the discovery server within another program), `presence`.

mod address;
mod announce;
mod chosen;
pub mod client;
mod clock;
mod connection;
mod description;
mod embedded;
mod endpoint;
#[doc(hidden)]
pub mod fuzz;
mod keeper;
pub mod lds;
mod line;
mod listen;
mod listing;
mod liveness;
mod network_arguments;
mod presence;
pub mod scan;
mod security;
mod services;
pub mod ua_lds;
mod uses;
mod watch;
mod wire;

pub use announce::{AnnounceSettings, AnnounceState, ServerAnnouncement, announce};
pub use chosen::{Marks, find_lds};
pub use description::ServerDescription;
pub use listing::{ListingArguments, ServerQuery};
pub use mdns::{MdnsFault, MdnsInterface, host_name};
pub use network_arguments::NetworkArguments;
pub use presence::be_there;
/// The detected cause of the loss of a server.
pub use registry::ServerLoss;
pub use watch::{PresentServer, ServerChange, ServerWatcher, WatchSettings, watch};

/// The URL of the Local Discovery Server of a host (OPC 10000-12, 4.2.2).
pub const DEFAULT_LDS: &str = "opc.tcp://127.0.0.1:4840";
