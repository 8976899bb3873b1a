//! Meaning of the numbers of a variable: unit, range, and texts.

use std::collections::BTreeMap;

use uadp::BuiltinType;

use super::types::{self, ValueType};
use crate::code::Code;
use crate::document::VariableEntry;
use crate::findings::MappingFindings;
use crate::mapping::Meaning;
use crate::read::{Located, given, short};
use crate::tree::TextSpan;
use crate::unit::Unit;

/// Maximum number of texts of one variable.
const MAX_TEXTS: usize = 1000;

/// Returns `None` for a faulty entry, which is noted. `value` has the OPC UA value type, if the
/// variable is one value.
pub(super) fn check(
    entry: &VariableEntry,
    value: (Option<ValueType>, bool),
    findings: &mut MappingFindings,
) -> Option<Meaning> {
    let mut sound = Some(());
    let mut unit = None;
    if let Some((text, place)) = given(&entry.unit) {
        unit = Unit::find(text);
        if unit.is_none() {
            let message = format!("unit `{}` unknown", short(text));
            let note = findings.error(Code::UnitUnknown, place, message);
            note.help_with(|| match Unit::suggest(text) {
                Some(near) => {
                    format!(
                        "did you mean `{}` ({}, {})?",
                        near.symbol, near.name, near.code
                    )
                }
                None => "use a symbol such as m/s, a UNECE code such as MTS, or a name".to_owned(),
            });
            sound = None;
        }
        let fits = numbers(value, ("unit", Code::UnitUnknown, place), findings);
        sound = sound.and(fits);
    }
    let mut range = None;
    if let Some((bounds, place)) = given(&entry.range) {
        range = limits(bounds, place, findings);
        let fits = numbers(value, ("range", Code::ValueRange, place), findings);
        let is_range = range.map(|_| ());
        sound = sound.and(fits).and(is_range);
    }
    let mut texts = BTreeMap::new();
    if let Some((pairs, place)) = given(&entry.r#enum) {
        let whole = value.0.is_none_or(|(builtin, _)| {
            builtin.is_number() && !matches!(builtin, BuiltinType::Float | BuiltinType::Double)
        });
        if value.1 || !whole {
            let told = told(value);
            let message = format!("an `enum` requires integers, but this is {told}");
            findings.error(Code::EnumTexts, place, message);
            sound = None;
        }
        if pairs.is_empty() || pairs.len() > MAX_TEXTS {
            let message = format!("the `enum` has {} values", pairs.len());
            findings
                .error(Code::EnumTexts, place, message)
                .help("give 1 to 1000 values, such as {0: idle, 1: moving}");
            sound = None;
        }
        for (number, text) in pairs {
            let (Some(number), Some(said)) = (number.value, &text.value) else {
                sound = None;
                continue;
            };
            if said.trim().is_empty() || said.chars().count() > 512 {
                let message =
                    format!("the text of {number} is empty or longer than 512 characters");
                findings.error(Code::EnumTexts, text.place, message);
                sound = None;
            }
            texts.insert(number, said.clone());
        }
    }
    let precision = precision(entry, value, findings);
    let description = description(entry, findings);
    sound?;
    Some(Meaning {
        description: description?,
        precision: precision?,
        promoted: given(&entry.promoted).is_some_and(|(on, _)| *on),
        ..Meaning::new(unit, range, texts)
    })
}

/// Returns `None` for a faulty precision, which is noted.
fn precision(
    entry: &VariableEntry,
    value: (Option<ValueType>, bool),
    findings: &mut MappingFindings,
) -> Option<Option<u8>> {
    let Some((digits, place)) = given(&entry.precision) else {
        return Some(None);
    };
    let precision = u8::try_from(*digits).ok().filter(|digits| *digits <= 15);
    if precision.is_none() {
        let message = format!("{digits} digits are out of range");
        findings
            .error(Code::WrongValue, place, message)
            .label("0 to 15");
    }
    numbers(value, ("precision", Code::ValueRange, place), findings)?;
    precision.map(Some)
}

/// Returns `None` for a faulty description, which is noted.
fn description(entry: &VariableEntry, findings: &mut MappingFindings) -> Option<Option<String>> {
    let Some((text, place)) = given(&entry.description) else {
        return Some(None);
    };
    if text.trim().is_empty() || text.chars().count() > 1000 {
        let message = "a description has 1 to 1000 characters";
        findings.error(Code::WrongValue, place, message);
        return None;
    }
    Some(Some(text.clone()))
}

/// Notes a value that is not a number, for a key that needs one.
fn numbers(
    value: (Option<ValueType>, bool),
    (key, code, place): (&str, Code, TextSpan),
    findings: &mut MappingFindings,
) -> Option<()> {
    let number = value.0.is_none_or(|(builtin, _)| builtin.is_number());
    if number && !value.1 {
        return Some(());
    }
    let message = format!("a `{key}` requires a number, but this is {}", told(value));
    findings
        .error(code, place, message)
        .help("bind a single `field`");
    None
}

fn told((value_type, several): (Option<ValueType>, bool)) -> String {
    match value_type {
        Some(value_type) if !several => types::print(value_type),
        _ => "a message of several fields".to_owned(),
    }
}

fn limits(
    bounds: &[Located<f64>],
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<(f64, f64)> {
    let bounds: Vec<f64> = bounds.iter().map(|at| at.value).collect::<Option<_>>()?;
    match bounds[..] {
        [low, high] if low.is_finite() && high.is_finite() && low < high => Some((low, high)),
        _ => {
            findings
                .error(Code::ValueRange, place, "this is not a range")
                .help("give the lowest and the highest value, such as [0, 1.5]");
            None
        }
    }
}
