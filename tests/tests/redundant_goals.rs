//! Goals from an action client of ROS 1 to an action server of rclpy, behind two redundant bridges
//! of ROS 2 of which the active one is killed.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, METRICS_ROS2, Peer, eventually, metrics};

const SOON: Duration = Duration::from_secs(60);
const ACTION: &str = "/ua_2_2_70";
const METRICS: [&str; 2] = [METRICS_ROS2, "127.0.0.1:9112"];

/// Returns the number of the active bridge, if the other is its standby.
fn active() -> Option<usize> {
    let role = |at: usize| Some(metrics(METRICS[at])?["redundancy"]["role"].clone());
    let roles = [role(0)?, role(1)?];
    let at = roles.iter().position(|role| role == "active")?;
    (roles[1 - at] == "standby").then_some(at)
}

/// Waits for the end of a goal.
fn end_of(client: &mut Child, goal: u64) -> Value {
    client.wait_for_json(&format!("the end of goal {goal}"), SOON * 2, |line| {
        (line.get("goal")? == goal && line.get("end").is_some()).then(|| line["end"].clone())
    })
}

#[test]
fn a_goal_ends_and_is_never_executed_twice_when_the_bridge_of_its_server_is_killed() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _master = cell.roscore();
    let server = cell
        .rclpy_started(
            Distribution::Kilted,
            "ros2_rclpy_action.py",
            &["serve", ACTION],
        )
        .told()
        .start()
        .ready(SOON);
    let mapping = cell.file("cell.yaml", "spaces: [{id: 1}, {id: 2}]\n");
    let mapping = mapping.to_str().unwrap();
    let mut bridges = [0, 1].map(|at| {
        let rank = ["1", "2"][at];
        let arguments = [mapping, "--domain", "2", "--rank", rank];
        Some(cell.bridge_ros2_at(&arguments, METRICS[at]).start())
    });
    let _ros1 = cell.bridge_ros1(&[mapping]);
    let first = eventually("a bridge is active, the other standby", SOON, active);
    let client = [ACTION, "test_msgs/Fibonacci"];
    let mut client = cell
        .rospy_started("calls/actionlib_client.py", &client)
        .told()
        .start()
        .ready(SOON);

    // The goal runs until it is cancelled.
    client.tell(&json!({"send": {"order": 100}}).to_string());
    client.wait_for_json("the goal runs", SOON, |line| {
        (line["goal"] == 0 && line.get("feedback").is_some()).then_some(())
    });
    let killed = bridges[first].take().unwrap();
    killed.signal(Signal::SIGKILL);
    let end = end_of(&mut client, 0);
    assert_ne!(end, "SUCCEEDED", "the goal cannot succeed");

    // The other bridge carries new goals.
    let mut goal = 0;
    eventually("a new goal succeeds", SOON * 2, || {
        goal += 1;
        client.tell(&json!({"send": {"order": 5}}).to_string());
        (end_of(&mut client, goal) == "SUCCEEDED").then_some(())
    });
    let lines = server.json_lines();
    let taken = |order: i64| {
        let lines = lines.iter().filter(|line| line["goal"] == order);
        lines.count() as u64
    };
    assert_eq!(taken(100), 1, "the goal was executed once: {lines:?}");
    assert!((1..=goal).contains(&taken(5)), "{lines:?}");
}
