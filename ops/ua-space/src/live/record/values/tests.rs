use std::net::SocketAddr;
use std::path::PathBuf;

use uadp::discovery::{AnnouncedContent, DataSetMetaDataType, FieldMetaData, WireArray};
use uadp::{
    BuiltinType, DataSetHeader, DataValue, GroupHeader, LocalizedText, PublisherId, Scalar,
    SecurityHeader, StatusCode, Timestamp, Variant,
};

use super::*;
use crate::live::book::{Book, DatagramContent, NameKind};
use crate::recorded::{RecordingReader, UnusableValue};

/// The time of arrival of the values.
const ARRIVED: i128 = 1_700_000_000_123_456_789;

/// Returns the announcement of a topic of space 2 with these fields.
fn announced(topic: &str, kind: &str, fields: &[(&str, BuiltinType, i32)]) -> Vec<u8> {
    let id: TopicId = topic.parse().unwrap();
    let (space, _, writer_id) = id.triple();
    let fields = fields.iter().map(|(name, builtin, rank)| FieldMetaData {
        name: Some(name),
        built_in_type: builtin.id(),
        value_rank: *rank,
        ..FieldMetaData::default()
    });
    let fields: Vec<_> = fields.collect();
    let name = format!("{topic} Robot.Value");
    let announcement = Announcement {
        sequence_number: 1,
        announced: AnnouncedContent::DataSetMetaData {
            writer_id,
            meta_data: DataSetMetaDataType {
                name: Some(&name),
                description: LocalizedText {
                    locale: None,
                    text: Some(kind),
                },
                fields: WireArray::new(&fields),
                ..DataSetMetaDataType::default()
            },
            status: StatusCode::GOOD,
        },
    };
    let mut datagram = Vec::new();
    let publisher = PublisherId::UInt16(space);
    announcement
        .encode(publisher, SecurityHeader::NONE, &mut datagram)
        .unwrap();
    datagram
}

/// Returns a value of a topic, with the given fields.
fn value(
    topic: &str,
    number: u16,
    write: &dyn Fn(&DataSetHeader, &mut NetworkMessageEncoder<'_>),
) -> Vec<u8> {
    let id: TopicId = topic.parse().unwrap();
    let (space, namespace, writer_id) = id.triple();
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(namespace),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let taken = Timestamp::from_unix_nanos(ARRIVED - 1_000_007);
    let header = DataSetHeader {
        sequence_number: Some(number),
        timestamp: Some(taken.time),
        picoseconds: Some(taken.picoseconds),
        ..DataSetHeader::default()
    };
    let ids = [writer_id];
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(&ids)).unwrap();
    write(&header, &mut message);
    message.finish().unwrap();
    datagram
}

/// Writes the fields of a key frame.
fn key_frame(scalars: &[Scalar<'_>]) -> impl Fn(&DataSetHeader, &mut NetworkMessageEncoder<'_>) {
    move |header, message| {
        let mut frame = message.key_frame(header).unwrap();
        for value in scalars {
            frame.scalar(*value).unwrap();
        }
        frame.finish().unwrap();
    }
}

/// Records the datagrams as MCAP, and reads the recording.
fn again(name: &str, datagrams: &[Vec<u8>]) -> (Vec<Vec<u8>>, BTreeMap<UnusableValue, u64>) {
    again_with(name, datagrams, None)
}

/// Records the model of a robot too.
fn again_with(
    name: &str,
    datagrams: &[Vec<u8>],
    model: Option<&RobotModelMessage>,
) -> (Vec<Vec<u8>>, BTreeMap<UnusableValue, u64>) {
    let file = format!("{name}-{}.mcap", std::process::id());
    let file: PathBuf = std::env::temp_dir().join(file);
    let _before = std::fs::remove_file(&file);
    let mut values = ValueRecorder::new(RecordingFile::create(&file).unwrap());
    if let Some(model) = model {
        values.add_model(model, ARRIVED);
    }
    let mut book = Book::new();
    let from: SocketAddr = "127.0.0.1:5000".parse().unwrap();
    let now = Duration::from_secs(1);
    for datagram in datagrams {
        let message = NetworkMessage::decode(datagram).unwrap();
        book.handle((&message, from), now, &mut |news| match news {
            DatagramContent::Sample(sample) => {
                assert_ne!(
                    values.add(&sample, (now, ARRIVED)).unwrap(),
                    RecordOutcome::Dropped
                )
            }
            DatagramContent::Announced {
                topic,
                kind: NameKind::Value,
                described,
                announcement,
                ..
            } => values.described((topic, announcement), described, now),
            DatagramContent::Announced { .. } | DatagramContent::Response(..) => {}
        });
    }
    values.finish().unwrap();
    let mut recorded = RecordingReader::open(&file).unwrap();
    let mut all = Vec::new();
    while let Some(datagram) = recorded.next().unwrap() {
        assert_eq!(datagram.time, ARRIVED);
        all.push(datagram.bytes);
    }
    std::fs::remove_file(file).unwrap();
    (all, recorded.unusable())
}

#[test]
fn ros_messages_bytes_and_other_values_are_the_same_messages_again() {
    let double = BuiltinType::Double;
    let point = [("x", double, -1), ("y", double, -1), ("z", double, -1)];
    let mixed = [
        ("count", BuiltinType::UInt64, -1),
        ("text", BuiltinType::String, -1),
        ("names", BuiltinType::String, 1),
    ];
    let names = [Scalar::String(Some("a")), Scalar::String(Some("b"))];
    let datagrams = [
        announced("ua_2_5_10", "geometry_msgs/Point", &point),
        value(
            "ua_2_5_10",
            7,
            &key_frame(&[1.0, 2.0, f64::NAN].map(Scalar::Double)),
        ),
        announced(
            "ua_1_5_11",
            "std_msgs/String as bytes",
            &[("data", BuiltinType::ByteString, -1)],
        ),
        value(
            "ua_1_5_11",
            8,
            &key_frame(&[Scalar::ByteString(Some(&[1, 0, 0, 0, 65]))]),
        ),
        announced("ua_0_5_12", "", &mixed),
        value("ua_0_5_12", 9, &|header, message| {
            let mut frame = message.key_frame(header).unwrap();
            frame.scalar(Scalar::UInt64(u64::MAX)).unwrap();
            frame.scalar(Scalar::String(None)).unwrap();
            frame.array(BuiltinType::String, 2).unwrap();
            for name in names {
                frame.element(name).unwrap();
            }
            frame.finish().unwrap();
        }),
        value("ua_0_5_12", 10, &|header, message| {
            let mut frame = message.delta_frame(header).unwrap();
            let changed = frame.field(1).unwrap();
            changed.scalar(Scalar::String(Some("new"))).unwrap();
            frame.finish().unwrap();
        }),
        value("ua_0_5_12", 11, &|header, message| {
            let mut frame = message.data_values(header).unwrap();
            for status in [None, Some(StatusCode(0x8031_0000)), None] {
                let value = DataValue {
                    status,
                    ..DataValue::default()
                };
                frame.value(&value).unwrap();
            }
            frame.finish().unwrap();
        }),
    ];
    let (all, unusable) = again("same", &datagrams);
    assert_eq!(unusable, BTreeMap::new());
    assert_eq!(all.len(), datagrams.len());
    for (before, after) in datagrams.iter().zip(&all) {
        let [before, after] = [before, after].map(|bytes| NetworkMessage::decode(bytes).unwrap());
        assert_eq!(before.message_type(), after.message_type());
        assert_eq!(before.datagram(), after.datagram(), "{before:?}");
    }
}

#[test]
fn the_model_of_a_robot_is_left_out_as_such() {
    let datagrams = [
        announced("ua_2_5_10", "", &[("level", BuiltinType::Byte, -1)]),
        value("ua_2_5_10", 1, &key_frame(&[Scalar::Byte(1)])),
    ];
    let model = RobotModelMessage {
        topic: "/robot_description".to_owned(),
        data: vec![0, 1, 0, 0, 1, 0, 0, 0, 0],
    };
    let (all, unusable) = again_with("model", &datagrams, Some(&model));
    assert_eq!(all.len(), 2);
    assert_eq!(unusable, BTreeMap::from([(UnusableValue::Model, 1)]));
}

#[test]
fn large_values_are_sent_in_chunks_and_values_without_a_type_are_counted() {
    let text = "x".repeat(4_000);
    let datagrams = [
        announced("ua_2_5_10", "", &[("text", BuiltinType::String, -1)]),
        value("ua_2_5_10", 1, &key_frame(&[Scalar::String(Some(&text))])),
        announced("ua_2_5_11", "", &[("any", BuiltinType::Variant, -1)]),
        value("ua_2_5_11", 1, &key_frame(&[Scalar::Byte(1)])),
        value("ua_2_5_12", 1, &key_frame(&[Scalar::Byte(1)])),
    ];
    let (all, unusable) = again("large", &datagrams);
    let wanted = [(UnusableValue::Undescribed, 1), (UnusableValue::Untyped, 1)];
    assert_eq!(unusable, BTreeMap::from(wanted));
    let mut book = Book::new();
    let from: SocketAddr = "127.0.0.1:5000".parse().unwrap();
    let mut texts = Vec::new();
    for datagram in &all {
        assert!(datagram.len() <= 1472);
        let message = NetworkMessage::decode(datagram).unwrap();
        book.handle((&message, from), Duration::ZERO, &mut |news| {
            if let DatagramContent::Sample(sample) = news {
                let first = sample.message.fields().unwrap().next().unwrap().unwrap();
                texts.push(first == Variant::Scalar(Scalar::String(Some(&text))));
            }
        });
    }
    assert_eq!(texts, [true]);
}
