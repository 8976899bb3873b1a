//! What a topic consists of, as DataSetMetaData says it (OPC 10000-14, 6.2.3.2.3).
//!
//! The name of the DataSet is that of the topic (`ua_1_2_10`), since an announcement has no WriterGroupId: with the
//! PublisherId and DataSetWriterId it has, the name tells which topic it is about. The description is the name of the ROS
//! type that the fields make, with ` as bytes` behind it where they are one ByteString with the whole message. It is
//! missing where they make none: one value out of a message, or values that were converted on the way. A local side that
//! speaks in fields may say more: a name for people behind that of the topic, and what the value is behind `; `.

use std::collections::BTreeMap;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};

use mappings::{Binding, Meaning, TopicId, Unit, Variable};
use messages::{Leaf, MemberKind, MessageType, Rank, Selected, Selection, TypeName};
use uadp::discovery::{
    Announced, Announcement, ConfigurationVersion, DataSetMetaDataType, DataTypeSchemaHeader,
    EUInformation, EnumValueType, FieldMetaData, KeyValuePair, List, Range, Settings,
    StructureDefinition, StructureDescription, StructureField, enum_strings,
};
use uadp::{
    BuiltinType, EncodeError, Guid, LocalizedText, NodeId, PublisherId, QualifiedName, Scalar,
    SecurityHeader, StatusCode, Timestamp, Variant,
};

use crate::call::{ValueDescription, join_name, split_name};
use crate::learned::Weight;

/// What the DataSetMetaData of a writer of another space says of its topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Described {
    /// The ROS type that the fields make.
    pub message_type: TypeName,
    /// The message stands in one ByteString as it is.
    pub bytes: bool,
    /// Its name for people; may be empty.
    pub name: String,
    /// What it is, for people and programs; may be empty.
    pub about: String,
    /// The fields, in the order of the values.
    pub fields: Vec<Leaf>,
}

impl Described {
    /// What of a local type of that name the fields are; `None` where that type has other fields.
    #[must_use]
    pub fn selection(&self, message_type: &MessageType) -> Option<Selection> {
        if self.bytes {
            return Some(Selection::Bytes);
        }
        if let [one] = &self.fields[..]
            && (one.builtin, one.rank) == (BuiltinType::ExtensionObject, Rank::Scalar)
        {
            return Some(Selection::Structure(None));
        }
        let leaves = message_type.leaves();
        let whole = leaves.len() == self.fields.len()
            && leaves.iter().zip(&self.fields).all(|(a, b)| is_same(a, b));
        if whole {
            return Some(Selection::Whole);
        }
        // Some of them, in the order of the message.
        let mut rest = leaves.iter();
        let selected = self.fields.iter().map(|field| {
            let found = rest.find(|leaf| is_same(leaf, field))?;
            Some(Selected::whole(&found.path))
        });
        let selected: Vec<Selected> = selected.collect::<Option<_>>()?;
        (!selected.is_empty()).then_some(Selection::Fields(selected))
    }

    /// Whether values of these types, and arrays or not, are what is described.
    pub(crate) fn fits(&self, shape: &[(BuiltinType, bool)]) -> bool {
        let fields = self.fields.iter().map(|field| {
            let array = matches!(field.rank, Rank::Array { .. });
            (field.builtin, array)
        });
        fields.eq(shape.iter().copied())
    }

    /// Reads what is announced of a topic; `None` where that names no ROS type.
    ///
    /// # Errors
    /// In words, what makes it useless.
    pub(crate) fn read(meta_data: &DataSetMetaDataType<'_>) -> Result<Option<Self>, String> {
        let Some(description) = meta_data.description.text else {
            return Ok(None);
        };
        let (made, about) = description.split_once(ABOUT).unwrap_or((description, ""));
        let (name, bytes) = match made.strip_suffix(AS_BYTES) {
            Some(name) => (name, true),
            None => (made, false),
        };
        if name.len() > MAX_NAME {
            return Err("the name of the type is too long".to_owned());
        }
        let (_, called) = meta_data.name.and_then(split_name).unzip();
        let called = called.unwrap_or_default();
        if called.len() > MAX_NAME || about.len() > MAX_ABOUT {
            return Err("its name or description is too long".to_owned());
        }
        let Ok(message_type) = name.parse() else {
            return Ok(None);
        };
        if meta_data.fields.len() > MAX_FIELDS {
            return Err(format!("more than {MAX_FIELDS} fields"));
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

impl Weight for Described {
    fn weight(&self) -> usize {
        let names: usize = self.fields.iter().map(|field| field.path.len()).sum();
        let texts = self.name.len() + self.about.len();
        names + texts + self.fields.len() * size_of::<Leaf>() + MAX_NAME
    }
}

fn read_field(field: &FieldMetaData<'_>) -> Result<Leaf, String> {
    let path = field.name.unwrap_or_default();
    if path.len() > MAX_NAME {
        return Err("the name of a field is too long".to_owned());
    }
    let Some(builtin) = field.builtin_type() else {
        return Err(format!("{} is no builtin type", field.built_in_type));
    };
    Ok(Leaf {
        path: path.to_owned(),
        builtin,
        rank: read_rank(field)?,
    })
}

/// Whether a field is an array.
///
/// # Errors
/// It has more dimensions, or may have.
pub(crate) fn read_rank(field: &FieldMetaData<'_>) -> Result<Rank, String> {
    match field.value_rank {
        -1 => Ok(Rank::Scalar),
        1 => Ok(Rank::Array {
            fixed: field.array_dimensions.get(0).filter(|length| *length > 0),
        }),
        other => Err(format!("a field of ValueRank {other}, which ROS has not")),
    }
}

/// ROS 1 and ROS 2 write some names in other cases.
fn is_same(a: &Leaf, b: &Leaf) -> bool {
    a.builtin == b.builtin && a.rank == b.rank && a.path.eq_ignore_ascii_case(&b.path)
}

/// What is announced of a topic of our own space.
#[derive(Debug)]
pub(crate) struct Description {
    /// The whole announcement, with the SequenceNumber 0.
    datagram: Vec<u8>,
    /// Where in it the body begins.
    body_at: usize,
    /// Of all that is said but the version.
    content: u64,
    version: ConfigurationVersion,
}

/// A topic and what makes its fields.
#[derive(Clone, Copy)]
pub(crate) struct Source<'s> {
    pub(crate) topic: TopicId,
    /// The message they are of, and what of it they are. Of values that no message is made of here, only the mapping says
    /// what they are.
    pub(crate) message: Option<(&'s MessageType, &'s Selection)>,
    /// The fields that cross.
    pub(crate) leaves: &'s [Leaf],
    /// What the mapping says of the value.
    pub(crate) variable: Option<&'s Variable>,
    /// What the local side says of it, where it speaks in fields.
    pub(crate) said: Option<&'s ValueDescription>,
    /// Namespace index -> URI, as far as known.
    pub(crate) namespaces: &'s BTreeMap<u16, String>,
}

impl Description {
    /// Describes a topic; its version is that of `before` if that says the same, else a newer one.
    ///
    /// # Errors
    /// [`EncodeError`] for a name that is too long, and for more than [`MAX_ANNOUNCEMENT`] bytes in all.
    pub(crate) fn new(
        source: Source<'_>,
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
        let (datagram, body_at) = source.encode(version)?;
        if datagram.len() > MAX_ANNOUNCEMENT {
            return Err(EncodeError::TooBig {
                what: "DataSetMetaData",
                len: datagram.len(),
            });
        }
        Ok(Self {
            datagram,
            body_at,
            content,
            version,
        })
    }

    /// What the messages it describes have in their header.
    pub(crate) const fn major_version(&self) -> u32 {
        self.version.major
    }

    /// Whether the version is another than that of `before`.
    pub(crate) fn differs(&self, before: Option<&Self>) -> bool {
        before.is_none_or(|before| before.version != self.version)
    }

    /// Writes the announcement into an empty buffer. Where its body begins is given back.
    pub(crate) fn write(&self, sequence_number: u16, out: &mut Vec<u8>) -> usize {
        out.extend_from_slice(&self.datagram);
        // Behind the AnnouncementType.
        let at = self.body_at + 1;
        if let Some(place) = out.get_mut(at..at + 2) {
            place.copy_from_slice(&sequence_number.to_le_bytes());
        }
        self.body_at
    }
}

impl Source<'_> {
    /// The announcement, and where its body begins.
    fn encode(&self, version: ConfigurationVersion) -> Result<(Vec<u8>, usize), EncodeError> {
        let (_, namespace, _) = self.topic.triple();
        let description = self.description();
        let called = self.said.map_or("", |said| &said.name);
        let named: Vec<FieldText> = self.leaves.iter().map(|leaf| self.names(leaf)).collect();
        let mut buffers = <[Vec<u8>; 3]>::default();
        let properties = match (self.leaves, self.variable) {
            ([_], Some(variable)) => properties(&variable.meaning, &mut buffers)?,
            _ => Vec::new(),
        };
        let fields: Vec<FieldMetaData<'_>> = self
            .leaves
            .iter()
            .zip(&named)
            .enumerate()
            .map(|(index, (leaf, text))| self.field(index, leaf, (text, &properties)))
            .collect();
        let name = join_name(self.topic, called);
        let plain = DataSetMetaDataType {
            name: Some(&name),
            description: text(&description),
            fields: List::new(&fields),
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
            announced: Announced::DataSetMetaData {
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

    /// Path of the message of which the fields are; empty for the whole.
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

    /// The message that the values make, if they make one.
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
            built_in_type: leaf.builtin.id(),
            data_type: data_type(leaf.builtin, of.filter(|_| structure), namespace),
            value_rank: value_rank(leaf.rank),
            array_dimensions: list(&said.sizes),
            data_set_field_id: field_id(self.topic, index, &said.name),
            // Only a single value has some.
            properties: list(properties),
            ..FieldMetaData::default()
        }
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

/// Hands on the definitions of the structures among those fields of a message.
pub(crate) fn with_structures<T>(
    message_type: &MessageType,
    leaves: &[Leaf],
    (namespace, uris): (u16, &BTreeMap<u16, String>),
    then: impl FnOnce(DataTypeSchemaHeader<'_>) -> Result<T, EncodeError>,
) -> Result<T, EncodeError> {
    let structures = structures(message_type, leaves);
    let namespaces = match structures.is_empty() {
        true => Vec::new(),
        false => namespaces_up_to(namespace, uris),
    };
    let inner_sizes: Vec<Vec<Vec<u32>>> = structures.iter().map(member_sizes).collect();
    let inner: Vec<Vec<StructureField<'_>>> = structures
        .iter()
        .zip(&inner_sizes)
        .map(|(structure, sizes)| structure_fields(structure, sizes, namespace))
        .collect();
    let described: Vec<StructureDescription<'_>> = structures
        .iter()
        .zip(&inner)
        .map(|(structure, fields)| structure_description(structure.name, fields, namespace))
        .collect();
    then(DataTypeSchemaHeader {
        namespaces: list(&namespaces),
        structure_data_types: list(&described),
        ..DataTypeSchemaHeader::default()
    })
}

/// The list of namespaces that has that index in it: ExtensionObjects have their TypeIds with it.
fn namespaces_up_to(namespace: u16, uris: &BTreeMap<u16, String>) -> Vec<Option<&str>> {
    if namespace > MAX_NAMESPACES {
        return Vec::new();
    }
    (1..=namespace)
        .map(|index| uris.get(&index).map(String::as_str))
        .collect()
}

/// The message type that all who read or write the value in ROS take as a whole, and the same.
fn whole_message(variable: &Variable) -> Option<&TypeName> {
    let (first, rest) = variable.bindings.split_first()?;
    let whole = |one: &Binding| one.selection == Selection::Whole;
    let same = |one: &Binding| whole(one) && one.message_type == first.message_type;
    let known = whole(first) && !variable.fields.is_empty();
    (known && rest.iter().all(same)).then_some(&first.message_type)
}

/// The fields of a value as the mapping says them; none where it leaves them open.
pub(crate) fn mapped_leaves(variable: &Variable) -> Vec<Leaf> {
    if whole_message(variable).is_some() {
        return variable.fields.clone();
    }
    let rank = |array| match array {
        true => Rank::Array { fixed: None },
        false => Rank::Scalar,
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

/// The Properties that say what a number means (OPC 10000-8, 5.3.2, and OPC 10000-3, 5.8.3).
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

/// The types of the messages in arrays and of those nested in them, each once.
fn structures<'m>(message_type: &'m MessageType, leaves: &[Leaf]) -> Vec<messages::Structure<'m>> {
    let mut all: Vec<messages::Structure<'m>> = Vec::new();
    for leaf in leaves {
        if leaf.builtin != BuiltinType::ExtensionObject {
            continue;
        }
        for structure in message_type.structures(&leaf.path) {
            if !all.iter().any(|known| known.name == structure.name) {
                all.push(structure);
            }
        }
    }
    all
}

/// What a field is called, and how many elements it has.
struct FieldText {
    name: String,
    description: String,
    sizes: Vec<u32>,
}

fn member_sizes(structure: &messages::Structure<'_>) -> Vec<Vec<u32>> {
    let ranks = structure.fields.iter().map(|field| field.rank);
    ranks.map(sizes).collect()
}

fn structure_description<'s>(
    name: &'s TypeName,
    fields: &'s [StructureField<'s>],
    namespace: u16,
) -> StructureDescription<'s> {
    StructureDescription {
        data_type_id: NodeId::string(namespace, name.as_str()),
        name: QualifiedName {
            namespace,
            name: Some(name.as_str()),
        },
        structure_definition: StructureDefinition {
            default_encoding_id: NodeId::string(namespace, name.as_str()),
            base_data_type: STRUCTURE,
            fields: list(fields),
            ..StructureDefinition::default()
        },
    }
}

fn structure_fields<'s>(
    structure: &'s messages::Structure<'_>,
    sizes: &'s [Vec<u32>],
    namespace: u16,
) -> Vec<StructureField<'s>> {
    let fields = structure.fields.iter().zip(sizes);
    fields
        .map(|(field, sizes)| StructureField {
            name: Some(field.name),
            data_type: match field.kind {
                MemberKind::Value(builtin) => data_type(builtin, None, namespace),
                MemberKind::Message(of) => {
                    data_type(BuiltinType::ExtensionObject, Some(of), namespace)
                }
            },
            value_rank: value_rank(field.rank),
            array_dimensions: list(sizes),
            ..StructureField::default()
        })
        .collect()
}

/// The DataType of a message type and its encoding have one NodeId, which is the name of the type.
pub(crate) fn data_type(builtin: BuiltinType, of: Option<&TypeName>, namespace: u16) -> NodeId<'_> {
    match of {
        Some(name) => NodeId::string(namespace, name.as_str()),
        None => NodeId::numeric(0, builtin.id().into()),
    }
}

pub(crate) const fn value_rank(rank: Rank) -> i32 {
    match rank {
        Rank::Scalar => -1,
        Rank::Array { .. } => 1,
    }
}

/// Elements in each dimension, 0 where that is open.
pub(crate) fn sizes(rank: Rank) -> Vec<u32> {
    match rank {
        Rank::Scalar => Vec::new(),
        Rank::Array { fixed } => vec![fixed.unwrap_or(0)],
    }
}

/// The null array without elements.
pub(crate) const fn list<T>(elements: &[T]) -> List<'_, T> {
    match elements {
        [] => List::null(),
        elements => List::new(elements),
    }
}

pub(crate) const fn text(text: &str) -> LocalizedText<'_> {
    LocalizedText {
        locale: None,
        text: if text.is_empty() { None } else { Some(text) },
    }
}

/// The same whenever the field is announced.
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

/// Seconds since 2000-01-01 UTC (VersionTime: OPC 10000-4, 7.44).
pub(crate) fn version_time(utc: Timestamp) -> u32 {
    let seconds = utc.unix_nanos() / 1_000_000_000 - UNIX_2000;
    u32::try_from(seconds.max(0)).unwrap_or(u32::MAX)
}

/// The DataType Structure (OPC 10000-5, 12.2.12).
const STRUCTURE: NodeId<'static> = NodeId::numeric(0, 22);
/// Seconds from 1970 to 2000.
const UNIX_2000: i128 = 946_684_800;
/// What stands between the type and what else is said.
const ABOUT: &str = "; ";
/// Bytes of that that are believed.
const MAX_ABOUT: usize = 1_024;
/// What stands behind the type of a message that crosses as it is.
const AS_BYTES: &str = " as bytes";
/// The one field of such a message.
const MESSAGE: &str = "message";
/// Bytes of a name that is believed.
pub(crate) const MAX_NAME: usize = 255;
/// As many fields as a message may have.
pub(crate) const MAX_FIELDS: usize = 4096;
/// Of a higher index the list of namespaces would be long.
const MAX_NAMESPACES: u16 = 64;
/// Bytes of the largest announcement that is sent.
pub(crate) const MAX_ANNOUNCEMENT: usize = 64 << 10;
