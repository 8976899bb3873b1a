//! Configuration of a Publisher: connections, groups and writers.

use super::endpoint::{EndpointDescription, MessageSecurityMode};
use super::list::WireArray;
use super::meta_data::{DataSetMetaDataType, KeyValuePair};
use super::wire::structure;
use crate::{ExtensionObject, Variant};

structure! {
    /// A PubSubConnection (OPC 10000-14, 6.2.7.5.1).
    PubSubConnectionDataType<'a> {
        /// Unique among the connections.
        name: Option<&'a str> = "Name",
        /// True if enabled.
        enabled: bool = "Enabled",
        /// The PublisherId, of the type it has on the wire.
        publisher_id: Variant<'a> = "PublisherId",
        /// Transport and message mapping.
        transport_profile_uri: Option<&'a str> = "TransportProfileUri",
        /// Destination, such as a [`NetworkAddressUrlDataType`](super::NetworkAddressUrlDataType).
        address: ExtensionObject<'a> = "Address",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.8).
        connection_properties: WireArray<'a, KeyValuePair<'a>> = "ConnectionProperties",
        /// Transport settings, such as a
        /// [`DatagramConnectionTransport2DataType`](super::DatagramConnectionTransport2DataType).
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// WriterGroups, if requested by the probe.
        writer_groups: WireArray<'a, WriterGroupDataType<'a>> = "WriterGroups",
        /// Empty in discovery messages (OPC 10000-14, 7.2.4.6.8).
        reader_groups: WireArray<'a, ReaderGroupDataType<'a>> = "ReaderGroups",
    }

    /// Common settings of writer and reader groups (OPC 10000-14, 6.2.5.7).
    PubSubGroupDataType<'a> {
        /// Unique among the groups of the connection.
        name: Option<&'a str> = "Name",
        /// True if enabled.
        enabled: bool = "Enabled",
        /// Security mode of the NetworkMessages.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// SecurityGroup that provides the keys.
        security_group_id: Option<&'a str> = "SecurityGroupId",
        /// Endpoints of the Security Key Services.
        security_key_services: WireArray<'a, EndpointDescription<'a>> = "SecurityKeyServices",
        /// Maximum bytes of a NetworkMessage, above which messages are sent in chunks; 0 for no
        /// limit.
        max_network_message_size: u32 = "MaxNetworkMessageSize",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.9).
        group_properties: WireArray<'a, KeyValuePair<'a>> = "GroupProperties",
    }

    /// A WriterGroup (OPC 10000-14, 6.2.6.7.1).
    WriterGroupDataType<'a> {
        /// Common settings of all groups.
        group: PubSubGroupDataType<'a> = "PubSubGroupDataType",
        /// Unique among the WriterGroups of the Publisher; 0 is null.
        writer_group_id: u16 = "WriterGroupId",
        /// Time from message to message, in milliseconds.
        publishing_interval: f64 = "PublishingInterval",
        /// Time after which a keep-alive is sent when there is nothing to publish, in milliseconds.
        keep_alive_time: f64 = "KeepAliveTime",
        /// Priority among the groups of the Publisher; a higher value is processed first.
        priority: u8 = "Priority",
        /// Languages of LocalizedTexts, in order of preference.
        locale_ids: WireArray<'a, Option<&'a str>> = "LocaleIds",
        /// The header layout of OPC 10000-14, Annex A.
        header_layout_uri: Option<&'a str> = "HeaderLayoutUri",
        /// Transport settings, such as a
        /// [`DatagramWriterGroupTransport2DataType`](super::DatagramWriterGroupTransport2DataType).
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Settings of the message mapping, such as a
        /// [`UadpWriterGroupMessageDataType`](super::UadpWriterGroupMessageDataType).
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// The DataSetWriters; announcements contain the requested DataSetWriters only.
        data_set_writers: WireArray<'a, DataSetWriterDataType<'a>> = "DataSetWriters",
    }

    /// A DataSetWriter (OPC 10000-14, 6.2.4.5.1).
    DataSetWriterDataType<'a> {
        /// Unique in the group.
        name: Option<&'a str> = "Name",
        /// True if enabled.
        enabled: bool = "Enabled",
        /// Unique among the DataSetWriters of the Publisher; 0 is null.
        data_set_writer_id: u16 = "DataSetWriterId",
        /// DataSetFieldContentMask (OPC 10000-14, 6.2.4.2): 0 for Variants, bit 5 for RawData,
        /// otherwise the parts of the DataValues.
        data_set_field_content_mask: u32 = "DataSetFieldContentMask",
        /// Number of messages from key frame to key frame.
        key_frame_count: u32 = "KeyFrameCount",
        /// The PublishedDataSet; null for a heartbeat.
        data_set_name: Option<&'a str> = "DataSetName",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.9).
        data_set_writer_properties: WireArray<'a, KeyValuePair<'a>> = "DataSetWriterProperties",
        /// Transport settings; null with datagrams.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Settings of the message mapping, such as a
        /// [`UadpDataSetWriterMessageDataType`](super::UadpDataSetWriterMessageDataType).
        message_settings: ExtensionObject<'a> = "MessageSettings",
    }

    /// A ReaderGroup (OPC 10000-14, 6.2.8.2.1).
    ReaderGroupDataType<'a> {
        /// Common settings of all groups.
        group: PubSubGroupDataType<'a> = "PubSubGroupDataType",
        /// Transport settings.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Settings of the message mapping.
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// The DataSetReaders.
        data_set_readers: WireArray<'a, DataSetReaderDataType<'a>> = "DataSetReaders",
    }

    /// A DataSetReader (OPC 10000-14, 6.2.9.13.1).
    DataSetReaderDataType<'a> {
        /// Unique in the group.
        name: Option<&'a str> = "Name",
        /// True if enabled.
        enabled: bool = "Enabled",
        /// PublisherId of the received messages; null for any.
        publisher_id: Variant<'a> = "PublisherId",
        /// WriterGroupId of the received messages; 0 for any.
        writer_group_id: u16 = "WriterGroupId",
        /// DataSetWriterId of the received messages; 0 for any.
        data_set_writer_id: u16 = "DataSetWriterId",
        /// Expected content.
        data_set_meta_data: DataSetMetaDataType<'a> = "DataSetMetaData",
        /// As in [`DataSetWriterDataType`].
        data_set_field_content_mask: u32 = "DataSetFieldContentMask",
        /// Time without a message after which the reader is in error, in milliseconds.
        message_receive_timeout: f64 = "MessageReceiveTimeout",
        /// As in [`DataSetWriterDataType`].
        key_frame_count: u32 = "KeyFrameCount",
        /// As in [`WriterGroupDataType`].
        header_layout_uri: Option<&'a str> = "HeaderLayoutUri",
        /// As in [`PubSubGroupDataType`]; INVALID to use the mode of the group.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// As in [`PubSubGroupDataType`].
        security_group_id: Option<&'a str> = "SecurityGroupId",
        /// As in [`PubSubGroupDataType`].
        security_key_services: WireArray<'a, EndpointDescription<'a>> = "SecurityKeyServices",
        /// Properties of the configuration.
        data_set_reader_properties: WireArray<'a, KeyValuePair<'a>> = "DataSetReaderProperties",
        /// Transport settings.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Settings of the message mapping.
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// Destination of the fields.
        subscribed_data_set: ExtensionObject<'a> = "SubscribedDataSet",
    }
}
