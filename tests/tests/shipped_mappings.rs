//! The shipped mappings without a robot-specific test, each with the systems it is made for.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, UaSide};
use uadp::{Scalar, Variant};

const SOON: Duration = Duration::from_secs(30);
const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings");

fn shipped(name: &str) -> String {
    format!("{FOLDER}/{name}")
}

/// Waits until the robot has received the value on the topic.
fn hears(robot: &mut Child, topic: &str, expected: Value) {
    robot.wait_for_json(&format!("{topic} is {expected}"), SOON, |line| {
        (line["heard"] == topic && line["value"] == expected).then_some(())
    });
}

#[test]
fn every_value_of_the_assembly_line_reaches_all_sides() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _master = cell.roscore();
    let side = UaSide::join();
    let mut niryo = cell.rospy("assembly_line_ros1.py", &["--switch"]);
    let mut turtlebot = cell.cyclone("assembly_line_ros2.py", &[]);
    let mapping = shipped("assembly-line.yaml");
    let _bridges = (
        cell.bridge_ros1(&[&mapping]),
        cell.bridge_ros2_alone(&[&mapping]).start(),
    );
    for (id, value) in [(11, 7), (12, 2), (13, 1)] {
        side.hear_scalar((1, 2, id), Scalar::UInt32(value));
    }
    side.hear_scalar((1, 2, 10), Scalar::Boolean(true));
    side.hear_scalar((2, 2, 20), Scalar::Boolean(true));
    side.hear_scalar((2, 2, 21), Scalar::Boolean(false));
    for (topic, value) in [
        ("/conveyor/running", json!(true)),
        ("/storage/covers", json!(7)),
        ("/conveyor/covers", json!(2)),
        ("/turtlebot3/covers", json!(1)),
    ] {
        hears(&mut turtlebot, topic, value);
    }
    hears(&mut niryo, "/park/busy", json!(true));
    hears(&mut niryo, "/bucket/busy", json!(false));
    // The robot executes calls of an OPC UA client and of a ROS 2 node.
    let _server = cell.ua_server(&[&mapping]);
    let args = [SERVER_ENDPOINT, "UaSpace/Calls/Conveyor/Switch"];
    let args = [&args[..], &["--value", "[true]"]].concat();
    let told = cell.asyncua_once("opcua_call.py", &args);
    assert_eq!(told[0]["node"], "ns=2;i=61");
    let answer = (&told[1]["status"], &told[1]["value"]);
    assert_eq!(answer, (&json!("Good"), &json!([true, "runs"])));
    hears(&mut niryo, "/conveyor/switch", json!(true));
    let args = ["call", "/conveyor/switch", "std_srvs/SetBool"];
    let args = [
        &args[..],
        &[
            "--domain",
            "2",
            "--wait",
            "30",
            "--value",
            r#"{"data": false}"#,
        ],
    ]
    .concat();
    let mut worker = cell.cyclone("ros2_service.py", &args);
    worker.wait_for_json("the conveyor stands still", SOON, |line| {
        (line["value"]["message"] == "stands still").then_some(())
    });
    hears(&mut niryo, "/conveyor/switch", json!(false));
}

#[test]
fn the_button_of_the_first_mapping_is_a_value() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let side = UaSide::join();
    let topic = ["/start_button", "std_msgs/Bool"];
    let value = ["--repeat", "0", "--value", "true"];
    let _robot = cell.rospy("ros1_pub.py", &[&topic[..], &value].concat());
    let _bridge = cell.bridge_ros1(&[&shipped("minimal.yaml")]);
    side.hear((1, 2, 10), "the button is pressed", |fields| {
        (fields == [Variant::Scalar(Scalar::Boolean(true))]).then_some(())
    });
}

#[test]
fn every_shipped_mapping_has_a_test_that_runs_it() {
    let sources = [
        include_str!("shipped_mappings.rs"),
        include_str!("assembly_line.rs"),
        include_str!("call_actionlib.rs"),
        include_str!("call_services.rs"),
        include_str!("moveit.rs"),
        include_str!("niryo.rs"),
        include_str!("skills/own.rs"),
        include_str!("turtlebot3.rs"),
    ];
    for entry in std::fs::read_dir(FOLDER).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if name.ends_with(".yaml") {
            let run = sources.iter().any(|source| source.contains(&name));
            assert!(run, "no test runs {name} against a robot");
        }
    }
}
