//! Formats values for people: plain JSON, and YAML line by line.

use serde::ser::{Serialize, SerializeMap as _, Serializer};
use serde_json::{Value, json};
use uadp::{DataSetMessage, DecodeError, FieldEncoding, Scalar, Variant};

use super::described::{AnnouncedDescription, AnnouncedField};
use super::scalars::{elements, scalar};
use super::text::harmless;
use crate::arguments::RawReading;
use crate::raw_data::RawDataLayout;
use crate::shape::FieldMetaData;
use crate::values::show_scalar;

/// Named values in order.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct NamedValues(pub(crate) Vec<(String, Value)>);

impl NamedValues {
    pub(crate) fn get(&self, name: &str) -> Option<&Value> {
        let found = self.0.iter().find(|(known, _)| known == name);
        found.map(|(_, value)| value)
    }

    pub(crate) fn text(&self, name: &str) -> Option<&str> {
        self.get(name)?.as_str()
    }

    pub(crate) fn number(&self, name: &str) -> Option<u64> {
        self.get(name)?.as_u64()
    }

    /// Renames values that were received before their names.
    pub(crate) fn rename(&mut self, fields: &[AnnouncedField]) {
        for (known, _) in &mut self.0 {
            let (number, rest) = known.split_once('.').unwrap_or((known, ""));
            let number = number
                .strip_prefix(UNNAMED)
                .and_then(|number| number.parse::<usize>().ok());
            if let Some(at) = number.and_then(|number| number.checked_sub(1)) {
                let dot = if rest.is_empty() { "" } else { "." };
                *known = format!("{}{dot}{rest}", name(fields, at));
            }
        }
    }

    /// Returns YAML, one value per line.
    pub(crate) fn yaml(&self) -> String {
        let mut text = String::new();
        for (name, value) in &self.0 {
            let plain = |c: char| c.is_alphanumeric() || matches!(c, '_' | '.' | '-' | '[' | ']');
            let name = if !name.is_empty() && name.chars().all(plain) {
                name.clone()
            } else {
                json!(name).to_string()
            };
            text.push_str(&harmless(&format!("{name}: {value}")));
            text.push('\n');
        }
        text
    }
}

impl Serialize for NamedValues {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, value) in &self.0 {
            map.serialize_entry(name, value)?;
        }
        map.end()
    }
}

/// Returns the fields of a message by their announced names, or as `field_1` and so on without an
/// announcement.
///
/// # Errors
/// [`DecodeError`] if the message is malformed, [`DecodeError::Misread`] for RawData without an
/// announcement.
pub(crate) fn message(
    message: &DataSetMessage<'_>,
    described: Option<&AnnouncedDescription>,
) -> Result<NamedValues, DecodeError> {
    let fields = described.map_or(&[][..], AnnouncedDescription::fields);
    if message.encoding() == FieldEncoding::RawData {
        return raw(message.payload(), fields);
    }
    let mut named = NamedValues::default();
    for value in message.values()? {
        let value = value?;
        let (index, status) = (value.index, value.value.status);
        if value.is_filler() {
            continue;
        }
        let shown = value
            .value
            .value
            .as_ref()
            .map_or(Ok(Value::Null), |value| field(value, fields, index.into()))?;
        let name = name(fields, index.into());
        if let Some(status) = status.filter(|status| status.0 != 0) {
            named.0.push((
                format!("{name}.status"),
                show_scalar(Scalar::StatusCode(status))?,
            ));
        }
        named.0.push((name, shown));
    }
    Ok(named)
}

/// Returns the fields of a response.
///
/// # Errors
/// See [`message`].
pub(crate) fn response(
    fields: uadp::action::ActionFields<'_>,
    described: &[AnnouncedField],
) -> Result<NamedValues, DecodeError> {
    if let uadp::action::ActionFields::RawData { payload, .. } = fields {
        return raw(payload, described);
    }
    let mut named = NamedValues::default();
    for (value, index) in fields.variants()?.zip(0..) {
        let shown = field(&value?, described, index)?;
        named.0.push((name(described, index), shown));
    }
    Ok(named)
}

/// Returns the value of the field with this index; messages in it have the announced names of their
/// fields.
fn field(
    value: &Variant<'_>,
    fields: &[AnnouncedField],
    index: usize,
) -> Result<Value, DecodeError> {
    let Some(structure) = fields.get(index).and_then(|field| field.structure.as_ref()) else {
        return variant(value);
    };
    let one = |value| match structure.show(value)? {
        Some(shown) => Ok(shown),
        None => scalar(value),
    };
    match value {
        Variant::Scalar(value) => one(*value),
        Variant::Array(array) => array.iter().map(one).collect(),
        Variant::Null | Variant::Matrix(_) => variant(value),
    }
}

/// Returns the announced name of a field, or `field_1` and so on.
pub(crate) fn name(fields: &[AnnouncedField], index: usize) -> String {
    match fields.get(index) {
        Some(field) if !field.name.is_empty() => field.name.clone(),
        Some(_) | None => format!("{UNNAMED}{}", index + 1),
    }
}

/// The prefix of the number of an unnamed field.
const UNNAMED: &str = "field_";

fn raw(payload: &[u8], fields: &[AnnouncedField]) -> Result<NamedValues, DecodeError> {
    const UNKNOWN: DecodeError = DecodeError::Misread("RawData, whose fields are not announced");
    if fields.is_empty() {
        return Err(UNKNOWN);
    }
    let metadata: Vec<FieldMetaData> = fields.iter().map(metadata).collect();
    let layout = RawDataLayout::new(&metadata, RawReading::Standard).map_err(|_| UNKNOWN)?;
    let mut named = NamedValues::default();
    let read = layout.read(payload, |field| {
        let name = name(fields, named.0.len());
        named.0.push((name, field.value.value.unwrap_or_default()));
    });
    match read {
        Ok(()) => Ok(named),
        Err(_) => Err(DecodeError::Misread(
            "RawData that is not what was announced",
        )),
    }
}

fn metadata(field: &AnnouncedField) -> FieldMetaData {
    FieldMetaData {
        name: None,
        built_in_type: field.builtin.map_or(0, uadp::BuiltinType::id),
        data_type: None,
        value_rank: field.rank,
        array_dimensions: field.dimensions.clone(),
        max_string_length: field.max_string_length,
    }
}

/// Returns a value without its type. 64-bit numbers are JSON numbers here; `decode` shows them as
/// text.
///
/// # Errors
/// [`DecodeError`] if the value is malformed.
pub(crate) fn variant(value: &Variant<'_>) -> Result<Value, DecodeError> {
    match value {
        Variant::Null => Ok(Value::Null),
        Variant::Scalar(value) => scalar(*value),
        Variant::Array(array) => elements(*array),
        Variant::Matrix(matrix) => {
            let dimensions: Vec<u32> = matrix.dimensions().collect();
            Ok(nested(elements(matrix.elements())?, &dimensions))
        }
    }
}

/// Nests a flat array by its dimensions, the innermost dimension last.
fn nested(mut flat: Value, dimensions: &[u32]) -> Value {
    for size in dimensions.iter().skip(1).rev() {
        let size = usize::try_from(*size).unwrap_or(usize::MAX).max(1);
        if let Value::Array(all) = &flat {
            flat = all.chunks(size).map(|chunk| json!(chunk)).collect();
        }
    }
    flat
}

#[cfg(test)]
mod tests {
    use uadp::{Array, BuiltinType};

    use super::*;

    #[test]
    fn numbers_of_64_bit_are_numbers_and_matrices_are_nested() {
        let bytes: Vec<u8> = (0..6_i64).flat_map(i64::to_le_bytes).collect();
        let array = Array::new(BuiltinType::Int64, 6, &bytes).unwrap();
        let sizes = [2_u32.to_le_bytes(), 3_u32.to_le_bytes()];
        let matrix = uadp::Matrix::new(array, &sizes).unwrap();
        assert_eq!(
            variant(&matrix.into()).unwrap(),
            json!([[0, 1, 2], [3, 4, 5]])
        );
    }

    #[test]
    fn yaml_keeps_the_order_and_shows_control_characters_by_their_number() {
        let named = NamedValues(vec![
            ("linear.x".to_owned(), json!(0.5)),
            ("a b".to_owned(), json!("\u{1b}[2J\u{9b}2J")),
        ]);
        let wanted = "linear.x: 0.5\n\"a b\": \"\\u001b[2J\\u{9b}2J\"\n";
        assert_eq!(named.yaml(), wanted);
        let json = serde_json::to_string(&named).unwrap();
        assert!(json.starts_with("{\"linear.x\":0.5,"), "{json}");
    }
}
