//! The PubSub configuration as a file that clients can read (OPC 10000-14, 9.1.3.7): the content of
//! the nodes in a single structure.
//!
//! The file is a UABinaryFileDataType as an ExtensionObject; its Body is a
//! PubSubConfiguration2DataType. It is read-only, because the mapping defines the configuration.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use mappings::{Mapping, SpaceId, TopicId};
use opcua::types::{
    BinaryEncodable as _, ContextOwned, DataSetFieldContentMask, DataSetReaderDataType,
    DataSetWriterDataType, ExtensionObject, MethodId, NetworkAddressUrlDataType, NodeId,
    PubSubConfiguration2DataType, PubSubConnectionDataType, PublishedDataItemsDataType,
    PublishedDataSetDataType, ReaderGroupDataType, StatusCode, TargetVariablesDataType,
    UABinaryFileDataType, UAString, UadpDataSetMessageContentMask,
    UadpDataSetWriterMessageDataType, UadpNetworkMessageContentMask,
    UadpWriterGroupMessageDataType, VariableId, Variant, WriterGroupDataType,
};
use plant_opcua::file::{FileAnswer, FileMethod, READ};
use plant_opcua::server::{CoreMethod, MethodRequest, method};

use super::insert::{self, DATA_SET_MESSAGE, FILE, NETWORK_MESSAGE};
use super::{Kind, PubSubNodes};
use crate::layout::{Layout, TopicNode};

/// The content of the file while all components are enabled.
#[derive(Debug, Default)]
pub(super) struct Content {
    /// The NamespaceArray from index 1 on. Index 0 is omitted in files (OPC 10000-5, 12.31).
    namespaces: Vec<UAString>,
    configuration: PubSubConfiguration2DataType,
}

impl Content {
    /// Returns the content for the topics that are shown.
    pub(super) fn of(mapping: &Mapping, layout: &Layout) -> Self {
        let mut writers: BTreeMap<u16, WriterGroupDataType> = BTreeMap::new();
        let mut readers: BTreeMap<(SpaceId, u16), ReaderGroupDataType> = BTreeMap::new();
        let mut sets = Vec::new();
        for topic in layout.topics.iter().take(insert::MOST_SHOWN) {
            let (space, namespace) = (topic.topic.space, topic.topic.namespace.get());
            if space == SpaceId::UA {
                let group = writers
                    .entry(namespace)
                    .or_insert_with(|| writer_group(mapping, namespace));
                group
                    .data_set_writers
                    .get_or_insert_default()
                    .push(writer(topic));
                sets.push(published(topic));
            } else {
                let group = readers
                    .entry((space, namespace))
                    .or_insert_with(|| reader_group(mapping, (space, namespace)));
                let reader = reader(mapping, topic);
                group.data_set_readers.get_or_insert_default().push(reader);
            }
        }
        let pubsub = mapping.pubsub();
        let address = NetworkAddressUrlDataType {
            network_interface: pubsub.interface.as_deref().unwrap_or_default().into(),
            url: insert::url(mapping).into(),
        };
        let connection = PubSubConnectionDataType {
            name: insert::CONNECTION.into(),
            enabled: true,
            publisher_id: Variant::UInt16(u16::from(SpaceId::UA.get())),
            transport_profile_uri: insert::profile(mapping).into(),
            address: ExtensionObject::from_message(address),
            writer_groups: Some(writers.into_values().collect()),
            reader_groups: Some(readers.into_values().collect()),
            ..PubSubConnectionDataType::default()
        };
        let namespaces = layout.namespaces.iter().skip(1);
        Self {
            namespaces: namespaces.map(|uri| uri.as_str().into()).collect(),
            configuration: PubSubConfiguration2DataType {
                published_data_sets: Some(sets),
                connections: Some(vec![connection]),
                enabled: true,
                ..PubSubConfiguration2DataType::default()
            },
        }
    }

    /// Returns the bytes of the file, with the disabled components.
    pub(super) fn bytes(&self, disabled: &HashSet<Kind>) -> Vec<u8> {
        let mut configuration = self.configuration.clone();
        if !disabled.is_empty() {
            disable(&mut configuration, disabled);
        }
        let file = UABinaryFileDataType {
            namespaces: Some(self.namespaces.clone()),
            body: Variant::from(ExtensionObject::from_message(configuration)),
            ..UABinaryFileDataType::default()
        };
        let file = ExtensionObject::from_message(file);
        file.encode_to_vec(&ContextOwned::default().context())
    }
}

/// Marks the disabled components.
fn disable(configuration: &mut PubSubConfiguration2DataType, disabled: &HashSet<Kind>) {
    let is_enabled = |kind| !disabled.contains(&kind);
    configuration.enabled = is_enabled(Kind::Whole);
    for connection in configuration.connections.iter_mut().flatten() {
        connection.enabled = is_enabled(Kind::Connection);
        for group in connection.writer_groups.iter_mut().flatten() {
            group.enabled = is_enabled(Kind::Writers(group.writer_group_id));
            for writer in group.data_set_writers.iter_mut().flatten() {
                let topic = topic(writer.data_set_name.as_ref());
                writer.enabled = topic.is_none_or(|topic| is_enabled(Kind::Writer(topic)));
            }
        }
        for group in connection.reader_groups.iter_mut().flatten() {
            for reader in group.data_set_readers.iter_mut().flatten() {
                let Some(topic) = topic(reader.name.as_ref()) else {
                    continue;
                };
                reader.enabled = is_enabled(Kind::Reader(topic));
                group.enabled = is_enabled(Kind::Readers(topic.space, topic.namespace.get()));
            }
        }
    }
}

/// Writers and readers have the names of their topics.
fn topic(name: &str) -> Option<TopicId> {
    name.parse().ok()
}

fn writer_group(mapping: &Mapping, namespace: u16) -> WriterGroupDataType {
    let pubsub = mapping.pubsub();
    let security = insert::Secured::of(mapping.group_of(namespace));
    let settings = UadpWriterGroupMessageDataType {
        network_message_content_mask: UadpNetworkMessageContentMask::from_bits_truncate(
            NETWORK_MESSAGE.cast_signed(),
        ),
        ..UadpWriterGroupMessageDataType::default()
    };
    WriterGroupDataType {
        name: insert::writers_name(namespace).into(),
        enabled: true,
        security_mode: security.mode,
        security_group_id: security.group,
        security_key_services: security.services,
        max_network_message_size: u32::from(pubsub.max_datagram),
        writer_group_id: namespace,
        publishing_interval: insert::milliseconds(pubsub.key_frame_period),
        keep_alive_time: insert::milliseconds(pubsub.keep_alive_period),
        message_settings: ExtensionObject::from_message(settings),
        ..WriterGroupDataType::default()
    }
}

fn reader_group(mapping: &Mapping, (space, namespace): (SpaceId, u16)) -> ReaderGroupDataType {
    let security = insert::Secured::of(mapping.group_of(namespace));
    ReaderGroupDataType {
        name: insert::readers_name(space, namespace).into(),
        enabled: true,
        security_mode: security.mode,
        security_group_id: security.group,
        security_key_services: security.services,
        max_network_message_size: u32::from(mapping.pubsub().max_datagram),
        ..ReaderGroupDataType::default()
    }
}

fn writer(topic: &TopicNode) -> DataSetWriterDataType {
    let name = topic.topic.to_string();
    let (_, _, identifier) = topic.topic.triple();
    let settings = UadpDataSetWriterMessageDataType {
        data_set_message_content_mask: UadpDataSetMessageContentMask::from_bits_truncate(
            DATA_SET_MESSAGE.cast_signed(),
        ),
        ..UadpDataSetWriterMessageDataType::default()
    };
    DataSetWriterDataType {
        name: name.as_str().into(),
        enabled: true,
        data_set_writer_id: identifier,
        data_set_field_content_mask: DataSetFieldContentMask::empty(),
        key_frame_count: 1,
        data_set_name: name.as_str().into(),
        message_settings: ExtensionObject::from_message(settings),
        ..DataSetWriterDataType::default()
    }
}

/// Returns the DataSet that a writer sends.
fn published(topic: &TopicNode) -> PublishedDataSetDataType {
    let source = PublishedDataItemsDataType {
        published_data: Some(insert::published(topic).collect()),
    };
    PublishedDataSetDataType {
        name: topic.topic.to_string().into(),
        data_set_meta_data: insert::meta_data(topic),
        data_set_source: ExtensionObject::from_message(source),
        ..PublishedDataSetDataType::default()
    }
}

fn reader(mapping: &Mapping, topic: &TopicNode) -> DataSetReaderDataType {
    let (space, namespace, identifier) = topic.topic.triple();
    let targets = TargetVariablesDataType {
        target_variables: Some(insert::targets(topic).collect()),
    };
    let security = insert::Secured::of(mapping.group_of(namespace));
    DataSetReaderDataType {
        name: topic.topic.to_string().into(),
        enabled: true,
        publisher_id: Variant::UInt16(space),
        writer_group_id: namespace,
        data_set_writer_id: identifier,
        data_set_meta_data: insert::meta_data(topic),
        message_receive_timeout: insert::milliseconds(mapping.pubsub().receive_timeout),
        key_frame_count: 1,
        security_mode: security.mode,
        security_group_id: security.group,
        security_key_services: security.services,
        subscribed_data_set: ExtensionObject::from_message(targets),
        ..DataSetReaderDataType::default()
    }
}

impl PubSubNodes {
    /// Returns the methods of the file.
    pub(super) fn file_methods(self: &Arc<Self>) -> Vec<CoreMethod> {
        let methods = METHODS.iter().map(|(own, of_type, name, what)| {
            let this = Arc::clone(self);
            let what = *what;
            let handler = method(move |request: MethodRequest| this.in_file(what, &request));
            let nodes: [NodeId; 2] = [(*own).into(), (*of_type).into()];
            CoreMethod::new(FILE, nodes, name, handler)
        });
        methods.collect()
    }

    fn in_file(&self, what: Option<FileMethod>, request: &MethodRequest) -> FileAnswer {
        let mut handles = self.file.lock();
        let before = handles.len();
        let answer = match (what, request.arguments.as_slice()) {
            (Some(FileMethod::Open), [Variant::Byte(READ)]) => {
                let content = self.file_bytes();
                handles.add(request, content, false)
            }
            (Some(FileMethod::Open), [Variant::Byte(mode)]) if MODES.contains(mode) => {
                Err(StatusCode::BadNotWritable.into())
            }
            // ReserveIds and CloseAndUpdate are for clients that write the file.
            (None, _) => Err(StatusCode::BadNotWritable.into()),
            (Some(what), _) => handles.call(what, request),
        };
        if handles.len() != before {
            self.show_open(handles.len());
        }
        answer
    }

    /// Closes the handles of closed sessions.
    pub(super) fn tidy_file(&self) {
        let mut handles = self.file.lock();
        let before = handles.len();
        handles.tidy();
        if handles.len() != before {
            self.show_open(handles.len());
        }
    }

    fn file_bytes(&self) -> Vec<u8> {
        let inner = self.inner.lock();
        inner.content.bytes(&inner.disabled())
    }

    fn show_open(&self, count: usize) {
        let count = u16::try_from(count).unwrap_or(u16::MAX);
        let node = VariableId::PublishSubscribe_PubSubConfiguration_OpenCount;
        self.write(vec![(node.into(), Variant::UInt16(count))]);
    }

    /// Shows the size of the file and that it is read-only.
    pub(super) fn show_file(&self) {
        let size = u64::try_from(self.file_bytes().len()).unwrap_or(u64::MAX);
        self.write(vec![
            (
                VariableId::PublishSubscribe_PubSubConfiguration_Size.into(),
                Variant::UInt64(size),
            ),
            (
                VariableId::PublishSubscribe_PubSubConfiguration_Writable.into(),
                Variant::Boolean(false),
            ),
            (
                VariableId::PublishSubscribe_PubSubConfiguration_UserWritable.into(),
                Variant::Boolean(false),
            ),
        ]);
    }
}

/// The other modes of the file beside read: erase and write, and read and write (OPC 10000-14,
/// 9.1.3.7.1).
const MODES: [u8; 2] = [6, 3];

/// The methods: own node, node of the type, name, and function of the file. Methods that are only
/// useful for writing have no function.
const METHODS: [(MethodId, MethodId, &str, Option<FileMethod>); 8] = [
    (
        MethodId::PublishSubscribe_PubSubConfiguration_Open,
        MethodId::FileType_Open,
        "Open",
        Some(FileMethod::Open),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_Close,
        MethodId::FileType_Close,
        "Close",
        Some(FileMethod::Close),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_Read,
        MethodId::FileType_Read,
        "Read",
        Some(FileMethod::Read),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_Write,
        MethodId::FileType_Write,
        "Write",
        Some(FileMethod::Write),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_GetPosition,
        MethodId::FileType_GetPosition,
        "GetPosition",
        Some(FileMethod::GetPosition),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_SetPosition,
        MethodId::FileType_SetPosition,
        "SetPosition",
        Some(FileMethod::SetPosition),
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_ReserveIds,
        MethodId::PubSubConfigurationType_ReserveIds,
        "ReserveIds",
        None,
    ),
    (
        MethodId::PublishSubscribe_PubSubConfiguration_CloseAndUpdate,
        MethodId::PubSubConfigurationType_CloseAndUpdate,
        "CloseAndUpdate",
        None,
    ),
];
/// The methods that are not executable.
pub(super) const OF_WRITERS: [MethodId; 3] = [
    MethodId::PublishSubscribe_PubSubConfiguration_Write,
    MethodId::PublishSubscribe_PubSubConfiguration_ReserveIds,
    MethodId::PublishSubscribe_PubSubConfiguration_CloseAndUpdate,
];
