//! Messages move between ROS bytes and fields without an allocation, once the buffers were used.
#![expect(clippy::unwrap_used, reason = "test code")]

use allocation_counter::measure;
use bridge_core::{decode_fields, encode_fields};
use messages::{Dialect, NoFields, Plan, Registry, Selection, Wire};
use uadp::{DataSetHeader, Fields, NetworkHeader, NetworkMessage, NetworkMessageEncoder};

fn encode(plan: &Plan, message: &[u8], datagram: &mut Vec<u8>) {
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
            let message = Registry::bundle(dialect)
                .get(&name.parse().unwrap())
                .unwrap();
            let plan = Plan::compile(&message, &Selection::Whole, wire).unwrap();
            let nothing = Selection::Template {
                fields: Vec::new(),
                rest: [].into(),
            };
            let mut bytes = Vec::new();
            Plan::compile(&message, &nothing, wire)
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
