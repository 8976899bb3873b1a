//! The topics of a group as channels of robot data: ROS messages where the writer announces a ROS
//! type whose definition is known, JSON otherwise.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use bridge_core::decode_fields;
use bridge_node::{Definitions, RosEnvironment, TypePaths};
use mappings::{SpaceId, TopicId};
use messages::{ArrayRank, Dialect, Leaf, MessagePlan, MessageType, Selection, TypeName, Wire};
use serde_json::{Map, Value, json};
use uadp::{BuiltinType, DataSetMessage, MessageKind, Scalar, Variant};

use super::described::{AnnouncedDescription, AnnouncedField, DescribedKind};
use super::plain;
use super::robot::{self, RobotModelMessage};

/// The channels of all topics with values. A topic with a new description gets a new channel.
pub(super) struct TopicChannels {
    topics: BTreeMap<TopicId, Slot>,
    /// The names of the channels, and the topics that use them. Models of robots have no topic.
    names: BTreeMap<String, Option<TopicId>>,
    ros1: Definitions,
    ros2: Definitions,
    /// The id of the last channel.
    last: u16,
    /// ROS types without a usable definition.
    unknown: BTreeSet<String>,
}

struct Slot {
    /// The time of the first value without a description.
    first: Duration,
    /// All channels of the topic; the one that was used last is at the end.
    made: Vec<Arc<TopicChannel>>,
}

/// The values of a topic in one form.
#[derive(Debug)]
pub(super) struct TopicChannel {
    /// From 1 on.
    pub(super) id: u16,
    /// The ROS topic, or the name of the value, or the topic of the space.
    pub(super) name: String,
    /// The encoding of the messages: `cdr`, `ros1` or `json`.
    pub(super) encoding: &'static str,
    pub(super) schema_name: String,
    /// The language of the schema: `ros2msg`, `ros1msg` or `jsonschema`.
    pub(super) schema_encoding: &'static str,
    pub(super) schema: String,
    /// Further information for users.
    pub(super) metadata: BTreeMap<String, String>,
    form: ChannelForm,
    described: Option<Arc<AnnouncedDescription>>,
}

#[derive(Debug)]
enum ChannelForm {
    /// The fields form a ROS message.
    Ros(Box<MessagePlan>),
    /// The only field is the ROS message as on the wire.
    Bytes,
    Json,
}

/// The reason why a value is not in its channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum ChannelMismatch {
    /// The writer is asked for the description.
    Undescribed,
    /// The number of channels is limited, of all topics and of each topic.
    Channels,
    /// The value does not match the announced description, or cannot be decoded.
    Mismatch,
}

impl ChannelMismatch {
    /// Returns the text for output.
    pub(super) const fn label(self) -> &'static str {
        match self {
            Self::Undescribed => "values before the description of their topic",
            Self::Channels => "values of more topics and descriptions than there are channels",
            Self::Mismatch => "values that do not match the description of their topic",
        }
    }
}

impl TopicChannels {
    /// Creates the channels with the definitions of ROS types of this host.
    pub(super) fn new() -> Self {
        let definitions = |dialect| {
            let none = Arc::new(TypePaths::default());
            Definitions::new(dialect, none, RosEnvironment::from_env())
        };
        Self {
            topics: BTreeMap::new(),
            names: BTreeMap::new(),
            ros1: definitions(Dialect::Ros1),
            ros2: definitions(Dialect::Ros2),
            last: 0,
            unknown: BTreeSet::new(),
        }
    }

    /// Returns the channel of a value with this description, and makes it first if needed. A value
    /// without a description gets a channel only some time after the first value of its topic.
    ///
    /// # Errors
    /// [`ChannelMismatch`] if there is no channel.
    pub(super) fn channel(
        &mut self,
        topic: TopicId,
        described: Option<&Arc<AnnouncedDescription>>,
        now: Duration,
    ) -> Result<Arc<TopicChannel>, ChannelMismatch> {
        let slot = self.topics.entry(topic).or_insert_with(|| Slot {
            first: now,
            made: Vec::new(),
        });
        if let Some(channel) = slot.fitting(described) {
            return Ok(channel);
        }
        if described.is_none() && now < slot.first + DESCRIBED_WITHIN {
            return Err(ChannelMismatch::Undescribed);
        }
        if slot.made.len() >= MOST_OF_TOPIC {
            return Err(ChannelMismatch::Channels);
        }
        let id = self.last.checked_add(1).ok_or(ChannelMismatch::Channels)?;
        self.last = id;
        let channel = Arc::new(self.make(id, topic, described));
        if let Some(slot) = self.topics.get_mut(&topic) {
            slot.made.push(Arc::clone(&channel));
        }
        Ok(channel)
    }

    /// Makes the channel of the model of a robot.
    ///
    /// # Errors
    /// [`ChannelMismatch`] if there is no channel, or the type of its message is not known.
    pub(super) fn of_model(
        &mut self,
        model: &RobotModelMessage,
    ) -> Result<Arc<TopicChannel>, ChannelMismatch> {
        let name: TypeName = robot::TYPE.parse().map_err(|_| ChannelMismatch::Mismatch)?;
        let message = self
            .ros2
            .find(&name)
            .map_err(|_| ChannelMismatch::Mismatch)?;
        self.last = self.last.checked_add(1).ok_or(ChannelMismatch::Channels)?;
        self.names.insert(model.topic.clone(), None);
        Ok(Arc::new(TopicChannel {
            id: self.last,
            name: model.topic.clone(),
            encoding: "cdr",
            schema_name: name.ros2(),
            schema_encoding: "ros2msg",
            schema: message.definition().to_owned(),
            metadata: BTreeMap::from([(MODEL.to_owned(), "urdf".to_owned())]),
            form: ChannelForm::Bytes,
            described: None,
        }))
    }

    /// Returns the ROS types that are recorded as JSON because their definitions are missing or
    /// differ.
    pub(super) const fn unknown(&self) -> &BTreeSet<String> {
        &self.unknown
    }

    fn make(
        &mut self,
        id: u16,
        topic: TopicId,
        described: Option<&Arc<AnnouncedDescription>>,
    ) -> TopicChannel {
        let ros = described.and_then(|described| self.ros(topic, described));
        let mut metadata = BTreeMap::from([
            ("topic".to_owned(), topic.to_string()),
            ("space".to_owned(), topic.space.to_string()),
        ]);
        if let Some(name) = described.map(|described| &described.name) {
            metadata.insert("name".to_owned(), name.clone());
        }
        let name = self.name(topic, described.map(AsRef::as_ref), ros.is_some());
        let described = described.map(Arc::clone);
        match ros {
            Some(Ros { message, form }) => {
                let is_ros1 = message.dialect() == Dialect::Ros1;
                let (encoding, schema_encoding, schema_name) = match is_ros1 {
                    true => ("ros1", "ros1msg", message.name().to_string()),
                    false => ("cdr", "ros2msg", message.name().ros2()),
                };
                TopicChannel {
                    id,
                    name,
                    encoding,
                    schema_name,
                    schema_encoding,
                    schema: message.definition().to_owned(),
                    metadata,
                    form,
                    described,
                }
            }
            None => TopicChannel {
                id,
                name,
                encoding: "json",
                schema_name: topic.to_string(),
                schema_encoding: "jsonschema",
                schema: schema(described.as_deref()).to_string(),
                metadata,
                form: ChannelForm::Json,
                described,
            },
        }
    }

    /// Returns the ROS message of a value; `None` if its definition is not known.
    fn ros(&mut self, topic: TopicId, described: &AnnouncedDescription) -> Option<Ros> {
        let name: TypeName = described.ros_type()?.parse().ok()?;
        let bytes = described.is_bytes();
        let found = match bytes && topic.space == SpaceId::ROS1 {
            true => self.ros1.find(&name).ok(),
            false => self.ros2.find(&name).ok(),
        };
        let form = found.as_ref().and_then(|message| match bytes {
            true => Some(ChannelForm::Bytes),
            false => {
                ros_plan(message, &name, described).map(|plan| ChannelForm::Ros(Box::new(plan)))
            }
        });
        match (found, form) {
            (Some(message), Some(form)) => Some(Ros { message, form }),
            _ => {
                if self.unknown.len() < MOST_UNKNOWN {
                    self.unknown.insert(name.to_string());
                }
                None
            }
        }
    }

    /// Returns a name that no other topic uses. A part of a message does not have the name of its
    /// ROS topic.
    fn name(
        &mut self,
        topic: TopicId,
        described: Option<&AnnouncedDescription>,
        is_ros: bool,
    ) -> String {
        let id = topic.to_string();
        let own = topic.space.get();
        let ros = described.filter(|_| is_ros).and_then(|described| {
            let of_space = |space| {
                described
                    .ros_topics
                    .iter()
                    .find(move |(of, _)| *of == space)
            };
            let found = of_space(own).or_else(|| described.ros_topics.first());
            found.map(|(_, topic)| topic.clone())
        });
        let named = || {
            let name = described.map(|described| viewed(&described.name));
            name.filter(|name| name.len() > 1)
        };
        let wanted = ros.or_else(named).unwrap_or_else(|| format!("/{id}"));
        let owner = *self.names.entry(wanted.clone()).or_insert(Some(topic));
        match owner == Some(topic) {
            true => wanted,
            false => format!("{wanted}/{id}"),
        }
    }
}

/// Returns the name of a value as a topic: `/Line/Speed` of `Line.Speed`. Viewers select parts of a
/// message by `TOPIC.FIELD`, so that their topics have no dots.
fn viewed(name: &str) -> String {
    let plain = |c: char| match c {
        '.' => '/',
        c if c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '/') => c,
        _ => '_',
    };
    let parts: String = name.chars().map(plain).collect();
    format!("/{}", parts.trim_matches('/'))
}

impl Slot {
    /// Returns the channel of a value with this description. A value without a description is in
    /// the channel that was used last.
    fn fitting(
        &mut self,
        described: Option<&Arc<AnnouncedDescription>>,
    ) -> Option<Arc<TopicChannel>> {
        let fits = |channel: &Arc<TopicChannel>| is_same(channel.described.as_ref(), described);
        let at = self.made.iter().rposition(fits)?;
        let channel = self.made.remove(at);
        self.made.push(Arc::clone(&channel));
        Some(channel)
    }
}

struct Ros {
    message: Arc<MessageType>,
    form: ChannelForm,
}

impl TopicChannel {
    /// Returns whether the channel has values with a description.
    pub(super) const fn is_described(&self) -> bool {
        self.described.is_some()
    }

    /// Appends the message of a value to `out`.
    ///
    /// # Errors
    /// [`ChannelMismatch::Mismatch`]; `out` is then unchanged.
    pub(super) fn encode(
        &self,
        message: &DataSetMessage<'_>,
        out: &mut Vec<u8>,
    ) -> Result<(), ChannelMismatch> {
        let unfit = |_| ChannelMismatch::Mismatch;
        match &self.form {
            ChannelForm::Ros(plan) => {
                let fields = message.fields().map_err(unfit)?;
                decode_fields(plan, fields, out).map_err(|_| ChannelMismatch::Mismatch)
            }
            ChannelForm::Bytes => {
                let mut fields = message.fields().map_err(unfit)?;
                match (fields.next(), fields.next()) {
                    (Some(Ok(Variant::Scalar(Scalar::ByteString(Some(bytes))))), None) => {
                        out.extend_from_slice(bytes);
                        Ok(())
                    }
                    _ => Err(ChannelMismatch::Mismatch),
                }
            }
            ChannelForm::Json => {
                let mut named =
                    plain::message(message, self.described.as_deref()).map_err(unfit)?;
                if message.kind == MessageKind::DeltaFrame {
                    named.0.insert(0, (DELTA.to_owned(), json!(true)));
                }
                serde_json::to_writer(out, &named).map_err(|_| ChannelMismatch::Mismatch)
            }
        }
    }
}

/// Returns whether a message has a value. Keep-alives and invalid messages have none, and neither
/// have heartbeats, which are headers only.
pub(super) fn is_value(message: &DataSetMessage<'_>) -> bool {
    message.kind != MessageKind::KeepAlive && !message.payload().is_empty() && message.is_valid()
}

/// Returns whether a channel of the first description fits a value with the second.
fn is_same(
    known: Option<&Arc<AnnouncedDescription>>,
    described: Option<&Arc<AnnouncedDescription>>,
) -> bool {
    match (known, described) {
        (_, None) => true,
        (None, Some(_)) => false,
        (Some(known), Some(described)) => Arc::ptr_eq(known, described) || known == described,
    }
}

/// Returns the conversion of the announced fields to the message; `None` if they do not form it.
pub(crate) fn ros_plan(
    message: &Arc<MessageType>,
    name: &TypeName,
    described: &AnnouncedDescription,
) -> Option<MessagePlan> {
    let fields = described.fields().iter().map(leaf);
    let of_writer = bridge_core::TopicMetaData {
        message_type: name.clone(),
        bytes: false,
        name: String::new(),
        about: String::new(),
        fields: fields.collect::<Option<_>>()?,
    };
    let selection: Selection = of_writer.selection(message)?;
    MessagePlan::compile(message, &selection, Wire::Cdr).ok()
}

fn leaf(field: &AnnouncedField) -> Option<Leaf> {
    let rank = match field.rank {
        -1 => ArrayRank::Scalar,
        1 => ArrayRank::Array {
            fixed: field.dimensions.first().copied().filter(|size| *size > 0),
        },
        _ => return None,
    };
    Some(Leaf {
        path: field.name.clone(),
        builtin: field.builtin?,
        rank,
    })
}

/// Returns the JSON Schema of a value.
fn schema(described: Option<&AnnouncedDescription>) -> Value {
    let mut properties = Map::new();
    if let Some(AnnouncedDescription {
        what: DescribedKind::Value(fields),
        ..
    }) = described
    {
        for field in fields {
            properties.insert(field.name.clone(), schema_of(field));
        }
    }
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "type": "object",
        "properties": properties,
    })
}

fn schema_of(field: &AnnouncedField) -> Value {
    let one = match field.builtin.map(kind) {
        Some(kind) if !field.is_array() => json!({"type": kind}),
        Some(kind) => json!({"type": "array", "items": {"type": kind}}),
        None => json!({}),
    };
    let meaning = field.meaning();
    match (one, meaning.as_str()) {
        (one, "") => one,
        (Value::Object(mut one), meaning) => {
            one.insert("description".to_owned(), meaning.into());
            Value::Object(one)
        }
        (one, _) => one,
    }
}

/// Returns the type of a value in JSON.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "all others are shown as text or object"
)]
const fn kind(builtin: BuiltinType) -> &'static str {
    match builtin {
        BuiltinType::Boolean => "boolean",
        integer if integer.is_integer() => "integer",
        BuiltinType::Float | BuiltinType::Double => "number",
        BuiltinType::ExtensionObject => "object",
        _ => "string",
    }
}

/// Time that values wait for the description of their topic.
pub(super) const DESCRIBED_WITHIN: Duration = Duration::from_millis(1500);
/// The member of a JSON value with only some of its fields.
pub(crate) const DELTA: &str = "$delta";
/// The key of the metadata of a recorded channel with the announcement of its topic, in Base64.
pub(crate) const ANNOUNCEMENT: &str = "announcement";
/// The metadata of a channel with the model of a robot, which is no value of the space.
pub(crate) const MODEL: &str = "robot_model";
const MOST_UNKNOWN: usize = 64;
/// Maximum number of channels of a topic, one for each of its descriptions.
const MOST_OF_TOPIC: usize = 8;

#[cfg(test)]
mod tests;
