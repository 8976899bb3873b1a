//! Images of ten megabytes between ROS 1 and the space, in chunks.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use system_tests::{Cell, METRICS_ROS1, Peer, UadpSocket, eventually, metrics};
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, DataSetMessage, Extras, GroupHeader, NetworkHeader,
    NetworkMessage, NetworkMessageEncoder, NetworkMessageType, PublisherId, Reassembler,
    ReassemblyLimits, Scalar, Timestamp, Variant, Whole,
};

const SOON: Duration = Duration::from_secs(60);
const SIZE: usize = 10_000_000;

/// Returns the image data of `ros1_image.py`: the data of image `number` starts at `number`. Made
/// once, because a receiver that leaves its socket unread for long loses datagrams.
fn patterns() -> Vec<u8> {
    (0..=250).cycle().take(SIZE + 251).collect()
}

/// The mapping of the cell's camera; its images are queued, so none is replaced by a newer image.
const CAMERA: &str = r#"
spaces: [{id: 1}]
namespaces: {5: "urn:cell"}
variables:
  - node: ns=5;i=10
    name: Camera
    origin: 1
    queue: {drop_oldest: 50}
    ros: {topic: /camera, type: sensor_msgs/Image, as: bytes}
  - node: ns=5;i=11
    name: Button
    origin: 1
    queue: {drop_oldest: 500}
    ros: {topic: /button, type: std_msgs/String}
"#;

/// Returns the number of an image and its data, from the end of the ROS message.
fn image<'a>(message: &DataSetMessage<'a>) -> (u32, &'a [u8]) {
    let fields: Vec<_> = message.fields().unwrap().map(Result::unwrap).collect();
    let [Variant::Scalar(Scalar::ByteString(Some(bytes)))] = fields[..] else {
        panic!("no image: {} fields", fields.len());
    };
    let data = &bytes[bytes.len() - SIZE..];
    (u32::from(data[0]), data)
}

#[test]
fn images_of_ten_megabytes_leave_ros_1_as_they_were_and_a_button_beside_them_loses_nothing() {
    const IMAGES: u32 = 20;
    const PRESSES: u32 = 200;
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let mapping = cell.file("camera.yaml", CAMERA);
    let _bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let patterns = patterns();
    let presses = PRESSES.to_string();
    let button = ["/button", "std_msgs/String", "--numbered", &presses];
    let paced = ["--rate", "50", "--wait-subscribers", "1"];
    let _button = cell.rospy("ros1_pub.py", &[&button[..], &paced].concat());
    // Started last, because it publishes at once: the images sent before the test listens are
    // larger than a socket's buffer.
    let count = IMAGES.to_string();
    let _camera = cell.rospy("ros1_image.py", &["pub", "/camera", "--count", &count]);
    let mut reassembler = Reassembler::new(ReassemblyLimits {
        pieces: 1000,
        ..ReassemblyLimits::default()
    });
    let (mut images, mut pressed) = (BTreeSet::new(), BTreeSet::new());
    let start = Instant::now();
    while images.len() < IMAGES as usize || pressed.len() < PRESSES as usize {
        assert!(
            start.elapsed() < SOON,
            "{} images and {} presses came; {:?}; {:?}",
            images.len(),
            pressed.len(),
            reassembler.counters(),
            metrics(METRICS_ROS1)
        );
        let Some(datagram) = group.receive(Duration::from_millis(100)) else {
            continue;
        };
        let message = NetworkMessage::decode(&datagram).unwrap();
        if message.message_type() != NetworkMessageType::DataSet {
            continue;
        }
        if message.is_chunk() {
            let whole = reassembler.receive(&message, start.elapsed()).unwrap();
            if let Some(whole) = whole {
                let message = whole.data_set_message().unwrap();
                let (number, data) = image(&message);
                let right = &patterns[number as usize..][..SIZE];
                assert!(data == right, "image {number} has other bytes");
                images.insert(number);
            }
            continue;
        }
        for message in message.messages().map(Result::unwrap) {
            // Keep-alives have no fields.
            let field = message.fields().ok().and_then(|mut fields| fields.next());
            if let Some(Ok(Variant::Scalar(Scalar::String(Some(text))))) = field {
                pressed.insert(text.parse::<u32>().unwrap());
            }
        }
    }
    assert!(images.into_iter().eq(0..IMAGES));
    assert!(pressed.into_iter().eq(0..PRESSES));
}

/// Sends an image of space 2 in the chunks that a writer makes of it.
fn send_image(group: &UadpSocket, data: &[u8], sequence: u16) {
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .unwrap();
    let stamp = Timestamp::from_unix_nanos(i128::try_from(now.as_nanos()).unwrap());
    let mut encoded = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut encoded, &NetworkHeader::default(), None).unwrap();
    let header = DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(stamp.time),
        picoseconds: Some(stamp.picoseconds),
        ..DataSetHeader::default()
    };
    let number = u32::from(sequence);
    let mut fields = message.key_frame(&header).unwrap();
    for field in [
        Scalar::DateTime(stamp.time),
        Scalar::String(Some("camera")),
        Scalar::UInt32(number),
        Scalar::UInt32(1),
        Scalar::String(Some("mono8")),
        Scalar::Byte(0),
        Scalar::UInt32(1),
        Scalar::ByteString(Some(data)),
    ] {
        fields.scalar(field).unwrap();
    }
    fields.finish().unwrap();
    message.finish().unwrap();
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(10),
        message_sequence_number: sequence,
        bytes: &encoded[1..],
    };
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let budget = ChunkBudget {
        network_message: 65_507,
        trailer: 0,
    };
    let extras = Extras::default();
    let mut chunks = ChunkEncoder::new(&header, &extras, whole, budget).unwrap();
    let mut datagram = Vec::new();
    while let Some(written) = chunks.append(&mut datagram, &extras) {
        written.unwrap();
        group.send(&datagram);
        datagram.clear();
        // Paced like a sender, because a socket buffer is smaller than an image.
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn images_of_ten_megabytes_from_the_space_reach_a_rospy_subscriber_as_they_were() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let _bridge = cell.bridge_ros1(&[]);
    let subscriber = cell.rospy("ros1_image.py", &["sub", "/ua_2_5_10"]);
    let patterns = patterns();
    let mut sequence = 0;
    eventually("five images came as they were", SOON, || {
        let number = usize::from(sequence) % 251;
        send_image(&group, &patterns[number..][..SIZE], sequence);
        sequence += 1;
        let heard = subscriber.json_lines();
        let heard: Vec<_> = heard
            .iter()
            .filter(|line| line.get("number").is_some())
            .collect();
        assert!(heard.iter().all(|line| line["right"] == true), "{heard:?}");
        (heard.len() >= 5).then_some(())
    });
}
