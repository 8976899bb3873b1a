//! Services of one ROS, asked for from the other: under their names of the space, and as a mapping says.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, Judge, MASTER, Peer, Started, eventually, metrics, program, xml_rpc,
};

/// rospy and rclpy need seconds to start on a busy machine.
const SOON: Duration = Duration::from_secs(40);
const OF_ROS1: &str = "/ua_1_2_61";
const OF_ROS2: &str = "/ua_2_2_62";
const SET_BOOL: &str = "std_srvs/SetBool";

fn set_bool(judge: &mut Judge, service: &str, data: bool) -> Value {
    judge.ask(json!({"call": service, "type": "std_srvs/srv/SetBool", "value": {"data": data}}))
}

fn rospy_call(cell: &Cell, service: &str, kind: &str, values: &[&str]) -> Vec<Value> {
    let mut args = vec![service, kind];
    for value in values {
        args.extend(["--value", value]);
    }
    let client: Child = cell.rospy("ros1_call.py", &args);
    let told = |line: &Value| line.get("value").or_else(|| line.get("error")).cloned();
    eventually("all are answered", SOON, || {
        let answers: Vec<Value> = client.json_lines().iter().filter_map(told).collect();
        (answers.len() == values.len()).then_some(answers)
    })
}

/// The node that the master knows as server of a service.
fn server_of(service: &str) -> Option<String> {
    let answer = xml_rpc(MASTER, "lookupService", &["/system_tests", service])?;
    let (_, rest) = answer.split_once("rosrpc://")?;
    Some(rest.split('<').next()?.to_owned())
}

/// Waits until the bridge has that service in ROS 2, or has it no longer.
fn has_service(judge: &mut Judge, bridge: &str, service: &str, wanted: bool) {
    judge.until(&json!({"nodes": 1}), |nodes| {
        nodes.as_array()?.contains(&json!(bridge)).then_some(())
    });
    judge.until(&json!({"info": bridge}), |info| {
        let services = info["services"].as_array()?;
        let has = services.iter().any(|one| one[0] == service);
        (has == wanted).then_some(())
    });
}

fn done() -> Value {
    json!({"success": true, "message": "done"})
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
    assert_eq!(set_bool(&mut judge, OF_ROS1, true), done());
    // What the server raises is no answer of its own.
    let refused = set_bool(&mut judge, OF_ROS1, false);
    assert_eq!(refused["success"], false, "{refused}");
    let why = refused["message"].as_str().unwrap();
    assert!(why.contains("went wrong"), "{why}");
    for value in [true, false] {
        let asked = |line: &Value| (line.get("value")? == value).then_some(());
        server.wait_for_json("the server is asked", SOON, asked);
    }
    assert_eq!(server.values().len(), 2);
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
    let told = rospy_call(&cell, OF_ROS2, SET_BOOL, &["{\"data\": true}"; 3]);
    assert_eq!(told, [answer.clone(), answer.clone(), answer]);
}

#[test]
fn rosservice_asks_for_a_service_of_cyclone_dds_while_that_is_there_and_again_when_it_is_back() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let serve = |text: &str| {
        let answer = json!({"success": true, "message": text}).to_string();
        let args = ["serve", OF_ROS2, SET_BOOL, "--domain", "2", "--leave"];
        let server = cell.cyclone_started("ros2_service.py", &args);
        let server = server.args(["--answer", &answer]).told();
        server.start().ready(SOON)
    };
    for text in ["first", "second"] {
        let mut server = serve(text);
        eventually("it is offered in ROS 1", SOON, || server_of(OF_ROS2));
        let printed = cell.ros1_tool("rosservice", &["call", OF_ROS2, "true"]);
        assert!(
            printed.iter().any(|line| line.contains(text)),
            "{printed:?}"
        );
        assert_eq!(server.values().len(), 1);
        server.tell("");
        server.wait_for_end(SOON);
        eventually("it is withdrawn", SOON, || {
            server_of(OF_ROS2).is_none().then_some(())
        });
    }
}

#[test]
fn a_server_that_ends_takes_its_service_along_and_of_a_killed_one_who_asks_is_told() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    for _ in 0..2 {
        let mut server = cell.rospy("ros1_serve.py", &[OF_ROS1]);
        assert_eq!(set_bool(&mut judge, OF_ROS1, true), done());
        server.end();
        has_service(&mut judge, "/ua_bridge_ros2", OF_ROS1, false);
    }
    let server = cell.rospy("ros1_serve.py", &[OF_ROS1]);
    assert_eq!(set_bool(&mut judge, OF_ROS1, true), done());
    // The master goes on to name it.
    server.signal(Signal::SIGKILL);
    let refused = set_bool(&mut judge, OF_ROS1, true);
    assert_eq!(refused["success"], false, "{refused}");
    let why = refused["message"].as_str().unwrap();
    assert!(why.contains("not executed"), "{why}");
    let _again = cell.rospy("ros1_serve.py", &[OF_ROS1]);
    eventually("it is executed again", SOON, || {
        (set_bool(&mut judge, OF_ROS1, true) == done()).then_some(())
    });
}

#[test]
fn of_two_bridges_in_one_domain_one_asks_and_a_call_is_executed_once() {
    const METRICS: &str = "127.0.0.1:9202";
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy("ros1_serve.py", &[OF_ROS1]);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let _second = Started::new("the second bridge", &program("bridge-ros2"))
        .args(["--domain", "2", "--space", "3", "--interface", "lo"])
        .args(["--metrics", METRICS, "--ros-args", "-r", "__node:=second"])
        .start();
    eventually("the second bridge answers", SOON, || metrics(METRICS));
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    has_service(&mut judge, "/ua_bridge_ros2", OF_ROS1, true);
    has_service(&mut judge, "/second", OF_ROS1, false);
    for _ in 0..5 {
        assert_eq!(set_bool(&mut judge, OF_ROS1, true), done());
    }
    // What is asked twice is asked at the same time; the last word of the server comes after both.
    assert_eq!(set_bool(&mut judge, OF_ROS1, false)["success"], false);
    let asked = |line: &Value| (line.get("value")? == false).then_some(());
    server.wait_for_json("the server is asked", SOON, asked);
    assert_eq!(server.values().len(), 6);
}
