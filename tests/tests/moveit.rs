//! `examples/plant/moveit-arm.yaml` with an action server of ROS 2 that takes the goals of MoveIt:
//! it executes, rejects, preempts and fails in planning. MoveIt itself is not run.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, program};

const SOON: Duration = Duration::from_secs(30);
const MAPPING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../mappings/moveit.yaml");
const ARM: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../examples/plant/moveit-arm.yaml"
);
const DEFINITIONS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/moveit");

fn ask(words: &[&str]) -> Child {
    let more = ["--interface", "lo", "--wait", "30", "--json"];
    StartedChild::new("ua-space", &program("ua-space"))
        .args([&["call"], words, &more].concat())
        .ends_on(Signal::SIGINT)
        .start()
}

/// Waits for the end of a call. Returns the exit code and the result.
fn ended(mut asking: Child) -> (i32, Value) {
    let code = asking.wait_for_end(SOON).code().unwrap();
    let lines = asking.json_lines();
    let result = lines.iter().find(|line| line["event"] == "result");
    (code, result.cloned().unwrap_or_else(|| json!(lines)))
}

fn goal(group: &mut Child) -> Value {
    group.wait_for_json("a goal", SOON, |line| {
        line.get("group").map(|_| line.clone())
    })
}

#[test]
fn an_arm_with_moveit_is_moved_by_skills() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut group = cell.cyclone("calls/ros2_moveit.py", &["/move_action"]);
    let bridge = cell.bridge_ros2_alone(&[MAPPING]);
    let _bridge = bridge.env("AMENT_PREFIX_PATH", DEFINITIONS).start();
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([ARM, "--interface", "lo", "--lds", "none"])
        .start();
    let reset = |skill: &str| {
        let (code, told) = ended(ask(&[&format!("arm.{skill}.Reset")]));
        assert_eq!(code, 0, "{told}");
    };
    reset("PtpMove");
    let (code, done) = ended(ask(&["arm.PtpMove", "TargetPosition=0.4,0.2,0.3,1.5,0,0"]));
    assert_eq!((code, &done["succeeded"]), (0, &json!(true)), "{done}");
    let met = goal(&mut group);
    assert_eq!(met["position"], json!([0.4, 0.2, 0.3, 1.0]), "{met}");
    let turned = [0.75_f64.cos(), 0.75_f64.sin(), 0.0, 0.0];
    let orientation = met["orientation"].as_array().unwrap();
    let mut pairs = orientation.iter().zip(turned);
    assert!(
        pairs.all(|(is, wanted)| (is.as_f64().unwrap() - wanted).abs() < 1e-9),
        "{met}"
    );
    assert_eq!(met["sphere"], json!([2, [0.0001]]), "{met}");
    assert_eq!(met["frame"], json!(["base_link", "tool0", 1.0]), "{met}");
    assert_eq!(
        met["planner"],
        json!(["pilz_industrial_motion_planner", "PTP"])
    );
    assert_eq!(
        met["scales"],
        json!([0.1, 0.1]),
        "never the full speed of the arm"
    );
    assert_eq!(
        (&met["is_diff"], &met["scene"]),
        (&json!(true), &json!([true, true]))
    );

    // What MoveIt does not do is told, and the skill does not count it as done.
    for (x, why) in [
        ("-1", "rejected"),
        ("-2", "aborted"),
        ("-4", "cancelled by somebody else"),
        ("7", "error_code.val is -2"),
    ] {
        let target = format!("TargetPosition={x},0,0,0,0,0");
        let (code, result) = ended(ask(&["arm.PtpMove", &target]));
        let message = result["message"].to_string();
        assert!(code == 1 && message.contains(why), "{x}: {result}");
        reset("PtpMove");
    }
    // Halt cancels the goal.
    let mut asking = ask(&["arm.PtpMove", "TargetPosition=100,0,0,0,0,0"]);
    asking.wait_for_json("the goal is accepted", SOON, |line| {
        (line["step"] == "Accepted").then_some(())
    });
    asking.signal(Signal::SIGINT);
    assert_eq!(ended(asking).0, 1);
    group.wait_for_json("the goal is cancelled", SOON, |line| {
        (line.get("cancel")? == &json!([100])).then_some(())
    });

    reset("JointMove");
    let joints = "TargetJointPosition=0.5,-1,0.25,0,1,-0.5";
    let (code, done) = ended(ask(&["arm.JointMove", joints]));
    assert_eq!(code, 0, "{done}");
    let met = group.wait_for_json("the goal of the joints", SOON, |line| {
        let joints = line.get("joints")?.as_array()?;
        (joints.len() == 6).then(|| line.clone())
    });
    assert_eq!(met["joints"][0], json!(["joint_1", 0.5, 1.0]), "{met}");
    assert_eq!(met["joints"][5], json!(["joint_6", -0.5, 1.0]), "{met}");

    reset("ToRest");
    executes_a_trajectory(&mut group);
}

/// Checks that a trajectory that was planned before is executed as the component has it.
fn executes_a_trajectory(group: &mut Child) {
    let (code, done) = ended(ask(&["arm.ToRest"]));
    assert_eq!((code, &done["succeeded"]), (0, &json!(true)), "{done}");
    let met = group.wait_for_json("the trajectory", SOON, |line| {
        line.get("trajectory").map(|_| line.clone())
    });
    let names: Vec<String> = (1..=6).map(|joint| format!("joint_{joint}")).collect();
    assert_eq!(met["names"], json!(names), "{met}");
    let points = met["trajectory"].as_array().unwrap();
    let times: Vec<&Value> = points.iter().map(|point| &point[1]).collect();
    assert_eq!(times, [0, 2, 5], "{met}");
    let last = json!([[0.0, -2.1, 2.1, -1.57, -1.57, 0.0], 5]);
    assert_eq!(points.last(), Some(&last), "{met}");
}
