//! Which OPC UA servers are there: the knowledge of a Local Discovery Server (OPC 10000-12, 4) without its sockets.
//!
//! A [`Registry`] hears of servers in two ways. They register ([`Registry::register`]; FindServers lists those), and they are
//! announced by mDNS ([`Registry::announced`]; FindServersOnNetwork lists those and the ones that registered with a name for
//! it). Whoever was heard of is looked after: [`Registry::poll_probe`] says whose endpoint to try, and who does not answer is
//! lost within [`Settings::lost_after`], with a goodbye or without.
//!
//! Time is a parameter, and there is no socket, no clock and no randomness. After every call drain
//! [`Registry::poll_event`]; when [`Registry::poll_timeout`] has passed, call [`Registry::handle_timeout`].

mod asked;
pub mod hierarchy;
mod loss;
mod name;
mod network;
mod registry;
mod share;
mod watch;

pub use asked::{ApplicationType, Asked, Channel, MdnsConfiguration, RegisterFault};
pub use loss::Loss;
pub use name::{instance_name, label, renamed};
pub use network::{Announcement, NetworkRecord};
pub use registry::{Event, Registered, Registry, Settings};
pub use watch::{Outcome, Probe, spread};
