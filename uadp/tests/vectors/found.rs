//! What was read, in the words of the JSON files.

use serde_json::{Map, Value, json};
use uadp::{
    Array, BuiltinType, DecodeError, ExtensionBody, ExtensionObject, Identifier, MessageKind,
    NetworkMessage, NodeId, PublisherId, Scalar, Variant,
};

pub(crate) fn describe(datagram: &[u8]) -> Result<Value, DecodeError> {
    let message = NetworkMessage::decode(datagram)?;
    let header = message.header();
    let mut group = Map::new();
    if let Some(found) = header.group {
        put(&mut group, "writerGroupId", found.writer_group_id);
        put(&mut group, "groupVersion", found.group_version);
        put(
            &mut group,
            "networkMessageNumber",
            found.network_message_number,
        );
        put(&mut group, "sequenceNumber", found.sequence_number);
    }
    let mut messages = Vec::new();
    for (data_set_message, id) in message.messages().zip(
        message
            .writer_ids()
            .into_iter()
            .flatten()
            .map(Some)
            .chain([None]),
    ) {
        let data_set_message = data_set_message?;
        assert_eq!(data_set_message.writer_id, id);
        let header = data_set_message.header;
        let mut out = Map::new();
        put(&mut out, "valid", Some(header.valid));
        put(&mut out, "sequenceNumber", header.sequence_number);
        put(&mut out, "timestamp", header.timestamp.map(|time| time.0));
        put(&mut out, "picoSeconds", header.picoseconds);
        put(&mut out, "status16", header.status);
        put(&mut out, "majorVersion", header.major_version);
        put(&mut out, "minorVersion", header.minor_version);
        let kind = match data_set_message.kind {
            MessageKind::KeyFrame => "keyFrame",
            MessageKind::DeltaFrame => "deltaFrame",
            MessageKind::Event => "event",
            MessageKind::KeepAlive => "keepAlive",
        };
        put(&mut out, "type", Some(kind));
        let fields = data_set_message.fields()?;
        let len = fields.len();
        let fields = fields.map(|field| field.map(describe_variant));
        let fields = fields.collect::<Result<Vec<_>, _>>()?;
        assert_eq!(fields.len(), len);
        put(&mut out, "fields", Some(fields));
        messages.push(Value::Object(out));
    }
    Ok(json!({
        "publisherId": header.publisher_id.map(|id| match id {
            PublisherId::Byte(id) => json!(["Byte", id.to_string()]),
            PublisherId::UInt16(id) => json!(["UInt16", id.to_string()]),
            PublisherId::UInt32(id) => json!(["UInt32", id.to_string()]),
            PublisherId::UInt64(id) => json!(["UInt64", id.to_string()]),
            PublisherId::String(id) => json!(["String", id]),
        }),
        "dataSetClassId": header.data_set_class_id.map(|id| id.to_string()),
        "groupHeader": header.group.map(|_| group),
        "dataSetWriterIds": message.writer_ids().map(Iterator::collect::<Vec<_>>),
        "timestamp": header.timestamp.map(|time| time.0),
        "picoSeconds": header.picoseconds,
        "dataSetMessages": messages,
    }))
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
    }
}

fn describe_node_id(node_id: NodeId<'_>) -> String {
    let identifier = match node_id.identifier {
        Identifier::Numeric(id) => format!("i={id}"),
        Identifier::String(id) => format!("s={}", id.unwrap()),
        Identifier::Guid(id) => format!("g={}", id.to_string().to_lowercase()),
        Identifier::Opaque(id) => format!("b={}", base64(id.unwrap())),
    };
    match node_id.namespace {
        0 => identifier,
        namespace => format!("ns={namespace};{identifier}"),
    }
}

/// Structures of the standard by the NodeId of their binary encoding; any other as its bytes.
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
