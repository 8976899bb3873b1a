//! Encodes `name=value` arguments as the request of a call or as a value, by the announced types.

use serde_json::{Value, json};
use uadp::BuiltinType;

use super::described::{AnnouncedField, list};
use crate::values::{JsonFieldValue, WrongValue, variant_bytes};

/// A wrong argument, and the parameters that the call takes.
#[derive(Debug, thiserror::Error)]
#[error("{what}\n  = help: {help}")]
pub(crate) struct WrongParameter {
    what: ArgumentFault,
    help: String,
}

/// A fault of the arguments of a call or a value.
#[derive(Debug, thiserror::Error)]
enum ArgumentFault {
    #[error("`{0}` is no name=value")]
    NoName(String),
    #[error("there is no parameter `{0}`")]
    Unknown(String),
    #[error("`{0}` is given twice")]
    Twice(String),
    #[error("{name}: {fault}")]
    Value { name: String, fault: TypedFault },
    #[error("{} is missing", .0.join(", "))]
    Missing(Vec<String>),
    #[error("too many parameters")]
    TooMany,
    #[error("{}", format!("{name}: {error}").replace(": .Value", ": value"))]
    Encoding { name: String, error: WrongValue },
}

/// The reason why a text is no value of a field.
#[derive(Debug, thiserror::Error)]
enum TypedFault {
    #[error("it is of a type that is not known here")]
    UnknownType,
    #[error("{kind} cannot be given here")]
    Rank { kind: String },
    #[error("`{0}` is no list as [1, 2, 3]")]
    NoList(String),
    #[error("{kind} takes {size} values, and {given} are given")]
    Length {
        kind: String,
        size: u32,
        given: usize,
    },
    #[error("expected a {expected}, found `{found}`")]
    OtherType {
        expected: &'static str,
        found: String,
    },
}

/// Returns the request: a FieldCount and as many Variants, in the order of the call. An omitted
/// optional parameter is a null Variant; without any arguments there are no fields.
///
/// # Errors
/// [`WrongParameter`] names the first wrong argument or the missing parameters, and lists the
/// parameters of the call.
pub(crate) fn request(
    words: &[String],
    takes: &[AnnouncedField],
) -> Result<Vec<u8>, WrongParameter> {
    encoded(words, takes, "call")
}

/// Encodes the fields of a call or a value, which `subject` names for errors; see [`request`].
pub(super) fn encoded(
    words: &[String],
    takes: &[AnnouncedField],
    subject: &str,
) -> Result<Vec<u8>, WrongParameter> {
    let wrong = |what| WrongParameter {
        what,
        help: match takes {
            [] => format!("this {subject} takes nothing"),
            _ => format!("this {subject} takes {}", list(takes)),
        },
    };
    let mut given: Vec<Option<Value>> = vec![None; takes.len()];
    for word in words {
        let (name, text) = word
            .split_once('=')
            .ok_or_else(|| wrong(ArgumentFault::NoName(word.clone())))?;
        let at = takes.iter().position(|field| field.name == name);
        let place = at.and_then(|at| Some((takes.get(at)?, given.get_mut(at)?)));
        let Some((field, place)) = place else {
            return Err(wrong(ArgumentFault::Unknown(name.to_owned())));
        };
        if place.is_some() {
            return Err(wrong(ArgumentFault::Twice(name.to_owned())));
        }
        let value = value(field, text).map_err(|fault| {
            let name = name.to_owned();
            wrong(ArgumentFault::Value { name, fault })
        })?;
        *place = Some(value);
    }
    let missing = takes.iter().zip(&given);
    let missing: Vec<String> = missing
        .filter(|(field, value)| value.is_none() && !field.optional)
        .map(|(field, _)| field.name.clone())
        .collect();
    if !missing.is_empty() {
        return Err(wrong(ArgumentFault::Missing(missing)));
    }
    if given.iter().all(Option::is_none) {
        return Ok(vec![0, 0]);
    }
    let count = u16::try_from(takes.len()).map_err(|_| wrong(ArgumentFault::TooMany))?;
    let mut block = count.to_le_bytes().to_vec();
    for (field, value) in takes.iter().zip(given) {
        let shown = JsonFieldValue {
            ua_type: value
                .is_some()
                .then_some(field.builtin)
                .flatten()
                .map(BuiltinType::id),
            value,
            ..JsonFieldValue::default()
        };
        let bytes = variant_bytes(&shown).map_err(|error| {
            let name = field.name.clone();
            wrong(ArgumentFault::Encoding { name, error })
        })?;
        block.extend(bytes);
    }
    Ok(block)
}

fn value(field: &AnnouncedField, text: &str) -> Result<Value, TypedFault> {
    let Some(builtin) = field.builtin else {
        return Err(TypedFault::UnknownType);
    };
    if !field.is_array() {
        return scalar(builtin, text);
    }
    if field.rank > 1 {
        return Err(TypedFault::Rank { kind: field.kind() });
    }
    let elements = match text.trim().starts_with('[') {
        true => match serde_json::from_str(text) {
            Ok(Value::Array(elements)) => elements,
            Ok(_) | Err(_) => return Err(TypedFault::NoList(text.to_owned())),
        },
        false if text.is_empty() => Vec::new(),
        false => text.split(',').map(|text| json!(text.trim())).collect(),
    };
    if let [size] = field.dimensions.as_slice()
        && *size > 0
        && usize::try_from(*size) != Ok(elements.len())
    {
        return Err(TypedFault::Length {
            kind: field.kind(),
            size: *size,
            given: elements.len(),
        });
    }
    let elements = elements.iter().map(|element| match element.as_str() {
        Some(text) => scalar(builtin, text),
        None => scalar(builtin, &element.to_string()),
    });
    elements.collect::<Result<_, _>>()
}

/// Converts a typed text to the JSON of its type.
fn scalar(builtin: BuiltinType, text: &str) -> Result<Value, TypedFault> {
    let expected = || TypedFault::OtherType {
        expected: builtin.name(),
        found: text.to_owned(),
    };
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "all others are typed as JSON, or as texts"
    )]
    match builtin {
        BuiltinType::Boolean => text
            .parse::<bool>()
            .map(Value::from)
            .map_err(|_| expected()),
        integer if integer.is_integer() => match text.parse::<i128>() {
            Ok(_) => Ok(json!(text)),
            Err(_) => Err(expected()),
        },
        BuiltinType::Float | BuiltinType::Double => match text.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(json!(number)),
            Ok(number) if number.is_nan() => Ok(json!("NaN")),
            Ok(number) => Ok(json!(if number > 0.0 {
                "Infinity"
            } else {
                "-Infinity"
            })),
            Err(_) => Err(expected()),
        },
        BuiltinType::String => Ok(json!(text)),
        _ => Ok(serde_json::from_str(text).unwrap_or_else(|_| json!(text))),
    }
}

#[cfg(test)]
mod tests {
    use uadp::action::ActionFields;

    use super::super::plain;
    use super::*;

    fn field(
        name: &str,
        builtin: BuiltinType,
        size: Option<u32>,
        optional: bool,
    ) -> AnnouncedField {
        AnnouncedField {
            optional,
            ..AnnouncedField::plain(name, builtin, size)
        }
    }

    fn takes() -> [AnnouncedField; 4] {
        [
            field("TargetPosition", BuiltinType::Double, Some(6), false),
            field("MaxVelocity", BuiltinType::Double, None, true),
            field("ToolFrame", BuiltinType::String, None, true),
            field("Tries", BuiltinType::Byte, None, true),
        ]
    }

    fn of(words: &[&str], takes: &[AnnouncedField]) -> Result<String, String> {
        let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        let block = request(&words, takes).map_err(|wrong| wrong.to_string())?;
        let named = plain::response(ActionFields::Variants(&block), takes).unwrap();
        Ok(serde_json::to_string(&named).unwrap())
    }

    #[test]
    fn words_become_values_of_the_types_the_call_takes_in_its_order() {
        let words = [
            "ToolFrame=a=b, c",
            "TargetPosition=0,0,.5,0,0,3e0",
            "Tries=3",
        ];
        let wanted = r#"{"TargetPosition":[0.0,0.0,0.5,0.0,0.0,3.0],"MaxVelocity":null,"ToolFrame":"a=b, c","Tries":3}"#;
        assert_eq!(of(&words, &takes()).unwrap(), wanted);
        let json = ["TargetPosition=[1, 2, 3, 4, 5, 6.5]"];
        assert!(
            of(&json, &takes())
                .unwrap()
                .contains("[1.0,2.0,3.0,4.0,5.0,6.5]")
        );
        assert_eq!(of(&[], &takes()[1..]).unwrap(), "{}");
    }

    #[test]
    fn what_is_wrong_is_named_and_the_call_says_what_it_takes() {
        let help = "\n  = help: this call takes TargetPosition: Double[6], [MaxVelocity: Double], \
                    [ToolFrame: String], [Tries: Byte]";
        let place = "TargetPosition=1,2,3,4,5,6";
        for (words, what) in [
            (&[][..], "TargetPosition is missing"),
            (&["MaxVelocity=1"], "TargetPosition is missing"),
            (&[place, "Speed=1"], "there is no parameter `Speed`"),
            (&[place, "Tries"], "`Tries` is no name=value"),
            (&[place, "Tries=1", "Tries=2"], "`Tries` is given twice"),
            (
                &[place, "Tries=much"],
                "Tries: expected a Byte, found `much`",
            ),
            (
                &[place, "Tries=256"],
                "Tries: value: expected Byte, found \"256\"",
            ),
            (
                &[place, "MaxVelocity=fast"],
                "MaxVelocity: expected a Double, found `fast`",
            ),
            (
                &["TargetPosition=1,2"],
                "TargetPosition: Double[6] takes 6 values, and 2 are given",
            ),
            (
                &["TargetPosition=[1,"],
                "TargetPosition: `[1,` is no list as [1, 2, 3]",
            ),
        ] {
            assert_eq!(of(words, &takes()).unwrap_err(), format!("{what}{help}"));
        }
        let nothing = of(&["Force=1"], &[]).unwrap_err();
        assert!(
            nothing.ends_with("= help: this call takes nothing"),
            "{nothing}"
        );
    }
}
