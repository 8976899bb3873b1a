//! The skill types as ROS actions (`ua_msgs/Grasp`), and the fields of their goals, results and
//! feedback in the space. Both follow from the same table of skill types.

use bridge_core::CallField;
use messages::{ArrayRank, Leaf};
use skills::model::{NAMESPACE, SKILL_TYPE, SkillType, find};
use skills::{Builtin, ParameterType, SkillParameter, SkillValue, ValueShape};
use uadp::BuiltinType;

use crate::fields;

/// The package of the types.
pub const PACKAGE: &str = "ua_msgs";

/// The fields of feedback.
pub(crate) const FEEDBACK: [(&str, Builtin, &str); 4] = [
    (
        "state",
        Builtin::String,
        "Halted, Ready, Running or Suspended.",
    ),
    (
        "progress",
        Builtin::Float,
        "How much of the run is done, 0 to 1.",
    ),
    ("step", Builtin::String, "What it is at."),
    ("run", Builtin::UInt32, RUN_ABOUT),
];

/// The first field of a result: the run.
pub(crate) const RUN: &str = "run";
const RUN_ABOUT: &str = "Which run of the skill it is, counted from 1.";

/// Returns the name of a skill type's action: `Grasp` for `GraspSkillType`, and `RunSkill` for the
/// base type of all skills.
#[must_use]
pub fn action_name(skill_type: &SkillType) -> &'static str {
    match skill_type.name {
        SKILL_TYPE => "RunSkill",
        name => name.strip_suffix("SkillType").unwrap_or(name),
    }
}

/// Returns the action type of a skill: the action of its type, or of its nearest supertype in the
/// namespace of the built-in skill types.
#[must_use]
pub fn action_type(types: &[ParameterType]) -> Option<String> {
    let ours = types.iter().filter(|of| of.namespace == NAMESPACE);
    let nearest = ours.filter_map(|of| find(&of.name)).next()?;
    Some(format!("{PACKAGE}/{}", action_name(nearest)))
}

/// Returns the action of the base type of all skills.
pub(crate) fn of_all() -> String {
    format!("{PACKAGE}/RunSkill")
}

/// Converts a name of OPC UA into a field name of ROS: `target_position` for `TargetPosition`.
#[must_use]
pub fn field_name(name: &str) -> String {
    let mut spelled = String::new();
    let mut before: Option<char> = None;
    for c in name.chars() {
        let begins = c.is_ascii_uppercase()
            && before.is_some_and(|before| before.is_ascii_lowercase() || before.is_ascii_digit());
        if begins {
            spelled.push('_');
        }
        match c.is_ascii_alphanumeric() {
            true => spelled.push(c.to_ascii_lowercase()),
            // ROS 2 forbids two consecutive underscores.
            false if !spelled.ends_with('_') => spelled.push('_'),
            false => {}
        }
        before = Some(c);
    }
    spelled
}

/// Returns the text of a skill type's `.action` file, which is the same for ROS 1 and ROS 2.
#[must_use]
pub fn definition(skill_type: &'static SkillType) -> String {
    let mut text = format!(
        "# {}\n#\n# The action of {} ({NAMESPACE}).\n",
        skill_type.about, skill_type.name
    );
    for parameter in skill_type.parameters() {
        let note = note(&parameter);
        text.push_str(&field(&parameter, &format!("{}{note}", parameter.about)));
    }
    text.push_str("---\n");
    text.push_str(&plain(RUN, Builtin::UInt32, RUN_ABOUT));
    for result in skill_type.results() {
        text.push_str(&field(&result, &result.about));
    }
    text.push_str("---\n");
    for (name, builtin, about) in FEEDBACK {
        text.push_str(&plain(name, builtin, about));
    }
    text
}

/// Returns the unit, range and default of a parameter, as far as it has them.
fn note(parameter: &SkillParameter) -> String {
    let mut note = String::new();
    // Some tools of ROS 1 read only ASCII.
    let unit = parameter
        .unit
        .iter()
        .map(|unit| unit.replace('\u{b2}', "^2"));
    let unit: String = unit.map(|unit| format!(" {unit}")).collect();
    if let Some((low, high)) = parameter.range {
        note.push_str(&format!(" From {low} to {high}{unit}."));
    }
    match &parameter.default {
        Some(SkillValue::Boolean(_)) | None => {}
        Some(default) if is_nothing(default) => {}
        Some(SkillValue::Array(_, elements)) if elements.iter().all(is_nothing) => {}
        Some(SkillValue::String(text)) => note.push_str(&format!(" \"\" is {text:?}.")),
        Some(SkillValue::Array(..)) => note.push_str(" Has a default, where it is empty."),
        Some(number) => note.push_str(&format!(" 0 is {number}{unit}.")),
    }
    note
}

fn field(parameter: &SkillParameter, about: &str) -> String {
    let suffix = match (parameter.shape.array, parameter.length) {
        (false, _) => String::new(),
        (true, None) => "[]".to_owned(),
        (true, Some(length)) => format!("[{length}]"),
    };
    let ros = ros(parameter.shape.builtin);
    let name = field_name(&parameter.name);
    format!("\n# {about}\n{ros}{suffix} {name}\n")
}

fn plain(name: &str, builtin: Builtin, about: &str) -> String {
    format!("\n# {about}\n{} {name}\n", ros(builtin))
}

const fn ros(builtin: Builtin) -> &'static str {
    match builtin {
        Builtin::Boolean => "bool",
        Builtin::SByte => "int8",
        Builtin::Byte => "uint8",
        Builtin::Int16 => "int16",
        Builtin::UInt16 => "uint16",
        Builtin::Int32 => "int32",
        Builtin::UInt32 => "uint32",
        Builtin::Int64 => "int64",
        Builtin::UInt64 => "uint64",
        Builtin::Float => "float32",
        Builtin::Double => "float64",
        Builtin::String => "string",
    }
}

/// Returns true if a value is the default value of a ROS message.
pub(crate) fn is_nothing(value: &SkillValue) -> bool {
    match value {
        // A Boolean that is not set cannot be distinguished from a Boolean that is set.
        SkillValue::Boolean(_) => false,
        SkillValue::String(text) => text.is_empty(),
        SkillValue::Array(_, elements) => elements.is_empty(),
        SkillValue::SByte(_)
        | SkillValue::Byte(_)
        | SkillValue::Int16(_)
        | SkillValue::UInt16(_)
        | SkillValue::Int32(_)
        | SkillValue::UInt32(_)
        | SkillValue::Int64(_)
        | SkillValue::UInt64(_)
        | SkillValue::Float(_)
        | SkillValue::Double(_) => value.as_f64() == Some(0.0),
    }
}

/// Returns the fields of a goal.
pub(crate) fn goal_fields(parameters: &[SkillParameter]) -> Vec<CallField> {
    let fields = parameters.iter().map(|parameter| {
        let field = call_field(parameter);
        match parameter.default {
            Some(_) => field.optional(),
            None => field,
        }
    });
    fields.collect()
}

/// Returns the fields of a result.
pub(crate) fn result_fields(results: &[SkillParameter]) -> Vec<CallField> {
    let run = CallField::scalar(RUN, BuiltinType::UInt32);
    [run]
        .into_iter()
        .chain(results.iter().map(call_field))
        .collect()
}

/// Returns the fields of feedback.
pub(crate) fn feedback_fields() -> Vec<Leaf> {
    let leaves = FEEDBACK.iter().map(|(name, builtin, _)| Leaf {
        path: (*name).to_owned(),
        builtin: fields::builtin(*builtin),
        rank: ArrayRank::Scalar,
    });
    leaves.collect()
}

fn call_field(parameter: &SkillParameter) -> CallField {
    let rank = match parameter.shape.array {
        false => ArrayRank::Scalar,
        true => ArrayRank::Array {
            fixed: parameter.length,
        },
    };
    CallField {
        rank,
        ..CallField::scalar(
            &field_name(&parameter.name),
            fields::builtin(parameter.shape.builtin),
        )
    }
}

/// Returns the empty value of a result.
pub(crate) fn nothing(of: &SkillParameter) -> SkillValue {
    let ValueShape { builtin, array } = of.shape;
    let one = match builtin {
        Builtin::Boolean => SkillValue::Boolean(false),
        Builtin::SByte => SkillValue::SByte(0),
        Builtin::Byte => SkillValue::Byte(0),
        Builtin::Int16 => SkillValue::Int16(0),
        Builtin::UInt16 => SkillValue::UInt16(0),
        Builtin::Int32 => SkillValue::Int32(0),
        Builtin::UInt32 => SkillValue::UInt32(0),
        Builtin::Int64 => SkillValue::Int64(0),
        Builtin::UInt64 => SkillValue::UInt64(0),
        Builtin::Float => SkillValue::Float(0.0),
        Builtin::Double => SkillValue::Double(0.0),
        Builtin::String => SkillValue::String(String::new()),
    };
    if !array {
        return one;
    }
    let count = of.length.unwrap_or_default();
    SkillValue::Array(builtin, (0..count).map(|_| one.clone()).collect())
}
