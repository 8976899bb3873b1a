//! The typed value of a command line.

use mappings::Variable;
use messages::ArrayRank;
use serde_json::Value;
use uadp::{BuiltinType, Timestamp};

use super::super::call::words;
use super::super::described::{AnnouncedField, FieldMeaning};
use super::super::parameters::{self, WrongParameter};
use crate::iso_time;

/// The reason why a value does not fit the fields of a DataSet.
#[derive(Debug, thiserror::Error)]
pub(super) enum NoFieldValue {
    #[error("its type is not known")]
    UnknownType,
    #[error("a single value is expected, and {given} are given")]
    Several { given: usize },
    #[error("{number} is out of the range {} to {}", range.0, range.1)]
    OutOfRange { number: f64, range: (f64, f64) },
    #[error(transparent)]
    Message(#[from] words::NoMessage),
    #[error(transparent)]
    Parameter(#[from] WrongParameter),
}

/// Encodes the value as the fields of a DataSet: their number, then a Variant for each field. `now`
/// is the present time in nanoseconds since 1970, for the stamp of a message.
///
/// # Errors
/// [`NoFieldValue`].
pub(super) fn encoded(
    given: &[String],
    fields: &[AnnouncedField],
    now: i128,
) -> Result<Vec<u8>, NoFieldValue> {
    let words = match (fields, given) {
        ([], _) => return Err(NoFieldValue::UnknownType),
        ([only], [text]) => vec![single(text, only)],
        ([_], _) => {
            let given = given.len();
            return Err(NoFieldValue::Several { given });
        }
        (_, _) => parts(given, fields, now)?,
    };
    in_range(&words, fields)?;
    Ok(parameters::encoded(&words, fields, "value")?)
}

/// Returns the only field as `name=value`.
fn single(text: &str, field: &AnnouncedField) -> String {
    let name = &field.name;
    let own = format!("{name}=");
    let text = if name.is_empty() {
        text
    } else {
        text.strip_prefix(&own).unwrap_or(text)
    };
    // A quoted text of YAML or JSON.
    let quoted = text
        .starts_with('"')
        .then(|| serde_json::from_str(text).ok());
    match quoted.flatten() {
        Some(Value::String(inner)) => format!("{name}={inner}"),
        Some(_) | None => format!("{name}={text}"),
    }
}

/// Returns the parts of a message as `name=value`. Missing parts are zero, and a missing stamp is
/// `now`.
fn parts(
    given: &[String],
    fields: &[AnnouncedField],
    now: i128,
) -> Result<Vec<String>, words::NoMessage> {
    let mut words = words::message(given, fields, false)?;
    let has = |name: &str| {
        let mut names = words.iter().filter_map(|word| word.split_once('='));
        names.any(|(of, _)| of == name)
    };
    let is_stamp = |field: &&AnnouncedField| {
        field.name == STAMP && field.builtin == Some(BuiltinType::DateTime) && !field.is_array()
    };
    if fields.iter().any(|field| is_stamp(&field)) && !has(STAMP) {
        let now = iso_time::of_date_time(Timestamp::from_unix_nanos(now).time);
        words.push(format!("{STAMP}={now}"));
    }
    words::message(&words, fields, true)
}

/// Checks the numbers of fields with a range.
fn in_range(words: &[String], fields: &[AnnouncedField]) -> Result<(), NoFieldValue> {
    for word in words {
        let Some((name, text)) = word.split_once('=') else {
            continue;
        };
        let field = fields.iter().find(|field| field.name == name);
        let Some((low, high)) = field.and_then(|field| field.meaning.range) else {
            continue;
        };
        let list = text.trim_matches(['[', ']']).split(',');
        let mut numbers = list.filter_map(|one| one.trim().trim_matches('"').parse::<f64>().ok());
        if let Some(wrong) = numbers.find(|one| !(low..=high).contains(one)) {
            let (number, range) = (wrong, (low, high));
            return Err(NoFieldValue::OutOfRange { number, range });
        }
    }
    Ok(())
}

/// Returns the fields of a variable of a mapping; empty if its type is not known.
pub(super) fn fields_of(variable: &Variable) -> Vec<AnnouncedField> {
    if let Some((builtin, is_array)) = variable.value_type {
        let only = AnnouncedField::plain(&variable.name, builtin, is_array.then_some(0));
        let range = variable.meaning.range();
        let meaning = FieldMeaning {
            range,
            ..FieldMeaning::default()
        };
        return vec![AnnouncedField { meaning, ..only }];
    }
    let fields = variable.fields.iter().map(|leaf| {
        let size = match leaf.rank {
            ArrayRank::Scalar => None,
            ArrayRank::Array { fixed } => Some(fixed.unwrap_or_default()),
        };
        AnnouncedField::plain(&leaf.path, leaf.builtin, size)
    });
    fields.collect()
}

/// The time of the header of a message.
const STAMP: &str = "header.stamp";

#[cfg(test)]
mod tests {
    use uadp::Fields;

    use super::*;
    use crate::live::plain;

    fn of(given: &[&str], fields: &[AnnouncedField]) -> Result<Vec<Value>, NoFieldValue> {
        let given: Vec<String> = given.iter().map(|word| (*word).to_owned()).collect();
        let block = encoded(&given, fields, 1_700_000_000_123_456_789)?;
        let values = Fields::parse(&block).unwrap().map(Result::unwrap);
        Ok(values
            .map(|value| plain::variant(&value).unwrap())
            .collect())
    }

    #[test]
    fn a_single_value_needs_no_name_and_has_the_type_of_its_field() {
        let speed = [AnnouncedField::plain(
            "Line.Speed",
            BuiltinType::Double,
            None,
        )];
        assert_eq!(of(&["1"], &speed).unwrap(), [1.0]);
        assert_eq!(of(&["-0.5"], &speed).unwrap(), [-0.5]);
        assert_eq!(of(&["Line.Speed=2"], &speed).unwrap(), [2.0]);
        let text = [AnnouncedField::plain("Text", BuiltinType::String, None)];
        assert_eq!(of(&["a=b {c}"], &text).unwrap(), ["a=b {c}"]);
        assert_eq!(of(&[r#""1""#], &text).unwrap(), ["1"]);
        let list = [AnnouncedField::plain("Joints", BuiltinType::Float, Some(2))];
        assert_eq!(
            of(&["[1, 2.5]"], &list).unwrap(),
            [serde_json::json!([1.0, 2.5])]
        );
        for (given, fields, why) in [
            (&["fast"][..], &speed[..], "expected a Double, found `fast`"),
            (
                &["1", "2"],
                &speed,
                "a single value is expected, and 2 are given",
            ),
            (&["1,2,3"], &list, "takes 2 values, and 3 are given"),
            (&["1"], &[], "its type is not known"),
        ] {
            let wrong = of(given, fields).unwrap_err().to_string();
            assert!(wrong.contains(why), "{given:?}: {wrong}");
        }
    }

    #[test]
    fn parts_of_a_message_are_given_by_path_or_as_a_map_and_others_are_zero() {
        let twist = [
            AnnouncedField::plain("header.stamp", BuiltinType::DateTime, None),
            AnnouncedField::plain("twist.linear.x", BuiltinType::Double, None),
            AnnouncedField::plain("twist.angular.z", BuiltinType::Double, None),
        ];
        let stamp = "2023-11-14T22:13:20.1234567Z";
        let wanted = [Value::from(stamp), 0.5.into(), 0.0.into()];
        for given in [
            &["twist.linear.x=0.5"][..],
            &["{twist: {linear: {x: 0.5}}}"],
            &[r#"{"twist": {"linear": {"x": 0.5}}}"#],
        ] {
            assert_eq!(of(given, &twist).unwrap(), wanted, "{given:?}");
        }
        let wrong = of(&["linear.x=1"], &twist).unwrap_err().to_string();
        assert!(
            wrong.contains("there is no parameter `linear.x`"),
            "{wrong}"
        );
        assert!(wrong.contains("this value takes header.stamp"), "{wrong}");
    }

    #[test]
    fn numbers_out_of_the_range_are_refused() {
        let mut speed = AnnouncedField::plain("Speed", BuiltinType::Double, None);
        speed.meaning.range = Some((0.0, 2.0));
        assert!(of(&["2"], std::slice::from_ref(&speed)).is_ok());
        let wrong = of(&["2.5"], std::slice::from_ref(&speed));
        let wrong = wrong.unwrap_err().to_string();
        assert_eq!(wrong, "2.5 is out of the range 0 to 2");
        let mut list = AnnouncedField::plain("Joints", BuiltinType::Double, Some(2));
        list.meaning.range = Some((0.0, 2.0));
        assert!(of(&["[1, -1]"], &[list]).is_err());
    }
}
