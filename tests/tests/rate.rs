//! 10 000 numbered messages at 1 kHz: in order and without loss.

use std::time::{Duration, Instant};

use serde_json::Value;
use system_tests::{Cell, Child, METRICS_ROS1, METRICS_ROS2, Peer, metrics};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const PLANT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml");
const COUNT: u32 = 10_000;

/// Returns the numbers received so far, without the text that is sent until the whole path is
/// established.
fn numbers(heard: &Child) -> Vec<u32> {
    heard
        .values()
        .iter()
        .filter_map(|value| value["data"].as_str()?.parse().ok())
        .collect()
}

fn all_arrive_in_order(sends: &mut Child, heard: &mut Child) {
    heard.wait_for_line("warm-up", SOON);
    let start = Instant::now();
    sends.tell("go");
    sends.wait_for_line("\"sent\"", SOON);
    let sent_in = start.elapsed();
    let last = (COUNT - 1).to_string();
    let deadline = Instant::now() + Duration::from_secs(10);
    while !heard
        .values()
        .last()
        .is_some_and(|value| value["data"] == last.as_str())
        && Instant::now() < deadline
    {
        std::thread::sleep(Duration::from_millis(20));
    }

    let got = numbers(heard);
    let expected: Vec<u32> = (0..COUNT).collect();
    if got != expected {
        let missing = expected
            .iter()
            .filter(|number| got.binary_search(number).is_err())
            .count();
        let turns = got.windows(2).filter(|pair| pair[0] >= pair[1]).count();
        let status = |address| metrics(address).unwrap_or(Value::Null);
        panic!(
            "{} of {COUNT} arrived, {missing} are missing, {turns} are out of order or doubled\n{}\n{}",
            got.len(),
            status(METRICS_ROS1),
            status(METRICS_ROS2)
        );
    }
    // A sender that cannot keep its pace tests less than intended.
    assert!(
        sent_in < Duration::from_secs(20),
        "{COUNT} messages took {sent_in:?}"
    );
}

#[test]
fn ten_thousand_messages_at_1_khz_go_from_ros_1_to_ros_2() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[PLANT]), cell.bridge_ros2(&[PLANT]));
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_2_12", "std_msgs/String", "--domain", "2"],
    );
    let numbered = [
        "--numbered",
        "10000",
        "--rate",
        "1000",
        "--warm-up",
        "\"warm-up\"",
    ];
    let mut sends = cell
        .rospy_started(
            "ros1_pub.py",
            &[&["/ua_1_2_12", "std_msgs/String"][..], &numbered].concat(),
        )
        .told()
        .start();
    all_arrive_in_order(&mut sends, &mut heard);
}

#[test]
fn ten_thousand_messages_at_1_khz_go_from_ros_2_to_ros_1() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[PLANT]), cell.bridge_ros2(&[PLANT]));
    let mut heard = cell.rospy("ros1_sub.py", &["/ua_2_2_22", "std_msgs/String"]);
    let numbered = [
        "--numbered",
        "10000",
        "--rate",
        "1000",
        "--warm-up",
        "\"warm-up\"",
    ];
    let mut sends = cell
        .cyclone_started(
            "ros2_pub.py",
            &[
                &["/ua_2_2_22", "std_msgs/String", "--domain", "2"][..],
                &numbered,
            ]
            .concat(),
        )
        .told()
        .start();
    all_arrive_in_order(&mut sends, &mut heard);
}
