//! Parses the arguments of a goal or a message: `name=value`, or the whole message as YAML in one
//! word.

use granit_parser::{Event, Parser};
use serde_json::{Value, json};
use uadp::BuiltinType;

use super::super::described::AnnouncedField;

/// The reason why an argument is no message in YAML.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(in crate::live) enum NoMessage {
    #[error("the value is not YAML: {0}")]
    Yaml(String),
    #[error("the value may have lists, maps and single values only")]
    Alias,
    #[error("the value is not a map, as {{order: 5}}")]
    NoMap,
    #[error("the names in a map are texts")]
    Name,
    #[error("`{name}` is given twice")]
    Twice { name: String },
}

/// Returns the fields of a goal by their names within the goal, without the goal id.
pub(super) fn fields(takes: &[AnnouncedField]) -> Vec<AnnouncedField> {
    let fields = takes.iter().filter(|field| field.name != GOAL_ID);
    fields
        .map(|field| AnnouncedField {
            name: own(&field.name, GOAL).to_owned(),
            ..field.clone()
        })
        .collect()
}

/// Returns the name of a field within a goal, its feedback or its result.
pub(super) fn own<'n>(name: &'n str, part: &str) -> &'n str {
    let rest = name
        .strip_prefix(part)
        .and_then(|rest| rest.strip_prefix('.'));
    rest.unwrap_or(name)
}

/// Returns the arguments of a goal as `name=value`. With `fills`, missing fields get the default
/// values of a ROS message.
///
/// # Errors
/// [`NoMessage`], if an argument is no message in YAML.
pub(super) fn spelled(
    typed: &[String],
    takes: &[AnnouncedField],
    fills: bool,
) -> Result<Vec<String>, NoMessage> {
    let typed: Vec<String> = typed
        .iter()
        .map(|word| own(word, GOAL).to_owned())
        .collect();
    message(&typed, takes, fills)
}

/// Returns the fields of a message as `name=value`, as [`spelled`] does for a goal.
///
/// # Errors
/// [`NoMessage`], if an argument is no message in YAML.
pub(in crate::live) fn message(
    typed: &[String],
    takes: &[AnnouncedField],
    fills: bool,
) -> Result<Vec<String>, NoMessage> {
    let mut words = Vec::new();
    for word in typed {
        match word.trim_start().starts_with('{') {
            true => flatten(&yaml(word)?, "", &mut words),
            false => words.push(word.clone()),
        }
    }
    if fills {
        let is_given = |field: &AnnouncedField| {
            let mut names = words.iter().filter_map(|word| word.split_once('='));
            names.any(|(name, _)| name == field.name)
        };
        let missing = takes
            .iter()
            .filter(|field| !field.optional && !is_given(field));
        let missing: Vec<String> = missing
            .filter_map(|field| Some(format!("{}={}", field.name, nothing(field)?)))
            .collect();
        words.extend(missing);
    }
    Ok(words)
}

/// Returns the default value of a field; `None` for types that ROS messages do not have.
fn nothing(field: &AnnouncedField) -> Option<String> {
    let builtin = field.builtin?;
    let one = if builtin == BuiltinType::Boolean {
        "false"
    } else if builtin.is_number() {
        "0"
    } else if matches!(builtin, BuiltinType::String | BuiltinType::ByteString)
        || builtin == BuiltinType::ExtensionObject && field.is_array()
    {
        ""
    } else if builtin == BuiltinType::DateTime {
        "1970-01-01T00:00:00Z"
    } else {
        return None;
    };
    if !field.is_array() {
        return Some(one.to_owned());
    }
    let count = match field.dimensions.as_slice() {
        [count] => usize::try_from(*count).ok()?.min(MOST_ELEMENTS),
        _ => 0,
    };
    Some(json!(vec![one; count]).to_string())
}

/// Flattens nested maps to names with dots.
fn flatten(value: &Value, path: &str, words: &mut Vec<String>) {
    match value {
        Value::Object(fields) => {
            for (name, value) in fields {
                let dot = if path.is_empty() { "" } else { "." };
                flatten(value, &format!("{path}{dot}{name}"), words);
            }
        }
        Value::String(text) => words.push(format!("{path}={text}")),
        Value::Array(_) | Value::Null | Value::Bool(_) | Value::Number(_) => {
            words.push(format!("{path}={value}"));
        }
    }
}

/// Parses YAML and keeps scalars as text, because their types are the types of the fields.
fn yaml(text: &str) -> Result<Value, NoMessage> {
    let options = granit_parser::options! {
        emit_comments: false,
        flow_nesting_limit: MOST_DEEP,
        block_nesting_limit: MOST_DEEP
    };
    let mut open: Vec<(bool, Vec<Value>)> = Vec::new();
    let mut root = None;
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, _) = event.map_err(|error| NoMessage::Yaml(error.to_string()))?;
        let value = match event {
            Event::Scalar(text, ..) => Value::String(text.into_owned()),
            Event::SequenceStart(..) => {
                open.push((false, Vec::new()));
                continue;
            }
            Event::MappingStart(..) => {
                open.push((true, Vec::new()));
                continue;
            }
            Event::SequenceEnd | Event::MappingEnd => match open.pop() {
                Some((is_map, values)) => closed(is_map, values)?,
                None => continue,
            },
            Event::StreamStart
            | Event::StreamEnd
            | Event::DocumentStart(..)
            | Event::DocumentEnd => continue,
            Event::Alias(_) | Event::UnresolvedAlias(_) | Event::Anchor(..) => {
                return Err(NoMessage::Alias);
            }
            // The enumeration is non-exhaustive.
            _ => return Err(NoMessage::Alias),
        };
        match open.last_mut() {
            Some((_, values)) => values.push(value),
            None => root = Some(value),
        }
    }
    match root {
        Some(value @ Value::Object(_)) => Ok(value),
        Some(_) | None => Err(NoMessage::NoMap),
    }
}

fn closed(is_map: bool, values: Vec<Value>) -> Result<Value, NoMessage> {
    if !is_map {
        return Ok(Value::Array(values));
    }
    let mut fields = serde_json::Map::new();
    let mut values = values.into_iter();
    while let (Some(name), Some(value)) = (values.next(), values.next()) {
        let Value::String(name) = name else {
            return Err(NoMessage::Name);
        };
        if fields.insert(name.clone(), value).is_some() {
            return Err(NoMessage::Twice { name });
        }
    }
    Ok(Value::Object(fields))
}

/// The field that identifies a goal.
pub(super) const GOAL_ID: &str = "goal_id";
/// The prefix of the fields of a goal.
const GOAL: &str = "goal";
const MOST_DEEP: usize = 32;
/// Maximum number of default elements of a fixed-length array.
const MOST_ELEMENTS: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn takes() -> Vec<AnnouncedField> {
        fields(&[
            AnnouncedField::plain("goal_id", BuiltinType::ByteString, None),
            AnnouncedField::plain("goal.pose.x", BuiltinType::Double, None),
            AnnouncedField::plain("goal.pose.frame_id", BuiltinType::String, None),
            AnnouncedField::plain("goal.stamp", BuiltinType::DateTime, None),
            AnnouncedField::plain("goal.covariance", BuiltinType::Double, Some(2)),
            AnnouncedField::plain("goal.poses", BuiltinType::ExtensionObject, Some(0)),
        ])
    }

    fn of(words: &[&str], fills: bool) -> Result<Vec<String>, NoMessage> {
        let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        spelled(&words, &takes(), fills)
    }

    #[test]
    fn a_goal_is_typed_by_its_fields_or_as_yaml() {
        // The order of the fields does not matter.
        let spelled = |words: &[&str]| {
            let mut spelled = of(words, false).unwrap();
            spelled.sort();
            spelled
        };
        let wanted = ["pose.frame_id=map", "pose.x=1.5"];
        assert_eq!(spelled(&["goal.pose.x=1.5", "pose.frame_id=map"]), wanted);
        assert_eq!(spelled(&["{pose: {x: 1.5, frame_id: map}}"]), wanted);
        let json = r#"{"pose": {"x": 1.5, "frame_id": "map"}, "covariance": [1, 2]}"#;
        assert_eq!(
            spelled(&[json]),
            [r#"covariance=["1","2"]"#, "pose.frame_id=map", "pose.x=1.5"]
        );
        for wrong in ["{pose: ", "{pose: *x}", "{pose: 1, pose: 2}", "{[1]: 2}"] {
            assert!(of(&[wrong], false).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_is_not_given_is_what_a_message_has_where_nothing_is_set() {
        assert_eq!(
            of(&["pose.x=2"], true).unwrap(),
            [
                "pose.x=2",
                "pose.frame_id=",
                "stamp=1970-01-01T00:00:00Z",
                r#"covariance=["0","0"]"#,
                "poses=[]",
            ]
        );
    }
}
