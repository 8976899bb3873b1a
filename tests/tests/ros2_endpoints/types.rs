//! Types that nodes tell one another.

use bridge_node::PortEvent;
use serde_json::json;
use system_tests::{Cell, Peer};

use crate::peer::{SOON, writes};
use crate::port::{bound, event, port, run_until, topic};

const UNKNOWN: &str = "type_description_interfaces/FieldType";

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_type_that_is_not_known_here_is_told_by_the_node_that_publishes_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let peer = cell.cyclone("ros2_describe.py", &["serve"]);
    assert_eq!(bound(&mut port, topic("ua_2_2_9")).await, UNKNOWN);
    let payload = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!((payload[4], payload[12], payload[20]), (7, 8, 9));
    let asked = peer.json_lines();
    let asked: Vec<_> = asked
        .iter()
        .filter(|line| line.get("asked").is_some())
        .collect();
    assert_eq!(asked.len(), 1, "{asked:?}");
    assert_eq!(
        asked[0]["asked"],
        "type_description_interfaces/msg/FieldType"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_description_that_is_not_of_the_announced_hash_is_not_believed() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _peer = cell.cyclone("ros2_describe.py", &["serve", "--lie"]);
    let why = event(&mut port, |event| match event {
        PortEvent::Bound { .. } => Some("bound"),
        PortEvent::Lost { why, .. } => Some(why),
        _ => None,
    })
    .await;
    assert_eq!(why, "type without a definition");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_node_tells_what_the_types_are_it_reads() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _writer = writes(
        &cell,
        "/ua_2_2_3",
        "sensor_msgs/JointState",
        &["--value", "{}"],
    );
    bound(&mut port, topic("ua_2_2_3")).await;
    let ask = ["ask", "--type", "sensor_msgs/msg/JointState"];
    let peer = cell.cyclone("ros2_describe.py", &ask);
    run_until(&mut port, "an answer", || !peer.values().is_empty()).await;
    assert_eq!(
        peer.values(),
        [json!({
            "successful": true,
            "reason": "",
            "type": "sensor_msgs/msg/JointState",
            "fields": [
                ["header", 1, "std_msgs/msg/Header"],
                ["name", 161, ""],
                ["position", 155, ""],
                ["velocity", 155, ""],
                ["effort", 155, ""],
            ],
            "referenced": ["builtin_interfaces/msg/Time", "std_msgs/msg/Header"],
        })],
        "{SOON:?}"
    );
}
