//! Subscribers that start after a value was published: they receive no event, and no state of a
//! producer that has ended.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, METRICS_ROS1, METRICS_ROS2, Peer, UaSide, UadpSocket, eventually,
    metrics,
};
use uadp::{NetworkMessage, NetworkMessageType, Scalar};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const TYPE: &str = "std_msgs/UInt32";

/// Starts subscribers of a topic: volatile and transient_local in ROS 2, and a subscriber in ROS 1.
fn late(cell: &Cell, topic: &str) -> [Child; 3] {
    let durability = |durability: &'static str| {
        let args = [topic, TYPE, "--domain", "2", "--durability", durability];
        cell.cyclone("ros2_sub.py", &[&args[..], &["--depth", "1"]].concat())
    };
    let ros1 = cell.rospy("ros1_sub.py", &[topic, TYPE, "--node", "late"]);
    [durability("volatile"), durability("transient_local"), ros1]
}

fn numbers(heard: &Child) -> Vec<u64> {
    let values = heard.values().into_iter();
    values.filter_map(|value| value["data"].as_u64()).collect()
}

/// Returns the number of values of a topic that a bridge has delivered.
fn delivered(bridge: &str, topic: &str) -> Option<u64> {
    let status: Value = metrics(bridge)?;
    status["topics"][topic]["delivered"].as_u64()
}

#[test]
fn a_command_of_opc_ua_reaches_present_subscribers_once_and_late_ones_never() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut side = UaSide::join();
    let topic = "/ua_0_5_10";
    let mut present = late(&cell, topic);
    // Written until all subscribers are known.
    for subscriber in &mut present {
        eventually("the subscriber is there", SOON, || {
            side.write((0, 5, 10), Scalar::UInt32(1));
            numbers(subscriber).contains(&1).then_some(())
        });
    }
    side.write((0, 5, 10), Scalar::UInt32(7));
    for subscriber in &mut present {
        subscriber.wait_for_line("7", SOON);
        assert_eq!(numbers(subscriber).iter().filter(|n| **n == 7).count(), 1);
    }
    drop(present);
    let mut late = late(&cell, topic);
    for subscriber in &mut late {
        eventually("the late subscriber is there", SOON, || {
            side.write((0, 5, 10), Scalar::UInt32(9));
            numbers(subscriber).contains(&9).then_some(())
        });
        assert!(!numbers(subscriber).contains(&7));
    }
}

/// The bridges advertise each topic with its first value, so even known subscribers have to connect
/// first.
#[test]
fn the_first_event_of_a_topic_reaches_subscribers_that_are_present() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2]) else {
        return;
    };
    let _master = cell.roscore();
    let mut rospy = [11, 12, 10].map(|number| {
        let (topic, node) = (format!("/ua_0_5_{number}"), format!("sub_{number}"));
        cell.rospy("ros1_sub.py", &[&topic, TYPE, "--node", &node])
    });
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    for number in (11..=20).chain([10_usize]) {
        let topic = format!("/ua_0_5_{number}");
        // The bridge cannot know whether a best-effort reader knows its new writer already.
        let qos = json!({"reliability": "RELIABLE"});
        judge.ask(json!({"subscribe": topic, "type": "std_msgs/msg/UInt32", "qos": qos}));
    }
    let mut side = UaSide::join();
    // The last topic shows when all subscribers are known.
    eventually("the subscribers are known", SOON, || {
        side.write((0, 5, 10), Scalar::UInt32(1));
        let heard = judge.child().json_lines();
        let is_heard = heard.iter().any(|line| line["heard"] == "/ua_0_5_10");
        (is_heard && !numbers(&rospy[2]).is_empty()).then_some(())
    });
    for number in 11..=20 {
        side.write((0, 5, number), Scalar::UInt32(u32::from(number)));
    }
    for number in 11..=20 {
        let data = |value: &Value| (value["data"] == number).then_some(());
        judge.hears(&format!("/ua_0_5_{number}"), data);
    }
    for (subscriber, number) in rospy.iter_mut().zip([11, 12]) {
        eventually("rospy receives the event", SOON, || {
            numbers(subscriber).contains(&number).then_some(())
        });
    }
    // A topic without subscribers.
    side.write((0, 5, 21), Scalar::UInt32(21));
    for bridge in [METRICS_ROS1, METRICS_ROS2] {
        eventually("the event is counted", SOON, || {
            let status: Value = metrics(bridge)?;
            let dropped = &status["topics"]["ua_0_5_21"]["dropped"];
            (dropped["no_subscriber"] == 1).then_some(())
        });
    }
}

#[test]
fn a_value_of_ros_1_that_is_not_latched_reaches_no_late_subscriber_of_ros_2_in_either_order_of_start()
 {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    for (topic, bridge_is_late) in [("/ua_1_5_10", false), ("/ua_1_5_11", true)] {
        let _ros1 = cell.bridge_ros1(&[]);
        let ros2 = (!bridge_is_late).then(|| cell.bridge_ros2(&[]));
        let name = topic.trim_start_matches('/');
        // In ROS 1, the value is delivered to the subscribers connected at that time.
        let value = ["--value", "7", "--wait-subscribers", "1"];
        let mut sends = cell.rospy("ros1_pub.py", &[&[topic, TYPE][..], &value].concat());
        eventually("the bridge has sent the value", SOON, || {
            let status: Value = metrics(METRICS_ROS1)?;
            (status["topics"][name]["repeated"].as_u64()? > 3).then_some(())
        });
        let _ros2 = ros2.unwrap_or_else(|| cell.bridge_ros2(&[]));
        let late = late(&cell, topic);
        eventually("the bridge has heard it several times", SOON, || {
            let status: Value = metrics(METRICS_ROS2)?;
            (status["topics"][name]["dropped"]["repeat"].as_u64()? > 5).then_some(())
        });
        let [volatile, transient_local, _] = &late;
        assert!(numbers(volatile).is_empty());
        assert!(numbers(transient_local).is_empty());
        sends.end();
    }
}

#[test]
fn a_latched_value_is_handed_to_nobody_once_its_producer_is_killed() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let topic = "/ua_1_5_10";
    let mut sends = cell.rospy("ros1_pub.py", &[topic, TYPE, "--latch", "--value", "7"]);
    sends.wait_for_line("\"sent\"", SOON);
    let reader = [
        topic,
        TYPE,
        "--domain",
        "2",
        "--durability",
        "transient_local",
    ];
    let reader = [&reader[..], &["--depth", "1"]].concat();
    let mut first = cell.cyclone("ros2_sub.py", &reader);
    let value = |line: &Value| line.get("value").cloned();
    let seven = first.wait_for_json("the state", SOON, value);
    assert_eq!(seven, json!({"data": 7}));
    sends.end();
    let name = topic.trim_start_matches('/');
    // For longer than `receive_timeout`.
    let group = UadpSocket::join();
    eventually("the producer says nothing any more", SOON, || {
        group.drain();
        let heard = group.receive_for(Duration::from_millis(3500));
        let is_value = |datagram: &Vec<u8>| {
            let message = NetworkMessage::decode(datagram);
            message.is_ok_and(|message| message.message_type() == NetworkMessageType::DataSet)
        };
        (!heard.iter().any(is_value)).then_some(())
    });
    let before = delivered(METRICS_ROS2, name);
    let third = cell.cyclone("ros2_sub.py", &reader);
    // A marker on another topic arrives after the values that the bridge could deliver at
    // discovery.
    let mut side = UaSide::join();
    let marker = ["/ua_0_5_20", TYPE, "--domain", "2"];
    let marker = cell.cyclone("ros2_sub.py", &marker);
    let mut count = 0;
    eventually("the markers come", SOON, || {
        side.write((0, 5, 20), Scalar::UInt32(count));
        count += 1;
        (numbers(&marker).len() > 20).then_some(())
    });
    assert!(numbers(&third).is_empty());
    assert_eq!(delivered(METRICS_ROS2, name), before);
}
