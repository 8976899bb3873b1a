//! The action servers of the graph: nodes with the topics of an action.

use messages::TypeName;
use tcpros::MasterGraph;

/// Returns the actions that nodes other than `own` serve.
pub(super) fn served<'g>(graph: &'g MasterGraph, own: &str) -> impl Iterator<Item = &'g str> {
    let goals = graph.subscribers.keys();
    let actions = goals.filter_map(|topic| topic.strip_suffix("/goal"));
    actions.filter(move |action| server(graph, own, action).is_some())
}

/// Returns another node that serves the action: it subscribes to goal and cancel, and publishes
/// status, feedback and result.
pub(super) fn server<'g>(graph: &'g MasterGraph, own: &str, action: &str) -> Option<&'g str> {
    server_of(graph, |node| node != own, action)
}

/// Returns a node for which `is_other` holds and that serves the action.
pub(super) fn server_of<'g>(
    graph: &'g MasterGraph,
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
pub(super) fn type_of(graph: &MasterGraph, action: &str) -> Option<TypeName> {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(nodes: [&str; 5]) -> MasterGraph {
        let named = |topic: &str, node: &str| (format!("/count/{topic}"), vec![node.to_owned()]);
        let [goal, cancel, status, feedback, result] = nodes;
        MasterGraph {
            subscribers: [named("goal", goal), named("cancel", cancel)].into(),
            publishers: [
                named("status", status),
                named("feedback", feedback),
                named("result", result),
            ]
            .into(),
            ..MasterGraph::default()
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
