//! The ROS 2 side of the bridge: topics of a DDS domain as bytes, and the port that ties them to the space.
//!
//! Discovery, reliability and fragments are RustDDS'; `ros2-client` gives the process its ROS node. The samples
//! themselves go past both as bytes, because their types are known at run time only.

mod cdr;
mod definitions;
pub mod domain;
pub mod graph;
pub mod inbox;
pub mod outlet;
pub mod parameters;
mod port;
pub mod qos;
pub mod raw;
pub mod service;
mod sink;
mod source;

pub use port::{PortOptions, Ros2Port};
