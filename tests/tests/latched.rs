//! Values that were published before a subscriber started.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Peer, UadpSocket, eventually};
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId,
    Scalar, Timestamp, Variant,
};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const KEPT: [&str; 6] = [
    "--domain",
    "2",
    "--durability",
    "transient_local",
    "--depth",
    "1",
];

fn value(line: &Value) -> Option<Value> {
    line.get("value").cloned()
}

#[test]
fn a_latched_value_reaches_a_ros_2_side_that_starts_later() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let mut sends = cell.rospy(
        "ros1_pub.py",
        &["/ua_1_5_10", "std_msgs/Bool", "--latch", "--value", "true"],
    );
    sends.wait_for_line("\"sent\"", SOON);

    let group = UadpSocket::join();
    let _ros1 = cell.bridge_ros1(&[]);
    eventually("the value is on the group", SOON, || {
        group.receive(Duration::from_millis(100))
    });

    let _ros2 = cell.bridge_ros2(&[]);
    let mut heard = cell.cyclone(
        "ros2_sub.py",
        &[&["/ua_1_5_10", "std_msgs/Bool"][..], &KEPT].concat(),
    );
    assert_eq!(
        heard.wait_for_json("the latched value", SOON, value),
        json!({"data": true})
    );
}

#[test]
fn a_second_late_ros_2_reader_gets_the_value_from_the_bridge_at_once() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let reader = [&["/ua_1_5_10", "std_msgs/UInt32"][..], &KEPT].concat();
    let mut first = cell.cyclone("ros2_sub.py", &reader);
    let sends = cell.rospy(
        "ros1_pub.py",
        &["/ua_1_5_10", "std_msgs/UInt32", "--latch", "--value", "42"],
    );
    assert_eq!(
        first.wait_for_json("the value", SOON, value),
        json!({"data": 42})
    );

    let mut second = cell.cyclone("ros2_sub.py", &reader);
    assert_eq!(
        second.wait_for_json("the kept value", SOON, value),
        json!({"data": 42})
    );
    drop(sends);
}

#[test]
fn a_transient_local_value_reaches_a_ros_1_side_that_starts_later() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mut sends = cell.cyclone(
        "ros2_pub.py",
        &[
            &["/ua_2_5_10", "std_msgs/UInt32", "--value", "42"][..],
            &KEPT,
        ]
        .concat(),
    );
    sends.wait_for_line("\"sent\"", SOON);

    let group = UadpSocket::join();
    let _ros2 = cell.bridge_ros2(&[]);
    eventually("the value is on the group", SOON, || {
        group.receive(Duration::from_millis(100))
    });

    let _master = cell.roscore();
    let _ros1 = cell.bridge_ros1(&[]);
    let mut heard = cell.rospy("ros1_sub.py", &["/ua_2_5_10", "std_msgs/UInt32"]);
    assert_eq!(
        heard.wait_for_json("the kept value", SOON, value),
        json!({"data": 42})
    );
}

/// Returns the value of a std_msgs/String in a datagram of the triple 5, 10.
fn text_of(datagram: &[u8]) -> Option<String> {
    let message = NetworkMessage::decode(datagram).ok()?;
    let message = message.messages().next()?.ok()?;
    let field = message.fields().ok()?.next()?.ok()?;
    match field {
        Variant::Scalar(Scalar::String(Some(text))) => Some(text.to_owned()),
        _ => None,
    }
}

fn repeated(group: &UadpSocket) -> BTreeSet<String> {
    group.drain();
    let datagrams = group.receive_for(Duration::from_millis(2500));
    datagrams.iter().filter_map(|d| text_of(d)).collect()
}

#[test]
fn a_late_reader_of_the_space_gets_the_value_of_each_latched_publisher_that_is_there() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _ros1 = cell.bridge_ros1(&[]);
    let mut publishers = ["left", "right", "base"].map(|name| {
        let value = format!("\"{name}\"");
        let topic = ["/ua_1_5_10", "std_msgs/String", "--latch"];
        let own = ["--node", name, "--value", value.as_str()];
        let mut publisher = cell.rospy("ros1_pub.py", &[&topic[..], &own].concat());
        publisher.wait_for_line("\"sent\"", SOON);
        Some(publisher)
    });
    let late = UadpSocket::join();
    let all = BTreeSet::from(["left", "right", "base"].map(str::to_owned));
    eventually("all three are repeated", SOON, || {
        (repeated(&late) == all).then_some(())
    });
    drop(publishers[1].take());
    let rest = BTreeSet::from(["left", "base"].map(str::to_owned));
    eventually("the one that left is not", SOON, || {
        (repeated(&late) == rest).then_some(())
    });
}

#[test]
fn a_late_reader_of_the_space_gets_the_value_of_each_transient_local_writer_also_beside_a_volatile_one()
 {
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let _ros2 = cell.bridge_ros2(&[]);
    let write = |text: &str, durability: &str| {
        let what = ["pub", "/ua_2_5_10", "std_msgs/String", "--text", text];
        let kept = ["--count", "1", "--depth", "1", "--durability", durability];
        cell.cyclone_c(&[&what[..], &kept, &["--wait-readers", "1"]].concat())
    };
    let mut writers = ["left", "right", "base"].map(|text| Some(write(text, "transient_local")));
    let late = UadpSocket::join();
    let all = BTreeSet::from(["left", "right", "base"].map(str::to_owned));
    eventually("all three are repeated", SOON, || {
        (repeated(&late) == all).then_some(())
    });
    // A value that is not latched is an event, and is not repeated together with states.
    let volatile = write("passing", "volatile");
    eventually("the volatile one is heard", SOON, || {
        repeated(&late).contains("passing").then_some(())
    });
    let _another = write("another", "transient_local");
    let four = &all | &BTreeSet::from(["another".to_owned()]);
    eventually("all four states are repeated", SOON, || {
        (repeated(&late) == four).then_some(())
    });
    drop(volatile);
    drop(writers[1].take());
    eventually("the one that left is not", SOON, || {
        let now = repeated(&late);
        (now.contains("left") && now.contains("base") && !now.contains("right")).then_some(())
    });
}

/// Encodes a std_msgs/String of space 2 with the timestamp `stamp` as a key frame.
fn key_frame(sequence: u16, stamp: i128, text: &str) -> Vec<u8> {
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let stamp = Timestamp::from_unix_nanos(stamp);
    let frame = DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(stamp.time),
        picoseconds: Some(stamp.picoseconds),
        ..DataSetHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[10])).unwrap();
    let mut fields = message.key_frame(&frame).unwrap();
    fields.scalar(Scalar::String(Some(text))).unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    datagram
}

#[test]
fn a_late_ros_1_subscriber_gets_each_value_the_space_repeats_and_an_update_replaces_one() {
    const FIRST: i128 = 1_700_000_000_000_000_000;
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _ros1 = cell.bridge_ros1(&[]);
    let mut early = cell.rospy("ros1_sub.py", &["/ua_2_5_10", "std_msgs/String"]);
    let group = UadpSocket::join();
    let values = Arc::new(Mutex::new(vec![
        (FIRST, "left"),
        (FIRST + 1, "right"),
        (FIRST + 2, "base"),
    ]));
    let ends = Arc::new(AtomicBool::new(false));
    let (told, asked) = (Arc::clone(&values), Arc::clone(&ends));
    let writer = std::thread::spawn(move || {
        let mut sequence = 0_u16;
        while !asked.load(Ordering::Relaxed) {
            for (stamp, text) in told.lock().unwrap().iter() {
                group.send(&key_frame(sequence, *stamp, text));
                sequence = sequence.wrapping_add(1);
            }
            // The key frame period.
            std::thread::sleep(Duration::from_millis(200));
        }
    });
    early.wait_for_line("base", SOON);
    let late = |name: &str, last: &str| {
        let mut late = cell.rospy(
            "ros1_sub.py",
            &["/ua_2_5_10", "std_msgs/String", "--node", name],
        );
        late.wait_for_line(last, SOON);
        let lines = late.json_lines();
        let heard = lines.iter().filter_map(|line| line.get("value"));
        heard
            .map(|value| value["data"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    eventually(
        "a late subscriber gets all three, oldest first",
        SOON,
        || (late("late", "base") == ["left", "right", "base"]).then_some(()),
    );
    values.lock().unwrap()[0] = (FIRST + 3, "left anew");
    eventually(
        "the update is there and what it replaced is not",
        SOON,
        || (late("later", "left anew") == ["right", "base", "left anew"]).then_some(()),
    );
    ends.store(true, Ordering::Relaxed);
    writer.join().unwrap();
    let of_right = early.json_lines();
    let of_right = of_right.iter().filter(|line| {
        line.get("value")
            .is_some_and(|value| value["data"] == "right")
    });
    assert_eq!(of_right.count(), 1, "a repetition is not a new message");
}
