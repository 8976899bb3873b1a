//! Values as JSON are read by software of other makers.
//!
//! aiomqtt is the client at the broker. node-opcua-json and node-opcua-pubsub-expander decode.

use std::collections::BTreeSet;
use std::time::Duration;

use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress, MessageMapping};
use serde_json::{Value, json};
use system_tests::{BROKER, Cell, Child, Peer};
use tokio::runtime::Runtime;
use tokio::time::timeout;
use transport::{BUFFER, Carrier, OutgoingMessage};
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, FieldMetaData, WireArray,
};
use uadp::{
    BuiltinType, DataSetHeader, DateTime, GroupHeader, Guid, LocalizedText, NetworkHeader,
    NetworkMessageEncoder, NodeId, PublisherId, Scalar, SecurityHeader, StatusCode, Timestamp,
};

use super::SOON;

/// The fields of the value and their texts, as `json.js` shows them.
const FIELDS: [(&str, BuiltinType, &str); 14] = [
    ("truth", BuiltinType::Boolean, "true"),
    ("least", BuiltinType::SByte, "-128"),
    ("most", BuiltinType::UInt16, "65535"),
    ("count", BuiltinType::Int64, "-9223372036854775808"),
    ("total", BuiltinType::UInt64, "18446744073709551615"),
    ("third", BuiltinType::Double, "0.3333333333333333"),
    ("label", BuiltinType::String, "a \"b\" Ä"),
    ("time", BuiltinType::DateTime, "2026-01-02T03:04:05.678Z"),
    (
        "guid",
        BuiltinType::Guid,
        "12345678-1234-5678-9abc-123456789abc",
    ),
    ("blob", BuiltinType::ByteString, "0102ff"),
    ("node", BuiltinType::NodeId, "ns=0;i=2258"),
    ("status", BuiltinType::StatusCode, "2148139008"),
    ("text", BuiltinType::LocalizedText, "de:Tür"),
    ("axes", BuiltinType::Float, "0.5 -2.5"),
];

/// Returns the scalars of the value, in the order of [`FIELDS`].
fn scalars() -> [Scalar<'static>; 13] {
    let guid = Guid::from_fields(
        0x1234_5678,
        0x1234,
        0x5678,
        [0x9a, 0xbc, 0x12, 0x34, 0x56, 0x78, 0x9a, 0xbc],
    );
    [
        Scalar::Boolean(true),
        Scalar::SByte(i8::MIN),
        Scalar::UInt16(u16::MAX),
        Scalar::Int64(i64::MIN),
        Scalar::UInt64(u64::MAX),
        Scalar::Double(1.0 / 3.0),
        Scalar::String(Some("a \"b\" Ä")),
        Scalar::DateTime(time(1_767_323_045_678)),
        Scalar::Guid(guid),
        Scalar::ByteString(Some(&[1, 2, 255])),
        Scalar::NodeId(NodeId::numeric(0, 2258)),
        Scalar::StatusCode(StatusCode(0x800A_0000)),
        Scalar::LocalizedText(LocalizedText {
            locale: Some("de"),
            text: Some("Tür"),
        }),
    ]
}

/// Returns a time by its milliseconds since 1970.
fn time(milliseconds: i128) -> DateTime {
    Timestamp::from_unix_nanos(milliseconds * 1_000_000).time
}

/// Returns a value of `ua_1_2_10`.
fn value(number: u16) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let header = DataSetHeader {
        sequence_number: Some(number),
        ..DataSetHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&header).unwrap();
    for scalar in scalars() {
        frame.scalar(scalar).unwrap();
    }
    frame.array(BuiltinType::Float, 2).unwrap();
    frame.element(Scalar::Float(0.5)).unwrap();
    frame.element(Scalar::Float(-2.5)).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

/// Returns the metadata of `ua_1_2_10`.
fn announcement() -> Vec<u8> {
    let fields = FIELDS.map(|(name, builtin, _)| FieldMetaData {
        name: Some(name),
        built_in_type: builtin.id(),
        data_type: NodeId::numeric(0, builtin.id().into()),
        value_rank: if builtin == BuiltinType::Float { 1 } else { -1 },
        ..FieldMetaData::default()
    });
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

fn runtime() -> Runtime {
    let runtime = tokio::runtime::Builder::new_current_thread();
    { runtime }.enable_all().build().unwrap()
}

/// Joins a space at the broker. Called in a runtime.
fn join(encoding: MessageMapping, publisher: u16) -> Box<dyn Carrier> {
    let mut broker = Broker::new(BrokerAddress::parse(BROKER).unwrap());
    broker.encoding = encoding;
    let identity = BrokerIdentity {
        program: "test".to_owned(),
        publisher: Some(publisher),
    };
    Box::new(Mqtt::open(&broker, &identity).unwrap())
}

/// Starts aiomqtt with a subscription.
fn client(cell: &Cell, filter: &str) -> Child {
    let started = cell.mqtt_python_started("mqtt_client.py", &[filter]);
    started.start().ready(SOON)
}

/// Sends the value in a form until aiomqtt has received it. Returns its ua-data and ua-metadata
/// messages.
fn seen(cell: &Cell, form: MessageMapping) -> (Value, Value) {
    let client = client(cell, "opcua/json/#");
    let message = |topic: &str| {
        let lines = client.json_lines();
        let line = lines.iter().find(|line| line["topic"] == topic)?;
        serde_json::from_str::<Value>(line["payload"].as_str()?).ok()
    };
    runtime().block_on(async {
        let mut carrier = join(form, 1);
        let mut buffer = vec![0; BUFFER];
        for number in 1..=300 {
            let _change = carrier.follow();
            for bytes in [announcement(), value(number)] {
                let _not_yet = carrier.try_send(&OutgoingMessage::new(&bytes));
            }
            let _own = timeout(Duration::from_millis(100), carrier.recv(&mut buffer)).await;
            let data = message("opcua/json/data/1/2/10");
            if let Some(both) = data.zip(message("opcua/json/metadata/1/2/10")) {
                return both;
            }
        }
        panic!("aiomqtt receives no value: {:?}", carrier.lost())
    })
}

#[test]
fn values_of_many_types_are_read_by_node_opcua_json_in_every_typed_form() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto, Peer::MqttPython, Peer::NodeOpcua]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let judge = cell.node_opcua_started("json.js", &[]).told();
    let mut judge = judge.start().ready(SOON);
    let expected: Vec<Value> = FIELDS
        .iter()
        .map(|(name, builtin, text)| json!([name, format!("{builtin:?}"), text]))
        .collect();
    for (form, scheme) in [
        (MessageMapping::JsonVerbose, "Verbose"),
        (MessageMapping::JsonCompact, "Compact"),
        (MessageMapping::JsonReversible, "DeprecatedReversible"),
    ] {
        let (data, metadata) = seen(&cell, form);
        let order = json!({"read": data, "by": metadata, "scheme": scheme});
        let read = judge.ask(&order.to_string(), SOON);
        assert_eq!(read["fields"], json!(expected), "{scheme}: {data}");
    }
}

#[test]
fn values_are_read_by_the_expander_of_node_opcua_by_their_metadata() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto, Peer::MqttPython, Peer::NodeOpcuaPubSub]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let mut judge = cell.node_opcua_pubsub("read.js");
    let (data, metadata) = seen(&cell, MessageMapping::JsonReversible);
    let order = json!({"read": data, "by": metadata});
    judge.tell(&order.to_string());
    let read = judge.wait_for_json("the fields", SOON, |line| line.get("fields").cloned());
    let read = read.as_array().unwrap();
    // The order of the keys of a JSON object has no meaning.
    let names: BTreeSet<&str> = read.iter().filter_map(|of| of[0].as_str()).collect();
    assert_eq!(names, FIELDS.map(|(name, ..)| name).into());
    for (name, value) in [
        ("truth", json!(true)),
        ("count", json!("-9223372036854775808")),
        ("third", json!(1.0 / 3.0)),
        ("label", json!("a \"b\" Ä")),
        ("axes", json!([0.5, -2.5])),
    ] {
        assert!(read.contains(&json!([name, value])), "{name}: {read:?}");
    }
}
