//! Every kind of executor asked by every kind of asker, with requests and responses of every kind.
//!
//! The table of the guide is the one that this test sees.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Asker, Cell, Counting, Distribution, Peer, Started, program};

const CASES: [&str; 5] = ["bundled", "files", "empty", "megabyte", "messages"];
const COUNT: u32 = 10;

/// The service of a case that is executed in that space.
fn service(space: u16, case: usize) -> String {
    format!("/ua_{space}_2_{}", 60 + case)
}

fn services(space: u16) -> Vec<String> {
    let all = CASES.iter().enumerate();
    all.map(|(number, case)| format!("{case}={}", service(space, number)))
        .collect()
}

/// Asks for each case of a space; the cases that are answered, and right each time.
fn asks(asker: &mut Asker, space: u16) -> Vec<&'static str> {
    let answered = |(number, case): (usize, &&'static str)| {
        let told = asker.ask(json!({
            "case": case, "service": service(space, number), "count": COUNT, "at_once": 2,
            "wait": 15, "patience": 10,
        }));
        // A wrong answer is worse than none. What a failure makes of a response of ROS 2 is no answer.
        assert!(
            told["failures"] != 0 || told["wrongs"] == 0,
            "{case} of {space}: {told}"
        );
        if told["right"] != COUNT {
            eprintln!("{case} of {space}: {told}");
        }
        (told["right"] == COUNT).then_some(*case)
    };
    CASES.iter().enumerate().filter_map(answered).collect()
}

/// What the guide says crosses, in the order of [`CASES`].
fn in_the_guide(executing: &str, asking: &str) -> Vec<&'static str> {
    let guide = include_str!("../../docs/guide.md");
    let row = format!("| {executing} | {asking} |");
    let line = guide.lines().find(|line| line.starts_with(&row));
    let line = line.unwrap_or_else(|| panic!("the guide has no row `{row}`"));
    let cells = line[row.len()..].split('|').map(str::trim);
    let yes = CASES.iter().zip(cells).filter(|(_, cell)| *cell == "yes");
    yes.map(|(case, _)| *case).collect()
}

fn all_executed(executor: &mut Counting, askers: &[Vec<&str>]) {
    let counts: Value = executor.counts();
    let least = askers.iter().map(Vec::len).sum::<usize>() * 10;
    assert!(
        counts["executed"].as_u64().unwrap() >= least as u64,
        "{counts}"
    );
}

#[test]
fn services_of_rospy_are_asked_for_by_rclpy_of_both_distributions() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let [one, two] = [1, 2].map(|of| cell.call_mapping(of, ""));
    let _core = cell.roscore();
    let names = services(1);
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut executor = cell.rospy_executor(&names);
    let _bridges = (cell.bridge_ros1(&[&one]), cell.bridge_ros2(&[&two]));
    let mut seen = Vec::new();
    for (distribution, name) in [
        (Distribution::Jazzy, "rclpy (Jazzy)"),
        (Distribution::Kilted, "rclpy (Kilted)"),
    ] {
        let answered = asks(&mut cell.rclpy_asker(distribution), 1);
        assert_eq!(answered, in_the_guide("rospy", name), "{name}");
        seen.push(answered);
    }
    all_executed(&mut executor, &seen);
    let told = call_by_name(&cell, "ua_1_2_60", &["data=true"]);
    assert_eq!(
        told["fields"],
        json!({"success": true, "message": "odd"}),
        "{told}"
    );
}

#[test]
fn services_of_rclpy_are_asked_for_by_rospy() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let [one, two] = [1, 2].map(|of| cell.call_mapping(of, ""));
    let _core = cell.roscore();
    let names = services(2);
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let _bridges = (cell.bridge_ros1(&[&one]), cell.bridge_ros2(&[&two]));
    for (distribution, name) in [
        (Distribution::Jazzy, "rclpy (Jazzy)"),
        (Distribution::Kilted, "rclpy (Kilted)"),
    ] {
        let mut executor = cell.rclpy_executor(distribution, &names);
        let answered = asks(&mut cell.rospy_asker(), 2);
        assert_eq!(answered, in_the_guide(name, "rospy"), "{name}");
        all_executed(&mut executor, &[answered]);
    }
    let tool = cell.ros1_tool("rosservice", &["list"]);
    assert!(tool.contains(&service(2, 0)), "{tool:?}");
}

/// The response of `ua-space call`, from beside the bridges.
fn call_by_name(cell: &Cell, topic: &str, fields: &[&str]) -> Value {
    let args = [&["call", topic], fields, &["--json", "--interface", "lo"]].concat();
    let mut tool = Started::new("ua-space", &program("ua-space"))
        .args(args)
        .start();
    let status = tool.wait_for_end(Duration::from_secs(20));
    assert!(
        status.success() && cell.folder().exists(),
        "{status}: {tool}"
    );
    tool.json_lines().first().cloned().unwrap_or(Value::Null)
}
