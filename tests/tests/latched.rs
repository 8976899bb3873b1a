//! Values that were there before anyone listened.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Peer, UadpSocket, eventually};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const KEPT: [&str; 6] = [
    "--domain",
    "2",
    "--durability",
    "transient_local",
    "--depth",
    "1",
];

fn value(line: &Value) -> Option<Value> {
    line.get("value").cloned()
}

#[test]
fn a_latched_value_reaches_a_ros_2_side_that_starts_later() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let mut sends = cell.rospy(
        "ros1_pub.py",
        &["/ua_1_5_10", "std_msgs/Bool", "--latch", "--value", "true"],
    );
    sends.wait_for_line("\"sent\"", SOON);

    let group = UadpSocket::join();
    let _ros1 = cell.bridge_ros1(&[]);
    eventually("the value is on the group", SOON, || {
        group.receive(Duration::from_millis(100))
    });

    let _ros2 = cell.bridge_ros2(&[]);
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &[&["/ua_1_5_10", "std_msgs/Bool"][..], &KEPT].concat(),
    );
    assert_eq!(
        heard.wait_for_json("the latched value", SOON, value),
        json!({"data": true})
    );
}

#[test]
fn a_second_late_ros_2_reader_gets_the_value_from_the_bridge_at_once() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let reader = [&["/ua_1_5_10", "std_msgs/UInt32"][..], &KEPT].concat();
    let mut first = cell.cyclone("ros2_sub.py", &reader);
    let sends = cell.rospy(
        "ros1_pub.py",
        &["/ua_1_5_10", "std_msgs/UInt32", "--latch", "--value", "42"],
    );
    assert_eq!(
        first.wait_for_json("the value", SOON, value),
        json!({"data": 42})
    );

    drop(sends);
    let mut second = cell.cyclone("ros2_sub.py", &reader);
    assert_eq!(
        second.wait_for_json("the kept value", SOON, value),
        json!({"data": 42})
    );
}

#[test]
fn a_transient_local_value_reaches_a_ros_1_side_that_starts_later() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &["/ua_2_5_10", "std_msgs/UInt32", "--value", "42"][..],
            &KEPT,
        ]
        .concat(),
    );
    sends.wait_for_line("\"sent\"", SOON);

    let group = UadpSocket::join();
    let _ros2 = cell.bridge_ros2(&[]);
    eventually("the value is on the group", SOON, || {
        group.receive(Duration::from_millis(100))
    });

    let _master = cell.roscore();
    let _ros1 = cell.bridge_ros1(&[]);
    let mut heard = cell.rospy("ros1_sub.py", &["/ua_2_5_10", "std_msgs/UInt32"]);
    assert_eq!(
        heard.wait_for_json("the kept value", SOON, value),
        json!({"data": 42})
    );
}
