//! Discovery probes of a Subscriber.

use super::list::WireArray;
use super::wire::WireStructure;
use super::{read_payload, write_headers};
use crate::data_set_message::check_padding;
use crate::reader::ByteReader;
use crate::{
    DecodeError, EncodeError, NetworkMessage, NetworkMessageType, PublisherId, SecurityHeader,
};
use alloc::vec::Vec;

/// A discovery probe (OPC 10000-14, 7.2.4.6.12).
///
/// The PublisherId in the header of its NetworkMessage identifies the probed Publisher.
/// [`ProbeTimer`](super::ProbeTimer) schedules probes, [`Announcer`](super::Announcer) schedules
/// their responses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Probe<'a> {
    /// Requests the Endpoints of the Server associated with the Publisher.
    PublisherEndpoints,
    /// Requests the DataSetMetaData of these DataSetWriters.
    DataSetMetaData(WireArray<'a, u16>),
    /// Requests the configuration of these DataSetWriters and their WriterGroups.
    DataSetWriterConfiguration(WireArray<'a, u16>),
    /// Requests the configuration of a WriterGroup, which is announced as
    /// [`AnnouncedContent::DataSetWriterConfiguration`](super::AnnouncedContent).
    WriterGroupConfiguration {
        /// Id of the WriterGroup.
        writer_group_id: u16,
        /// Include its DataSetWriters.
        include_data_set_writers: bool,
    },
    /// Requests the PubSubConnections.
    PubSubConnections {
        /// Restricts the response to these transport profiles; null or empty for all.
        transport_profile_uris: WireArray<'a, Option<&'a str>>,
        /// Include their WriterGroups.
        include_writer_groups: bool,
        /// Include the DataSetWriters of the WriterGroups.
        include_data_set_writers: bool,
    },
    /// Requests the application description of every Publisher. The PublisherId in the header is
    /// null.
    FindApplications,
}

impl<'a> Probe<'a> {
    /// Decodes the probe of a NetworkMessage.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] if the message is not a probe, is a chunk, or is still sealed;
    /// otherwise as [`decode_body`](Self::decode_body).
    pub fn decode(message: &NetworkMessage<'a>) -> Result<Self, DecodeError> {
        match message.message_type() {
            NetworkMessageType::Probe => Self::decode_body(read_payload(message)?),
            NetworkMessageType::DataSet | NetworkMessageType::Announcement => {
                Err(DecodeError::Misread("not a discovery probe"))
            }
        }
    }

    /// Decodes the bytes behind the headers of a probe, for example its reassembled chunks. The
    /// Endpoints probe is accepted in both forms: without further fields, and as in version 1.04
    /// with an array that is null or empty.
    ///
    /// # Errors
    /// [`DecodeError::Reserved`] with the type of an unknown probe. Otherwise fails if a field is
    /// truncated or malformed, or if bytes other than padding follow the last field.
    pub fn decode_body(body: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = ByteReader::new(body);
        let probe = match reader.u8("ProbeType")? {
            PUBLISHER_INFORMATION => Self::read_publisher_information(&mut reader)?,
            FIND_APPLICATIONS => Self::FindApplications,
            unknown => {
                return Err(DecodeError::Reserved {
                    field: "ProbeType",
                    value: unknown.into(),
                });
            }
        };
        check_padding(reader.rest())?;
        Ok(probe)
    }

    fn read_publisher_information(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(match reader.u8("InformationType")? {
            PUBLISHER_ENDPOINTS => {
                skip_no_writer_ids(reader)?;
                Self::PublisherEndpoints
            }
            DATA_SET_META_DATA => Self::DataSetMetaData(WireArray::read(reader, WRITER_IDS)?),
            DATA_SET_WRITER => {
                Self::DataSetWriterConfiguration(WireArray::read(reader, WRITER_IDS)?)
            }
            WRITER_GROUP => Self::WriterGroupConfiguration {
                writer_group_id: reader.u16("WriterGroupId")?,
                include_data_set_writers: bool::read(reader, "IncludeDataSetWriters")?,
            },
            PUB_SUB_CONNECTIONS => Self::PubSubConnections {
                transport_profile_uris: WireArray::read(reader, "TransportProfileUris")?,
                include_writer_groups: bool::read(reader, "IncludeWriterGroups")?,
                include_data_set_writers: bool::read(reader, "IncludeDataSetWriters")?,
            },
            unknown => {
                return Err(DecodeError::Reserved {
                    field: "InformationType",
                    value: unknown.into(),
                });
            }
        })
    }

    /// Appends the NetworkMessage, up to the end of its payload. `publisher_id` identifies the
    /// probed Publisher. `None` is encoded as the Byte 0, which is not a valid PublisherId
    /// (OPC 10000-14, 6.2.7.1) and is required for [`FindApplications`](Self::FindApplications).
    /// Without security the header is [`SecurityHeader::NONE`].
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if a text, array or nonce exceeds its length field.
    pub fn encode(
        &self,
        publisher_id: Option<PublisherId<'_>>,
        security: SecurityHeader<'_>,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let publisher_id = publisher_id.unwrap_or(PublisherId::Byte(0));
        write_headers(NetworkMessageType::Probe, publisher_id, security, out)?;
        self.encode_body(out)
    }

    /// Appends the bytes behind the headers.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if a text or array exceeds its length field.
    pub fn encode_body(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        match self {
            Self::PublisherEndpoints => {
                out.extend_from_slice(&[PUBLISHER_INFORMATION, PUBLISHER_ENDPOINTS]);
            }
            Self::DataSetMetaData(writer_ids) => {
                out.extend_from_slice(&[PUBLISHER_INFORMATION, DATA_SET_META_DATA]);
                writer_ids.write(out, WRITER_IDS)?;
            }
            Self::DataSetWriterConfiguration(writer_ids) => {
                out.extend_from_slice(&[PUBLISHER_INFORMATION, DATA_SET_WRITER]);
                writer_ids.write(out, WRITER_IDS)?;
            }
            Self::WriterGroupConfiguration {
                writer_group_id,
                include_data_set_writers,
            } => {
                out.extend_from_slice(&[PUBLISHER_INFORMATION, WRITER_GROUP]);
                out.extend_from_slice(&writer_group_id.to_le_bytes());
                out.push(u8::from(*include_data_set_writers));
            }
            Self::PubSubConnections {
                transport_profile_uris,
                include_writer_groups,
                include_data_set_writers,
            } => {
                out.extend_from_slice(&[PUBLISHER_INFORMATION, PUB_SUB_CONNECTIONS]);
                transport_profile_uris.write(out, "TransportProfileUris")?;
                out.push(u8::from(*include_writer_groups));
                out.push(u8::from(*include_data_set_writers));
            }
            Self::FindApplications => out.push(FIND_APPLICATIONS),
        }
        Ok(())
    }
}

/// Skips the null array of DataSetWriterIds that ends the Endpoints probe of version 1.04.
fn skip_no_writer_ids(reader: &mut ByteReader<'_>) -> Result<(), DecodeError> {
    if reader.remaining() == 0 {
        return Ok(());
    }
    match reader.length(WRITER_IDS)? {
        None | Some(0) => Ok(()),
        Some(count) => Err(DecodeError::Reserved {
            field: "DataSetWriterIds of an Endpoints probe",
            value: u32::try_from(count).unwrap_or(u32::MAX),
        }),
    }
}

const WRITER_IDS: &str = "DataSetWriterIds";

const PUBLISHER_INFORMATION: u8 = 1;
const FIND_APPLICATIONS: u8 = 2;

const PUBLISHER_ENDPOINTS: u8 = 1;
const DATA_SET_META_DATA: u8 = 2;
const DATA_SET_WRITER: u8 = 3;
const WRITER_GROUP: u8 = 4;
const PUB_SUB_CONNECTIONS: u8 = 5;
