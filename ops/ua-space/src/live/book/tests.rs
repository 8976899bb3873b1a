use uadp::discovery::{
    ActionMetaData as ActionMeta, ActionTargetDataType, ApplicationDescription,
    ConfigurationVersion, DataSetMetaDataType, FieldMetaData, KeyValuePair, WireArray,
};
use uadp::{
    BuiltinType, ChunkEncoder, DataSetHeader, GroupHeader, LocalizedText, NetworkMessageEncoder,
    QualifiedName, Scalar, Sealer, SecurityHeader, SecurityMode, SecurityPolicy, StatusCode,
    TokenKeys, Variant,
};

use super::*;

const NOW: Duration = Duration::from_secs(1);

fn from(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn value((space, namespace, writer_id): (u16, u16, u16), value: Scalar<'_>) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(namespace),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut datagram, &network, Some(&[writer_id])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(value).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    datagram
}

fn field(name: &str) -> FieldMetaData<'_> {
    FieldMetaData {
        name: Some(name),
        built_in_type: BuiltinType::String.id(),
        value_rank: -1,
        ..FieldMetaData::default()
    }
}

fn meta_data<'a>(name: &'a str, fields: &'a [FieldMetaData<'a>]) -> DataSetMetaDataType<'a> {
    DataSetMetaDataType {
        name: Some(name),
        description: LocalizedText {
            locale: None,
            text: Some("ua_msgs/SkillState; GraspSkillType nsu=urn:ua-bridge:skills"),
        },
        fields: WireArray::new(fields),
        configuration_version: ConfigurationVersion { major: 1, minor: 1 },
        ..DataSetMetaDataType::default()
    }
}

fn announcement(announced: AnnouncedContent<'_>) -> Vec<u8> {
    let announcement = Announcement {
        sequence_number: 1,
        announced,
    };
    let mut datagram = Vec::new();
    announcement
        .encode(PublisherId::UInt16(0), SecurityHeader::NONE, &mut datagram)
        .unwrap();
    datagram
}

fn describes(writer_id: u16, name: &str, status: StatusCode) -> Vec<u8> {
    announcement(AnnouncedContent::DataSetMetaData {
        writer_id,
        meta_data: meta_data(name, &[field("state")]),
        status,
    })
}

fn take(book: &mut Book, datagram: &[u8], port: u16) {
    match NetworkMessage::decode(datagram) {
        Ok(message) => book.handle((&message, from(port)), NOW, &mut |_| {}),
        Err(_) => book.malformed(),
    }
}

fn name(book: &Book, of: &str) -> Option<String> {
    Some(book.described(topic(of))?.name.clone())
}

#[test]
fn components_with_equal_writers_are_told_apart() {
    let mut book = Book::new();
    for (namespace, port) in [(7, 1), (8, 2)] {
        take(
            &mut book,
            &value((0, namespace, 101), Scalar::Byte(1)),
            port,
        );
    }
    take(
        &mut book,
        &describes(101, "ua_0_7_101 gripper.Grasp.State", StatusCode::GOOD),
        1,
    );
    assert_eq!(
        name(&book, "ua_0_7_101").as_deref(),
        Some("gripper.Grasp.State")
    );
    assert_eq!(name(&book, "ua_0_8_101"), None);
    take(
        &mut book,
        &describes(101, "ua_0_8_101 robot.Move.State", StatusCode::GOOD),
        2,
    );
    assert_eq!(
        name(&book, "ua_0_8_101").as_deref(),
        Some("robot.Move.State")
    );
    assert_eq!(
        name(&book, "ua_0_7_101").as_deref(),
        Some("gripper.Grasp.State")
    );
}

#[test]
fn only_who_sends_the_values_says_what_they_are() {
    let mut book = Book::new();
    take(&mut book, &value((0, 7, 101), Scalar::Byte(1)), 1);
    take(
        &mut book,
        &describes(101, "ua_0_7_101 forged", StatusCode::GOOD),
        66,
    );
    assert_eq!(name(&book, "ua_0_7_101"), None);
    take(
        &mut book,
        &describes(102, "ua_0_7_101 gripper", StatusCode::GOOD),
        1,
    );
    take(&mut book, &describes(101, "gripper", StatusCode::GOOD), 1);
    assert_eq!(
        name(&book, "ua_0_7_101"),
        None,
        "of another topic, or of none"
    );
    assert_eq!(book.dropped().collect::<Vec<_>>(), [(Drop::Useless, 2)]);
}

#[test]
fn a_space_without_values_is_known_by_its_application() {
    let mut book = Book::new();
    let announcement = Announcement {
        sequence_number: 1,
        announced: AnnouncedContent::ApplicationDescription {
            description: ApplicationDescription {
                application_uri: Some("urn:example:bridge"),
                ..ApplicationDescription::default()
            },
            capabilities: WireArray::null(),
        },
    };
    let mut datagram = Vec::new();
    announcement
        .encode(PublisherId::UInt16(2), SecurityHeader::NONE, &mut datagram)
        .unwrap();
    take(&mut book, &datagram, 1);
    assert_eq!(book.spaces(), BTreeSet::from([2]));
}

#[test]
fn what_is_withdrawn_is_forgotten() {
    let mut book = Book::new();
    take(&mut book, &value((0, 7, 101), Scalar::Byte(1)), 1);
    take(
        &mut book,
        &describes(101, "ua_0_7_101 gripper", StatusCode::GOOD),
        1,
    );
    let bad = StatusCode(0x803E_0000);
    take(&mut book, &describes(101, "ua_0_7_101", bad), 2);
    assert_eq!(
        name(&book, "ua_0_7_101").as_deref(),
        Some("gripper"),
        "not by others"
    );
    take(&mut book, &describes(101, "ua_0_7_101", bad), 1);
    assert_eq!(name(&book, "ua_0_7_101"), None);
    assert_eq!(book.weight, 0);
}

#[test]
fn a_call_is_known_by_its_name_with_what_may_be_left_out_of_it() {
    let optional = [KeyValuePair {
        key: QualifiedName {
            namespace: 0,
            name: Some("Optional"),
        },
        value: Variant::Scalar(Scalar::Boolean(true)),
    }];
    let fields = [
        field("Place"),
        FieldMetaData {
            properties: WireArray::new(&optional),
            ..field("Force")
        },
    ];
    let target = ActionTargetDataType {
        action_target_id: 1,
        ..ActionTargetDataType::default()
    };
    let datagram = announcement(AnnouncedContent::ActionMetaData(ActionMeta {
        writer_id: 105,
        action_targets: WireArray::new(&[target]),
        request: meta_data("ua_0_7_105 gripper.Grasp.Start", &fields),
        response: meta_data("ua_0_7_105 gripper.Grasp.Start", &[field("message")]),
        action_methods: WireArray::null(),
    }));
    let mut book = Book::new();
    let mut heard = Vec::new();
    for port in [1, 1, 2] {
        let message = NetworkMessage::decode(&datagram).unwrap();
        book.handle((&message, from(port)), NOW, &mut |news| {
            if let DatagramContent::Announced {
                topic,
                kind,
                described,
                ..
            } = news
            {
                heard.push((topic, kind, described.summary()));
            }
        });
    }
    let summary = "(Place: String, [Force: String]) -> (message: String)".to_owned();
    let wanted = (topic("ua_0_7_105"), NameKind::Call, summary);
    assert_eq!(heard, [wanted.clone(), wanted], "once from each");
    assert_eq!(
        (book.calls().count(), book.announcers(topic("ua_0_7_105"))),
        (1, 2)
    );
}

#[test]
fn a_description_in_chunks_is_put_together_for_each_sender() {
    let long = "x".repeat(600);
    let fields = [field(&long), field("state")];
    let body = |name: &str| {
        let announcement = Announcement {
            sequence_number: 1,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id: 101,
                meta_data: meta_data(name, &fields),
                status: StatusCode::GOOD,
            },
        };
        let mut body = Vec::new();
        announcement.encode_body(&mut body).unwrap();
        body
    };
    let chunks = |name: &str| {
        let body = body(name);
        let whole = uadp::Whole {
            message_type: NetworkMessageType::Announcement,
            writer_id: None,
            message_sequence_number: 1,
            bytes: &body,
        };
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(0)),
            ..NetworkHeader::default()
        };
        let budget = uadp::ChunkBudget {
            network_message: 400,
            trailer: 0,
        };
        let extras = uadp::Extras::default();
        let mut chunks = ChunkEncoder::new(&network, &extras, whole, budget).unwrap();
        let (mut datagrams, mut buffer) = (Vec::new(), Vec::new());
        while let Some(chunk) = chunks.append(&mut buffer, &extras) {
            datagrams.push(buffer.split_off(chunk.unwrap().start));
        }
        datagrams
    };
    let mut book = Book::new();
    for (namespace, port) in [(7, 1), (8, 2)] {
        take(
            &mut book,
            &value((0, namespace, 101), Scalar::Byte(1)),
            port,
        );
    }
    let (one, two) = (chunks("ua_0_7_101 gripper"), chunks("ua_0_8_101 robot"));
    assert!(one.len() > 1);
    for (one, two) in one.iter().zip(&two) {
        take(&mut book, one, 1);
        take(&mut book, two, 2);
    }
    assert_eq!(name(&book, "ua_0_7_101").as_deref(), Some("gripper"));
    assert_eq!(name(&book, "ua_0_8_101").as_deref(), Some("robot"));
}

#[test]
fn a_flood_fills_no_more_than_there_is_room_for_and_is_counted() {
    let mut book = Book::new();
    take(&mut book, &value((2, 7, 10), Scalar::Byte(1)), 1);
    for garbage in [&b""[..], b"\x00", b"GET / HTTP/1.1\r\n", &[0xff; 64]] {
        take(&mut book, garbage, 9);
    }
    for id in 1..=u16::try_from(MOST_TOPICS).unwrap() + 9 {
        take(&mut book, &value((3, 1, id), Scalar::Byte(1)), id);
    }
    take(&mut book, &value((300, 1, 1), Scalar::Byte(1)), 9);
    assert_eq!(book.topics().count(), MOST_TOPICS);
    let dropped: BTreeMap<Drop, u64> = book.dropped().collect();
    assert_eq!(dropped[&Drop::Topics], 10);
    assert_eq!(dropped[&Drop::NotInSpace], 1);
    assert_eq!(dropped[&Drop::Malformed], 4);
    take(&mut book, &value((2, 7, 10), Scalar::Byte(2)), 1);
    assert_eq!(book.heard(topic("ua_2_7_10")).unwrap().values, 2);
}

#[test]
fn a_secured_announcement_without_keys_is_no_malformed_message() {
    let policy = SecurityPolicy::PubSubAes256Ctr;
    let keys = TokenKeys::from_bytes(policy, &vec![7; policy.key_data_length()]).unwrap();
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(1, [keys]).unwrap();
    let seal = sealer.seal([1, 2, 3, 4]).unwrap();
    let mut sealed = Vec::new();
    let plain = describes(101, "ua_0_7_101 gripper", StatusCode::GOOD);
    seal.secure(&plain, &mut sealed).unwrap();
    let mut book = Book::new();
    take(&mut book, &sealed, 1);
    assert_eq!(book.dropped().collect::<Vec<_>>(), [(Drop::Secured, 1)]);
}
