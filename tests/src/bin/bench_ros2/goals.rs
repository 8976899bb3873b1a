//! The time until a goal is accepted through both bridges, compared with a direct goal within a
//! ROS.

use std::time::Duration;

use serde_json::json;
use system_tests::{Cell, Child, Distribution, Times};

use crate::ends::{LIMIT, START};

pub(crate) fn measure(cell: &Cell, goals: u64) {
    let mut ways = Ways::stand(cell);
    println!("\n{goals} goals of each way, one at a time, in turns of {TURN}; microseconds:\n");
    println!("| way | lost | accepted p50 | p99 |");
    println!("|---|---|---|---|");
    let mut sums = NAMES.map(|_| Times::default());
    for _ in 0..goals.div_ceil(TURN) {
        for (way, times) in sums.iter_mut().enumerate() {
            for took in ways.ask(way) {
                times.add(took);
            }
        }
    }
    for (name, mut times) in NAMES.into_iter().zip(sums) {
        let lost = goals.next_multiple_of(TURN) - times.count();
        let [half, most] = [0.5, 0.99].map(|share| times.at(share));
        println!("| {name} | {lost} | {half:.0} | {most:.0} |");
    }
}

/// A client for each way, in the order of [`NAMES`].
struct Ways {
    clients: [Child; 4],
    /// The bridges, and the servers of the goals.
    _others: [Child; 4],
}

impl Ways {
    fn stand(cell: &Cell) -> Self {
        let servers = [
            cell.rospy_started(
                "calls/actionlib_server.py",
                &[OF_ROS1, TYPE, "--limit", LIMIT],
            ),
            cell.rclpy_started(
                Distribution::Jazzy,
                RCLPY,
                &["serve", OF_ROS2, "--limit", LIMIT],
            ),
        ];
        let [of_ros1, of_ros2] = servers.map(|server| server.told().start().ready(START));
        let bridges = [cell.bridge_ros1(&[]), cell.bridge_ros2(&[])];
        let by_actionlib = |action: &str| {
            // Of two nodes with the same name, the master shuts the first down.
            let node = action.trim_start_matches('/');
            let args = [action, TYPE, "--plain", "--limit", LIMIT, "--node", node];
            cell.rospy_started("calls/actionlib_client.py", &args)
        };
        let by_rclpy = |action: &str| {
            let args = ["call", action, "--wait", "60", "--limit", LIMIT];
            cell.rclpy_started(Distribution::Jazzy, RCLPY, &args)
        };
        let clients = [
            by_actionlib(OF_ROS1),
            by_rclpy(OF_ROS2),
            by_rclpy(OF_ROS1),
            by_actionlib(OF_ROS2),
        ];
        let [one, two] = bridges;
        let mut ways = Self {
            clients: clients.map(|client| client.told().start().ready(START)),
            _others: [of_ros1, of_ros2, one, two],
        };
        // The first goals are slow and not measured.
        for way in 0..NAMES.len() {
            drop(ways.ask(way));
        }
        ways
    }

    /// Sends [`TURN`] goals on a way of [`NAMES`].
    fn ask(&mut self, way: usize) -> Vec<Duration> {
        let client = &mut self.clients[way];
        let told = match way {
            0 | 3 => client.ask(&json!({"accepts": TURN}).to_string(), START),
            _ => client.ask(&format!("accepts {TURN}"), START),
        };
        let times = told["ns"].as_array().unwrap();
        let times = times.iter().map(|time| time.as_u64().unwrap());
        times.map(Duration::from_nanos).collect()
    }
}

const NAMES: [&str; 4] = [
    "actionlib -> actionlib, direct",
    "rclpy -> rclpy, direct",
    "rclpy -> both bridges -> actionlib",
    "actionlib -> both bridges -> rclpy",
];
const RCLPY: &str = "ros2_rclpy_action.py";
const TYPE: &str = "test_msgs/Fibonacci";
const OF_ROS1: &str = "/ua_1_2_70";
const OF_ROS2: &str = "/ua_2_2_70";
/// Goals of a way before the next way's turn.
const TURN: u64 = 25;
