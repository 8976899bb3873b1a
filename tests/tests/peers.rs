//! The peers without a bridge between them: a failure here is a fault of the machine or of a peer.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Peer, UadpSocket};

const SOON: Duration = Duration::from_secs(20);

fn data(line: &Value) -> Option<Value> {
    line.pointer("/value/data").cloned()
}

#[test]
fn a_rospy_subscriber_hears_a_rospy_publisher() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let joints = json!({"name": ["joint_1"], "position": [0.5], "header": {"frame_id": "base"}});
    let mut heard = cell.rospy("ros1_sub.py", &["/joints", "sensor_msgs/JointState"]);
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/joints",
            "sensor_msgs/JointState",
            "--wait-subscribers",
            "1",
            "--value",
            &joints.to_string(),
        ],
    );
    let line = heard.wait_for_json("a message", SOON, |line| {
        line.get("value").map(|_| line.clone())
    });
    assert_eq!(line["callerid"], "/rospy_pub");
    assert_eq!(line["type"], "sensor_msgs/JointState");
    assert_eq!(line["value"]["name"], json!(["joint_1"]));
    assert_eq!(line["value"]["position"], json!([0.5]));
    assert_eq!(line["value"]["header"]["frame_id"], "base");
}

#[test]
fn a_late_rospy_subscriber_gets_the_latched_value() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mut sends = cell.rospy(
        "ros1_pub.py",
        &["/state", "std_msgs/Bool", "--latch", "--value", "true"],
    );
    sends.wait_for_line("\"sent\"", SOON);
    let mut heard = cell.rospy("ros1_sub.py", &["/state", "std_msgs/Bool"]);
    let line = heard.wait_for_json("the latched message", SOON, |line| {
        line.get("value").map(|_| line.clone())
    });
    assert_eq!(line["value"]["data"], true);
    assert_eq!(line["latching"], true);
}

#[test]
fn a_roscpp_relay_stands_between_rospy_nodes() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _relay = cell.topic_tools_relay("/near", "/far");
    let mut heard = cell.rospy("ros1_sub.py", &["/far", "std_msgs/String"]);
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/near",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"through roscpp\"",
        ],
    );
    let text = heard.wait_for_json("a message", SOON, data);
    assert_eq!(text, "through roscpp");
}

#[test]
fn rosrust_and_rospy_hear_each_other() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();

    let mut rospy = cell.rospy("ros1_sub.py", &["/from_rosrust", "std_msgs/String"]);
    let _rosrust = cell.rosrust(&["pub", "/from_rosrust", "from rosrust"]);
    let line = rospy.wait_for_json("a message of rosrust", SOON, |line| {
        line.get("value").map(|_| line.clone())
    });
    assert_eq!(line["value"]["data"], "from rosrust");
    assert_eq!(line["callerid"], "/rosrust_pub");

    let mut rosrust = cell.rosrust(&["sub", "/from_rospy"]);
    let _rospy = cell.rospy(
        "ros1_pub.py",
        &[
            "/from_rospy",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"from rospy\"",
        ],
    );
    assert_eq!(
        rosrust.wait_for_json("a message of rospy", SOON, data),
        "from rospy"
    );
}

#[test]
fn the_echoing_node_repeats_others_and_not_itself() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mut heard = cell.rospy("ros1_sub.py", &["/ua_1_5_10", "std_msgs/String"]);
    let mut echo = cell.rospy("ros1_echo_loop.py", &[]);
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"again\"",
        ],
    );
    heard.wait_for_line("/rospy_echo", SOON);
    // The peer reports the echo after sending it.
    echo.wait_for_line("\"echoed\"", SOON);
    let echoed: Vec<Value> = echo
        .json_lines()
        .iter()
        .filter(|line| line.get("echoed").is_some())
        .map(|line| line["callerid"].clone())
        .collect();
    assert!(
        echoed.iter().all(|sender| sender == "/rospy_pub"),
        "{echoed:?}"
    );
}

#[test]
fn a_cyclone_reader_hears_a_cyclone_writer() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let joints = json!({"header": {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "base"},
                        "name": ["joint_1"], "position": [0.5]});
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &["/joints", "sensor_msgs/JointState", "--domain", "2"],
    );
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            "/joints",
            "sensor_msgs/JointState",
            "--domain",
            "2",
            "--wait-readers",
            "1",
            "--value",
            &joints.to_string(),
        ],
    );
    let value = heard.wait_for_json("a sample", SOON, |line| line.get("value").cloned());
    assert_eq!(value["header"]["stamp"], json!({"sec": 7, "nanosec": 8}));
    assert_eq!(value["name"], json!(["joint_1"]));
    assert_eq!(value["position"], json!([0.5]));
}

#[test]
fn a_late_cyclone_reader_gets_the_transient_local_sample() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let durable = ["--durability", "transient_local", "--depth", "1"];
    let mut sends = cell.cyclone(
        "ros2_pub.py",
        &[&["/state", "std_msgs/UInt32", "--value", "4"][..], &durable].concat(),
    );
    sends.wait_for_line("\"sent\"", SOON);
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &[&["/state", "std_msgs/UInt32"][..], &durable].concat(),
    );
    assert_eq!(heard.wait_for_json("the kept sample", SOON, data), 4);
}

#[test]
fn two_domains_of_cyclone_do_not_meet() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let topic = ["/chatter", "std_msgs/String"];
    let mut same = cell.cyclone("ros2_sub.py", &[&topic[..], &["--domain", "2"]].concat());
    let other = cell.cyclone("ros2_sub.py", &[&topic[..], &["--domain", "3"]].concat());
    let _sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &topic[..],
            &["--domain", "2", "--wait-readers", "1", "--value", "\"two\""],
        ]
        .concat(),
    );
    assert_eq!(same.wait_for_json("a sample", SOON, data), "two");
    assert_eq!(other.values(), Vec::<Value>::new());
}

#[test]
fn asyncua_reads_writes_and_watches_a_variable_of_an_asyncua_server() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let endpoint = "opc.tcp://127.0.0.1:4850";
    let mut server = cell.asyncua("opcua_serve.py", &[endpoint]);
    let node = server.wait_for_json("it names its node", SOON, |line| {
        Some(line.get("ready")?.as_str()?.to_owned())
    });

    let read = cell.asyncua_once("opcua_read.py", &[endpoint, &node]);
    assert_eq!(read[0]["value"], true);
    assert_eq!(read[0]["type"], "Boolean");
    assert_eq!(read[0]["status"], "Good");

    let mut watch = cell.asyncua("opcua_subscribe.py", &[endpoint, &node]);
    let written = cell.asyncua_once("opcua_write.py", &[endpoint, &node, "Boolean", "false"]);
    assert_eq!(written[0]["status"], "Good");
    watch.wait_for_json("the written value", SOON, |line| {
        (line.get("value")? == false).then_some(())
    });

    let refused = cell.asyncua_once(
        "opcua_write.py",
        &[endpoint, "ns=0;i=2258", "Boolean", "true"],
    );
    assert_ne!(refused[0]["status"], "Good");
}

#[test]
fn asyncua_decodes_a_datagram_of_the_group() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut listener = cell.uadp_listener();
    let group = UadpSocket::join();
    // PublisherId UInt16 1, WriterGroupId 5, DataSetWriterId 10, a key frame with a single Boolean,
    // true.
    group.send(&[
        0xf1, 0x01, 0x01, 0x00, 0x01, 0x05, 0x00, 0x01, 0x0a, 0x00, 0x01, 0x01, 0x00, 0x01, 0x01,
    ]);
    let line = listener.wait_for_json("a key frame", SOON, |line| {
        (line.get("kind")? == "key_frame").then(|| line.clone())
    });
    assert_eq!(
        (&line["publisher"], &line["group"], &line["writer"]),
        (&json!(1), &json!(5), &json!(10))
    );
    assert_eq!(line["publisher_type"], "UInt16");
    assert_eq!(line["fields"], json!([{"type": "Boolean", "value": true}]));
    assert_eq!(group.receive(SOON).map(|datagram| datagram.len()), Some(15));
}
