//! `ua-space write` with a robot of rospy behind its bridge: by a mapping alone, and at a
//! ua-server.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, METRICS_ROS1, Peer, SERVER_ENDPOINT, StartedChild, eventually, program,
};

const SOON: Duration = Duration::from_secs(30);
const MAPPING: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:ua-bridge:system-tests}
variables:
  - {node: ns=2;i=30, name: Arm.Setpoint, type: Double, range: [0, 100], origin: 0, ros: {space: 1, topic: /arm/setpoint, type: std_msgs/Float64, field: data}}
  - {node: ns=2;i=40, name: Arm.Velocity, origin: 0, on_loss: zero, ros: {space: 1, topic: /cmd_vel, type: geometry_msgs/Twist}}
server: {security: [None]}
";

/// Runs `ua-space write`. Returns the exit code, the objects of stdout, and all output.
fn write(words: &[&str]) -> (i32, Vec<Value>, String) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(["write"])
        .args(words)
        .args(["--json", "--interface", "lo"])
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.json_lines(), child.lines().join("\n"))
}

fn outcomes(written: &[Value]) -> Vec<&str> {
    let all = written.iter();
    all.map(|one| one["outcome"].as_str().unwrap_or_default())
        .collect()
}

/// Writes values with the arguments `by` until one is confirmed, since the robot and its bridge may
/// still be connecting. Returns that value.
fn confirmed(by: &[&str], mut value: f64) -> f64 {
    eventually("a value is confirmed", SOON * 2, || {
        value += 1.0;
        let text = value.to_string();
        let (code, written, _) = write(&[&["Setpoint", &text], by].concat());
        (code == 0 && outcomes(&written) == ["written"]).then_some(value)
    })
}

/// Waits until the robot has received the setpoint.
fn came(robot: &mut Child, setpoint: f64) {
    robot.wait_for_json(&format!("the setpoint {setpoint}"), SOON, |line| {
        (line["value"]["data"].as_f64()? == setpoint).then_some(())
    });
}

/// Returns how often the robot has received the setpoint.
fn times(robot: &Child, setpoint: f64) -> usize {
    let lines = robot.json_lines();
    let lines = lines
        .iter()
        .filter_map(|line| line["value"]["data"].as_f64());
    lines.filter(|value| *value == setpoint).count()
}

fn robot(cell: &Cell) -> Child {
    cell.rospy("ros1_sub.py", &["/arm/setpoint", "std_msgs/Float64"])
}

#[test]
fn a_value_is_sent_by_the_mapping_alone_and_its_commander_ends_with_the_command() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", MAPPING);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[mapping]);
    let by = ["--mapping", mapping];
    let (code, written, told) = write(&[&["Setpoint", "1"][..], &by].concat());
    assert_eq!((code, outcomes(&written)), (69, vec!["unknown"]), "{told}");
    assert!(told.contains("whether it arrived is not known"), "{told}");

    let mut robot = robot(&cell);
    let value = confirmed(&by, 10.0);
    came(&mut robot, value);
    let mut velocity = cell.rospy(
        "ros1_sub.py",
        &["/cmd_vel", "geometry_msgs/Twist", "--node", "base"],
    );
    eventually("the velocity is confirmed", SOON * 2, || {
        let stream = [
            "Arm.Velocity",
            "linear.x=0.5",
            "--rate",
            "10",
            "--count",
            "5",
        ];
        let (code, written, _) = write(&[&stream[..], &by].concat());
        (code == 0 && written.len() == 5).then_some(())
    });
    let is = |line: &Value, wanted: f64| {
        (line["value"]["linear"]["x"].as_f64()? == wanted).then_some(())
    };
    velocity.wait_for_json("the velocity", SOON, |line| is(line, 0.5));
    velocity.wait_for_json("the stop of `on_loss`", SOON, |line| is(line, 0.0));

    for (words, code, why) in [
        (["Setpoint", "fast"], 64, "expected a Double, found `fast`"),
        (["Setpoint", "101"], 64, "101 is out of the range 0 to 100"),
        (["Setpiont", "1"], 64, "the mapping has no value Setpiont"),
    ] {
        let (ended, written, told) = write(&[&words[..], &by].concat());
        assert_eq!((ended, written.len()), (code, 0), "{words:?}: {told}");
        assert!(told.contains(why), "{words:?}: {told}");
    }
    assert_eq!(times(&robot, value), 1, "it is delivered once");
}

#[test]
fn beside_a_server_a_value_is_written_at_the_server() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Ros1]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", MAPPING);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[mapping]);
    let _server = cell.ua_server(&[mapping]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let mut robot = robot(&cell);
    // The server has not sent a value yet, so that only its announcement shows that it has this
    // one.
    let (_, _, told) = write(&["Setpoint", "5"]);
    assert!(!told.contains("nothing was sent"), "{told}");
    // With a mapping, too: two programs must not send in one namespace.
    let value = confirmed(&["--mapping", mapping], 20.0);
    came(&mut robot, value);
    let value = confirmed(&[], value);
    came(&mut robot, value);
    let (code, written, told) = write(&["/arm/setpoint", "77"]);
    assert_eq!((code, outcomes(&written)), (0, vec!["written"]), "{told}");
    assert_eq!(written[0]["by"], "ua-server");
    assert_eq!(written[0]["topic"], "ua_0_2_30");
    came(&mut robot, 77.0);
    let shown = cell.asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, "ns=2;i=30"]);
    assert_eq!(shown[0]["value"], json!(77.0));

    let (code, _, told) = write(&["Setpoint", "101"]);
    assert_eq!(code, 64, "{told}");
    drop(robot);
    let (code, written, told) = write(&["Setpoint", "78"]);
    assert_eq!((code, outcomes(&written)), (69, vec!["unknown"]), "{told}");
    let (code, _, told) = write(&["Nothing", "1", "--wait", "1"]);
    assert_eq!(code, 69, "{told}");
    assert!(told.contains("--mapping cell.yaml"), "{told}");
}

/// Starts `ua-space tap` at the bridge.
fn tap(words: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(["tap", "--metrics", METRICS_ROS1, "--json"])
        .args(words)
        .ends_on(Signal::SIGINT)
        .start()
}

/// Ends a tap as Ctrl-C does.
fn ends_well(mut tap: Child) {
    tap.signal(Signal::SIGINT);
    assert_eq!(tap.wait_for_end(SOON).code(), Some(0));
}

#[test]
fn a_tap_at_the_bridge_shows_the_way_of_a_value() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", MAPPING);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[mapping]);
    let by = ["--mapping", mapping];
    let mut robot = robot(&cell);
    let value = confirmed(&by, 30.0);
    came(&mut robot, value);
    // A command that no subscriber receives is counted, and shown as dropped.
    let nobody = tap(&["Arm.Setpoint"]);
    robot.signal(Signal::SIGTERM);
    robot.wait_for_end(SOON);
    eventually(
        "a command without a subscriber is dropped",
        SOON * 2,
        || {
            let (_, _, _) = write(&[&["Setpoint", "35"][..], &by].concat());
            let steps = nobody.json_lines();
            steps
                .iter()
                .any(|line| line["reason"] == "no_subscriber")
                .then_some(())
        },
    );
    ends_well(nobody);
    let _robot = self::robot(&cell);
    // The bridge knows the name by now.
    let way = tap(&["Arm.Setpoint"]);
    eventually("a value crosses under the tap", SOON * 2, || {
        let (_, _, _) = write(&[&["Setpoint", "40"][..], &by].concat());
        let steps: Vec<Value> = way
            .json_lines()
            .iter()
            .map(|line| line["step"].clone())
            .collect();
        let has = |step: &str| steps.iter().any(|one| one == step);
        (has("received") && has("published")).then_some(())
    });
    ends_well(way);
}

#[test]
fn the_samples_of_a_topic_are_followed_and_written_as_a_trace_and_a_drawing() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[]);
    let _node = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_2_10",
            "std_msgs/Float64",
            "--repeat",
            "0",
            "--value",
            r#"{"data": 1.5}"#,
        ],
    );
    let (perfetto, svg) = (
        cell.folder().join("trace.pftrace"),
        cell.folder().join("trace.svg"),
    );
    let files = [
        "--perfetto",
        perfetto.to_str().unwrap(),
        "--svg",
        svg.to_str().unwrap(),
    ];
    let followed = eventually("samples are followed", SOON * 2, || {
        let words = [
            "trace",
            "--follow",
            "ua_1_2_10",
            "--seconds",
            "2",
            "--json",
            "--interface",
            "lo",
        ];
        let mut child = StartedChild::new("ua-space", &program("ua-space"))
            .args(words)
            .args(files)
            .start();
        let ended = child.wait_for_end(SOON);
        let lines = child.json_lines();
        (ended.success() && lines.len() > 2).then_some(lines)
    });
    let new: Vec<&Value> = followed
        .iter()
        .filter(|line| line["repeated"] == false)
        .collect();
    assert!(
        new.iter()
            .any(|line| line["origin_us"].as_f64() > Some(0.0) && line["network_us"].is_f64()),
        "{followed:?}"
    );
    let trace = std::fs::read(&perfetto).unwrap();
    for name in ["UA space", "ua_1_2_10: origin", "ua_1_2_10: network"] {
        let has = trace
            .windows(name.len())
            .any(|part| part == name.as_bytes());
        assert!(has, "{name} is not in the trace");
    }
    let drawing = std::fs::read_to_string(&svg).unwrap();
    assert!(
        drawing.contains(">ua_1_2_10<") && drawing.contains("<rect "),
        "{drawing}"
    );
}
