//! What a Publisher is configured to do: connections, groups and writers.

use super::endpoint::{EndpointDescription, MessageSecurityMode};
use super::list::List;
use super::meta_data::DataSetMetaDataType;
use super::wire::structure;
use crate::{ExtensionObject, QualifiedName, Variant};

structure! {
    /// A property by name (OPC 10000-5, 12.21).
    KeyValuePair<'a> {
        /// The name.
        key: QualifiedName<'a> = "Key",
        /// The value.
        value: Variant<'a> = "Value",
    }

    /// A PubSubConnection (OPC 10000-14, 6.2.7.5.1).
    PubSubConnectionDataType<'a> {
        /// Unique among the connections.
        name: Option<&'a str> = "Name",
        /// Whether it is enabled.
        enabled: bool = "Enabled",
        /// The PublisherId, of the type it has on the wire.
        publisher_id: Variant<'a> = "PublisherId",
        /// Transport and message mapping.
        transport_profile_uri: Option<&'a str> = "TransportProfileUri",
        /// Where to, such as a [`NetworkAddressUrlDataType`](super::NetworkAddressUrlDataType).
        address: ExtensionObject<'a> = "Address",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.8).
        connection_properties: List<'a, KeyValuePair<'a>> = "ConnectionProperties",
        /// Of the transport, such as a
        /// [`DatagramConnectionTransport2DataType`](super::DatagramConnectionTransport2DataType).
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// What is published over it, as far as the probe asked for it.
        writer_groups: List<'a, WriterGroupDataType<'a>> = "WriterGroups",
        /// Empty in discovery messages (OPC 10000-14, 7.2.4.6.8).
        reader_groups: List<'a, ReaderGroupDataType<'a>> = "ReaderGroups",
    }

    /// What writer and reader groups have in common (OPC 10000-14, 6.2.5.7).
    PubSubGroupDataType<'a> {
        /// Unique among the groups of the connection.
        name: Option<&'a str> = "Name",
        /// Whether it is enabled.
        enabled: bool = "Enabled",
        /// What is done to NetworkMessages.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// The SecurityGroup whose keys are used.
        security_group_id: Option<&'a str> = "SecurityGroupId",
        /// Where the keys are.
        security_key_services: List<'a, EndpointDescription<'a>> = "SecurityKeyServices",
        /// Most bytes of a NetworkMessage, beyond which messages are sent in chunks; 0 without limit.
        max_network_message_size: u32 = "MaxNetworkMessageSize",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.9).
        group_properties: List<'a, KeyValuePair<'a>> = "GroupProperties",
    }

    /// A WriterGroup (OPC 10000-14, 6.2.6.7.1).
    WriterGroupDataType<'a> {
        /// What every group has.
        group: PubSubGroupDataType<'a> = "PubSubGroupDataType",
        /// Unique among the WriterGroups of the Publisher; 0 is null.
        writer_group_id: u16 = "WriterGroupId",
        /// Time from message to message, in milliseconds.
        publishing_interval: f64 = "PublishingInterval",
        /// Time after which a keep-alive is sent when there is nothing to publish, in milliseconds.
        keep_alive_time: f64 = "KeepAliveTime",
        /// The higher, the sooner it is served among the groups of the Publisher.
        priority: u8 = "Priority",
        /// Languages of LocalizedTexts, in order of preference.
        locale_ids: List<'a, Option<&'a str>> = "LocaleIds",
        /// The header layout of OPC 10000-14, Annex A.
        header_layout_uri: Option<&'a str> = "HeaderLayoutUri",
        /// Of the transport, such as a
        /// [`DatagramWriterGroupTransport2DataType`](super::DatagramWriterGroupTransport2DataType).
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Of the message mapping, such as a
        /// [`UadpWriterGroupMessageDataType`](super::UadpWriterGroupMessageDataType).
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// The DataSetWriters, in announcements only those asked for.
        data_set_writers: List<'a, DataSetWriterDataType<'a>> = "DataSetWriters",
    }

    /// A DataSetWriter (OPC 10000-14, 6.2.4.5.1).
    DataSetWriterDataType<'a> {
        /// Unique in the group.
        name: Option<&'a str> = "Name",
        /// Whether it is enabled.
        enabled: bool = "Enabled",
        /// Unique among the DataSetWriters of the Publisher; 0 is null.
        data_set_writer_id: u16 = "DataSetWriterId",
        /// DataSetFieldContentMask (OPC 10000-14, 6.2.4.2): 0 for Variants, bit 5 for RawData, else the parts of the
        /// DataValues.
        data_set_field_content_mask: u32 = "DataSetFieldContentMask",
        /// Every how many messages there is a key frame.
        key_frame_count: u32 = "KeyFrameCount",
        /// The PublishedDataSet; null for a heartbeat.
        data_set_name: Option<&'a str> = "DataSetName",
        /// Not in discovery messages (OPC 10000-14, 7.2.4.6.9).
        data_set_writer_properties: List<'a, KeyValuePair<'a>> = "DataSetWriterProperties",
        /// Of the transport; null with datagrams.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Of the message mapping, such as a
        /// [`UadpDataSetWriterMessageDataType`](super::UadpDataSetWriterMessageDataType).
        message_settings: ExtensionObject<'a> = "MessageSettings",
    }

    /// A ReaderGroup (OPC 10000-14, 6.2.8.2.1).
    ReaderGroupDataType<'a> {
        /// What every group has.
        group: PubSubGroupDataType<'a> = "PubSubGroupDataType",
        /// Of the transport.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Of the message mapping.
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// The DataSetReaders.
        data_set_readers: List<'a, DataSetReaderDataType<'a>> = "DataSetReaders",
    }

    /// A DataSetReader (OPC 10000-14, 6.2.9.13.1).
    DataSetReaderDataType<'a> {
        /// Unique in the group.
        name: Option<&'a str> = "Name",
        /// Whether it is enabled.
        enabled: bool = "Enabled",
        /// The Publisher it listens to; null for any.
        publisher_id: Variant<'a> = "PublisherId",
        /// The WriterGroup it listens to; 0 for any.
        writer_group_id: u16 = "WriterGroupId",
        /// The DataSetWriter it listens to; 0 for any.
        data_set_writer_id: u16 = "DataSetWriterId",
        /// What it expects.
        data_set_meta_data: DataSetMetaDataType<'a> = "DataSetMetaData",
        /// As in [`DataSetWriterDataType`].
        data_set_field_content_mask: u32 = "DataSetFieldContentMask",
        /// Silence after which it is in error, in milliseconds.
        message_receive_timeout: f64 = "MessageReceiveTimeout",
        /// As in [`DataSetWriterDataType`].
        key_frame_count: u32 = "KeyFrameCount",
        /// As in [`WriterGroupDataType`].
        header_layout_uri: Option<&'a str> = "HeaderLayoutUri",
        /// As in [`PubSubGroupDataType`]; INVALID for that of the group.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// As in [`PubSubGroupDataType`].
        security_group_id: Option<&'a str> = "SecurityGroupId",
        /// As in [`PubSubGroupDataType`].
        security_key_services: List<'a, EndpointDescription<'a>> = "SecurityKeyServices",
        /// Properties of the configuration.
        data_set_reader_properties: List<'a, KeyValuePair<'a>> = "DataSetReaderProperties",
        /// Of the transport.
        transport_settings: ExtensionObject<'a> = "TransportSettings",
        /// Of the message mapping.
        message_settings: ExtensionObject<'a> = "MessageSettings",
        /// Where the fields go.
        subscribed_data_set: ExtensionObject<'a> = "SubscribedDataSet",
    }
}
