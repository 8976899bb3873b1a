//! The parameters and results of skills: names, types, units and limits.

use knowledge::units;
use skills::{Builtin, FoundParameter, FoundSkill, SkillValue, ValueShape};

use crate::parameter_fault::{GivenFault, ParameterFault};
use crate::process::GivenParameter;

/// Converts the parameters of a step to the parameters of a skill.
///
/// # Errors
/// The first parameter that is unknown, missing, of another type or unit, or out of its limits.
pub(super) fn values(
    found: &FoundSkill,
    given: &[GivenParameter],
) -> Result<Vec<(String, SkillValue)>, ParameterFault> {
    for known in &found.parameters {
        let is_given = given.iter().any(|given| given.name == known.name);
        if known.default.is_none() && !is_given {
            return Err(ParameterFault::Missing {
                skill: found.name.clone(),
                parameter: known.name.clone(),
            });
        }
    }
    let value = |given: &GivenParameter| {
        let parameter = parameter(found, &given.name)?;
        // The value is known when its step is done, or when the step of its query begins.
        if given.result.is_some() || (given.query.is_some() && given.value.is_null()) {
            return Ok(None);
        }
        let wrong = |why| ParameterFault::Given(given.shown(), why);
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
            return Err(wrong(GivenFault::OutOfRange {
                number,
                low,
                high,
                unit: parameter.unit.clone().unwrap_or_default(),
            }));
        }
        Ok(Some((given.name.clone(), value)))
    };
    let values: Vec<(String, SkillValue)> = given
        .iter()
        .filter_map(|given| value(given).transpose())
        .collect::<Result<_, _>>()?;
    if let Some(workspace) = &found.workspace {
        workspace.allows_target(values.iter())?;
    }
    Ok(values)
}

/// Reads a value that may be sent to a machine.
fn read(shape: ValueShape, json: &serde_json::Value) -> Result<SkillValue, GivenFault> {
    let value = shape.read_json(json)?;
    match value.is_unreal() {
        true => Err(GivenFault::Unreal(json.clone())),
        false => Ok(value),
    }
}

/// Returns the parameter of a skill with a name.
pub(super) fn parameter<'a>(
    found: &'a FoundSkill,
    name: &str,
) -> Result<&'a FoundParameter, ParameterFault> {
    named(&found.name, ("parameter", &found.parameters), name)
}

/// Returns the result of a skill with a name.
pub(super) fn result<'a>(
    found: &'a FoundSkill,
    name: &str,
) -> Result<&'a FoundParameter, ParameterFault> {
    named(&found.name, ("result", &found.results), name)
}

fn named<'a>(
    skill: &str,
    (kind, all): (&'static str, &'a [FoundParameter]),
    name: &str,
) -> Result<&'a FoundParameter, ParameterFault> {
    let found = all.iter().find(|known| known.name == name);
    found.ok_or_else(|| ParameterFault::Unknown {
        skill: skill.to_owned(),
        kind,
        name: name.to_owned(),
        known: all.iter().map(|known| known.name.clone()).collect(),
    })
}

/// Checks that a result can be a parameter: its kind of value and its unit.
pub(super) fn connects(from: &FoundParameter, to: &FoundParameter) -> Result<(), ParameterFault> {
    let (has, wanted) = (kind(from), kind(to));
    let result = from.name.clone();
    if has != wanted {
        return Err(ParameterFault::Kind {
            result,
            has,
            wanted,
        });
    }
    match (from.unit.clone(), to.unit.clone()) {
        (Some(unit), Some(to)) if units::convert(1.0, &unit, &to).is_none() => {
            Err(ParameterFault::ResultUnit { result, unit, to })
        }
        (Some(unit), None) => Err(ParameterFault::SkillWithoutUnit { result, unit }),
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
) -> Result<serde_json::Value, GivenFault> {
    let Some(from) = given.unit.as_deref() else {
        return Ok(given.value.clone());
    };
    let Some(to) = parameter.unit.as_deref() else {
        return Err(GivenFault::NoUnit(from.to_owned()));
    };
    if from == to {
        return Ok(given.value.clone());
    }
    let one = |value: &serde_json::Value| {
        let number = value.as_f64().ok_or_else(|| GivenFault::NoNumber {
            value: value.clone(),
            unit: from.to_owned(),
        })?;
        let converted = units::convert(number, from, to);
        converted.map(Into::into).ok_or_else(|| GivenFault::Unit {
            from: from.to_owned(),
            to: to.to_owned(),
        })
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
            let unreal = GivenFault::Unreal(text.into());
            assert_eq!(read(shape, &text.into()), Err(unreal));
        }
    }
}
