//! The ROS 2 side of the bridge: topics of a DDS domain as bytes, and the port that binds them to
//! the space.
//!
//! RustDDS provides discovery, reliability and fragmentation; this crate makes a participant a ROS
//! node. Samples pass through RustDDS as bytes, because their types are known only at run time.

pub mod action;
mod cdr;
pub mod clock;
pub mod compatibility;
mod definitions;
mod descriptors;
pub mod discovery_info;
pub mod domain;
#[cfg(feature = "patched-dds")]
mod driver;
pub mod entry;
pub mod environment;
pub mod graph;
pub mod inbox;
pub mod limits;
pub mod node;
pub mod outlet;
pub mod parameters;
mod port;
pub mod qos;
pub mod raw;
mod ros_args;
mod rosout;
pub mod security;
pub mod service;
mod sink;
mod source;
mod type_description;

pub use port::{PortOptions, Ros2Port};
pub use ros_args::RosArgs;
