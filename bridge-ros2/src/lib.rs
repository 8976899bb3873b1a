//! The ROS 2 side of the bridge: the port that binds the topics, services and actions of a DDS
//! domain to the space, and the program with its arguments.
//!
//! The node in the domain is `ros2-node`.

mod definitions;
mod descriptors;
pub mod entry;
mod environment;
mod port;
mod ros_args;
mod sink;
mod source;

pub use port::{Ros2Port, Ros2PortOptions};

/// The name of the program.
pub(crate) const NAME: &str = "bridge-ros2";
