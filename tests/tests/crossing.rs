//! Values between spaces, with real peers on both ends, compared with their types.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, eventually};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const PLANT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml");

fn value(line: &Value) -> Option<Value> {
    line.get("value").cloned()
}

fn joints() -> Value {
    json!({"header": {"frame_id": "base_link"}, "name": ["joint_1", "joint_2"],
           "position": [0.1, -1.5e-3], "velocity": [], "effort": [12.25]})
}

/// Compares the fields of a JointState that both ROS versions have: only ROS 1 has a sequence
/// number in the header.
fn same_joints(heard: &Value) {
    let sent = joints();
    for field in ["name", "position", "velocity", "effort"] {
        assert_eq!(heard[field], sent[field], "{field} of {heard}");
    }
    assert_eq!(heard["header"]["frame_id"], sent["header"]["frame_id"]);
}

/// Starts a rospy node, named after the topic, that publishes the value ten times a second.
fn in_ros1(cell: &Cell, topic: &str, kind: &str, value: &Value) -> Child {
    let node = topic.replace('/', "_");
    let value = value.to_string();
    cell.rospy(
        "ros1_pub.py",
        &[
            topic, kind, "--node", &node, "--repeat", "0", "--value", &value,
        ],
    )
}

/// Starts a Cyclone DDS writer in domain 2 that publishes the value ten times a second.
fn in_ros2(cell: &Cell, topic: &str, kind: &str, value: &Value) -> Child {
    let value = value.to_string();
    cell.cyclone(
        "ros2_pub.py",
        &[
            topic, kind, "--domain", "2", "--repeat", "0", "--value", &value,
        ],
    )
}

#[test]
fn a_string_crosses_from_ros_1_to_ros_2_without_a_mapping() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"grüße\"",
        ],
    );
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_10", "std_msgs/String", "--domain", "2"],
    );
    let got = heard.wait_for_json("the string in ROS 2", SOON, value);
    assert_eq!(got, json!({"data": "grüße"}));
}

#[test]
fn a_string_crosses_from_ros_2_to_ros_1_without_a_mapping() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let topic = ["/ua_2_5_10", "std_msgs/String"];
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &topic[..],
            &["--domain", "2", "--repeat", "0", "--value", "\"grüße\""],
        ]
        .concat(),
    );
    let mut heard = cell.rospy("ros1_sub.py", &topic);
    let line = heard.wait_for_json("the string in ROS 1", SOON, |line| {
        value(line).map(|_| line.clone())
    });
    assert_eq!(line["value"], json!({"data": "grüße"}));
    assert_eq!(line["type"], "std_msgs/String");
}

#[test]
fn a_joint_state_crosses_from_ros_1_to_ros_2_without_a_mapping() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let topic = ["/ua_1_5_11", "sensor_msgs/JointState"];
    let mut heard = cell.cyclone("ros2_sub.py", &[&topic[..], &["--domain", "2"]].concat());
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            &topic[..],
            &["--repeat", "0", "--value", &joints().to_string()],
        ]
        .concat(),
    );
    same_joints(&heard.wait_for_json("the joints in ROS 2", SOON, value));
}

#[test]
fn a_joint_state_crosses_from_ros_2_to_ros_1_without_a_mapping() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let topic = ["/ua_2_5_11", "sensor_msgs/JointState"];
    let mut sent = joints();
    sent["header"]["stamp"] = json!({"sec": 1_700_000_000, "nanosec": 123_456_700});
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &topic[..],
            &[
                "--domain",
                "2",
                "--repeat",
                "0",
                "--value",
                &sent.to_string(),
            ],
        ]
        .concat(),
    );
    let mut heard = cell.rospy("ros1_sub.py", &topic);
    let got = heard.wait_for_json("the joints in ROS 1", SOON, value);
    same_joints(&got);
    // An OPC UA DateTime has a resolution of 100 ns.
    assert_eq!(
        got["header"]["stamp"],
        json!({"secs": 1_700_000_000, "nsecs": 123_456_700})
    );
}

#[test]
fn mapped_topics_cross_under_the_names_of_the_mapping() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[PLANT]), cell.bridge_ros2(&[PLANT]));
    let topic = ["/arm/joint_states", "sensor_msgs/JointState"];
    let mut heard = cell.cyclone("ros2_sub.py", &[&topic[..], &["--domain", "2"]].concat());
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            &topic[..],
            &["--repeat", "0", "--value", &joints().to_string()],
        ]
        .concat(),
    );
    same_joints(&heard.wait_for_json("the joints in ROS 2", SOON, value));
}

#[test]
fn an_opc_ua_client_reads_what_either_ros_publishes() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[PLANT]), cell.bridge_ros2(&[PLANT]));
    let _server = cell.ua_server(&[PLANT]);
    let read =
        |nodes: &[&str]| cell.asyncua_try("opcua_read.py", &[&[SERVER_ENDPOINT], nodes].concat());

    let before = eventually("the server answers", SOON, || read(&["ns=2;i=10"]));
    assert_eq!(
        before[0]["status"], "BadWaitingForInitialData",
        "{before:?}"
    );

    let text = "std_msgs/String";
    let state = "sensor_msgs/JointState";
    let _sends = [
        in_ros1(&cell, "/ua_1_2_10", text, &json!("from ROS 1")),
        in_ros1(&cell, "/arm/joint_states", state, &joints()),
        in_ros2(&cell, "/ua_2_2_20", text, &json!("from ROS 2")),
        in_ros2(&cell, "/wheels/joint_states", state, &joints()),
    ];
    let nodes = [
        "ns=2;i=10",
        "ns=2;s=11.position",
        "ns=2;s=11.name",
        "ns=2;i=20",
        "ns=2;s=21.effort",
    ];
    let read = eventually("all of them are good", SOON, || {
        read(&nodes).filter(|lines| lines.iter().all(|line| line["status"] == "Good"))
    });
    let values: Vec<&Value> = read.iter().map(|line| &line["value"]).collect();
    assert_eq!(
        values,
        [
            &json!("from ROS 1"),
            &json!([0.1, -1.5e-3]),
            &json!(["joint_1", "joint_2"]),
            &json!("from ROS 2"),
            &json!([12.25])
        ]
    );
    let types: Vec<&Value> = read.iter().map(|line| &line["type"]).collect();
    assert_eq!(types, ["String", "Double", "String", "String", "Double"]);
    assert!(
        read.iter().all(|line| line["source_timestamp"].is_string()),
        "{read:?}"
    );
}

#[test]
fn a_cell_without_ros_1_crosses_between_ros_2_and_the_server() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _programs = (cell.bridge_ros2(&[PLANT]), cell.ua_server(&[PLANT]));
    let mut switch = cell.cyclone(
        "ros2_sub.py",
        &["/ua_0_2_30", "std_msgs/Bool", "--domain", "2"],
    );
    let _sends = in_ros2(
        &cell,
        "/wheels/joint_states",
        "sensor_msgs/JointState",
        &joints(),
    );
    let positions = eventually("the positions are good", SOON, || {
        let lines = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=2;s=21.position"])?;
        (lines[0]["status"] == "Good").then(|| lines[0]["value"].clone())
    });
    assert_eq!(positions, joints()["position"]);

    let write = [SERVER_ENDPOINT, "ns=2;i=30", "Boolean", "true"];
    assert_eq!(
        cell.asyncua_once("opcua_write.py", &write)[0]["status"],
        "BadTimeout",
        "the bridge of space 1 confirms it, and is not there"
    );
    assert_eq!(
        switch.wait_for_json("the switch in ROS 2", SOON, value),
        json!({"data": true})
    );
}

#[test]
fn a_value_whose_writer_is_gone_is_uncertain_and_still_there() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let bridge = cell.bridge_ros1(&[PLANT]);
    let _server = cell.ua_server(&[PLANT]);
    let sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_2_10",
            "std_msgs/String",
            "--latch",
            "--value",
            "\"last\"",
        ],
    );
    let status = |wanted: &str| {
        eventually(wanted, SOON, || {
            let lines = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=2;i=10"])?;
            (lines[0]["status"] == wanted).then(|| lines[0]["value"].clone())
        })
    };
    assert_eq!(status("Good"), "last");
    drop(sends);
    drop(bridge);
    // No other value of that space is received either.
    assert_eq!(status("UncertainNoCommunicationLastUsableValue"), "last");
}

#[test]
fn an_opc_ua_write_reaches_ros_1_and_ros_2_and_a_write_to_anothers_value_is_refused() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[PLANT]), cell.bridge_ros2(&[PLANT]));
    let _server = cell.ua_server(&[PLANT]);
    let mut in_ros1 = cell.rospy("ros1_sub.py", &["/conveyor/switch", "std_msgs/Bool"]);
    let mut in_ros2 = cell.cyclone(
        "ros2_sub.py",
        &["/ua_0_2_30", "std_msgs/Bool", "--domain", "2"],
    );
    let write = |node: &str, kind: &str, value: &str| {
        eventually("the server answers", SOON, || {
            cell.asyncua_try("opcua_write.py", &[SERVER_ENDPOINT, node, kind, value])
        })[0]["status"]
            .clone()
    };

    assert_eq!(write("ns=2;i=30", "Boolean", "true"), "Good");
    assert_eq!(
        in_ros1.wait_for_json("the switch in ROS 1", SOON, value),
        json!({"data": true})
    );
    assert_eq!(
        in_ros2.wait_for_json("the switch in ROS 2", SOON, value),
        json!({"data": true})
    );

    assert_eq!(
        write("ns=2;i=10", "String", "\"not mine\""),
        "BadNotWritable"
    );
}

#[test]
fn asyncua_decodes_the_datagrams_of_both_bridges() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let mut group = cell.uadp_listener();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let _sends = (
        cell.rospy(
            "ros1_pub.py",
            &[
                "/ua_1_5_10",
                "std_msgs/Float64",
                "--repeat",
                "0",
                "--value",
                "2.5",
            ],
        ),
        cell.cyclone(
            "ros2_pub.py",
            &[
                "/ua_2_6_11",
                "std_msgs/UInt32",
                "--domain",
                "2",
                "--repeat",
                "0",
                "--value",
                "7",
            ],
        ),
    );
    let mut key_frame = |publisher: u64| {
        group.wait_for_json("a key frame", SOON, |line| {
            (line["publisher"] == publisher && line["kind"] == "key_frame").then(|| line.clone())
        })
    };
    let ros1 = key_frame(1);
    assert_eq!((&ros1["group"], &ros1["writer"]), (&json!(5), &json!(10)));
    assert_eq!(ros1["publisher_type"], "UInt16");
    assert_eq!(ros1["fields"], json!([{"type": "Double", "value": 2.5}]));
    assert!(ros1["timestamp"].is_string(), "{ros1}");
    let ros2 = key_frame(2);
    assert_eq!((&ros2["group"], &ros2["writer"]), (&json!(6), &json!(11)));
    assert_eq!(ros2["fields"], json!([{"type": "UInt32", "value": 7}]));
}

#[test]
fn rosrust_is_heard_in_ros_2_and_hears_it() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));

    let mut in_ros2 = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_20", "std_msgs/String", "--domain", "2"],
    );
    let _rosrust = cell.rosrust(&["pub", "/ua_1_5_20", "by rosrust"]);
    assert_eq!(
        in_ros2.wait_for_json("rosrust's string", SOON, value),
        json!({"data": "by rosrust"})
    );

    let mut rosrust = cell.rosrust(&["sub", "/ua_2_5_20"]);
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            "/ua_2_5_20",
            "std_msgs/String",
            "--domain",
            "2",
            "--repeat",
            "0",
            "--value",
            "\"by Cyclone\"",
        ],
    );
    assert_eq!(
        rosrust.wait_for_json("Cyclone's string", SOON, value),
        json!({"data": "by Cyclone"})
    );
}

#[test]
fn a_roscpp_relay_may_stand_in_the_path_on_either_way() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let _relays = (
        cell.topic_tools_relay("/near", "/ua_1_5_30"),
        cell.topic_tools_relay("/ua_2_5_30", "/far"),
    );

    let mut in_ros2 = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_30", "std_msgs/String", "--domain", "2"],
    );
    let _near = cell.rospy(
        "ros1_pub.py",
        &[
            "/near",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"out\"",
        ],
    );
    assert_eq!(
        in_ros2.wait_for_json("the relayed string", SOON, value),
        json!({"data": "out"})
    );

    let mut in_ros1 = cell.rospy("ros1_sub.py", &["/far", "std_msgs/String"]);
    let _far = cell.cyclone(
        "ros2_pub.py",
        &[
            "/ua_2_5_30",
            "std_msgs/String",
            "--domain",
            "2",
            "--repeat",
            "0",
            "--value",
            "\"back\"",
        ],
    );
    assert_eq!(
        in_ros1.wait_for_json("the string behind the relay", SOON, value),
        json!({"data": "back"})
    );
}
