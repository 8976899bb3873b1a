//! Actions of ROS 1 used from ROS 2 and the reverse: actionlib itself at an end, rclpy or Cyclone
//! DDS at the other.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Peer, StartedChild, eventually, program};

/// The time that rospy and rclpy need to start on a busy machine.
const SOON: Duration = Duration::from_secs(60);
const OF_ROS1: &str = "/ua_1_2_70";
const OF_ROS2: &str = "/ua_2_2_70";
const FIBONACCI: &str = "test_msgs/Fibonacci";
const SERVER: &str = "calls/actionlib_server.py";
const CLIENT: &str = "calls/actionlib_client.py";
const RCLPY: &str = "ros2_rclpy_action.py";

/// Starts an actionlib client, which takes orders once it has found its server.
fn actionlib_client(cell: &Cell, args: &[&str]) -> Child {
    let started = cell.rospy_started(CLIENT, args).told();
    started.start().ready(SOON)
}

fn send(client: &mut Child, goal: &Value) {
    client.tell(&json!({"send": goal}).to_string());
}

/// Returns the end of a goal of an actionlib client: status, text and result.
fn end(client: &mut Child, goal: u64) -> Value {
    client.wait_for_json(&format!("the end of goal {goal}"), SOON, |line| {
        (line.get("goal")? == goal && line.get("end").is_some())
            .then(|| json!([line["end"], line["text"], line["result"]]))
    })
}

/// Returns the feedback that an actionlib client received for a goal.
fn feedback(client: &Child, goal: u64) -> Vec<Value> {
    let lines = client.json_lines();
    let told = lines.iter().filter(|line| line["goal"] == goal);
    told.filter_map(|line| line.get("feedback").cloned())
        .collect()
}

fn rclpy_client(cell: &Cell, action: &str) -> Child {
    let args = ["call", action, "--results", "--wait", "60"];
    let started = cell.rclpy_started(Distribution::Jazzy, RCLPY, &args).told();
    started.start().ready(SOON)
}

fn rclpy_server(cell: &Cell, action: &str) -> Child {
    let args = ["serve", action];
    let started = cell
        .rclpy_started(Distribution::Kilted, RCLPY, &args)
        .told();
    started.start().ready(SOON)
}

/// Waits for a line in which `key` is `value`, and returns its value of the key `wanted`.
fn line(child: &mut Child, key: &str, value: &Value, wanted: &str) -> Value {
    child.wait_for_json(&format!("{key} {value} with {wanted}"), SOON, |line| {
        (line.get(key)? == value).then(|| line.get(wanted).cloned())?
    })
}

fn sequence(of: &[i32]) -> Value {
    json!({ "sequence": of })
}

#[test]
fn a_simple_action_client_drives_an_action_server_of_rclpy() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = rclpy_server(&cell, OF_ROS2);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut client = actionlib_client(&cell, &[OF_ROS2, FIBONACCI]);
    send(&mut client, &json!({"order": 5}));
    let reached = json!(["SUCCEEDED", "", sequence(&[1, 1, 2, 3, 5])]);
    assert_eq!(end(&mut client, 0), reached);
    // In ROS 1, a result may overtake the last feedback.
    let told = feedback(&client, 0);
    assert_eq!(told.first(), Some(&sequence(&[1])), "{told:?}");
    assert_eq!(line(&mut server, "goal", &json!(5), "accepted"), true);

    send(&mut client, &json!({"order": -1}));
    let rejected = end(&mut client, 1);
    assert_eq!(
        (&rejected[0], &rejected[2]),
        (&json!("REJECTED"), &sequence(&[]))
    );
    send(&mut client, &json!({"order": -2}));
    assert_eq!(end(&mut client, 2)[0], "ABORTED");

    send(&mut client, &json!({"order": 100}));
    client.wait_for_json("the third feedback", SOON, |line| {
        (line["goal"] == 3 && line.get("feedback")? == &sequence(&[1, 1, 2])).then_some(())
    });
    client.tell("{\"cancel\": 3}");
    let cancelled = json!(["PREEMPTED", "", sequence(&[1, 1, 2])]);
    assert_eq!(end(&mut client, 3), cancelled);
    line(&mut server, "cancel", &json!(100), "cancel");
    assert_eq!(
        server
            .json_lines()
            .iter()
            .filter(|line| line.get("goal").is_some())
            .count(),
        4,
        "each goal is taken once"
    );
}

#[test]
fn rclpy_drives_a_simple_action_server() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy(SERVER, &[OF_ROS1, FIBONACCI, "--simple"]);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut client = rclpy_client(&cell, OF_ROS1);
    client.tell("send 5");
    assert_eq!(line(&mut client, "goal", &json!(0), "accepted"), true);
    assert_eq!(
        line(&mut client, "result", &json!(0), "status"),
        "SUCCEEDED"
    );
    let reached = line(&mut client, "result", &json!(0), "sequence");
    assert_eq!(reached, json!([1, 1, 2, 3, 5]));
    line(&mut client, "feedback", &json!(0), "sequence");
    client.tell("send -2");
    assert_eq!(line(&mut client, "result", &json!(1), "status"), "ABORTED");
    client.tell("send 100");
    assert_eq!(line(&mut client, "goal", &json!(2), "accepted"), true);
    client.tell("cancel 2");
    client.wait_for_json("the server agrees", SOON, |line| {
        (line.get("cancel")? == "NONE" && line["goals"] == json!([2])).then_some(())
    });
    assert_eq!(line(&mut client, "result", &json!(2), "status"), "CANCELED");
    line(&mut server, "cancel", &json!(100), "cancel");
    let taken = server.json_lines();
    let taken = taken.iter().filter(|line| line.get("goal").is_some());
    assert_eq!(taken.count(), 3, "each goal is taken once");
}

#[test]
fn goals_side_by_side_are_told_apart_rejected_and_cancelled_together() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy(SERVER, &[OF_ROS1, FIBONACCI]);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut client = rclpy_client(&cell, OF_ROS1);
    client.tell("send -1");
    assert_eq!(line(&mut client, "goal", &json!(0), "accepted"), false);
    for (goal, order) in [(1, 100), (2, 102)] {
        client.tell(&format!("send {order}"));
        let accepted = line(&mut client, "goal", &json!(goal), "accepted");
        assert_eq!(accepted, true);
    }
    client.tell("send 3");
    assert_eq!(
        line(&mut client, "result", &json!(3), "status"),
        "SUCCEEDED"
    );
    client.tell("cancel_all");
    for goal in [1, 2] {
        let status = line(&mut client, "result", &json!(goal), "status");
        assert_eq!(status, "CANCELED");
    }
    for order in [100, 102] {
        line(&mut server, "cancel", &json!(order), "cancel");
    }
}

#[test]
fn a_goal_goes_on_without_its_client_and_ends_without_its_server() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy(SERVER, &[OF_ROS1, FIBONACCI]);
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut client = rclpy_client(&cell, OF_ROS1);
    client.tell("send 100");
    assert_eq!(line(&mut client, "goal", &json!(0), "accepted"), true);
    client.signal(Signal::SIGKILL);
    let mut other = rclpy_client(&cell, OF_ROS1);
    other.tell("send 102");
    assert_eq!(line(&mut other, "goal", &json!(0), "accepted"), true);
    let ended = |line: &Value| line.get("cancel").or_else(|| line.get("done")).is_some();
    assert!(!server.json_lines().iter().any(ended), "the first goes on");
    // Another client can cancel the goals.
    other.tell("cancel_all");
    for order in [100, 102] {
        line(&mut server, "cancel", &json!(order), "cancel");
    }
    assert_eq!(line(&mut other, "result", &json!(0), "status"), "CANCELED");
    other.tell("send 104");
    assert_eq!(line(&mut other, "goal", &json!(1), "accepted"), true);
    server.signal(Signal::SIGKILL);
    assert_eq!(line(&mut other, "result", &json!(1), "status"), "ABORTED");
    // The master still lists the killed server.
    other.tell("send 3");
    assert_eq!(line(&mut other, "goal", &json!(2), "accepted"), false);
    let _again = cell.rospy(SERVER, &[OF_ROS1, FIBONACCI]);
    other.tell("send 4");
    assert_eq!(line(&mut other, "goal", &json!(3), "accepted"), true);
    let reached = line(&mut other, "result", &json!(3), "sequence");
    assert_eq!(reached, json!([1, 1, 2, 3]));
}

/// Starts `ua-space call` of an action, with its events as JSON.
fn ask(words: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(
            [
                &["call"],
                words,
                &["--interface", "lo", "--wait", "30", "--json"],
            ]
            .concat(),
        )
        .ends_on(Signal::SIGINT)
        .start()
}

/// Waits for the end of a call. Returns the exit code, the status, the result and the lines.
fn asked(mut asking: Child) -> (i32, Value, Value, Vec<Value>) {
    let code = asking.wait_for_end(SOON).code().unwrap();
    let lines = asking.json_lines();
    let result = lines.iter().find(|line| line["event"] == "result");
    let result = result.cloned().unwrap_or_default();
    (
        code,
        result["status"].clone(),
        result["fields"].clone(),
        lines,
    )
}

#[test]
fn who_looks_into_the_space_sends_goals_sees_their_feedback_and_cancels_them() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let mut server = cell.rospy(SERVER, &[OF_ROS1, FIBONACCI]);
    let _bridge = cell.bridge_ros1(&[]);
    let reached = asked(ask(&["ua_1_2_70", "order=5"]));
    assert_eq!(
        (reached.0, &reached.1, &reached.2),
        (0, &json!("SUCCEEDED"), &sequence(&[1, 1, 2, 3, 5])),
        "{:?}",
        reached.3
    );
    let answer = &reached.3[0];
    assert_eq!(
        (&answer["event"], &answer["fields"]["accepted"]),
        (&json!("answer"), &json!(true))
    );
    let rejected = asked(ask(&["ua_1_2_70", "{order: -1}"]));
    assert_eq!(
        (rejected.0, &rejected.1),
        (1, &Value::Null),
        "{:?}",
        rejected.3
    );
    assert_eq!(rejected.3[0]["fields"]["accepted"], false);
    let aborted = asked(ask(&["ua_1_2_70", "order=-2"]));
    assert_eq!(
        (aborted.0, &aborted.1),
        (1, &json!("ABORTED")),
        "{:?}",
        aborted.3
    );

    let mut asking = ask(&["ua_1_2_70", "{order: 100}"]);
    let told = asking.wait_for_json("feedback of the goal", SOON, |line| {
        (line["event"] == "feedback").then(|| line["fields"]["sequence"].clone())
    });
    assert_eq!(told[0], 1);
    line(&mut server, "goal", &json!(100), "body");
    asking.signal(Signal::SIGINT);
    let cancelled = asked(asking);
    assert_eq!(
        (cancelled.0, &cancelled.1, &cancelled.2),
        (1, &json!("CANCELED"), &sequence(&[1, 1, 2])),
        "{:?}",
        cancelled.3
    );
    line(&mut server, "cancel", &json!(100), "cancel");
    let cancelled = asked(ask(&["ua_1_2_70", "order=102", "--run-timeout", "1"]));
    assert_eq!((cancelled.0, &cancelled.1), (1, &json!("CANCELED")));
    // Unset fields of a goal get the defaults of the message; unknown fields are reported.
    let nothing = asked(ask(&["ua_1_2_70"]));
    assert_eq!(
        (nothing.0, &nothing.2),
        (0, &sequence(&[])),
        "{:?}",
        nothing.3
    );
    assert_eq!(asked(ask(&["ua_1_2_70", "{ordre: 1}"])).0, 64);
}

const NAVIGATION: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings/navigation.yaml");

#[test]
fn a_client_of_move_base_drives_a_base_of_ros_2() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let mut base = cell.cyclone("calls/ros2_navigate.py", &["/navigate_to_pose"]);
    let bridge = cell.bridge_ros2_alone(&[NAVIGATION]);
    let bridge = bridge.env("AMENT_PREFIX_PATH", cell.nav2_prefix());
    let _bridges = (cell.bridge_ros1(&[NAVIGATION]), bridge.start());
    let mut client = actionlib_client(&cell, &["/move_base", "move_base_msgs/MoveBase"]);
    let pose = |x: f64| {
        json!({"target_pose": {
            "header": {"frame_id": "map", "stamp": {"secs": 7, "nsecs": 500}},
            "pose": {
                "position": {"x": x, "y": 2.5, "z": -1.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
            },
        }})
    };
    send(&mut client, &pose(1.0));
    assert_eq!(end(&mut client, 0)[0], "SUCCEEDED");
    let met = base.wait_for_json("the goal", SOON, |line| {
        line.get("position").map(|_| line.clone())
    });
    assert_eq!(met["position"], json!([1.0, 2.5, -1.0]));
    assert_eq!(met["orientation"], json!([0.0, 0.0, 0.6, 0.8]));
    assert_eq!(
        (&met["frame"], &met["stamp"], &met["tree"]),
        (&json!("map"), &json!([7, 500]), &json!(""))
    );
    send(&mut client, &pose(-2.0));
    let failed = end(&mut client, 1);
    assert_eq!(failed[0], "ABORTED");
    send(&mut client, &pose(100.0));
    let told = client.wait_for_json("feedback", SOON, |line| {
        (line["goal"] == 2).then(|| line.get("feedback").cloned())?
    });
    let at = &told["base_position"];
    assert_eq!(at["pose"]["position"]["x"], 100.0, "{told}");
    assert_eq!(
        (&at["header"]["frame_id"], &at["header"]["stamp"]),
        (&json!("map"), &json!([7, 500]))
    );
    client.tell("{\"cancel\": 2}");
    assert_eq!(end(&mut client, 2)[0], "PREEMPTED");
    send(&mut client, &pose(-1.0));
    assert_eq!(end(&mut client, 3)[0], "REJECTED");
}

/// Writes the types of a trajectory in ROS 1, and the richer types in ROS 2.
fn trajectory_types(cell: &Cell) -> [String; 2] {
    const POINTS: &str = "trajectory_msgs/JointTrajectoryPoint desired\n\
        trajectory_msgs/JointTrajectoryPoint actual\n\
        trajectory_msgs/JointTrajectoryPoint error\n";
    const MANY: &str = "trajectory_msgs/MultiDOFJointTrajectoryPoint";
    const LIMITS: &str = "float64 position\nfloat64 velocity\nfloat64 acceleration\n";
    let one = format!(
        "trajectory_msgs/JointTrajectory trajectory\nJointTolerance[] path_tolerance\n\
         JointTolerance[] goal_tolerance\nduration goal_time_tolerance\n---\n\
         int32 error_code\nstring error_string\n---\n\
         std_msgs/Header header\nstring[] joint_names\n{POINTS}"
    );
    let two = format!(
        "trajectory_msgs/JointTrajectory trajectory\n\
         trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory\n\
         JointTolerance[] path_tolerance\nJointComponentTolerance[] component_path_tolerance\n\
         JointTolerance[] goal_tolerance\nJointComponentTolerance[] component_goal_tolerance\n\
         builtin_interfaces/Duration goal_time_tolerance\n---\n\
         int32 error_code\nstring error_string\n---\n\
         std_msgs/Header header\nstring[] joint_names\n{POINTS}string[] multi_dof_joint_names\n\
         {MANY} multi_dof_desired\n{MANY} multi_dof_actual\n{MANY} multi_dof_error\n"
    );
    let tolerance = format!("string name\n{LIMITS}");
    let component = format!("string joint_name\nint32 component\n{LIMITS}");
    [("catkin", one), ("ament_cmake", two)].map(|(tool, text)| {
        let package = cell.folder().join(tool).join("control_msgs");
        let (action, msg) = (package.join("action"), package.join("msg"));
        let about = format!(
            "<package format=\"2\"><name>control_msgs</name>\
             <buildtool_depend>{tool}</buildtool_depend></package>"
        );
        for (folder, name, text) in [
            (&package, "package.xml", &about),
            (&action, "FollowJointTrajectory.action", &text),
            (&msg, "JointTolerance.msg", &tolerance),
            (&msg, "JointComponentTolerance.msg", &component),
        ] {
            std::fs::create_dir_all(folder).unwrap();
            std::fs::write(folder.join(name), text).unwrap();
        }
        cell.folder().join(tool).display().to_string()
    })
}

/// A mapping for an arm of ROS 1 that clients of ROS 2 move with goals of a richer type.
fn arm([one, two]: &[String; 2]) -> String {
    format!(
        "
spaces: [{{id: 1}}, {{id: 2, domain: 2}}]
namespaces: {{2: 'urn:test:arm'}}
type_paths: ['{one}', '{two}']
calls:
  - node: ns=2;i=70
    name: Arm.Follow
    origin: 1
    ros:
      - {{action: /arm_controller/follow, type: control_msgs/FollowJointTrajectory}}
      - space: 2
        action: /follow
        type: control_msgs/FollowJointTrajectory
        goal: {{trajectory: {{field: trajectory}}}}
        feedback:
          multi_dof_joint_names: []
          multi_dof_desired.transforms: []
          multi_dof_desired.velocities: []
          multi_dof_desired.accelerations: []
          multi_dof_desired.time_from_start: 0s
          multi_dof_actual.transforms: []
          multi_dof_actual.velocities: []
          multi_dof_actual.accelerations: []
          multi_dof_actual.time_from_start: 0s
          multi_dof_error.transforms: []
          multi_dof_error.velocities: []
          multi_dof_error.accelerations: []
          multi_dof_error.time_from_start: 0s
"
    )
}

#[test]
fn a_client_of_ros_2_moves_an_arm_of_ros_1_along_a_trajectory() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let mapping = cell.file("arm.yaml", &arm(&trajectory_types(&cell)));
    let mapping = mapping.display().to_string();
    let _core = cell.roscore();
    let kind = "control_msgs/FollowJointTrajectory";
    let mut arm = cell.rospy(SERVER, &["/arm_controller/follow", kind]);
    let _bridges = (
        cell.bridge_ros1(&[&mapping]),
        cell.bridge_ros2_alone(&[&mapping]).start(),
    );
    let client = cell.cyclone_started("calls/ros2_trajectory.py", &["/follow"]);
    let mut client = client.told().start().ready(SOON);
    client.tell("3");
    assert_eq!(line(&mut client, "goal", &json!(0), "accepted"), true);
    let goal = line(&mut arm, "goal", &json!(3), "body");
    let path = &goal["trajectory"];
    assert_eq!(path["joint_names"], json!(["shoulder", "elbow"]));
    assert_eq!(
        path["header"],
        json!({"seq": 0, "stamp": [0, 0], "frame_id": "arm"})
    );
    let points = json!([
        {"positions": [3.0, 0.25], "velocities": [], "accelerations": [], "effort": [], "time_from_start": [1, 500_000_000]},
        {"positions": [0.5, -0.25], "velocities": [1.0, 2.0], "accelerations": [], "effort": [], "time_from_start": [3, 0]},
    ]);
    assert_eq!(path["points"], points);
    let tolerance =
        json!([{"name": "elbow", "position": 0.125, "velocity": 0.0, "acceleration": 0.0}]);
    assert_eq!(goal["path_tolerance"], tolerance);
    assert_eq!(goal["goal_time_tolerance"], json!([2, 0]));
    let told = client.wait_for_json("feedback", SOON, |line| {
        (line.get("feedback")? == 0).then(|| line.clone())
    });
    assert_eq!(
        (
            &told["joints"],
            &told["desired"],
            &told["at"],
            &told["many"]
        ),
        (
            &json!(["shoulder", "elbow"]),
            &json!([0.5, -0.25]),
            &json!([3, 0]),
            &json!([])
        )
    );
    let ended = client.wait_for_json("the result", SOON, |line| {
        (line.get("result")? == 0).then(|| line.clone())
    });
    assert_eq!(
        (&ended["status"], &ended["code"], &ended["text"]),
        (&json!("SUCCEEDED"), &json!(-2), &json!("elbow"))
    );
}

/// A component with a skill that runs until it is halted, a skill that completes at once, and a
/// skill with a target parameter.
const COMPONENT: &str = "
component: bench
application_uri: urn:ua-bridge:system-tests:component
namespace: 9
skills:
  - {name: Hold, type: GraspSkillType, driver: {simulated: {duration: 10 min}}}
  - {name: Let, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}
  - {name: Move, type: PtpMoveSkillType, driver: {simulated: {time_scale: 100}}}
";

/// The single entry of a mapping for clients with an action type of their own.
const HOLD: &str = "
spaces: [{id: 1}, {id: 2, domain: 2}]
namespaces: {9: 'urn:ua-bridge:system-tests:component'}
calls:
  - node: ns=9;i=110
    name: bench.Hold.Goal
    origin: 0
    ros:
      - {space: 2, action: /hold, type: test_msgs/Fibonacci, goal: {force: 12.5}, feedback: {sequence: [1]}, result: {sequence: [2]}}
";

/// Starts a component that serves at this address.
fn skills(cell: &Cell, url: &str) -> Child {
    component(cell, COMPONENT, url)
}

fn component(cell: &Cell, yaml: &str, url: &str) -> Child {
    let file = cell.file("component.yaml", yaml);
    let child = StartedChild::new("ua-component", &program("ua-component"))
        .args([file.to_str().unwrap(), "--endpoint", url, "--lds", "none"])
        .args(["--interface", "lo", "--metrics", "127.0.0.1:9855"])
        .start();
    eventually("the component serves", SOON, || {
        std::net::TcpStream::connect(url.trim_start_matches("opc.tcp://")).ok()
    });
    child
}

/// Waits until an OPC UA client reads this state. A subscription may skip a state that is replaced
/// at once.
fn stands(cell: &Cell, url: &str, state: &str) {
    eventually(state, SOON, || {
        let read = cell.asyncua_try("opcua_read.py", &[url, "ns=1;i=101"])?;
        let shown = read.first()?["value"].to_string();
        shown.contains(&format!("'{state}'")).then_some(())
    });
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story of one component")]
fn goals_of_either_ros_run_skills_and_are_refused_with_the_reason_of_the_component() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2, Peer::Python]) else {
        return;
    };
    let url = "opc.tcp://127.0.0.1:4856";
    let _core = cell.roscore();
    let mut component = skills(&cell, url);
    let file = cell.file("hold.yaml", HOLD);
    let path = file.to_str().unwrap();
    let _bridges = (cell.bridge_ros1(&[path]), cell.bridge_ros2(&[path]));
    stands(&cell, url, "Halted");

    // Without a mapping, the action has its type of ua_msgs. The skill is not ready at first and
    // becomes ready.
    let mut hold = actionlib_client(&cell, &["/ua_0_9_110", "ua_msgs/Grasp"]);
    send(&mut hold, &json!({}));
    let told = hold.wait_for_json("feedback", SOON, |line| {
        (line["goal"] == 0).then(|| line.get("feedback").cloned())?
    });
    assert_eq!(told["state"], "Running");
    assert!(told["run"].as_u64() > Some(0), "{told}");
    stands(&cell, url, "Running");
    // A component executes a single skill at a time.
    let mut moves = actionlib_client(
        &cell,
        &["/ua_0_9_310", "ua_msgs/PtpMove", "--node", "mover"],
    );
    let target = json!([0.3, 0.0, 0.3, 0.0, 0.0, 0.0]);
    send(&mut moves, &json!({"target_position": target}));
    let refused = end(&mut moves, 0);
    let why = refused[1].as_str().unwrap();
    assert_eq!(refused[0], "REJECTED");
    assert!(
        why.contains("BadInvalidState") && why.contains("Hold"),
        "{why}"
    );
    hold.tell("{\"cancel\": 0}");
    let halted = end(&mut hold, 0);
    assert_eq!(
        (&halted[0], &halted[2]),
        (
            &json!("PREEMPTED"),
            &json!({"run": told["run"], "gripped": false})
        )
    );
    stands(&cell, url, "Halted");

    // A wrong parameter moves nothing; a valid goal returns its result.
    send(
        &mut moves,
        &json!({"target_position": target, "max_velocity": 99.0}),
    );
    let refused = end(&mut moves, 1);
    let why = refused[1].as_str().unwrap();
    assert!(why.contains("MaxVelocity is from"), "{why}");
    send(&mut moves, &json!({"target_position": target}));
    let moved = end(&mut moves, 2);
    assert_eq!(moved[0], "SUCCEEDED");
    let first = moved[2]["run"].as_u64().unwrap();
    let near = |(at, of): (&Value, &Value)| (at.as_f64().unwrap() - of.as_f64().unwrap()).abs();
    let position = moved[2]["position"].as_array().unwrap();
    let off = position.iter().zip(target.as_array().unwrap()).map(near);
    assert!(off.fold(0.0, f64::max) < 1e-3, "{position:?}");

    // The same call from the command line.
    let goal = [
        "bench.Move.Goal",
        "{target_position: [0.2, 0, 0.3, 0, 0, 0]}",
    ];
    let moved = asked(ask(&goal));
    let (code, status) = (moved.0, &moved.1);
    assert_eq!((code, status), (0, &json!("SUCCEEDED")), "{:?}", moved.3);
    assert_eq!(moved.2["run"], first + 1);
    let unsaid = asked(ask(&["bench.Move.Goal"]));
    assert_eq!(unsaid.0, 64, "where to is not made up: {:?}", unsaid.3);

    // Through the entry of the mapping, for clients with another type.
    let mut rclpy = rclpy_client(&cell, "/hold");
    rclpy.tell("send 7");
    assert_eq!(line(&mut rclpy, "goal", &json!(0), "accepted"), true);
    let progress = line(&mut rclpy, "feedback", &json!(0), "sequence");
    assert_eq!(progress, json!([1]));
    rclpy.tell("cancel 0");
    rclpy.wait_for_json("the component agrees", SOON, |line| {
        (line.get("cancel")? == "NONE" && line["goals"] == json!([0])).then_some(())
    });
    assert_eq!(line(&mut rclpy, "result", &json!(0), "status"), "CANCELED");
    assert_eq!(
        line(&mut rclpy, "result", &json!(0), "sequence"),
        json!([2])
    );

    // A component that dies aborts its goals; the next component runs new goals.
    rclpy.tell("send 8");
    assert_eq!(line(&mut rclpy, "goal", &json!(1), "accepted"), true);
    component.signal(Signal::SIGKILL);
    component.wait_for_end(SOON);
    assert_eq!(line(&mut rclpy, "result", &json!(1), "status"), "ABORTED");
    let next = skills(&cell, url);
    let mut number = 2;
    eventually("a goal is taken by the next component", SOON, || {
        rclpy.tell("send 9");
        let answer = line(&mut rclpy, "goal", &json!(number), "accepted");
        number += 1;
        (answer == true).then_some(())
    });
    // The reason is reported, where this ROS has a field for it, soon after receive_timeout, which
    // is 3 s.
    rclpy.tell(&format!("cancel {}", number - 1));
    line(&mut rclpy, "result", &json!(number - 1), "status");
    send(&mut hold, &json!({}));
    hold.wait_for_json("the goal runs", SOON, |line| {
        (line["goal"] == 1 && line["feedback"]["state"] == "Running").then_some(())
    });
    next.signal(Signal::SIGKILL);
    let lost = hold.wait_for_json("the end of the goal", Duration::from_secs(10), |line| {
        (line.get("goal")? == 1 && line.get("end").is_some()).then(|| line.clone())
    });
    assert_eq!(lost["end"], "ABORTED");
    let why = lost["text"].as_str().unwrap();
    assert!(why.contains("the executor of the action is lost"), "{why}");
}

/// A component with skills executed by a base of ROS 2 and a belt of ROS 1.
const LINE: &str = "
component: line
application_uri: urn:ua-bridge:system-tests:line
namespace: 9
skills:
  - name: Go
    type: NavigateToSkillType
    driver:
      action:
        name: ua_2_2_70
        goal:
          pose.header.frame_id: {parameter: Frame}
          pose.pose.position.x: {parameter: Goal, at: 0}
          pose.pose.position.y: {parameter: Goal, at: 1}
          pose.pose.orientation.z: {parameter: Goal, at: 2, as: quaternion_z}
          pose.pose.orientation.w: {parameter: Goal, at: 2, as: quaternion_w}
        results: {Pose: {parameter: Goal}}
  - name: Belt
    type: RunConveyorSkillType
    driver: {call: {name: ua_1_2_61, request: {data: {parameter: On}}}}
";

/// Runs a skill with these arguments. Returns the exit code of `ua-space` and the result.
fn run(words: &[&str]) -> (i32, Value) {
    let (code, .., lines) = asked(ask(words));
    let result = lines.iter().find(|line| line["event"] == "result");
    (code, result.cloned().unwrap_or_else(|| json!(lines)))
}

#[test]
fn skills_have_their_work_done_by_an_action_of_ros_2_and_a_service_of_ros_1() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let url = "opc.tcp://127.0.0.1:4857";
    let _core = cell.roscore();
    let mut base = cell.cyclone("calls/ros2_navigate.py", &["/navigate_to_pose"]);
    let mut belt = cell.rospy("ros1_serve.py", &["/ua_1_2_61"]);
    let bridge = cell.bridge_ros2_alone(&[NAVIGATION]);
    let bridge = bridge.env("AMENT_PREFIX_PATH", cell.nav2_prefix());
    let _bridges = (cell.bridge_ros1(&[]), bridge.start());
    let _component = component(&cell, LINE, url);
    let (code, lines) = run(&["line.Go.Reset"]);
    assert_eq!(code, 0, "{lines}");

    let (code, result) = run(&["line.Go", "Goal=1,2.5,0.6"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    assert_eq!(result["results"], json!({"Pose": [1.0, 2.5, 0.6]}));
    let met = base.wait_for_json("the goal", SOON, |line| {
        line.get("position").map(|_| line.clone())
    });
    assert_eq!(met["position"], json!([1.0, 2.5, 0.0]));
    let turned = [0.0, 0.0, 0.3_f64.sin(), 0.3_f64.cos()];
    assert_eq!(met["orientation"], json!(turned));
    assert_eq!((&met["frame"], &met["tree"]), (&json!("map"), &json!("")));

    // A goal that the base rejects or aborts is no success; the result has the reason.
    for (x, why) in [("-1", "rejected"), ("-2", "aborted")] {
        let (code, result) = run(&["line.Go", &format!("Goal={x},0,0")]);
        let message = result["message"].to_string();
        assert!(code == 1 && message.contains(why), "{result}");
        assert_eq!(run(&["line.Go.Reset"]).0, 0);
    }
    // Halt cancels the goal.
    let mut asking = ask(&["line.Go", "Goal=100,0,0"]);
    line(&mut base, "goal", &json!(100), "accepted");
    asking.wait_for_json("the goal is accepted", SOON, |line| {
        (line["step"] == "Accepted").then_some(())
    });
    asking.signal(Signal::SIGINT);
    assert_eq!(asked(asking).0, 1);
    base.wait_for_json("the goal is cancelled", SOON, |line| {
        (line.get("cancel")? == &json!([100])).then_some(())
    });

    // An OPC UA client runs the belt.
    for method in ["Reset", "Start"] {
        let path = format!("line/Skills/Belt/{method}");
        let told = cell.asyncua_once("opcua_call.py", &[url, &path, "--value", "[]"]);
        assert_eq!(told[1]["status"], "Good", "{told:?}");
    }
    assert_eq!(line(&mut belt, "value", &json!(true), "value"), true);
    let (code, result) = run(&["line.Belt", "On=false"]);
    assert_eq!(code, 1, "the service failed: {result}");
    // Called as an action of ROS 1; an action of ROS 2 does the work.
    let mut client = actionlib_client(&cell, &["/ua_0_9_110", "ua_msgs/NavigateTo"]);
    send(&mut client, &json!({"goal": [3.0, 0.0, 0.0]}));
    let reached = end(&mut client, 0);
    assert_eq!(
        (&reached[0], &reached[2]["pose"]),
        (&json!("SUCCEEDED"), &json!([3.0, 0.0, 0.0]))
    );
}
