//! What others see of an action: endpoints, their types, hashes and quality, and whose they are.

use std::collections::BTreeSet;

use bridge_ros2::domain::can_announce_type_hashes;
use messages::{Dialect, Registry};
use serde_json::Value;
use system_tests::{Cell, Child, Peer};

use crate::fibonacci::{self, DEFINITION, Ours, until};
use crate::served::{options, serve};

/// The graph as a peer last printed it.
fn graph(peer: &Child) -> Value {
    let lines = peer.json_lines();
    let graphs = lines.iter().filter_map(|line| line.get("graph"));
    graphs.last().cloned().unwrap_or_default()
}

/// Guid, type and user data of the endpoint on a topic.
fn endpoint(graph: &Value, kind: &str, topic: &str) -> Option<(String, Value)> {
    let endpoints = graph[kind].as_object()?;
    let found = endpoints.iter().find(|(_, one)| one["topic"] == topic)?;
    Some((found.0.clone(), found.1.clone()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_action_is_on_the_list_of_its_node_with_the_types_and_hashes_of_ros() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let peer = cell.cyclone("ros2_graph.py", &["--domain", "2", "--gid", "16"]);
    let ours = Ours::join();
    let mut registry = Registry::bundle(Dialect::Ros2);
    let fibonacci = "demo_msgs/Fibonacci".parse().unwrap();
    registry.add_action(&fibonacci, DEFINITION).unwrap();
    let hashes = registry.action_type_hashes(&fibonacci, DEFINITION).unwrap();
    fibonacci::action().announce(&ours.domain, &hashes);
    let _serving = serve(&ours, options());
    let cancel = registry
        .service_type_hashes(&"action_msgs/CancelGoal".parse().unwrap())
        .unwrap();
    let list = registry
        .type_hash(&"action_msgs/GoalStatusArray".parse().unwrap())
        .unwrap();
    let wanted = [
        (
            "subscriptions",
            "rq/count/_action/send_goalRequest",
            "demo_msgs::action::dds_::Fibonacci_SendGoal_Request_",
            &hashes.send_goal.request,
        ),
        (
            "publications",
            "rr/count/_action/send_goalReply",
            "demo_msgs::action::dds_::Fibonacci_SendGoal_Response_",
            &hashes.send_goal.response,
        ),
        (
            "subscriptions",
            "rq/count/_action/cancel_goalRequest",
            "action_msgs::srv::dds_::CancelGoal_Request_",
            &cancel.request,
        ),
        (
            "publications",
            "rr/count/_action/cancel_goalReply",
            "action_msgs::srv::dds_::CancelGoal_Response_",
            &cancel.response,
        ),
        (
            "subscriptions",
            "rq/count/_action/get_resultRequest",
            "demo_msgs::action::dds_::Fibonacci_GetResult_Request_",
            &hashes.get_result.request,
        ),
        (
            "publications",
            "rr/count/_action/get_resultReply",
            "demo_msgs::action::dds_::Fibonacci_GetResult_Response_",
            &hashes.get_result.response,
        ),
        (
            "publications",
            "rt/count/_action/feedback",
            "demo_msgs::action::dds_::Fibonacci_FeedbackMessage_",
            &hashes.feedback_message,
        ),
        (
            "publications",
            "rt/count/_action/status",
            "action_msgs::msg::dds_::GoalStatusArray_",
            &list,
        ),
    ];
    until("all are announced", || {
        let graph = graph(&peer);
        wanted
            .iter()
            .all(|(kind, topic, ..)| endpoint(&graph, kind, topic).is_some())
    })
    .await;
    let seen = graph(&peer);
    let mut guids = BTreeSet::new();
    for (kind, topic, type_name, hash) in wanted {
        let (guid, endpoint) = endpoint(&seen, kind, topic).unwrap();
        assert_eq!(endpoint["type"], type_name);
        let told = if can_announce_type_hashes() {
            format!("typehash={hash};")
        } else {
            String::new()
        };
        assert_eq!(endpoint["user_data"], told, "{topic}");
        let reliability = endpoint["reliability"].to_string();
        assert!(reliability.contains("Reliable"), "{reliability}");
        let durable = endpoint["durability"]
            .to_string()
            .contains("TransientLocal");
        assert_eq!(durable, topic.ends_with("/status"), "{topic}");
        guids.insert(guid);
    }
    until("the node has them all on its list", || {
        let graph = graph(&peer);
        let nodes = graph["nodes"]
            .as_object()
            .into_iter()
            .flat_map(|nodes| nodes.values());
        let mut nodes = nodes.flat_map(|nodes| nodes.as_array().unwrap());
        let Some(node) = nodes.find(|node| node["name"] == "/actions") else {
            return false;
        };
        let listed = |kind: &str| -> BTreeSet<String> {
            let guids = node[kind].as_array().unwrap().iter();
            guids
                .map(|guid| guid.as_str().unwrap().to_owned())
                .collect()
        };
        guids.is_subset(&(&listed("readers") | &listed("writers")))
    })
    .await;
}
