//! Messages that are carried as bytes, between spaces of the same ROS version and of different
//! versions.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bridge_core::{Local, LocalMessage, Now, Output, Reason, Router, RouterSettings, Verdict};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, MessageType, Selection, TypeRegistry};
use uadp::Timestamp;

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn now() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

/// Creates a bridge: ROS 1 for space 1, ROS 2 for other spaces.
fn bridge(space: u16) -> (Router, TypeRegistry) {
    let (local, dialect) = match space {
        1 => (Local::Ros1, Dialect::Ros1),
        _ => (Local::Cdr, Dialect::Ros2),
    };
    let settings = RouterSettings {
        own: SpaceId::new(space).unwrap(),
        local,
        source: None,
    };
    let router = Router::new(settings, Arc::new(Mapping::default()));
    (router, TypeRegistry::bundle(dialect))
}

/// Returns the message that a bridge of space `to` publishes when a bridge of space `from` receives
/// `message`. Both bind the topic `as: bytes`.
fn cross(
    (from, to): (u16, u16),
    types: impl Fn(&mut TypeRegistry) -> Arc<MessageType>,
    message: &[u8],
) -> Result<Vec<u8>, (Reason, String)> {
    let topic: TopicId = format!("ua_{from}_5_10").parse().unwrap();
    let now = now();
    let [mut sender, mut reader] = [from, to].map(|space| {
        let (mut router, mut registry) = bridge(space);
        let message_type = types(&mut registry);
        router
            .bind(topic, &message_type, &Selection::Bytes, now)
            .unwrap();
        router
    });
    let heard = LocalMessage {
        topic,
        payload: message,
        received: now.utc,
        latched_by: None,
    };
    assert_eq!(sender.handle_local(heard, now), Verdict::Forward);
    while let Some(output) = sender.poll_output(now) {
        if let Output::Datagram { bytes, .. } = output {
            reader.handle_datagram(&bytes, PEER, now);
        }
    }
    let output = std::iter::from_fn(|| reader.poll_output(now)).find_map(|output| match output {
        Output::Delivery(delivery) => Some(Ok(delivery.payload)),
        Output::Notice(notice) => Some(Err((notice.reason, notice.detail))),
        _ => None,
    });
    output.unwrap()
}

fn of(name: &'static str) -> impl Fn(&mut TypeRegistry) -> Arc<MessageType> {
    move |registry| registry.get(&name.parse().unwrap()).unwrap()
}

const PEER: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_001);
const ROS_1: &[u8] = &[2, 0, 0, 0, b'h', b'i'];
const ROS_2: &[u8] = &[0, 1, 0, 0, 3, 0, 0, 0, b'h', b'i', 0, 0];

#[test]
fn between_spaces_of_one_ros_the_message_stays_as_it_is_whatever_is_in_it() {
    let anything = [0, 1, 0, 0, 0xff, 0xff, 0xff];
    let crossed = cross((2, 3), of("std_msgs/String"), &anything);
    assert_eq!(crossed, Ok(anything.to_vec()));
}

#[test]
fn between_both_kinds_of_ros_it_is_written_anew() {
    let crossed = cross((1, 2), of("std_msgs/String"), ROS_1);
    assert_eq!(crossed, Ok(ROS_2.to_vec()));
    let crossed = cross((2, 1), of("std_msgs/String"), ROS_2);
    assert_eq!(crossed, Ok(ROS_1.to_vec()));
}

#[test]
fn an_image_with_its_header_crosses_both_ways() {
    // seq 0, the null time, frame "cam", 1 x 2, "mono8", little endian, step 2, two pixels.
    let mut ros_1 = vec![0; 12];
    ros_1.extend(b"\x03\0\0\0cam\x01\0\0\0\x02\0\0\0\x05\0\0\0mono8\0\x02\0\0\0\x02\0\0\0\x07\x09");
    let ros_2 = cross((1, 2), of("sensor_msgs/Image"), &ros_1).unwrap();
    let back = cross((2, 1), of("sensor_msgs/Image"), &ros_2);
    assert_eq!(back, Ok(ros_1));
}

#[test]
fn bytes_that_are_no_such_message_are_counted_as_malformed() {
    let (reason, _) = cross((1, 2), of("std_msgs/String"), &[9, 0, 0, 0]).unwrap_err();
    assert_eq!(reason, Reason::Malformed);
}

#[test]
fn a_type_the_other_ros_is_not_known_to_have_is_a_mismatch_that_names_both_sides() {
    let own = |registry: &mut TypeRegistry| {
        let name = "my_robot_msgs/Part".parse().unwrap();
        registry.add(&name, "int32 number\n").unwrap();
        registry.get(&name).unwrap()
    };
    let (reason, detail) = cross((1, 2), own, &[7, 0, 0, 0]).unwrap_err();
    assert_eq!(reason, Reason::Mismatch);
    for part in ["ROS 1", "ROS 2", "my_robot_msgs/Part"] {
        assert!(detail.contains(part), "{detail}");
    }
}
