//! A node that returns every topic of the space to the same topic: traffic must end.

use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, Peer, UadpSocket, eventually};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
/// Long enough to reveal a loop: a round trip takes a few milliseconds.
const WINDOW: Duration = Duration::from_secs(4);

fn of_publisher(datagrams: &[Vec<u8>], space: u8) -> usize {
    // UADP version and flags, ExtendedFlags1, then the PublisherId as UInt16.
    datagrams
        .iter()
        .filter(|bytes| bytes.len() > 3 && bytes[1] & 0b111 == 1 && bytes[2..4] == [space, 0])
        .count()
}

fn wait_for_silence(group: &UadpSocket) -> Vec<Vec<u8>> {
    // Two topics, each with a key frame or keep-alive a second, and a margin for a busy machine.
    let most = 2 * (WINDOW.as_secs() as usize + 2);
    eventually("traffic falls to key frames and keep-alives", SOON, || {
        group.drain();
        let heard = group.receive_for(WINDOW);
        (heard.len() <= most).then_some(heard)
    })
}

#[test]
fn an_echoing_ros_1_node_makes_no_loop() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut echo = cell.rospy("ros1_echo_loop.py", &[]);
    let string = "std_msgs/String";
    let mut in_ros2 = cell.cyclone("ros2_sub.py", &["/ua_1_5_10", string, "--domain", "2"]);
    let mut in_ros1 = cell.rospy("ros1_sub.py", &["/ua_2_5_10", string]);
    let of_ros1 = cell.rospy(
        "ros1_pub.py",
        &["/ua_1_5_10", string, "--repeat", "0", "--value", "\"one\""],
    );
    let of_ros2 = cell.cyclone(
        "ros2_pub.py",
        &[
            "/ua_2_5_10",
            string,
            "--domain",
            "2",
            "--repeat",
            "0",
            "--value",
            "\"two\"",
        ],
    );
    in_ros2.wait_for_line("\"one\"", SOON);
    in_ros1.wait_for_line("\"two\"", SOON);
    echo.wait_for_json("it echoes the topic of ROS 1", SOON, |line| {
        (line["echoed"] == "/ua_1_5_10").then_some(())
    });
    echo.wait_for_json("it echoes the topic of ROS 2", SOON, |line| {
        (line["echoed"] == "/ua_2_5_10").then_some(())
    });

    drop((of_ros1, of_ros2));
    let group = UadpSocket::join();
    wait_for_silence(&group);
    let heard = (
        in_ros1.values().len(),
        in_ros2.values().len(),
        echo.lines().len(),
    );
    let quiet = group.receive_for(WINDOW);
    assert!(
        quiet.len() <= 12,
        "{} datagrams in {WINDOW:?} with nobody publishing",
        quiet.len()
    );
    let after = (
        in_ros1.values().len(),
        in_ros2.values().len(),
        echo.lines().len(),
    );
    assert_eq!(
        heard, after,
        "(ROS 1 subscriber, ROS 2 subscriber, echo) hear nothing more"
    );
    assert!(echo.runs());
}

#[test]
fn nothing_comes_home_to_the_space_it_was_produced_in() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut at_home = cell.rospy("ros1_sub.py", &["/ua_1_5_10", "std_msgs/String"]);
    let mut abroad = cell.cyclone(
        "ros2_sub.py",
        &["/ua_1_5_10", "std_msgs/String", "--domain", "2"],
    );
    let _sends = cell.rospy(
        "ros1_pub.py",
        &[
            "/ua_1_5_10",
            "std_msgs/String",
            "--repeat",
            "0",
            "--value",
            "\"one\"",
        ],
    );
    abroad.wait_for_line("\"one\"", SOON);
    at_home.wait_for_line("\"one\"", SOON);

    let datagrams = group.receive_for(WINDOW);
    assert!(of_publisher(&datagrams, 1) > 0);
    assert_eq!(
        of_publisher(&datagrams, 2),
        0,
        "the ROS 2 bridge sends nothing of space 1 back"
    );
    let senders: Vec<Value> = at_home
        .json_lines()
        .iter()
        .filter_map(|line| line.get("callerid").cloned())
        .collect();
    assert!(
        senders.iter().all(|sender| sender == "/rospy_pub"),
        "{senders:?}"
    );
}
