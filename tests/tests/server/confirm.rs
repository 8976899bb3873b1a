//! Writes that succeed when a bridge confirms them or the robot answers, and not when they have
//! been sent.

use nix::sys::signal::Signal;
use system_tests::{BROKER, Distribution, program};

use super::*;
use crate::mqtt::commanded::{COMMAND, Commanded};

const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 1
  - id: 2
variables:
  - node: ns=2;i=10
    name: reached
    type: Double
    origin: SPACE
    ros: {topic: /arm/reached, type: std_msgs/Float64, field: data}
  - node: ns=2;i=30
    name: setpoint
    type: Double
    origin: 0
    confirm: {by: ns=2;i=10, within: 3s}
    ros: {space: SPACE, topic: /arm/setpoint, type: std_msgs/Float64, field: data}
server:
  security: [None]
";

const TOPICS: [&str; 2] = ["/arm/setpoint", "/arm/reached"];
const SETPOINT: &str = "ns=2;i=30";

fn served(cell: &Cell, space: &str) -> (Child, String) {
    let mapping = cell.file("confirm.yaml", &MAPPING.replace("SPACE", space));
    let mapping = mapping.to_str().unwrap().to_owned();
    let server = cell.ua_server(&[&mapping]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    (server, mapping)
}

fn got(robot: &mut Child, setpoint: f64) {
    robot.wait_for_json(&format!("the setpoint {setpoint}"), SOON, |line| {
        (line.get("setpoint")?.as_f64()? == setpoint).then_some(())
    });
}

/// Returns whether a datagram of `window` contains a setpoint.
fn is_sent(group: &UadpSocket, window: Duration) -> bool {
    let sent = group.receive_for(window);
    let mut written = sent.iter().filter_map(|datagram| written(datagram));
    written.any(|(triple, _)| triple == (0, 2, 30))
}

/// Checks writes to a robot that is present behind its bridge, and then is lost.
fn confirms(cell: &Cell, mut robot: Child) {
    let set = |value: &str| write(cell, SETPOINT, "Double", value);
    // The first write may be sent before discovery is complete.
    eventually("the robot answers", SOON * 2, || {
        (set("5.0") == "Good").then_some(())
    });
    got(&mut robot, 5.0);
    assert_eq!(read(cell, SETPOINT)["value"], 5.0);
    assert_eq!(set("5.0"), "Good", "each write has its own answer");

    let group = UadpSocket::join();
    assert_eq!(set("500.0"), "BadTimeout");
    got(&mut robot, 500.0);
    let shown = read(cell, SETPOINT);
    assert_eq!(
        (&shown["value"], &shown["status"]),
        (&json!(5.0), &json!("Good"))
    );
    // Datagrams that were already sent.
    let _before = group.receive_for(Duration::from_millis(100));
    let three_periods = Duration::from_secs(3);
    assert!(!is_sent(&group, three_periods), "it is still repeated");

    assert_eq!(set("6.0"), "Good");
    assert!(is_sent(&group, three_periods), "it is not repeated");
    drop(robot);
    assert_eq!(set("7.0"), "BadTimeout");
    assert_eq!(read(cell, SETPOINT)["value"], 6.0);
}

#[test]
fn without_confirmations_a_write_is_good_when_its_value_has_left_and_not_when_it_was_replaced() {
    const RARE: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0, at_most: 0.125 Hz}
server:
  security: [None]
";
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, RARE);
    let group = UadpSocket::join();
    let start = |value| {
        let arguments = [
            SERVER_ENDPOINT,
            SETPOINT,
            "Double",
            value,
            "--patience",
            "20",
        ];
        cell.asyncua_started("opcua_write.py", &arguments).start()
    };
    let status = |mut writer: Child| {
        writer.wait_for_json("the status of a write", SOON, |line| {
            line.get("status").cloned()
        })
    };
    assert_eq!(status(start("1.0")), "Good");
    // Eight seconds begin, in which values wait.
    let replaced = start("2.0");
    eventually("the value is shown", SOON, || {
        (read(&cell, SETPOINT)["value"] == 2.0).then_some(())
    });
    let newest = start("3.0");
    assert_eq!(status(replaced), "BadRequestCancelledByRequest");
    assert_eq!(status(newest), "Good");
    let sent = group.receive_for(Duration::from_millis(100));
    let sent = sent.iter().filter_map(|datagram| written(datagram));
    let mut values: Vec<f64> = sent.flat_map(|(_, values)| values).collect();
    // Values are repeated for late joiners.
    values.dedup();
    assert_eq!(values, [1.0, 3.0]);
}

#[test]
fn a_write_has_succeeded_when_a_robot_of_rospy_answers_and_has_not_happened_when_it_does_not() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let (_server, mapping) = served(&cell, "1");
    let _bridge = cell.bridge_ros1(&[&mapping]);
    let robot = cell.rospy("ros1_arm.py", &TOPICS);
    confirms(&cell, robot);
}

#[test]
fn a_write_has_succeeded_when_a_robot_of_rclpy_answers_and_has_not_happened_when_it_does_not() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros2]) else {
        return;
    };
    let (_server, mapping) = served(&cell, "2");
    let _bridge = cell.bridge_ros2(&[&mapping]);
    let robot = cell.rclpy(Distribution::Jazzy, "ros2_arm.py", &TOPICS);
    confirms(&cell, robot);
}

/// Checks a bridge that confirms: without a robot, with a present robot, and with a lost robot.
fn is_confirmed_by_the_bridge(cell: &Cell, bridge: Child, start: impl FnOnce() -> Child) {
    let set = |value: &str| write(cell, SETPOINT, "Double", value);
    let shown = || {
        let shown = read(cell, SETPOINT);
        (shown["value"].clone(), shown["status"].clone())
    };
    assert_eq!(set("1.0"), "BadTimeout", "there is no subscriber");
    assert_eq!(shown(), (json!(1.0), json!("UncertainLastUsableValue")));
    let mut robot = start();
    // The bridge and the robot may still be discovering each other.
    let mut value = 10.0;
    eventually("a write is confirmed", SOON * 2, || {
        value += 1.0;
        (set(&format!("{value:.1}")) == "Good").then_some(())
    });
    got(&mut robot, value);
    for value in ["50.0", "51.0", "52.0"] {
        assert_eq!(set(value), "Good");
        got(&mut robot, value.parse().unwrap());
    }
    assert_eq!(shown(), (json!(52.0), json!("Good")));
    let came = robot.json_lines();
    let came = came
        .iter()
        .filter_map(|line| line.get("setpoint")?.as_f64());
    let came: Vec<f64> = came.collect();
    assert!(
        came.is_sorted_by(|one, next| one < next),
        "none comes twice or late: {came:?}"
    );
    bridge.signal(Signal::SIGKILL);
    drop(bridge);
    assert_eq!(set("60.0"), "BadTimeout", "there is no bridge");
    assert_eq!(shown(), (json!(60.0), json!("UncertainLastUsableValue")));
}

fn confirmed_by_the_bridge(space: &str) -> String {
    let by_bridge = MAPPING.replace("    confirm: {by: ns=2;i=10, within: 3s}\n", "");
    assert_ne!(by_bridge, MAPPING);
    by_bridge.replace("SPACE", space)
}

#[test]
fn a_write_is_good_when_a_subscriber_of_rospy_has_it_and_else_unknown() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mapping = confirmed_by_the_bridge("1");
    let _server = serving(&cell, &mapping);
    let mapping = cell.file("bridge.yaml", &mapping);
    let bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    is_confirmed_by_the_bridge(&cell, bridge, || cell.rospy("ros1_arm.py", &TOPICS));
}

#[test]
fn a_write_is_good_when_a_subscriber_of_rclpy_has_it_and_else_unknown() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros2]) else {
        return;
    };
    let mapping = confirmed_by_the_bridge("2");
    let _server = serving(&cell, &mapping);
    let mapping = cell.file("bridge.yaml", &mapping);
    let bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    is_confirmed_by_the_bridge(&cell, bridge, || {
        cell.rclpy(Distribution::Jazzy, "ros2_arm.py", &TOPICS)
    });
}

#[test]
fn a_bridge_confirms_the_writes_of_a_secured_group() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros2]) else {
        return;
    };
    let keys = cell.folder().join("cell.keys");
    let made = std::process::Command::new(program("ua-space"))
        .arg("keys")
        .arg(&keys)
        .status();
    assert!(made.unwrap().success());
    let secured = "security: [{group: cell, keys: {file: cell.keys}}]\n";
    let mapping = format!("{}{secured}", confirmed_by_the_bridge("2"));
    let group = UadpSocket::join();
    let _server = serving(&cell, &mapping);
    let mapping = cell.file("bridge.yaml", &mapping);
    let bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    is_confirmed_by_the_bridge(&cell, bridge, || {
        cell.rclpy(Distribution::Jazzy, "ros2_arm.py", &TOPICS)
    });
    let sent = group.receive_for(Duration::from_millis(100));
    let messages = sent.iter().map(|datagram| NetworkMessage::decode(datagram));
    let messages: Vec<NetworkMessage<'_>> = messages.map(Result::unwrap).collect();
    assert!(messages.iter().any(NetworkMessage::is_sealed));
    let is_clear = |message: &NetworkMessage<'_>| message.is_action() && !message.is_sealed();
    assert!(
        !messages.iter().any(is_clear),
        "requests and confirmations are sealed"
    );
}

const LIGHT: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 1
variables:
  - {node: ns=2;i=3, name: Light, type: Boolean, origin: 0, ros: {space: 1, call: /light, type: std_srvs/SetBool, field: data}}
server:
  security: [None]
";

#[test]
fn a_write_is_good_when_a_service_of_rospy_has_its_call_and_else_unknown() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _server = serving(&cell, LIGHT);
    let mapping = cell.file("bridge.yaml", LIGHT);
    let _bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let light = "ns=2;i=3";
    let set = || write(&cell, light, "Boolean", "true");
    assert_eq!(set(), "BadTimeout", "there is no service");
    assert_eq!(read(&cell, light)["status"], "UncertainLastUsableValue");
    let mut service = cell.rospy("ros1_serve.py", &["/light"]);
    // The bridge may not have found the service.
    eventually("a write is confirmed", SOON * 2, || {
        (set() == "Good").then_some(())
    });
    assert_eq!(read(&cell, light)["status"], "Good");
    let calls = |service: &Child| service.values().len();
    // The bridge confirms when the request is sent.
    eventually("the service is called", SOON, || {
        (calls(&service) > 0).then_some(())
    });
    let before = calls(&service);
    assert_eq!(set(), "Good");
    eventually("the next write calls", SOON, || {
        (calls(&service) > before).then_some(())
    });
    service.signal(Signal::SIGKILL);
    service.wait_for_end(SOON);
    assert_eq!(set(), "BadTimeout", "the service is killed");
    assert_eq!(read(&cell, light)["status"], "UncertainLastUsableValue");
}

#[test]
fn the_last_write_that_a_killed_server_confirmed_is_what_the_robot_got() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let sent = MAPPING.replace("    confirm: {by: ns=2;i=10, within: 3s}\n", "");
    assert_ne!(sent, MAPPING);
    let mapping = cell.file("sent.yaml", &sent.replace("SPACE", "1"));
    let mapping = mapping.to_str().unwrap();
    let server = cell.ua_server(&[mapping]);
    let _bridge = cell.bridge_ros1(&[mapping]);
    let mut robot = cell.rospy("ros1_arm.py", &TOPICS);
    eventually("the robot is told", SOON * 2, || {
        let args = [SERVER_ENDPOINT, SETPOINT, "Double", "0.5"];
        let _status = cell.asyncua_try("opcua_write.py", &args)?;
        let told = robot.json_lines();
        told.iter()
            .any(|line| line.get("setpoint").is_some())
            .then_some(())
    });
    let args = [
        SERVER_ENDPOINT,
        SETPOINT,
        "Double",
        "--many",
        "--patience",
        "3",
    ];
    let mut client = cell.asyncua("opcua_write.py", &args);
    robot.wait_for_json("a hundred setpoints", SOON, |line| {
        (line.get("setpoint")?.as_f64()? >= 100.0).then_some(())
    });
    server.signal(Signal::SIGKILL);
    client.wait_for_json("the client is told", SOON, |line| {
        line.get("gone").map(|_| ())
    });
    let confirmed = client.json_lines();
    let confirmed = confirmed
        .iter()
        .filter_map(|line| line.get("confirmed")?.as_f64());
    let last = confirmed.max_by(f64::total_cmp).unwrap();
    // One more value may have been sent without its confirmation.
    eventually(&format!("{last} has come"), SOON, || {
        let told = robot.json_lines();
        let got = told
            .iter()
            .filter_map(|line| line.get("setpoint")?.as_f64());
        let got = got.max_by(f64::total_cmp)?;
        (got == last || got == last + 1.0).then_some(())
    });
}

/// Checks that a command that waited for a stopped bridge does not reach the robot. `carrier` is
/// the carrier in the mapping.
pub(crate) fn is_never_late_after_a_stop(carrier: &str) {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let mapping = COMMAND.replace(&format!("address: \"{BROKER}\""), carrier);
    assert!(mapping.contains(carrier), "{mapping}");
    let mapping = cell.file("cell.yaml", &mapping);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _server = cell.ua_server(&[mapping]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let bridge = cell.bridge_ros1(&[mapping]);
    let mut commanded = Commanded::robot(&cell);
    commanded.arrives();

    bridge.signal(Signal::SIGSTOP);
    assert_eq!(commanded.write(1002.0), "BadTimeout");
    bridge.signal(Signal::SIGCONT);
    commanded.never_arrives(1002.0);
    commanded.arrives();
}

#[test]
fn a_command_is_never_late_when_its_bridge_was_stopped() {
    is_never_late_after_a_stop("interface: lo");
}
