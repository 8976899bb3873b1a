//! JSON messages whose values node-opcua-json wrote are read, in each of its four forms.

use std::collections::BTreeMap;
use std::process::Command;
use std::time::Duration;

use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress};
use serde_json::{Value, json};
use system_tests::{BROKER, Cell, Peer};
use tokio::time::timeout;
use transport::{BUFFER, Carrier};
use uadp::discovery::Announcement;
use uadp::{BuiltinType, DataValue, NetworkMessage, StatusCode};

use super::SOON;

/// A field of `json.js`: its name, its type, the number of its DataType if it is no builtin type,
/// and its ValueRank.
type Field = (&'static str, BuiltinType, Option<u32>, i32);

const FIELDS: [Field; 35] = [
    ("truth", BuiltinType::Boolean, None, -1),
    ("never", BuiltinType::Boolean, None, -1),
    ("least", BuiltinType::SByte, None, -1),
    ("byte", BuiltinType::Byte, None, -1),
    ("short", BuiltinType::Int16, None, -1),
    ("most", BuiltinType::UInt16, None, -1),
    ("none", BuiltinType::Int32, None, -1),
    ("wide", BuiltinType::UInt32, None, -1),
    ("count", BuiltinType::Int64, None, -1),
    ("total", BuiltinType::UInt64, None, -1),
    ("half", BuiltinType::Float, None, -1),
    ("third", BuiltinType::Double, None, -1),
    ("broken", BuiltinType::Double, None, -1),
    ("label", BuiltinType::String, None, -1),
    ("time", BuiltinType::DateTime, None, -1),
    ("never_set", BuiltinType::DateTime, None, -1),
    ("guid", BuiltinType::Guid, None, -1),
    ("blob", BuiltinType::ByteString, None, -1),
    ("xml", BuiltinType::XmlElement, None, -1),
    ("node", BuiltinType::NodeId, None, -1),
    ("own_node", BuiltinType::NodeId, None, -1),
    ("far_node", BuiltinType::ExpandedNodeId, None, -1),
    ("status", BuiltinType::StatusCode, None, -1),
    ("name", BuiltinType::QualifiedName, None, -1),
    ("text", BuiltinType::LocalizedText, None, -1),
    ("range", BuiltinType::ExtensionObject, Some(884), -1),
    ("unit", BuiltinType::ExtensionObject, Some(887), -1),
    ("taken", BuiltinType::DataValue, None, -1),
    ("info", BuiltinType::DiagnosticInfo, None, -1),
    ("axes", BuiltinType::Float, None, 1),
    ("states", BuiltinType::StatusCode, None, 1),
    ("texts", BuiltinType::LocalizedText, None, 1),
    ("mixed", BuiltinType::Variant, None, 1),
    ("grid", BuiltinType::Int32, None, 2),
    ("measured", BuiltinType::Double, None, -1),
];

const TIMEOUT: StatusCode = StatusCode(0x800A_0000);

/// Returns the values that `json.js` wrote in a form, as they are to be read. The form decides
/// about the namespace of a NodeId, the locale of a text, and the type of a null.
fn expected(form: &str) -> BTreeMap<&'static str, Value> {
    let is_old = form.starts_with("Deprecated");
    let is_plain = form == "DeprecatedNonReversible";
    let timed_out = json!({"Code": TIMEOUT.0, "Symbol": "BadTimeout"});
    let text = |locale: Option<&str>, text: Option<&str>| json!({"Locale": locale, "Text": text});
    // The verbose form of node-opcua-json writes -1 for the indexes that are not there.
    let indexes = if form == "Verbose" {
        json!({"SymbolicId": 3, "NamespaceUri": -1, "Locale": -1, "LocalizedText": -1,
            "InnerStatusCode": timed_out})
    } else {
        json!({"SymbolicId": 3, "InnerStatusCode": timed_out})
    };
    let values = [
        ("truth", json!(true)),
        ("never", json!(false)),
        ("least", json!(-128)),
        ("byte", json!(255)),
        ("short", json!(-3)),
        ("most", json!(65_535)),
        ("none", json!(0)),
        ("wide", json!(4_294_967_295_u32)),
        ("count", json!("-9223372036854775808")),
        ("total", json!("18446744073709551615")),
        ("half", json!(0.5)),
        ("third", json!(1.0 / 3.0)),
        // The plain form has no type that tells a null number from a null Variant.
        ("broken", if is_plain { Value::Null } else { json!("NaN") }),
        ("label", json!("a \"b\" Ä")),
        ("time", json!("2026-01-02T03:04:05.678Z")),
        ("never_set", json!("1601-01-01T00:00:00Z")),
        ("guid", json!("12345678-1234-5678-9ABC-123456789ABC")),
        ("blob", json!("AQL/")),
        ("xml", json!("<a/>")),
        ("node", json!("i=2258")),
        (
            "own_node",
            json!(if is_old {
                "ns=1;s=x"
            } else {
                "s=nsu=urn:judge;s=x"
            }),
        ),
        ("far_node", json!("svr=3;i=7")),
        ("status", timed_out.clone()),
        ("name", json!("1:n")),
        ("text", text((!is_plain).then_some("de"), Some("Tür"))),
        (
            "range",
            json!({"Low": 0.0, "High": 2.0, "UaTypeId": "i=884"}),
        ),
        (
            "unit",
            json!({"NamespaceUri": "urn:u", "UnitId": 3, "DisplayName": text(None, Some("m")),
                "Description": text(None, None), "UaTypeId": "i=887"}),
        ),
        (
            "taken",
            json!({"UaType": 11, "Value": 1.5, "Status": timed_out, "SourcePicoseconds": 30,
                "SourceTimestamp": "2026-01-02T03:04:05.678Z"}),
        ),
        ("info", indexes),
        ("axes", json!([0.5, -2.5, "NaN"])),
        ("states", json!([{"Code": 0, "Symbol": "Good"}, timed_out])),
        ("texts", json!([text(None, Some("t")), text(None, None)])),
        (
            "mixed",
            json!([{"UaType": 11, "Value": 1.5}, {"UaType": 12, "Value": "x"}, {}]),
        ),
        ("grid", json!([1, 2, 3, 4, 5, 6])),
        ("measured", json!(1.5)),
    ];
    let unknown = |name: &str| is_plain && ["mixed", "taken"].contains(&name);
    values
        .into_iter()
        .map(|(name, value)| (name, if unknown(name) { Value::Null } else { value }))
        .collect()
}

/// Publishes a JSON message at a topic below `opcua/json`.
fn publish(kind: &str, message: &Value) {
    let topic = format!("opcua/json/{kind}/1/2/10");
    let sent = Command::new("mosquitto_pub")
        .args(["-h", "127.0.0.1", "-t", &topic, "-m", &message.to_string()])
        .status();
    assert!(sent.unwrap().success());
}

/// Returns the fields of the value that a carrier receives while a payload is published, and the
/// number of messages with forms that the standard does not have.
fn received(payload: &Value) -> (Vec<(Value, Option<StatusCode>)>, u64) {
    let fields: Vec<Value> = FIELDS
        .map(|(name, builtin, data_type, rank)| {
            let data_type = data_type.unwrap_or_else(|| builtin.id().into());
            json!({"Name": name, "BuiltInType": builtin.id(), "ValueRank": rank,
            "DataType": format!("i={data_type}")})
        })
        .into();
    let described = json!({"MessageId": "described", "MessageType": "ua-metadata",
        "PublisherId": "1", "DataSetWriterId": 10, "MetaData": {"Name": "arm", "Fields": fields}});
    let runtime = tokio::runtime::Builder::new_current_thread();
    { runtime }.enable_all().build().unwrap().block_on(async {
        let broker = Broker::new(BrokerAddress::parse(BROKER).unwrap());
        let identity = BrokerIdentity {
            program: "test".to_owned(),
            publisher: Some(3),
        };
        let mut carrier: Box<dyn Carrier> = Box::new(Mqtt::open(&broker, &identity).unwrap());
        let mut buffer = vec![0; BUFFER];
        let end = tokio::time::Instant::now() + SOON;
        for number in 1.. {
            assert!(
                tokio::time::Instant::now() < end,
                "no value arrives: {:?} {:?}",
                carrier.lost(),
                carrier.dropped()
            );
            let _change = carrier.follow();
            let data = json!({"MessageId": number.to_string(), "MessageType": "ua-data",
            "PublisherId": "1", "Messages": [
                {"DataSetWriterId": 10, "SequenceNumber": number, "Payload": payload},
            ]});
            publish("metadata", &described);
            publish("data", &data);
            let wait = timeout(Duration::from_millis(100), carrier.recv(&mut buffer));
            let Ok(Ok(read)) = wait.await else {
                continue;
            };
            let message = NetworkMessage::decode(&buffer[..read.length]).unwrap();
            if Announcement::decode(&message).is_err() {
                let counted = carrier.dropped();
                let counted = counted.iter().find(|(why, _)| *why == "nonstandard_json");
                return (shown(&message), counted.map_or(0, |(_, count)| *count));
            }
        }
        unreachable!("the loop ends with a value or a panic")
    })
}

/// Returns the fields of a message: each value, shown, and its status.
fn shown(message: &NetworkMessage<'_>) -> Vec<(Value, Option<StatusCode>)> {
    let data = message.messages().next().unwrap().unwrap();
    let fields = data.values().unwrap().map(|field| {
        let DataValue { value, status, .. } = field.unwrap().value;
        let value = value.map(|value| json_values::show_variant(&value).unwrap());
        let value = value.and_then(|value| value.value).unwrap_or_default();
        (value, status)
    });
    fields.collect()
}

#[test]
fn values_that_node_opcua_json_writes_are_read_in_each_of_its_forms() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto, Peer::NodeOpcua]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let judge = cell.node_opcua_started("json.js", &[]).told();
    let mut judge = judge.start().ready(SOON);
    for form in [
        "Verbose",
        "Compact",
        "DeprecatedReversible",
        "DeprecatedNonReversible",
    ] {
        let order = json!({ "write": form }).to_string();
        let payload = judge.ask(&order, SOON)["payload"].take();
        let (fields, counted) = received(&payload);
        let expected = expected(form);
        for ((name, ..), (value, status)) in FIELDS.iter().zip(&fields) {
            assert_eq!(value, &expected[name], "{form}: {name} of {payload}");
            let wanted = (*name == "measured").then_some(TIMEOUT);
            assert_eq!(*status, wanted, "{form}: {name}");
        }
        assert_eq!(fields.len(), FIELDS.len());
        assert!(counted > 0, "{form}");
    }
}
