//! The arguments and results of a call as ActionMetaData (OPC 10000-14, 6.2.3.10 and 7.2.4.6.11).
//!
//! As for values, the name starts with the topic, because an announcement has no WriterGroupId. A
//! field of the request that has a default value has the Property `Optional`. Fields with a meaning
//! for users have the Properties `EngineeringUnits`, `EURange` and `Default` (a text).

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use mappings::{TopicId, Unit};
use messages::{ArrayRank, MessageType};
use uadp::discovery::{
    ActionMetaData, ActionTargetDataType, AnnouncedContent, Announcement, ConfigurationVersion,
    DataSetMetaDataType, DataTypeSchemaHeader, EUInformation, FieldMetaData, KeyValuePair, Range,
    SettingsStructure as _, StructureDescription, StructureType, WireArray,
};
use uadp::{
    Array, BuiltinType, EncodeError, NodeId, NodeIdValue, PublisherId, QualifiedName, Scalar,
    SecurityHeader, Timestamp, Variant,
};

use crate::call::{
    ActionFamily, CallDescription, CallField, CallRole, CallStructure, FieldNote, join_name,
};
use crate::description::{
    DescriptionFault, MAX_ANNOUNCEMENT, MAX_NAME, data_type, field_id, list, read_rank, sizes,
    text, value_rank, version_time, with_structures,
};
use crate::learned::Weight;
use crate::redundancy::RedundancyRank as BridgeRank;

/// The ROS messages of the fields of a call.
#[derive(Clone, Copy)]
pub(crate) struct CallTypes<'m> {
    pub(crate) request: &'m MessageType,
    pub(crate) response: &'m MessageType,
}

/// The content of an announcement: the call, its types if it has types, the namespace URIs by
/// index, and the ActionTargetId.
pub(crate) type Said<'s> = (
    &'s CallDescription,
    Option<CallTypes<'s>>,
    &'s BTreeMap<u16, String>,
    u16,
);

/// The announcement of an own call.
#[derive(Debug)]
pub(crate) struct CallAnnouncement {
    /// The complete announcement with the SequenceNumber 0.
    datagram: Vec<u8>,
    /// The offset of the body in the announcement.
    body_at: usize,
    /// A hash of the content without the version.
    content: u64,
    version: ConfigurationVersion,
}

impl CallAnnouncement {
    /// Creates the announcement of a call. The version is the version of `before` if the content is
    /// the same, and newer otherwise.
    ///
    /// # Errors
    /// Returns an [`EncodeError`] if the announcement is too large.
    pub(crate) fn new(
        topic: TopicId,
        said: Said<'_>,
        before: Option<&Self>,
        utc: Timestamp,
    ) -> Result<Self, EncodeError> {
        let (body, _) = encode(topic, said, ConfigurationVersion::default())?;
        let mut hasher = DefaultHasher::new();
        body.hash(&mut hasher);
        let content = hasher.finish();
        let version = match before {
            Some(before) if before.content == content => before.version,
            Some(before) => before.version.changed(version_time(utc)),
            None => ConfigurationVersion::default().changed(version_time(utc)),
        };
        let (datagram, body_at) = encode(topic, said, version)?;
        if datagram.len() > MAX_ANNOUNCEMENT {
            return Err(EncodeError::TooBig {
                what: "ActionMetaData",
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

    /// Writes the announcement with the ActionTargetId into an empty buffer and returns the offset
    /// of its body.
    pub(crate) fn write(&self, (sequence_number, target): (u16, u16), out: &mut Vec<u8>) -> usize {
        out.extend_from_slice(&self.datagram);
        for (offset, number) in [(SEQUENCE_NUMBER_AT, sequence_number), (TARGET_AT, target)] {
            let at = self.body_at + offset;
            if let Some(bytes) = out.get_mut(at..at + 2) {
                bytes.copy_from_slice(&number.to_le_bytes());
            }
        }
        self.body_at
    }
}

/// Returns the announcement and the offset of its body.
fn encode(
    topic: TopicId,
    (description, types, namespaces, target): Said<'_>,
    version: ConfigurationVersion,
) -> Result<(Vec<u8>, usize), EncodeError> {
    let (space, _, writer_id) = topic.triple();
    let name = join_name(topic, &description.name);
    let target = [ActionTargetDataType {
        action_target_id: target,
        name: Some(&description.name),
        description: text(""),
    }];
    let request = Side {
        fields: FieldList::new(&description.request, description.role),
        of: types.map(|types| types.request),
        first: 0,
        meta_data: (&name, &description.about, version),
    };
    let response = Side {
        fields: FieldList::new(&description.response, CallRole::Call),
        of: types.map(|types| types.response),
        first: description.request.len(),
        meta_data: (&name, "", version),
    };
    request.with(topic, namespaces, |request| {
        response.with(topic, namespaces, |response| {
            let announcement = Announcement {
                sequence_number: 0,
                announced: AnnouncedContent::ActionMetaData(ActionMetaData {
                    writer_id,
                    action_targets: WireArray::new(&target),
                    request: *request,
                    response: *response,
                    action_methods: WireArray::null(),
                }),
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
        })
    })
}

/// The request or the response.
struct Side<'s> {
    fields: FieldList<'s>,
    /// The message of its fields.
    of: Option<&'s MessageType>,
    /// The number of fields that precede it.
    first: usize,
    /// The name, description and version.
    meta_data: (&'s str, &'s str, ConfigurationVersion),
}

/// Fields with their metadata.
struct FieldList<'s> {
    fields: &'s [CallField],
    sizes: Vec<Vec<u32>>,
    /// The bytes of the array in the Property `ActionFamily`.
    family: Vec<u8>,
    role: CallRole,
}

impl<'s> FieldList<'s> {
    fn new(fields: &'s [CallField], role: CallRole) -> Self {
        let family = match role {
            CallRole::Goal(ActionFamily {
                cancel,
                result,
                feedback,
                status,
            }) => [cancel, result, feedback, status]
                .map(u16::to_le_bytes)
                .concat(),
            CallRole::Call | CallRole::Cancel { .. } | CallRole::Result { .. } => Vec::new(),
        };
        Self {
            fields,
            sizes: fields.iter().map(|field| sizes(field.rank)).collect(),
            family,
            role,
        }
    }

    /// Returns the Property with the role of the call in an action.
    fn role(&self) -> Result<Option<KeyValuePair<'_>>, EncodeError> {
        let property = |key, value| Some(KeyValuePair { key, value });
        let of = |of| Variant::Scalar(Scalar::UInt16(of));
        Ok(match self.role {
            CallRole::Call => None,
            CallRole::Goal(_) => {
                let family = Array::new(BuiltinType::UInt16, FAMILY, &self.family);
                let family = family.map_err(|_| EncodeError::TooBig {
                    what: "ActionFamily",
                    len: self.family.len(),
                })?;
                property(ACTION_FAMILY, Variant::Array(family))
            }
            CallRole::Cancel { of: goal } => property(CANCEL_OF, of(goal)),
            CallRole::Result { of: goal } => property(RESULT_OF, of(goal)),
        })
    }
}

/// Returns the Properties with unit, range and default of a field (OPC 10000-8, 5.3.2).
fn note_properties<'b>(
    note: &'b FieldNote,
    [unit_buffer, range_buffer]: &'b mut [Vec<u8>; 2],
) -> Result<Vec<KeyValuePair<'b>>, EncodeError> {
    let mut found = Vec::new();
    if !note.unit.is_empty() {
        let known = Unit::find(&note.unit);
        let information = EUInformation {
            namespace_uri: known.map(|_| Unit::NAMESPACE),
            // OPC 10000-8, 5.6.4.3: -1 for a unit without a number.
            unit_id: known.map_or(-1, Unit::id),
            display_name: text(&note.unit),
            description: text(known.map_or("", |unit| unit.name)),
        };
        let object = information.write_object(unit_buffer)?;
        let value = Variant::Scalar(Scalar::ExtensionObject(object));
        let key = named("EngineeringUnits");
        found.push(KeyValuePair { key, value });
    }
    if let Some((low, high)) = note.range {
        let object = Range { low, high }.write_object(range_buffer)?;
        let value = Variant::Scalar(Scalar::ExtensionObject(object));
        let key = named("EURange");
        found.push(KeyValuePair { key, value });
    }
    if let Some(default) = &note.default {
        let value = Variant::Scalar(Scalar::String(Some(default)));
        let key = named("Default");
        found.push(KeyValuePair { key, value });
    }
    Ok(found)
}

impl Side<'_> {
    /// Calls `then` with the metadata of the request or response.
    fn with<T>(
        &self,
        topic: TopicId,
        namespaces: &BTreeMap<u16, String>,
        then: impl FnOnce(&DataSetMetaDataType<'_>) -> Result<T, EncodeError>,
    ) -> Result<T, EncodeError> {
        let (_, namespace, _) = topic.triple();
        let optional = KeyValuePair {
            key: OPTIONAL,
            value: Variant::Scalar(Scalar::Boolean(true)),
        };
        let role = self.fields.role()?;
        let mut buffers = vec![<[Vec<u8>; 2]>::default(); self.fields.fields.len()];
        let mut properties: Vec<Vec<KeyValuePair<'_>>> = Vec::new();
        let fields = self.fields.fields.iter().zip(&mut buffers).enumerate();
        for (index, (field, buffers)) in fields {
            let role = role.filter(|_| index == 0);
            let optional = field.optional.then_some(optional);
            let mut own: Vec<KeyValuePair<'_>> = role.into_iter().chain(optional).collect();
            if let Some(note) = &field.note {
                own.extend(note_properties(note, buffers)?);
            }
            properties.push(own);
        }
        let fields = self.fields.fields.iter().zip(&self.fields.sizes);
        let fields: Vec<FieldMetaData<'_>> = fields
            .zip(&properties)
            .enumerate()
            .map(|(index, ((field, sizes), properties))| {
                let structure = field.builtin == BuiltinType::ExtensionObject;
                let of = self.of.filter(|_| structure);
                let about = field.note.as_ref().map_or("", |note| &note.about);
                FieldMetaData {
                    name: Some(&field.name),
                    description: text(about),
                    built_in_type: field.builtin.id(),
                    data_type: data_type(
                        field.builtin,
                        of.and_then(|of| of.message_at(&field.name)),
                        namespace,
                    ),
                    value_rank: value_rank(field.rank),
                    array_dimensions: list(sizes),
                    data_set_field_id: field_id(topic, self.first + index, &field.name),
                    properties: list(properties),
                    ..FieldMetaData::default()
                }
            })
            .collect();
        let (name, about, version) = self.meta_data;
        let plain = DataSetMetaDataType {
            name: Some(name),
            description: text(about),
            fields: list(&fields),
            configuration_version: version,
            ..DataSetMetaDataType::default()
        };
        match self.of {
            None => then(&plain),
            Some(of) => with_structures(of, of.leaves(), (namespace, namespaces), |schema| {
                then(&DataSetMetaDataType { schema, ..plain })
            }),
        }
    }
}

/// Reads the announcement of a call and its ActionTargetId. `name` is the name of the Action
/// without the topic.
///
/// # Errors
/// Returns the reason if the announcement cannot be used.
pub(crate) fn read(
    action: &ActionMetaData<'_>,
    name: &str,
) -> Result<(CallDescription, u16), DescriptionFault> {
    let target = action.action_targets.get(0);
    let target = target.ok_or(DescriptionFault::NoTarget)?.action_target_id;
    let about = action.request.description.text.unwrap_or_default();
    if name.len() > MAX_NAME || about.len() > MAX_ABOUT {
        return Err(DescriptionFault::Text);
    }
    let description = CallDescription {
        name: name.to_owned(),
        about: about.to_owned(),
        role: read_role(&action.request),
        request: read_fields(&action.request)?,
        response: read_fields(&action.response)?,
    };
    Ok((description, target))
}

/// Returns the ActionTargetId of all calls of a program instance, from the random bytes of the
/// instance. A request to an earlier instance has a different ActionTargetId. It is not executed,
/// because the earlier instance may have executed it.
pub(crate) fn target_of(instance: [u8; 16]) -> u16 {
    let (pairs, _) = instance.as_chunks::<2>();
    let folded = pairs
        .iter()
        .fold(0, |all, pair| all ^ u16::from_le_bytes(*pair));
    folded.max(LASTING_TARGET)
}

/// Returns the ActionTargetId of all calls of a redundant bridge. Two terms of a bridge as the
/// active one have different ActionTargetIds, and so have bridges of different ranks: a request to
/// a former active bridge is never executed by another.
pub(crate) fn target_of_term(instance: [u8; 16], rank: BridgeRank, term: u64) -> u16 {
    let first = u64::from(target_of(instance));
    // Two bits are left for the rank. 0 is left out, so that no result is `LASTING_TARGET`.
    let term = first.wrapping_add(term) % MOST_TERMS + 1;
    u16::try_from(term << 2).unwrap_or(u16::MAX) | u16::from(rank.get())
}

/// Reads the role of the call in an action from the first field. Properties with invalid values are
/// ignored.
fn read_role(request: &DataSetMetaDataType<'_>) -> CallRole {
    let Some(field) = request.fields.get(0) else {
        return CallRole::Call;
    };
    let said = field.properties.iter().find_map(|property| {
        let number = match property.value {
            Variant::Scalar(Scalar::UInt16(number)) => number,
            Variant::Null | Variant::Scalar(_) | Variant::Array(_) | Variant::Matrix(_) => 0,
        };
        if property.key == ACTION_FAMILY {
            read_family(&property.value).map(CallRole::Goal)
        } else if number == 0 {
            None
        } else if property.key == CANCEL_OF {
            Some(CallRole::Cancel { of: number })
        } else {
            (property.key == RESULT_OF).then_some(CallRole::Result { of: number })
        }
    });
    said.unwrap_or_default()
}

fn read_family(value: &Variant<'_>) -> Option<ActionFamily> {
    let Variant::Array(array) = value else {
        return None;
    };
    let mut numbers = array.iter().map(|number| {
        let Scalar::UInt16(number) = number else {
            return None;
        };
        (number != 0).then_some(number)
    });
    let family = ActionFamily {
        cancel: numbers.next()??,
        result: numbers.next()??,
        feedback: numbers.next()??,
        status: numbers.next()??,
    };
    numbers.next().is_none().then_some(family)
}

fn read_fields(data_set: &DataSetMetaDataType<'_>) -> Result<Vec<CallField>, DescriptionFault> {
    if data_set.fields.len() > MAX_CALL_FIELDS {
        return Err(DescriptionFault::Fields(MAX_CALL_FIELDS));
    }
    let structures = read_structures(&data_set.schema);
    let fields = data_set.fields.iter().map(|field| {
        let name = field.name.unwrap_or_default();
        if name.len() > MAX_NAME {
            return Err(DescriptionFault::FieldName);
        }
        let builtin = field
            .builtin_type()
            .ok_or(DescriptionFault::Builtin(field.built_in_type))?;
        let optional = field.properties.iter().any(|property| {
            property.key == OPTIONAL && property.value == Variant::Scalar(Scalar::Boolean(true))
        });
        Ok(CallField {
            name: name.to_owned(),
            builtin,
            rank: read_rank(&field)?,
            optional,
            structure: find(&structures, field.data_type)
                .filter(|_| is_structure(builtin))
                .map(|(structure, _)| Arc::clone(structure)),
            note: None,
        })
    });
    fields.collect()
}

/// Structures by their DataTypes, each with the number of its fields including the fields of nested
/// structures.
type Structures<'s> = Vec<(NodeId<'s>, (Arc<CallStructure>, usize))>;

/// Reads the structures of a schema. Structures that cannot be resolved, such as recursive
/// structures, are omitted. Structures with too many fields are also omitted, because with nested
/// structures a short announcement can define any number of fields.
fn read_structures<'s>(schema: &DataTypeSchemaHeader<'s>) -> Structures<'s> {
    let mut open: Vec<StructureDescription<'s>> = schema
        .structure_data_types
        .iter()
        .take(MAX_STRUCTURES)
        .collect();
    let mut known = Vec::new();
    loop {
        let before = open.len();
        open.retain(|one| {
            let read = read_structure(one, &known);
            let is_open = read.is_none();
            known.extend(read.map(|read| (one.data_type_id, read)));
            is_open
        });
        if open.len() == before {
            return known;
        }
    }
}

/// Reads a structure, if all nested structures are in `known`.
fn read_structure(
    described: &StructureDescription<'_>,
    known: &Structures<'_>,
) -> Option<(Arc<CallStructure>, usize)> {
    let name = described.name.name.filter(|name| name.len() <= MAX_NAME)?;
    let definition = &described.structure_definition;
    let written = NodeId::string(described.data_type_id.namespace, name);
    let plain = definition.structure_type == StructureType::default();
    if !plain
        || definition.default_encoding_id != written
        || definition.fields.len() > MAX_CALL_FIELDS
    {
        return None;
    }
    let mut count = 0_usize;
    let fields = definition.fields.iter().map(|field| {
        let name = field.name.filter(|name| name.len() <= MAX_NAME)?;
        let rank = match field.value_rank {
            -1 => ArrayRank::Scalar,
            1 => ArrayRank::Array {
                fixed: field.array_dimensions.get(0).filter(|length| *length > 0),
            },
            _ => return None,
        };
        let found = find(known, field.data_type);
        count = count.saturating_add(1 + found.map_or(0, |(_, inner)| *inner));
        let structure = found.map(|(structure, _)| Arc::clone(structure));
        let builtin = match (&structure, field.data_type) {
            (Some(_), _) => BuiltinType::ExtensionObject,
            (
                None,
                NodeId {
                    namespace: 0,
                    identifier: NodeIdValue::Numeric(number),
                },
            ) => {
                let builtin = u8::try_from(number).ok().and_then(BuiltinType::from_id)?;
                (!is_structure(builtin)).then_some(builtin)?
            }
            (None, _) => return None,
        };
        Some(CallField {
            name: name.to_owned(),
            builtin,
            rank,
            optional: false,
            structure,
            note: None,
        })
    });
    let name = name.to_owned();
    let fields = fields.collect::<Option<_>>()?;
    let read = Arc::new(CallStructure { name, fields });
    (count <= MAX_INNER_FIELDS).then_some((read, count))
}

fn find<'f>(
    structures: &'f Structures<'_>,
    data_type: NodeId<'_>,
) -> Option<&'f (Arc<CallStructure>, usize)> {
    let found = structures.iter().find(|(id, _)| *id == data_type);
    found.map(|(_, structure)| structure)
}

fn is_structure(builtin: BuiltinType) -> bool {
    builtin == BuiltinType::ExtensionObject
}

impl Weight for CallDescription {
    fn weight(&self) -> usize {
        let fields = self.request.iter().chain(&self.response);
        let mut seen = Vec::new();
        let names: usize = fields.map(|field| weight(field, &mut seen)).sum();
        names + self.name.len() + self.about.len() + size_of::<Self>()
    }
}

/// Returns the size in bytes of a field with its nested structures, without the structures in
/// `seen`.
fn weight(field: &CallField, seen: &mut Vec<*const CallStructure>) -> usize {
    let own = field.name.len() + size_of::<CallField>();
    let Some(structure) = &field.structure else {
        return own;
    };
    let place = Arc::as_ptr(structure);
    if seen.contains(&place) {
        return own;
    }
    seen.push(place);
    let inner: usize = structure
        .fields
        .iter()
        .map(|field| weight(field, seen))
        .sum();
    own + structure.name.len() + inner
}

/// The ActionTargetId that is valid for each call in every instance of its program. It is for
/// requestors with static configuration that do not receive announcements.
pub(crate) const LASTING_TARGET: u16 = 1;
/// The offsets of the SequenceNumber and of the ActionTargetId in the body: behind the
/// AnnouncementType, and behind the DataSetWriterId and the number of targets (OPC 10000-14,
/// 7.2.4.6.11).
const SEQUENCE_NUMBER_AT: usize = 1;
const TARGET_AT: usize = 9;
/// The number of terms of a bridge with different ActionTargetIds.
const MOST_TERMS: u64 = (1 << 14) - 1;
/// The Property of optional request fields: the fields may be omitted if all are omitted.
const OPTIONAL: QualifiedName<'static> = QualifiedName {
    namespace: 0,
    name: Some("Optional"),
};
/// The Property of the first request field with the DataSetWriterIds of cancel, result, feedback
/// and status of the action.
const ACTION_FAMILY: QualifiedName<'static> = named("ActionFamily");
/// The number of DataSetWriterIds in `ActionFamily`.
const FAMILY: usize = 4;
/// The Property of the first request field with the DataSetWriterId of the action that has its
/// goals cancelled by the call.
const CANCEL_OF: QualifiedName<'static> = named("CancelOf");
/// The Property of the first request field with the DataSetWriterId of the action that provides the
/// results for the call.
const RESULT_OF: QualifiedName<'static> = named("ResultOf");

const fn named(name: &'static str) -> QualifiedName<'static> {
    QualifiedName {
        namespace: 0,
        name: Some(name),
    }
}

/// The maximum accepted length in bytes of a description.
const MAX_ABOUT: usize = 1_024;
/// The maximum accepted number of fields of a request or response.
const MAX_CALL_FIELDS: usize = 256;
/// The maximum accepted number of structures of a request or response.
const MAX_STRUCTURES: usize = 64;
/// The maximum number of fields in a structure, including the fields of nested structures.
const MAX_INNER_FIELDS: usize = 4_096;

#[cfg(test)]
mod tests;
