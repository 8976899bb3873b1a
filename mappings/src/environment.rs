//! What is there while a mapping is looked at: the graphs and the server it names, as somebody with sockets saw them.

use std::collections::{BTreeMap, BTreeSet};

use uadp::BuiltinType;

use crate::node_id::NodeIdText;
use crate::topic::SpaceId;

/// What was asked for and found. What is missing here was not asked for, and says nothing.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// The ROS graphs, by their spaces.
    pub spaces: BTreeMap<SpaceId, LiveSpace>,
    /// The OPC UA server of the cell.
    pub server: Option<LiveServer>,
}

/// A ROS graph as it was.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveSpace {
    /// By their names, with the leading `/`.
    pub topics: BTreeMap<String, LiveTopic>,
    /// Services by their names, with the types they have, as `std_srvs/SetBool`: several where servers disagree, none where
    /// nobody told. `None` where they were not asked for.
    pub services: Option<BTreeMap<String, BTreeSet<String>>>,
}

/// A topic as it was.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveTopic {
    /// Its message types, as `std_msgs/Bool`; several where publishers and subscribers disagree, none where nobody told.
    pub types: BTreeSet<String>,
    /// Somebody publishes it.
    pub published: bool,
    /// Somebody subscribes to it.
    pub subscribed: bool,
}

/// An OPC UA server as it was.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveServer {
    /// Its NamespaceArray: the URI of each index.
    pub namespaces: Vec<String>,
    /// The nodes that were asked for, by the text of their ids.
    pub nodes: BTreeMap<String, LiveNode>,
}

/// What a server said of a node it was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveNode {
    /// There is no such variable.
    Away,
    /// A variable; its builtin type and whether it is an array, where the server says so.
    Variable(Option<(BuiltinType, bool)>),
}

impl LiveServer {
    /// Whether the node's namespace index means the URI `uri` here, so that the node can be asked for by its id.
    #[must_use]
    pub fn agrees(&self, node: &NodeIdText, uri: Option<&str>) -> bool {
        let index = usize::from(node.namespace);
        node.namespace == 0 || self.namespaces.get(index).map(String::as_str) == uri
    }
}
