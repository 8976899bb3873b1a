//! The announcements of publishers: names, units and fields of values.

use std::net::SocketAddr;

use mappings::{SpaceId, TopicId};
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, EUInformation, SettingsStructure as _,
};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId, Scalar, Variant};

/// The announced description of a value.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct AnnouncedValue {
    /// The display name; may be empty.
    pub(crate) name: String,
    /// The ROS type, if the fields form a message.
    pub(crate) type_name: String,
    /// The description for people.
    pub(crate) about: String,
    /// The unit of the first field that has one.
    pub(crate) unit: String,
    /// The names of the fields.
    pub(crate) fields: Vec<String>,
    /// The address of the publisher.
    pub(crate) from: Option<SocketAddr>,
}

/// Reads a message. Returns `None` unless it is the announcement of a value.
pub(crate) fn read(
    message: &NetworkMessage<'_>,
    from: SocketAddr,
) -> Option<(TopicId, AnnouncedValue)> {
    if message.message_type() != NetworkMessageType::Announcement
        || message.is_sealed()
        || message.is_chunk()
    {
        return None;
    }
    let Some(PublisherId::UInt16(space)) = message.publisher_id() else {
        return None;
    };
    let announcement = Announcement::decode(message).ok()?;
    let AnnouncedContent::DataSetMetaData {
        writer_id,
        meta_data,
        status,
    } = &announcement.announced
    else {
        return None;
    };
    let (topic, name) = split(meta_data.name?)?;
    let is_of_writer = topic.space == SpaceId::new(space)? && topic.identifier.get() == *writer_id;
    if !is_of_writer || status.0 & BAD != 0 {
        return None;
    }
    Some((topic, description(meta_data, name, from)))
}

fn description(
    meta_data: &DataSetMetaDataType<'_>,
    name: &str,
    from: SocketAddr,
) -> AnnouncedValue {
    let text = meta_data.description.text.unwrap_or_default();
    let (type_name, about) = text.split_once("; ").unwrap_or((text, ""));
    let names = meta_data.fields.iter().take(MOST_FIELDS);
    AnnouncedValue {
        name: bounded(name),
        type_name: bounded(type_name),
        about: bounded(about),
        unit: unit(meta_data).unwrap_or_default(),
        fields: names
            .map(|field| bounded(field.name.unwrap_or_default()))
            .collect(),
        from: Some(from),
    }
}

/// Returns the symbol of the first unit.
fn unit(meta_data: &DataSetMetaDataType<'_>) -> Option<String> {
    let fields = meta_data.fields.iter().take(MOST_FIELDS);
    fields
        .flat_map(|field| field.properties.iter().take(MOST_PROPERTIES))
        .find_map(|property| {
            let Variant::Scalar(Scalar::ExtensionObject(object)) = property.value else {
                return None;
            };
            let unit = EUInformation::from_object(&object).ok()??;
            unit.display_name.text.map(bounded)
        })
}

/// Splits the name of a DataSet into the topic and the display name.
fn split(name: &str) -> Option<(TopicId, &str)> {
    let (topic, name) = name.split_once(' ').unwrap_or((name, ""));
    Some((topic.parse().ok()?, name))
}

fn bounded(text: &str) -> String {
    crate::value::cut(text, LONGEST)
}

/// The bit of a StatusCode that marks the severity Bad.
const BAD: u32 = 0x8000_0000;
const LONGEST: usize = 200;
const MOST_FIELDS: usize = 256;
const MOST_PROPERTIES: usize = 16;
