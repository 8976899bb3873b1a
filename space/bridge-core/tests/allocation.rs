//! Messages are converted between ROS bytes and fields without an allocation after the first use of
//! the buffers.
use std::sync::Arc;
use std::time::Instant;

use allocation_counter::measure;
use bridge_core::{Local, Now, Output, Router, RouterSettings, decode_fields, encode_fields};
use mappings::{Mapping, SpaceId};
use messages::{Dialect, MessagePlan, NoFields, Selection, TypeRegistry, Wire};
use uadp::{
    DataSetHeader, Fields, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    PublisherId, Scalar, Timestamp,
};

fn encode(plan: &MessagePlan, message: &[u8], datagram: &mut Vec<u8>) {
    datagram.clear();
    let network = NetworkHeader::default();
    let mut encoder = NetworkMessageEncoder::new(datagram, &network, Some(&[1])).unwrap();
    let mut frame = encoder.key_frame(&DataSetHeader::default()).unwrap();
    encode_fields(plan, message, 2, &mut frame).unwrap();
    frame.finish().unwrap();
    encoder.finish().unwrap();
}

fn fields(datagram: &[u8]) -> Fields<'_> {
    let network = NetworkMessage::decode(datagram).unwrap();
    let message = network.messages().next().unwrap().unwrap();
    message.fields().unwrap()
}

#[test]
fn messages_move_both_ways_without_an_allocation() {
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        for name in [
            "std_msgs/Bool",
            "geometry_msgs/Twist",
            "geometry_msgs/PoseWithCovarianceStamped",
            "nav_msgs/Odometry",
            "sensor_msgs/JointState",
            "sensor_msgs/LaserScan",
            "sensor_msgs/PointCloud2",
        ] {
            let message = TypeRegistry::bundle(dialect)
                .get(&name.parse().unwrap())
                .unwrap();
            let plan = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
            let nothing = Selection::Template {
                fields: Vec::new(),
                rest: [].into(),
            };
            let mut bytes = Vec::new();
            MessagePlan::compile(&message, &nothing, wire)
                .unwrap()
                .write(&mut NoFields, &mut bytes)
                .unwrap();
            let (mut datagram, mut back) = (Vec::new(), Vec::new());
            let mut once = || {
                encode(&plan, &bytes, &mut datagram);
                back.clear();
                decode_fields(&plan, fields(&datagram), &mut back).unwrap();
            };
            once();
            let counted = measure(once);
            assert_eq!(counted.count_total, 0, "{name} {wire:?}");
            assert_eq!(back, bytes, "{name} {wire:?}");
        }
    }
}

#[test]
#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn a_key_frame_of_another_space_is_handed_on_without_an_allocation() {
    let settings = RouterSettings {
        own: SpaceId::new(1).unwrap(),
        local: Local::Ros1,
        source: None,
    };
    let mut router = Router::new(settings, Arc::new(Mapping::default()));
    let now = Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    };
    let message = TypeRegistry::bundle(Dialect::Ros1)
        .get(&"geometry_msgs/Twist".parse().unwrap())
        .unwrap();
    let topic = "ua_2_5_10".parse().unwrap();
    router
        .bind(topic, &message, &Selection::Whole, now)
        .unwrap();
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let datagrams: Vec<Vec<u8>> = (0..20)
        .map(|sequence| {
            let mut datagram = Vec::new();
            let mut message =
                NetworkMessageEncoder::new(&mut datagram, &header, Some(&[10])).unwrap();
            let header = DataSetHeader {
                sequence_number: Some(sequence),
                ..DataSetHeader::default()
            };
            let mut frame = message.key_frame(&header).unwrap();
            for _ in 0..6 {
                frame.scalar(Scalar::Double(f64::from(sequence))).unwrap();
            }
            frame.finish().unwrap();
            message.finish().unwrap();
            datagram
        })
        .collect();
    let mut delivered = 0;
    let mut hear = |datagram: &[u8]| {
        router.handle_datagram(datagram, ([127, 0, 0, 1], 50_001).into(), now);
        while let Some(output) = router.poll_output(now) {
            if let Output::Delivery(delivery) = output {
                router.published(delivery.topic, delivery.arrived, now);
                router.recycle(delivery.payload);
                delivered += 1;
            }
        }
    };
    let (first, rest) = datagrams.split_at(10);
    first.iter().for_each(|datagram| hear(datagram));
    let counted = measure(|| rest.iter().for_each(|datagram| hear(datagram)));
    assert_eq!((counted.count_total, delivered), (0, 20));
}
