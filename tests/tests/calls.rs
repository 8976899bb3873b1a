//! Calls of the space, made by nodes of ROS 1 and ROS 2.

use std::time::{Duration, Instant};

use messages::{Dialect, TypeRegistry};
use serde_json::{Value, json};
use system_tests::{
    Cell, Distribution, Executes, Executor, Judge, Peer, StartedChild, eventually, program,
};

const START: (u16, u16, u16) = (0, 7, 105);
const SERVICE: &str = "/ua_0_7_105";
const NAME: &str = "gripper.Grasp.Start";
/// The time that rospy and rclpy need to start on a busy machine.
const SOON: Duration = Duration::from_secs(30);

/// Returns the results of a rospy client that calls `times` times: responses, or texts of errors.
fn rospy_calls(cell: &Cell, times: usize) -> Vec<Value> {
    let mut args = vec![SERVICE, "std_srvs/Trigger"];
    for _ in 0..times {
        args.extend(["--value", "{}"]);
    }
    let mut client = cell.rospy("ros1_call.py", &args);
    let told = |line: &Value| line.get("value").or_else(|| line.get("error")).cloned();
    (0..times)
        .map(|_| client.wait_for_json("an answer", SOON, told))
        .collect()
}

fn judge_calls(judge: &mut Judge) -> Value {
    judge.ask(json!({"call": SERVICE, "type": "std_srvs/srv/Trigger", "value": {}}))
}

#[test]
fn a_rospy_client_asks_for_a_call_that_is_executed_once_although_datagrams_are_doubled() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let executor = Executor::start(START, NAME, Executes::AtOnce, 2);
    let _bridge = cell.bridge_ros1(&[]);
    let answers = rospy_calls(&cell, 3);
    let answer = json!({"success": true, "message": NAME});
    assert_eq!(answers, [answer.clone(), answer.clone(), answer]);
    assert_eq!(executor.executed(), 3);
}

#[test]
fn an_executor_that_is_killed_is_a_fault_to_rospy_and_its_service_goes() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let executor = Executor::start(START, NAME, Executes::Forever, 1);
    let _bridge = cell.bridge_ros1(&[]);
    let mut client = cell.rospy(
        "ros1_call.py",
        &[SERVICE, "std_srvs/Trigger", "--value", "{}"],
    );
    eventually("the call is begun", SOON, || {
        (executor.executed() == 1).then_some(())
    });
    executor.kill();
    let start = Instant::now();
    let fault = client.wait_for_json("the fault", SOON, |line| line.get("error").cloned());
    assert!(start.elapsed() < BOUND, "{:?}", start.elapsed());
    assert!(fault.as_str().unwrap().contains("known"), "{fault}");
}

#[test]
fn an_rclpy_client_sees_and_asks_for_a_call_and_is_told_when_its_executor_is_killed() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let executor = Executor::start(START, NAME, Executes::AtOnce, 2);
    let _bridge = cell.bridge_ros2(&[]);
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    judge.until(&json!({"nodes": 1}), |nodes| {
        nodes
            .as_array()?
            .contains(&json!("/ua_bridge_ros2"))
            .then_some(())
    });
    // The services as in `ros2 node info`.
    let info = judge.until(&json!({"info": "/ua_bridge_ros2"}), |info| {
        let services = info["services"].as_array()?;
        services
            .iter()
            .find(|service| service[0] == SERVICE)
            .cloned()
    });
    assert_eq!(info, json!([SERVICE, ["std_srvs/srv/Trigger"]]));
    // The bridge describes the type of the service as a node of ROS with such a service does.
    judge.ask(json!({"serve": "/own", "type": "std_srvs/srv/Trigger", "value": {}}));
    let trigger = "std_srvs/Trigger".parse().unwrap();
    let hashes = TypeRegistry::bundle(Dialect::Ros2).service_type_hashes(&trigger);
    let asked = json!({"type_name": "std_srvs/srv/Trigger", "type_hash": hashes.unwrap().service.to_string()});
    let answer = json!({"success": true, "message": NAME});
    assert_eq!(judge_calls(&mut judge), answer);
    let [ours, theirs] = ["/ua_bridge_ros2", "/judge/judge"].map(|node| {
        let service = format!("{node}/get_type_description");
        let interface = "type_description_interfaces/srv/GetTypeDescription";
        let told = judge.ask(json!({"call": service, "type": interface, "value": asked}));
        assert_eq!(told["successful"], true, "{told}");
        told["type_description"].clone()
    });
    assert_eq!(ours, theirs);
    for _ in 0..2 {
        assert_eq!(judge_calls(&mut judge), answer);
    }
    assert_eq!(executor.executed(), 3);
    executor.kill();
    let executor = Executor::start(START, NAME, Executes::Forever, 1);
    let killed = std::thread::spawn(move || {
        eventually("the call is begun", SOON, || {
            (executor.executed() == 1).then_some(())
        });
        executor.kill();
        Instant::now()
    });
    let told = judge_calls(&mut judge);
    let took = killed.join().unwrap().elapsed();
    assert!(took < BOUND, "{took:?}");
    assert_eq!(told["success"], false);
    let why = told["message"].as_str().unwrap();
    assert!(why.contains("known"), "{why}");
}

#[test]
fn a_skill_of_a_component_is_started_from_ros_2_and_from_ros_1() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let yaml = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../examples/plant/parallel-gripper.yaml"
    );
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([yaml, "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("pki")])
        .start();
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    judge.until(&json!({"topics": 1}), |topics| {
        (topics["/ua_0_7_101"] == json!(["ua_msgs/msg/SkillState"])).then_some(())
    });
    let mut call = |id: u16| {
        let service = format!("/ua_0_7_{id}");
        judge.ask(json!({"call": service, "type": "std_srvs/srv/Trigger", "value": {}}))
    };
    let [start, halt, reset] = [105, 106, 109];
    // The skill may be Halted or Ready at first.
    call(reset);
    let started = call(start);
    assert_eq!(started["success"], true, "{started}");
    let refused = call(start);
    let why = refused["message"].as_str().unwrap();
    assert!(
        refused["success"] == false && why.starts_with("BadInvalidState"),
        "{refused}"
    );
    for id in [halt, reset] {
        let answer = call(id);
        assert_eq!(answer["success"], true, "{answer}");
    }
    let answers = rospy_calls(&cell, 1);
    assert_eq!(answers[0]["success"], true, "{answers:?}");
}

/// Time within which a caller learns that the executor is lost.
const BOUND: Duration = Duration::from_secs(8);
