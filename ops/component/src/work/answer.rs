//! The answers of the executors of calls and actions, as values of skills.

use bridge_node::CallField;
use serde_json::Value as Json;
use skills::{Builtin, SkillValue, ValueShape};
use uadp::Fields;

use crate::fields;

/// The fields of an answer with types that a skill supports.
#[derive(Debug)]
pub(super) struct SpaceAnswer(Vec<(String, Json)>);

impl SpaceAnswer {
    /// Decodes an answer with these fields.
    ///
    /// # Errors
    /// A message for the operator, if the bytes are not such fields.
    pub(super) fn read(block: &[u8], response: &[CallField]) -> Result<Self, String> {
        let unread = |error: &dyn std::fmt::Display| format!("the answer does not read: {error}");
        let values = Fields::parse(block).map_err(|error| unread(&error))?;
        let mut answer = Vec::new();
        for (value, field) in values.zip(response) {
            let value = value.map_err(|error| unread(&error))?;
            if let Ok(Some(value)) = fields::value(&value) {
                answer.push((field.name.clone(), value.to_json()));
            }
        }
        Ok(Self(answer))
    }

    #[cfg(test)]
    pub(super) const fn of(fields: Vec<(String, Json)>) -> Self {
        Self(fields)
    }

    pub(super) fn field(&self, name: &str) -> Option<&Json> {
        let found = self.0.iter().find(|(known, _)| known == name);
        found.map(|(_, value)| value)
    }

    /// Returns the text of a field; empty if there is none.
    pub(super) fn text(&self, name: &str) -> &str {
        self.field(name).and_then(Json::as_str).unwrap_or_default()
    }

    /// Returns the first field as a number.
    pub(super) fn code(&self) -> Option<i64> {
        let (_, code) = self.0.first()?;
        code.as_i64()
    }

    /// Returns the end of the goal that the answer is about.
    pub(super) fn end(&self) -> AnsweredEnd {
        match self.field("status").and_then(Json::as_i64) {
            Some(4) => AnsweredEnd::Succeeded,
            Some(5) => AnsweredEnd::Canceled,
            Some(6) => AnsweredEnd::Aborted,
            Some(-1) => AnsweredEnd::NeverRan,
            Some(_) | None => AnsweredEnd::Unknown,
        }
    }

    /// Returns the end of a goal as text for the operator, with the message of its server if it has
    /// a message.
    pub(super) fn end_text(&self, how: &str) -> String {
        let message = self.text("message").trim();
        let fields = self.0.iter();
        let texts = fields.filter_map(|(name, value)| Some((name.as_str(), value.as_str()?)));
        let message = Some(message).filter(|message| !message.is_empty());
        match message.or_else(|| messages::reason_of(texts)) {
            None => format!("the goal was {how}"),
            Some(message) => format!("the goal was {how}: {message}"),
        }
    }

    /// Returns the fields with this prefix as results, by the names that results of OPC UA have.
    pub(super) fn results(&self, prefix: &str) -> impl Iterator<Item = (String, SkillValue)> {
        self.0.iter().filter_map(move |(name, value)| {
            let name = camel(name.strip_prefix(prefix)?);
            Some((name, plain(value)?))
        })
    }
}

/// The end of a goal, as its executor reports it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AnsweredEnd {
    Succeeded,
    Canceled,
    Aborted,
    /// The goal was rejected or not sent.
    NeverRan,
    Unknown,
}

/// Returns true if a value equals the written value.
pub(super) fn is(value: &Json, wanted: &str) -> bool {
    match value {
        Json::String(text) => text == wanted,
        Json::Number(number) => wanted
            .parse::<f64>()
            .is_ok_and(|wanted| number.as_f64() == Some(wanted)),
        Json::Bool(truth) => wanted.parse() == Ok(*truth),
        Json::Null => wanted == "null",
        Json::Array(_) | Json::Object(_) => false,
    }
}

/// Converts a value of an answer into the widest type of its kind. The type of the skill narrows
/// it.
pub(super) fn plain(value: &Json) -> Option<SkillValue> {
    let of = |builtin| ValueShape::scalar(builtin).read_json(value).ok();
    match value {
        Json::Bool(_) => of(Builtin::Boolean),
        Json::String(_) => of(Builtin::String),
        Json::Number(number) if number.is_i64() => of(Builtin::Int64),
        Json::Number(_) => of(Builtin::Double),
        Json::Array(elements) => {
            let builtin = match elements.first() {
                Some(Json::Bool(_)) => Builtin::Boolean,
                Some(Json::String(_)) => Builtin::String,
                Some(_) | None => Builtin::Double,
            };
            ValueShape::array(builtin).read_json(value).ok()
        }
        Json::Null | Json::Object(_) => None,
    }
}

/// Converts a name of ROS into a result name of OPC UA: `TargetPosition` for `target_position`.
fn camel(name: &str) -> String {
    let mut spelled = String::new();
    let mut begins = true;
    for c in name.chars() {
        match (c, begins) {
            ('_', _) => begins = true,
            (c, true) => {
                spelled.push(c.to_ascii_uppercase());
                begins = false;
            }
            (c, false) => spelled.push(c),
        }
    }
    spelled
}
