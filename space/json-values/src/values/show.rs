//! Converts values to JSON.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::{Map, Value, json};
use uadp::{
    Array, DataValue, DecodeError, DiagnosticInfo, ExtensionBody, ExtensionObject, NodeId,
    NodeIdValue, QualifiedName, Scalar, StatusCode, Variant,
};

use crate::field_value::{JsonFieldValue, JsonStatus};
use crate::structures::JsonStructure;
use crate::{iso_time, node_ids, status};

/// Shows a Variant with its type.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn show_variant(variant: &Variant<'_>) -> Result<JsonFieldValue, DecodeError> {
    let mut shown = JsonFieldValue {
        ua_type: variant.builtin_type().map(uadp::BuiltinType::id),
        ..JsonFieldValue::default()
    };
    match variant {
        Variant::Null => {}
        Variant::Scalar(scalar) => shown.value = Some(show_scalar(*scalar)?),
        Variant::Array(array) => {
            shown.value = Some(show_elements(*array)?);
            shown.null_array = array.is_null();
        }
        Variant::Matrix(matrix) => {
            shown.value = Some(show_elements(matrix.elements())?);
            shown.null_array = matrix.elements().is_null();
            shown.dimensions = Some(matrix.dimensions().collect());
        }
    }
    Ok(shown)
}

/// Shows a DataValue; a null Variant has the UaType 0.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn show_data_value(data_value: &DataValue<'_>) -> Result<JsonFieldValue, DecodeError> {
    let value = match &data_value.value {
        None => JsonFieldValue::default(),
        Some(Variant::Null) => JsonFieldValue {
            ua_type: Some(0),
            ..JsonFieldValue::default()
        },
        Some(variant) => show_variant(variant)?,
    };
    Ok(JsonFieldValue {
        status: data_value.status.map(show_status),
        source_timestamp: data_value.source_timestamp.map(iso_time::of_date_time),
        source_picoseconds: data_value.source_picoseconds,
        server_timestamp: data_value.server_timestamp.map(iso_time::of_date_time),
        server_picoseconds: data_value.server_picoseconds,
        ..value
    })
}

/// Shows a value without its type.
///
/// # Errors
/// The value cannot be decoded or encoded.
pub fn show_scalar(scalar: Scalar<'_>) -> Result<Value, DecodeError> {
    Ok(match scalar {
        Scalar::Boolean(value) => json!(value),
        Scalar::SByte(value) => json!(value),
        Scalar::Byte(value) => json!(value),
        Scalar::Int16(value) => json!(value),
        Scalar::UInt16(value) => json!(value),
        Scalar::Int32(value) => json!(value),
        Scalar::UInt32(value) => json!(value),
        Scalar::Int64(value) => json!(value.to_string()),
        Scalar::UInt64(value) => json!(value.to_string()),
        Scalar::Float(value) => show_float(value),
        Scalar::Double(value) => show_double(value),
        Scalar::String(value) | Scalar::XmlElement(value) => json!(value),
        Scalar::DateTime(value) => json!(iso_time::of_date_time(value)),
        Scalar::Guid(value) => json!(value.to_string()),
        Scalar::ByteString(value) => json!(value.map(|bytes| BASE64.encode(bytes))),
        Scalar::NodeId(value) => json!(node_ids::text(value)),
        Scalar::ExpandedNodeId(value) => json!(node_ids::expanded_text(value)),
        Scalar::StatusCode(value) => object(show_status(value)),
        Scalar::QualifiedName(value) => show_qualified_name(value),
        Scalar::LocalizedText(value) => json!({ "Locale": value.locale, "Text": value.text }),
        Scalar::ExtensionObject(value) => show_extension_object(value),
        Scalar::DataValue(value) => object(show_data_value(&value.get()?)?),
        Scalar::Variant(value) => object(show_variant(&value.get()?)?),
        Scalar::DiagnosticInfo(value) => show_diagnostic_info(value.get()?)?,
    })
}

fn show_elements(array: Array<'_>) -> Result<Value, DecodeError> {
    array.iter().map(show_scalar).collect()
}

/// Returns the shortest decimal that parses as the same Float.
fn show_float(value: f32) -> Value {
    match value.to_string().parse::<f64>() {
        Ok(double) => show_double(double),
        Err(_) => show_double(value.into()),
    }
}

fn show_double(value: f64) -> Value {
    match value {
        f64::INFINITY => json!("Infinity"),
        f64::NEG_INFINITY => json!("-Infinity"),
        value if value.is_nan() => json!("NaN"),
        value => json!(value),
    }
}

fn show_status(status: StatusCode) -> JsonStatus {
    JsonStatus {
        code: status.0,
        symbol: status::symbol(status).map(str::to_owned),
    }
}

fn show_qualified_name(name: QualifiedName<'_>) -> Value {
    match name.name {
        Some(text) => json!(format!("{}:{text}", name.namespace)),
        None => json!({ "NamespaceIndex": name.namespace, "Name": null }),
    }
}

/// Shows a known structure by the NodeId of its type and its fields, any other structure by the
/// NodeId of its encoding and its body.
fn show_extension_object(object: ExtensionObject<'_>) -> Value {
    let type_id = node_ids::text(object.type_id);
    match object.body {
        ExtensionBody::None if object.type_id == NodeId::NULL => Value::Null,
        ExtensionBody::None => json!({ "UaTypeId": type_id, "UaEncoding": 0 }),
        ExtensionBody::Xml(body) => {
            json!({ "UaTypeId": type_id, "UaEncoding": 2, "UaBody": body })
        }
        ExtensionBody::Binary(body) => match known(object.type_id).and_then(|s| s.show(body)) {
            Some(fields) => fields.into(),
            None => {
                json!({ "UaTypeId": type_id, "UaEncoding": 1, "UaBody": BASE64.encode(body) })
            }
        },
    }
}

fn known(encoding: NodeId<'_>) -> Option<&'static JsonStructure> {
    match encoding {
        NodeId {
            namespace: 0,
            identifier: NodeIdValue::Numeric(id),
        } => JsonStructure::by_encoding(id),
        _ => None,
    }
}

fn show_diagnostic_info(info: DiagnosticInfo<'_>) -> Result<Value, DecodeError> {
    let mut shown = Map::new();
    let indexes = [
        ("SymbolicId", info.symbolic_id),
        ("NamespaceUri", info.namespace_uri),
        ("Locale", info.locale),
        ("LocalizedText", info.localized_text),
    ];
    for (name, index) in indexes {
        if let Some(index) = index {
            shown.insert(name.to_owned(), index.into());
        }
    }
    if let Some(text) = info.additional_info {
        shown.insert("AdditionalInfo".to_owned(), json!(text));
    }
    if let Some(status) = info.inner_status_code {
        shown.insert("InnerStatusCode".to_owned(), object(show_status(status)));
    }
    if let Some(inner) = info.inner {
        let inner = show_diagnostic_info(inner.get()?)?;
        shown.insert("InnerDiagnosticInfo".to_owned(), inner);
    }
    Ok(shown.into())
}

/// Converts a shape to JSON. The shapes used here have text keys only, so this does not fail.
fn object(shape: impl serde::Serialize) -> Value {
    serde_json::to_value(shape).unwrap_or_default()
}
