//! Calls of the space as Methods of the server: an OPC UA client calls services of ROS.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Peer, SERVER_ENDPOINT};

/// rospy, rclpy and asyncua need seconds to start on a busy machine.
const SOON: Duration = Duration::from_secs(40);
const MAPPING: &str = "
spaces: [{id: 1}, {id: 2, domain: 2}]
namespaces: {2: 'urn:test:belt'}
calls:
  - {node: ns=2;i=61, name: Belt.Switch, about: Starts or stops the belt, origin: 1, ros: {service: /belt, type: std_srvs/SetBool}}
";

fn line(client: &mut Child, key: &str) -> Value {
    client.wait_for_json(key, SOON, |line| line.get(key).map(|_| line.clone()))
}

#[test]
fn asyncua_calls_a_service_of_rospy_and_is_told_how_it_went() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let file = cell.file("cell.yaml", MAPPING);
    let path = file.to_str().unwrap();
    let server = cell.rospy("ros1_serve.py", &["/belt"]);
    let mut bridge = cell.bridge_ros1(&[path]);
    let _ua_server = cell.ua_server(&[path]);
    let method = "UaSpace/Calls/Belt/Switch";
    let values = ["[true]", "[false]", "[]", "[true, true]"];
    let mut args = vec![SERVER_ENDPOINT, method, "--gone"];
    for value in values {
        args.extend(["--value", value]);
    }
    let mut client = cell.asyncua_started("opcua_call.py", &args).start();
    let found = line(&mut client, "node");
    assert_eq!(found["node"], "ns=2;i=61");
    // Boolean 1, String 12; scalars.
    assert_eq!(found["takes"], json!([["data", 1, -1]]));
    assert_eq!(
        found["gives"],
        json!([["success", 1, -1], ["message", 12, -1]])
    );
    let told = client.wait_for_json("four answers", SOON, {
        let mut all = Vec::new();
        move |line| {
            all.extend(
                line.get("status")
                    .map(|status| (status.clone(), line["value"].clone())),
            );
            (all.len() == values.len()).then(|| all.clone())
        }
    });
    let none = || json!([]);
    assert_eq!(told[0], (json!("Good"), json!([true, "done"])));
    assert_eq!(told[1], (json!("BadUnexpectedError"), none()));
    assert_eq!(told[2], (json!("BadArgumentsMissing"), none()));
    assert_eq!(told[3], (json!("BadTooManyArguments"), none()));
    // What was not right never reached the service.
    assert_eq!(server.values(), [true, false]);
    bridge.end();
    line(&mut client, "gone");
    // And so is the object that had nothing else in it.
    let object = ["UaSpace/Calls/Belt", "--wait", "0"];
    let args = [&[SERVER_ENDPOINT][..], &object].concat();
    let told = cell.asyncua_once("opcua_call.py", &args);
    assert_eq!(told, [json!({"missing": "UaSpace/Calls/Belt"})]);
}

#[test]
fn asyncua_calls_a_service_of_rclpy_that_nobody_mapped() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let answer = json!({"success": true, "message": "weighed"});
    judge.ask(json!({"serve": "/ua_2_2_62", "type": "std_srvs/srv/Trigger", "value": answer}));
    let _bridge = cell.bridge_ros2(&[]);
    let _ua_server = cell.ua_server(&[]);
    let args = [SERVER_ENDPOINT, "UaSpace/Calls/ua_2_2_62", "--value", "[]"];
    let mut client = cell.asyncua_started("opcua_call.py", &args).start();
    assert_eq!(line(&mut client, "node")["takes"], json!([]));
    let told = line(&mut client, "status");
    assert_eq!(
        (&told["status"], &told["value"]),
        (&json!("Good"), &json!([true, "weighed"]))
    );
}
