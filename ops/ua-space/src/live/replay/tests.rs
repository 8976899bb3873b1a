use std::net::SocketAddrV4;
use std::path::PathBuf;

use clap::Parser as _;
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, FieldMetaData, KeyValuePair, WireArray,
};
use uadp::{
    BuiltinType, ChunkBudget, ChunkEncoder, DataSetHeader, Extras, GroupHeader, LocalizedText,
    NetworkHeader, NetworkMessageEncoder, PublisherId, QualifiedName, Scalar, SecurityHeader,
    StatusCode, Variant, Whole,
};

use super::*;
use crate::arguments::{ToolArguments, Verb};
use crate::capture::{LinkLayer, PcapNg};

/// Returns a message with values of a group.
fn values(space: u16, namespace: u16, ids: &[u16]) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(namespace),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(ids)).unwrap();
    for id in ids {
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        frame.scalar(Scalar::UInt16(*id)).unwrap();
        frame.finish().unwrap();
    }
    message.finish().unwrap();
    datagram
}

/// Returns the announcement of a topic, marked as a command or not.
fn announced(space: u16, id: u16, description: &str, command: bool) -> Vec<u8> {
    let name = format!("ua_{space}_2_{id} Value{id}");
    let mark = [KeyValuePair {
        key: QualifiedName {
            namespace: 0,
            name: Some("Command"),
        },
        value: Variant::Scalar(Scalar::Boolean(command)),
    }];
    let fields = [FieldMetaData {
        name: Some("data"),
        built_in_type: BuiltinType::UInt16.id(),
        value_rank: -1,
        properties: WireArray::new(&mark),
        ..FieldMetaData::default()
    }];
    let announcement = Announcement {
        sequence_number: 1,
        announced: AnnouncedContent::DataSetMetaData {
            writer_id: id,
            meta_data: DataSetMetaDataType {
                name: Some(&name),
                description: LocalizedText {
                    locale: None,
                    text: Some(description),
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

/// Writes a recording of these messages into a temporary file.
fn recording(name: &str, messages: &[Vec<u8>]) -> PathBuf {
    let to: SocketAddrV4 = "239.192.0.40:4840".parse().unwrap();
    let mut file = Vec::new();
    let mut writer = PcapNg::begin(LinkLayer::Udp(to), "lo", &mut file);
    for (message, time) in messages.iter().zip(1_000_000_000_i128..) {
        writer.packet(time, "127.0.0.1:5000".parse().unwrap(), message, &mut file);
    }
    let path = std::env::temp_dir().join(format!("{name}-{}.pcapng", std::process::id()));
    std::fs::write(&path, file).unwrap();
    path
}

fn read(file: &std::path::Path, more: &[&str]) -> RecordingContents {
    let words = ["ua-space", "replay", file.to_str().unwrap()];
    let words = words.iter().chain(more);
    let Verb::Replay(arguments) = ToolArguments::try_parse_from(words).unwrap().verb else {
        panic!("another verb");
    };
    RecordingContents::read(&arguments, &mut None).unwrap()
}

/// Returns the DataSetWriterIds that are sent of a message, or the reason why it is left out.
fn sent(contents: &RecordingContents, datagram: &[u8]) -> Result<Vec<u16>, ReplayOmission> {
    let prepared = contents.prepare(datagram, &mut None)?;
    let Ok(message) = NetworkMessage::decode(&prepared.plain) else {
        return Ok(Vec::new());
    };
    Ok(message.writer_ids().into_iter().flatten().collect())
}

#[test]
fn commands_and_values_that_may_be_commands_are_left_out() {
    let messages = [
        announced(1, 10, "sensor_msgs/JointState", false),
        announced(1, 11, "std_msgs/Bool", true),
        announced(1, 12, "geometry_msgs/Twist", false),
        values(1, 2, &[10, 11, 12, 13]),
        values(0, 2, &[10]),
    ];
    let file = recording("commands", &messages);
    let contents = read(&file, &[]);
    let [.., of_ros, of_server] = &messages;
    assert_eq!(sent(&contents, of_ros), Ok(vec![10]));
    let prepared = contents.prepare(of_ros, &mut None).unwrap();
    let removed = BTreeMap::from([
        (ReplayOmission::Command, 2),
        (ReplayOmission::Undescribed, 1),
    ]);
    assert_eq!(prepared.removed, removed);
    assert_eq!(sent(&contents, of_server), Ok(Vec::new()));
    assert_eq!(contents.spaces(), BTreeSet::from([1]));
    assert_eq!(contents.announcements().count(), 1);
    assert_eq!(sent(&contents, &messages[1]), Err(ReplayOmission::Command));

    let all = read(&file, &["--commands"]);
    assert_eq!(sent(&all, of_ros), Ok(vec![10, 11, 12, 13]));
    assert_eq!(sent(&all, of_server), Ok(vec![10]));
    assert_eq!(all.spaces(), BTreeSet::from([0, 1]));

    let other = read(&file, &["--commands", "--space", "0"]);
    assert_eq!(sent(&other, of_ros), Err(ReplayOmission::OtherSpace));
    assert_eq!(other.spaces(), BTreeSet::from([0]));
    std::fs::remove_file(file).unwrap();
}

#[test]
fn large_calls_and_probes_are_left_out() {
    let mut probe = Vec::new();
    Probe::FindApplications
        .encode(None, SecurityHeader::NONE, &mut probe)
        .unwrap();
    // A call that is larger than a datagram is sent in chunks without a DataSetWriterId.
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        ..NetworkHeader::default()
    };
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: None,
        message_sequence_number: 1,
        bytes: &[1; 2000],
    };
    let extras = Extras::default();
    let mut chunks = ChunkEncoder::new(&network, &extras, whole, ChunkBudget::IPV4).unwrap();
    let mut chunk = Vec::new();
    chunks.append(&mut chunk, &extras).unwrap().unwrap();
    let file = recording(
        "calls",
        &[values(1, 2, &[10]), probe.clone(), chunk.clone()],
    );
    let contents = read(&file, &[]);
    assert_eq!(sent(&contents, &probe), Err(ReplayOmission::Probe));
    assert_eq!(sent(&contents, &chunk), Err(ReplayOmission::Call));
    let all = read(&file, &["--commands"]);
    assert_eq!(sent(&all, &probe), Err(ReplayOmission::Probe));
    assert_eq!(sent(&all, &chunk), Ok(Vec::new()));
    std::fs::remove_file(file).unwrap();
}

#[test]
fn a_topic_that_commanded_at_any_time_is_left_out() {
    let messages = [
        announced(1, 10, "std_msgs/Bool", false),
        announced(1, 10, "std_msgs/Bool", true),
        announced(1, 10, "std_msgs/Bool", false),
        announced(1, 11, "control_msgs/JointJog", false),
        announced(1, 12, "trajectory_msgs/MultiDOFJointTrajectory", false),
        announced(1, 13, "move_base_msgs/MoveBaseActionGoal", false),
        announced(1, 14, "move_base_msgs/MoveBaseActionResult", false),
        values(1, 2, &[10, 11, 12, 13, 14]),
    ];
    let file = recording("once", &messages);
    let contents = read(&file, &[]);
    let [.., of_ros] = &messages;
    assert_eq!(sent(&contents, of_ros), Ok(vec![14]));
    let prepared = contents.prepare(of_ros, &mut None).unwrap();
    assert_eq!(
        prepared.removed,
        BTreeMap::from([(ReplayOmission::Command, 4)])
    );
    std::fs::remove_file(file).unwrap();
}

#[test]
fn secured_topics_are_shown_as_secured_without_keys() {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let extras = Extras {
        security: Some(SecurityHeader {
            signed: true,
            ..SecurityHeader::NONE
        }),
        ..Extras::default()
    };
    let ids: [u16; 1] = [10];
    let mut sealed = Vec::new();
    let begun = NetworkMessageEncoder::with(&mut sealed, &network, Some(&ids), &extras);
    assert!(begun.is_ok());
    // Without keys nothing behind the headers is read.
    sealed.extend([0; 40]);
    let file = recording("secured", &[sealed]);
    let topic: TopicId = "ua_1_2_10".parse().unwrap();
    let cases: [(&[&str], ReplayOmission, &[u16]); 3] = [
        (&[], ReplayOmission::Secured, &[]),
        (&["--commands"], ReplayOmission::Secured, &[1]),
        (&["--space", "0"], ReplayOmission::OtherSpace, &[]),
    ];
    for (words, why, spaces) in cases {
        let contents = read(&file, words);
        let topics: Vec<_> = contents.topics().collect();
        assert_eq!(topics, [(topic, 1, Some(why))]);
        let spaces: BTreeSet<u16> = spaces.iter().copied().collect();
        assert_eq!(contents.spaces(), spaces);
    }
    std::fs::remove_file(file).unwrap();
}
