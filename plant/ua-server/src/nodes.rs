//! The node manager of the space: the mapped topics as nodes, what clients may write, and who watches.
//!
//! The address space's lock is taken before the subscriptions' lock and never across an await. Nothing here calls out
//! while it is held but the subscriptions: a write leaves through a bounded channel.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use mappings::{SpaceId, TopicId};
use opcua::nodes::{NodeType, ObjectBuilder, VariableBuilder};
use opcua::server::address_space::{AccessLevel, AddressSpace};
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{InMemoryNodeManager, InMemoryNodeManagerImpl};
use opcua::server::node_manager::{
    MonitoredItemRef, ParsedWriteValue, RequestContext, ServerContext, WriteNode,
};
use opcua::server::{CreateMonitoredItem, MonitoredItemHandle, SubscriptionCache};
use opcua::sync::{Mutex, RwLock};
use opcua::types::{
    AttributeId, DataEncoding, DataValue, DateTime, LocalizedText, NodeId, NumericRange, ObjectId,
    QualifiedName, StatusCode, TimestampsToReturn, VariableTypeId, Variant,
};
use tokio::sync::mpsc;
use uadp::Timestamp;

use crate::layout::{FieldNode, Layout, Shape, TopicNode};
use crate::properties;
use crate::value;

/// The node manager as the server has it.
pub(crate) type SpaceManager = InMemoryNodeManager<SpaceNodes>;

/// Serves the nodes of the space.
pub(crate) struct SpaceNodes {
    namespaces: Vec<NamespaceMetadata>,
    /// Whose value a node has, and the place of the field, if it is a component.
    places: RwLock<Places>,
    exits: Exits,
    unfiltered: Mutex<HashSet<MonitoredItemHandle>>,
}

type Places = HashMap<NodeId, (Arc<TopicNode>, Option<usize>)>;

/// What leaves the node manager.
#[derive(Clone)]
pub(crate) struct Exits {
    /// Values clients wrote. A client is told when there is no room.
    pub(crate) writes: mpsc::Sender<ClientWrite>,
    /// Monitored items as they are made, to be looked at once more. Without room a look is missed.
    pub(crate) created: mpsc::Sender<(NodeId, MonitoredItemHandle)>,
}

/// A value a client wrote to a topic of the OPC UA side.
#[derive(Debug)]
pub(crate) struct ClientWrite {
    pub(crate) topic: TopicId,
    /// The fields of the DataSet as a key frame carries them.
    pub(crate) block: Bytes,
    pub(crate) source: Timestamp,
}

impl SpaceNodes {
    /// Registers the namespaces and puts the nodes of `layout` into `address_space`.
    pub(crate) fn build(
        layout: &Layout,
        exits: Exits,
        context: &ServerContext,
        address_space: &mut AddressSpace,
    ) -> Self {
        let mut namespaces = Vec::new();
        {
            let mut type_tree = context.type_tree.write();
            for uri in layout.namespaces.iter().skip(1) {
                let index = type_tree.namespaces_mut().add_namespace(uri);
                address_space.add_namespace(uri, index);
                namespaces.push(NamespaceMetadata {
                    namespace_uri: uri.clone(),
                    namespace_index: index,
                    ..NamespaceMetadata::default()
                });
            }
        }
        add_folders(layout, address_space);
        let mut places = Places::new();
        for topic in &layout.topics {
            add_topic(address_space, topic, &origin_folder(topic.topic.space));
            put(&mut places, topic);
        }
        Self {
            namespaces,
            places: RwLock::new(places),
            exits,
            unfiltered: Mutex::new(HashSet::new()),
        }
    }

    /// Takes the nodes of some topics out and puts those of others in. Who watches a node that is gone is told.
    pub(crate) fn exchange(
        &self,
        address_space: &RwLock<AddressSpace>,
        subscriptions: &SubscriptionCache,
        (gone, new): (&[TopicNode], &[TopicNode]),
    ) {
        let mut address_space = address_space.write();
        let mut places = self.places.write();
        for node in gone.iter().flat_map(TopicNode::nodes) {
            drop(address_space.delete(node, true));
            places.remove(node);
        }
        // Nodes of their own: what stays behind would keep the new ones out. One that is the node of a variable is that.
        for node in gone.iter().flat_map(properties::nodes) {
            if !places.contains_key(&node) {
                drop(address_space.delete(&node, true));
            }
        }
        for topic in new {
            let folder = origin_folder(topic.topic.space);
            if !address_space.node_exists(&folder) {
                add_folder(
                    &folder,
                    &origin_name(topic.topic.space),
                    root(),
                    &mut address_space,
                );
            }
            add_topic(&mut address_space, topic, &folder);
            put(&mut places, topic);
        }
        drop(places);
        for node in gone.iter().flat_map(TopicNode::nodes) {
            let value = current_data_value(&address_space, node).unwrap_or_else(|| DataValue {
                status: Some(StatusCode::BadNodeIdUnknown),
                server_timestamp: Some(DateTime::now()),
                ..DataValue::default()
            });
            self.notify(subscriptions, node, value, false);
        }
    }

    /// The namespaces of these nodes with the indexes the server gave them.
    pub(crate) fn served_namespaces(&self) -> impl Iterator<Item = (u16, &str)> {
        self.namespaces
            .iter()
            .map(|ns| (ns.namespace_index, ns.namespace_uri.as_str()))
    }

    /// Stores `values` and tells who watches them.
    pub(crate) fn store(
        &self,
        address_space: &RwLock<AddressSpace>,
        subscriptions: &SubscriptionCache,
        values: Vec<Stored>,
    ) {
        let mut address_space = address_space.write();
        for Stored {
            node,
            value,
            flipped,
        } in values
        {
            let flipped = flipped
                && value.value == current_data_value(&address_space, &node).and_then(|v| v.value);
            if let Some(NodeType::Variable(variable)) = address_space.find_mut(&node) {
                variable.set_data_value(value.clone());
                self.notify(subscriptions, &node, value, flipped);
            }
        }
    }

    /// The server compares values alone for an item without filter, though a status that changed is to be reported
    /// too (OPC 10000-4, 7.22.2: the default trigger is StatusValue). A null value in between makes it report both;
    /// clients with a queue of one see only the second.
    fn notify(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        value: DataValue,
        flipped: bool,
    ) {
        let mut notifier = subscriptions.data_notifier();
        let Some(mut items) = notifier.notify_for(node, AttributeId::Value) else {
            return;
        };
        if flipped {
            let unfiltered = self.unfiltered.lock();
            for (handle, _) in items.entries() {
                if unfiltered.contains(handle) {
                    let between = DataValue {
                        value: Some(Variant::Empty),
                        ..value
                    };
                    items.data_value_to_item(between, handle);
                }
            }
        }
        items.data_value(value);
    }

    fn write_one(
        &self,
        address_space: &mut AddressSpace,
        subscriptions: &SubscriptionCache,
        write: &ParsedWriteValue,
    ) -> Result<(), StatusCode> {
        if write.attribute_id != AttributeId::Value {
            let exists = address_space.node_exists(&write.node_id);
            return Err(if exists {
                StatusCode::BadNotWritable
            } else {
                StatusCode::BadNodeIdUnknown
            });
        }
        let Some((topic, field)) = self.place(&write.node_id) else {
            let exists = address_space.node_exists(&write.node_id);
            return Err(if exists {
                StatusCode::BadNotWritable
            } else {
                StatusCode::BadNodeIdUnknown
            });
        };
        if !topic.writable() {
            return Err(StatusCode::BadNotWritable);
        }
        if write
            .value
            .status
            .is_some_and(|status| status != StatusCode::Good)
        {
            return Err(StatusCode::BadWriteNotSupported);
        }
        let value = write
            .value
            .value
            .as_ref()
            .ok_or(StatusCode::BadTypeMismatch)?;
        let field = field.and_then(|field| topic.fields.get(field));
        let fields = new_fields(address_space, &topic, field, (value, &write.index_range))?;
        let now = DateTime::now();
        let (time, picoseconds) = match write.value.source_timestamp {
            Some(time) => (
                time,
                write
                    .value
                    .source_picoseconds
                    .unwrap_or_default()
                    .min(9_999),
            ),
            None => (now, 0),
        };
        let block = Bytes::from(value::fields_block(&fields)?);
        let source = Timestamp {
            time: value::ticks(time),
            picoseconds,
        };
        self.exits
            .writes
            .try_send(ClientWrite {
                topic: topic.topic,
                block,
                source,
            })
            .map_err(|_| StatusCode::BadResourceUnavailable)?;
        let stamp = Stamp {
            status: StatusCode::Good,
            source: Some(source),
            server: now,
        };
        for (node, value) in topic_values(&topic, fields, stamp) {
            if let Some(NodeType::Variable(variable)) = address_space.find_mut(&node) {
                variable.set_data_value(value.clone());
                self.notify(subscriptions, &node, value, false);
            }
        }
        Ok(())
    }

    fn place(&self, node: &NodeId) -> Option<(Arc<TopicNode>, Option<usize>)> {
        self.places.read().get(node).cloned()
    }
}

/// Notes where the values of a topic's nodes are.
fn put(places: &mut Places, topic: &TopicNode) {
    let topic = Arc::new(topic.clone());
    places.insert(topic.node.clone(), (Arc::clone(&topic), None));
    if topic.compound {
        let fields = topic.fields.iter().enumerate();
        let fields = fields.map(|(at, field)| (field.node.clone(), (Arc::clone(&topic), Some(at))));
        places.extend(fields);
    }
}

/// Whether a monitored item has no filter. The server keeps the filter's type to itself; it can be printed.
fn unfiltered(item: &CreateMonitoredItem) -> bool {
    format!("{:?}", item.filter()) == "None"
}

/// A value on its way into the address space.
pub(crate) struct Stored {
    pub(crate) node: NodeId,
    pub(crate) value: DataValue,
    /// Its status is another than that of the value before.
    pub(crate) flipped: bool,
}

/// What all values of one sample have in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stamp {
    pub(crate) status: StatusCode,
    pub(crate) source: Option<Timestamp>,
    pub(crate) server: DateTime,
}

/// The values of a topic's nodes, its own first, from the values of its fields.
///
/// A field that is a StatusCode where another type is due has no value but that status (OPC 10000-14, 7.2.4.5.5).
pub(crate) fn topic_values(
    topic: &TopicNode,
    fields: Vec<Variant>,
    stamp: Stamp,
) -> Vec<(NodeId, DataValue)> {
    let mut values = Vec::with_capacity(1 + fields.len());
    if topic.compound {
        let whole = fields
            .iter()
            .map(|field| Variant::Variant(Box::new(field.clone())))
            .collect();
        let array = opcua::types::Array {
            value_type: opcua::types::VariantScalarTypeId::Variant,
            values: whole,
            dimensions: None,
        };
        values.push((
            topic.node.clone(),
            data_value(Variant::Array(Box::new(array)), stamp),
        ));
    }
    for (field, value) in topic.fields.iter().zip(fields) {
        let value = if let Variant::StatusCode(status) = value
            && !field.shape.accepts(&value)
        {
            data_value(Variant::Empty, Stamp { status, ..stamp })
        } else {
            data_value(value, stamp)
        };
        values.push((field.node.clone(), value));
    }
    values
}

fn data_value(value: Variant, stamp: Stamp) -> DataValue {
    DataValue {
        value: Some(value),
        status: Some(stamp.status),
        source_timestamp: stamp.source.map(|source| value::date_time(source.time)),
        // asyncua takes the picoseconds for the first bytes of the server timestamp (its order of the fields is not
        // that of OPC 10000-6, 5.2.2.17), so there are none: 100 ns are left, and clients read right times.
        source_picoseconds: None,
        server_timestamp: Some(stamp.server),
        server_picoseconds: None,
    }
}

/// All fields of a topic after a write to it or to one of its fields.
fn new_fields(
    address_space: &AddressSpace,
    topic: &TopicNode,
    field: Option<&FieldNode>,
    (value, range): (&Variant, &NumericRange),
) -> Result<Vec<Variant>, StatusCode> {
    let target = field.map_or(&topic.node, |field| &field.node);
    let value = if range.has_range() {
        let mut whole = current(address_space, target).ok_or(StatusCode::BadIndexRangeNoData)?;
        whole.set_range_of(range, value)?;
        whole
    } else {
        value.clone()
    };
    let fields: Vec<Variant> = match (field, topic.compound) {
        (None, true) => members(value)?,
        (None, false) => vec![value],
        (Some(written), _) => topic
            .fields
            .iter()
            .map(|other| match current(address_space, &other.node) {
                _ if other.node == written.node => value.clone(),
                Some(known) => known,
                None => value::zero(other.shape.0),
            })
            .collect(),
    };
    let fit = fields.len() == topic.fields.len()
        && topic
            .fields
            .iter()
            .zip(&fields)
            .all(|(field, value)| field.shape.accepts(value));
    if fit {
        Ok(fields)
    } else {
        Err(StatusCode::BadTypeMismatch)
    }
}

/// The elements of a Variant array.
fn members(value: Variant) -> Result<Vec<Variant>, StatusCode> {
    let Variant::Array(array) = value else {
        return Err(StatusCode::BadTypeMismatch);
    };
    Ok(array
        .values
        .into_iter()
        .map(|value| {
            if let Variant::Variant(inner) = value {
                *inner
            } else {
                value
            }
        })
        .collect())
}

/// The value a node has, if it has one.
pub(crate) fn current(address_space: &AddressSpace, node: &NodeId) -> Option<Variant> {
    let value = current_data_value(address_space, node)?.value?;
    (!matches!(value, Variant::Empty)).then_some(value)
}

fn current_data_value(address_space: &AddressSpace, node: &NodeId) -> Option<DataValue> {
    let NodeType::Variable(variable) = address_space.find(node)? else {
        return None;
    };
    Some(variable.value(
        TimestampsToReturn::Both,
        &NumericRange::None,
        &DataEncoding::Binary,
        0.0,
    ))
}

#[async_trait]
impl InMemoryNodeManagerImpl for SpaceNodes {
    async fn init(&self, _address_space: &mut AddressSpace, _context: ServerContext) {}

    fn name(&self) -> &'static str {
        NAME
    }

    fn namespaces(&self) -> Vec<NamespaceMetadata> {
        self.namespaces.clone()
    }

    async fn create_value_monitored_items(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        items: &mut [&mut &mut CreateMonitoredItem],
    ) {
        let address_space = address_space.read();
        for item in items {
            let value = address_space.read(
                context,
                item.item_to_monitor(),
                0.0,
                TimestampsToReturn::Both,
            );
            if value.status() != StatusCode::BadAttributeIdInvalid {
                item.set_initial_value(value);
            }
            item.set_status(StatusCode::Good);
            // Every change is reported as it comes, with its own time: the server would put off a value that comes
            // within the sampling interval, and give it another source timestamp.
            if item.sampling_interval() > 0.0 {
                item.revise_sampling_interval(AS_IT_COMES_MS);
            }
            if unfiltered(item) {
                let mut unfiltered = self.unfiltered.lock();
                if unfiltered.len() < MOST_UNFILTERED {
                    unfiltered.insert(item.handle());
                }
            }
            // A value that comes between this look and the item's being there is only seen by a second look.
            let _missed = self
                .exits
                .created
                .try_send((item.item_to_monitor().node_id.clone(), item.handle()));
        }
    }

    async fn delete_monitored_items(&self, _context: &RequestContext, items: &[&MonitoredItemRef]) {
        let mut unfiltered = self.unfiltered.lock();
        for item in items {
            unfiltered.remove(&item.handle());
        }
    }

    async fn write(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        nodes_to_write: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        let mut address_space = address_space.write();
        for write in nodes_to_write {
            let result = self.write_one(&mut address_space, &context.subscriptions, write.value());
            write.set_status(result.err().unwrap_or(StatusCode::Good));
        }
        Ok(())
    }
}

/// Looks once more at monitored items some time after they were made, for values that came while they were.
pub(crate) async fn look_again(
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    mut created: mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
) {
    let mut items = Vec::new();
    while created.recv_many(&mut items, 1_000).await > 0 {
        tokio::time::sleep(SECOND_LOOK).await;
        let address_space = manager.address_space().read();
        let mut notifier = subscriptions.data_notifier();
        for (node, handle) in items.drain(..) {
            let Some(value) = current_data_value(&address_space, &node) else {
                continue;
            };
            if let Some(mut batch) = notifier.notify_for(&node, AttributeId::Value) {
                batch.data_value_to_item(value, &handle);
            }
        }
    }
}

/// Adds a variable for each of a topic's nodes under `folder`, without a value.
pub(crate) fn add_topic(address_space: &mut AddressSpace, topic: &TopicNode, folder: &NodeId) {
    let writable = topic.writable();
    let name = |node: &NodeId, text: &str| QualifiedName::new(node.namespace, text);
    let (type_, rank) = if topic.compound {
        (Shape(None).data_type(), 1)
    } else {
        let shape = topic
            .fields
            .first()
            .map_or(Shape(None), |field| field.shape);
        (shape.data_type(), shape.value_rank())
    };
    VariableBuilder::new(
        &topic.node,
        name(&topic.node, &topic.name),
        LocalizedText::from(topic.name.as_str()),
    )
    .description(LocalizedText::from(topic.topic.to_string()))
    .data_type(type_)
    .value_rank(rank)
    .access_level(access(writable))
    .user_access_level(access(writable))
    .has_type_definition(VariableTypeId::BaseDataVariableType)
    .organized_by(folder.clone())
    .insert(address_space);
    wait_for_data(address_space, &topic.node);
    if !topic.compound {
        properties::add(address_space, topic);
        return;
    }
    for field in &topic.fields {
        VariableBuilder::new(
            &field.node,
            name(&field.node, &field.name),
            LocalizedText::from(field.name.as_str()),
        )
        .data_type(field.shape.data_type())
        .value_rank(field.shape.value_rank())
        .access_level(access(writable))
        .user_access_level(access(writable))
        .has_type_definition(VariableTypeId::BaseDataVariableType)
        .component_of(topic.node.clone())
        .insert(address_space);
        wait_for_data(address_space, &field.node);
    }
}

/// Changes what a variable is said to hold.
pub(crate) fn retype(address_space: &mut AddressSpace, node: &NodeId, shape: Shape) {
    if let Some(NodeType::Variable(variable)) = address_space.find_mut(node) {
        variable.set_data_type(shape.data_type());
        variable.set_value_rank(shape.value_rank());
    }
}

fn wait_for_data(address_space: &mut AddressSpace, node: &NodeId) {
    if let Some(NodeType::Variable(variable)) = address_space.find_mut(node) {
        // A null value, not none: the server forgets the status of a variable that has no value at all.
        variable.set_data_value(DataValue {
            value: Some(Variant::Empty),
            status: Some(StatusCode::BadWaitingForInitialData),
            server_timestamp: Some(DateTime::now()),
            ..DataValue::default()
        });
    }
}

fn access(writable: bool) -> AccessLevel {
    if writable {
        AccessLevel::CURRENT_READ | AccessLevel::CURRENT_WRITE
    } else {
        AccessLevel::CURRENT_READ
    }
}

fn add_folders(layout: &Layout, address_space: &mut AddressSpace) {
    let objects = ObjectId::ObjectsFolder.into();
    add_folder(&root(), "UaSpace", objects, address_space);
    add_folder(&unmapped_folder(), "Unmapped", root(), address_space);
    let spaces: HashSet<SpaceId> = layout
        .topics
        .iter()
        .map(|topic| topic.topic.space)
        .collect();
    for space in spaces {
        add_folder(
            &origin_folder(space),
            &origin_name(space),
            root(),
            address_space,
        );
    }
}

fn add_folder(node: &NodeId, name: &str, parent: NodeId, address_space: &mut AddressSpace) {
    ObjectBuilder::new(
        node,
        QualifiedName::new(node.namespace, name),
        LocalizedText::from(name),
    )
    .is_folder()
    .organized_by(parent)
    .insert(address_space);
}

fn root() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace")
}

fn origin_name(space: SpaceId) -> String {
    match space {
        SpaceId::UA => "OPC UA".to_owned(),
        SpaceId::ROS1 => "ROS 1".to_owned(),
        other => format!("ROS 2 space {other}"),
    }
}

fn origin_folder(space: SpaceId) -> NodeId {
    NodeId::new(APPLICATION, format!("UaSpace.{space}"))
}

pub(crate) fn unmapped_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Unmapped")
}

/// The node of a topic that the mapping does not name.
pub(crate) fn unmapped_node(topic: TopicId) -> NodeId {
    NodeId::new(APPLICATION, topic.to_string())
}

/// The node manager's name in the server's log.
const NAME: &str = "space";
/// The namespace index of the application's own URI.
const APPLICATION: u16 = 1;
/// Counts as no interval at all, yet is above the 0 that the server takes for "not asked for".
const AS_IT_COMES_MS: f64 = 0.000_1;
/// How many items without filter are kept in mind; further ones are not told of a status alone.
const MOST_UNFILTERED: usize = 100_000;
const SECOND_LOOK: Duration = Duration::from_millis(100);
