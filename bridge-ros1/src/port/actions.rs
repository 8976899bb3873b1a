//! Offers actions of other spaces as action servers of the graph, and executes action servers of
//! the graph for other spaces.

use std::sync::Arc;

use bridge_node::{Actions, Present};
use mappings::TopicId;
use messages::TypeName;
use tcpros::Graph;

use super::Ros1Port;
use super::calls::is_redundant_peer;
use crate::services::Ros1Graph;

impl Ros1Port {
    /// Offers the known actions. An action under a name from the mapping gives way to an action
    /// server of another node, because both servers would take each goal.
    pub(super) fn offer_actions(&mut self) {
        let (graph, own) = (&self.graph, self.node.name());
        let is_redundant = self.is_redundant;
        let is_other = |node: &str| node != own && !(is_redundant && is_redundant_peer(own, node));
        let other = |action: &str| server_of(graph, is_other, action);
        let is_chosen = |topic: TopicId, action: &str| action != format!("/{topic}");
        for (topic, action) in self.actions.chosen(&self.policy) {
            if let Some(node) = other(&action) {
                self.policy.told.once(&action, "taken", || {
                    format!(
                        "{topic} is not offered as {action}: the node {node} already serves this action; \
                         use another name, or stop the node"
                    )
                });
            }
        }
        let left =
            |topic: TopicId, action: &str| is_chosen(topic, action) && other(action).is_some();
        self.actions.leave(left);
        if !self.actions.is_waiting() {
            return;
        }
        let mut ros = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        // The owners of names are known once the master has responded.
        let has_master = self.has_master;
        let may = |topic: TopicId, action: &str| {
            !left(topic, action) && (has_master || !is_chosen(topic, action))
        };
        let calls = &self.calls;
        let asker = |topic| calls.asker(topic);
        let policy = &mut self.policy;
        let events = self
            .actions
            .offer_waiting((&mut ros, policy), asker, may, usize::MAX);
        self.events.extend(events);
    }

    /// Offers the action servers of other nodes that are actions of this space, and withdraws
    /// actions of lost servers.
    pub(super) fn find_actions(&mut self) {
        let mapping = Arc::clone(self.policy.mapping());
        let mapped = Actions::mapped(&mapping, &self.policy);
        let (graph, own) = (&self.graph, self.node.name());
        let mut present = Present::new();
        for topic in graph.subscribers.keys() {
            let Some(action) = topic.strip_suffix("/goal") else {
                continue;
            };
            let wanted = mapped.contains(action) || Actions::is_named(&self.policy, action);
            if action.len() > MAX_NAME || !wanted || server(graph, own, action).is_none() {
                continue;
            }
            present.insert(action.to_owned(), type_of(graph, action));
        }
        let mut ros = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        let policy = &mut self.policy;
        let events = self
            .actions
            .reconcile(&mut ros, policy, (&present, usize::MAX));
        self.events.extend(events);
    }
}

/// Returns the actions that nodes other than `own` serve.
pub(super) fn served<'g>(graph: &'g Graph, own: &str) -> impl Iterator<Item = &'g str> {
    let goals = graph.subscribers.keys();
    let actions = goals.filter_map(|topic| topic.strip_suffix("/goal"));
    actions.filter(move |action| server(graph, own, action).is_some())
}

/// Returns another node that serves the action: it subscribes to goal and cancel, and publishes
/// status, feedback and result.
pub(super) fn server<'g>(graph: &'g Graph, own: &str, action: &str) -> Option<&'g str> {
    server_of(graph, |node| node != own, action)
}

fn server_of<'g>(
    graph: &'g Graph,
    is_other: impl Fn(&str) -> bool,
    action: &str,
) -> Option<&'g str> {
    let subscribed = |topic: &str| graph.subscribers.get(&format!("{action}/{topic}"));
    let published = |topic: &str| graph.publishers.get(&format!("{action}/{topic}"));
    let others = [
        subscribed("cancel")?,
        published("status")?,
        published("feedback")?,
        published("result")?,
    ];
    let mut nodes = subscribed("goal")?.iter();
    let found = nodes
        .find(|node| is_other(node) && others.iter().all(|names| names.iter().any(|n| n == *node)));
    found.map(String::as_str)
}

/// Returns the type of an action from the types of its topics, as far as the master knows them. The
/// master has the type `*` for a topic without publishers that is subscribed with any type.
fn type_of(graph: &Graph, action: &str) -> Option<TypeName> {
    let parts = [
        ("goal", "ActionGoal"),
        ("result", "ActionResult"),
        ("feedback", "ActionFeedback"),
    ];
    parts.iter().find_map(|(topic, ending)| {
        let named = graph.types.get(&format!("{action}/{topic}"))?;
        named.strip_suffix(ending)?.parse().ok()
    })
}

/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 255;

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(nodes: [&str; 5]) -> Graph {
        let named = |topic: &str, node: &str| (format!("/count/{topic}"), vec![node.to_owned()]);
        let [goal, cancel, status, feedback, result] = nodes;
        Graph {
            subscribers: [named("goal", goal), named("cancel", cancel)].into(),
            publishers: [
                named("status", status),
                named("feedback", feedback),
                named("result", result),
            ]
            .into(),
            ..Graph::default()
        }
    }

    #[test]
    fn a_server_has_all_topics_of_its_action_and_is_another_node() {
        let whole = graph(["/robot"; 5]);
        assert_eq!(server(&whole, "/bridge", "/count"), Some("/robot"));
        assert_eq!(server(&whole, "/robot", "/count"), None);
        assert_eq!(server(&whole, "/bridge", "/other"), None);
        for missing in 0..5 {
            let mut nodes = ["/robot"; 5];
            nodes[missing] = "/other";
            assert_eq!(
                server(&graph(nodes), "/bridge", "/count"),
                None,
                "{nodes:?}"
            );
        }
    }

    #[test]
    fn the_type_is_that_of_the_first_topic_that_has_one() {
        let mut known = graph(["/robot"; 5]);
        let mut set = |topic: &str, name: &str| {
            known
                .types
                .insert(format!("/count/{topic}"), name.to_owned());
            type_of(&known, "/count").map(|name| name.to_string())
        };
        assert_eq!(set("goal", "*"), None);
        assert_eq!(set("feedback", "std_msgs/String"), None);
        let found = Some("actionlib/Test".to_owned());
        assert_eq!(set("result", "actionlib/TestActionResult"), found);
        let found = Some("actionlib/TwoInts".to_owned());
        assert_eq!(set("goal", "actionlib/TwoIntsActionGoal"), found);
    }
}
