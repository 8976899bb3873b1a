//! One level of a plant: a workstation that hides its devices from the level above, and hides that
//! level from the devices.
//!
//! A station is a Local Discovery Server for the level below ([`discovery::lds`]) and an
//! application with two faces. The face above shows the objects, variables and methods of the
//! devices, the face below shows the nodes of the neighbours above. Calls and writes are forwarded,
//! values and events are repeated. Addresses of one level are not visible on the other.
//!
//! Servers that appear on the level below are configured: the station connects, compares the
//! certificate with the registration, and calls the method `Configure` of the component with its
//! place in the plant.
//!
//! Reading order:
//!
//! - `configure`: the method
//! - `mirror`: the nodes of a server
//! - `copy`: these nodes on the other level
//! - `feed`: their values and events
//! - `callers`: the permissions of callers
//! - `face`: the servers that show methods
//! - `board`: the state of both levels
//! - `budget`: the number of nodes that a face shows
//! - `tend`: the supervision of a server
//! - `marks`: the search for a node
//! - `station`: the complete station

mod board;
mod budget;
mod callers;
mod configure;
mod copy;
pub mod entry;
mod face;
mod feed;
mod looks;
mod marks;
mod mirror;
mod station;
mod tend;

pub use station::{StationSettings, Upper, run};
