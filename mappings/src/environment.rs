//! What is there while a mapping is looked at: the graphs and the server it names, as somebody with sockets saw them.

use std::collections::{BTreeMap, BTreeSet};

use uadp::BuiltinType;

use crate::call::MethodTarget;
use crate::node_id::{ExpandedNodeIdText, NodeIdText};
use crate::topic::SpaceId;

/// What was asked for and found. What is missing here was not asked for, and says nothing.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// The ROS graphs, by their spaces.
    pub spaces: BTreeMap<SpaceId, LiveSpace>,
    /// The OPC UA server of the cell.
    pub server: Option<LiveServer>,
    /// What other OPC UA servers said of Methods of theirs that execute calls: nothing where all is well, else why one cannot
    /// be called, for people.
    pub methods: Vec<(MethodTarget, Option<String>)>,
    /// What other OPC UA servers said of nodes of theirs that variables come from or go to, by the name of the server and the
    /// text of the node id.
    pub remote: BTreeMap<(String, String), LiveRemote>,
}

impl Environment {
    /// What a server said of a node; `None` where it was not asked.
    pub(crate) fn remote(&self, server: &str, node: &ExpandedNodeIdText) -> Option<LiveRemote> {
        let key = (server.to_owned(), node.to_string());
        self.remote.get(&key).copied()
    }
}

/// What another server said of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LiveRemote {
    /// There is no such variable.
    Away,
    /// A variable.
    Variable {
        /// Its builtin type and whether it is an array, where the server says so.
        value: Option<(BuiltinType, bool)>,
        /// Whether whoever asked may read it.
        readable: bool,
        /// Whether whoever asked may write it.
        writable: bool,
    },
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

impl LiveSpace {
    /// The actions that somebody serves, by their names, with the types they have, as `nav2_msgs/NavigateToPose`: told by the
    /// topics of their feedback.
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
