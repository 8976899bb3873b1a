//! Values and conditions as texts.

use serde_json::Value;

use super::flow::NodeCondition;
use crate::process::{Compare, GivenParameter, Test};

/// A value in a text, or a reference to a result of an earlier step.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum WrittenValue {
    Value {
        value: Value,
        unit: Option<String>,
    },
    /// The ID of a step, and the name of its result.
    Result(String, String),
}

/// Reads a value as `5`, `2.5 l`, `true`, `[1, 2]` or a text, or a reference as `${step.Result}` or
/// `=step.Result`.
pub(super) fn value(text: &str) -> WrittenValue {
    let text = text.trim();
    if let Some(expression) = expression(text) {
        if let Some((step, result)) = reference(expression) {
            return WrittenValue::Result(step.to_owned(), result.to_owned());
        }
        return plain(expression);
    }
    plain(text)
}

fn plain(text: &str) -> WrittenValue {
    if let Ok(value) = serde_json::from_str(text) {
        return WrittenValue::Value { value, unit: None };
    }
    let with_unit = text
        .split_once(char::is_whitespace)
        .and_then(|(number, unit)| {
            let value: Value = serde_json::from_str(number).ok().filter(Value::is_number)?;
            let unit = unit.trim();
            (!unit.is_empty() && !unit.contains(char::is_whitespace)).then(|| WrittenValue::Value {
                value,
                unit: Some(unit.to_owned()),
            })
        });
    with_unit.unwrap_or_else(|| WrittenValue::Value {
        value: Value::String(text.to_owned()),
        unit: None,
    })
}

/// Returns the text inside `${..}` or after `=`.
fn expression(text: &str) -> Option<&str> {
    let inside = text
        .strip_prefix("${")
        .and_then(|rest| rest.strip_suffix('}'));
    inside
        .or_else(|| text.strip_prefix('=').filter(|rest| !rest.starts_with('=')))
        .map(str::trim)
}

/// Splits `step.Result` at its last dot.
fn reference(text: &str) -> Option<(&str, &str)> {
    let (step, result) = text.rsplit_once('.')?;
    let is_number = text.parse::<f64>().is_ok();
    let is_name = |name: &str| {
        !name.is_empty() && !name.contains(|c: char| c.is_whitespace() || "\"'[]{}()".contains(c))
    };
    (!is_number && is_name(step) && is_name(result)).then_some((step, result))
}

/// Reads a comparison as `step.Result >= 5`. `node` returns the node with the ID of a step.
///
/// # Errors
/// The text is no comparison, or its step is unknown.
pub(super) fn condition(
    text: &str,
    node: &dyn Fn(&str) -> Option<usize>,
) -> Result<NodeCondition, String> {
    let text = text.trim();
    let text = expression(text).unwrap_or(text);
    let shown: String = text.chars().take(100).collect();
    let other =
        || format!("the condition `{shown}` is not supported; write it as step.Result >= 5");
    let split = Compare::ALL
        .iter()
        .filter_map(|(compare, sign)| Some((*compare, text.split_once(sign)?)))
        // The first comparison of the text; of two at one place the longer sign.
        .min_by_key(|(compare, (before, _))| (before.len(), compare.sign().len() == 1));
    // A single = compares too.
    let single = || {
        let (before, after) = text.split_once('=')?;
        Some((Compare::Equal, (before, after)))
    };
    let (compare, (of, value)) = split.or_else(single).ok_or_else(other)?;
    let (step, result) = reference(of.trim()).ok_or_else(other)?;
    let value = value.trim();
    let quoted = value
        .strip_prefix('\'')
        .and_then(|rest| rest.strip_suffix('\''))
        .map(|text| Value::String(text.to_owned()));
    let value = match quoted {
        Some(value) => value,
        None => serde_json::from_str(value).map_err(|_no_json| other())?,
    };
    let node = node(step).ok_or_else(|| {
        format!("the condition `{shown}` names the step `{step}`, which is unknown")
    })?;
    Ok(NodeCondition {
        step: node,
        test: Test::Result {
            name: result.to_owned(),
            compare,
            value,
        },
        is_negated: false,
    })
}

/// Returns a parameter with a value.
pub(super) fn given(name: &str, value: Value, unit: Option<String>) -> GivenParameter {
    GivenParameter {
        name: name.to_owned(),
        value,
        unit,
        result: None,
        query: None,
    }
}

/// Reads an ISO 8601 duration of days and times, as `PT1M30S`, in seconds. Engines that evaluate
/// expressions have it in quotes.
pub(super) fn duration(text: &str) -> Option<f64> {
    let plain = text.trim().trim_matches(['"', '\'']);
    let rest = plain.strip_prefix('P')?;
    let (days, times) = rest.split_once('T').unwrap_or((rest, ""));
    let mut seconds = 0.0;
    let mut parts = 0;
    let days_of: &[(char, f64)] = &[('D', 86_400.0)];
    let times_of: &[(char, f64)] = &[('H', 3600.0), ('M', 60.0), ('S', 1.0)];
    for (mut rest, units) in [(days, days_of), (times, times_of)] {
        for (unit, factor) in units {
            if let Some((number, behind)) = rest.split_once(*unit) {
                let is_number =
                    !number.is_empty() && number.chars().all(|c| c.is_ascii_digit() || c == '.');
                seconds += number.parse::<f64>().ok().filter(|_| is_number)? * factor;
                parts += 1;
                rest = behind;
            }
        }
        if !rest.is_empty() {
            return None;
        }
    }
    (parts > 0 && seconds > 0.0).then_some(seconds)
}
