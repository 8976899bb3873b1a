//! The available OPC UA servers: the state of a Local Discovery Server (OPC 10000-12, 4) without
//! its sockets.
//!
//! A [`ServerRegistry`] has three sources of servers. Servers register
//! ([`ServerRegistry::register`]; FindServers lists them), they are announced by mDNS
//! ([`ServerRegistry::announced`]), or a Global Discovery Server lists them
//! ([`ServerRegistry::listed`], [`Listing`]), for servers that multicast does not reach.
//! FindServersOnNetwork lists announced servers, registered servers with an mDNS name, and listed
//! servers that answer. All of them are supervised: [`ServerRegistry::poll_probe`] returns the
//! endpoint to probe, and a server that does not answer is lost within
//! [`RegistrySettings::lost_after`], with or without a goodbye.
//!
//! Time is a parameter, and there is no socket, no clock and no randomness. After every call drain
//! [`ServerRegistry::poll_event`]; when [`ServerRegistry::poll_timeout`] has passed, call
//! [`ServerRegistry::handle_timeout`].

mod asked;
pub mod hierarchy;
mod listing;
mod loss;
mod name;
mod network;
mod registry;
mod share;
mod watch;

pub use asked::{ApplicationType, Channel, MdnsConfiguration, RegisterFault, RegistrationRequest};
pub use listing::{Ignored, ListedServer, Listing, ListingSettings};
pub use loss::ServerLoss;
pub use name::{instance_name, label, renamed};
pub use network::{AnnouncedServer, NetworkRecord, RecordSource};
pub use registry::{Registered, RegistryEvent, RegistrySettings, ServerRegistry};
pub use watch::{EndpointProbe, ProbeOutcome, spread};
