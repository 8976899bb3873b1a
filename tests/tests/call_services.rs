//! Services of a ROS, called from the other ROS under their names of the space and under names of a
//! mapping.

mod examples;

use std::fs;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, Judge, MASTER, Peer, StartedChild, eventually, metrics, program,
    xml_rpc,
};

/// The time that rospy and rclpy need to start on a busy machine.
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

/// Returns the server of a service according to the master.
fn server_of(service: &str) -> Option<String> {
    let answer = xml_rpc(MASTER, "lookupService", &["/system_tests", service])?;
    let (_, rest) = answer.split_once("rosrpc://")?;
    Some(rest.split('<').next()?.to_owned())
}

/// Waits until the bridge has or does not have that service in ROS 2.
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
    // An exception of the server is not a response of the service type.
    let refused = set_bool(&mut judge, OF_ROS1, false);
    assert_eq!(refused["success"], false, "{refused}");
    let why = refused["message"].as_str().unwrap();
    assert!(why.contains("and failed"), "{why}");
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
    let mut server = cell.rospy("ros1_serve.py", &[OF_ROS1]);
    assert_eq!(set_bool(&mut judge, OF_ROS1, true), done());
    // The master still lists the server. While its sockets exist, the bridge cannot know whether it
    // executes.
    server.signal(Signal::SIGKILL);
    server.wait_for_end(SOON);
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
    let _second = StartedChild::new("the second bridge", &program("bridge-ros2"))
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
    // If two bridges executed a call, both requests would be sent at the same time. The server's
    // last line is printed after both.
    assert_eq!(set_bool(&mut judge, OF_ROS1, false)["success"], false);
    let asked = |line: &Value| (line.get("value")? == false).then_some(());
    server.wait_for_json("the server is asked", SOON, asked);
    assert_eq!(server.values().len(), 6);
}

/// A mapping for a belt of ROS 1 that is switched from ROS 2 under other names and fields.
fn belt(asked: &str) -> String {
    format!(
        "
spaces: [{{id: 1}}, {{id: 2, domain: 2}}]
namespaces: {{2: 'urn:test:belt'}}
calls:
  - node: ns=2;i=61
    name: Belt.Switch
    origin: 1
    timeout: 5s
    ros:
      - {{service: /belt/switch, type: std_srvs/SetBool}}
      - {asked}
"
    )
}

/// Saves a file as editors do: writes another file and renames it.
fn save(file: &Path, text: &str) {
    let beside = file.with_extension("new");
    fs::write(&beside, text).unwrap();
    fs::rename(beside, file).unwrap();
}

#[test]
fn a_mapping_names_what_is_executed_and_what_is_asked_for_and_is_read_again_meanwhile() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let as_bool = "{space: 2, service: /switch, type: std_srvs/SetBool}";
    let file = cell.file("cell.yaml", &belt(as_bool));
    let path = file.to_str().unwrap();
    let mut server = cell.rospy("ros1_serve.py", &["/belt/switch"]);
    let _bridges = (cell.bridge_ros1(&[path]), cell.bridge_ros2(&[path]));
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    assert_eq!(set_bool(&mut judge, "/switch", true), done());
    has_service(&mut judge, "/ua_bridge_ros2", OF_ROS1, false);
    // An empty request starts the belt; the response is also converted by the mapping.
    let as_trigger = "{space: 2, service: /start, type: std_srvs/Trigger, request: {data: true}, \
                      response: {success: true, message: {field: message}}}";
    save(&file, &belt(as_trigger));
    let trigger = json!({"call": "/start", "type": "std_srvs/srv/Trigger", "value": {}});
    has_service(&mut judge, "/ua_bridge_ros2", "/start", true);
    has_service(&mut judge, "/ua_bridge_ros2", "/switch", false);
    assert_eq!(judge.ask(trigger), done());
    // Removing the mapping removes the service.
    save(&file, "spaces: [{id: 1}, {id: 2, domain: 2}]\n");
    has_service(&mut judge, "/ua_bridge_ros2", "/start", false);
    assert_eq!(server.values().len(), 2);
    let asked = |line: &Value| (line.get("value")? == true).then_some(());
    server.wait_for_json("the server is asked", SOON, asked);
}

#[test]
fn a_service_that_somebody_has_keeps_its_name_in_both_ros() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mapping = "
spaces: [{id: 1}, {id: 2, domain: 2}]
namespaces: {2: 'urn:test:belt'}
calls:
  - {node: ns=2;i=61, name: Belt, origin: 1, ros: [{service: /belt, type: std_srvs/SetBool}, \
     {space: 2, service: /taken, type: std_srvs/SetBool}]}
  - {node: ns=2;i=62, name: Lamp, origin: 2, ros: [{service: /lamp, type: std_srvs/SetBool}, \
     {space: 1, service: /mine, type: std_srvs/SetBool}]}
";
    let file = cell.file("cell.yaml", mapping);
    let path = file.to_str().unwrap();
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let theirs = json!({"success": true, "message": "theirs"});
    for service in ["/taken", "/lamp"] {
        judge.ask(json!({"serve": service, "type": "std_srvs/srv/SetBool", "value": theirs}));
    }
    let _belt = cell.rospy("ros1_serve.py", &["/belt", "--node", "belt"]);
    let mut mine = cell.rospy("ros1_serve.py", &["/mine", "--node", "mine"]);
    let before = server_of("/mine").unwrap();
    let mut ros1 = cell.bridge_ros1(&[path]);
    let mut ros2 = cell.bridge_ros2(&[path]);
    ros2.wait_for_line("is not offered as /taken", SOON);
    ros1.wait_for_line("is not offered as /mine", SOON);
    assert_eq!(set_bool(&mut judge, "/taken", true), theirs);
    assert_eq!(server_of("/mine").as_ref(), Some(&before));
    // The bridge takes the name as soon as it is free.
    mine.end();
    let ours = eventually("the bridge has the name", SOON, || server_of("/mine"));
    assert_ne!(ours, before);
    let told = rospy_call(&cell, "/mine", SET_BOOL, &["{\"data\": true}"]);
    assert_eq!(told, [theirs]);
}

#[test]
fn the_shipped_mapping_of_a_line_switches_its_belt_and_its_lamp() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings/calls.yaml");
    let _core = cell.roscore();
    let mut judge = cell.judge(Distribution::Kilted, &["judge"]);
    let lit = json!({"success": true, "message": "lit"});
    judge.ask(json!({"serve": "/lamp", "type": "std_srvs/srv/SetBool", "value": lit}));
    let _belt = cell.rospy("ros1_serve.py", &["/belt/switch"]);
    let _bridges = (cell.bridge_ros1(&[path]), cell.bridge_ros2(&[path]));
    let start = json!({"call": "/belt/start", "type": "std_srvs/srv/Trigger", "value": {}});
    assert_eq!(judge.ask(start), done());
    let told = rospy_call(&cell, "/line/lamp", SET_BOOL, &["{\"data\": true}"]);
    assert_eq!(told, [lit]);
}
