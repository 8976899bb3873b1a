//! `mappings/niryo-ned.yaml` with the ROS graph of a Niryo Ned: every topic and every service by
//! its real name.

use std::{path::Path, time::Duration};

use messages::{Dialect, Literal, MessagePlan, NoFields, Selection, TypeRegistry, Wire};
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, MASTER, METRICS_ROS1, Peer, StartedChild, UaSide, eventually, metrics, number,
    program,
};
use tcpros::actionlib::{self, ActionlibClient, ActionlibClientOptions, ClientType};
use tcpros::{Node, NodeOptions, TopicType};
use uadp::{Scalar, Variant};

const SOON: Duration = Duration::from_secs(30);
const MAPPING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings/niryo-ned.yaml");
/// Returns the definitions of ned_ros, a peer: they are under the GPL and not part of the project.
fn definitions() -> Option<String> {
    let path = test_data::foreign("ros1-niryo")?;
    Some(path.to_str().unwrap().to_owned())
}

/// Waits for the next call of a service that the robot reports, after `before` calls, and returns
/// its request.
fn called(robot: &Child, service: &str, before: usize) -> Value {
    eventually(&format!("{service} is called"), SOON, || {
        calls(robot, service).get(before).cloned()
    })
}

fn calls(robot: &Child, service: &str) -> Vec<Value> {
    let lines = robot.json_lines().into_iter();
    lines
        .filter(|line| line["service"] == service)
        .map(|line| line["request"].clone())
        .collect()
}

pub(crate) struct NiryoLine {
    pub(crate) side: UaSide,
    pub(crate) robot: Child,
    bridge: Child,
    _master: Child,
}

pub(crate) fn start(cell: &Cell) -> NiryoLine {
    start_with(cell, MAPPING)
}

fn start_with(cell: &Cell, mapping: &str) -> NiryoLine {
    let master = cell.roscore();
    let side = UaSide::join();
    let robot = cell.rospy("niryo.py", &[&definitions().unwrap()]);
    NiryoLine {
        side,
        robot,
        bridge: bridge(cell, mapping),
        _master: master,
    }
}

fn bridge(cell: &Cell, mapping: &str) -> Child {
    cell.bridge_ros1_started(&[mapping])
        .env("ROS_PACKAGE_PATH", definitions().unwrap())
        .start()
}

pub(crate) fn cell() -> Option<Cell> {
    let _there = definitions()?;
    Cell::with(&[Peer::Ros1])
}

#[test]
fn what_a_niryo_shows_reaches_the_space_as_typed_values() {
    let Some(cell) = cell() else { return };
    let line = start(&cell);
    let side = &line.side;
    side.hear((1, 2, 11), "six joint positions", |fields| match fields {
        [Variant::Array(array)] => (array.len() == 6).then_some(()),
        _ => None,
    });
    side.hear((1, 2, 12), "the joints' names", |fields| match fields {
        [Variant::Array(array)] => {
            (array.iter().next() == Some(Scalar::String(Some("joint_1")))).then_some(())
        }
        _ => None,
    });
    side.hear(
        (1, 2, 13),
        "position.x 0.25 and tcp_speed 0.125",
        |fields| {
            let ends = (fields.first(), fields.last());
            (ends
                == (
                    Some(&Variant::Scalar(Scalar::Double(0.25))),
                    Some(&Variant::Scalar(Scalar::Double(0.125))),
                ))
                .then_some(())
        },
    );
    side.hear_scalar((1, 2, 14), Scalar::SByte(6));
    side.hear_scalar((1, 2, 15), Scalar::String(Some("STANDBY")));
    side.hear((1, 2, 16), "hardware version ned2", |fields| {
        fields
            .contains(&Variant::Scalar(Scalar::String(Some("ned2"))))
            .then_some(())
    });
    side.hear_scalar((1, 2, 17), Scalar::Boolean(false));
    side.hear_scalar((1, 2, 18), Scalar::Boolean(false));
    side.hear((1, 2, 21), "two outputs", |fields| match fields {
        [Variant::Array(inputs), Variant::Array(outputs)] => {
            ((inputs.len(), outputs.len()) == (1, 2)).then_some(())
        }
        _ => None,
    });
    side.hear((1, 2, 23), "tool 11", |fields| {
        (fields.first() == Some(&Variant::Scalar(Scalar::SByte(11)))).then_some(())
    });
    side.hear_scalar((1, 2, 24), Scalar::Int32(11));
    side.hear_scalar((1, 2, 25), Scalar::Boolean(false));
}

#[test]
fn values_of_the_space_add_and_run_a_conveyor_and_its_answers_are_values() {
    let Some(cell) = cell() else { return };
    let mut line = start(&cell);
    // Received joints show that the bridge and the robot have discovered each other.
    line.side.hear((1, 2, 11), "joints", |_| Some(()));

    line.side.write((0, 2, 40), Scalar::Byte(1));
    let request = called(
        &line.robot,
        "/niryo_robot/conveyor/ping_and_set_conveyor",
        0,
    );
    assert_eq!(request, json!({"cmd": 1, "id": 0}));
    line.side.hear_scalar((1, 2, 41), Scalar::Int16(12));
    line.side.hear_scalar((1, 2, 42), Scalar::Int16(1));

    line.side.write((0, 2, 43), Scalar::Boolean(true));
    let control = "/niryo_robot/conveyor/control_conveyor";
    let request = called(&line.robot, control, 0);
    assert_eq!(
        request,
        json!({"id": 12, "control_on": true, "speed": 50, "direction": 1})
    );
    line.side.hear_scalar((1, 2, 44), Scalar::Int16(1));
    line.side.hear(
        (1, 2, 20),
        "one conveyor in the feedback",
        |fields| match fields {
            [Variant::Array(conveyors)] => (conveyors.len() == 1).then_some(()),
            _ => None,
        },
    );
    line.side
        .hear_scalar((1, 2, 49), Scalar::String(Some("NiryoSteppers")));

    line.side.write((0, 2, 43), Scalar::Boolean(false));
    assert_eq!(called(&line.robot, control, 1)["control_on"], false);

    // A conveyor that does not exist: the fault is a value, too.
    line.side.write((0, 2, 40), Scalar::Byte(2));
    line.side.hear_scalar((1, 2, 42), Scalar::Int16(-123));
}

#[test]
fn digital_outputs_learning_mode_and_stop_are_called_with_what_the_mapping_says() {
    let Some(cell) = cell() else { return };
    let mut line = start(&cell);
    line.side.hear((1, 2, 11), "joints", |_| Some(()));
    line.side.write((0, 2, 45), Scalar::Boolean(true));
    let request = called(&line.robot, "/niryo_robot_rpi/set_digital_io", 0);
    assert_eq!(request, json!({"name": "DO1", "value": true}));
    line.side.hear_scalar((1, 2, 46), Scalar::Int32(1));
    line.side.write((0, 2, 47), Scalar::Boolean(true));
    called(&line.robot, "/niryo_robot/learning_mode/activate", 0);
    line.side.hear_scalar((1, 2, 25), Scalar::Boolean(true));

    let stop = "/niryo_robot_arm_commander/stop_command";
    line.side.write((0, 2, 48), Scalar::Boolean(false));
    line.side.write((0, 2, 48), Scalar::Boolean(true));
    called(&line.robot, stop, 0);
    // A later call has arrived, so all earlier calls have arrived.
    line.side.write((0, 2, 48), Scalar::Boolean(false));
    line.side.write((0, 2, 48), Scalar::Boolean(true));
    called(&line.robot, stop, 1);
    assert_eq!(calls(&line.robot, stop).len(), 2, "false does not stop it");
}

#[test]
fn a_state_waits_for_its_service_and_an_event_does_not() {
    let Some(cell) = cell() else { return };
    // A value that calls a service is an event, unless its mapping sets another queue.
    let output = "name: DigitalOutput1\n    type: Boolean\n";
    let text = std::fs::read_to_string(MAPPING).unwrap();
    assert_eq!(text.matches(output).count(), 1);
    let text = text.replace(output, &format!("{output}    queue: keep_latest\n"));
    let file = cell.file("cell.yaml", &text);
    let mut line = start_with(&cell, file.to_str().unwrap());
    line.side.hear((1, 2, 11), "joints", |_| Some(()));
    let killed = line.robot.id();
    line.robot.signal(nix::sys::signal::Signal::SIGKILL);
    eventually("the robot is gone", SOON, || {
        (!Path::new(&format!("/proc/{killed}/cmdline")).exists() || !line.robot.runs())
            .then_some(())
    });
    line.side.write((0, 2, 45), Scalar::Boolean(true));
    line.side.write((0, 2, 40), Scalar::Byte(1));
    eventually("the event is counted as lost", SOON, || {
        let status = metrics(METRICS_ROS1)?;
        (number(&status, "call_failed") > 0).then_some(())
    });
    line.robot = cell.rospy("niryo.py", &[&definitions().unwrap()]);
    let request = called(&line.robot, "/niryo_robot_rpi/set_digital_io", 0);
    assert_eq!(request, json!({"name": "DO1", "value": true}));
    line.side.hear_scalar((1, 2, 46), Scalar::Int32(1));
    let events = calls(&line.robot, "/niryo_robot/conveyor/ping_and_set_conveyor");
    assert_eq!(
        events,
        [] as [Value; 0],
        "an event of before is not made up for"
    );
    assert!(line.bridge.runs());
}

#[test]
fn a_niryos_actions_are_there_for_a_client_that_knows_their_definitions() {
    let Some(cell) = cell() else { return };
    let _master = cell.roscore();
    let robot = cell.rospy("niryo.py", &[&definitions().unwrap()]);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let outcome = runtime.block_on(async {
        let mut options = NodeOptions::from_env("skill");
        options.master_uri = format!("http://{MASTER}");
        options.advertise_as("127.0.0.1");
        let node = Node::start(options).unwrap();
        let (goal_type, goal) = move_goal("cmd.cmd_type", "LINEAR_POSE");
        let client = ActionlibClient::new(
            &node,
            "/niryo_robot_arm_commander/robot_action",
            ClientType::of_goal(goal_type),
            ActionlibClientOptions::default(),
        )
        .unwrap();
        client.wait_for_server(SOON).await.unwrap();
        let mut goal = client.send_goal(&goal);
        let outcome = tokio::time::timeout(SOON, goal.outcome()).await.unwrap();
        node.shutdown().await;
        outcome
    });
    let result = outcome.unwrap();
    assert_eq!(result.status, actionlib::ActionlibStatus::Succeeded);
    // int32 status, 1 of niryo_robot_msgs/CommandStatus, before its text.
    assert_eq!(result.body[..4], 1i32.to_le_bytes());
    let told = robot.json_lines();
    let told = told.iter().find(|line| line.get("action").is_some());
    assert_eq!(told.map(|line| line["cmd_type"].clone()), Some(json!(5)));
}

#[test]
fn the_arm_its_gripper_and_its_conveyor_are_run_by_skills() {
    let Some(cell) = cell() else { return };
    let mut line = start(&cell);
    line.side.hear((1, 2, 11), "joints", |_| Some(()));
    line.side.write((0, 2, 40), Scalar::Byte(1));
    line.side.hear_scalar((1, 2, 41), Scalar::Int16(12));
    let example = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../examples/plant/niryo-ned.yaml"
    );
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([example, "--interface", "lo", "--lds", "none"])
        .start();
    let call = |words: &[&str]| {
        let words = [&["call"], words, &["--interface", "lo", "--wait", "30"]].concat();
        let mut asking = StartedChild::new("ua-space", &program("ua-space"))
            .args(words)
            .start();
        let code = asking.wait_for_end(SOON).code();
        assert_eq!(code, Some(0), "{:?}", asking.lines());
    };
    for (skill, parameter) in [
        ("PtpMove", &["TargetPosition=0.25,0,0.25,0,1.5,0"][..]),
        ("Grasp", &[]),
        ("Conveyor", &["On=true"]),
    ] {
        call(&[&format!("niryo-ned.{skill}.Reset")]);
        call(&[&[&*format!("niryo-ned.{skill}")], parameter].concat());
    }
    let told = line.robot.json_lines();
    let actions = told.iter().filter(|line| line.get("action").is_some());
    let actions: Vec<(&Value, &Value)> = actions
        .map(|line| (&line["action"], &line["cmd_type"]))
        .collect();
    let wanted = [
        (&json!("/niryo_robot_arm_commander/robot_action"), &json!(1)),
        (
            &json!("/niryo_robot_tools_commander/action_server"),
            &json!(2),
        ),
    ];
    assert_eq!(actions, wanted);
    let request = called(&line.robot, "/niryo_robot/conveyor/control_conveyor", 0);
    let wanted = json!({"id": 12, "control_on": true, "speed": 50, "direction": 1});
    assert_eq!(request, wanted);
}

/// Returns the type of RobotMove's goal topic, and a goal with a single field set.
fn move_goal(path: &str, value: &str) -> (TopicType, Vec<u8>) {
    let mut registry = TypeRegistry::bundle(Dialect::Ros1);
    let definitions = definitions().unwrap();
    for (folder, name, kind) in [
        ("niryo_robot_arm_commander", "RobotMove", "action"),
        ("niryo_robot_arm_commander", "ArmMoveCommand", "msg"),
        ("niryo_robot_arm_commander", "ShiftPose", "msg"),
        ("niryo_robot_msgs", "RobotState", "msg"),
        ("niryo_robot_msgs", "RPY", "msg"),
    ] {
        let file = format!("{definitions}/{folder}/{kind}/{name}.{kind}");
        let text = std::fs::read_to_string(file).unwrap();
        let name = format!("{folder}/{name}").parse().unwrap();
        match kind {
            "action" => registry.add_action(&name, &text).unwrap(),
            _ => registry.add(&name, &text).unwrap(),
        }
    }
    let name = "niryo_robot_arm_commander/RobotMove".parse().unwrap();
    let action = registry.action(&name).unwrap();
    let rest = [(path.to_owned(), Literal::One(value.to_owned()))].into();
    let template = Selection::Template {
        fields: Vec::new(),
        rest,
    };
    let plan = MessagePlan::compile(action.goal(), &template, Wire::Ros1).unwrap();
    let mut goal = Vec::new();
    plan.write(&mut NoFields, &mut goal).unwrap();
    let goal_type = TopicType {
        name: action.action_goal().name().to_string(),
        md5sum: action.action_goal().md5().to_owned(),
        definition: action.action_goal().definition().to_owned(),
    };
    (goal_type, goal)
}

#[test]
fn a_restarted_bridge_calls_for_the_next_value_that_is_written() {
    let Some(cell) = cell() else { return };
    let mut line = start(&cell);
    line.side.hear((1, 2, 11), "joints", |_| Some(()));
    let output = "/niryo_robot_rpi/set_digital_io";
    line.side.write((0, 2, 45), Scalar::Boolean(true));
    called(&line.robot, output, 0);
    line.bridge.end();
    line.bridge = bridge(&cell, MAPPING);
    let again = eventually("the next value is called for", SOON, || {
        line.side.write((0, 2, 45), Scalar::Boolean(true));
        calls(&line.robot, output).get(1).cloned()
    });
    assert_eq!(again, json!({"name": "DO1", "value": true}));
}
