//! Values in the JSON of a recording as fields with their announced types.

use serde_json::{Map, Value, json};
use uadp::{BuiltinType, DataSetHeader, DataValue, Fields, NetworkMessageEncoder, StatusCode};
use uadp::{EncodeError, Variant};

use super::unusable::UnusableValue;
use crate::live::channels::DELTA;
use crate::live::described::AnnouncedField;
use crate::live::plain;
use crate::values::{JsonFieldValue, variant_bytes};

/// Writes the fields of a value into a message. A value has a name for each field, and
/// `NAME.status` for the quality of a field that is not Good.
///
/// # Errors
/// [`UnusableValue`]; discard the message in this case.
pub(super) fn write(
    data: &[u8],
    fields: &[AnnouncedField],
    (header, writer): (&DataSetHeader, &mut NetworkMessageEncoder<'_>),
) -> Result<(), UnusableValue> {
    let named: Map<String, Value> =
        serde_json::from_slice(data).map_err(|_| UnusableValue::Mismatch)?;
    let is_delta = named.get(DELTA) == Some(&Value::Bool(true));
    let mut block = Vec::new();
    let mut given = Vec::new();
    let mut keys = usize::from(is_delta);
    for (field, index) in fields.iter().zip(0_u16..) {
        let name = plain::name(fields, index.into());
        let value = named.get(&name);
        let status = named.get(&format!("{name}.status"));
        if is_delta && value.is_none() && status.is_none() {
            continue;
        }
        keys += usize::from(value.is_some()) + usize::from(status.is_some());
        match (value.unwrap_or(&Value::Null), status) {
            // A field without a value has the quality alone.
            (Value::Null, Some(_)) => block.push(0),
            (value, _) => block.extend(variant(field, value)?),
        }
        given.push((index, status.map(quality).transpose()?));
    }
    // Further names are of another description.
    if keys != named.len() {
        return Err(UnusableValue::Mismatch);
    }
    let count = u16::try_from(given.len()).map_err(|_| UnusableValue::Mismatch)?;
    let block = [&count.to_le_bytes()[..], &block].concat();
    let values = Fields::parse(&block).map_err(|_| UnusableValue::Mismatch)?;
    let values: Result<Vec<_>, _> = values.collect();
    let values = values.map_err(|_| UnusableValue::Mismatch)?;
    let each = || given.iter().copied().zip(&values);
    let written = match (is_delta, given.iter().any(|(_, status)| status.is_some())) {
        (false, false) => writer.key_frame(header).and_then(|mut frame| {
            frame.fields_block(&block)?;
            frame.finish()
        }),
        (true, false) => writer.delta_frame(header).and_then(|mut frame| {
            for ((index, _), value) in each() {
                frame.field(index)?.variant(value)?;
            }
            frame.finish()
        }),
        (is_delta, true) => data_values((header, writer), is_delta, each()),
    };
    written.map_err(|_| UnusableValue::Mismatch)
}

/// Writes values with their quality.
fn data_values<'a>(
    (header, writer): (&DataSetHeader, &mut NetworkMessageEncoder<'_>),
    is_delta: bool,
    values: impl Iterator<Item = ((u16, Option<StatusCode>), &'a Variant<'a>)>,
) -> Result<(), EncodeError> {
    let mut frame = if is_delta {
        writer.delta_data_values(header)?
    } else {
        writer.data_values(header)?
    };
    for ((index, status), value) in values {
        let value = DataValue {
            value: Some(*value).filter(|value| *value != Variant::Null),
            status,
            ..DataValue::default()
        };
        if is_delta {
            frame.changed(index, &value)?
        } else {
            frame.value(&value)?
        }
    }
    frame.finish()
}

/// Returns the Variant of a field.
fn variant(field: &AnnouncedField, value: &Value) -> Result<Vec<u8>, UnusableValue> {
    let is_typed = field.structure.is_none() && field.builtin != Some(BuiltinType::Variant);
    let builtin = field.builtin.filter(|_| is_typed || value.is_null());
    let builtin = builtin.ok_or(UnusableValue::Untyped)?;
    let mut dimensions = None;
    let value = match (value, field.rank) {
        (Value::Array(_), 2..) => {
            let (flat, sizes) = flat(value);
            dimensions = Some(sizes);
            flat
        }
        (value, _) => value.clone(),
    };
    let value = match value {
        Value::Array(all) => all.into_iter().map(|one| typed(builtin, one)).collect(),
        one @ (Value::Null
        | Value::Bool(_)
        | Value::Number(_)
        | Value::String(_)
        | Value::Object(_)) => typed(builtin, one),
    };
    // A null text differs from no value.
    let is_text = matches!(
        builtin,
        BuiltinType::String | BuiltinType::ByteString | BuiltinType::XmlElement
    );
    let shown = JsonFieldValue {
        ua_type: (!value.is_null() || is_text && !field.is_array()).then_some(builtin.id()),
        value: Some(value),
        dimensions,
        ..JsonFieldValue::default()
    };
    variant_bytes(&shown).map_err(|_| UnusableValue::Mismatch)
}

/// Returns a single value in the form with which it is encoded.
fn typed(builtin: BuiltinType, value: Value) -> Value {
    match (builtin, value) {
        // The recording has no locales.
        (BuiltinType::LocalizedText, Value::String(text)) => json!({"Text": text}),
        (_, value) => value,
    }
}

/// Returns the elements of nested arrays in order, and the sizes of the arrays.
fn flat(nested: &Value) -> (Value, Vec<u32>) {
    let mut sizes = Vec::new();
    let mut level: Vec<&Value> = vec![nested];
    while let Some(Value::Array(first)) = level.first() {
        sizes.push(u32::try_from(first.len()).unwrap_or(u32::MAX));
        let next = level.iter().filter_map(|all| all.as_array());
        level = next.flatten().collect();
    }
    (level.into_iter().cloned().collect(), sizes)
}

/// Reads a StatusCode.
fn quality(shown: &Value) -> Result<StatusCode, UnusableValue> {
    let code = shown.as_u64().or_else(|| shown.get("Code")?.as_u64());
    let code = code.and_then(|code| u32::try_from(code).ok());
    code.map(StatusCode).ok_or(UnusableValue::Mismatch)
}
