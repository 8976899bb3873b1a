//! A secured group in operation: both bridges have its keys, and a third program has no keys.

mod sks;

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{
    Cell, METRICS_ROS1, METRICS_ROS2, Peer, StartedChild, UaSide, UadpSocket, eventually, metrics,
    program,
};
use uadp::{NetworkMessage, Scalar};

const SOON: Duration = Duration::from_secs(30);
const TOPIC: [&str; 2] = ["/ua_1_5_10", "std_msgs/String"];
const SECRET: &str = "a recipe nobody may know";
const GRIPPER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../examples/plant/parallel-gripper.yaml"
);
const METRICS_COMPONENT: &str = "127.0.0.1:9107";

/// Runs `ua-space` and returns its output.
fn space(args: &[&str]) -> String {
    let output = Command::new(program("ua-space")).args(args).output();
    let output = output.unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {told}");
    String::from_utf8(output.stdout).unwrap()
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Returns the key that a program uses, by its SecurityTokenId.
fn token(address: &str) -> Option<u64> {
    metrics(address)?["groups"]["cell"]["token"].as_u64()
}

/// Returns the number of drops for that reason, with and without a topic.
fn dropped(address: &str, reason: &str) -> u64 {
    let status = metrics(address).unwrap_or_default();
    status["others"]["dropped"][reason]
        .as_u64()
        .unwrap_or_default()
}

#[test]
fn bridges_with_the_keys_hear_each_other_and_a_third_program_neither_hears_nor_is_heard() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let keys = cell.folder().join("cell.keys");
    space(&["keys", path(&keys)]);
    let mapping = cell.file(
        "cell.yaml",
        "security: [{group: cell, keys: {file: cell.keys}}]\n",
    );
    let _master = cell.roscore();
    let secured = ["--security", path(&mapping)];
    let _bridges = (cell.bridge_ros1(&secured), cell.bridge_ros2(&secured));
    let text = json!(SECRET).to_string();
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[&TOPIC[..], &["--repeat", "0", "--value", &text]].concat(),
    );
    let value = |line: &Value| line.get("value").cloned();
    let mut heard = cell.cyclone("ros2_sub.py", &[&TOPIC[..], &["--domain", "2"]].concat());
    let got = heard.wait_for_json("the string in ROS 2", SOON, value);
    assert_eq!(got, json!({ "data": SECRET }));

    // A listener without the keys sees that messages are sent, but cannot read them.
    let datagrams = UadpSocket::join().receive_for(Duration::from_secs(2));
    assert!(!datagrams.is_empty());
    for datagram in &datagrams {
        assert!(NetworkMessage::decode(datagram).unwrap().is_sealed());
        let readable = datagram.windows(SECRET.len());
        assert_eq!(
            readable.filter(|part| *part == SECRET.as_bytes()).count(),
            0
        );
    }
    // A sender without the keys is ignored, and so are replayed messages.
    let mut third = UaSide::join();
    third.write((0, 5, 11), Scalar::String(Some("forged")));
    let socket = UadpSocket::join();
    for datagram in &datagrams {
        socket.send(datagram);
    }
    for address in [METRICS_ROS1, METRICS_ROS2] {
        eventually("what is in clear is counted", SOON, || {
            (dropped(address, "unsecured") > 0).then_some(())
        });
        eventually("what is sent again is counted", SOON, || {
            (dropped(address, "replayed") > 0).then_some(())
        });
        let topics = metrics(address).unwrap()["topics"].clone();
        assert_eq!(topics.get("ua_0_5_11"), None, "{topics}");
    }
    // A program with the keys reads the values.
    let echoed = space(&[
        "echo",
        "ua_1_5_10",
        "-n",
        "1",
        "--seconds",
        "20",
        "--interface",
        "lo",
        "--keys",
        path(&keys),
    ]);
    assert!(echoed.contains(SECRET), "{echoed}");

    // The key is replaced while values are sent.
    space(&["keys", "--next", path(&keys)]);
    space(&["keys", "--drop", path(&keys)]);
    for address in [METRICS_ROS1, METRICS_ROS2] {
        let second = || (token(address) == Some(2)).then_some(());
        eventually("the second key is used", SOON, second);
    }
    let before = dropped(METRICS_ROS2, "unknown_key");
    let count = heard.values().len();
    eventually("values go on", SOON, || {
        (heard.values().len() > count + 10).then_some(())
    });
    assert_eq!(dropped(METRICS_ROS2, "unknown_key"), before);
}

/// Calls a component with `ua-space`. Returns the exit code and the output.
fn called(words: &[&str]) -> (Option<i32>, String) {
    let told = Command::new(program("ua-space"))
        .args(["call", "--interface", "lo", "--json"])
        .args(words)
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&told.stdout).into_owned();
    let errors = String::from_utf8_lossy(&told.stderr);
    (told.status.code(), printed + &errors)
}

#[test]
fn skills_of_a_secured_group_are_run_by_who_has_its_keys_and_by_nobody_else() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let keys = cell.folder().join("cell.keys");
    space(&["keys", path(&keys)]);
    let mapping = cell.file(
        "cell.yaml",
        "security: [{group: cell, keys: {file: cell.keys}}]\n",
    );
    let secured = ["--security", path(&mapping)];
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&secured);
    let of_component = [GRIPPER, "--lds", "none", "--interface", "lo"];
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args(of_component)
        .args(["--metrics", METRICS_COMPONENT])
        .args(secured)
        .start();
    eventually("the component has its keys", SOON, || {
        token(METRICS_COMPONENT)
    });

    // A ROS client runs a skill through the bridge, which has the keys.
    for method in ["/ua_0_7_209", "/ua_0_7_205"] {
        let asked = [method, "std_srvs/Trigger", "--value", "{}"];
        let mut robot = cell.rospy("ros1_call.py", &asked);
        let told = robot.wait_for_json("an answer", SOON, |line| {
            line.get("value").or_else(|| line.get("error")).cloned()
        });
        assert_eq!(told["success"], true, "{method}: {told}");
    }
    // A program with the keys in the space runs another skill and gets its result.
    let with_keys = ["--keys", path(&keys), "--wait", "20"];
    let reset = called(&[&["parallel-gripper.Grasp.Reset"], &with_keys[..]].concat());
    assert_eq!(reset.0, Some(0), "{}", reset.1);
    let grasp = ["parallel-gripper.Grasp", "Force=12.5"];
    let grasped = called(&[&grasp[..], &with_keys].concat());
    assert_eq!(grasped.0, Some(0), "{}", grasped.1);
    let datagrams = UadpSocket::join().receive_for(Duration::from_secs(1));
    assert!(!datagrams.is_empty());
    for datagram in &datagrams {
        assert!(NetworkMessage::decode(datagram).unwrap().is_sealed());
    }

    // A program without keys sees no skill, and its unsecured requests are ignored.
    let before = dropped(METRICS_COMPONENT, "unsecured");
    let refused = called(&["ua_0_7_109", "--wait", "2"]);
    assert!(refused.0.is_some_and(|code| code != 0), "{}", refused.1);
    eventually("what is in clear is counted", SOON, || {
        (dropped(METRICS_COMPONENT, "unsecured") > before).then_some(())
    });
    let again = called(&[&grasp[..], &with_keys].concat());
    assert_eq!(again.0, Some(0), "{}", again.1);
}

#[test]
fn keys_that_others_can_read_are_not_used() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let keys = cell.folder().join("cell.keys");
    space(&["keys", path(&keys)]);
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o644);
    std::fs::set_permissions(&keys, open).unwrap();
    let mapping = cell.file(
        "cell.yaml",
        "security: [{group: cell, keys: {file: cell.keys}}]\n",
    );
    let mut server = cell.ua_server_started(&[path(&mapping)]).start();
    let ended = server.wait_for_end(SOON);
    assert_eq!(ended.code(), Some(78));
    let told = server.lines().join("\n");
    assert!(told.contains("chmod 600"), "{told}");
}
