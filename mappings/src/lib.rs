//! The names of the space, and the YAML that ties them to ROS topics and OPC UA nodes.

mod mapping;
mod node_id;
mod topic;

pub use mapping::{
    Binding, Endpoint, Mapping, Overflow, PubSub, PublisherIdRule, SecurityPolicy, Server, Space,
    Variable,
};
pub use node_id::{Identifier, NodeIdError, NodeIdText};
pub use topic::{Part, SpaceId, TopicError, TopicId};
