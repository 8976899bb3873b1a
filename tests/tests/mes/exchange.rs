//! The exchange of an arm: the same process, with another YAML file of the arm.

use serde_json::{Value, json};
use system_tests::{Cell, Child, StartedChild, eventually, program};

use super::{EXAMPLES, PROCESS, SOON, list, run, start};
use crate::niryo;

/// Runs the process of the example with an arm, and returns the steps that ran and the chosen skill
/// of each role.
fn ran_on(cell: &Cell, arm: &str) -> (Vec<Value>, Vec<(String, String)>) {
    for file in ["capabilities.ttl", "vacuum-gripper.xml"] {
        let from = std::path::Path::new(EXAMPLES).join(file);
        std::fs::copy(from, cell.folder().join(file)).unwrap();
    }
    let _arm = start(cell, "ua-component", arm, &[], &[]);
    let _gripper = start(cell, "ua-component", "parallel-gripper.yaml", &[], &[]);
    let _mes = start(cell, "ua-mes", "mes.yaml", &[], &["--run", PROCESS]);
    let done = run("the process has ended", |run| {
        matches!(run["outcome"].as_str(), Some("done" | "failed"))
    });
    assert_eq!(done["outcome"], "done", "{arm}: {done}");
    let [plan] = list(&done, "plans") else {
        panic!("{done}")
    };
    let steps = list(plan, "ran").iter().map(|ran| ran["step"].clone());
    let needs = list(plan, "steps")
        .iter()
        .flat_map(|step| list(step, "needs"));
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let chosen = needs.map(|need| (text(&need["role"]), text(&need["chosen"])));
    (steps.collect(), chosen.collect())
}

fn simulated_ur() -> Child {
    let simulator = StartedChild::new("universal-robot", &program("ua-component"))
        .args(["simulate", "universal-robot", "--speed", "20"])
        .start();
    eventually("the simulator serves", SOON, || {
        std::net::TcpStream::connect("127.0.0.1:30004").ok()
    });
    simulator
}

#[test]
fn a_process_runs_on_a_ur_and_on_a_niryo_with_nothing_changed_but_the_file_of_the_arm() {
    let Some(cell) = niryo::cell() else { return };
    let on_ur = {
        let _simulator = simulated_ur();
        ran_on(&cell, "ur5.yaml")
    };
    let line = niryo::start(&cell);
    line.side.hear((1, 2, 11), "joints", |_| Some(()));
    let on_niryo = ran_on(&cell, "niryo-ned.yaml");
    assert_eq!(on_ur.0, on_niryo.0, "the same steps");
    assert!(on_ur.0.contains(&json!("MovePick")), "{on_ur:?}");
    let arms = |chosen: &[(String, String)]| {
        let arms = chosen
            .iter()
            .filter(|(role, _)| role == "ptp" || role == "linear");
        let mut arms: Vec<String> = arms
            .map(|(_, skill)| skill.split('#').next().unwrap_or_default().to_owned())
            .collect();
        arms.dedup();
        arms
    };
    assert_eq!(arms(&on_ur.1), ["urn:example:ur5"], "{on_ur:?}");
    assert_eq!(arms(&on_niryo.1), ["urn:example:niryo-ned"], "{on_niryo:?}");
    // The arm itself has moved: joint moves to the approach, straight moves to the part.
    let lines = line.robot.json_lines();
    let commands: Vec<&Value> = lines
        .iter()
        .filter(|line| line.get("action").is_some())
        .map(|line| &line["cmd_type"])
        .collect();
    assert_eq!(commands, [1, 5, 5, 1, 5, 5], "{lines:?}");
}
