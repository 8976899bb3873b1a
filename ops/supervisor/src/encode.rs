//! Requests of calls and values of topics, from the text of a form.

use bridge_node::{CallDescription, CallField};
use messages::ArrayRank;
use serde_json::{Map, Value};
use uadp::BuiltinType;

/// Reason for which the text of a form is no value, for the user.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum FormFault {
    #[error("the call has no field `{0}`")]
    UnknownField(String),
    #[error("`{0}` is missing")]
    Missing(String),
    #[error("too many fields")]
    Fields,
    #[error("`{field}`: {fault}")]
    Field { field: String, fault: EntryFault },
    #[error(transparent)]
    Entry(#[from] EntryFault),
}

/// Reason for which a text is no value of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum EntryFault {
    #[error("too many elements")]
    Elements,
    #[error("{wanted} elements are wanted, not {given}")]
    Length { wanted: u32, given: i32 },
    #[error("`{text}` is no {kind}")]
    Text { text: String, kind: &'static str },
    #[error("a {0} cannot be entered here")]
    Unsupported(&'static str),
}

/// Encodes the request of a call. `given` has a text, a number or a list for each field.
///
/// # Errors
/// Returns the fault of a field.
pub(crate) fn request(
    call: &CallDescription,
    given: &Map<String, Value>,
) -> Result<Vec<u8>, FormFault> {
    let is_known = |name: &&String| call.request.iter().all(|field| field.name != **name);
    if let Some(unknown) = given.keys().find(is_known) {
        return Err(FormFault::UnknownField(unknown.clone()));
    }
    // A request without fields uses all defaults.
    if given.is_empty() && call.may_be_empty() {
        return Ok(vec![0, 0]);
    }
    let count = u16::try_from(call.request.len()).map_err(|_| FormFault::Fields)?;
    let mut block = Vec::from(count.to_le_bytes());
    for field in &call.request {
        match given.get(&field.name) {
            Some(value) => {
                variant(field, value, &mut block).map_err(|fault| FormFault::Field {
                    field: field.name.clone(),
                    fault,
                })?;
            }
            // The null Variant stands for the default.
            None if field.optional => block.push(0),
            None => return Err(FormFault::Missing(field.name.clone())),
        }
    }
    Ok(block)
}

/// Encodes the value of a variable with a single field.
///
/// # Errors
/// Returns the fault of the value.
pub(crate) fn value(field: &CallField, given: &Value) -> Result<Vec<u8>, FormFault> {
    let mut block = vec![1, 0];
    variant(field, given, &mut block)?;
    Ok(block)
}

fn variant(field: &CallField, value: &Value, block: &mut Vec<u8>) -> Result<(), EntryFault> {
    let ArrayRank::Array { fixed } = field.rank else {
        block.push(field.builtin.id());
        return scalar(field.builtin, &text(value), block);
    };
    let elements: Vec<String> = match value.as_array() {
        Some(elements) => elements.iter().map(text).collect(),
        None => {
            let all = text(value);
            let all = all.trim().trim_start_matches('[').trim_end_matches(']');
            let separator = if all.contains(';') { ';' } else { ',' };
            match all.trim() {
                "" => Vec::new(),
                all => all
                    .split(separator)
                    .map(|element| element.trim().to_owned())
                    .collect(),
            }
        }
    };
    let length = i32::try_from(elements.len()).map_err(|_| EntryFault::Elements)?;
    if let Some(fixed) = fixed
        && u32::try_from(length) != Ok(fixed)
    {
        return Err(EntryFault::Length {
            wanted: fixed,
            given: length,
        });
    }
    block.push(field.builtin.id() | ARRAY);
    block.extend(length.to_le_bytes());
    for element in &elements {
        scalar(field.builtin, element, block)?;
    }
    Ok(())
}

/// Returns the text of a JSON value, without quotes.
fn text(value: &Value) -> String {
    match value.as_str() {
        Some(text) => text.to_owned(),
        None => value.to_string(),
    }
}

/// Appends a value without its type.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "the other types have no text that people enter"
)]
fn scalar(builtin: BuiltinType, text: &str, block: &mut Vec<u8>) -> Result<(), EntryFault> {
    let fault = || EntryFault::Text {
        text: crate::value::cut(text, 40),
        kind: builtin.name(),
    };
    let trimmed = text.trim();
    match builtin {
        BuiltinType::Boolean => {
            let is_true = match trimmed {
                "true" | "1" => true,
                "false" | "0" => false,
                _ => return Err(fault()),
            };
            block.push(u8::from(is_true));
        }
        BuiltinType::SByte => block.extend(number::<i8>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::Byte => block.push(number::<u8>(trimmed, fault)?),
        BuiltinType::Int16 => block.extend(number::<i16>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::UInt16 => block.extend(number::<u16>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::Int32 => block.extend(number::<i32>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::UInt32 => block.extend(number::<u32>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::Int64 => block.extend(number::<i64>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::UInt64 => block.extend(number::<u64>(trimmed, fault)?.to_le_bytes()),
        BuiltinType::Float => {
            let value = number::<f32>(trimmed, fault)?;
            block.extend(finite(value.is_finite(), value, fault)?.to_le_bytes());
        }
        BuiltinType::Double => {
            let value = number::<f64>(trimmed, fault)?;
            block.extend(finite(value.is_finite(), value, fault)?.to_le_bytes());
        }
        BuiltinType::String => {
            let length = i32::try_from(text.len()).map_err(|_| fault())?;
            block.extend(length.to_le_bytes());
            block.extend(text.as_bytes());
        }
        other => return Err(EntryFault::Unsupported(other.name())),
    }
    Ok(())
}

fn number<T: std::str::FromStr>(
    text: &str,
    fault: impl Fn() -> EntryFault,
) -> Result<T, EntryFault> {
    text.parse().map_err(|_| fault())
}

/// A machine takes no infinite numbers from a form.
fn finite<T>(is_finite: bool, value: T, fault: impl Fn() -> EntryFault) -> Result<T, EntryFault> {
    is_finite.then_some(value).ok_or_else(fault)
}

const ARRAY: u8 = 0x80;

#[cfg(test)]
mod tests {
    use bridge_node::CallRole;
    use serde_json::json;

    use super::*;

    fn call(request: Vec<CallField>) -> CallDescription {
        CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request,
            response: Vec::new(),
        }
    }

    fn encoded(request: Vec<CallField>, given: &Value) -> Result<Vec<u8>, String> {
        let block = super::request(&call(request), given.as_object().unwrap());
        block.map_err(|fault| fault.to_string())
    }

    #[test]
    fn a_form_becomes_the_fields_of_the_request() {
        let fields = || {
            vec![
                CallField::scalar("On", BuiltinType::Boolean),
                CallField::scalar("Force", BuiltinType::Double).optional(),
                CallField::array("Point", BuiltinType::Int16),
                CallField::scalar("Name", BuiltinType::String),
            ]
        };
        let block = encoded(
            fields(),
            &json!({ "On": "true", "Point": "1, -2", "Name": "ä" }),
        );
        let block = block.unwrap();
        let shown = crate::value::fields(&block, &[]).unwrap();
        assert_eq!(
            Value::Object(shown.into_iter().collect()),
            json!({ "field_1": true, "field_2": null, "field_3": [1, -2], "field_4": "ä" })
        );
    }

    #[test]
    fn a_fault_names_the_field() {
        let speed = || vec![CallField::scalar("Speed", BuiltinType::Byte)];
        for (given, fault) in [
            (json!({ "Speed": "300" }), "`Speed`: `300` is no Byte"),
            (json!({}), "`Speed` is missing"),
            (json!({ "Sped": 1 }), "the call has no field `Sped`"),
        ] {
            assert_eq!(encoded(speed(), &given), Err(fault.to_owned()));
        }
        let force = vec![CallField::scalar("Force", BuiltinType::Double)];
        assert!(encoded(force, &json!({ "Force": "inf" })).is_err());
        let fixed = CallField {
            rank: ArrayRank::Array { fixed: Some(6) },
            ..CallField::array("Joints", BuiltinType::Double)
        };
        for text in ["1,,3", "0,5; 1,5"] {
            let joints = vec![CallField::array("Joints", BuiltinType::Double)];
            assert!(
                encoded(joints, &json!({ "Joints": text })).is_err(),
                "{text}"
            );
        }
        let fault = encoded(vec![fixed], &json!({ "Joints": [1, 2] })).unwrap_err();
        assert_eq!(fault, "`Joints`: 6 elements are wanted, not 2");
    }

    #[test]
    fn a_value_is_a_block_with_a_single_field() {
        let speed = CallField::scalar("value", BuiltinType::Int16);
        assert_eq!(value(&speed, &json!("-2")), Ok(vec![1, 0, 4, 0xFE, 0xFF]));
        assert!(value(&speed, &json!("fast")).is_err());
    }

    #[test]
    fn a_request_without_fields_uses_all_defaults() {
        let force = CallField::scalar("Force", BuiltinType::Double).optional();
        assert_eq!(encoded(vec![force], &json!({})), Ok(vec![0, 0]));
    }
}
