//! Services of one ROS, asked for from the other: under their names of the space, without a mapping.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Judge, Peer};

/// rospy and rclpy need seconds to start on a busy machine.
const SOON: Duration = Duration::from_secs(40);
const OF_ROS1: &str = "/ua_1_2_61";
const OF_ROS2: &str = "/ua_2_2_62";

fn set_bool(judge: &mut Judge, service: &str, data: bool) -> Value {
    judge.ask(json!({"call": service, "type": "std_srvs/srv/SetBool", "value": {"data": data}}))
}

fn rospy_call(cell: &Cell, service: &str, kind: &str, values: &[&str]) -> Vec<Value> {
    let mut args = vec![service, kind];
    for value in values {
        args.extend(["--value", value]);
    }
    let mut client: Child = cell.rospy("ros1_call.py", &args);
    let told = |line: &Value| line.get("value").or_else(|| line.get("error")).cloned();
    let answer = |_| client.wait_for_json("an answer", SOON, told);
    values.iter().map(answer).collect()
}

#[test]
fn rclpy_asks_for_a_service_of_rospy_and_is_told_that_it_fails() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy("ros1_serve.py", &[OF_ROS1]);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    assert_eq!(
        set_bool(&mut judge, OF_ROS1, true),
        json!({"success": true, "message": "done"})
    );
    // What the server raises is no answer of its own.
    let refused = set_bool(&mut judge, OF_ROS1, false);
    assert_eq!(refused["success"], false, "{refused}");
    let why = refused["message"].as_str().unwrap();
    assert!(why.contains("went wrong"), "{why}");
    for value in [true, false] {
        let asked = |line: &Value| (line.get("value")? == value).then_some(());
        server.wait_for_json("the server is asked", SOON, asked);
    }
}

#[test]
fn rospy_asks_for_a_service_of_rclpy() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut judge = cell.judge(Distribution::Kilted, &["judge"]);
    let answer = json!({"success": true, "message": "here"});
    judge.ask(json!({"serve": OF_ROS2, "type": "std_srvs/srv/SetBool", "value": answer}));
    let told = rospy_call(&cell, OF_ROS2, "std_srvs/SetBool", &["{\"data\": true}"; 3]);
    assert_eq!(told, [answer.clone(), answer.clone(), answer]);
}
