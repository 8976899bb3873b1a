//! Random messages that both codecs can express, in the types of the foreign crate.
//!
//! Left out because of the foreign crate:
//! - chunks: the foreign crate refuses them.
//! - discovery messages: it has neither their SecurityHeader nor the ProbeType.
//! - security: there it is a separate feature, checked with other vectors.
//! - ExpandedNodeId, DataValue, Variant and DiagnosticInfo in a Variant: its type for values has
//!   none of them.
//! - null String, ByteString, XmlElement and null in NodeIds, names and texts: it reads null as
//!   empty and cannot write it.
//! - null and empty arrays: it refuses null arrays and writes empty arrays as a null Variant.
//! - arrays of one dimension with ArrayDimensions: it does not distinguish them from plain arrays.
//! - DataValues with SourcePicoSeconds and ServerTimestamp: it has both times first and both
//!   PicoSeconds behind them.
//! - a key frame without FieldCount: it requires the FieldCount.
//! - padding to a ConfiguredSize: it refuses padding between messages.
//!
//! Left out because of the standard:
//! - events as DataValues or RawData and delta frames as RawData (OPC 10000-14, 7.2.4.5.6 and
//!   7.2.4.5.7).
//! - PicoSeconds without their time, and of 10 000 and more (OPC 10000-6, 5.2.2.17).
//! - PromotedFields with several DataSetMessages (OPC 10000-14, 7.2.4.4.2), and a Count of 0
//!   (7.2.4.5.2).

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use zerodds_opcua_gateway::data_value::{
    DataValue, ExtensionObject, ExtensionObjectBody, Variant, VariantValue,
};
use zerodds_opcua_gateway::node_id::{NodeId, NodeIdentifier};
use zerodds_opcua_gateway::types::{Guid, LocalizedText, QualifiedName};
use zerodds_opcua_pubsub::uadp::{
    DataSetData, DataSetMessage, DataSetMessageKind, GroupHeader, NetworkMessage, PublisherId,
};

/// Generates every valid message that both codecs can express.
pub(crate) fn messages() -> impl Strategy<Value = NetworkMessage> {
    let payload = prop_oneof![
        3 => data_set_message().prop_map(|message| (true, vec![message])),
        3 => vec(data_set_message(), 2..5).prop_map(|messages| (true, messages)),
        1 => data_set_message().prop_map(|message| {
            // Without payload header, the message has no DataSetWriterId.
            (false, vec![DataSetMessage { writer_id: 0, ..message }])
        }),
    ];
    (headers(), payload).prop_map(|(headers, (payload_header, messages))| {
        let promoted_fields = match messages.len() {
            1 => headers.promoted_fields,
            _ => Vec::new(),
        };
        NetworkMessage {
            promoted_fields,
            payload_header,
            messages,
            ..headers
        }
    })
}

fn headers() -> impl Strategy<Value = NetworkMessage> {
    (
        option::of(publisher_id()),
        option::of(guid()),
        option::of(group_header()),
        time(),
        prop_oneof![3 => Just(Vec::new()), 1 => vec(variant(), 1..3)],
    )
        .prop_map(
            |(publisher_id, data_set_class_id, group_header, time, promoted_fields)| {
                NetworkMessage {
                    publisher_id,
                    data_set_class_id,
                    group_header,
                    timestamp: time.0,
                    pico_seconds: time.1,
                    promoted_fields,
                    ..NetworkMessage::with_messages(Vec::new())
                }
            },
        )
}

fn publisher_id() -> impl Strategy<Value = PublisherId> {
    prop_oneof![
        any::<u8>().prop_map(PublisherId::Byte),
        any::<u16>().prop_map(PublisherId::UInt16),
        any::<u32>().prop_map(PublisherId::UInt32),
        any::<u64>().prop_map(PublisherId::UInt64),
        text().prop_map(PublisherId::String),
    ]
}

fn group_header() -> impl Strategy<Value = GroupHeader> {
    any::<(Option<u16>, Option<u32>, Option<u16>, Option<u16>)>().prop_map(
        |(writer_group_id, group_version, network_message_number, sequence_number)| GroupHeader {
            writer_group_id,
            group_version,
            network_message_number,
            sequence_number,
        },
    )
}

fn data_set_message() -> impl Strategy<Value = DataSetMessage> {
    let header = (
        any::<u16>(),
        any::<Option<u16>>(),
        time(),
        any::<Option<u16>>(),
        any::<(Option<u32>, Option<u32>)>(),
    );
    (header, data()).prop_map(
        |((writer_id, sequence_number, time, status, version), (kind, data))| DataSetMessage {
            writer_id,
            valid: true,
            kind,
            sequence_number,
            timestamp: time.0,
            pico_seconds: time.1,
            status,
            config_major_version: version.0,
            config_minor_version: version.1,
            data,
        },
    )
}

fn data() -> impl Strategy<Value = (DataSetMessageKind, DataSetData)> {
    use DataSetMessageKind::{DeltaFrame, Event, KeepAlive, KeyFrame};
    let variants = || vec(variant(), 0..5).prop_map(DataSetData::Variant);
    let delta = vec((any::<u16>(), variant()), 0..5).prop_map(DataSetData::DeltaVariant);
    let delta_values =
        vec((any::<u16>(), data_value()), 0..5).prop_map(DataSetData::DeltaDataValue);
    prop_oneof![
        4 => variants().prop_map(|fields| (KeyFrame, fields)),
        3 => vec(data_value(), 0..5).prop_map(|fields| (KeyFrame, DataSetData::DataValue(fields))),
        1 => vec(any::<u8>(), 0..20).prop_map(|bytes| (KeyFrame, DataSetData::Raw(bytes))),
        2 => delta.prop_map(|fields| (DeltaFrame, fields)),
        2 => delta_values.prop_map(|fields| (DeltaFrame, fields)),
        1 => variants().prop_map(|fields| (Event, fields)),
        1 => Just((KeepAlive, DataSetData::None)),
    ]
}

fn data_value() -> impl Strategy<Value = DataValue> {
    (option::of(variant()), any::<Option<u32>>(), time(), time()).prop_map(
        |(value, status, source, server)| {
            let server = match source.1 {
                Some(_) => (None, None),
                None => server,
            };
            DataValue {
                value,
                status,
                source_timestamp: source.0,
                server_timestamp: server.0,
                source_pico_sec: source.1,
                server_pico_sec: server.1,
            }
        },
    )
}

/// Generates a DateTime and its PicoSeconds.
fn time() -> impl Strategy<Value = (Option<i64>, Option<u16>)> {
    prop_oneof![
        Just((None, None)),
        any::<i64>().prop_map(|time| (Some(time), None)),
        (any::<i64>(), 0..10_000_u16).prop_map(|(time, rest)| (Some(time), Some(rest))),
    ]
}

fn variant() -> impl Strategy<Value = Variant> {
    let scalar = value().prop_map(Variant::scalar);
    let array = arrays(1..6).prop_map(|value| Variant {
        array_dimensions: vec![u32::try_from(value.len()).unwrap()],
        value,
    });
    let matrix = vec(1..4_u32, 2..4).prop_flat_map(|dimensions| {
        let len: u32 = dimensions.iter().product();
        let len = usize::try_from(len).unwrap();
        arrays(len..len + 1).prop_map(move |value| Variant {
            array_dimensions: dimensions.clone(),
            value,
        })
    });
    let null = Just(Variant {
        array_dimensions: Vec::new(),
        value: Vec::new(),
    });
    prop_oneof![6 => scalar, 3 => array, 1 => matrix, 1 => null]
}

/// Generates values of a single type.
fn arrays(len: std::ops::Range<usize>) -> impl Strategy<Value = Vec<VariantValue>> {
    (0..KINDS).prop_flat_map(move |kind| vec(value_of(kind), len.clone()))
}

fn value() -> impl Strategy<Value = VariantValue> {
    (0..KINDS).prop_flat_map(value_of)
}

const KINDS: usize = 21;

/// Generates a value of a type of [`VariantValue`].
fn value_of(kind: usize) -> BoxedStrategy<VariantValue> {
    match kind {
        0 => any::<bool>().prop_map(VariantValue::Boolean).boxed(),
        1 => any::<i8>().prop_map(VariantValue::SByte).boxed(),
        2 => any::<u8>().prop_map(VariantValue::Byte).boxed(),
        3 => any::<i16>().prop_map(VariantValue::Int16).boxed(),
        4 => any::<u16>().prop_map(VariantValue::UInt16).boxed(),
        5 => any::<i32>().prop_map(VariantValue::Int32).boxed(),
        6 => any::<u32>().prop_map(VariantValue::UInt32).boxed(),
        7 => any::<i64>().prop_map(VariantValue::Int64).boxed(),
        8 => any::<u64>().prop_map(VariantValue::UInt64).boxed(),
        // Made from bits, so that every NaN is included.
        9 => (any::<u32>())
            .prop_map(|bits| VariantValue::Float(f32::from_bits(bits)))
            .boxed(),
        10 => (any::<u64>())
            .prop_map(|bits| VariantValue::Double(f64::from_bits(bits)))
            .boxed(),
        11 => text().prop_map(VariantValue::String).boxed(),
        12 => any::<i64>().prop_map(VariantValue::DateTime).boxed(),
        13 => guid().prop_map(VariantValue::Guid).boxed(),
        14 => bytes().prop_map(VariantValue::ByteString).boxed(),
        15 => text().prop_map(VariantValue::XmlElement).boxed(),
        16 => node_id().prop_map(VariantValue::NodeId).boxed(),
        17 => any::<u32>().prop_map(VariantValue::StatusCode).boxed(),
        18 => qualified_name()
            .prop_map(VariantValue::QualifiedName)
            .boxed(),
        19 => localized_text()
            .prop_map(VariantValue::LocalizedText)
            .boxed(),
        _ => extension_object()
            .prop_map(VariantValue::ExtensionObject)
            .boxed(),
    }
}

fn qualified_name() -> impl Strategy<Value = QualifiedName> {
    (any::<u16>(), text()).prop_map(|(namespace_index, name)| QualifiedName {
        namespace_index,
        name,
    })
}

fn localized_text() -> impl Strategy<Value = LocalizedText> {
    (option::of(text()), option::of(text()))
        .prop_map(|(locale, text)| LocalizedText { locale, text })
}

fn extension_object() -> impl Strategy<Value = ExtensionObject> {
    let body = prop_oneof![
        Just(ExtensionObjectBody::None),
        bytes().prop_map(ExtensionObjectBody::ByteString),
        text().prop_map(ExtensionObjectBody::XmlElement),
    ];
    (node_id(), body).prop_map(|(type_id, body)| ExtensionObject { type_id, body })
}

/// Generates numeric identifiers of every width, because each width has its own encoding.
fn node_id() -> impl Strategy<Value = NodeId> {
    let identifier = prop_oneof![
        (0..=0xFF_u32).prop_map(NodeIdentifier::Numeric),
        (0..=0xFFFF_u32).prop_map(NodeIdentifier::Numeric),
        any::<u32>().prop_map(NodeIdentifier::Numeric),
        text().prop_map(NodeIdentifier::String),
        guid().prop_map(NodeIdentifier::Guid),
        bytes().prop_map(NodeIdentifier::Opaque),
    ];
    let namespace = prop_oneof![Just(0), 0..=0xFF_u16, any::<u16>()];
    (namespace, identifier).prop_map(|(namespace_index, identifier_type)| NodeId {
        namespace_index,
        identifier_type,
    })
}

fn guid() -> impl Strategy<Value = Guid> {
    any::<[u8; 16]>().prop_map(Guid::from_bytes)
}

fn text() -> impl Strategy<Value = String> {
    vec(any::<char>(), 0..6).prop_map(String::from_iter)
}

fn bytes() -> impl Strategy<Value = Vec<u8>> {
    vec(any::<u8>(), 0..12)
}
