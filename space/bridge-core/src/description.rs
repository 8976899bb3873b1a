//! The content of a topic as DataSetMetaData (OPC 10000-14, 6.2.3.2.3).
//!
//! The name of the DataSet is the name of the topic (`ua_1_2_10`). An announcement has no
//! WriterGroupId, so the topic is identified by this name together with the PublisherId and
//! DataSetWriterId. The description is the name of the ROS type of the message that the fields
//! form. It ends with ` as bytes` if the field is a ByteString with the whole message. The type
//! name is missing if the fields do not form a message: a single value of a message, or values that
//! were converted. The display name follows after the topic name: the name in the mapping, or the
//! name from a local side with fields as payload, which may also add a description after `; `. The
//! Property [`ROS_TOPICS`] of the first field lists the ROS topics of the mapping, and the Property
//! `Command` marks a value that acts where it arrives.

mod schema;

use std::collections::BTreeMap;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};

use mappings::{Binding, Meaning, SpaceId, TopicId, Unit, Variable};
use messages::{ArrayRank, Leaf, MessageType, Selected, Selection, TypeName};
use uadp::discovery::{
    AnnouncedContent, Announcement, ConfigurationVersion, DataSetMetaDataType, EUInformation,
    EnumValueType, FieldMetaData, KeyValuePair, Range, SettingsStructure, WireArray, enum_strings,
    strings,
};
use uadp::{
    BuiltinType, EncodeError, Guid, LocalizedText, PublisherId, QualifiedName, Scalar,
    SecurityHeader, StatusCode, Timestamp, Variant,
};

pub(crate) use self::schema::{data_type, list, sizes, value_rank, with_structures};
use crate::call::{ValueDescription, join_name, split_name};
use crate::learned::Weight;

/// The DataSetMetaData of a topic from a writer of another space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicMetaData {
    /// The ROS type of the message that the fields form.
    pub message_type: TypeName,
    /// Whether a single ByteString contains the whole message.
    pub bytes: bool,
    /// The display name; may be empty.
    pub name: String,
    /// The description for users and programs; may be empty.
    pub about: String,
    /// The fields, in the order of the values.
    pub fields: Vec<Leaf>,
}

impl TopicMetaData {
    /// Returns the selection of the fields in a local type of the same name; `None` if the type has
    /// other fields.
    #[must_use]
    pub fn selection(&self, message_type: &MessageType) -> Option<Selection> {
        if self.bytes {
            return Some(Selection::Bytes);
        }
        if let [one] = &self.fields[..]
            && (one.builtin, one.rank) == (BuiltinType::ExtensionObject, ArrayRank::Scalar)
        {
            return Some(Selection::Structure(None));
        }
        let leaves = message_type.leaves();
        let whole = leaves.len() == self.fields.len()
            && leaves.iter().zip(&self.fields).all(|(a, b)| is_same(a, b));
        if whole {
            return Some(Selection::Whole);
        }
        // A part of the fields, in the order of the message.
        let mut rest = leaves.iter();
        let selected = self.fields.iter().map(|field| {
            let found = rest.find(|leaf| is_same(leaf, field))?;
            Some(Selected::whole(&found.path))
        });
        let selected: Vec<Selected> = selected.collect::<Option<_>>()?;
        (!selected.is_empty()).then_some(Selection::Fields(selected))
    }

    /// Returns whether values of these types match the description. The flag is true for arrays.
    pub(crate) fn fits(&self, shape: &[(BuiltinType, bool)]) -> bool {
        let fields = self.fields.iter().map(|field| {
            let array = matches!(field.rank, ArrayRank::Array { .. });
            (field.builtin, array)
        });
        fields.eq(shape.iter().copied())
    }

    /// Reads the announcement of a topic; `None` if it names no ROS type.
    ///
    /// # Errors
    /// Returns the reason if the announcement cannot be used.
    pub(crate) fn read(
        meta_data: &DataSetMetaDataType<'_>,
    ) -> Result<Option<Self>, DescriptionFault> {
        let Some(description) = meta_data.description.text else {
            return Ok(None);
        };
        let (made, about) = description.split_once(ABOUT).unwrap_or((description, ""));
        let (name, bytes) = match made.strip_suffix(AS_BYTES) {
            Some(name) => (name, true),
            None => (made, false),
        };
        if name.len() > MAX_NAME {
            return Err(DescriptionFault::TypeName);
        }
        let (_, called) = meta_data.name.and_then(split_name).unzip();
        let called = called.unwrap_or_default();
        if called.len() > MAX_NAME || about.len() > MAX_ABOUT {
            return Err(DescriptionFault::Text);
        }
        let Ok(message_type) = name.parse() else {
            return Ok(None);
        };
        if meta_data.fields.len() > MAX_FIELDS {
            return Err(DescriptionFault::Fields(MAX_FIELDS));
        }
        let fields = meta_data.fields.iter().map(|field| read_field(&field));
        Ok(Some(Self {
            message_type,
            bytes,
            name: called.to_owned(),
            about: about.to_owned(),
            fields: fields.collect::<Result<_, _>>()?,
        }))
    }
}

/// Reason for which an announcement cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DescriptionFault {
    #[error("more than {0} fields")]
    Fields(usize),
    #[error("the name of the type is too long")]
    TypeName,
    #[error("its name or description is too long")]
    Text,
    #[error("the name of a field is too long")]
    FieldName,
    #[error("{0} is not a builtin type")]
    Builtin(u8),
    #[error("a field has ValueRank {0}, which ROS does not support")]
    ValueRank(i32),
    #[error("a field of more than {0} dimensions")]
    Dimensions(usize),
    #[error("it has no target")]
    NoTarget,
    #[error("the limit of described topics with fields is reached")]
    Full,
}

impl Weight for TopicMetaData {
    fn weight(&self) -> usize {
        let names: usize = self.fields.iter().map(|field| field.path.len()).sum();
        let texts = self.name.len() + self.about.len();
        names + texts + self.fields.len() * size_of::<Leaf>() + MAX_NAME
    }
}

fn read_field(field: &FieldMetaData<'_>) -> Result<Leaf, DescriptionFault> {
    let path = field.name.unwrap_or_default();
    if path.len() > MAX_NAME {
        return Err(DescriptionFault::FieldName);
    }
    let Some(builtin) = field.builtin_type() else {
        return Err(DescriptionFault::Builtin(field.built_in_type));
    };
    Ok(Leaf {
        path: path.to_owned(),
        builtin,
        rank: read_rank(field)?,
    })
}

/// Returns whether a field is a scalar or an array.
///
/// # Errors
/// The field has or may have several dimensions.
pub(crate) fn read_rank(field: &FieldMetaData<'_>) -> Result<ArrayRank, DescriptionFault> {
    match field.value_rank {
        -1 => Ok(ArrayRank::Scalar),
        1 => Ok(ArrayRank::Array {
            fixed: field.array_dimensions.get(0).filter(|length| *length > 0),
        }),
        other => Err(DescriptionFault::ValueRank(other)),
    }
}

/// Compares fields without case, because some names differ in case between ROS 1 and ROS 2.
fn is_same(a: &Leaf, b: &Leaf) -> bool {
    a.builtin == b.builtin && a.rank == b.rank && a.path.eq_ignore_ascii_case(&b.path)
}

/// The announcement of a topic of the own space.
#[derive(Debug)]
pub(crate) struct OwnAnnouncements {
    /// The complete announcement with the SequenceNumber 0.
    datagram: Vec<u8>,
    /// The offset of the body in the announcement.
    body_at: usize,
    /// A hash of the content without the version.
    content: u64,
    version: ConfigurationVersion,
}

/// A topic and the sources of its metadata.
#[derive(Clone, Copy)]
pub(crate) struct MetaDataSource<'s> {
    pub(crate) topic: TopicId,
    /// The message of the fields, and the selection of fields. `None` if no message is converted;
    /// the mapping alone then describes the fields.
    pub(crate) message: Option<(&'s MessageType, &'s Selection)>,
    /// The fields that cross.
    pub(crate) leaves: &'s [Leaf],
    /// The variable in the mapping.
    pub(crate) variable: Option<&'s Variable>,
    /// The description from the local side, if its payloads are fields.
    pub(crate) said: Option<&'s ValueDescription>,
    /// The known namespace URIs by index.
    pub(crate) namespaces: &'s BTreeMap<u16, String>,
}

impl OwnAnnouncements {
    /// Creates the description of a topic. The version is the version of `before` if the content is
    /// the same, and newer otherwise.
    ///
    /// # Errors
    /// Returns an [`EncodeError`] for a name that is too long, and for more than
    /// [`MAX_ANNOUNCEMENT`] bytes in total.
    pub(crate) fn new(
        source: MetaDataSource<'_>,
        before: Option<&Self>,
        utc: Timestamp,
    ) -> Result<Self, EncodeError> {
        let (body, _) = source.encode(ConfigurationVersion::default())?;
        let mut hasher = DefaultHasher::new();
        body.hash(&mut hasher);
        let content = hasher.finish();
        let version = match before {
            Some(before) if before.content == content => before.version,
            Some(before) => before.version.changed(version_time(utc)),
            None => ConfigurationVersion::default().changed(version_time(utc)),
        };
        let (mut datagram, body_at) = source.encode(version)?;
        if datagram.len() > MAX_ANNOUNCEMENT {
            return Err(EncodeError::TooBig {
                what: "DataSetMetaData",
                len: datagram.len(),
            });
        }
        // There may be thousands of announcements, and each is stored for as long as its topic.
        datagram.shrink_to_fit();
        Ok(Self {
            datagram,
            body_at,
            content,
            version,
        })
    }

    /// Returns the MajorVersion for the headers of the described messages.
    pub(crate) const fn major_version(&self) -> u32 {
        self.version.major
    }

    /// Returns whether the version differs from the version of `before`.
    pub(crate) fn differs(&self, before: Option<&Self>) -> bool {
        before.is_none_or(|before| before.version != self.version)
    }

    /// Writes the announcement into an empty buffer and returns the offset of its body.
    pub(crate) fn write(&self, sequence_number: u16, out: &mut Vec<u8>) -> usize {
        out.extend_from_slice(&self.datagram);
        // The SequenceNumber follows the AnnouncementType.
        let at = self.body_at + 1;
        if let Some(place) = out.get_mut(at..at + 2) {
            place.copy_from_slice(&sequence_number.to_le_bytes());
        }
        self.body_at
    }
}

impl MetaDataSource<'_> {
    /// Returns the announcement and the offset of its body.
    fn encode(&self, version: ConfigurationVersion) -> Result<(Vec<u8>, usize), EncodeError> {
        let (_, namespace, _) = self.topic.triple();
        let description = self.description();
        let named: Vec<FieldText> = self.leaves.iter().map(|leaf| self.names(leaf)).collect();
        let mut buffers = <[Vec<u8>; 3]>::default();
        let mut properties = match (self.leaves, self.variable) {
            ([_], Some(variable)) => properties(&variable.meaning, &mut buffers)?,
            _ => Vec::new(),
        };
        let mut topics_buffer = Vec::new();
        if let Some(variable) = self.variable {
            properties.extend(ros_topics(variable, &mut topics_buffer)?);
            properties.extend(command(variable));
        }
        let fields: Vec<FieldMetaData<'_>> = self
            .leaves
            .iter()
            .zip(&named)
            .enumerate()
            .map(|(index, (leaf, text))| self.field(index, leaf, (text, &properties)))
            .collect();
        let name = join_name(self.topic, self.name());
        let plain = DataSetMetaDataType {
            name: Some(&name),
            description: text(&description),
            fields: WireArray::new(&fields),
            configuration_version: version,
            ..DataSetMetaDataType::default()
        };
        match self.message {
            None => self.announcement(&plain),
            Some((of, _)) => {
                let names = (namespace, self.namespaces);
                with_structures(of, self.leaves, names, |schema| {
                    self.announcement(&DataSetMetaDataType { schema, ..plain })
                })
            }
        }
    }

    fn announcement(
        &self,
        meta_data: &DataSetMetaDataType<'_>,
    ) -> Result<(Vec<u8>, usize), EncodeError> {
        let (space, _, writer_id) = self.topic.triple();
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data: *meta_data,
                status: StatusCode::GOOD,
            },
        };
        let mut datagram = Vec::new();
        announcement.encode(
            PublisherId::UInt16(space),
            SecurityHeader::NONE,
            &mut datagram,
        )?;
        let mut body = Vec::new();
        announcement.encode_body(&mut body)?;
        let body_at = datagram.len().saturating_sub(body.len());
        Ok((datagram, body_at))
    }

    /// Returns the display name: of the local side, or of the mapping. Readers refuse an
    /// announcement with a longer name than [`MAX_NAME`].
    fn name(&self) -> &str {
        let mapped = || self.variable.map(|variable| variable.name.as_str());
        let said = self.said.map(|said| said.name.as_str());
        let name = said.or_else(mapped).unwrap_or_default();
        if name.len() > MAX_NAME { "" } else { name }
    }

    /// Returns the path in the message to which the fields belong; empty for the whole message.
    fn within(&self) -> &str {
        match self.message {
            Some((_, Selection::Field(path) | Selection::Structure(Some(path)))) => path,
            Some((
                _,
                Selection::Whole
                | Selection::Structure(None)
                | Selection::Fields(_)
                | Selection::Value { .. }
                | Selection::Template { .. }
                | Selection::Bytes,
            ))
            | None => "",
        }
    }

    /// Returns the type of the message that the values form, if they form a message.
    fn made(&self) -> Option<&TypeName> {
        let Some((message_type, selection)) = self.message else {
            if let Some(said) = self.said {
                return said.message_type.as_ref();
            }
            return self.variable.and_then(whole_message);
        };
        match selection {
            Selection::Value { .. } => None,
            Selection::Fields(selected) if selected.iter().any(|one| !one.is_plain()) => None,
            Selection::Fields(_)
            | Selection::Whole
            | Selection::Structure(_)
            | Selection::Field(_)
            | Selection::Template { .. }
            | Selection::Bytes => message_type.message_at(self.within()),
        }
    }

    fn description(&self) -> String {
        let about = self.said.map_or("", |said| &said.about);
        let (before, about) = match about {
            "" => ("", ""),
            about => (ABOUT, about),
        };
        let Some(name) = self.made() else {
            return format!("{before}{about}");
        };
        let behind = match self.message {
            Some((_, Selection::Bytes)) => AS_BYTES,
            Some((
                _,
                Selection::Whole
                | Selection::Structure(_)
                | Selection::Fields(_)
                | Selection::Field(_)
                | Selection::Value { .. }
                | Selection::Template { .. },
            ))
            | None => "",
        };
        format!("{name}{behind}{before}{about}")
    }

    fn field<'f>(
        &'f self,
        index: usize,
        leaf: &Leaf,
        (said, properties): (&'f FieldText, &'f [KeyValuePair<'f>]),
    ) -> FieldMetaData<'f> {
        let (_, namespace, _) = self.topic.triple();
        let structure = leaf.builtin == BuiltinType::ExtensionObject;
        let of = self.message.and_then(|(of, _)| of.message_at(&leaf.path));
        FieldMetaData {
            name: Some(&said.name),
            description: text(&said.description),
            field_flags: self.field_flags(),
            built_in_type: leaf.builtin.id(),
            data_type: data_type(leaf.builtin, of.filter(|_| structure), namespace),
            value_rank: value_rank(leaf.rank),
            array_dimensions: list(&said.sizes),
            data_set_field_id: field_id(self.topic, index, &said.name),
            properties: list(if index == 0 { properties } else { &[] }),
            ..FieldMetaData::default()
        }
    }

    /// Returns the DataSetFieldFlags of each field.
    fn field_flags(&self) -> u16 {
        let is_promoted = self.variable.is_some_and(|of| of.meaning.promoted);
        if is_promoted { PROMOTED_FIELD } else { 0 }
    }

    fn names(&self, leaf: &Leaf) -> FieldText {
        let within = self.within();
        let inner = leaf
            .path
            .strip_prefix(within)
            .and_then(|rest| rest.strip_prefix('.'));
        let (name, description) = if leaf.path.is_empty() {
            (MESSAGE, String::new())
        } else if self.made().is_none() {
            let told = self
                .message
                .map(|(of, _)| format!("{} of {}", leaf.path, of.name()));
            (leaf.path.as_str(), told.unwrap_or_default())
        } else {
            (inner.unwrap_or(&leaf.path), String::new())
        };
        FieldText {
            name: name.to_owned(),
            description,
            sizes: sizes(leaf.rank),
        }
    }
}

/// Returns the message type if all ROS bindings of the value use the same type as a whole.
fn whole_message(variable: &Variable) -> Option<&TypeName> {
    let (first, rest) = variable.bindings.split_first()?;
    let whole = |one: &Binding| one.selection == Selection::Whole;
    let same = |one: &Binding| whole(one) && one.message_type == first.message_type;
    let known = whole(first) && !variable.fields.is_empty();
    (known && rest.iter().all(same)).then_some(&first.message_type)
}

/// Returns the fields of a value from the mapping; empty if the mapping does not define them.
pub(crate) fn mapped_leaves(variable: &Variable) -> Vec<Leaf> {
    if whole_message(variable).is_some() {
        return variable.fields.clone();
    }
    let rank = |array| {
        if array {
            ArrayRank::Array { fixed: None }
        } else {
            ArrayRank::Scalar
        }
    };
    match variable.value_type {
        Some((builtin, array)) => vec![Leaf {
            path: variable.name.clone(),
            builtin,
            rank: rank(array),
        }],
        None => variable.fields.clone(),
    }
}

/// Returns the Properties with the meaning of a number (OPC 10000-8, 5.3.2, and OPC 10000-3,
/// 5.8.3).
fn properties<'b>(
    meaning: &'b Meaning,
    [unit_buffer, range_buffer, texts_buffer]: &'b mut [Vec<u8>; 3],
) -> Result<Vec<KeyValuePair<'b>>, EncodeError> {
    let mut found = Vec::new();
    let mut push = |name: &'static str, value: Variant<'b>| {
        let key = QualifiedName {
            namespace: 0,
            name: Some(name),
        };
        found.push(KeyValuePair { key, value });
    };
    if let Some(unit) = meaning.unit {
        let information = EUInformation {
            namespace_uri: Some(Unit::NAMESPACE),
            unit_id: unit.id(),
            display_name: text(unit.symbol),
            description: text(unit.name),
        };
        let object = information.write_object(unit_buffer)?;
        push(
            "EngineeringUnits",
            Variant::Scalar(Scalar::ExtensionObject(object)),
        );
    }
    if let Some((low, high)) = meaning.range() {
        let object = Range { low, high }.write_object(range_buffer)?;
        push("EURange", Variant::Scalar(Scalar::ExtensionObject(object)));
    }
    let counted = (0..)
        .zip(meaning.texts.keys())
        .all(|(at, number)| at == *number);
    if counted && !meaning.texts.is_empty() {
        let names: Vec<LocalizedText<'_>> = meaning.texts.values().map(|said| text(said)).collect();
        push("EnumStrings", enum_strings(&names, texts_buffer)?);
    } else if !meaning.texts.is_empty() {
        let values: Vec<EnumValueType<'_>> = meaning
            .texts
            .iter()
            .map(|(value, said)| EnumValueType {
                value: *value,
                display_name: text(said),
                ..EnumValueType::default()
            })
            .collect();
        push("EnumValues", EnumValueType::array(&values, texts_buffer)?);
    }
    Ok(found)
}

/// Returns the Property with the ROS topics and services of a value; `None` if there are none.
fn ros_topics<'b>(
    variable: &Variable,
    buffer: &'b mut Vec<u8>,
) -> Result<Option<KeyValuePair<'b>>, EncodeError> {
    let names = variable
        .ros_names()
        .filter(|(_, name)| name.len() <= MAX_NAME)
        .map(|(space, name)| format!("{space} {name}"));
    let names: Vec<String> = names.collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    if names.is_empty() {
        return Ok(None);
    }
    let key = QualifiedName {
        namespace: 0,
        name: Some(ROS_TOPICS),
    };
    let value = strings(&names, buffer)?;
    Ok(Some(KeyValuePair { key, value }))
}

/// Returns the Property of a value of a ROS space that acts where it arrives. Values of the OPC UA
/// side are commands by their origin.
fn command(variable: &Variable) -> Option<KeyValuePair<'static>> {
    let key = QualifiedName {
        namespace: 0,
        name: Some(COMMAND),
    };
    let value = Variant::Scalar(Scalar::Boolean(true));
    let acts = variable.topic.space != SpaceId::UA && variable.is_command();
    acts.then_some(KeyValuePair { key, value })
}

/// The name, description and array sizes of a field.
struct FieldText {
    name: String,
    description: String,
    sizes: Vec<u32>,
}

pub(crate) const fn text(text: &str) -> LocalizedText<'_> {
    LocalizedText {
        locale: None,
        text: if text.is_empty() { None } else { Some(text) },
    }
}

/// Returns the DataSetFieldId, which is the same in each announcement of the field.
pub(crate) fn field_id(topic: TopicId, index: usize, name: &str) -> Guid {
    let mut hasher = DefaultHasher::new();
    (topic.triple(), index).hash(&mut hasher);
    let first = hasher.finish().to_le_bytes();
    name.hash(&mut hasher);
    let second = hasher.finish().to_le_bytes();
    let mut id = [0; 16];
    for (place, byte) in id.iter_mut().zip(first.into_iter().chain(second)) {
        *place = byte;
    }
    Guid(id)
}

/// Returns the seconds since 2000-01-01 UTC (VersionTime: OPC 10000-4, 7.44).
pub(crate) fn version_time(utc: Timestamp) -> u32 {
    let seconds = utc.unix_nanos() / 1_000_000_000 - UNIX_2000;
    u32::try_from(seconds.max(0)).unwrap_or(u32::MAX)
}

/// Seconds from 1970 to 2000.
const UNIX_2000: i128 = 946_684_800;
/// The Property of the first field of a DataSet with the ROS topics and services of the value: an
/// array of texts, each with the number of a space and a name, such as `1 /joint_states`.
pub const ROS_TOPICS: &str = "RosTopics";
/// The name of the Property of a value that acts where it arrives.
const COMMAND: &str = "Command";
/// The separator between the type and the description.
/// Bit of DataSetFieldFlags (OPC 10000-14, 6.2.3.2.5).
const PROMOTED_FIELD: u16 = 1;
const ABOUT: &str = "; ";
/// The maximum accepted length in bytes of the description after the separator.
const MAX_ABOUT: usize = 1_024;
/// The suffix of the type for messages that are carried as bytes.
const AS_BYTES: &str = " as bytes";
/// The name of the field of a message that is carried as bytes.
const MESSAGE: &str = "message";
/// The maximum accepted length in bytes of a name.
pub(crate) const MAX_NAME: usize = 255;
/// The maximum number of fields of a message.
pub(crate) const MAX_FIELDS: usize = 4096;
/// The maximum size in bytes of an announcement.
pub(crate) const MAX_ANNOUNCEMENT: usize = 64 << 10;
