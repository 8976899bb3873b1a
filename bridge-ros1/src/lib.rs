//! The ROS 1 side of a bridge.
//!
//! [`Ros1Port`] connects topics of a ROS 1 graph with values of the space: the topics in the
//! mapping, and topics with names of the space, such as `/ua_1_2_10`. The encoding of values in the
//! space is not part of this crate.

mod actions;
mod brought;
mod definitions;
mod ends;
pub mod entry;
mod port;
mod services;
mod sink;
mod source;
mod watcher;

pub use port::{Ros1Port, Ros1PortOptions};
