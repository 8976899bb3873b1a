//! Decoded messages, described as in the JSON files.

use serde_json::{Map, Value, json};
use uadp::{
    Array, BuiltinType, DataSetMessage, DataValue, DecodeError, ExtensionBody, ExtensionObject,
    FieldEncoding, GroupHeader, MessageKind, NetworkMessage, NetworkMessageType, NodeId,
    NodeIdValue, PublisherId, Scalar, Variant,
};

/// Describes the headers of a NetworkMessage and of its chunk.
pub(crate) fn describe_headers(message: &NetworkMessage<'_>) -> Result<Value, DecodeError> {
    let header = message.header();
    let promoted = message.promoted_fields().map(|fields| {
        let fields = fields.map(|field| field.map(describe_variant));
        fields.collect::<Result<Vec<_>, _>>()
    });
    let chunk = if message.is_chunk() {
        Some(message.chunk()?)
    } else {
        None
    };
    Ok(json!({
        "publisherId": header.publisher_id.map(|id| match id {
            PublisherId::Byte(id) => json!(["Byte", id.to_string()]),
            PublisherId::UInt16(id) => json!(["UInt16", id.to_string()]),
            PublisherId::UInt32(id) => json!(["UInt32", id.to_string()]),
            PublisherId::UInt64(id) => json!(["UInt64", id.to_string()]),
            PublisherId::String(id) => json!(["String", id]),
        }),
        "dataSetClassId": header.data_set_class_id.map(|id| id.to_string()),
        "groupHeader": header.group.map(describe_group),
        "dataSetWriterIds": message.writer_ids().map(Iterator::collect::<Vec<_>>),
        "timestamp": header.timestamp.map(|time| time.0),
        "picoSeconds": header.picoseconds,
        "promotedFields": promoted.transpose()?,
        "securityHeader": message.security().map(|header| json!({
            "signed": header.signed,
            "encrypted": header.encrypted,
            "forceKeyReset": header.force_key_reset,
            "securityTokenId": header.token_id,
            "nonce": hex(header.nonce),
            "footerSize": header.footer_size,
            "footer": hex(message.footer()),
        })),
        "networkMessageType": match message.message_type() {
            NetworkMessageType::DataSet => None,
            NetworkMessageType::Probe => Some("discoveryProbe"),
            NetworkMessageType::Announcement => Some("discoveryAnnouncement"),
        },
        "chunk": chunk.map(|chunk| json!({
            "dataSetWriterId": chunk.writer_id,
            "messageSequenceNumber": chunk.message_sequence_number,
            "chunkOffset": chunk.offset,
            "totalSize": chunk.total_size,
            "chunkDataHex": hex(chunk.data),
        })),
    }))
}

fn describe_group(group: GroupHeader) -> Value {
    let mut out = Map::new();
    put(&mut out, "writerGroupId", group.writer_group_id);
    put(&mut out, "groupVersion", group.group_version);
    let number = group.network_message_number;
    put(&mut out, "networkMessageNumber", number);
    put(&mut out, "sequenceNumber", group.sequence_number);
    Value::Object(out)
}

/// Describes the DataSetMessages, without the fields of RawData messages.
pub(crate) fn describe_messages(message: &NetworkMessage<'_>) -> Result<Value, DecodeError> {
    let ids = message.writer_ids().into_iter().flatten().map(Some);
    let mut messages = Vec::new();
    for (data_set_message, id) in message.messages().zip(ids.chain([None])) {
        let data_set_message = data_set_message?;
        assert_eq!(data_set_message.writer_id, id);
        messages.push(describe_message(&data_set_message)?);
    }
    Ok(Value::Array(messages))
}

fn describe_message(message: &DataSetMessage<'_>) -> Result<Value, DecodeError> {
    let header = message.header();
    let mut out = Map::new();
    put(&mut out, "valid", Some(header.valid));
    put(&mut out, "sequenceNumber", header.sequence_number);
    put(&mut out, "timestamp", header.timestamp.map(|time| time.0));
    put(&mut out, "picoSeconds", header.picoseconds);
    put(&mut out, "status16", header.status);
    put(&mut out, "majorVersion", header.major_version);
    put(&mut out, "minorVersion", header.minor_version);
    let kind = match message.kind {
        MessageKind::KeyFrame => "keyFrame",
        MessageKind::DeltaFrame => "deltaFrame",
        MessageKind::Event => "event",
        MessageKind::KeepAlive => "keepAlive",
    };
    put(&mut out, "type", Some(kind));
    let encoding = match message.encoding() {
        FieldEncoding::Variant => "Variant",
        FieldEncoding::RawData => "RawData",
        FieldEncoding::DataValue => "DataValue",
    };
    put(&mut out, "fieldEncoding", Some(encoding));
    if message.encoding() != FieldEncoding::RawData {
        put(&mut out, "fields", Some(describe_fields(message)?));
    }
    Ok(Value::Object(out))
}

fn describe_fields(message: &DataSetMessage<'_>) -> Result<Vec<Value>, DecodeError> {
    let values = message.values()?.collect::<Result<Vec<_>, _>>()?;
    if let Ok(fields) = message.fields() {
        assert_eq!(fields.len(), values.len());
        let plain = fields.map(|field| describe_variant(field.unwrap()));
        let indexed = values.iter().filter_map(|field| field.value.value);
        assert!(plain.eq(indexed.map(describe_variant)));
    }
    let mut out = Vec::new();
    for (position, field) in values.into_iter().enumerate() {
        let value = describe_data_value(field.value);
        out.push(match message.kind {
            MessageKind::DeltaFrame => json!({ "index": field.index, "value": value }),
            _ => {
                assert_eq!(usize::from(field.index), position);
                value
            }
        });
    }
    Ok(out)
}

fn describe_data_value(value: DataValue<'_>) -> Value {
    let mut out = match value.value.map(describe_variant) {
        Some(Value::Object(value)) => value,
        _ => Map::new(),
    };
    put(&mut out, "status", value.status.map(|status| status.0));
    let source = value.source_timestamp.map(|time| time.0);
    put(&mut out, "sourceTimestamp", source);
    put(&mut out, "sourcePicoseconds", value.source_picoseconds);
    let server = value.server_timestamp.map(|time| time.0);
    put(&mut out, "serverTimestamp", server);
    put(&mut out, "serverPicoseconds", value.server_picoseconds);
    Value::Object(out)
}

fn put<T: Into<Value>>(map: &mut Map<String, Value>, key: &str, value: Option<T>) {
    if let Some(value) = value {
        map.insert(key.to_owned(), value.into());
    }
}

fn describe_variant(variant: Variant<'_>) -> Value {
    match variant {
        Variant::Null => json!({}),
        Variant::Scalar(scalar) => {
            json!({ "type": scalar.builtin_type().name(), "value": describe_scalar(scalar) })
        }
        Variant::Array(array) => json!({
            "type": array.element().name(),
            "value": array.iter().map(describe_scalar).collect::<Vec<_>>(),
        }),
        Variant::Matrix(matrix) => {
            let mut out = describe_variant(Variant::Array(matrix.elements()));
            out["dimensions"] = matrix.dimensions().collect();
            out
        }
    }
}

fn describe_scalar(scalar: Scalar<'_>) -> Value {
    match scalar {
        Scalar::Boolean(value) => json!(value),
        Scalar::SByte(value) => json!(value),
        Scalar::Byte(value) => json!(value),
        Scalar::Int16(value) => json!(value),
        Scalar::UInt16(value) => json!(value),
        Scalar::Int32(value) => json!(value),
        Scalar::UInt32(value) => json!(value),
        Scalar::Int64(value) => json!(value.to_string()),
        Scalar::UInt64(value) => json!(value.to_string()),
        Scalar::Float(value) => json!(value.to_string()),
        Scalar::Double(value) => json!(value.to_string()),
        Scalar::String(value) | Scalar::XmlElement(value) => json!(value),
        Scalar::DateTime(value) => json!(value.0),
        Scalar::Guid(value) => json!(value.to_string()),
        Scalar::ByteString(value) => json!(value.map(base64)),
        Scalar::NodeId(value) => json!(describe_node_id(value)),
        Scalar::ExpandedNodeId(value) => {
            assert_eq!(value.server_index, 0);
            match value.namespace_uri {
                Some(uri) => {
                    let plain = NodeId {
                        namespace: 0,
                        ..value.node_id
                    };
                    json!(format!("nsu={uri};{}", describe_node_id(plain)))
                }
                None => json!(describe_node_id(value.node_id)),
            }
        }
        Scalar::StatusCode(value) => json!(value.0),
        Scalar::QualifiedName(value) => {
            json!(format!("{}:{}", value.namespace, value.name.unwrap()))
        }
        Scalar::LocalizedText(value) => json!({ "Locale": value.locale, "Text": value.text }),
        Scalar::ExtensionObject(value) => describe_structure(value),
        Scalar::Variant(value) => describe_variant(value.get().unwrap()),
        Scalar::DataValue(value) => panic!("no vector has a DataValue in a Variant: {value:?}"),
        Scalar::DiagnosticInfo(value) => panic!("no vector has a DiagnosticInfo: {value:?}"),
    }
}

fn describe_node_id(node_id: NodeId<'_>) -> String {
    let identifier = match node_id.identifier {
        NodeIdValue::Numeric(id) => format!("i={id}"),
        NodeIdValue::String(id) => format!("s={}", id.unwrap()),
        NodeIdValue::Guid(id) => format!("g={}", id.to_string().to_lowercase()),
        NodeIdValue::Opaque(id) => format!("b={}", base64(id.unwrap())),
    };
    match node_id.namespace {
        0 => identifier,
        namespace => format!("ns={namespace};{identifier}"),
    }
}

/// Describes structures of the standard by the NodeId of their binary encoding; other structures by
/// their bytes.
fn describe_structure(object: ExtensionObject<'_>) -> Value {
    let body = match object.body {
        ExtensionBody::None => {
            assert_eq!(object.type_id, NodeId::NULL);
            return Value::Null;
        }
        ExtensionBody::Binary(body) => body,
        ExtensionBody::Xml(body) => panic!("no vector has an XML body: {body}"),
    };
    let doubles = || -> Vec<String> {
        let (chunks, rest) = body.as_chunks();
        assert!(rest.is_empty());
        chunks
            .iter()
            .map(|chunk| f64::from_le_bytes(*chunk).to_string())
            .collect()
    };
    match describe_node_id(object.type_id).as_str() {
        "i=886" => json!({ "type": "i=884", "numbers": doubles() }),
        "i=18823" => json!({ "type": "i=18814", "numbers": doubles() }),
        "i=889" => {
            let (uri, rest) = string(body);
            let (unit, rest) = rest.split_first_chunk().unwrap();
            let text = Array::new(BuiltinType::LocalizedText, 2, rest).unwrap();
            let texts: Vec<_> = text.iter().map(describe_scalar).collect();
            json!({ "type": "i=887", "uri": uri, "unit": i32::from_le_bytes(*unit), "texts": texts })
        }
        type_id => json!({ "type": type_id, "body": base64(body) }),
    }
}

fn string(bytes: &[u8]) -> (&str, &[u8]) {
    let (len, rest) = bytes.split_first_chunk().unwrap();
    let (text, rest) = rest.split_at(usize::try_from(i32::from_le_bytes(*len)).unwrap());
    (str::from_utf8(text).unwrap(), rest)
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(crate) fn base64(bytes: &[u8]) -> String {
    let digits = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::new();
    for chunk in bytes.chunks(3) {
        let mut group = [0; 3];
        group[..chunk.len()].copy_from_slice(chunk);
        let bits = u32::from_be_bytes([0, group[0], group[1], group[2]]);
        for place in 0..4 {
            let digit = digits[(bits >> (18 - 6 * place)) as usize & 63];
            out.push(if place <= chunk.len() {
                char::from(digit)
            } else {
                '='
            });
        }
    }
    out
}
