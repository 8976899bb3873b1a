//! The parameters and results of skills: names, types, units and limits.

use knowledge::units;
use skills::{Builtin, FoundParameter, FoundSkill, SkillValue, ValueShape};

use crate::process::GivenParameter;

/// Converts the parameters of a step to the parameters of a skill.
///
/// # Errors
/// The first parameter that is unknown, missing, of another type or unit, or out of its limits.
pub(super) fn values(
    found: &FoundSkill,
    given: &[GivenParameter],
) -> Result<Vec<(String, SkillValue)>, String> {
    for known in &found.parameters {
        let is_given = given.iter().any(|given| given.name == known.name);
        if known.default.is_none() && !is_given {
            return Err(format!(
                "{} needs the parameter {}, and the step does not give it",
                found.name, known.name
            ));
        }
    }
    let value = |given: &GivenParameter| {
        let parameter = parameter(found, &given.name)?;
        // The value is known when its step is done, or when the step of its query begins.
        if given.result.is_some() || (given.query.is_some() && given.value.is_null()) {
            return Ok(None);
        }
        let wrong = |why: String| format!("{}: {why}", given.shown());
        let json = in_unit(given, parameter).map_err(wrong)?;
        let value = read(parameter.shape, &json).map_err(wrong)?;
        let numbers = if let SkillValue::Array(_, elements) = &value {
            elements.iter().filter_map(SkillValue::as_f64).collect()
        } else {
            Vec::from_iter(value.as_f64())
        };
        if let Some((low, high)) = parameter.range
            && let Some(number) = numbers
                .into_iter()
                .find(|number| !(low..=high).contains(number))
        {
            let unit = parameter.unit.as_deref().unwrap_or_default();
            let why = format!("{number} is not from {low} to {high} {unit}");
            return Err(wrong(why.trim_end().to_owned()));
        }
        Ok(Some((given.name.clone(), value)))
    };
    let values: Vec<(String, SkillValue)> = given
        .iter()
        .filter_map(|given| value(given).transpose())
        .collect::<Result<_, _>>()?;
    if let Some(workspace) = &found.workspace {
        let allowed = workspace.allows_target(values.iter());
        allowed.map_err(|why| why.to_string())?;
    }
    Ok(values)
}

/// Reads a value that may be sent to a machine.
fn read(shape: ValueShape, json: &serde_json::Value) -> Result<SkillValue, String> {
    let value = shape.read_json(json).map_err(|error| error.to_string())?;
    match value.is_unreal() {
        true => Err(format!("{json} is not a number")),
        false => Ok(value),
    }
}

/// Returns the parameter of a skill with a name.
pub(super) fn parameter<'a>(
    found: &'a FoundSkill,
    name: &str,
) -> Result<&'a FoundParameter, String> {
    named(&found.parameters, name)
        .map_err(|known| format!("{} has no parameter {name}; {known}", found.name))
}

/// Returns the result of a skill with a name.
pub(super) fn result<'a>(found: &'a FoundSkill, name: &str) -> Result<&'a FoundParameter, String> {
    named(&found.results, name)
        .map_err(|known| format!("{} has no result {name}; {known}", found.name))
}

fn named<'a>(all: &'a [FoundParameter], name: &str) -> Result<&'a FoundParameter, String> {
    all.iter().find(|known| known.name == name).ok_or_else(|| {
        let known: Vec<_> = all.iter().map(|known| known.name.as_str()).collect();
        match known.as_slice() {
            [] => "it has none".to_owned(),
            known => format!("it has {}", known.join(", ")),
        }
    })
}

/// Checks that a result can be a parameter: its kind of value and its unit.
pub(super) fn connects(from: &FoundParameter, to: &FoundParameter) -> Result<(), String> {
    let (has, wanted) = (kind(from), kind(to));
    if has != wanted {
        return Err(format!("{} is {has}, and {wanted} is expected", from.name));
    }
    match (from.unit.as_deref(), to.unit.as_deref()) {
        (Some(from_unit), Some(to_unit)) if units::convert(1.0, from_unit, to_unit).is_none() => {
            Err(format!(
                "{} has the unit {from_unit}, which cannot be converted to {to_unit}",
                from.name
            ))
        }
        (Some(unit), None) => Err(format!(
            "{} has the unit {unit}, and the skill gives no unit",
            from.name
        )),
        _ => Ok(()),
    }
}

/// Returns the kind of the values of a parameter, in words.
fn kind(of: &FoundParameter) -> &'static str {
    use Builtin::{
        Boolean, Byte, Double, Float, Int16, Int32, Int64, SByte, UInt16, UInt32, UInt64,
    };
    match (of.shape.builtin, of.shape.array) {
        (Boolean, false) => "a Boolean",
        (Boolean, true) => "a list of Booleans",
        (
            SByte | Byte | Int16 | UInt16 | Int32 | UInt32 | Int64 | UInt64 | Float | Double,
            is_list,
        ) => {
            if is_list {
                "a list of numbers"
            } else {
                "a number"
            }
        }
        (_, false) => "a text",
        (_, true) => "a list of texts",
    }
}

/// Returns the value of a parameter in the unit of the skill.
fn in_unit(
    given: &GivenParameter,
    parameter: &FoundParameter,
) -> Result<serde_json::Value, String> {
    let Some(from) = given.unit.as_deref() else {
        return Ok(given.value.clone());
    };
    let Some(to) = parameter.unit.as_deref() else {
        return Err(format!("the skill gives no unit, and {from} is given"));
    };
    if from == to {
        return Ok(given.value.clone());
    }
    let one = |value: &serde_json::Value| {
        let number = value.as_f64();
        let number =
            number.ok_or_else(|| format!("`{value}` with the unit {from} is no number"))?;
        let converted = units::convert(number, from, to);
        converted
            .map(Into::into)
            .ok_or_else(|| format!("its unit is {to}, and {from} cannot be converted to it"))
    };
    if let serde_json::Value::Array(all) = &given.value {
        return all.iter().map(one).collect();
    }
    one(&given.value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_that_is_not_finite_is_refused() {
        let shape = ValueShape::scalar(Builtin::Double);
        assert_eq!(read(shape, &2.5.into()), Ok(SkillValue::Double(2.5)));
        for text in ["NaN", "Infinity", "-Infinity"] {
            let why = read(shape, &text.into()).unwrap_err();
            assert!(why.contains("is not a number"), "{why}");
        }
    }
}
