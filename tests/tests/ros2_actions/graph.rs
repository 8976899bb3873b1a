//! An action in the graph of its peers: endpoints, their types, hashes and QoS, and their nodes.

use std::collections::BTreeSet;

use messages::{ActionTypeHashes, Dialect, TypeHash, TypeRegistry};
use ros2_node::domain::can_announce_type_hashes;
use serde_json::Value;
use system_tests::{Cell, Child, Peer};

use crate::ros2_actions::fibonacci::{self, ActionParticipant, DEFINITION, until};
use crate::ros2_actions::served::{options, serve};

/// Returns the graph as last printed by a peer.
fn graph(peer: &Child) -> Value {
    let lines = peer.json_lines();
    let mut graphs = lines.iter().filter_map(|line| line.get("graph"));
    graphs.next_back().cloned().unwrap_or_default()
}

/// Returns the GUID and the properties (type, user data) of the endpoint on a topic.
fn endpoint(graph: &Value, kind: &str, topic: &str) -> Option<(String, Value)> {
    let endpoints = graph[kind].as_object()?;
    let found = endpoints.iter().find(|(_, one)| one["topic"] == topic)?;
    Some((found.0.clone(), found.1.clone()))
}

/// Kind, topic, type and hash of an endpoint.
type WantedEndpoint = (&'static str, String, String, TypeHash);

/// Returns the endpoints of the server.
fn wanted(registry: &TypeRegistry, hashes: &ActionTypeHashes) -> Vec<WantedEndpoint> {
    let shared = |name: &str| name.parse().unwrap();
    let cancel = registry.service_type_hashes(&shared("action_msgs/CancelGoal"));
    let list = registry.type_hash(&shared("action_msgs/GoalStatusArray"));
    let own = "demo_msgs::action::dds_::Fibonacci";
    let feedback = format!("{own}_FeedbackMessage_");
    let status = "action_msgs::msg::dds_::GoalStatusArray_".to_owned();
    let topic = |name: &str| format!("rt/count/_action/{name}");
    let mut found = vec![
        (
            "publications",
            topic("feedback"),
            feedback,
            hashes.feedback_message,
        ),
        ("publications", topic("status"), status, list.unwrap()),
    ];
    for (name, types, hashes) in [
        (
            "send_goal",
            format!("{own}_SendGoal"),
            hashes.send_goal.clone(),
        ),
        (
            "get_result",
            format!("{own}_GetResult"),
            hashes.get_result.clone(),
        ),
        (
            "cancel_goal",
            "action_msgs::srv::dds_::CancelGoal".to_owned(),
            cancel.unwrap(),
        ),
    ] {
        let request = format!("rq/count/_action/{name}Request");
        found.push((
            "subscriptions",
            request,
            format!("{types}_Request_"),
            hashes.request,
        ));
        let reply = format!("rr/count/_action/{name}Reply");
        found.push((
            "publications",
            reply,
            format!("{types}_Response_"),
            hashes.response,
        ));
    }
    found
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_action_is_on_the_list_of_its_node_with_the_types_and_hashes_of_ros() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let peer = cell.cyclone("ros2_graph.py", &["--domain", "2", "--gid", "16"]);
    let ours = ActionParticipant::join();
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    let fibonacci = "demo_msgs/Fibonacci".parse().unwrap();
    registry.add_action(&fibonacci, DEFINITION).unwrap();
    let hashes = registry.action_type_hashes(&fibonacci, DEFINITION).unwrap();
    fibonacci::action().announce(&ours.domain, &hashes);
    let _serving = serve(&ours, options());
    let wanted = wanted(&registry, &hashes);
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
        let (guid, endpoint) = endpoint(&seen, kind, &topic).unwrap();
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
