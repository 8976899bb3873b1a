//! The names of the space, and the YAML that ties them to ROS topics and OPC UA nodes.

mod topic;

pub use topic::{Part, SpaceId, TopicError, TopicId};
