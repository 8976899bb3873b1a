//! A single `bridge-ros2` that serves several spaces, each in a separate DDS domain.

use std::time::Duration;

use nix::sys::signal::Signal;
use system_tests::{Cell, Child, METRICS_ROS2, Peer, eventually, metrics};

const SOON: Duration = Duration::from_secs(30);
/// Long enough to reveal a loop: a round trip takes a few milliseconds.
const WINDOW: Duration = Duration::from_secs(2);
const STRING: &str = "std_msgs/String";
const COUNT: usize = 100;

fn subscriber(cell: &Cell, topic: &str, domain: &str) -> Child {
    cell.cyclone("ros2_sub.py", &[topic, STRING, "--domain", domain])
}

/// Starts a publisher that sends numbers when it is ordered to, and other texts until then.
fn numbers(cell: &Cell, topic: &str, domain: &str) -> Child {
    let count = COUNT.to_string();
    cell.cyclone_started(
        "ros2_pub.py",
        &[
            topic,
            STRING,
            "--domain",
            domain,
            "--numbered",
            &count,
            "--rate",
            "100",
            "--warm-up",
            "\"warm\"",
        ],
    )
    .told()
    .start()
}

/// Returns the numbers that a subscriber received.
fn numbers_of(subscriber: &Child) -> Vec<String> {
    let text = |value: &serde_json::Value| value["data"].as_str().map(str::to_owned);
    subscriber
        .values()
        .iter()
        .filter_map(text)
        .filter(|value| value != "warm")
        .collect()
}

#[test]
fn values_cross_between_two_domains_of_one_bridge_once_and_do_not_come_home() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.file(
        "cell.yaml",
        "spaces:\n  - {id: 2, domain: 12}\n  - {id: 3, domain: 13}\n\
         namespaces:\n  5: urn:test\n\
         variables:\n\
         \x20 - {node: ns=5;i=10, name: One, origin: 2, queue: {drop_oldest: 200}}\n\
         \x20 - {node: ns=5;i=11, name: Two, origin: 3, queue: {drop_oldest: 200}}\n",
    );
    let file = file.to_str().unwrap();
    let mut bridge = cell.bridge_ros2_alone(&[file, "--space", "2,3"]).start();
    eventually("the bridge answers", SOON, || metrics(METRICS_ROS2));
    // For each value, a subscriber in its own domain and a subscriber in the other domain.
    let mut subscribers = [
        ("/ua_2_5_10", "12"),
        ("/ua_2_5_10", "13"),
        ("/ua_3_5_11", "12"),
        ("/ua_3_5_11", "13"),
    ]
    .map(|(topic, domain)| subscriber(&cell, topic, domain));
    let mut publishers = [
        numbers(&cell, "/ua_2_5_10", "12"),
        numbers(&cell, "/ua_3_5_11", "13"),
    ];
    for subscriber in &mut subscribers {
        subscriber.wait_for_line("warm", SOON);
    }
    for publisher in &mut publishers {
        publisher.tell("");
    }
    let all: Vec<String> = (0..COUNT).map(|n| format!("{n}")).collect();
    for subscriber in &mut subscribers {
        eventually("all numbers arrive", SOON, || {
            (numbers_of(subscriber).len() >= COUNT).then_some(())
        });
    }
    let silence = std::time::Instant::now() + WINDOW;
    eventually("the window is over", SOON, || {
        (std::time::Instant::now() >= silence).then_some(())
    });
    for subscriber in &mut subscribers {
        let heard = numbers_of(subscriber);
        assert_eq!(heard, all, "each number once and in order");
    }
    let status = metrics(METRICS_ROS2).unwrap();
    let spaces: Vec<u64> = status
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|space| space["space"].as_u64())
        .collect();
    assert_eq!(spaces, [2, 3], "/status has one object for each space");
    bridge.signal(Signal::SIGTERM);
    assert!(bridge.wait_for_end(SOON).success());
}
