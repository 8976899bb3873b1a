//! What a call takes and gives, as ActionMetaData say it (OPC 10000-14, 6.2.3.10 and 7.2.4.6.11).
//!
//! As with values the name stands behind that of the topic, since an announcement has no WriterGroupId. A field of the request
//! that has a value of its own has the Property `Optional`.

use std::hash::{DefaultHasher, Hash, Hasher};

use mappings::TopicId;
use uadp::discovery::{
    ActionMetaData, ActionTargetDataType, Announced, Announcement, ConfigurationVersion,
    DataSetMetaDataType, FieldMetaData, KeyValuePair, List,
};
use uadp::{
    EncodeError, NodeId, PublisherId, QualifiedName, Scalar, SecurityHeader, Timestamp, Variant,
};

use crate::call::{CallDescription, CallField, join_name};
use crate::description::{
    MAX_ANNOUNCEMENT, MAX_NAME, field_id, list, read_rank, sizes, text, value_rank, version_time,
};
use crate::learned::Weight;

/// What is announced of a call of ours.
#[derive(Debug)]
pub(crate) struct CallAnnouncement {
    /// The whole announcement, with the SequenceNumber 0.
    datagram: Vec<u8>,
    /// Where in it the body begins.
    body_at: usize,
    /// Of all that is said but the version.
    content: u64,
    version: ConfigurationVersion,
}

impl CallAnnouncement {
    /// Announces a call; its version is that of `before` if that says the same, else a newer one.
    ///
    /// # Errors
    /// [`EncodeError`] for more bytes than are sent.
    pub(crate) fn new(
        topic: TopicId,
        description: &CallDescription,
        before: Option<&Self>,
        utc: Timestamp,
    ) -> Result<Self, EncodeError> {
        let (body, _) = encode(topic, description, ConfigurationVersion::default())?;
        let mut hasher = DefaultHasher::new();
        body.hash(&mut hasher);
        let content = hasher.finish();
        let version = match before {
            Some(before) if before.content == content => before.version,
            Some(before) => before.version.changed(version_time(utc)),
            None => ConfigurationVersion::default().changed(version_time(utc)),
        };
        let (datagram, body_at) = encode(topic, description, version)?;
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

/// The announcement, and where its body begins.
fn encode(
    topic: TopicId,
    description: &CallDescription,
    version: ConfigurationVersion,
) -> Result<(Vec<u8>, usize), EncodeError> {
    let (space, _, writer_id) = topic.triple();
    let name = join_name(topic, &description.name);
    let request_sizes: Vec<Vec<u32>> = description.request.iter().map(|f| sizes(f.rank)).collect();
    let response_sizes: Vec<Vec<u32>> =
        description.response.iter().map(|f| sizes(f.rank)).collect();
    let optional = [KeyValuePair {
        key: OPTIONAL,
        value: Variant::Scalar(Scalar::Boolean(true)),
    }];
    let request = field_list((topic, 0), &description.request, &request_sizes, &optional);
    let first = description.request.len();
    let response = field_list((topic, first), &description.response, &response_sizes, &[]);
    let data_set = |fields, about| DataSetMetaDataType {
        name: Some(&name),
        description: text(about),
        fields,
        configuration_version: version,
        ..DataSetMetaDataType::default()
    };
    let target = [ActionTargetDataType {
        action_target_id: TARGET,
        name: Some(&description.name),
        description: text(""),
    }];
    let announcement = Announcement {
        sequence_number: 0,
        announced: Announced::ActionMetaData(ActionMetaData {
            writer_id,
            action_targets: List::new(&target),
            request: data_set(list(&request), &description.about),
            response: data_set(list(&response), ""),
            action_methods: List::null(),
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
}

fn field_list<'f>(
    (topic, first): (TopicId, usize),
    fields: &'f [CallField],
    sizes: &'f [Vec<u32>],
    optional: &'f [KeyValuePair<'f>],
) -> Vec<FieldMetaData<'f>> {
    let fields = fields.iter().zip(sizes).enumerate();
    fields
        .map(|(index, (field, sizes))| FieldMetaData {
            name: Some(&field.name),
            built_in_type: field.builtin.id(),
            data_type: NodeId::numeric(0, field.builtin.id().into()),
            value_rank: value_rank(field.rank),
            array_dimensions: list(sizes),
            data_set_field_id: field_id(topic, first + index, &field.name),
            properties: match field.optional {
                true => list(optional),
                false => List::null(),
            },
            ..FieldMetaData::default()
        })
        .collect()
}

/// Reads what is announced of a call; its name is what stands behind that of the topic.
///
/// # Errors
/// In words, what makes it useless.
pub(crate) fn read(action: &ActionMetaData<'_>, name: &str) -> Result<CallDescription, String> {
    if action.target(TARGET).is_none() {
        return Err(format!("it has no target {TARGET}"));
    }
    let about = action.request.description.text.unwrap_or_default();
    if name.len() > MAX_NAME || about.len() > MAX_ABOUT {
        return Err("its name or description is too long".to_owned());
    }
    Ok(CallDescription {
        name: name.to_owned(),
        about: about.to_owned(),
        request: read_fields(&action.request)?,
        response: read_fields(&action.response)?,
    })
}

fn read_fields(data_set: &DataSetMetaDataType<'_>) -> Result<Vec<CallField>, String> {
    if data_set.fields.len() > MAX_CALL_FIELDS {
        return Err(format!("more than {MAX_CALL_FIELDS} fields"));
    }
    let fields = data_set.fields.iter().map(|field| {
        let name = field.name.unwrap_or_default();
        if name.len() > MAX_NAME {
            return Err("the name of a field is too long".to_owned());
        }
        let builtin = field
            .builtin_type()
            .ok_or_else(|| format!("{} is no builtin type", field.built_in_type))?;
        let optional = field.properties.iter().any(|property| {
            property.key == OPTIONAL && property.value == Variant::Scalar(Scalar::Boolean(true))
        });
        Ok(CallField {
            name: name.to_owned(),
            builtin,
            rank: read_rank(&field)?,
            optional,
        })
    });
    fields.collect()
}

impl Weight for CallDescription {
    fn weight(&self) -> usize {
        let fields = self.request.iter().chain(&self.response);
        let names: usize = fields
            .map(|field| field.name.len() + size_of::<CallField>())
            .sum();
        names + self.name.len() + self.about.len() + size_of::<Self>()
    }
}

/// The one target of each call.
pub(crate) const TARGET: u16 = 1;
/// Of a field of a request: it may be left out, with all others.
const OPTIONAL: QualifiedName<'static> = QualifiedName {
    namespace: 0,
    name: Some("Optional"),
};
/// Bytes of a description that is believed.
const MAX_ABOUT: usize = 1_024;
/// Fields of a request or response that are believed.
const MAX_CALL_FIELDS: usize = 256;

#[cfg(test)]
mod tests {
    use uadp::{BuiltinType, NetworkMessage};

    use super::*;

    #[test]
    fn what_is_announced_of_a_call_is_what_is_read_of_it() {
        let description = CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: "closes".to_owned(),
            request: vec![
                CallField::scalar("Force", BuiltinType::Double).optional(),
                CallField::array("Position", BuiltinType::Float),
            ],
            response: vec![CallField::scalar("success", BuiltinType::Boolean)],
        };
        let topic: TopicId = "ua_0_7_105".parse().unwrap();
        let utc = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
        let announcement = CallAnnouncement::new(topic, &description, None, utc).unwrap();
        let mut bytes = Vec::new();
        announcement.write(3, &mut bytes);
        let message = NetworkMessage::decode(&bytes).unwrap();
        let announced = Announcement::decode(&message).unwrap();
        assert_eq!(announced.sequence_number, 3);
        let Announced::ActionMetaData(action) = announced.announced else {
            unreachable!("{announced:?}");
        };
        assert_eq!(action.writer_id, 105);
        let (named, name) = crate::split_name(action.name().unwrap()).unwrap();
        assert_eq!(named, topic);
        assert_eq!(read(&action, name), Ok(description));
    }
}
