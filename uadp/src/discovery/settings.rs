//! Structures in ExtensionObjects, which can also hold other structures.

use super::list::WireArray;
use super::wire::{WireStructure, enumeration, read_all, structure};
use crate::{DecodeError, EncodeError, ExtensionBody, ExtensionObject, NodeId};
use alloc::vec::Vec;

/// Settings of a transport or message mapping in an [`ExtensionObject`], decoded on demand.
///
/// Settings of other mappings remain ExtensionObjects and are encoded as they were decoded.
#[expect(
    private_bounds,
    reason = "the settings of UADP and datagrams are all there are"
)]
pub trait SettingsStructure<'a>: WireStructure<'a> {
    /// NodeId of the binary encoding in the ExtensionObject.
    const ENCODING_ID: NodeId<'static>;

    /// Name of the structure.
    const NAME: &'static str;

    /// Decodes the object. Returns `None` if it has another type, is null, or is not binary.
    ///
    /// # Errors
    /// Fails if the body is not exactly this structure.
    fn from_object(object: &ExtensionObject<'a>) -> Result<Option<Self>, DecodeError> {
        match object.body {
            ExtensionBody::Binary(body) if object.type_id == Self::ENCODING_ID => {
                read_all(body, Self::NAME).map(Some)
            }
            ExtensionBody::Binary(_) | ExtensionBody::None | ExtensionBody::Xml(_) => Ok(None),
        }
    }

    /// Writes the body to the start of `buffer`, and returns the object.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] if a text or list exceeds its length field.
    fn write_object<'b>(
        &self,
        buffer: &'b mut Vec<u8>,
    ) -> Result<ExtensionObject<'b>, EncodeError> {
        buffer.clear();
        self.write(buffer, Self::NAME)?;
        Ok(ExtensionObject {
            type_id: Self::ENCODING_ID,
            body: ExtensionBody::Binary(buffer),
        })
    }
}

structure! {
    /// UADP NetworkMessage settings of a WriterGroup (OPC 10000-14, 6.3.1.1.7).
    UadpWriterGroupMessageDataType<'a> {
        /// Version of the layout, a VersionTime: seconds since 2000-01-01 UTC.
        group_version: u32 = "GroupVersion",
        /// Order of the DataSetMessages.
        data_set_ordering: DataSetOrderingType = "DataSetOrdering",
        /// UadpNetworkMessageContentMask: the present headers (OPC 10000-14, 6.3.1.1.4).
        network_message_content_mask: u32 = "NetworkMessageContentMask",
        /// Sampling time within the publishing interval, in milliseconds; -1 if undefined.
        sampling_offset: f64 = "SamplingOffset",
        /// Sending time of each NetworkMessage within the publishing interval, in milliseconds.
        publishing_offset: WireArray<'a, f64> = "PublishingOffset",
    }

    /// UADP DataSetMessage settings of a DataSetWriter (OPC 10000-14, 6.3.1.3.6).
    UadpDataSetWriterMessageDataType {
        /// UadpDataSetMessageContentMask: the present header fields (OPC 10000-14, 6.3.1.3.2).
        data_set_message_content_mask: u32 = "DataSetMessageContentMask",
        /// Size to which each DataSetMessage is padded, in bytes; 0 for no padding.
        configured_size: u16 = "ConfiguredSize",
        /// Number of its NetworkMessage within the publishing interval; 0 if undefined.
        network_message_number: u16 = "NetworkMessageNumber",
        /// Offset in the NetworkMessage, in bytes; 0 if undefined.
        data_set_offset: u16 = "DataSetOffset",
    }

    /// An address that is a URL (OPC 10000-14, 6.2.7.5.4).
    NetworkAddressUrlDataType<'a> {
        /// Network interface to use; null for any.
        network_interface: Option<&'a str> = "NetworkInterface",
        /// The URL, such as `opc.udp://224.0.2.14:4840`.
        url: Option<&'a str> = "Url",
    }

    /// Datagram settings of a connection (OPC 10000-14, 6.4.1.2.2).
    DatagramConnectionTransportDataType<'a> {
        /// Destination of probes and announcements, such as a [`NetworkAddressUrlDataType`].
        discovery_address: ExtensionObject<'a> = "DiscoveryAddress",
    }

    /// Datagram settings of a connection, from version 1.05 on (OPC 10000-14, 6.4.1.2.7).
    DatagramConnectionTransport2DataType<'a> {
        /// Destination of probes and announcements, such as a [`NetworkAddressUrlDataType`].
        discovery_address: ExtensionObject<'a> = "DiscoveryAddress",
        /// Announcement interval of the connection, in seconds; 0 for announcements on request
        /// only.
        discovery_announce_rate: u32 = "DiscoveryAnnounceRate",
        /// Maximum bytes of a discovery NetworkMessage, above which it is sent in chunks.
        discovery_max_message_size: u32 = "DiscoveryMaxMessageSize",
        /// Quality of service; null for best effort.
        qos_category: Option<&'a str> = "QosCategory",
        /// Parameters of the quality of service.
        datagram_qos: WireArray<'a, ExtensionObject<'a>> = "DatagramQos",
    }

    /// Datagram settings of a WriterGroup (OPC 10000-14, 6.4.1.3.3).
    DatagramWriterGroupTransportDataType {
        /// Number of repetitions of every NetworkMessage.
        message_repeat_count: u8 = "MessageRepeatCount",
        /// Time between the repetitions, in milliseconds.
        message_repeat_delay: f64 = "MessageRepeatDelay",
    }

    /// Datagram settings of a WriterGroup, from version 1.05 on (OPC 10000-14, 6.4.1.3.9).
    DatagramWriterGroupTransport2DataType<'a> {
        /// Number of repetitions of every NetworkMessage.
        message_repeat_count: u8 = "MessageRepeatCount",
        /// Time between the repetitions, in milliseconds.
        message_repeat_delay: f64 = "MessageRepeatDelay",
        /// Destination, such as a [`NetworkAddressUrlDataType`]; null for the address of the
        /// connection.
        address: ExtensionObject<'a> = "Address",
        /// Quality of service; null for the quality of service of the connection.
        qos_category: Option<&'a str> = "QosCategory",
        /// Parameters of the quality of service.
        datagram_qos: WireArray<'a, ExtensionObject<'a>> = "DatagramQos",
        /// Announcement interval of the group, in seconds; 0 for announcements on request only.
        discovery_announce_rate: u32 = "DiscoveryAnnounceRate",
        /// Topic, for transports with topics.
        topic: Option<&'a str> = "Topic",
    }
}

enumeration! {
    /// Order of the DataSetMessages in NetworkMessages (OPC 10000-14, 6.3.1.1.3).
    DataSetOrderingType {
        /// Any.
        UNDEFINED = 0,
        /// By DataSetWriterId, also across the NetworkMessages of a publishing interval.
        ASCENDING_WRITER_ID = 1,
        /// By DataSetWriterId, each in a separate NetworkMessage.
        ASCENDING_WRITER_ID_SINGLE = 2,
    }
}

macro_rules! settings {
    ($($name:ident $(<$lifetime:lifetime>)? = $encoding_id:literal;)+) => { $(
        impl<'a> SettingsStructure<'a> for $name $(<$lifetime>)? {
            const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, $encoding_id);
            const NAME: &'static str = stringify!($name);
        }
    )+ };
}

settings! {
    UadpWriterGroupMessageDataType<'a> = 15715;
    UadpDataSetWriterMessageDataType = 15717;
    NetworkAddressUrlDataType<'a> = 21152;
    DatagramConnectionTransportDataType<'a> = 17468;
    DatagramConnectionTransport2DataType<'a> = 23864;
    DatagramWriterGroupTransportDataType = 21155;
    DatagramWriterGroupTransport2DataType<'a> = 23865;
}
