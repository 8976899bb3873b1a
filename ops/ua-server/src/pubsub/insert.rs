//! A mapping as PubSub components and their nodes.

use std::collections::BTreeMap;
use std::time::Duration;

use mappings::{GroupMode, KeySource, Mapping, MessageMapping, SecurityGroup, SpaceId};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    AttributeId, ConfigurationVersionDataType, DataSetMetaDataType, DataTypeId,
    EndpointDescription, ExtensionObject, FieldMetaData, FieldTargetDataType, Guid, Identifier,
    LocalizedText, MessageSecurityMode, NodeId, ObjectId, ObjectTypeId, PublishedVariableDataType,
    ReferenceTypeId, UAString, VariableId, Variant,
};
use tracing::warn;

use super::counts::{Counter, Counts, LiveCounts, PubSubCounters};
use super::states::PubSubNodeState;
use super::tree::{At, Tree};
use super::{Ask, Inner, Kind, Part};
use crate::layout::{Layout, TopicNode};

/// The nodes to add.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NodesToAdd {
    /// All nodes except the nodes of readers.
    WithoutReaders,
    /// The nodes of readers only.
    Readers,
    /// All nodes.
    All,
}

/// Adds the components of a mapping and the wanted nodes.
pub(super) fn all(
    mapping: &Mapping,
    layout: &Layout,
    address_space: &mut AddressSpace,
    wanted: NodesToAdd,
) -> Inner {
    let has_others = wanted != NodesToAdd::Readers;
    let mut insert = Insert {
        mapping,
        inner: Inner::default(),
        tree: Tree {
            address_space,
            made: Vec::new(),
            is_dry: !has_others,
        },
    };
    let whole = insert.whole();
    insert.file();
    let (connection, object) = insert.connection(whole);
    let mut groups: BTreeMap<(SpaceId, u16), (usize, At)> = BTreeMap::new();
    if layout.topics.len() > MOST_SHOWN {
        warn!(
            topics = layout.topics.len(),
            "the PubSub configuration shows only the first {MOST_SHOWN} topics"
        );
    }
    for (at, topic) in layout.topics.iter().take(MOST_SHOWN).enumerate() {
        let (space, namespace) = (topic.topic.space, topic.topic.namespace.get());
        let (group, above) = groups
            .entry((space, namespace))
            .or_insert_with(|| insert.group((space, namespace), (connection, &object)))
            .clone();
        let detailed = at < MOST_DETAILED;
        if space == SpaceId::UA {
            insert.writer(topic, (group, &above), detailed);
        } else {
            insert.tree.is_dry = wanted == NodesToAdd::WithoutReaders;
            insert.reader(topic, (group, &above), detailed);
            insert.tree.is_dry = !has_others;
        }
    }
    let Insert { inner, tree, .. } = insert;
    Inner {
        made: tree.made,
        ..inner
    }
}

struct Insert<'a> {
    mapping: &'a Mapping,
    inner: Inner,
    tree: Tree<'a>,
}

impl Insert<'_> {
    /// Adds the object PublishSubscribe; its node exists already.
    fn whole(&mut self) -> usize {
        let at = self.inner.states.add(None, PubSubNodeState::Operational);
        self.inner.parts.push(Part {
            kind: Kind::Whole,
            parent: None,
            state: VariableId::PublishSubscribe_Status_State.into(),
            diagnostics: Some(PubSubCounters::of_the_whole()),
            live: Some(LiveCounts::of_the_whole()),
            counts: Counts::default(),
        });
        at
    }

    /// Adds the MimeType of the configuration file. The file object exists already.
    fn file(&mut self) {
        let file = At::core(FILE, "PubSub.Configuration");
        let mime = (DataTypeId::String, -1);
        self.tree.property("MimeType", mime, UA_BINARY, &file);
    }

    /// Adds a component with its Status, and with counters if it has any. Also returns the object
    /// of the live values.
    fn part(
        &mut self,
        kind: Kind,
        (parent, own): (usize, PubSubNodeState),
        object: &At,
        counters: Option<(ObjectTypeId, &[Counter])>,
    ) -> (usize, Option<At>) {
        let at = self.inner.states.add(Some(parent), own);
        let status = self
            .tree
            .part("Status", ObjectTypeId::PubSubStatusType, object);
        let state = (DataTypeId::PubSubState, -1);
        let state = self.tree.value("State", state, own as i32, &status);
        let mut methods = vec![
            (self.tree.method("Enable", &status), Ask::Enable),
            (self.tree.method("Disable", &status), Ask::Disable),
        ];
        let mut live = None;
        let diagnostics = counters.map(|(kind, counters)| {
            let (made, reset, values) =
                PubSubCounters::insert(&mut self.tree, object, kind, counters);
            methods.push((reset, Ask::Reset));
            live = Some(values);
            made
        });
        let asked = methods.into_iter().map(|(node, ask)| (node, (at, ask)));
        self.inner.methods.extend(asked);
        self.inner.parts.push(Part {
            kind,
            parent: Some(parent),
            state,
            diagnostics,
            live: None,
            counts: Counts::default(),
        });
        (at, live)
    }

    /// Adds the connection. Its address is the group that all programs send to.
    fn connection(&mut self, whole: usize) -> (usize, At) {
        let pubsub = self.mapping.pubsub();
        let root = At::core(ObjectId::PublishSubscribe, "PubSub");
        let how = (&root, ReferenceTypeId::HasPubSubConnection);
        let object = self
            .tree
            .object(CONNECTION, ObjectTypeId::PubSubConnectionType, how);
        let tree = &mut self.tree;
        let publisher = Variant::UInt16(u16::from(SpaceId::UA.get()));
        tree.property(
            "PublisherId",
            (DataTypeId::BaseDataType, -1),
            publisher,
            &object,
        );
        let profile = profile(self.mapping);
        tree.selection("TransportProfileUri", profile, &object);
        properties(tree, "ConnectionProperties", &object);
        let address = tree.part("Address", ObjectTypeId::NetworkAddressUrlType, &object);
        let interface = pubsub.interface.as_deref().unwrap_or_default();
        tree.selection("NetworkInterface", interface, &address);
        let group = url(self.mapping);
        tree.value("Url", (DataTypeId::String, -1), group.clone(), &address);
        let counters = (ObjectTypeId::PubSubDiagnosticsConnectionType, &[][..]);
        let (at, live) = self.part(
            Kind::Connection,
            (whole, PubSubNodeState::Operational),
            &object,
            Some(counters),
        );
        if let Some(live) = live {
            let text = (DataTypeId::String, -1);
            self.tree.live_value("ResolvedAddress", text, group, &live);
        }
        (at, object)
    }

    /// Adds the group of the writers or readers of a namespace.
    fn group(
        &mut self,
        (space, namespace): (SpaceId, u16),
        (above, connection): (usize, &At),
    ) -> (usize, At) {
        let writes = space == SpaceId::UA;
        let (kind, reference, counted, type_, name) = if writes {
            (
                Kind::Writers(namespace),
                ReferenceTypeId::HasWriterGroup,
                &Counter::OF_WRITERS[..],
                (
                    ObjectTypeId::WriterGroupType,
                    ObjectTypeId::PubSubDiagnosticsWriterGroupType,
                ),
                writers_name(namespace),
            )
        } else {
            (
                Kind::Readers(space, namespace),
                ReferenceTypeId::HasReaderGroup,
                &Counter::OF_READERS[..],
                (
                    ObjectTypeId::ReaderGroupType,
                    ObjectTypeId::PubSubDiagnosticsReaderGroupType,
                ),
                readers_name(space, namespace),
            )
        };
        let object = self.tree.object(&name, type_.0, (connection, reference));
        let pubsub = self.mapping.pubsub();
        let tree = &mut self.tree;
        security(tree, self.mapping.group_of(namespace), &object);
        tree.property(
            "MaxNetworkMessageSize",
            UINT32,
            u32::from(pubsub.max_datagram),
            &object,
        );
        properties(tree, "GroupProperties", &object);
        if writes {
            self.writer_group(namespace, &object);
        }
        let (at, live) = self.part(
            kind,
            (above, PubSubNodeState::Operational),
            &object,
            Some((type_.1, counted)),
        );
        let counts = live.map(|live| LiveCounts::insert(&mut self.tree, &live, writes));
        if let Some(part) = self.inner.parts.get_mut(at) {
            part.live = counts;
        }
        (at, object)
    }

    /// Adds the nodes that only a WriterGroup has.
    fn writer_group(&mut self, namespace: u16, object: &At) {
        let pubsub = self.mapping.pubsub();
        let tree = &mut self.tree;
        tree.property("WriterGroupId", UINT16, namespace, object);
        let period = milliseconds(pubsub.key_frame_period);
        tree.property("PublishingInterval", DURATION, period, object);
        let alive = milliseconds(pubsub.keep_alive_period);
        tree.property("KeepAliveTime", DURATION, alive, object);
        tree.property("Priority", (DataTypeId::Byte, -1), 0_u8, object);
        let none: Vec<UAString> = Vec::new();
        tree.property("LocaleIds", (DataTypeId::LocaleId, 1), none, object);
        tree.property("HeaderLayoutUri", (DataTypeId::String, -1), "", object);
        let settings = ObjectTypeId::UadpWriterGroupMessageType;
        let settings = tree.part("MessageSettings", settings, object);
        let version = (DataTypeId::VersionTime, -1);
        tree.property("GroupVersion", version, 0_u32, &settings);
        let ordering = (DataTypeId::DataSetOrderingType, -1);
        tree.property("DataSetOrdering", ordering, 0_i32, &settings);
        let mask = (DataTypeId::UadpNetworkMessageContentMask, -1);
        tree.property(
            "NetworkMessageContentMask",
            mask,
            NETWORK_MESSAGE,
            &settings,
        );
        let offsets = (DataTypeId::Duration, 1);
        tree.property("PublishingOffset", offsets, Vec::<f64>::new(), &settings);
    }

    /// Adds the writer of a value that this program sends, and its PublishedDataSet.
    fn writer(&mut self, topic: &TopicNode, (above, group): (usize, &At), detailed: bool) {
        let name = topic.topic.to_string();
        let how = (group, ReferenceTypeId::HasDataSetWriter);
        let object = self
            .tree
            .object(&name, ObjectTypeId::DataSetWriterType, how);
        let (_, _, identifier) = topic.topic.triple();
        let tree = &mut self.tree;
        tree.property("DataSetWriterId", UINT16, identifier, &object);
        tree.property("DataSetFieldContentMask", FIELDS, 0_u32, &object);
        tree.property("KeyFrameCount", UINT32, 1_u32, &object);
        properties(tree, "DataSetWriterProperties", &object);
        let settings = ObjectTypeId::UadpDataSetWriterMessageType;
        let settings = tree.part("MessageSettings", settings, &object);
        let mask = (DataTypeId::UadpDataSetMessageContentMask, -1);
        tree.property(
            "DataSetMessageContentMask",
            mask,
            DATA_SET_MESSAGE,
            &settings,
        );
        for zero in ["ConfiguredSize", "NetworkMessageNumber", "DataSetOffset"] {
            tree.property(zero, UINT16, 0_u16, &settings);
        }
        let sets = At::core(
            ObjectId::PublishSubscribe_PublishedDataSets,
            "PubSub.DataSets",
        );
        let set = tree.part(&name, ObjectTypeId::PublishedDataItemsType, &sets);
        let version = ConfigurationVersionDataType::default();
        let kind = (DataTypeId::ConfigurationVersionDataType, -1);
        tree.property("ConfigurationVersion", kind, object_of(version), &set);
        show_meta_data(tree, topic, &set);
        let published: Vec<ExtensionObject> = published(topic)
            .map(ExtensionObject::from_message)
            .collect();
        let kind = (DataTypeId::PublishedVariableDataType, 1);
        tree.property("PublishedData", kind, published, &set);
        tree.refer(&set.node, &object.node, ReferenceTypeId::DataSetToWriter);
        let counters = (
            ObjectTypeId::PubSubDiagnosticsDataSetWriterType,
            &[Counter::FailedMessages][..],
        );
        self.part(
            Kind::Writer(topic.topic),
            (above, PubSubNodeState::Operational),
            &object,
            detailed.then_some(counters),
        );
    }

    /// Adds the reader of a value that this program receives.
    fn reader(&mut self, topic: &TopicNode, (above, group): (usize, &At), detailed: bool) {
        let name = topic.topic.to_string();
        let how = (group, ReferenceTypeId::HasDataSetReader);
        let object = self
            .tree
            .object(&name, ObjectTypeId::DataSetReaderType, how);
        let (space, namespace, identifier) = topic.topic.triple();
        let pubsub = self.mapping.pubsub();
        let tree = &mut self.tree;
        let publisher = Variant::UInt16(space);
        tree.property(
            "PublisherId",
            (DataTypeId::BaseDataType, -1),
            publisher,
            &object,
        );
        tree.property("WriterGroupId", UINT16, namespace, &object);
        tree.property("DataSetWriterId", UINT16, identifier, &object);
        show_meta_data(tree, topic, &object);
        tree.property("DataSetFieldContentMask", FIELDS, 0_u32, &object);
        let timeout = milliseconds(pubsub.receive_timeout);
        tree.property("MessageReceiveTimeout", DURATION, timeout, &object);
        tree.property("KeyFrameCount", UINT32, 1_u32, &object);
        tree.property("HeaderLayoutUri", (DataTypeId::String, -1), "", &object);
        properties(tree, "DataSetReaderProperties", &object);
        let written = tree.part(
            "SubscribedDataSet",
            ObjectTypeId::TargetVariablesType,
            &object,
        );
        let targets: Vec<ExtensionObject> =
            targets(topic).map(ExtensionObject::from_message).collect();
        let kind = (DataTypeId::FieldTargetDataType, 1);
        tree.property("TargetVariables", kind, targets, &written);
        let counters = (
            ObjectTypeId::PubSubDiagnosticsDataSetReaderType,
            &[Counter::FailedMessages][..],
        );
        self.part(
            Kind::Reader(topic.topic),
            (above, PubSubNodeState::PreOperational),
            &object,
            detailed.then_some(counters),
        );
    }
}

/// Returns true if a node is the connection, a group of readers, or a node below such a group.
pub(super) fn leads_to_readers(node: &NodeId) -> bool {
    match &node.identifier {
        Identifier::String(text) => {
            let rest = text.as_ref().strip_prefix(CONNECTION_ID);
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(READERS))
        }
        Identifier::Numeric(_) | Identifier::Guid(_) | Identifier::ByteString(_) => false,
    }
}

/// Returns the variables with the values that a writer sends.
pub(super) fn published(topic: &TopicNode) -> impl Iterator<Item = PublishedVariableDataType> {
    variables(topic).map(|node| PublishedVariableDataType {
        published_variable: node.clone(),
        attribute_id: AttributeId::Value as u32,
        ..PublishedVariableDataType::default()
    })
}

/// Returns the variables that show the values of a reader.
pub(super) fn targets(topic: &TopicNode) -> impl Iterator<Item = FieldTargetDataType> {
    variables(topic).map(|node| FieldTargetDataType {
        target_node_id: node.clone(),
        attribute_id: AttributeId::Value as u32,
        ..FieldTargetDataType::default()
    })
}

/// Returns the variable of each field of a DataSet.
fn variables(topic: &TopicNode) -> impl Iterator<Item = &NodeId> {
    let fields = topic
        .places()
        .filter(|(_, field)| field.is_some() || !topic.compound);
    fields.map(|(node, _)| node)
}

/// Returns the fields of a DataSet, as far as they are known before a publisher sends them.
pub(super) fn meta_data(topic: &TopicNode) -> DataSetMetaDataType {
    let fields = topic.fields.iter().map(|field| FieldMetaData {
        name: UAString::from(field.name.as_str()),
        built_in_type: field.shape.0.map_or(VARIANT, |(builtin, _)| builtin as u8),
        data_type: field.data_type(),
        value_rank: field.shape.value_rank(),
        data_set_field_id: Guid::null(),
        ..FieldMetaData::default()
    });
    DataSetMetaDataType {
        name: UAString::from(topic.name.as_str()),
        description: LocalizedText::from(topic.topic.to_string().as_str()),
        fields: Some(fields.collect()),
        ..DataSetMetaDataType::default()
    }
}

fn show_meta_data(tree: &mut Tree<'_>, topic: &TopicNode, above: &At) {
    let kind = (DataTypeId::DataSetMetaDataType, -1);
    tree.property("DataSetMetaData", kind, object_of(meta_data(topic)), above);
}

/// The security mode of a group, and its key services.
pub(super) struct Secured {
    pub(super) mode: MessageSecurityMode,
    /// Null for an unsecured group, like `services`.
    pub(super) group: UAString,
    pub(super) services: Option<Vec<EndpointDescription>>,
}

impl Secured {
    pub(super) fn of(group: Option<&SecurityGroup>) -> Self {
        let mode = match group.map(|group| group.mode) {
            None | Some(GroupMode::None) => MessageSecurityMode::None,
            Some(GroupMode::Sign) => MessageSecurityMode::Sign,
            Some(GroupMode::SignAndEncrypt) => MessageSecurityMode::SignAndEncrypt,
        };
        let Some(group) = group.filter(|group| group.mode != GroupMode::None) else {
            return Self {
                mode,
                group: UAString::null(),
                services: None,
            };
        };
        let endpoint = match &group.keys {
            Some(KeySource::Own(served)) => Some(served.endpoint.to_string()),
            Some(KeySource::Sks(endpoint)) => Some(endpoint.to_string()),
            Some(KeySource::File(_) | KeySource::Credential(_)) | None => None,
        };
        let services = endpoint.into_iter().map(|url| EndpointDescription {
            endpoint_url: UAString::from(url.as_str()),
            ..EndpointDescription::default()
        });
        Self {
            mode,
            group: group.id.as_str().into(),
            services: Some(services.collect()),
        }
    }
}

fn security(tree: &mut Tree<'_>, group: Option<&SecurityGroup>, above: &At) {
    let secured = Secured::of(group);
    let mode = (DataTypeId::MessageSecurityMode, -1);
    tree.property("SecurityMode", mode, secured.mode as i32, above);
    let Some(services) = secured.services else {
        return;
    };
    let id = (DataTypeId::String, -1);
    tree.property("SecurityGroupId", id, secured.group, above);
    let services = services.into_iter().map(ExtensionObject::from_message);
    let services: Vec<ExtensionObject> = services.collect();
    let kind = (DataTypeId::EndpointDescription, 1);
    tree.property("SecurityKeyServices", kind, services, above);
}

/// Adds an empty list of properties.
fn properties(tree: &mut Tree<'_>, name: &str, above: &At) {
    let none: Vec<ExtensionObject> = Vec::new();
    tree.property(name, (DataTypeId::KeyValuePair, 1), none, above);
}

fn object_of<T>(value: T) -> Variant
where
    T: opcua::types::DynEncodable,
{
    Variant::from(ExtensionObject::from_message(value))
}

/// Returns the TransportProfileUri (OPC 10000-7).
pub(super) fn profile(mapping: &Mapping) -> &'static str {
    match &mapping.pubsub().broker {
        None => UDP_UADP,
        Some(broker) if broker.encoding == MessageMapping::Uadp => MQTT_UADP,
        Some(_) => MQTT_JSON,
    }
}

/// Returns the URL of the group or broker.
pub(super) fn url(mapping: &Mapping) -> String {
    let pubsub = mapping.pubsub();
    match &pubsub.broker {
        Some(broker) => broker.address.to_string(),
        None => format!("opc.udp://{}", pubsub.address),
    }
}

/// The BrowseName of the writers of a namespace.
pub(super) fn writers_name(namespace: u16) -> String {
    format!("writers {namespace}")
}

/// The BrowseName of the readers of a namespace of a space.
pub(super) fn readers_name(space: SpaceId, namespace: u16) -> String {
    format!("readers {space} {namespace}")
}

/// Converts a time into a Duration of OPC UA.
pub(super) fn milliseconds(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// The identifier of the node of the connection. The identifiers of groups of readers continue with
/// `READERS`.
const CONNECTION_ID: &str = "PubSub.space";
const READERS: &str = ".readers ";
/// The BrowseName of the connection.
pub(super) const CONNECTION: &str = "space";
const MQTT_UADP: &str = "http://opcfoundation.org/UA-Profile/Transport/pubsub-mqtt-uadp";
const MQTT_JSON: &str = "http://opcfoundation.org/UA-Profile/Transport/pubsub-mqtt-json";
const UDP_UADP: &str = "http://opcfoundation.org/UA-Profile/Transport/pubsub-udp-uadp";
/// The profiles that a mapping selects from.
pub(super) const PROFILES: [&str; 3] = [UDP_UADP, MQTT_UADP, MQTT_JSON];
const UINT16: (DataTypeId, i32) = (DataTypeId::UInt16, -1);
const UINT32: (DataTypeId, i32) = (DataTypeId::UInt32, -1);
const DURATION: (DataTypeId, i32) = (DataTypeId::Duration, -1);
const FIELDS: (DataTypeId, i32) = (DataTypeId::DataSetFieldContentMask, -1);
/// PublisherId, GroupHeader, WriterGroupId, PayloadHeader (OPC 10000-14, 6.3.1.1.4).
pub(super) const NETWORK_MESSAGE: u32 = 0b0100_0111;
/// Timestamp, PicoSeconds, Status, MajorVersion, SequenceNumber (OPC 10000-14, 6.3.1.2.2).
pub(super) const DATA_SET_MESSAGE: u32 = 0b0010_1111;
/// The BuiltInType of a field of any type.
const VARIANT: u8 = 24;
/// The MIME type of a file in the binary encoding (OPC 10000-5, 12.36).
const UA_BINARY: &str = "application/opcua+uabinary";
/// The file object.
pub(super) const FILE: ObjectId = ObjectId::PublishSubscribe_PubSubConfiguration;
/// Largest number of writers and readers that are shown, and largest number with counters.
pub(super) const MOST_SHOWN: usize = 5_000;
const MOST_DETAILED: usize = 500;
