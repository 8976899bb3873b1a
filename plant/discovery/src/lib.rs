//! Who is there: the registry of [`registry`] with sockets around it.
//!
//! [`announce`] tells of a server: by mDNS to whoever is on the network, and by registration to the Local Discovery
//! Server. [`watch`] tells who is there. [`mdns::tell_bridge`] tells of a program that carries a space. [`lds`] is the Local Discovery Server itself, the program `ua-lds`.
//!
//! Reading order: `url`, `interface` and `address` (where), `mdns` and `goodbye` (announcements and what is heard of others), `wire` (OPC UA
//! over TCP), `client` (asking by it), `line` and `liveness` (who still answers), `keeper` (all of that around one registry),
//! `watch`, `scan`, `chosen`, `announce` and `bridges` (for programs), `endpoint`, `connection`, `security` and `services` (answering by it), `lds`, `embedded` (the same within another program), `presence`.

mod address;
mod announce;
mod chosen;
pub mod client;
mod clock;
mod connection;
mod embedded;
mod endpoint;
#[doc(hidden)]
pub mod fuzz;
mod keeper;
pub mod lds;
mod line;
mod liveness;
mod presence;
pub mod scan;
mod security;
mod services;
pub mod ua_lds;
mod watch;
mod wire;

pub use announce::{AnnounceSettings, AnnounceState, Announced, Server, announce};
pub use chosen::{Marks, find_lds};
pub use mdns::{Interface, MdnsFault, host_name};
pub use presence::be_there;
/// How it is known that a server is gone.
pub use registry::Loss;
pub use watch::{Found, Known, WatchSettings, Watcher, watch};

/// Where the Local Discovery Server of a host is (OPC 10000-12, 4.2.2).
pub const DEFAULT_LDS: &str = "opc.tcp://127.0.0.1:4840";
