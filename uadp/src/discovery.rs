//! Discovery: Subscribers probe, Publishers announce what they publish (OPC 10000-14, 7.2.4.6).
//!
//! A [`Probe`] or [`Announcement`] is the payload of a [`NetworkMessage`] of its own
//! [type](crate::NetworkMessageType). Reading one allocates nothing: arrays are [`List`]s over the checked bytes of the
//! datagram, ExtensionObjects are looked into on demand by the [`Settings`] of UADP and datagrams. The same structures
//! are written, with lists that borrow slices.
//!
//! One that is bigger than DiscoveryMaxMessageSize (4096 bytes unless configured: OPC 10000-14, 6.4.1.2.4) travels in
//! chunks of what [`encode_body`](Announcement::encode_body) writes, under the announcement's SequenceNumber and
//! without payload header (OPC 10000-14, 7.2.4.4.4). [`decode_body`](Announcement::decode_body) reads the whole.
//!
//! [`ProbeTimer`] says when to probe and [`Announcer`] what to answer when; where the datagrams go is the caller's
//! matter. By default that is `opc.udp://224.0.2.14:4840` for both.
//!
//! # Announcing the content of a DataSet
//! ```
//! use uadp::discovery::{
//!     Announced, Announcement, ConfigurationVersion, DataSetMetaDataType, FieldMetaData, List, VersionMatch,
//! };
//! use uadp::{
//!     BuiltinType, DataSetHeader, DecodeError, Guid, NetworkMessage, NodeId, PublisherId, SecurityHeader, StatusCode,
//! };
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
//!         array_dimensions: List::new(&[3]),
//!         ..FieldMetaData::default()
//!     },
//! ];
//! let announcement = Announcement {
//!     sequence_number: 7,
//!     announced: Announced::DataSetMetaData {
//!         writer_id: 10,
//!         meta_data: DataSetMetaDataType {
//!             name: Some("robot_status"),
//!             fields: List::new(&fields),
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
//! let Announced::DataSetMetaData { writer_id: 10, meta_data, status: StatusCode::GOOD } = heard.announced else {
//!     panic!("{heard:?}");
//! };
//! let (index, pose) = meta_data.field_by_name("pose").unwrap();
//! assert_eq!((index, pose.builtin_type()), (1, Some(BuiltinType::Double)));
//! assert_eq!(pose.array_dimensions.iter().collect::<Vec<_>>(), [3]);
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
    ActionMetaData, ActionMethodDataType, ActionTargetDataType, Announced, Announcement,
    ConnectionState, CyclicStatus,
};
pub use announcer::{
    AnnounceCounters, AnnounceLimits, AnnounceRefusal, Announcer, DueAnnouncement, Included,
    Subject,
};
pub use configuration::{
    DataSetReaderDataType, DataSetWriterDataType, KeyValuePair, PubSubConnectionDataType,
    PubSubGroupDataType, ReaderGroupDataType, WriterGroupDataType,
};
pub use endpoint::{
    ApplicationDescription, ApplicationType, EndpointDescription, MessageSecurityMode,
    UserTokenPolicy, UserTokenType,
};
pub use list::{List, ListIter};
pub use meta_data::{
    DataSetMetaDataType, DataTypeSchemaHeader, EnumDefinition, EnumDescription, EnumField,
    FieldMetaData, SimpleTypeDescription, StructureDefinition, StructureDescription,
    StructureField, StructureType, VersionMatch,
};
pub use probe::Probe;
pub use probe_timer::{ProbeLimits, ProbeStep, ProbeTimer};
pub use property::{EUInformation, EnumValueType, Range, enum_strings};
pub use settings::{
    DataSetOrderingType, DatagramConnectionTransport2DataType, DatagramConnectionTransportDataType,
    DatagramWriterGroupTransport2DataType, DatagramWriterGroupTransportDataType,
    NetworkAddressUrlDataType, Settings, UadpDataSetWriterMessageDataType,
    UadpWriterGroupMessageDataType,
};

use crate::header_writer::{self, Extras, Form, PayloadHeader};
use crate::{
    DecodeError, EncodeError, NetworkHeader, NetworkMessage, NetworkMessageType, PublisherId,
    SecurityHeader,
};

/// The payload of a discovery message that is whole and in clear.
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

/// The headers all discovery messages have: PublisherId and SecurityHeader, nothing else
/// (OPC 10000-14, 7.2.4.6.3 and 7.2.4.6.12.1).
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
    let form = Form {
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
