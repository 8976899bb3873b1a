//! Encodes values from JSON, in the binary encoding of OPC 10000-6, 5.2.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde::Deserialize;
use serde_json::{Map, Value};
use uadp::{
    Array, BuiltinType, DataValue, DiagnosticInfo, ExtensionBody, ExtensionObject, LocalizedText,
    Matrix, Nested, NodeId, NodeIdValue, QualifiedName, Scalar, StatusCode, Variant,
};

use super::WrongValue;
use crate::field_value::{JsonFieldValue, JsonStatus};
use crate::iso_time;
use crate::node_ids::{OwnedNodeId, parse_guid};
use crate::structures::JsonStructure;

type Written = Result<(), WrongValue>;

/// Returns the bytes of a Variant.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn variant_bytes(json: &JsonFieldValue) -> Result<Vec<u8>, WrongValue> {
    let quality = json.status.is_some()
        || json.source_timestamp.is_some()
        || json.source_picoseconds.is_some()
        || json.server_timestamp.is_some()
        || json.server_picoseconds.is_some();
    if quality {
        let what = "Status and timestamps belong to a DataValue, not to a Variant";
        return Err(WrongValue::new(what));
    }
    let mut out = Vec::new();
    write_variant(json, &mut out)?;
    Ok(out)
}

/// Returns the bytes of a DataValue.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn data_value_bytes(json: &JsonFieldValue) -> Result<Vec<u8>, WrongValue> {
    let mut out = Vec::new();
    write_data_value(json, &mut out)?;
    Ok(out)
}

/// Appends a value without its type.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn write_scalar(builtin: BuiltinType, json: &Value, out: &mut Vec<u8>) -> Written {
    match builtin {
        BuiltinType::Boolean => append(out, Scalar::Boolean(boolean(json)?)),
        BuiltinType::SByte => append(out, Scalar::SByte(integer(builtin, json)?)),
        BuiltinType::Byte => append(out, Scalar::Byte(integer(builtin, json)?)),
        BuiltinType::Int16 => append(out, Scalar::Int16(integer(builtin, json)?)),
        BuiltinType::UInt16 => append(out, Scalar::UInt16(integer(builtin, json)?)),
        BuiltinType::Int32 => append(out, Scalar::Int32(integer(builtin, json)?)),
        BuiltinType::UInt32 => append(out, Scalar::UInt32(integer(builtin, json)?)),
        BuiltinType::Int64 => append(out, Scalar::Int64(integer(builtin, json)?)),
        BuiltinType::UInt64 => append(out, Scalar::UInt64(integer(builtin, json)?)),
        BuiltinType::Float => append(out, Scalar::Float(float(json)?)),
        BuiltinType::Double => append(out, Scalar::Double(double(json)?)),
        BuiltinType::String => append(out, Scalar::String(text(json)?)),
        BuiltinType::XmlElement => append(out, Scalar::XmlElement(text(json)?)),
        BuiltinType::DateTime => append(out, Scalar::DateTime(date_time(json)?)),
        BuiltinType::Guid => append(out, Scalar::Guid(parsed("a Guid", json, parse_guid)?)),
        BuiltinType::ByteString => append(out, Scalar::ByteString(byte_string(json)?.as_deref())),
        BuiltinType::NodeId => {
            let node_id = parsed("a NodeId", json, OwnedNodeId::parse)?;
            let plain = node_id.node_id();
            let plain = plain.ok_or_else(|| WrongValue::expected("a plain NodeId", json))?;
            append(out, Scalar::NodeId(plain))
        }
        BuiltinType::ExpandedNodeId => {
            let node_id = parsed("an ExpandedNodeId", json, OwnedNodeId::parse)?;
            append(out, Scalar::ExpandedNodeId(node_id.expanded()))
        }
        BuiltinType::StatusCode => append(out, Scalar::StatusCode(status_code(json)?)),
        BuiltinType::QualifiedName => append(out, Scalar::QualifiedName(qualified_name(json)?)),
        BuiltinType::LocalizedText => append(out, Scalar::LocalizedText(localized_text(json)?)),
        BuiltinType::ExtensionObject => write_extension_object(json, out),
        BuiltinType::DataValue => write_data_value(&field_value(json)?, out),
        BuiltinType::Variant => write_variant(&field_value(json)?, out),
        BuiltinType::DiagnosticInfo => write_diagnostic_info(json, out),
    }
}

fn write_variant(json: &JsonFieldValue, out: &mut Vec<u8>) -> Written {
    let value = json.value.as_ref().unwrap_or(&Value::Null);
    let builtin = match json.ua_type {
        None | Some(0) if value.is_null() => {
            out.push(0);
            return Ok(());
        }
        None | Some(0) => return Err(WrongValue::new("a Value needs its UaType")),
        Some(id) => BuiltinType::from_id(id)
            .ok_or_else(|| WrongValue::new(format!("unknown UaType {id}: expected 0 to 25")))?,
    };
    if let Some(elements) = value.as_array() {
        return write_array(builtin, elements, json, out);
    }
    if json.null_array && value.is_null() {
        return write_array(builtin, &[], json, out);
    }
    // A Variant directly in a Variant has no encoding.
    if json.dimensions.is_some() || builtin == BuiltinType::Variant {
        return Err(WrongValue::expected("an array", value).at(".Value"));
    }
    out.push(builtin.id());
    write_scalar(builtin, value, out).map_err(|wrong| wrong.at(".Value"))
}

fn write_array(
    builtin: BuiltinType,
    elements: &[Value],
    json: &JsonFieldValue,
    out: &mut Vec<u8>,
) -> Written {
    let mut bytes = Vec::new();
    for (element, at) in elements.iter().zip(0..) {
        write_scalar(builtin, element, &mut bytes)
            .map_err(|wrong| wrong.at(&format!(".Value[{at}]")))?;
    }
    let array = match json.null_array {
        true if elements.is_empty() => Array::null(builtin),
        true => return Err(WrongValue::new("a null array with elements")),
        false => Array::new(builtin, elements.len(), &bytes)?,
    };
    let mut buffer = Vec::new();
    let encoded = match &json.dimensions {
        None => Nested::variant(&Variant::Array(array), &mut buffer)?,
        Some(dimensions) => {
            let dimensions: Vec<_> = dimensions.iter().map(|size| size.to_le_bytes()).collect();
            let matrix = Matrix::new(array, &dimensions);
            let matrix = matrix.map_err(|wrong| WrongValue::from(wrong).at(".Dimensions"))?;
            Nested::variant(&Variant::Matrix(matrix), &mut buffer)?
        }
    };
    out.extend_from_slice(encoded.bytes());
    Ok(())
}

fn write_data_value(json: &JsonFieldValue, out: &mut Vec<u8>) -> Written {
    let mut variant = Vec::new();
    if json.ua_type.is_some() || json.value.is_some() {
        write_variant(json, &mut variant)?;
    }
    let value = if variant.is_empty() {
        None
    } else {
        Some(Nested::<Variant<'_>>::new(&variant)?.get()?)
    };
    let time = |text: &Option<String>, key: &str| match text.as_deref() {
        None => Ok(None),
        Some(text) => match iso_time::parse(text) {
            Some(time) => Ok(Some(time)),
            None => Err(WrongValue::expected(A_TIME, &text.into()).at(key)),
        },
    };
    let data_value = DataValue {
        value,
        status: json.status.as_ref().map(|status| StatusCode(status.code)),
        source_timestamp: time(&json.source_timestamp, ".SourceTimestamp")?,
        source_picoseconds: json.source_picoseconds,
        server_timestamp: time(&json.server_timestamp, ".ServerTimestamp")?,
        server_picoseconds: json.server_picoseconds,
    };
    let mut buffer = Vec::new();
    out.extend_from_slice(Nested::data_value(&data_value, &mut buffer)?.bytes());
    Ok(())
}

/// Appends a known structure, in the form with fields or with bytes, or the bytes of any other
/// structure.
fn write_extension_object(json: &Value, out: &mut Vec<u8>) -> Written {
    if json.is_null() {
        let null = ExtensionObject {
            type_id: NodeId::NULL,
            body: ExtensionBody::None,
        };
        return append(out, Scalar::ExtensionObject(null));
    }
    let wrong = || WrongValue::expected("a structure", json);
    let object = json.as_object().ok_or_else(wrong)?;
    if let Some(structure) = decoded_structure(object) {
        let mut body = Vec::new();
        structure.write(object, &mut body)?;
        let object = ExtensionObject {
            type_id: NodeId::numeric(0, structure.encoding),
            body: ExtensionBody::Binary(&body),
        };
        return append(out, Scalar::ExtensionObject(object));
    }
    let (type_id, encoding, body) = if object.contains_key("BodyBase64") {
        check_keys(object, &["TypeId", "BodyBase64"])?;
        ("TypeId", 1, "BodyBase64")
    } else {
        check_keys(object, &["UaTypeId", "UaEncoding", "UaBody"])?;
        let encoding = object.get("UaEncoding").unwrap_or(&Value::Null);
        let encoding = integer(BuiltinType::Byte, encoding).map_err(|wrong| {
            let hint = "an unknown structure needs UaEncoding and UaBody";
            WrongValue::new(format!("{hint}: {}", wrong.what))
        })?;
        ("UaTypeId", encoding, "UaBody")
    };
    let node_id = parsed(
        "a NodeId",
        object.get(type_id).unwrap_or(&Value::Null),
        OwnedNodeId::parse,
    )?;
    let plain = node_id
        .node_id()
        .ok_or_else(|| WrongValue::new("expected a plain NodeId"))?;
    write_body(
        plain,
        encoding,
        object.get(body).unwrap_or(&Value::Null),
        out,
    )
}

fn write_body(type_id: NodeId<'_>, encoding: u8, body: &Value, out: &mut Vec<u8>) -> Written {
    let bytes;
    let body = match (encoding, body) {
        (0, Value::Null) => ExtensionBody::None,
        (1, Value::String(text)) => {
            // open62541 1.5 writes the bytes themselves as text, which is rarely valid base64.
            bytes = BASE64
                .decode(text)
                .unwrap_or_else(|_| text.clone().into_bytes());
            ExtensionBody::Binary(&bytes)
        }
        (2, Value::String(text)) => ExtensionBody::Xml(text),
        (0..=2, other) => return Err(WrongValue::expected("the body as text", other)),
        _ => return Err(WrongValue::new("expected UaEncoding 0, 1 or 2")),
    };
    append(
        out,
        Scalar::ExtensionObject(ExtensionObject { type_id, body }),
    )
}

fn decoded_structure(object: &Map<String, Value>) -> Option<&'static JsonStructure> {
    if object.contains_key("UaEncoding") {
        return None;
    }
    structure_named(object.get("UaTypeId")?.as_str()?)
}

/// Returns the known structure with this NodeId of its DataType.
fn structure_named(data_type: &str) -> Option<&'static JsonStructure> {
    match OwnedNodeId::parse(data_type)?.node_id()? {
        NodeId {
            namespace: 0,
            identifier: NodeIdValue::Numeric(id),
        } => JsonStructure::by_data_type(id),
        _ => None,
    }
}

fn write_diagnostic_info(json: &Value, out: &mut Vec<u8>) -> Written {
    let object = json
        .as_object()
        .ok_or_else(|| WrongValue::expected("a DiagnosticInfo", json))?;
    const INNER: &str = "InnerDiagnosticInfo";
    let indexes = ["SymbolicId", "NamespaceUri", "Locale", "LocalizedText"];
    let others = ["AdditionalInfo", "InnerStatusCode", INNER];
    check_keys(object, &[&indexes[..], &others[..]].concat())?;
    let [symbolic_id, namespace_uri, locale, localized_text] = indexes.map(|key| {
        object
            .get(key)
            .map(|json| integer(BuiltinType::Int32, json))
    });
    let mut inner = Vec::new();
    if let Some(json) = object.get(INNER) {
        write_diagnostic_info(json, &mut inner)?;
    }
    let info = DiagnosticInfo {
        symbolic_id: symbolic_id.transpose()?,
        namespace_uri: namespace_uri.transpose()?,
        locale: locale.transpose()?,
        localized_text: localized_text.transpose()?,
        additional_info: object.get("AdditionalInfo").map(text).transpose()?,
        inner_status_code: object.get("InnerStatusCode").map(status_code).transpose()?,
        inner: if inner.is_empty() {
            None
        } else {
            Some(Nested::new(&inner)?)
        },
    };
    let mut buffer = Vec::new();
    out.extend_from_slice(Nested::diagnostic_info(&info, &mut buffer)?.bytes());
    Ok(())
}

/// Appends a value as it is encoded after the encoding byte of a Variant.
fn append(out: &mut Vec<u8>, scalar: Scalar<'_>) -> Written {
    let mut buffer = Vec::new();
    let variant = Nested::variant(&Variant::Scalar(scalar), &mut buffer)?;
    out.extend_from_slice(variant.bytes().get(1..).unwrap_or_default());
    Ok(())
}

fn boolean(json: &Value) -> Result<bool, WrongValue> {
    json.as_bool()
        .ok_or_else(|| WrongValue::expected("true or false", json))
}

/// Parses a number, given as a number or as text.
fn integer<T: TryFrom<i128>>(builtin: BuiltinType, json: &Value) -> Result<T, WrongValue> {
    let text = json.as_str().and_then(|text| text.parse().ok());
    let signed = json.as_i64().map(i128::from);
    let number = text.or(signed).or_else(|| json.as_u64().map(i128::from));
    number
        .and_then(|number| T::try_from(number).ok())
        .ok_or_else(|| WrongValue::expected(builtin.name(), json))
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "a Float is what is wanted of the number; beyond its range it is infinite, and refused"
)]
fn float(json: &Value) -> Result<f32, WrongValue> {
    let wanted = double(json)?;
    let float = wanted as f32;
    if float.is_infinite() && wanted.is_finite() {
        return Err(WrongValue::expected("a Float", json));
    }
    Ok(if wanted.is_nan() { NAN_FLOAT } else { float })
}

fn double(json: &Value) -> Result<f64, WrongValue> {
    let named = match json.as_str() {
        Some("NaN") => Some(NAN_DOUBLE),
        Some("Infinity") => Some(f64::INFINITY),
        Some("-Infinity") => Some(f64::NEG_INFINITY),
        _ => json.as_f64(),
    };
    named.ok_or_else(|| WrongValue::expected("a number", json))
}

fn text(json: &Value) -> Result<Option<&str>, WrongValue> {
    match json.as_str() {
        None if !json.is_null() => Err(WrongValue::expected("a text or null", json)),
        text => Ok(text),
    }
}

fn byte_string(json: &Value) -> Result<Option<Vec<u8>>, WrongValue> {
    match text(json)? {
        None => Ok(None),
        Some(base64) => match BASE64.decode(base64) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(_) => Err(WrongValue::expected("base64", json)),
        },
    }
}

fn date_time(json: &Value) -> Result<uadp::DateTime, WrongValue> {
    parsed(A_TIME, json, iso_time::parse)
}

fn parsed<T>(
    what: &str,
    json: &Value,
    parse: impl FnOnce(&str) -> Option<T>,
) -> Result<T, WrongValue> {
    json.as_str()
        .and_then(parse)
        .ok_or_else(|| WrongValue::expected(what, json))
}

fn status_code(json: &Value) -> Result<StatusCode, WrongValue> {
    if let Some(code) = json.as_u64() {
        return match u32::try_from(code) {
            Ok(code) => Ok(StatusCode(code)),
            Err(_) => Err(WrongValue::expected("a StatusCode", json)),
        };
    }
    let status =
        JsonStatus::deserialize(json).map_err(|_| WrongValue::expected("{\"Code\": ...}", json))?;
    Ok(StatusCode(status.code))
}

/// Parses `7:Speed`, a name without a number for namespace 0, or an object.
fn qualified_name(json: &Value) -> Result<QualifiedName<'_>, WrongValue> {
    let wrong = || WrongValue::expected("a QualifiedName such as \"7:Speed\"", json);
    if let Some(text) = json.as_str() {
        let numbered = text.split_once(':').filter(|(namespace, _)| {
            !namespace.is_empty() && namespace.bytes().all(|byte| byte.is_ascii_digit())
        });
        let (namespace, name) = numbered.unwrap_or(("0", text));
        return Ok(QualifiedName {
            namespace: namespace.parse().map_err(|_| wrong())?,
            name: Some(name),
        });
    }
    let object = json.as_object().ok_or_else(wrong)?;
    check_keys(object, &["NamespaceIndex", "Name"])?;
    let namespace = object.get("NamespaceIndex");
    let namespace = namespace.map(|index| integer(BuiltinType::UInt16, index));
    Ok(QualifiedName {
        namespace: namespace.transpose()?.unwrap_or_default(),
        name: text(object.get("Name").unwrap_or(&Value::Null))?,
    })
}

fn localized_text(json: &Value) -> Result<LocalizedText<'_>, WrongValue> {
    let object = json
        .as_object()
        .ok_or_else(|| WrongValue::expected("{\"Locale\": ..., \"Text\": ...}", json))?;
    check_keys(object, &["Locale", "Text"])?;
    let part = |key| text(object.get(key).unwrap_or(&Value::Null));
    Ok(LocalizedText {
        locale: part("Locale")?,
        text: part("Text")?,
    })
}

fn field_value(json: &Value) -> Result<JsonFieldValue, WrongValue> {
    JsonFieldValue::deserialize(json).map_err(|error| WrongValue::new(error.to_string()))
}

fn check_keys(object: &Map<String, Value>, known: &[&str]) -> Written {
    match object.keys().find(|key| !known.contains(&key.as_str())) {
        None => Ok(()),
        Some(key) => Err(WrongValue::new(format!(
            "unknown key `{key}`, expected {}",
            known.join(", ")
        ))),
    }
}

const A_TIME: &str = "a time like \"2026-05-17T12:34:56.789Z\"";
/// The NaNs of the examples in OPC 10000-6, 5.2.2.3, which open62541 writes too: the sign bit is
/// set.
const NAN_DOUBLE: f64 = f64::from_bits(0xFFF8_0000_0000_0000);
const NAN_FLOAT: f32 = f32::from_bits(0xFFC0_0000);
