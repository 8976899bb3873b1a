//! Discovery messages as JSON: their type and identifiers as values, their structures as bytes.

use uadp::discovery::{AnnouncedContent, Announcement, Probe, WireArray};
use uadp::{DecodeError, StatusCode};

use crate::shape::{self, FieldMetaData};
use crate::values::WrongValue;
use crate::{hex, node_ids};

/// Shows the body of a probe, after its headers.
pub(crate) fn show_probe(body: &[u8]) -> Result<shape::ProbeJson, DecodeError> {
    let mut shown = shape::ProbeJson {
        probe_type: PUBLISHER_INFORMATION,
        ..shape::ProbeJson::default()
    };
    let information_type = match Probe::decode_body(body)? {
        Probe::PublisherEndpoints => 1,
        Probe::DataSetMetaData(ids) => {
            shown.data_set_writer_ids = Some(ids.iter().collect());
            2
        }
        Probe::DataSetWriterConfiguration(ids) => {
            shown.data_set_writer_ids = Some(ids.iter().collect());
            3
        }
        Probe::WriterGroupConfiguration {
            writer_group_id,
            include_data_set_writers,
        } => {
            shown.writer_group_id = Some(writer_group_id);
            shown.include_data_set_writers = Some(include_data_set_writers);
            4
        }
        Probe::PubSubConnections {
            transport_profile_uris,
            include_writer_groups,
            include_data_set_writers,
        } => {
            let uris = transport_profile_uris.iter();
            shown.transport_profile_uris = Some(uris.map(|uri| uri.map(str::to_owned)).collect());
            shown.include_writer_groups = Some(include_writer_groups);
            shown.include_data_set_writers = Some(include_data_set_writers);
            5
        }
        Probe::FindApplications => {
            shown.probe_type = FIND_APPLICATIONS;
            return Ok(shown);
        }
    };
    shown.information_type = Some(information_type);
    Ok(shown)
}

/// Returns the body of a probe, after its headers.
pub(crate) fn probe_body(json: &shape::ProbeJson) -> Result<Vec<u8>, WrongValue> {
    let ids = json.data_set_writer_ids.as_deref().unwrap_or_default();
    let uris = json.transport_profile_uris.as_deref().unwrap_or_default();
    let uris: Vec<_> = uris.iter().map(Option::as_deref).collect();
    let include_data_set_writers = json.include_data_set_writers.unwrap_or_default();
    let probe = match (json.probe_type, json.information_type) {
        (PUBLISHER_INFORMATION, Some(1)) => Probe::PublisherEndpoints,
        (PUBLISHER_INFORMATION, Some(2)) => Probe::DataSetMetaData(WireArray::new(ids)),
        (PUBLISHER_INFORMATION, Some(3)) => Probe::DataSetWriterConfiguration(WireArray::new(ids)),
        (PUBLISHER_INFORMATION, Some(4)) => Probe::WriterGroupConfiguration {
            writer_group_id: json.writer_group_id.unwrap_or_default(),
            include_data_set_writers,
        },
        (PUBLISHER_INFORMATION, Some(5)) => Probe::PubSubConnections {
            transport_profile_uris: WireArray::new(&uris),
            include_writer_groups: json.include_writer_groups.unwrap_or_default(),
            include_data_set_writers,
        },
        (FIND_APPLICATIONS, None) => Probe::FindApplications,
        _ => {
            return Err(WrongValue::new(
                "probeType 1 with informationType 1 to 5, or probeType 2 without",
            ));
        }
    };
    let mut body = Vec::new();
    probe.encode_body(&mut body)?;
    Ok(body)
}

/// Shows the body of an announcement, after its headers.
pub(crate) fn show_announcement(body: &[u8]) -> Result<shape::AnnouncementJson, DecodeError> {
    let Announcement {
        sequence_number,
        announced,
    } = Announcement::decode_body(body)?;
    let mut shown = shape::AnnouncementJson {
        announcement_type: announced.announcement_type(),
        sequence_number,
        ..shape::AnnouncementJson::default()
    };
    // The numbers of bytes before and after the structure.
    let (head, tail) = match announced {
        AnnouncedContent::PublisherEndpoints { endpoints, status } => {
            shown.endpoints = Some(endpoints.len());
            let urls = endpoints
                .iter()
                .filter_map(|endpoint| endpoint.endpoint_url);
            shown.endpoint_urls = urls.map(str::to_owned).collect();
            shown.status_code = Some(status.0);
            (LENGTH, STATUS)
        }
        AnnouncedContent::DataSetMetaData {
            writer_id,
            meta_data,
            status,
        } => {
            shown.data_set_writer_id = Some(writer_id);
            shown.meta_data_name = meta_data.name.map(str::to_owned);
            shown.meta_data = meta_data.fields.iter().map(show_field).collect();
            shown.status_code = Some(status.0);
            (WRITER_ID, STATUS)
        }
        AnnouncedContent::DataSetWriterConfiguration {
            writer_ids,
            statuses,
            ..
        } => {
            shown.data_set_writer_ids = Some(writer_ids.iter().collect());
            shown.status_codes = Some(statuses.iter().map(|status| status.0).collect());
            (
                LENGTH + writer_ids.len() * WRITER_ID,
                LENGTH + statuses.len() * STATUS,
            )
        }
        AnnouncedContent::PubSubConnections(connections) => {
            shown.connections = Some(connections.len());
            (LENGTH, 0)
        }
        AnnouncedContent::PubSubConnection { status, .. } => {
            shown.status_code = Some(status.0);
            (0, STATUS)
        }
        AnnouncedContent::ApplicationDescription { .. }
        | AnnouncedContent::ApplicationStatus { .. }
        | AnnouncedContent::ActionResponder(_)
        | AnnouncedContent::ActionMetaData(_) => (0, 0),
    };
    let structure = body
        .get(ANNOUNCEMENT_HEAD + head..body.len() - tail)
        .unwrap_or_default();
    shown.body_hex = Some(hex::text(structure));
    Ok(shown)
}

/// Returns the body of an announcement, after its headers.
pub(crate) fn announcement_body(json: &shape::AnnouncementJson) -> Result<Vec<u8>, WrongValue> {
    let structure = json.body_hex.as_deref().unwrap_or_default();
    let structure =
        hex::parse(structure).map_err(|error| WrongValue::new(error.to_string()).at(".bodyHex"))?;
    let mut body = vec![json.announcement_type];
    body.extend(json.sequence_number.to_le_bytes());
    let status = json.status_code.unwrap_or_default().to_le_bytes();
    match json.announcement_type {
        1 => {
            body.extend(length(json.endpoints.unwrap_or_default())?);
            body.extend(structure);
            body.extend(status);
        }
        2 => {
            body.extend(json.data_set_writer_id.unwrap_or_default().to_le_bytes());
            body.extend(structure);
            body.extend(status);
        }
        3 => {
            let ids = json.data_set_writer_ids.as_deref().unwrap_or_default();
            body.extend(length(ids.len())?);
            body.extend(ids.iter().flat_map(|id| id.to_le_bytes()));
            body.extend(structure);
            let statuses = json.status_codes.as_deref().unwrap_or_default();
            body.extend(length(statuses.len())?);
            body.extend(statuses.iter().flat_map(|status| status.to_le_bytes()));
        }
        4 => match json.connections {
            Some(connections) => {
                body.extend(length(connections)?);
                body.extend(structure);
            }
            None => {
                body.extend(structure);
                body.extend(status);
            }
        },
        _ => body.extend(structure),
    }
    Announcement::decode_body(&body).map_err(|error| {
        WrongValue::new(format!(
            "not what an announcement of this type holds: {error}"
        ))
    })?;
    Ok(body)
}

fn show_field(field: uadp::discovery::FieldMetaData<'_>) -> FieldMetaData {
    let is_structure = field.built_in_type == uadp::BuiltinType::ExtensionObject.id();
    FieldMetaData {
        name: field.name.map(str::to_owned),
        built_in_type: field.built_in_type,
        data_type: is_structure.then(|| node_ids::text(field.data_type)),
        value_rank: field.value_rank,
        array_dimensions: field.array_dimensions.iter().collect(),
        max_string_length: field.max_string_length,
    }
}

fn length(count: usize) -> Result<[u8; 4], WrongValue> {
    match i32::try_from(count) {
        Ok(count) => Ok(count.to_le_bytes()),
        Err(_) => Err(WrongValue::new(format!("{count} are too many"))),
    }
}

const PUBLISHER_INFORMATION: u8 = 1;
const FIND_APPLICATIONS: u8 = 2;
/// Bytes of AnnouncementType and SequenceNumber.
const ANNOUNCEMENT_HEAD: usize = 3;
/// Bytes of the length of an array, of a DataSetWriterId and of a StatusCode.
const LENGTH: usize = 4;
const WRITER_ID: usize = 2;
const STATUS: usize = size_of::<StatusCode>();
