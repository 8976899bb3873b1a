//! The ROS 1 side of a bridge.
//!
//! [`Ros1Port`] ties the topics of a ROS 1 graph to the values of the space: those the mapping names, and those whose
//! names are of the space, such as `/ua_1_2_10`. What crosses, and how its bytes look there, is not known here.

mod actions;
mod brought;
mod definitions;
mod ends;
mod port;
mod services;
mod sink;
mod source;
mod watcher;

pub use port::{PortOptions, Ros1Port};
