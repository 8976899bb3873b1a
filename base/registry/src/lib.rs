//! The available OPC UA servers: the state of a Local Discovery Server (OPC 10000-12, 4) without
//! its sockets.
//!
//! A [`Registry`] has three sources of servers. Servers register ([`Registry::register`];
//! FindServers lists them), they are announced by mDNS ([`Registry::announced`]), or a Global
//! Discovery Server lists them ([`Registry::listed`], [`Listing`]), for servers that multicast does
//! not reach. FindServersOnNetwork lists announced servers, registered servers with an mDNS name,
//! and listed servers that answer. All of them are supervised: [`Registry::poll_probe`] returns the
//! endpoint to probe, and a server that does not answer is lost within [`Settings::lost_after`],
//! with or without a goodbye.
//!
//! Time is a parameter, and there is no socket, no clock and no randomness. After every call drain
//! [`Registry::poll_event`]; when [`Registry::poll_timeout`] has passed, call
//! [`Registry::handle_timeout`].

mod asked;
pub mod hierarchy;
mod listing;
mod loss;
mod name;
mod network;
mod registry;
mod share;
mod watch;

pub use asked::{ApplicationType, Asked, Channel, MdnsConfiguration, RegisterFault};
pub use listing::{Ignored, ListedServer, Listing, ListingSettings};
pub use loss::Loss;
pub use name::{instance_name, label, renamed};
pub use network::{Announcement, NetworkRecord, RecordSource};
pub use registry::{Event, Registered, Registry, Settings};
pub use watch::{Outcome, Probe, spread};
