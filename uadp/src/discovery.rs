//! Discovery: Subscribers send probes, Publishers announce their configuration (OPC 10000-14,
//! 7.2.4.6).
//!
//! A [`Probe`] or [`Announcement`] is the payload of a [`NetworkMessage`] of a separate
//! [type](crate::NetworkMessageType). Decoding allocates nothing: arrays are [`WireArray`]s over
//! the checked bytes of the datagram, and ExtensionObjects are decoded on demand with the
//! [`SettingsStructure`] of UADP and datagrams. The same structures are encoded, with lists that
//! borrow slices.
//!
//! A message larger than DiscoveryMaxMessageSize (4096 bytes unless configured: OPC 10000-14,
//! 6.4.1.2.4) is sent in chunks of the bytes that [`encode_body`](Announcement::encode_body)
//! writes, with the SequenceNumber of the announcement and without payload header (OPC 10000-14,
//! 7.2.4.4.4). [`decode_body`](Announcement::decode_body) decodes the reassembled bytes.
//!
//! [`ProbeTimer`] schedules probes and [`Announcer`] schedules announcements. The caller sends the
//! datagrams; the default address for both is `opc.udp://224.0.2.14:4840`.
//!
//! # Announcing the content of a DataSet
//! ```
//! use uadp::discovery::{
//!     AnnouncedContent, Announcement, ConfigurationVersion, DataSetMetaDataType, FieldMetaData,
//!     WireArray, VersionMatch, }; use uadp::{ BuiltinType, DataSetHeader, DecodeError, Guid,
//!     NetworkMessage, NodeId, PublisherId, SecurityHeader, StatusCode, };
//!
//! let fields = [
//!     FieldMetaData {
//!         name: Some("battery"),
//!         built_in_type: BuiltinType::Double.id(),
//!         data_type: NodeId::numeric(0, 11),
//!         value_rank: -1,
//!         data_set_field_id: Guid([7; 16]),
//!         ..FieldMetaData::default()
//!     },
//!     FieldMetaData {
//!         name: Some("pose"),
//!         built_in_type: BuiltinType::Double.id(),
//!         data_type: NodeId::numeric(0, 11),
//!         value_rank: 1,
//!         array_dimensions: WireArray::new(&[3]),
//!         ..FieldMetaData::default()
//!     },
//! ];
//! let announcement = Announcement {
//!     sequence_number: 7,
//!     announced: AnnouncedContent::DataSetMetaData {
//!         writer_id: 10,
//!         meta_data: DataSetMetaDataType {
//!             name: Some("robot_status"),
//!             fields: WireArray::new(&fields),
//!             configuration_version: ConfigurationVersion { major: 700_000_000, minor: 700_000_000 },
//!             ..DataSetMetaDataType::default()
//!         },
//!         status: StatusCode::GOOD,
//!     },
//! };
//! let mut datagram = Vec::new();
//! announcement.encode(PublisherId::UInt16(2), SecurityHeader::NONE, &mut datagram)?;
//!
//! let message = NetworkMessage::decode(&datagram)?;
//! assert_eq!(message.header().publisher_id, Some(PublisherId::UInt16(2)));
//! let heard = Announcement::decode(&message)?;
//! assert_eq!(heard.sequence_number, 7);
//! let AnnouncedContent::DataSetMetaData { writer_id: 10, meta_data, status: StatusCode::GOOD } =
//! heard.announced else { panic!("{heard:?}"); }; let (index, pose) =
//! meta_data.field_by_name("pose").unwrap(); assert_eq!((index, pose.builtin_type()), (1,
//! Some(BuiltinType::Double))); assert_eq!(pose.array_dimensions.iter().collect::<Vec<_>>(), [3]);
//!
//! let header = DataSetHeader { major_version: Some(700_000_000), ..DataSetHeader::default() };
//! assert_eq!(meta_data.configuration_version.compare(&header), VersionMatch::Same);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod announcement;
mod announcer;
mod configuration;
mod endpoint;
mod list;
mod meta_data;
mod probe;
mod probe_timer;
mod property;
mod settings;
mod wire;

pub use crate::ConfigurationVersion;
pub use announcement::{
    ActionMetaData, ActionMethodDataType, ActionTargetDataType, AnnouncedContent, Announcement,
    ConnectionState, CyclicStatus,
};
pub use announcer::{
    AnnounceCounters, AnnounceLimits, AnnounceRefusal, AnnouncedSubject, Announcer,
    DueAnnouncement, Included,
};
pub use configuration::{
    DataSetReaderDataType, DataSetWriterDataType, PubSubConnectionDataType, PubSubGroupDataType,
    ReaderGroupDataType, WriterGroupDataType,
};
pub use endpoint::{
    ApplicationDescription, ApplicationType, EndpointDescription, MessageSecurityMode,
    UserTokenPolicy, UserTokenType,
};
pub use list::{ListIter, WireArray};
pub use meta_data::{
    DataSetMetaDataType, DataTypeSchemaHeader, EnumDefinition, EnumDescription, EnumField,
    FieldMetaData, KeyValuePair, SimpleTypeDescription, StructureDefinition, StructureDescription,
    StructureField, StructureType, VersionMatch,
};
pub use probe::Probe;
pub use probe_timer::{ProbeLimits, ProbeStep, ProbeTimer};
pub use property::{EUInformation, EnumValueType, Range, enum_strings, strings};
pub use settings::{
    DataSetOrderingType, DatagramConnectionTransport2DataType, DatagramConnectionTransportDataType,
    DatagramWriterGroupTransport2DataType, DatagramWriterGroupTransportDataType,
    NetworkAddressUrlDataType, SettingsStructure, UadpDataSetWriterMessageDataType,
    UadpWriterGroupMessageDataType,
};

use crate::header_writer::{self, Extras, MessageForm, PayloadHeader};
use crate::{
    DecodeError, EncodeError, NetworkHeader, NetworkMessage, NetworkMessageType, PublisherId,
    SecurityHeader,
};
use alloc::vec::Vec;

/// Returns the payload of a discovery message that is neither sealed nor a chunk.
fn read_payload<'a>(message: &NetworkMessage<'a>) -> Result<&'a [u8], DecodeError> {
    if message.is_sealed() {
        return Err(DecodeError::Misread(
            "secured, to be opened with its keys first",
        ));
    }
    if message.is_chunk() {
        return Err(DecodeError::Misread("a chunk, to be reassembled first"));
    }
    Ok(message.payload())
}

/// Writes the headers of a discovery message: PublisherId and SecurityHeader only (OPC 10000-14,
/// 7.2.4.6.3 and 7.2.4.6.12.1).
fn write_headers(
    message_type: NetworkMessageType,
    publisher_id: PublisherId<'_>,
    security: SecurityHeader<'_>,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let header = NetworkHeader {
        publisher_id: Some(publisher_id),
        ..NetworkHeader::default()
    };
    let form = MessageForm {
        message_type,
        chunk: false,
        action: false,
        extras: &Extras {
            promoted_fields: None,
            security: Some(security),
        },
    };
    header_writer::write(out, &header, PayloadHeader::None, form)?;
    Ok(())
}
