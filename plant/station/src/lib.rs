//! One level of a plant: a workstation that hides its devices from the level above, and hides that level from them.
//!
//! It is a Local Discovery Server for the level below ([`discovery::lds`]) and one application with two faces: a server on
//! the level above that shows the methods of the devices, and one on the level below that shows the methods of the
//! neighbours above. What is called there is passed on. No address of one level is told on the other.
//!
//! Whoever comes on the level below is configured: the station connects, holds the certificate against what is registered,
//! and calls the method `Configure` of the component with its place in the plant.
//!
//! Reading order: `configure` (the method), `mirror` (which methods a server has), `callers` (who may call them), `face` (how they are shown), `board` (what
//! is known), `tend` (one server's life), `marks` (looking for a node), `station` (all of it).

mod board;
mod callers;
mod configure;
pub mod entry;
mod face;
mod marks;
mod mirror;
mod station;
mod tend;

pub use station::{StationSettings, Upper, run};
