//! What the programs of the space share: the port trait, the run loop, arguments, logging and metrics.
//!
//! It does not know which ROS it serves (that is the [`Port`]) nor how UADP bytes look (that is `bridge-core`).

mod port;

pub use port::{Delivery, Port, PortEvent};
