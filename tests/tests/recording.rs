//! `ua-space record`, `replay` and `live` with running programs: recordings open in the software of
//! others, a replay drives a bridge, and a viewer sees the values.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use system_tests::{
    Cell, Child, MASTER, Peer, StartedChild, UaSide, eventually, holds_for, program,
};
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);
const JOINTS: &str = "sensor_msgs/JointState";
const TWIST: &str = "geometry_msgs/Twist";

/// Returns `ua-space` in the network of the cell, not started yet.
fn ua_space(words: &[&str]) -> StartedChild {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--interface", "lo"])
}

/// Runs `ua-space` to its end. Returns the exit code and the program.
fn ended(words: &[&str]) -> (i32, Child) {
    let mut child = ua_space(words).start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child)
}

/// Waits until the topics are announced with their types.
fn listed(types: &[(&str, &str)]) {
    eventually("the topics are listed with their types", SOON, || {
        let (code, child) = ended(&["list", "--topics", "--seconds", "1", "--json"]);
        assert_eq!(code, 0, "{child}");
        let all = child.json_lines().pop()?;
        let all = all["topics"].as_array()?.clone();
        let is_there = |(topic, kind): &(&str, &str)| {
            all.iter()
                .any(|line| line["topic"] == *topic && line["type"] == *kind)
        };
        types.iter().all(is_there).then_some(())
    });
}

fn joints() -> Value {
    json!({"header": {"frame_id": "base"}, "name": ["a", "b"], "position": [0.5, -0.25],
           "velocity": [], "effort": []})
}

/// Starts ROS 1 nodes that publish joints and a command to move, ten times a second each.
fn nodes(cell: &Cell) -> [Child; 2] {
    let twist = json!({"linear": {"x": 1.0, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}});
    let all = [
        ("joints", "/ua_1_2_10", JOINTS, joints()),
        ("twist", "/ua_1_2_11", TWIST, twist),
    ];
    all.map(|(node, topic, kind, value)| {
        let value = value.to_string();
        let words = [
            topic, kind, "--node", node, "--repeat", "0", "--value", &value,
        ];
        cell.rospy("ros1_pub.py", &words)
    })
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_recording_opens_elsewhere_and_drives_a_bridge_without_its_commands() {
    let peers = [Peer::Ros1, Peer::Python, Peer::Tshark];
    let Some(cell) = Cell::with(&peers) else {
        return;
    };
    let packets = cell.folder().join("cell.pcapng");
    let values = cell.folder().join("cell.mcap");
    let _master = cell.roscore();
    let mut bridge = cell.bridge_ros1(&[]);
    let mut nodes = nodes(&cell);
    listed(&[("ua_1_2_10", JOINTS), ("ua_1_2_11", TWIST)]);
    let mut recording = ua_space(&["record", text(&values), "--count", "30", "--json"]).start();
    let (code, recorded) = ended(&["record", text(&packets), "--count", "120", "--json"]);
    assert_eq!(code, 0, "{recorded}");
    let summary = recorded.json_lines().pop().unwrap();
    assert_eq!(
        (&summary["messages"], &summary["slow_disk"]),
        (&json!(120), &json!(0))
    );
    // Own probes are no messages that the socket lost.
    assert_eq!(summary["full_socket"], json!(0), "{recorded}");
    assert!(recording.wait_for_end(SOON).success(), "{recording}");

    let (code, refused) = ended(&["replay", text(&packets)]);
    assert_eq!(code, 1, "bridge-ros1 is alive: {refused}");
    assert!(refused.to_string().contains("--onto-live"), "{refused}");
    for node in &mut nodes {
        node.end();
    }
    bridge.end();

    let columns = ["-T", "fields", "-e", "frame.time_epoch", "-e", "uadp.topic"];
    let shown = cell.tshark_of(&packets, &columns);
    assert_eq!(shown.lines().count(), 120, "{shown}");
    assert!(shown.contains("ua_1_2_10"), "{shown}");
    let malformed = cell.tshark_of(&packets, &["-Y", "uadp.malformed || _ws.malformed"]);
    assert_eq!(malformed, "");

    let judged = cell.asyncua_once("mcap_judge.py", &[text(&values)]);
    let of = |topic: &str| judged.iter().find(|line| line["topic"] == topic);
    let read = of("/ua_1_2_10").unwrap_or(&Value::Null);
    assert_eq!(read["schema"], "sensor_msgs/msg/JointState", "{judged:?}");
    assert_eq!(read["first"]["position"], json!([0.5, -0.25]), "{read}");
    assert_eq!(read["first"]["header"]["frame_id"], "base", "{read}");
    assert_eq!(
        read["late"], 0,
        "values arrive after they were taken: {read}"
    );
    let all: u64 = judged
        .iter()
        .filter_map(|line| line["count"].as_u64())
        .sum();
    assert_eq!(judged.last().unwrap()["messages"], json!(all));

    let _other = cell.bridge_ros2(&[]);
    let subscriber = |topic, kind| {
        let words = [topic, kind, "--domain", "2"];
        cell.cyclone("ros2_sub.py", &words)
    };
    let mut joints_there = subscriber("/ua_1_2_10", JOINTS);
    let commands_there = subscriber("/ua_1_2_11", TWIST);
    let mut before = 0;
    // A second replay repeats sequence numbers and values, and is delivered all the same.
    for turn in 1..=2 {
        // At half the speed most values follow the discovery, on slow hosts too.
        let words = ["replay", text(&packets), "--speed", "0.5", "--json"];
        let (code, replayed) = ended(&words);
        assert_eq!(code, 0, "{replayed}");
        let summary = replayed.json_lines().pop().unwrap();
        let sent = summary["sent"].as_u64().unwrap();
        assert!((20..120).contains(&sent), "{summary}");
        eventually("most values of the replay are in ROS 2", SOON, || {
            let count = joints_there.values().len();
            (count >= before + 10).then_some(())
        });
        before = joints_there.values().len();
        assert!(joints_there.runs(), "turn {turn}");
    }
    let got = joints_there.wait_for_json("joints", SOON, |line| line.get("value").cloned());
    assert_eq!(got["position"], json!([0.5, -0.25]), "{got}");
    assert_eq!(commands_there.values(), Vec::<Value>::new());
    let words = ["replay", text(&packets), "--commands", "--speed", "0.5"];
    let (code, replayed) = ended(&words);
    assert_eq!(code, 0, "{replayed}");
    eventually("the commands of the replay are in ROS 2", SOON, || {
        (!commands_there.values().is_empty()).then_some(())
    });
    replay_values(&values, &joints_there);
}

/// Replays an MCAP file: its values are the same messages in ROS 2, and its commands are left out.
fn replay_values(values: &Path, joints_there: &Child) {
    let before = joints_there.values().len();
    let (code, replayed) = ended(&["replay", text(values), "--speed", "0.2", "--json"]);
    assert_eq!(code, 0, "{replayed}");
    let summary = replayed.json_lines().pop().unwrap();
    let left_out = summary["left_out"].as_object().unwrap();
    let commanded = left_out.iter().any(|(why, count)| {
        why.contains("--commands") && count.as_u64().is_some_and(|count| count > 0)
    });
    assert!(commanded, "{summary}");
    eventually("values of the MCAP file are in ROS 2", SOON, || {
        (joints_there.values().len() >= before + 5).then_some(())
    });
    let last = joints_there.values().pop().unwrap();
    assert_eq!(last["position"], json!([0.5, -0.25]), "{last}");
    assert_eq!(last["header"]["frame_id"], "base", "{last}");
}

#[test]
fn a_full_disk_and_a_signal_end_a_recording_with_whole_messages() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let small = cell.folder().join("small");
    std::fs::create_dir(&small).unwrap();
    let mount = ["-t", "tmpfs", "-o", "size=256k", "tmpfs", text(&small)];
    let mounted = Command::new("mount").args(mount).status().unwrap();
    assert!(mounted.success());
    let mut side = UaSide::join();
    let mut write_until_end = |recording: &mut Child| {
        let start = Instant::now();
        while recording.runs() && start.elapsed() < SOON {
            side.write((1, 2, 10), Scalar::ByteString(Some(&[7; 1000])));
            std::thread::park_timeout(Duration::from_millis(1));
        }
    };
    for name in ["full.pcapng", "full.mcap"] {
        let file = small.join(name);
        let mut recording = ua_space(&["record", text(&file)]).start();
        write_until_end(&mut recording);
        let code = recording.wait_for_end(SOON).code();
        assert_eq!(code, Some(74), "{recording}");
        assert!(
            recording.to_string().contains("No space left"),
            "{recording}"
        );
        if name == "full.pcapng" {
            let (code, decoded) = ended_alone(&["decode", text(&file)]);
            assert_eq!(code, 0, "{decoded}");
            assert!(!decoded.lines().is_empty());
        }
        std::fs::remove_file(file).unwrap();
    }
    let unmounted = Command::new("umount").arg(&small).status().unwrap();
    assert!(unmounted.success());

    let file = cell.folder().join("interrupted.pcapng");
    let mut recording = ua_space(&["record", text(&file)]).start();
    eventually("the recording has messages", SOON, || {
        side.write((1, 2, 10), Scalar::Byte(1));
        let length = std::fs::metadata(&file).ok()?.len();
        (length > 1000).then_some(())
    });
    recording.signal(nix::sys::signal::Signal::SIGINT);
    assert!(recording.wait_for_end(SOON).success(), "{recording}");
    let (code, decoded) = ended_alone(&["decode", text(&file)]);
    assert_eq!(code, 0, "{decoded}");
}

/// Runs a verb without a network to its end.
fn ended_alone(words: &[&str]) -> (i32, Child) {
    let ua_space = StartedChild::new("ua-space", &program("ua-space")).args(words);
    let mut child = ua_space.start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child)
}

#[test]
fn viewers_see_the_values_as_ros_messages_by_both_protocols() {
    let peers = [Peer::Ros1, Peer::Python];
    let Some(cell) = Cell::with(&peers) else {
        return;
    };
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[]);
    let _nodes = nodes(&cell);
    listed(&[("ua_1_2_10", JOINTS)]);
    let mut live = ua_space(&["live", "--port", "8766"]).start();
    live.wait_for_line("ws://127.0.0.1:8766", SOON);
    for protocol in ["foxglove.sdk.v1", "foxglove.websocket.v1"] {
        let words = [
            "ws://127.0.0.1:8766",
            "--protocol",
            protocol,
            "--topics",
            "2",
        ];
        let seen = cell.asyncua_once("viewer.py", &words);
        let [info, ..] = seen.as_slice() else {
            panic!("nothing seen");
        };
        assert_eq!(info, &json!({"protocol": protocol, "capabilities": []}));
        let of = |topic: &str| seen.iter().find(|line| line["topic"] == topic);
        let read = of("/ua_1_2_10").unwrap_or(&Value::Null);
        assert_eq!(read["schema"], "sensor_msgs/msg/JointState", "{seen:?}");
        assert_eq!(read["value"]["name"], json!(["a", "b"]), "{read}");
    }
    holds_for("the server runs on", Duration::from_millis(300), || {
        live.runs()
    });
}

const URDF: &str = r#"<robot name="arm"><link name="base"><visual><geometry><mesh filename="package://arm_description/meshes/base.stl"/></geometry></visual></link></robot>"#;
const MESH: &str = "package://arm_description/meshes/base.stl";
const ROBOTS: &str = "spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:test:robots}
variables:
  - {node: ns=2;i=20, name: Arm.Transforms, origin: 1, ros: {topic: /tf, type: tf2_msgs/TFMessage}}
  - {node: ns=2;i=21, name: Arm.Fixed, origin: 1, ros: {topic: /tf_static, type: tf2_msgs/TFMessage}}
  - {node: ns=2;i=22, name: Base.Model, origin: 2, ros: {topic: /robot_description, type: std_msgs/String}}
";

/// Returns a transform from the world to a frame, as rospy and viewers have it.
fn transform(frame: &str, x: f64) -> Value {
    json!({"transforms": [{
        "header": {"frame_id": "world"}, "child_frame_id": frame,
        "transform": {"translation": {"x": x, "y": 0.0, "z": 0.25},
                      "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}}]})
}

/// Checks the transforms and models that a viewer or the reader of a recording decoded.
fn check_robots(seen: &[Value], value: &str) {
    let of = |topic: &str| seen.iter().find(|line| line["topic"] == topic);
    for (topic, frame, x) in [("/tf", "tool", 1.5), ("/tf_static", "base", -0.5)] {
        let line = of(topic).unwrap_or(&Value::Null);
        assert_eq!(line["schema"], "tf2_msgs/msg/TFMessage", "{seen:?}");
        let transform = &line[value]["transforms"][0];
        assert_eq!(transform["header"]["frame_id"], "world", "{line}");
        assert_eq!(transform["child_frame_id"], frame, "{line}");
        let translation = &transform["transform"]["translation"];
        assert_eq!(translation["x"], x, "{line}");
    }
    for (topic, text) in [("/robot_description", "<robot/>"), ("/arm/model", URDF)] {
        let line = of(topic).unwrap_or(&Value::Null);
        assert_eq!(line["schema"], "std_msgs/msg/String", "{seen:?}");
        assert_eq!(line[value]["data"], text, "{line}");
    }
}

/// Starts the nodes of both ROS that publish transforms and the model of a robot.
fn robots(cell: &Cell) -> [Child; 3] {
    let tf = "tf2_msgs/TFMessage";
    let (moving, fixed) = (transform("tool", 1.5), transform("base", -0.5));
    let (moving, fixed) = (moving.to_string(), fixed.to_string());
    let words = [
        "/tf", tf, "--node", "tf", "--repeat", "0", "--value", &moving,
    ];
    let moving = cell.rospy("ros1_pub.py", &words);
    let words = [
        "/tf_static",
        tf,
        "--node",
        "fixed",
        "--latch",
        "--value",
        &fixed,
    ];
    let fixed = cell.rospy("ros1_pub.py", &words);
    let kept = ["--durability", "transient_local", "--depth", "1"];
    let words = ["/robot_description", "std_msgs/String", "--domain", "2"];
    let value = ["--value", "\"<robot/>\""];
    let words = [&words[..], &value, &kept].concat();
    let model = cell.cyclone("ros2_pub.py", &words);
    listed(&[
        ("ua_1_2_20", tf),
        ("ua_1_2_21", tf),
        ("ua_2_2_22", "std_msgs/String"),
    ]);
    [moving, fixed, model]
}

#[test]
fn viewers_and_recordings_have_the_transforms_and_models_of_both_ros() {
    let peers = [Peer::Ros1, Peer::Python];
    let Some(cell) = Cell::with(&peers) else {
        return;
    };
    let package = cell.folder().join("prefix/share/arm_description");
    std::fs::create_dir_all(package.join("meshes")).unwrap();
    std::fs::write(package.join("meshes/base.stl"), "solid base").unwrap();
    let mapping = cell.file("robots.yaml", ROBOTS);
    let mapping = text(&mapping);
    let _master = cell.roscore();
    let set = ["set", "/arm/robot_description", URDF];
    let mut set = cell.ros1_started("bin/rosparam", &set).start();
    assert!(set.wait_for_end(SOON).success(), "{set}");
    let _bridges = (cell.bridge_ros1(&[mapping]), cell.bridge_ros2(&[mapping]));
    let _robots = robots(&cell);

    // Viewers and recordings that start after the fixed transforms and the models were published.
    let model = format!("/arm/model=http://{MASTER}/arm/robot_description");
    let with_model = ["--model", &model];
    let words = ["live", "--port", "8767"];
    let mut live = ua_space(&[&words[..], &with_model].concat())
        .env("AMENT_PREFIX_PATH", cell.folder().join("prefix"))
        .start();
    live.wait_for_line("ws://127.0.0.1:8767", SOON);
    let words = ["ws://127.0.0.1:8767", "--topics", "4", "--asset", MESH];
    let seen = cell.asyncua_once("viewer.py", &words);
    assert_eq!(seen[0]["capabilities"], json!(["assets"]), "{seen:?}");
    check_robots(&seen, "value");
    let mesh = json!({"request": 9, "status": 0, "error": "", "data": "solid base"});
    assert_eq!(seen.last(), Some(&mesh), "{seen:?}");

    let values = cell.folder().join("robots.mcap");
    let words = ["record", text(&values), "--for", "5"];
    let (code, recorded) = ended(&[&words[..], &with_model].concat());
    assert_eq!(code, 0, "{recorded}");
    let judged = cell.asyncua_once("mcap_judge.py", &[text(&values)]);
    check_robots(&judged, "first");
}
