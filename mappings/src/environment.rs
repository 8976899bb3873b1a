//! The running cell while a mapping is checked: ROS graphs and OPC UA servers, as a program with
//! sockets queried them.

use std::collections::{BTreeMap, BTreeSet};

use uadp::BuiltinType;

use crate::call::MethodTarget;
use crate::node_id::{ExpandedNodeIdText, NodeIdText};
use crate::topic::SpaceId;

/// Results of queries. Names that are missing here were not queried, so nothing is reported about
/// them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// ROS graphs, by space.
    pub spaces: BTreeMap<SpaceId, LiveSpace>,
    /// The OPC UA server of the cell.
    pub server: Option<LiveServer>,
    /// Results for Methods of other OPC UA servers that execute calls: `None` if the Method can be
    /// called, else the reason, for users.
    pub methods: Vec<(MethodTarget, Option<String>)>,
    /// Results for nodes of other OPC UA servers that variables come from or are written to, by the
    /// name of the server and the text of the node id.
    pub remote: BTreeMap<(String, String), LiveRemote>,
}

impl Environment {
    /// Returns the result for a node of a server; `None` if it was not queried.
    pub(crate) fn remote(&self, server: &str, node: &ExpandedNodeIdText) -> Option<LiveRemote> {
        let key = (server.to_owned(), node.to_string());
        self.remote.get(&key).copied()
    }
}

/// Result of a query for a node of another server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveRemote {
    /// The server has no such variable.
    Away,
    /// A variable.
    Variable {
        /// Builtin type, and `true` for an array; `None` if the server does not provide it.
        value: Option<(BuiltinType, bool)>,
        /// `true` if the session of the query may read it.
        readable: bool,
        /// `true` if the session of the query may write it.
        writable: bool,
    },
}

/// State of a ROS graph.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveSpace {
    /// Topics by their names, with the leading `/`.
    pub topics: BTreeMap<String, LiveTopic>,
    /// Services by their names, with their types, such as `std_srvs/SetBool`. There are several
    /// types if servers disagree, and none if no server announces its type. `None` if services were
    /// not queried.
    pub services: Option<BTreeMap<String, BTreeSet<String>>>,
}

impl LiveSpace {
    /// Returns the actions that have a server, by their names, with their types, such as
    /// `nav2_msgs/NavigateToPose`. They are found by the topics of their feedback.
    #[must_use]
    pub fn actions(&self) -> BTreeMap<&str, BTreeSet<String>> {
        let mut actions: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
        for (topic, live) in self.topics.iter().filter(|(_, live)| live.published) {
            let (name, end) = match topic.strip_suffix("/_action/feedback") {
                Some(name) => (name, "_FeedbackMessage"),
                None => match topic.strip_suffix("/feedback") {
                    Some(name) => (name, "ActionFeedback"),
                    None => continue,
                },
            };
            let types = live.types.iter().filter_map(|kind| kind.strip_suffix(end));
            let types: BTreeSet<String> = types.map(str::to_owned).collect();
            if !name.is_empty() && !types.is_empty() {
                actions.insert(name, types);
            }
        }
        actions
    }
}

/// State of a topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveTopic {
    /// Message types, such as `std_msgs/Bool`; several if publishers and subscribers disagree, none
    /// if no node announces the type.
    pub types: BTreeSet<String>,
    /// `true` if the topic has a publisher.
    pub published: bool,
    /// `true` if the topic has a subscriber.
    pub subscribed: bool,
}

/// State of an OPC UA server.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LiveServer {
    /// Its NamespaceArray: the URI of each index.
    pub namespaces: Vec<String>,
    /// Results for the nodes that were queried, by the text of their ids.
    pub nodes: BTreeMap<String, LiveNode>,
}

/// Result of a query for a node of the cell's server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveNode {
    /// The server has no such variable.
    Away,
    /// A variable, with its builtin type and `true` for an array; `None` if the server does not
    /// provide the type.
    Variable(Option<(BuiltinType, bool)>),
}

impl LiveServer {
    /// Returns `true` if the node's namespace index means `uri` at this server, so that the node
    /// can be queried by its id.
    #[must_use]
    pub fn agrees(&self, node: &NodeIdText, uri: Option<&str>) -> bool {
        let index = usize::from(node.namespace);
        node.namespace == 0 || self.namespaces.get(index).map(String::as_str) == uri
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_of_either_ros_are_told_by_their_feedback() {
        let topic = |name: &str, kind: &str, published| {
            let live = LiveTopic {
                types: BTreeSet::from([kind.to_owned()]),
                published,
                subscribed: !published,
            };
            (name.to_owned(), live)
        };
        let live = LiveSpace {
            topics: [
                topic(
                    "/nav/_action/feedback",
                    "nav2_msgs/Nav_FeedbackMessage",
                    true,
                ),
                topic("/move/feedback", "a_msgs/MoveActionFeedback", true),
                topic("/asked/feedback", "a_msgs/MoveActionFeedback", false),
                topic("/user/feedback", "std_msgs/String", true),
            ]
            .into(),
            services: None,
        };
        let actions = live.actions();
        let actions: Vec<(&str, &str)> = actions
            .iter()
            .map(|(name, types)| (*name, types.first().map_or("", String::as_str)))
            .collect();
        assert_eq!(
            actions,
            [("/move", "a_msgs/Move"), ("/nav", "nav2_msgs/Nav")]
        );
    }
}
