//! Programs that exchange messages in shared memory. They were built with the feature `shm`.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, METRICS_ROS2, Peer, metrics};

use crate::mqtt::space;
use crate::server::confirm::is_never_late_after_a_stop;

const SOON: Duration = Duration::from_secs(30);

/// Returns the name of a group that no other test has.
fn group() -> String {
    format!("system-{}", std::process::id())
}

fn text(cell: &Cell, text: &str) -> Child {
    let value = json!(text).to_string();
    cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            &value,
        ],
    )
}

fn hears(heard: &mut Child, text: &str) {
    heard.wait_for_json("the text in ROS 2", SOON, |line: &Value| {
        (line["value"]["data"] == text).then_some(())
    });
}

#[test]
fn values_cross_and_go_on_after_a_program_was_killed() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let group = group();
    let mapping = format!("pubsub: {{shm: {{group: {group}}}}}\n");
    let mapping = cell.file("cell.yaml", &mapping);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let ros1 = cell.bridge_ros1(&[mapping]);
    let _ros2 = cell.bridge_ros2(&[mapping]);
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_10", "std_msgs/String", "--domain", "2"],
    );
    let before = text(&cell, "before");
    hears(&mut heard, "before");
    let status = metrics(METRICS_ROS2).unwrap();
    assert!(
        status.to_string().contains(&format!("shm:{group}")),
        "{status}"
    );

    // The command line sees the group, and UDP does not have it.
    let address = format!("shm:{group}");
    for (args, is_there) in [(&["--address", address.as_str()][..], true), (&[], false)] {
        let args = [&["list", "--topics", "--seconds", "2", "--json"][..], args].concat();
        let listed = space(&args);
        assert_eq!(listed.contains("ua_1_5_10"), is_there, "{listed}");
    }

    ros1.signal(Signal::SIGKILL);
    drop((ros1, before));
    let _ros1 = cell.bridge_ros1(&[mapping]);
    let _after = text(&cell, "after");
    hears(&mut heard, "after");
}

#[test]
fn a_command_is_never_late_when_its_bridge_was_stopped() {
    let carrier = format!("shm: {{group: {}}}", group());
    is_never_late_after_a_stop(&carrier);
}
