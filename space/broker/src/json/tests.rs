//! Tests of the JSON mapping: own messages are read as they were written, in every form, and
//! messages of other stacks in every layout.

use serde_json::json;
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, FieldMetaData, WireArray,
};
use uadp::{
    BuiltinType, DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId,
    Scalar, SecurityHeader,
};

use super::*;
use crate::topics::{Address, TopicMessageType};

const TOPIC: Address = Address {
    kind: TopicMessageType::Data,
    publisher: 1,
    group: Some(2),
    writer: Some(10),
};

const FORMS: [MessageMapping; 4] = [
    MessageMapping::JsonVerbose,
    MessageMapping::JsonCompact,
    MessageMapping::JsonReversible,
    MessageMapping::JsonNonReversible,
];

fn now() -> Timestamp {
    Timestamp::from_unix_nanos(1_700_000_000_123_456_700)
}

/// Returns an announcement of the fields of [`value`].
fn announcement() -> Vec<u8> {
    announcement_with(|_| false)
}

/// Returns the announcement, with the fields that are promoted.
fn announcement_with(promoted: impl Fn(&str) -> bool) -> Vec<u8> {
    let field = |name, builtin: BuiltinType, value_rank| FieldMetaData {
        name: Some(name),
        field_flags: promoted(name).into(),
        built_in_type: builtin.id(),
        value_rank,
        ..FieldMetaData::default()
    };
    let fields = [
        field("zone", BuiltinType::Double, -1),
        field("count", BuiltinType::Int64, -1),
        field("axes", BuiltinType::Float, 1),
        field("label", BuiltinType::String, -1),
        field("blob", BuiltinType::ByteString, -1),
    ];
    let announcement = Announcement {
        sequence_number: 1,
        announced: AnnouncedContent::DataSetMetaData {
            writer_id: 10,
            meta_data: DataSetMetaDataType {
                name: Some("ua_1_2_10 arm"),
                fields: WireArray::new(&fields),
                ..DataSetMetaDataType::default()
            },
            status: StatusCode::GOOD,
        },
    };
    let mut bytes = Vec::new();
    announcement
        .encode(PublisherId::UInt16(1), SecurityHeader::NONE, &mut bytes)
        .unwrap();
    bytes
}

fn value() -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        timestamp: Some(now().time),
        ..NetworkHeader::default()
    };
    let header = DataSetHeader {
        sequence_number: Some(7),
        timestamp: Some(now().time),
        status: Some(0x4090),
        ..DataSetHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&header).unwrap();
    frame.scalar(Scalar::Double(f64::INFINITY)).unwrap();
    frame.scalar(Scalar::Int64(i64::MIN)).unwrap();
    frame.array(BuiltinType::Float, 2).unwrap();
    frame.element(Scalar::Float(0.1)).unwrap();
    frame.element(Scalar::Float(-2.5)).unwrap();
    frame.scalar(Scalar::String(Some("a \"b\""))).unwrap();
    frame
        .scalar(Scalar::ByteString(Some(&[1, 2, 255])))
        .unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

/// Returns converters of a sender and a receiver that know the metadata.
fn both(form: MessageMapping) -> (Json, Json) {
    let announcement = announcement();
    let announcement = NetworkMessage::decode(&announcement).unwrap();
    let (mut sender, mut receiver) = (Json::new(form), Json::new(MessageMapping::Uadp));
    let described = sender.describe(&announcement, now()).unwrap();
    let meta = Address {
        kind: TopicMessageType::MetaData,
        ..TOPIC
    };
    let learned = receiver.read(&described, meta).unwrap();
    let learned = NetworkMessage::decode(&learned.messages[0]).unwrap();
    let (topic, meta_data) = descriptions::to_json(&learned).unwrap();
    assert_eq!(
        (topic, &meta_data["Name"]),
        ((1, 2, 10), &json!("ua_1_2_10 arm"))
    );
    (sender, receiver)
}

#[test]
fn a_value_is_read_as_it_was_written_in_every_form() {
    let datagram = value();
    let message = NetworkMessage::decode(&datagram).unwrap();
    for form in FORMS {
        let (mut sender, mut receiver) = both(form);
        let text = sender.value(&message, now()).unwrap();
        let reading = receiver.read(&text, TOPIC).unwrap();
        assert_eq!(reading.faults, [""; 0], "{form:?}");
        assert_eq!(
            reading.messages,
            std::slice::from_ref(&datagram),
            "{form:?}"
        );
    }
}

#[test]
fn promoted_fields_are_texts_in_the_verbose_form() {
    let datagram = value();
    let message = NetworkMessage::decode(&datagram).unwrap();
    let texts = |promoted: &[&str]| {
        let announcement = announcement_with(|name| promoted.contains(&name));
        let mut json = Json::new(MessageMapping::Uadp);
        json.learn_own(&NetworkMessage::decode(&announcement).unwrap());
        let promoted = json.promoted(&message);
        let texts = promoted.iter().map(|(name, text)| format!("{name}={text}"));
        (texts.collect::<Vec<_>>(), promoted.size())
    };
    assert_eq!(texts(&[]), (Vec::new(), 0));
    let (all, size) = texts(&["zone", "count", "axes", "label"]);
    assert_eq!(
        all,
        [
            r#"zone="Infinity""#,
            r#"count="-9223372036854775808""#,
            "axes=[0.1,-2.5]",
            r#"label="a \"b\"""#,
        ]
    );
    // A user property has an identifier and two lengths instead of the `=`.
    assert_eq!(size, all.iter().map(|text| text.len() + 4).sum::<usize>());
    // Without metadata nothing is promoted.
    let unknown = Json::new(MessageMapping::Uadp).promoted(&message);
    assert_eq!(unknown, PromotedTexts::default());
}

#[test]
fn a_field_that_cannot_be_read_leaves_the_promoted_fields_before_it() {
    let mut datagram = Vec::new();
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(Scalar::Double(1.5)).unwrap();
    frame.array(BuiltinType::String, 1).unwrap();
    frame.element(Scalar::String(Some("no utf8"))).unwrap();
    frame.scalar(Scalar::Boolean(true)).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    let start = datagram.windows(7).position(|of| of == b"no utf8");
    datagram[start.unwrap()] = 0xFF;

    let announcement = announcement_with(|_| true);
    let mut json = Json::new(MessageMapping::Uadp);
    json.learn_own(&NetworkMessage::decode(&announcement).unwrap());
    let promoted = json.promoted(&NetworkMessage::decode(&datagram).unwrap());
    // The start of the fields behind it is unknown.
    assert_eq!(promoted, std::iter::once(("zone", "1.5")).collect());
}

#[test]
fn verbose_json_is_plain_and_the_other_forms_carry_types() {
    let datagram = value();
    let message = NetworkMessage::decode(&datagram).unwrap();
    for (form, count) in FORMS.into_iter().zip([
        json!("-9223372036854775808"),
        json!({"UaType": 8, "Value": "-9223372036854775808"}),
        json!({"Type": 8, "Body": "-9223372036854775808"}),
        json!("-9223372036854775808"),
    ]) {
        let text = both(form).0.value(&message, now()).unwrap();
        let whole: Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(whole["PublisherId"], "1");
        let data = &whole["Messages"][0];
        assert_eq!(data["Payload"]["count"], count);
        let old = matches!(
            form,
            MessageMapping::JsonReversible | MessageMapping::JsonNonReversible
        );
        assert_eq!(data["DataSetWriterId"].is_string(), old);
    }
}

/// Returns the only field of each message that is read from a text.
fn read(receiver: &mut Json, text: &Value) -> Result<Vec<String>, &'static str> {
    let reading = receiver.read(text.to_string().as_bytes(), TOPIC)?;
    if let Some(fault) = reading.faults.first() {
        return Err(fault);
    }
    let show = |bytes: &Vec<u8>| {
        let message = NetworkMessage::decode(bytes).unwrap();
        let data = message.messages().next().unwrap().unwrap();
        let fields = data.fields().unwrap().map(|field| {
            let shown = json_values::show_variant(&field.unwrap()).unwrap();
            format!("{:?} {}", shown.ua_type, shown.value.unwrap_or_default())
        });
        fields.collect::<Vec<_>>().join(", ")
    };
    Ok(reading.messages.iter().map(show).collect())
}

#[test]
fn every_layout_and_encoding_of_other_stacks_is_read() {
    let mut unknown = Json::new(MessageMapping::Uadp);
    let typed = json!({"UaType": 11, "Value": 1.5});
    let message =
        json!({"DataSetWriterId": "10", "SequenceNumber": 70_000, "Payload": {"v": typed}});
    for text in [
        json!({"MessageId": "x", "MessageType": "ua-data", "PublisherId": 1, "Messages": [message]}),
        json!({"MessageType": "ua-data", "PublisherId": "1", "Messages": message}),
        json!([message]),
        message,
        json!({"v": typed}),
        json!({"v": {"Value": 1.5, "UaType": 11, "SourceTimestamp": "2026-01-01T00:00:00Z"}}),
        json!({"v": {"Type": 11, "Body": 1.5}}),
        json!({"v": {"Value": {"Type": 11, "Body": 1.5}, "SourcePicoSeconds": 3}}),
    ] {
        assert_eq!(
            read(&mut unknown, &text).unwrap(),
            ["Some(11) 1.5"],
            "{text}"
        );
    }
    // Plain values of unknown types are read where the type is certain only.
    assert_eq!(
        read(&mut unknown, &json!({"v": true})).unwrap(),
        ["Some(1) true"]
    );
    assert_eq!(
        read(&mut unknown, &json!({"v": 1})),
        Err("undescribed_json")
    );
    assert_eq!(
        read(&mut unknown, &json!({"v": true, "w": true})),
        Err("undescribed_json")
    );
    let (_, mut known) = both(MessageMapping::JsonVerbose);
    let plain = json!({"label": "x", "zone": 1, "count": "3", "axes": [1], "blob": null});
    assert_eq!(
        read(&mut known, &plain).unwrap(),
        ["Some(11) 1.0, Some(8) \"3\", Some(10) [1.0], Some(12) \"x\", None null"]
    );
    let more = json!({"label": "x", "other": 1});
    assert_eq!(read(&mut known, &more), Err("unknown_field"));
    let delta = json!({"MessageType": "ua-deltaframe", "Payload": {"count": "4"}});
    let reading = known.read(delta.to_string().as_bytes(), TOPIC).unwrap();
    let delta = NetworkMessage::decode(&reading.messages[0]).unwrap();
    let delta = delta.messages().next().unwrap().unwrap();
    assert_eq!(delta.values().unwrap().next().unwrap().unwrap().index, 1);
}

#[test]
fn faulty_messages_are_refused_with_their_fault() {
    let (_, mut known) = both(MessageMapping::JsonVerbose);
    for (text, fault) in [
        (json!(3), "malformed_json"),
        (
            json!({"PublisherId": "2", "Messages": []}),
            "other_publisher",
        ),
        (json!({"Payload": 3}), "malformed_json"),
        (json!({"Payload": {"zone": "fast"}}), "wrong_json_value"),
        (
            json!({"Payload": {"zone": {"UaType": 99, "Value": 1}}}),
            "wrong_json_value",
        ),
        (
            json!({"Status": "BadTimeout", "Payload": {"zone": 1}}),
            "wrong_json_value",
        ),
        (
            json!({"Status": {"code": 2_147_483_648_u32}, "Payload": {"zone": 1}}),
            "wrong_json_value",
        ),
        (
            json!({"Status": "2147483648", "Payload": {"zone": 1}}),
            "wrong_json_value",
        ),
    ] {
        assert_eq!(read(&mut known, &text), Err(fault), "{text}");
    }
    let refused = known.read(b"{", TOPIC);
    assert_eq!(refused, Err("malformed_json"));
}

#[test]
fn a_status_is_read_as_it_was_written() {
    let mut json = Json::new(MessageMapping::JsonCompact);
    let cyclic = CyclicStatus {
        next_report_time: now().time,
        timestamp: now().time,
    };
    for status in [
        (ConnectionState::OPERATIONAL, Some(cyclic)),
        (ConnectionState::ERROR, None),
    ] {
        let text = json.status(1, status, now());
        let read = json.read(&text, TOPIC).unwrap();
        assert_eq!(read.status, Some(status));
    }
}

/// Returns the fields of a message as DataValues: their values, shown, and their status.
fn with_status(receiver: &mut Json, text: &Value) -> Vec<(u16, Option<Value>, Option<StatusCode>)> {
    let reading = receiver.read(text.to_string().as_bytes(), TOPIC).unwrap();
    let message = NetworkMessage::decode(&reading.messages[0]).unwrap();
    let data = message.messages().next().unwrap().unwrap();
    let fields = data.values().unwrap().map(|field| {
        let field = field.unwrap();
        let value = field.value.value.map(|value| {
            let shown = json_values::show_variant(&value).unwrap();
            shown.value.unwrap_or_default()
        });
        (field.index, value, field.value.status)
    });
    fields.collect()
}

#[test]
fn a_field_keeps_its_status_unless_it_is_good() {
    let (_, mut known) = both(MessageMapping::JsonVerbose);
    let timeout = StatusCode(0x800A_0000);
    let uncertain = StatusCode(0x4000_0000);
    let payload = json!({
        "zone": {"Value": 1.5, "Status": {"Code": 0x800A_0000_u32, "Symbol": "BadTimeout"}},
        "count": {"UaType": 8, "Value": "3", "StatusCode": {"Code": 0x4000_0000}},
        "axes": {"Status": {"Code": 0x800A_0000_u32}},
        "label": {"Type": 12, "Body": "x", "Status": 0},
    });
    let zone = (0, Some(json!(1.5)), Some(timeout));
    let count = (1, Some(json!("3")), Some(uncertain));
    let axes = (2, None, Some(timeout));
    let label = (3, Some(json!("x")), None);
    assert_eq!(
        with_status(&mut known, &json!({ "Payload": payload })),
        [
            zone.clone(),
            count.clone(),
            axes.clone(),
            label.clone(),
            (4, None, None)
        ]
    );
    let delta = json!({"MessageType": "ua-deltaframe", "Payload": payload});
    assert_eq!(with_status(&mut known, &delta), [zone, count, axes, label]);
    let good =
        json!({"zone": {"Value": 1.5, "Status": {}, "SourceTimestamp": "2026-01-01T00:00:00Z"}});
    assert_eq!(
        read(&mut known, &good).unwrap(),
        ["Some(11) 1.5, None null, None null, None null, None null"]
    );
    let wrong = json!({"zone": {"Value": 1.5, "Status": "bad"}});
    assert_eq!(read(&mut known, &wrong), Err("wrong_json_value"));
}
