//! Values of the space as text and numbers for the page.

use serde_json::{Value, json};
use uadp::{Array, DecodeError, ExtensionBody, Fields, NodeId, NodeIdValue, Scalar, Variant};

/// Returns the fields of a block in order with their `names`; a field without a name is `field_1`
/// and so on.
///
/// The result is bounded: long arrays and texts are cut, and end with `…`.
///
/// # Errors
/// Returns the reason if the block is malformed.
pub(crate) fn fields(block: &[u8], names: &[String]) -> Result<Vec<(String, Value)>, DecodeError> {
    let mut shown = Vec::new();
    let fields = Fields::parse(block)?;
    for (index, field) in fields.enumerate().take(MOST_FIELDS) {
        shown.push((name(names, index), variant(&field?)));
    }
    Ok(shown)
}

/// Returns the block in one line: the only value, or the first fields as `name: value`.
pub(crate) fn line(block: &[u8], names: &[String]) -> String {
    let Ok(shown) = fields(block, names) else {
        return "unreadable".to_owned();
    };
    let text = match shown.len() {
        0 => "–".to_owned(),
        1 => shown
            .first()
            .map(|(_, value)| short(value))
            .unwrap_or_default(),
        _ => {
            let each = shown.iter().take(LINE_FIELDS);
            let each: Vec<String> = each
                .map(|(name, value)| format!("{name} {}", short(value)))
                .collect();
            each.join("  ")
        }
    };
    cut(&text, LONGEST_LINE)
}

/// Returns the first number of a block, for a sparkline.
pub(crate) fn number(block: &[u8]) -> Option<f64> {
    let fields = Fields::parse(block).ok()?;
    for field in fields.take(NUMBER_FIELDS) {
        let found = match field.ok()? {
            Variant::Scalar(scalar) => number_of(&scalar),
            Variant::Array(array) => array.iter().next().as_ref().and_then(number_of),
            Variant::Matrix(_) | Variant::Null => None,
        };
        if found.is_some_and(f64::is_finite) {
            return found;
        }
    }
    None
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "all other types are no numbers"
)]
#[expect(clippy::cast_precision_loss, reason = "a number that is drawn")]
fn number_of(scalar: &Scalar<'_>) -> Option<f64> {
    Some(match scalar {
        Scalar::Boolean(value) => f64::from(u8::from(*value)),
        Scalar::SByte(value) => (*value).into(),
        Scalar::Byte(value) => (*value).into(),
        Scalar::Int16(value) => (*value).into(),
        Scalar::UInt16(value) => (*value).into(),
        Scalar::Int32(value) => (*value).into(),
        Scalar::UInt32(value) => (*value).into(),
        Scalar::Int64(value) => *value as f64,
        Scalar::UInt64(value) => *value as f64,
        Scalar::Float(value) => (*value).into(),
        Scalar::Double(value) => *value,
        _ => return None,
    })
}

/// Returns the name of the field at `index`.
pub(crate) fn name(names: &[String], index: usize) -> String {
    match names.get(index) {
        Some(name) if !name.is_empty() => name.clone(),
        Some(_) | None => format!("field_{}", index + 1),
    }
}

fn variant(value: &Variant<'_>) -> Value {
    match value {
        Variant::Null => Value::Null,
        Variant::Scalar(value) => scalar(value),
        Variant::Array(array) => elements(*array),
        Variant::Matrix(matrix) => elements(matrix.elements()),
    }
}

fn elements(array: Array<'_>) -> Value {
    let mut shown: Vec<Value> = array
        .iter()
        .take(MOST_ELEMENTS)
        .map(|element| scalar(&element))
        .collect();
    if array.len() > MOST_ELEMENTS {
        shown.push(json!(format!("… {} elements", array.len())));
    }
    Value::Array(shown)
}

fn scalar(value: &Scalar<'_>) -> Value {
    match value {
        Scalar::Boolean(value) => json!(value),
        Scalar::SByte(value) => json!(value),
        Scalar::Byte(value) => json!(value),
        Scalar::Int16(value) => json!(value),
        Scalar::UInt16(value) => json!(value),
        Scalar::Int32(value) => json!(value),
        Scalar::UInt32(value) => json!(value),
        Scalar::Int64(value) => json!(value),
        Scalar::UInt64(value) => json!(value),
        // The shortest decimal that parses as the same Float.
        Scalar::Float(value) => real(
            value
                .to_string()
                .parse()
                .unwrap_or_else(|_| (*value).into()),
        ),
        Scalar::Double(value) => real(*value),
        Scalar::String(value) | Scalar::XmlElement(value) => text(*value),
        Scalar::DateTime(value) => {
            let nanos = uadp::Timestamp::from(*value).unix_nanos();
            json!({ "ms": i64::try_from(nanos / 1_000_000).unwrap_or_default() })
        }
        Scalar::Guid(value) => json!(value.to_string()),
        Scalar::ByteString(value) => {
            let length = value.map_or(0, <[u8]>::len);
            json!(format!("{length} bytes"))
        }
        Scalar::NodeId(value) => json!(node_id(value)),
        Scalar::ExpandedNodeId(value) => json!(node_id(&value.node_id)),
        Scalar::StatusCode(value) => json!(format!("0x{:08X}", value.0)),
        Scalar::QualifiedName(value) => text(value.name),
        Scalar::LocalizedText(value) => text(value.text),
        Scalar::ExtensionObject(value) => match value.body {
            ExtensionBody::Binary(bytes) => {
                json!(format!(
                    "{}, {} bytes",
                    node_id(&value.type_id),
                    bytes.len()
                ))
            }
            ExtensionBody::Xml(_) | ExtensionBody::None => json!(node_id(&value.type_id)),
        },
        Scalar::DataValue(value) => {
            let inner = value.get().ok().and_then(|value| value.value);
            inner.as_ref().map_or(Value::Null, variant)
        }
        Scalar::Variant(value) => value.get().as_ref().map_or(Value::Null, variant),
        Scalar::DiagnosticInfo(_) => json!("DiagnosticInfo"),
    }
}

/// JSON has no infinities and no NaN; they are texts.
fn real(value: f64) -> Value {
    match serde_json::Number::from_f64(value) {
        Some(number) => Value::Number(number),
        None => json!(value.to_string()),
    }
}

fn text(value: Option<&str>) -> Value {
    value.map_or(Value::Null, |text| json!(cut(text, LONGEST_TEXT)))
}

fn node_id(id: &NodeId<'_>) -> String {
    let namespace = id.namespace;
    match &id.identifier {
        NodeIdValue::Numeric(number) => format!("ns={namespace};i={number}"),
        NodeIdValue::String(text) => format!("ns={namespace};s={}", text.unwrap_or_default()),
        NodeIdValue::Guid(guid) => format!("ns={namespace};g={guid}"),
        NodeIdValue::Opaque(_) => format!("ns={namespace};b=…"),
    }
}

/// Returns a value for a line: numbers with at most four decimals, texts without quotes.
fn short(value: &Value) -> String {
    match value {
        Value::Null => "–".to_owned(),
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64() {
            Some(real) if number.is_f64() => {
                let text = format!("{real:.4}");
                let text = text.trim_end_matches('0').trim_end_matches('.');
                match text {
                    "-0" | "" => "0".to_owned(),
                    text => text.to_owned(),
                }
            }
            Some(_) | None => number.to_string(),
        },
        Value::Array(all) => {
            let each: Vec<String> = all.iter().take(LINE_ELEMENTS).map(short).collect();
            let more = if all.len() > LINE_ELEMENTS {
                " …"
            } else {
                ""
            };
            format!("[{}{more}]", each.join(" "))
        }
        Value::Bool(_) | Value::Object(_) => value.to_string(),
    }
}

/// Returns the text, cut after `most` characters.
pub(crate) fn cut(text: &str, most: usize) -> String {
    match text.char_indices().nth(most) {
        None => text.to_owned(),
        Some((at, _)) => format!("{}…", text.get(..at).unwrap_or_default()),
    }
}

const MOST_FIELDS: usize = 256;
const MOST_ELEMENTS: usize = 64;
const LONGEST_TEXT: usize = 2048;
const LONGEST_LINE: usize = 120;
const LINE_FIELDS: usize = 8;
const LINE_ELEMENTS: usize = 6;
const NUMBER_FIELDS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a block with a single Double.
    pub(crate) fn double(value: f64) -> Vec<u8> {
        let mut block = vec![1, 0, 11];
        block.extend(value.to_le_bytes());
        block
    }

    #[test]
    fn one_field_is_its_value_and_several_have_names() {
        assert_eq!(line(&double(21.5), &[]), "21.5");
        assert_eq!(line(&double(1.0 / 3.0), &[]), "0.3333");
        assert_eq!(line(&double(f64::NAN), &[]), "NaN");
        let two = [2, 0, 1, 1, 6, 7, 0, 0, 0];
        let names = ["running".to_owned()];
        assert_eq!(line(&two, &names), "running true  field_2 7");
        assert_eq!(number(&two), Some(1.0));
        assert_eq!(line(&[9], &[]), "unreadable");
    }

    #[test]
    fn long_arrays_are_cut() {
        // 100 Bytes.
        let mut block = vec![1, 0, 3 | 0x80, 100, 0, 0, 0];
        block.extend([7; 100]);
        let shown = fields(&block, &[]).unwrap();
        let array = shown[0].1.as_array().unwrap();
        assert_eq!(array.len(), MOST_ELEMENTS + 1);
        assert_eq!(line(&block, &[]), "[7 7 7 7 7 7 …]");
    }

    #[test]
    fn a_text_is_cut_between_characters() {
        assert_eq!(cut("äöü", 2), "äö…");
        assert_eq!(cut("äöü", 3), "äöü");
    }
}
