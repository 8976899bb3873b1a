//! The descriptions of topics and calls, as announced by their writers.
//!
//! The announced name begins with the topic, because an announcement has no WriterGroupId. The
//! display name follows after a space: `ua_0_7_101 gripper.Grasp.State`. The description is the ROS
//! type of the fields, followed by `; ` and further information, such as the type of a skill.

use mappings::TopicId;
use serde::Serialize;
use uadp::discovery::{
    ActionMetaData, DataSetMetaDataType, DataTypeSchemaHeader, EUInformation, FieldMetaData, Range,
    SettingsStructure as _,
};
use uadp::{BuiltinType, Scalar, Variant};

use super::structure::StructureFields;

/// The announced description of a topic or call.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct AnnouncedDescription {
    /// The display name of the DataSet or Action; may be empty.
    pub(crate) name: String,
    /// The description by the writer.
    pub(crate) description: String,
    /// The ROS topics and services of a value, each with its space.
    pub(crate) ros_topics: Vec<(u8, String)>,
    /// Whether the writer says that the value acts where it arrives.
    pub(crate) command: bool,
    pub(crate) what: DescribedKind,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum DescribedKind {
    Value(Vec<AnnouncedField>),
    Call(DescribedCall),
}

/// The request and response of a call, and its targets.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DescribedCall {
    pub(crate) request: Vec<AnnouncedField>,
    pub(crate) response: Vec<AnnouncedField>,
    /// ActionTargetIds; never empty.
    pub(crate) targets: Vec<u16>,
    /// The parts of the action, for a call that sends goals.
    pub(crate) action: Option<DescribedAction>,
}

/// The DataSetWriterIds of an action besides the id of its goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DescribedAction {
    pub(crate) cancel: u16,
    pub(crate) result: u16,
    pub(crate) feedback: u16,
}

/// A field of a DataSet.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct AnnouncedField {
    pub(crate) name: String,
    /// `None` for an id that is not a builtin type.
    pub(crate) builtin: Option<BuiltinType>,
    /// The ValueRank of the standard: -1 for a scalar, otherwise the number of dimensions or a
    /// constraint on it.
    pub(crate) rank: i32,
    /// Maximum number of elements in each dimension, 0 if unlimited.
    pub(crate) dimensions: Vec<u32>,
    pub(crate) max_string_length: u32,
    /// The description for people.
    pub(crate) description: String,
    pub(crate) meaning: FieldMeaning,
    /// True if a request may leave the field out.
    pub(crate) optional: bool,
    /// The fields of the messages in this field.
    pub(crate) structure: Option<StructureFields>,
}

/// The meaning of a field, as far as it is announced.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct FieldMeaning {
    /// The symbol of the unit; may be empty.
    pub(crate) unit: String,
    /// The lowest and the highest value.
    pub(crate) range: Option<(f64, f64)>,
    /// The default value of a parameter, as text.
    pub(crate) default: Option<String>,
}

/// A field as `--json` shows it.
#[derive(Debug, Serialize)]
pub(crate) struct ShownField<'a> {
    name: &'a str,
    #[serde(rename = "type")]
    kind: String,
    #[serde(skip_serializing_if = "str::is_empty")]
    description: &'a str,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    optional: bool,
    #[serde(skip_serializing_if = "str::is_empty")]
    unit: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    range: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    default: Option<&'a str>,
}

impl AnnouncedDescription {
    /// Reads the description of a DataSet.
    ///
    /// # Errors
    /// The name of the part that exceeds a limit.
    pub(crate) fn of_value(meta_data: &DataSetMetaDataType<'_>) -> Result<Self, &'static str> {
        Ok(Self {
            name: called(meta_data.name)?,
            description: bounded(meta_data.description.text, "the description")?,
            ros_topics: ros_topics(meta_data),
            command: is_command(meta_data),
            what: DescribedKind::Value(fields(meta_data)?),
        })
    }

    /// Reads the description of an Action.
    ///
    /// # Errors
    /// The name of the part that exceeds a limit.
    pub(crate) fn of_call(meta_data: &ActionMetaData<'_>) -> Result<Self, &'static str> {
        let targets = meta_data.action_targets.iter().take(MOST_TARGETS);
        let targets: Vec<u16> = targets.map(|target| target.action_target_id).collect();
        if targets.is_empty() {
            return Err("a call on nothing");
        }
        Ok(Self {
            name: called(meta_data.request.name)?,
            description: bounded(meta_data.request.description.text, "the description")?,
            ros_topics: ros_topics(&meta_data.request),
            command: false,
            what: DescribedKind::Call(DescribedCall {
                request: fields(&meta_data.request)?,
                response: fields(&meta_data.response)?,
                targets,
                action: action(&meta_data.request),
            }),
        })
    }

    /// Returns the names for people: the display name and the ROS topics.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        let name = Some(self.name.as_str()).filter(|name| !name.is_empty());
        let ros = self.ros_topics.iter().map(|(_, topic)| topic.as_str());
        name.into_iter().chain(ros)
    }

    /// Returns the fields of the values, or of the response of the call.
    pub(crate) fn fields(&self) -> &[AnnouncedField] {
        match &self.what {
            DescribedKind::Value(fields) => fields,
            DescribedKind::Call(call) => &call.response,
        }
    }

    pub(crate) fn call(&self) -> Option<&DescribedCall> {
        match &self.what {
            DescribedKind::Value(_) => None,
            DescribedKind::Call(call) => Some(call),
        }
    }

    /// Returns the ROS type of the fields, if the description begins with a type.
    pub(crate) fn ros_type(&self) -> Option<&str> {
        let first = self.description.split([';', ' ']).next()?;
        let is_type = first.parse::<messages::TypeName>().is_ok();
        is_type.then_some(first)
    }

    /// Returns whether the only field is a message as on the wire.
    pub(crate) fn is_bytes(&self) -> bool {
        let kind = self.description.split(';').next().unwrap_or_default();
        kind.trim_end().ends_with(AS_BYTES)
    }

    /// Returns the name and namespace of the SkillType from the description of a state, as
    /// `GraspSkillType nsu=urn:ua-bridge:skills`.
    pub(crate) fn skill_type(&self) -> Option<(&str, &str)> {
        let (before, after) = self.description.split_once("nsu=")?;
        let name = before.split_whitespace().next_back()?;
        let namespace = after.split_whitespace().next().unwrap_or_default();
        Some((name, namespace))
    }

    /// Returns the request and response, or the type, in one line.
    pub(crate) fn summary(&self) -> String {
        match &self.what {
            DescribedKind::Value(fields) => match (self.ros_type(), fields.as_slice()) {
                (Some(name), _) => name.to_owned(),
                (None, [one]) => one.kind(),
                (None, []) => "-".to_owned(),
                (None, many) => format!("{} fields", many.len()),
            },
            DescribedKind::Call(call) => {
                format!("({}) -> ({})", list(&call.request), list(&call.response))
            }
        }
    }

    /// Returns the summary, or the numbers of fields of a call if its summary is longer than
    /// `limit` characters: a signature that is cut off says less.
    pub(crate) fn summary_within(&self, limit: usize) -> String {
        let summary = self.summary();
        match &self.what {
            DescribedKind::Call(call) if summary.chars().count() > limit => {
                let [takes, gives] =
                    [&call.request, &call.response].map(|fields| match fields.len() {
                        0 => String::new(),
                        1 => "1 field".to_owned(),
                        several => format!("{several} fields"),
                    });
                format!("({takes}) -> ({gives})")
            }
            DescribedKind::Call(_) | DescribedKind::Value(_) => summary,
        }
    }

    /// Returns the approximate size in bytes.
    pub(crate) fn weight(&self) -> usize {
        let of = |fields: &[AnnouncedField]| -> usize {
            let texts = fields.iter().map(|field| {
                let structure = field.structure.as_ref().map_or(0, StructureFields::weight);
                field.name.len() + field.description.len() + field.dimensions.len() * 4 + structure
            });
            texts.sum::<usize>() + size_of_val(fields)
        };
        let what = match &self.what {
            DescribedKind::Value(fields) => of(fields),
            DescribedKind::Call(call) => {
                of(&call.request) + of(&call.response) + call.targets.len() * 2
            }
        };
        let ros = self.ros_topics.iter();
        let ros: usize = ros
            .map(|(_, topic)| topic.len() + size_of::<String>())
            .sum();
        size_of::<Self>() + self.name.len() + self.description.len() + ros + what
    }
}

impl AnnouncedField {
    /// Returns the type of the field, as `Double[6]`.
    pub(crate) fn kind(&self) -> String {
        let name = self.builtin.map_or("?", BuiltinType::name);
        match (self.rank, self.dimensions.as_slice()) {
            (-1, _) => name.to_owned(),
            (_, [] | [0]) => format!("{name}[]"),
            (_, sizes) => {
                let sizes: Vec<String> = sizes.iter().map(ToString::to_string).collect();
                format!("{name}[{}]", sizes.join(","))
            }
        }
    }

    /// Returns unit, range and default in words; empty if none is announced.
    pub(crate) fn meaning(&self) -> String {
        let FieldMeaning {
            unit,
            range,
            default,
        } = &self.meaning;
        let unit = match unit.as_str() {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        let range = range.map(|(low, high)| format!("{low} to {high}{unit}"));
        let only_unit = Some(unit.trim_start()).filter(|unit| !unit.is_empty());
        let range = range.or_else(|| only_unit.map(str::to_owned));
        let default = default.as_ref().map(|default| format!("default {default}"));
        let parts: Vec<String> = range.into_iter().chain(default).collect();
        parts.join(", ")
    }

    /// Returns a field without a meaning: a scalar, or an array with the size, which is 0 if
    /// unlimited.
    pub(super) fn plain(name: &str, builtin: BuiltinType, size: Option<u32>) -> Self {
        Self {
            name: name.to_owned(),
            builtin: Some(builtin),
            rank: size.map_or(-1, |_| 1),
            dimensions: size.into_iter().collect(),
            max_string_length: 0,
            description: String::new(),
            meaning: FieldMeaning::default(),
            optional: false,
            structure: None,
        }
    }

    pub(crate) const fn is_array(&self) -> bool {
        self.rank != -1
    }

    pub(crate) fn shown(&self) -> ShownField<'_> {
        ShownField {
            name: &self.name,
            kind: self.kind(),
            description: &self.description,
            optional: self.optional,
            unit: &self.meaning.unit,
            range: self.meaning.range.map(|(low, high)| [low, high]),
            default: self.meaning.default.as_deref(),
        }
    }
}

/// Returns a list of fields, as `TargetPosition: Double[6], [MaxVelocity: Double]`, with optional
/// fields in brackets.
pub(crate) fn list(fields: &[AnnouncedField]) -> String {
    let each = fields.iter().map(|field| {
        let text = format!("{}: {}", field.name, field.kind());
        if field.optional {
            format!("[{text}]")
        } else {
            text
        }
    });
    each.collect::<Vec<_>>().join(", ")
}

/// Returns the topic at the beginning of a name.
pub(crate) fn topic_of(name: Option<&str>) -> Option<TopicId> {
    name?.split(' ').next()?.parse().ok()
}

/// Returns the display name after the topic.
fn called(name: Option<&str>) -> Result<String, &'static str> {
    let rest = name.and_then(|name| name.split_once(' '));
    bounded(rest.map(|(_, rest)| rest), "the name")
}

fn fields(meta_data: &DataSetMetaDataType<'_>) -> Result<Vec<AnnouncedField>, &'static str> {
    if meta_data.fields.len() > MOST_FIELDS {
        return Err("too many fields");
    }
    let mut room = MOST_FIELDS;
    let fields = meta_data.fields.iter();
    fields
        .map(|field| read(&field, &meta_data.schema, &mut room))
        .collect()
}

fn read(
    field: &FieldMetaData<'_>,
    schema: &DataTypeSchemaHeader<'_>,
    room: &mut usize,
) -> Result<AnnouncedField, &'static str> {
    if field.array_dimensions.len() > MOST_DIMENSIONS {
        return Err("too many dimensions");
    }
    let builtin = field.builtin_type();
    let is_structure = builtin == Some(BuiltinType::ExtensionObject);
    let structure = is_structure.then(|| StructureFields::of(schema, field.data_type, room));
    Ok(AnnouncedField {
        name: bounded(field.name, "the name of a field")?,
        builtin,
        structure: structure.flatten(),
        rank: field.value_rank,
        dimensions: field.array_dimensions.iter().collect(),
        max_string_length: field.max_string_length,
        description: bounded(field.description.text, "the description of a field")?,
        meaning: meaning(field),
        optional: has_true(field, OPTIONAL),
    })
}

/// Reads unit, range and default of a field, as far as they are well formed.
fn meaning(field: &FieldMetaData<'_>) -> FieldMeaning {
    let mut meaning = FieldMeaning::default();
    for property in field.properties.iter().take(MOST_PROPERTIES) {
        match (property.key.name, property.value) {
            (Some("EngineeringUnits"), Variant::Scalar(Scalar::ExtensionObject(object))) => {
                let unit = EUInformation::from_object(&object);
                let symbol = unit.ok().flatten().and_then(|unit| unit.display_name.text);
                let symbol = symbol.filter(|symbol| symbol.len() <= MOST_TEXT);
                meaning.unit = symbol.unwrap_or_default().to_owned();
            }
            (Some("EURange"), Variant::Scalar(Scalar::ExtensionObject(object))) => {
                let range = Range::from_object(&object).ok().flatten();
                meaning.range = range.map(|range| (range.low, range.high));
            }
            (Some("Default"), Variant::Scalar(Scalar::String(Some(text)))) => {
                meaning.default = Some(text.to_owned()).filter(|text| text.len() <= MOST_TEXT);
            }
            _ => {}
        }
    }
    meaning
}

/// Reads the ROS topics from the first field, as far as they are well formed.
fn ros_topics(meta_data: &DataSetMetaDataType<'_>) -> Vec<(u8, String)> {
    let Some(first) = meta_data.fields.get(0) else {
        return Vec::new();
    };
    let mut properties = first.properties.iter().take(MOST_PROPERTIES);
    let property = properties.find(|property| property.key.name == Some(ROS_TOPICS));
    let Some(Variant::Array(topics)) = property.map(|property| property.value) else {
        return Vec::new();
    };
    let topics = topics.iter().take(MOST_ROS_TOPICS);
    let topics = topics.filter_map(|topic| {
        let Scalar::String(Some(text)) = topic else {
            return None;
        };
        let (space, topic) = text.split_once(' ')?;
        let topic = Some(topic).filter(|topic| topic.len() <= MOST_TEXT)?;
        Some((space.parse().ok()?, topic.to_owned()))
    });
    topics.collect()
}

/// Returns whether the first field is marked as a command.
fn is_command(meta_data: &DataSetMetaDataType<'_>) -> bool {
    let first = meta_data.fields.get(0);
    first.is_some_and(|first| has_true(&first, COMMAND))
}

/// Returns whether a property of the field is true.
fn has_true(field: &FieldMetaData<'_>, name: &str) -> bool {
    let mut properties = field.properties.iter().take(MOST_PROPERTIES);
    let yes = Variant::Scalar(Scalar::Boolean(true));
    properties.any(|property| property.key.name == Some(name) && property.value == yes)
}

/// Reads the parts of an action from the first field of a request that sends goals.
fn action(request: &DataSetMetaDataType<'_>) -> Option<DescribedAction> {
    let first = request.fields.get(0)?;
    let mut properties = first.properties.iter().take(MOST_PROPERTIES);
    let family = properties.find(|property| property.key.name == Some(ACTION_FAMILY))?;
    let Variant::Array(family) = family.value else {
        return None;
    };
    let mut numbers = family.iter().map(|number| {
        let Scalar::UInt16(number) = number else {
            return None;
        };
        (number != 0).then_some(number)
    });
    let mut next = || numbers.next().flatten();
    Some(DescribedAction {
        cancel: next()?,
        result: next()?,
        feedback: next()?,
    })
}

fn bounded(text: Option<&str>, what: &'static str) -> Result<String, &'static str> {
    let text = text.unwrap_or_default();
    if text.len() <= MOST_TEXT {
        Ok(text.to_owned())
    } else {
        Err(what)
    }
}

/// The end of the description of a message as on the wire.
const AS_BYTES: &str = " as bytes";
/// The property of the first field with the ROS topics, each as `1 /joint_states`.
const ROS_TOPICS: &str = "RosTopics";
/// The property of the first field of a value that acts where it arrives.
const COMMAND: &str = "Command";
/// The property of a field that a request may leave out.
const OPTIONAL: &str = "Optional";
/// The property of the first field of a request that sends goals: the DataSetWriterIds of cancel,
/// result, feedback and status.
const ACTION_FAMILY: &str = "ActionFamily";
const MOST_PROPERTIES: usize = 64;
const MOST_ROS_TOPICS: usize = 16;
const MOST_TEXT: usize = 1024;
const MOST_FIELDS: usize = 1000;
const MOST_DIMENSIONS: usize = 8;
const MOST_TARGETS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn described(description: &str) -> AnnouncedDescription {
        AnnouncedDescription {
            name: "gripper.Grasp.State".to_owned(),
            description: description.to_owned(),
            ros_topics: Vec::new(),
            command: false,
            what: DescribedKind::Value(Vec::new()),
        }
    }

    #[test]
    fn a_description_says_the_ros_type_the_skill_type_or_both() {
        let both = described("ua_msgs/SkillState; GraspSkillType nsu=urn:ua-bridge:skills");
        assert_eq!(both.ros_type(), Some("ua_msgs/SkillState"));
        let skill = Some(("GraspSkillType", "urn:ua-bridge:skills"));
        assert_eq!(both.skill_type(), skill);
        let one = described("; GraspSkillType nsu=urn:ua-bridge:skills");
        assert_eq!((one.ros_type(), one.skill_type()), (None, skill));
        let other = described("geometry_msgs/Twist as bytes");
        assert_eq!(other.ros_type(), Some("geometry_msgs/Twist"));
        assert_eq!(other.skill_type(), None);
    }

    #[test]
    fn a_long_signature_is_shown_by_its_numbers_of_fields() {
        let field = |name| AnnouncedField::plain(name, BuiltinType::Boolean, None);
        let call = AnnouncedDescription {
            what: DescribedKind::Call(DescribedCall {
                request: vec![field("on")],
                response: vec![field("success"), field("is_running")],
                targets: vec![1],
                action: None,
            }),
            ..described("")
        };
        let whole = "(on: Boolean) -> (success: Boolean, is_running: Boolean)";
        assert_eq!(call.summary_within(60), whole);
        assert_eq!(call.summary_within(40), "(1 field) -> (2 fields)");
        // A type of ROS has no shorter form.
        let value = described("std_msgs/Bool");
        assert_eq!(value.summary_within(4), "std_msgs/Bool");
    }

    #[test]
    fn a_field_is_called_by_its_type_and_sizes() {
        let field = |rank, dimensions: &[u32]| AnnouncedField {
            rank,
            dimensions: dimensions.to_vec(),
            ..AnnouncedField::plain("TargetPosition", BuiltinType::Double, None)
        };
        assert_eq!(field(-1, &[]).kind(), "Double");
        assert_eq!(field(1, &[6]).kind(), "Double[6]");
        assert_eq!(field(1, &[0]).kind(), "Double[]");
        assert_eq!(field(2, &[2, 3]).kind(), "Double[2,3]");
    }
}
