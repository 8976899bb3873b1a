//! Discovery announcements of a Publisher.

use super::configuration::{PubSubConnectionDataType, WriterGroupDataType};
use super::endpoint::{ApplicationDescription, EndpointDescription};
use super::list::WireArray;
use super::meta_data::DataSetMetaDataType;
use super::wire::{WireStructure, enumeration, structure};
use super::{read_payload, write_headers};
use crate::data_set_message::check_padding;
use crate::reader::ByteReader;
use crate::{
    DateTime, DecodeError, EncodeError, LocalizedText, NetworkMessage, NetworkMessageType, NodeId,
    PublisherId, SecurityHeader, StatusCode,
};
use alloc::vec::Vec;

/// A discovery announcement (OPC 10000-14, 7.2.4.6.3).
///
/// The PublisherId in the header of its NetworkMessage identifies the announcing Publisher.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Announcement<'a> {
    /// Number that increases by 1 with every announcement of the PublisherId. It is also the
    /// MessageSequenceNumber of the chunks of the announcement.
    pub sequence_number: u16,
    /// Content of the announcement.
    pub announced: AnnouncedContent<'a>,
}

/// Content of an [`Announcement`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AnnouncedContent<'a> {
    /// The Endpoints of the Server associated with the Publisher (OPC 10000-14, 7.2.4.6.6).
    PublisherEndpoints {
        /// The Endpoints.
        endpoints: WireArray<'a, EndpointDescription<'a>>,
        /// Bad if the Publisher has no information.
        status: StatusCode,
    },
    /// The content of the DataSet of a DataSetWriter (OPC 10000-14, 7.2.4.6.4).
    DataSetMetaData {
        /// The DataSetWriter.
        writer_id: u16,
        /// The metadata; valid only if the status is good.
        meta_data: DataSetMetaDataType<'a>,
        /// Bad if the Publisher has no information, for example because the DataSetWriter does not
        /// exist.
        status: StatusCode,
    },
    /// A WriterGroup with some of its DataSetWriters (OPC 10000-14, 7.2.4.6.9). It is also the
    /// response to [`Probe::WriterGroupConfiguration`](super::Probe), for which the standard has no
    /// separate announcement.
    DataSetWriterConfiguration {
        /// Ids of the announced DataSetWriters.
        writer_ids: WireArray<'a, u16>,
        /// The group, with the announced DataSetWriters only.
        writer_group: WriterGroupDataType<'a>,
        /// A status for each DataSetWriterId, in the same order.
        statuses: WireArray<'a, StatusCode>,
    },
    /// The PubSubConnections (OPC 10000-14, 7.2.4.6.8).
    PubSubConnections(WireArray<'a, PubSubConnectionDataType<'a>>),
    /// A PubSubConnection with a status. The standard defines an array without status instead, but
    /// other stacks send this form with the same AnnouncementType. It is decoded, but should not be
    /// sent.
    PubSubConnection {
        /// The connection.
        connection: PubSubConnectionDataType<'a>,
        /// Bad if the Publisher has no information.
        status: StatusCode,
    },
    /// The application; also the response to [`Probe::FindApplications`](super::Probe)
    /// (OPC 10000-14, 7.2.4.6.5).
    ApplicationDescription {
        /// The application.
        description: ApplicationDescription<'a>,
        /// Capability identifiers of OPC 10000-12, Annex D.
        capabilities: WireArray<'a, Option<&'a str>>,
    },
    /// The state of the Publisher (OPC 10000-14, 7.2.4.6.7).
    ApplicationStatus {
        /// State of the PubSubConnection.
        state: ConnectionState,
        /// Times of a cyclic status; `None` for a status that is sent on change.
        cyclic: Option<CyclicStatus>,
    },
    /// The connections with Action Responders (OPC 10000-14, 7.2.4.6.10).
    ActionResponder(WireArray<'a, PubSubConnectionDataType<'a>>),
    /// Arguments and results of an Action (OPC 10000-14, 7.2.4.6.11).
    ActionMetaData(ActionMetaData<'a>),
}

structure! {
    /// Times of a cyclic status and of the next status (OPC 10000-14, 7.2.4.6.7).
    CyclicStatus {
        /// Time of the next status. If it passes without a status, the Publisher counts as failed.
        next_report_time: DateTime = "NextReportTime",
        /// Time at which this status was sent.
        timestamp: DateTime = "Timestamp",
    }

    /// An Action and the targets it can be called on (OPC 10000-14, 7.2.4.6.11).
    ActionMetaData<'a> {
        /// DataSetWriter of the Action.
        writer_id: u16 = "DataSetWriterId",
        /// Targets of the Action.
        action_targets: WireArray<'a, ActionTargetDataType<'a>> = "ActionTargets",
        /// Content of requests; its name is the name of the Action.
        request: DataSetMetaDataType<'a> = "Request",
        /// Content of responses, with the name and ConfigurationVersion of the request.
        response: DataSetMetaDataType<'a> = "Response",
        /// The Methods of the targets, in the order of the targets, or empty.
        action_methods: WireArray<'a, ActionMethodDataType<'a>> = "ActionMethods",
    }

    /// A target of an Action (OPC 10000-14, 6.2.3.10.3).
    ActionTargetDataType<'a> {
        /// Unique among the targets of the Action.
        action_target_id: u16 = "ActionTargetId",
        /// Its name.
        name: Option<&'a str> = "Name",
        /// Description for people.
        description: LocalizedText<'a> = "Description",
    }

    /// The Method of a target of an Action (OPC 10000-14, 6.2.3.10).
    ActionMethodDataType<'a> {
        /// The Object.
        object_id: NodeId<'a> = "ObjectId",
        /// Its Method.
        method_id: NodeId<'a> = "MethodId",
    }
}

enumeration! {
    /// PubSubState in an announcement (OPC 10000-14, 6.2.1).
    ConnectionState {
        /// Not enabled.
        DISABLED = 0,
        /// Enabled, but a parent component is not.
        PAUSED = 1,
        /// Operational.
        OPERATIONAL = 2,
        /// Enabled, but in error.
        ERROR = 3,
        /// Enabled, and becoming operational.
        PRE_OPERATIONAL = 4,
    }
}

impl<'a> Announcement<'a> {
    /// Decodes the announcement of a NetworkMessage.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] if the message is not an announcement, is a chunk, or is still
    /// sealed; otherwise as [`decode_body`](Self::decode_body).
    pub fn decode(message: &NetworkMessage<'a>) -> Result<Self, DecodeError> {
        match message.message_type() {
            NetworkMessageType::Announcement => Self::decode_body(read_payload(message)?),
            NetworkMessageType::DataSet | NetworkMessageType::Probe => {
                Err(DecodeError::Misread("not a discovery announcement"))
            }
        }
    }

    /// Decodes the bytes behind the headers of an announcement, for example its reassembled chunks.
    ///
    /// # Errors
    /// [`DecodeError::Reserved`] with the type of an unknown announcement. Otherwise fails if a
    /// field is truncated or malformed, or if bytes other than padding follow the last field.
    pub fn decode_body(body: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = ByteReader::new(body);
        let announcement_type = reader.u8("AnnouncementType")?;
        let sequence_number = reader.u16("SequenceNumber")?;
        let announced = AnnouncedContent::read(announcement_type, &mut reader)?;
        check_padding(reader.rest())?;
        Ok(Self {
            sequence_number,
            announced,
        })
    }

    /// Appends the NetworkMessage, up to the end of its payload. Without security the header is
    /// [`SecurityHeader::NONE`].
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if a text, array or nonce exceeds its length field.
    pub fn encode(
        &self,
        publisher_id: PublisherId<'_>,
        security: SecurityHeader<'_>,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        write_headers(
            NetworkMessageType::Announcement,
            publisher_id,
            security,
            out,
        )?;
        self.encode_body(out)
    }

    /// Appends the bytes behind the headers. They are split into chunks if the NetworkMessage would
    /// exceed the DiscoveryMaxMessageSize (OPC 10000-14, 6.4.1.2.4 and 7.2.4.4.4).
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if a text or array exceeds its length field.
    pub fn encode_body(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        out.push(self.announced.announcement_type());
        out.extend_from_slice(&self.sequence_number.to_le_bytes());
        self.announced.write(out)
    }
}

impl<'a> AnnouncedContent<'a> {
    /// Returns the AnnouncementType, 1 to 7 (OPC 10000-14, 7.2.4.6.3).
    #[must_use]
    pub const fn announcement_type(&self) -> u8 {
        match self {
            Self::PublisherEndpoints { .. } => PUBLISHER_ENDPOINTS,
            Self::DataSetMetaData { .. } => DATA_SET_META_DATA,
            Self::DataSetWriterConfiguration { .. } => DATA_SET_WRITER_CONFIGURATION,
            Self::PubSubConnections(_) | Self::PubSubConnection { .. } => PUB_SUB_CONNECTIONS,
            Self::ApplicationDescription { .. } | Self::ApplicationStatus { .. } => {
                APPLICATION_INFORMATION
            }
            Self::ActionResponder(_) => ACTION_RESPONDER,
            Self::ActionMetaData(_) => ACTION_META_DATA,
        }
    }

    fn read(announcement_type: u8, reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(match announcement_type {
            PUBLISHER_ENDPOINTS => Self::PublisherEndpoints {
                endpoints: WireArray::read(reader, ENDPOINTS)?,
                status: WireStructure::read(reader, STATUS_CODE)?,
            },
            DATA_SET_META_DATA => Self::DataSetMetaData {
                writer_id: reader.u16("DataSetWriterId")?,
                meta_data: WireStructure::read(reader, "MetaData")?,
                status: WireStructure::read(reader, STATUS_CODE)?,
            },
            DATA_SET_WRITER_CONFIGURATION => Self::read_writer_configuration(reader)?,
            PUB_SUB_CONNECTIONS => Self::read_connections(reader)?,
            APPLICATION_INFORMATION => Self::read_application_information(reader)?,
            ACTION_RESPONDER => Self::ActionResponder(WireArray::read(reader, "ActionResponder")?),
            ACTION_META_DATA => Self::read_action_meta_data(reader)?,
            unknown => {
                return Err(DecodeError::Reserved {
                    field: "AnnouncementType",
                    value: unknown.into(),
                });
            }
        })
    }

    fn read_writer_configuration(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let writer_ids: WireArray<'a, u16> = WireArray::read(reader, WRITER_IDS)?;
        let writer_group = WireStructure::read(reader, "DataSetWriterConfig")?;
        let statuses: WireArray<'a, StatusCode> = WireArray::read(reader, STATUS_CODES)?;
        if statuses.len() != writer_ids.len() {
            return Err(DecodeError::Reserved {
                field: "number of statusCodes",
                value: u32::try_from(statuses.len()).unwrap_or(u32::MAX),
            });
        }
        Ok(Self::DataSetWriterConfiguration {
            writer_ids,
            writer_group,
            statuses,
        })
    }

    /// Reads the array of the standard, or else the single connection of other stacks. If both
    /// fail, the error is the error of the array.
    fn read_connections(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let mut other = *reader;
        let connections = WireArray::read(reader, CONNECTIONS).map(Self::PubSubConnections);
        if connections.is_ok() && reader.remaining() == 0 {
            return connections;
        }
        match Self::read_single_connection(&mut other) {
            Ok(connection) if other.remaining() == 0 => {
                *reader = other;
                Ok(connection)
            }
            Ok(_) | Err(_) => connections,
        }
    }

    fn read_single_connection(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(Self::PubSubConnection {
            connection: WireStructure::read(reader, CONNECTIONS)?,
            status: WireStructure::read(reader, STATUS_CODE)?,
        })
    }

    fn read_action_meta_data(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let action: ActionMetaData<'a> = WireStructure::read(reader, "ActionMetaData")?;
        if action.has_its_methods() {
            Ok(Self::ActionMetaData(action))
        } else {
            Err(DecodeError::Reserved {
                field: "number of ActionMethods",
                value: u32::try_from(action.action_methods.len()).unwrap_or(u32::MAX),
            })
        }
    }

    fn read_application_information(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(match reader.u16("ApplicationInformationType")? {
            APPLICATION_DESCRIPTION => Self::ApplicationDescription {
                description: WireStructure::read(reader, "ApplicationDescription")?,
                capabilities: WireArray::read(reader, CAPABILITIES)?,
            },
            APPLICATION_STATUS => {
                let is_cyclic = bool::read(reader, "IsCyclic")?;
                Self::ApplicationStatus {
                    state: WireStructure::read(reader, "Status")?,
                    cyclic: if is_cyclic {
                        Some(WireStructure::read(reader, "CyclicStatus")?)
                    } else {
                        None
                    },
                }
            }
            unknown => {
                return Err(DecodeError::Reserved {
                    field: "ApplicationInformationType",
                    value: unknown.into(),
                });
            }
        })
    }

    fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        match self {
            Self::PublisherEndpoints { endpoints, status } => {
                endpoints.write(out, ENDPOINTS)?;
                status.write(out, STATUS_CODE)
            }
            Self::DataSetMetaData {
                writer_id,
                meta_data,
                status,
            } => {
                out.extend_from_slice(&writer_id.to_le_bytes());
                meta_data.write(out, "MetaData")?;
                status.write(out, STATUS_CODE)
            }
            Self::DataSetWriterConfiguration {
                writer_ids,
                writer_group,
                statuses,
            } => {
                if statuses.len() != writer_ids.len() {
                    return Err(EncodeError::Misplaced(
                        "the numbers of statuses and of DataSetWriterIds differ",
                    ));
                }
                writer_ids.write(out, WRITER_IDS)?;
                writer_group.write(out, "DataSetWriterConfig")?;
                statuses.write(out, STATUS_CODES)
            }
            Self::PubSubConnections(connections) | Self::ActionResponder(connections) => {
                connections.write(out, CONNECTIONS)
            }
            Self::PubSubConnection { connection, status } => {
                connection.write(out, CONNECTIONS)?;
                status.write(out, STATUS_CODE)
            }
            Self::ApplicationDescription {
                description,
                capabilities,
            } => {
                out.extend_from_slice(&APPLICATION_DESCRIPTION.to_le_bytes());
                description.write(out, "ApplicationDescription")?;
                capabilities.write(out, CAPABILITIES)
            }
            Self::ApplicationStatus { state, cyclic } => {
                out.extend_from_slice(&APPLICATION_STATUS.to_le_bytes());
                out.push(u8::from(cyclic.is_some()));
                state.write(out, "Status")?;
                match cyclic {
                    Some(cyclic) => cyclic.write(out, "CyclicStatus"),
                    None => Ok(()),
                }
            }
            Self::ActionMetaData(action) if !action.has_its_methods() => Err(
                EncodeError::Misplaced("the numbers of ActionMethods and of ActionTargets differ"),
            ),
            Self::ActionMetaData(action) => action.write(out, "ActionMetaData"),
        }
    }
}

impl<'a> ActionMetaData<'a> {
    /// Returns the target with an ActionTargetId, and its Method if there is one.
    #[must_use]
    pub fn target(
        &self,
        target_id: u16,
    ) -> Option<(ActionTargetDataType<'a>, Option<ActionMethodDataType<'a>>)> {
        let mut targets = self.action_targets.iter().enumerate();
        let (index, target) = targets.find(|(_, target)| target.action_target_id == target_id)?;
        Some((target, self.action_methods.get(index)))
    }

    /// Returns the name of the Action. Returns `None` without a name, or if names or
    /// ConfigurationVersions of request and response differ, so that they do not belong to the same
    /// Action.
    #[must_use]
    pub fn name(&self) -> Option<&'a str> {
        let of = |data: &DataSetMetaDataType<'a>| (data.name, data.configuration_version);
        let one = of(&self.request) == of(&self.response);
        self.request.name.filter(|_| one)
    }

    fn has_its_methods(&self) -> bool {
        self.action_methods.is_empty() || self.action_methods.len() == self.action_targets.len()
    }
}

const PUBLISHER_ENDPOINTS: u8 = 1;
const DATA_SET_META_DATA: u8 = 2;
const DATA_SET_WRITER_CONFIGURATION: u8 = 3;
const PUB_SUB_CONNECTIONS: u8 = 4;
const APPLICATION_INFORMATION: u8 = 5;
const ACTION_RESPONDER: u8 = 6;
const ACTION_META_DATA: u8 = 7;

const APPLICATION_DESCRIPTION: u16 = 1;
const APPLICATION_STATUS: u16 = 2;

const ENDPOINTS: &str = "Endpoints";
const STATUS_CODE: &str = "statusCode";
const STATUS_CODES: &str = "statusCodes";
const WRITER_IDS: &str = "DataSetWriterIds";
const CONNECTIONS: &str = "PubSubConnections";
const CAPABILITIES: &str = "Capabilities";
