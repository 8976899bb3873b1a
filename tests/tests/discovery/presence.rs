//! Presence of servers as values of the space.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Peer, StartedChild, program};

use super::{SOON, now};

const GRIPPER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../examples/plant/parallel-gripper.yaml"
);
const MESSAGES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../ros");
const ENDPOINT: &str = "opc.tcp://127.0.0.1:4841/";
const TOPIC: &str = "ua_0_1_7";

fn gripper(cell: &Cell) -> Child {
    StartedChild::new("ua-component", &program("ua-component"))
        .args([GRIPPER, "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("gripper-pki")])
        .start()
}

fn heard(node: &mut Child, online: bool) -> Value {
    let what = format!("the gripper with online {online}");
    node.wait_for_json(&what, SOON, |line| {
        let value = line.get("value")?;
        (value["online"] == online).then(|| value.clone())
    })
}

/// Returns the milliseconds from an instant of this process to the time of a message, given in
/// seconds.
fn after(since: Duration, seconds: &Value) -> f64 {
    (seconds.as_f64().unwrap() - since.as_secs_f64()) * 1000.0
}

#[test]
fn a_component_is_a_value_of_the_space_that_tells_within_two_seconds_that_it_died() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let _server = cell.ua_server(&["--endpoint", ENDPOINT, "--announce"]);
    let topic = format!("/{TOPIC}");
    let asked = [&topic, "ua_msgs/Component", "--definitions", MESSAGES];
    let mut rospy = cell.rospy("ros1_sub.py", &asked);
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let begun = now();
    let component = gripper(&cell);
    let told = heard(&mut rospy, true);
    for (key, value) in [
        ("number", json!(7)),
        ("uri", json!("urn:example:gripper")),
        ("level", json!("lo")),
    ] {
        assert_eq!(told[key], value, "{told}");
    }
    let url = told["urls"][0].as_str().unwrap();
    assert!(url.starts_with("opc.tcp://127.0.0.1:"), "{told}");
    for key in ["since", "started"] {
        assert!(
            (-1.0..10_000.0).contains(&after(begun, &told[key])),
            "{told}, begun at {begun:?}"
        );
    }
    judge.until(&json!({"topics": 1}), |topics| {
        (topics[&topic] == json!(["ua_msgs/msg/Component"])).then_some(())
    });
    let name = told["name"].as_str().unwrap();
    let read = |property: &str| {
        let node = format!("ns=1;s=UaSpace.Components.{name}.{property}");
        cell.asyncua_once("opcua_read.py", &[ENDPOINT, &node])[0]["value"].clone()
    };
    assert_eq!(read("Topic"), TOPIC);
    assert_eq!(read("Number"), 7);
    let before = now();
    component.signal(Signal::SIGKILL);
    let gone = heard(&mut rospy, false);
    let late = after(before, &gone["since"]);
    assert!(late < 2500.0, "{late} ms: {gone}");
    assert!(
        now().saturating_sub(before) < Duration::from_secs(4),
        "and in ROS at once"
    );
    assert_eq!(gone["uri"], "urn:example:gripper");
    assert_eq!(read("Online"), false);
    // The gripper restarts at another port and is the same value again.
    let _again = gripper(&cell);
    rospy.wait_for_json("another run of the gripper", SOON, |line| {
        let value = line.get("value")?;
        let is_later = value["started"].as_f64() > told["started"].as_f64();
        (is_later && value["online"] == true).then_some(())
    });
}
