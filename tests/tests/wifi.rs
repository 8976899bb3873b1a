//! Two hosts at a radio link that loses datagrams and carries no multicast: each bridge sends to
//! the address of the other (`peers`).

use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, HERE, Peer, StartedChild, THERE, WireEffect, program};

const SOON: Duration = Duration::from_secs(60);
const TOPIC: [&str; 2] = ["/ua_1_5_10", "std_msgs/String"];
const COUNT: u32 = 200;

/// Writes the mapping of a host.
fn mapping(cell: &Cell, name: &str, [own, other]: [&str; 2]) -> String {
    let text = format!(
        "pubsub: [{{udp: {{address: \"opc.udp://{own}:4840\", peers: [\"{other}:4840\"]}}}}]\n\
         spaces: [{{id: 1}}, {{id: 2}}]\n"
    );
    cell.file(name, &text).display().to_string()
}

/// Sends texts ten times a second from ROS 1 on this host to ROS 2 on the other. At most `missing`
/// are lost.
fn arrive_with(loss: f64, missing: usize) {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let host = cell.host(WireEffect {
        loss,
        delay: Duration::from_millis(3),
    });
    let _master = cell.roscore();
    let here = mapping(&cell, "here.yaml", [HERE, THERE]);
    let there = mapping(&cell, "there.yaml", [THERE, HERE]);
    let bridge = |name: &str| StartedChild::new(name, &program(name));
    let _ros1 = cell.with_ros1(bridge("bridge-ros1")).args([here]).start();
    let _ros2 = bridge("bridge-ros2")
        .args([&there[..], "--domain", "2"])
        .on(&host)
        .start();
    let subscriber = [&TOPIC[..], &["--domain", "2"]].concat();
    let mut receives = cell
        .cyclone_started("ros2_sub.py", &subscriber)
        .on(&host)
        .start()
        .ready(SOON);
    let count = COUNT.to_string();
    let numbered = [
        "--numbered",
        &count,
        "--rate",
        "10",
        "--warm-up",
        "\"warm\"",
    ];
    let mut sends = cell
        .rospy_started("ros1_pub.py", &[&TOPIC[..], &numbered].concat())
        .told()
        .start()
        .ready(SOON);
    receives.wait_for_json("the first text", SOON, |line| line.get("value").map(drop));
    sends.tell("begin");
    let last = Value::from((COUNT - 1).to_string());
    receives.wait_for_json("the last text", SOON, |line| {
        (line["value"]["data"] == last).then_some(())
    });
    let numbers: Vec<u32> = receives
        .values()
        .iter()
        .filter_map(|value| value["data"].as_str()?.parse().ok())
        .collect();
    assert!(
        numbers.windows(2).all(|pair| pair[0] < pair[1]),
        "{numbers:?}"
    );
    assert!(numbers.len() + missing >= COUNT as usize, "{numbers:?}");
}

#[test]
fn events_between_unicast_hosts_survive_a_loss_of_one_percent() {
    arrive_with(0.01, 0);
}

#[test]
fn events_between_unicast_hosts_survive_a_loss_of_five_percent() {
    // An event is lost if all of its three datagrams are lost: one of 8000.
    arrive_with(0.05, 2);
}
