//! The skill types as ROS actions (`ua_msgs/Grasp`), and the fields of their goals, results and
//! feedback in the space. Both follow from the same table of skill types.

use bridge_core::CallField;
use messages::{Leaf, Rank};
use skills::model::{NAMESPACE, SKILL_TYPE, SkillType, find};
use skills::{Builtin, Parameter, Shape, TypeName, Value};
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
pub fn action_type(types: &[TypeName]) -> Option<String> {
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
fn note(parameter: &Parameter) -> String {
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
        Some(Value::Boolean(_)) | None => {}
        Some(default) if is_nothing(default) => {}
        Some(Value::Array(_, elements)) if elements.iter().all(is_nothing) => {}
        Some(Value::String(text)) => note.push_str(&format!(" \"\" is {text:?}.")),
        Some(Value::Array(..)) => note.push_str(" Has a default, where it is empty."),
        Some(number) => note.push_str(&format!(" 0 is {number}{unit}.")),
    }
    note
}

fn field(parameter: &Parameter, about: &str) -> String {
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
pub(crate) fn is_nothing(value: &Value) -> bool {
    match value {
        // A Boolean that is not set cannot be distinguished from a Boolean that is set.
        Value::Boolean(_) => false,
        Value::String(text) => text.is_empty(),
        Value::Array(_, elements) => elements.is_empty(),
        Value::SByte(_)
        | Value::Byte(_)
        | Value::Int16(_)
        | Value::UInt16(_)
        | Value::Int32(_)
        | Value::UInt32(_)
        | Value::Int64(_)
        | Value::UInt64(_)
        | Value::Float(_)
        | Value::Double(_) => value.as_f64() == Some(0.0),
    }
}

/// Returns the fields of a goal.
pub(crate) fn goal_fields(parameters: &[Parameter]) -> Vec<CallField> {
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
pub(crate) fn result_fields(results: &[Parameter]) -> Vec<CallField> {
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
        rank: Rank::Scalar,
    });
    leaves.collect()
}

fn call_field(parameter: &Parameter) -> CallField {
    let rank = match parameter.shape.array {
        false => Rank::Scalar,
        true => Rank::Array {
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
pub(crate) fn nothing(of: &Parameter) -> Value {
    let Shape { builtin, array } = of.shape;
    let one = match builtin {
        Builtin::Boolean => Value::Boolean(false),
        Builtin::SByte => Value::SByte(0),
        Builtin::Byte => Value::Byte(0),
        Builtin::Int16 => Value::Int16(0),
        Builtin::UInt16 => Value::UInt16(0),
        Builtin::Int32 => Value::Int32(0),
        Builtin::UInt32 => Value::UInt32(0),
        Builtin::Int64 => Value::Int64(0),
        Builtin::UInt64 => Value::UInt64(0),
        Builtin::Float => Value::Float(0.0),
        Builtin::Double => Value::Double(0.0),
        Builtin::String => Value::String(String::new()),
    };
    if !array {
        return one;
    }
    let count = of.length.unwrap_or_default();
    Value::Array(builtin, (0..count).map(|_| one.clone()).collect())
}
