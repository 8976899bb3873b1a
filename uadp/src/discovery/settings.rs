//! Structures that come in ExtensionObjects, since others can stand in their place.

use super::list::List;
use super::wire::{Structure, enumeration, read_all, structure};
use crate::{DecodeError, EncodeError, ExtensionBody, ExtensionObject, NodeId};

/// Settings of a transport or message mapping, which come in an [`ExtensionObject`] and are decoded on demand.
///
/// Those of other mappings stay the ExtensionObject they are: it is written as it was read.
#[expect(
    private_bounds,
    reason = "the settings of UADP and datagrams are all there are"
)]
pub trait Settings<'a>: Structure<'a> {
    /// NodeId of the binary encoding, which the ExtensionObject has.
    const ENCODING_ID: NodeId<'static>;

    /// Name of the structure.
    const NAME: &'static str;

    /// Decodes the object; `None` when it is of another type, null, or not in binary.
    ///
    /// # Errors
    /// Fails when the body is not exactly this structure.
    fn from_object(object: &ExtensionObject<'a>) -> Result<Option<Self>, DecodeError> {
        match object.body {
            ExtensionBody::Binary(body) if object.type_id == Self::ENCODING_ID => {
                read_all(body, Self::NAME).map(Some)
            }
            ExtensionBody::Binary(_) | ExtensionBody::None | ExtensionBody::Xml(_) => Ok(None),
        }
    }

    /// Writes the body into `buffer`, from its start, and makes the object of it.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] when a text or list is too long for its length.
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
    /// How a WriterGroup makes UADP NetworkMessages (OPC 10000-14, 6.3.1.1.7).
    UadpWriterGroupMessageDataType<'a> {
        /// Version of the layout, a VersionTime: seconds since 2000-01-01 UTC.
        group_version: u32 = "GroupVersion",
        /// Order of the DataSetMessages.
        data_set_ordering: DataSetOrderingType = "DataSetOrdering",
        /// UadpNetworkMessageContentMask: the headers there are (OPC 10000-14, 6.3.1.1.4).
        network_message_content_mask: u32 = "NetworkMessageContentMask",
        /// When in the publishing interval values are sampled, in milliseconds; -1 when that is open.
        sampling_offset: f64 = "SamplingOffset",
        /// When in the publishing interval each NetworkMessage is sent, in milliseconds.
        publishing_offset: List<'a, f64> = "PublishingOffset",
    }

    /// How a DataSetWriter makes UADP DataSetMessages (OPC 10000-14, 6.3.1.3.6).
    UadpDataSetWriterMessageDataType {
        /// UadpDataSetMessageContentMask: the header fields there are (OPC 10000-14, 6.3.1.3.2).
        data_set_message_content_mask: u32 = "DataSetMessageContentMask",
        /// Bytes every DataSetMessage is padded to; 0 without padding.
        configured_size: u16 = "ConfiguredSize",
        /// Which NetworkMessage of the publishing interval it stands in; 0 when that is open.
        network_message_number: u16 = "NetworkMessageNumber",
        /// Where it starts in the NetworkMessage, in bytes; 0 when that is open.
        data_set_offset: u16 = "DataSetOffset",
    }

    /// An address that is a URL (OPC 10000-14, 6.2.7.5.4).
    NetworkAddressUrlDataType<'a> {
        /// Network interface to use; null for any.
        network_interface: Option<&'a str> = "NetworkInterface",
        /// The URL, such as `opc.udp://224.0.2.14:4840`.
        url: Option<&'a str> = "Url",
    }

    /// How a connection uses datagrams (OPC 10000-14, 6.4.1.2.2).
    DatagramConnectionTransportDataType<'a> {
        /// Where probes and announcements go; an address such as a [`NetworkAddressUrlDataType`].
        discovery_address: ExtensionObject<'a> = "DiscoveryAddress",
    }

    /// How a connection uses datagrams, since version 1.05 (OPC 10000-14, 6.4.1.2.7).
    DatagramConnectionTransport2DataType<'a> {
        /// Where probes and announcements go; an address such as a [`NetworkAddressUrlDataType`].
        discovery_address: ExtensionObject<'a> = "DiscoveryAddress",
        /// Every how many seconds the connection is announced; 0 for only when asked.
        discovery_announce_rate: u32 = "DiscoveryAnnounceRate",
        /// Most bytes of a discovery NetworkMessage, beyond which it is sent in chunks.
        discovery_max_message_size: u32 = "DiscoveryMaxMessageSize",
        /// Quality of service; null for best effort.
        qos_category: Option<&'a str> = "QosCategory",
        /// Parameters of the quality of service.
        datagram_qos: List<'a, ExtensionObject<'a>> = "DatagramQos",
    }

    /// How a WriterGroup uses datagrams (OPC 10000-14, 6.4.1.3.3).
    DatagramWriterGroupTransportDataType {
        /// How often every NetworkMessage is repeated.
        message_repeat_count: u8 = "MessageRepeatCount",
        /// Time between the repetitions, in milliseconds.
        message_repeat_delay: f64 = "MessageRepeatDelay",
    }

    /// How a WriterGroup uses datagrams, since version 1.05 (OPC 10000-14, 6.4.1.3.9).
    DatagramWriterGroupTransport2DataType<'a> {
        /// How often every NetworkMessage is repeated.
        message_repeat_count: u8 = "MessageRepeatCount",
        /// Time between the repetitions, in milliseconds.
        message_repeat_delay: f64 = "MessageRepeatDelay",
        /// Where to, such as a [`NetworkAddressUrlDataType`]; null for the address of the connection.
        address: ExtensionObject<'a> = "Address",
        /// Quality of service; null for that of the connection.
        qos_category: Option<&'a str> = "QosCategory",
        /// Parameters of the quality of service.
        datagram_qos: List<'a, ExtensionObject<'a>> = "DatagramQos",
        /// Every how many seconds the group is announced; 0 for only when asked.
        discovery_announce_rate: u32 = "DiscoveryAnnounceRate",
        /// Topic of a middleware that has such.
        topic: Option<&'a str> = "Topic",
    }
}

enumeration! {
    /// Order of the DataSetMessages in NetworkMessages (OPC 10000-14, 6.3.1.1.3).
    DataSetOrderingType {
        /// Any.
        UNDEFINED = 0,
        /// By DataSetWriterId, over the NetworkMessages of a publishing interval too.
        ASCENDING_WRITER_ID = 1,
        /// By DataSetWriterId, and each in a NetworkMessage of its own.
        ASCENDING_WRITER_ID_SINGLE = 2,
    }
}

macro_rules! settings {
    ($($name:ident $(<$lifetime:lifetime>)? = $encoding_id:literal;)+) => { $(
        impl<'a> Settings<'a> for $name $(<$lifetime>)? {
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
