//! Programs report missing peers: each common mistake of an integrator is named in one log line.

use std::time::Duration;

use system_tests::{
    Cell, Child, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, Peer, http_answer, metrics,
};

const SOON: Duration = Duration::from_secs(30);
const HEAD: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:cell}
";

/// Writes a mapping with the common head.
fn mapping(cell: &Cell, name: &str, text: &str) -> String {
    let file = cell.file(name, &format!("{HEAD}{text}"));
    file.to_str().unwrap().to_owned()
}

/// Publishes a Bool on `topic` until it is dropped.
fn publisher(cell: &Cell, node: &str, topic: &str) -> Child {
    let bool = "std_msgs/Bool";
    let args = [
        topic, bool, "--node", node, "--repeat", "0", "--value", "true",
    ];
    cell.rospy("ros1_pub.py", &args)
}

#[test]
fn a_ros_1_bridge_names_what_is_misspelt_missing_or_out_of_reach_and_withdraws_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _robot = publisher(&cell, "robot", "/start_button");
    let text = "
variables:
  - {node: ns=2;i=10, name: Typo, origin: 1, ros: {topic: /start_buton, type: std_msgs/Bool}}
  - {node: ns=2;i=11, name: Origin, origin: 2, ros: {space: 1, topic: /start_button, type: std_msgs/Bool}}
calls:
  - {node: ns=2;i=60, name: Call, origin: 1, ros: {service: /no_such, type: std_srvs/SetBool}}
";
    let file = mapping(&cell, "mistakes.yaml", text);
    let mut bridge = cell.bridge_ros1(&[&file]);
    let line = bridge.wait_for_line("waiting for: ", SOON);
    for expected in [
        "topic /start_buton (no publisher; did you mean /start_button?)",
        "subscriber of /start_button (no node subscribes to it, and /robot publishes it too",
        "service /no_such (no server)",
        "space 2 (nothing received on lo",
    ] {
        assert!(line.contains(expected), "{expected}: {line}");
    }
    let status = metrics(METRICS_ROS1).unwrap();
    assert_eq!(status["waiting_for"].as_array().map(Vec::len), Some(4));
    let (code, ready) = http_answer(METRICS_ROS1, "/readyz").unwrap();
    assert_eq!(code, 200);
    assert!(ready.contains("waiting for topic /start_buton"), "{ready}");
    let _late = publisher(&cell, "late", "/start_buton");
    bridge.wait_for_line("no longer waiting for: topic /start_buton", SOON);
}

#[test]
fn a_ros_1_subscriber_that_cannot_reach_the_bridge_is_named() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let bool = "std_msgs/Bool";
    let _robot = cell.rospy("ros1_sub.py", &["/lamp", bool]);
    let text = "
variables:
  - {node: ns=2;i=10, name: Lamp, origin: 0, ros: {space: 1, topic: /lamp, type: std_msgs/Bool}}
";
    let file = mapping(&cell, "lamp.yaml", text);
    // An address that no interface has: packets to it are lost.
    let bridge = cell.bridge_ros1_started(&[&file]);
    let mut bridge = bridge
        .env("ROS_HOSTNAME", "")
        .env("ROS_IP", "10.77.0.1")
        .start();
    let line = bridge.wait_for_line("waiting for: ", SOON);
    for expected in [
        "it cannot reach http://10.77.0.1:",
        "set ROS_IP",
        "10.77.0.1, which is not an address of this host",
        "space 0 (nothing received on lo",
    ] {
        assert!(line.contains(expected), "{expected}: {line}");
    }
}

#[test]
fn an_empty_domain_and_a_space_of_which_nothing_is_received_are_named() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let text = "
variables:
  - {node: ns=2;i=10, name: B, origin: 2, ros: {topic: /start_button, type: std_msgs/Bool}}
";
    let file = mapping(&cell, "domain.yaml", text);
    let mut server = cell.ua_server(&[&file]);
    let line = server.wait_for_line("waiting for: ", SOON);
    assert!(line.contains("space 2 (nothing received on lo"), "{line}");
    let mut bridge = cell.bridge_ros2(&[&file]);
    let line = bridge.wait_for_line("waiting for: ", SOON);
    assert!(
        line.contains("nodes in DDS domain 2 (no participant"),
        "{line}"
    );
    // The bridge is present, although it has no value.
    server.wait_for_line("no longer waiting for: space 2", SOON);
    assert_eq!(
        metrics(METRICS_SERVER).unwrap()["waiting_for"]
            .as_array()
            .map(Vec::len),
        Some(0)
    );
    drop(bridge);
    let other = cell.bridge_ros2_alone(&[&file]);
    let mut other = other.args(["--domain", "3"]).start();
    let line = other.wait_for_line("waiting for: ", SOON);
    assert!(line.contains("the mapping declares only 1, 2"), "{line}");
    assert!(metrics(METRICS_ROS2).is_some());
}
