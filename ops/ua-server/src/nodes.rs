//! The node manager of the space: values of nodes, writes of clients, and monitored items.
//!
//! Locks are taken in this order and never across an await: the address space, the places, the
//! conditions, the values, the past values, the subscriptions, the watched items. While a lock is
//! held, only the subscriptions are called: a write leaves through a bounded channel.

mod called;
mod items;
mod live;
mod write;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use opcua::server::address_space::{AddressSpace, NodeType};
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{InMemoryNodeManager, InMemoryNodeManagerImpl};
use opcua::server::node_manager::{
    HistoryNode, MethodCall, MonitoredItemRef, MonitoredItemUpdateRef, ParsedReadValueId,
    ParsedWriteValue, RequestContext, ServerContext, WriteNode,
};
use opcua::server::{CreateMonitoredItem, MonitoredItemHandle, SubscriptionCache};
use opcua::sync::RwLock;
use opcua::types::{
    AttributeId, DataEncoding, DataValue, MonitoringMode, NodeId, NumericRange, ReadAtTimeDetails,
    ReadEventDetails, ReadProcessedDetails, ReadRawModifiedDetails, StatusCode, TimestampsToReturn,
    Variant,
};
use plant_opcua::nodeset::ImportedNodeSets;
use plant_opcua::server::{EventHistory as _, SessionCaller};
use plant_opcua::users::{Right, UserAccess};
use tokio::sync::{Semaphore, mpsc};

use self::called::{Callables, set_result};
use self::live::LiveValues;
use self::write::WritePath;
pub(crate) use self::write::{ClientWrite, WriteClient};
use crate::access::Genuine;
use crate::address;
use crate::alarms::Alarms;
use crate::asking::{CallFailure, Questions};
use crate::confirm::Confirms;
use crate::folders;
use crate::history::{ResponseBudget, Series};
use crate::identity;
use crate::layout::{Layout, TopicNode};
use crate::nodesets::Loaded;
use crate::properties;
use crate::pubsub::PubSubNodes;
use crate::redundant::ServerRole;
use crate::values::{self, ShownValue};

/// The node manager in the server.
pub(crate) type SpaceManager = InMemoryNodeManager<SpaceNodes>;

/// Serves the nodes of the space.
pub(crate) struct SpaceNodes {
    namespaces: Vec<NamespaceMetadata>,
    places: RwLock<Places>,
    /// Rank of each node among the children of its parent.
    order: RwLock<HashMap<NodeId, usize>>,
    live: Arc<LiveValues>,
    writes: WritePath,
    genuine: Genuine,
    created: mpsc::Sender<(NodeId, MonitoredItemHandle)>,
    access: Arc<UserAccess>,
    pubsub: Arc<PubSubNodes>,
    alarms: Arc<Alarms>,
    nodesets: Loaded,
    callables: Callables,
}

/// The topic of each node, and the index of the field if the node is a component.
type Places = HashMap<NodeId, (Arc<TopicNode>, Option<usize>)>;

/// Channels and shared state that the node manager uses.
#[derive(Clone)]
pub(crate) struct Exits {
    /// Values written by clients. If the channel is full, the client gets an error.
    pub(crate) writes: mpsc::Sender<ClientWrite>,
    /// Limits the total size of these values, in KiB.
    pub(crate) room: Arc<Semaphore>,
    /// Created monitored items, for a second check of their values. If the channel is full, the
    /// second check is skipped.
    pub(crate) created: mpsc::Sender<(NodeId, MonitoredItemHandle)>,
    /// Calls of clients. If the channel is full, the client gets an error.
    pub(crate) questions: Questions,
    /// Permissions of users.
    pub(crate) access: Arc<UserAccess>,
    /// The PubSub configuration; clients can disable parts of it.
    pub(crate) pubsub: Arc<PubSubNodes>,
    /// The confirmations of writes.
    pub(crate) confirms: Arc<Confirms>,
    /// Whether a redundant server sends the values that clients write.
    pub(crate) role: ServerRole,
    /// The conditions of values.
    pub(crate) alarms: Arc<Alarms>,
}

impl SpaceNodes {
    /// Registers the namespaces and adds the nodes of `layout` to `address_space`.
    pub(crate) fn build(
        (layout, sets): (&Layout, &ImportedNodeSets),
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
        let nodesets = {
            let mut type_tree = context.type_tree.write();
            Loaded::put_in(sets, address_space, type_tree.namespaces_mut())
        };
        let served = namespaces.iter();
        let served = served.filter(|one| !nodesets.tell_of(&one.namespace_uri));
        let served = served.map(|one| (one.namespace_index, one.namespace_uri.as_str()));
        identity::add_namespaces(served, address_space);
        address::add_folders(layout, address_space);
        for structure in &layout.structures {
            structure.insert(address_space);
        }
        let mut places = Places::new();
        for topic in &layout.topics {
            let folder = folders::stand(address_space, topic);
            if !nodesets.adopt(address_space, topic, &folder) {
                address::add_topic(address_space, topic, &folder);
            }
            put(&mut places, topic);
        }
        let (confirms, alarms) = (Arc::clone(&exits.confirms), Arc::clone(&exits.alarms));
        let live = Arc::new(LiveValues::new(confirms, alarms));
        Self {
            namespaces,
            places: RwLock::new(places),
            order: RwLock::new(folders::order(layout)),
            writes: WritePath::new(Arc::clone(&live), &exits),
            live,
            genuine: Genuine::default(),
            created: exits.created,
            access: exits.access,
            pubsub: exits.pubsub,
            alarms: exits.alarms,
            nodesets,
            callables: Callables::new(exits.questions),
        }
    }

    /// Returns the nodes of NodeSets.
    pub(crate) const fn nodesets(&self) -> &Loaded {
        &self.nodesets
    }

    /// Returns the values of the topics.
    pub(crate) fn live(&self) -> &LiveValues {
        &self.live
    }

    /// Returns the writes of clients.
    pub(crate) const fn writes(&self) -> &WritePath {
        &self.writes
    }

    /// Returns the PubSub configuration.
    pub(crate) fn pubsub(&self) -> &PubSubNodes {
        &self.pubsub
    }

    /// Returns the Methods and Programs that clients can call.
    pub(crate) const fn callables(&self) -> &Callables {
        &self.callables
    }

    /// Removes the nodes of the topics in `gone` and adds the nodes of the topics in `new`. Clients
    /// that monitor a removed node are notified.
    pub(crate) fn exchange(
        &self,
        address_space: &RwLock<AddressSpace>,
        subscriptions: &SubscriptionCache,
        (gone, new): (&[TopicNode], &[TopicNode]),
    ) {
        let mut address_space = address_space.write();
        let mut places = self.places.write();
        // The lock is held until all items are notified, so that notifications keep their order.
        let _values = self.live.exchange(gone, new);
        let mut left = HashMap::new();
        for node in gone.iter().flat_map(TopicNode::nodes) {
            match self.nodesets.release(&mut address_space, node) {
                Some(shown) => drop(left.insert(node, shown)),
                None if self.nodesets.has(node) => {}
                None => drop(address_space.delete(node, true)),
            }
            places.remove(node);
        }
        // Property nodes that stay would conflict with the new nodes. A property node that is also
        // the node of a variable is kept.
        for node in gone.iter().flat_map(properties::nodes) {
            if !places.contains_key(&node) && !self.nodesets.has(&node) {
                drop(address_space.delete(&node, true));
            }
        }
        for topic in new {
            let folder = folders::stand(&mut address_space, topic);
            if !self.nodesets.adopt(&mut address_space, topic, &folder) {
                address::add_topic(&mut address_space, topic, &folder);
            }
            put(&mut places, topic);
        }
        folders::tidy(&mut address_space, gone);
        let mut notifier = subscriptions.data_notifier();
        for node in gone.iter().flat_map(TopicNode::nodes) {
            let nothing = |status| {
                values::data_value(Some(Variant::Empty), ShownValue::nothing(status).stamp)
            };
            let value = match (places.get(node), left.remove(node)) {
                (Some(_), _) => nothing(StatusCode::BadWaitingForInitialData),
                (None, Some(shown)) => shown,
                (None, None) => nothing(StatusCode::BadNodeIdUnknown),
            };
            notifier.notify(node, AttributeId::Value, value);
        }
    }

    /// Registers the nodes of a topic that is new or has another type.
    pub(crate) fn know(&self, topic: &TopicNode) {
        put(&mut self.places.write(), topic);
    }

    /// Sorts the nodes in the order of `layout`.
    pub(crate) fn set_order(&self, layout: &Layout) {
        *self.order.write() = folders::order(layout);
    }

    /// Returns the rank of a node among the children of its parent, or 0 for a node without a rank.
    pub(crate) fn rank(&self, node: &NodeId) -> usize {
        self.order.read().get(node).copied().unwrap_or_default()
    }

    /// Returns true if the children of a node are ordered.
    pub(crate) fn has_order(&self, node: &NodeId) -> bool {
        self.order.read().contains_key(node)
    }

    /// Returns the namespaces of these nodes with the indexes that the server assigned.
    pub(crate) fn served_namespaces(&self) -> impl Iterator<Item = (u16, &str)> {
        self.namespaces
            .iter()
            .map(|ns| (ns.namespace_index, ns.namespace_uri.as_str()))
    }

    /// Returns the value of a node for a client, or the reason why it is refused. Returns `None`
    /// for nodes without a topic.
    fn answer(&self, node: &NodeId, range: &NumericRange) -> Option<DataValue> {
        let (topic, field) = self.place(node)?;
        Some(self.live.answer((&topic, field), range))
    }

    /// Returns true if every admitted client may read a node.
    pub(crate) fn is_public(&self, node: &NodeId) -> bool {
        self.access.is_public(node)
    }

    /// Returns the value of a node, unless it is large.
    pub(crate) fn shown_at(&self, node: &NodeId) -> Option<Variant> {
        let (topic, field) = self.place(node)?;
        self.live.small((&topic, field))
    }

    /// Sends the current value of a node to a single monitored item.
    fn look_at(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        handle: MonitoredItemHandle,
    ) {
        if let Some((topic, field)) = self.place(node) {
            let place = (&*topic, field);
            self.live.look_at(subscriptions, node, place, handle);
        }
    }

    /// Returns the value of a node for a single monitored item.
    fn answer_item(&self, node: &NodeId, handle: MonitoredItemHandle) -> Option<DataValue> {
        let (topic, field) = self.place(node)?;
        Some(self.live.answer_item((&topic, field), handle))
    }

    /// Writes a value for a client: an OPC UA session, or a user of the page.
    pub(crate) async fn write_one(
        &self,
        address_space: &RwLock<AddressSpace>,
        writer: &WriteClient,
        write: &ParsedWriteValue,
    ) -> Result<StatusCode, StatusCode> {
        let is_value = write.attribute_id == AttributeId::Value;
        let place = self.place(&write.node_id).filter(|_| is_value);
        let Some((topic, field)) = place else {
            let address_space = address_space.read();
            return Err(match address_space.find(&write.node_id) {
                Some(node) if !has_attribute(node, write.attribute_id) => {
                    StatusCode::BadAttributeIdInvalid
                }
                Some(_) => StatusCode::BadNotWritable,
                None => StatusCode::BadNodeIdUnknown,
            });
        };
        if !topic.writable() {
            return Err(StatusCode::BadNotWritable);
        }
        if !self
            .access
            .allows(&writer.token, &write.node_id, Right::Write)
        {
            return Err(StatusCode::BadUserAccessDenied);
        }
        self.writes.write(writer, (&topic, field), write).await
    }

    /// Calls a method of the PubSub configuration.
    fn call_pubsub(&self, context: &RequestContext, method: &NodeId) -> StatusCode {
        let may = context
            .authenticator
            .is_user_executable(&context.token, method);
        if !may {
            return StatusCode::BadUserAccessDenied;
        }
        let called = self.pubsub.call(method, &SessionCaller::of(context).user);
        called.unwrap_or_else(|| {
            if self.nodesets.has(method) {
                StatusCode::BadNotExecutable
            } else {
                StatusCode::BadNodeIdUnknown
            }
        })
    }

    /// Returns the past values of a node.
    fn series(&self, node: &NodeId) -> Option<Series> {
        let place = self.place(node).filter(|(topic, _)| topic.historizing)?;
        Some(self.live.series(place))
    }

    /// Answers the request of each node from its past values.
    fn answer_past(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut &mut HistoryNode],
        wanted: TimestampsToReturn,
        answer: impl Fn(&Series, &mut HistoryNode, &mut ResponseBudget<'_>),
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        if matches!(
            wanted,
            TimestampsToReturn::Neither | TimestampsToReturn::Invalid
        ) {
            return Err(StatusCode::BadTimestampsToReturnInvalid);
        }
        let large = |weight| self.live.items().take(weight);
        let mut room = ResponseBudget::new(&large);
        for node in nodes {
            match self.series(node.node_id()) {
                Some(series) => answer(&series, node, &mut room),
                None => node.set_status(StatusCode::BadHistoryOperationUnsupported),
            }
        }
        Ok(())
    }

    fn place(&self, node: &NodeId) -> Option<(Arc<TopicNode>, Option<usize>)> {
        self.places.read().get(node).cloned()
    }
}

/// Registers the topic and fields of a topic's nodes.
fn put(places: &mut Places, topic: &TopicNode) {
    let topic = Arc::new(topic.clone());
    let all = topic.places();
    places.extend(all.map(|(node, field)| (node.clone(), (Arc::clone(&topic), field))));
}

/// Returns true if a monitored item has no filter. The type of the filter is private in the
/// library, but it can be printed.
fn unfiltered(item: &CreateMonitoredItem) -> bool {
    format!("{:?}", item.filter()) == "None"
}

fn has_attribute(node: &NodeType, attribute: AttributeId) -> bool {
    let node = node.as_node();
    let none = NumericRange::None;
    let wanted = TimestampsToReturn::Neither;
    node.get_attribute(wanted, attribute, &none, &DataEncoding::Binary)
        .is_some()
}

/// Removes the timestamps that were not requested.
fn stamped(mut value: DataValue, wanted: TimestampsToReturn) -> DataValue {
    if !matches!(
        wanted,
        TimestampsToReturn::Both | TimestampsToReturn::Source
    ) {
        value.source_timestamp = None;
    }
    if !matches!(
        wanted,
        TimestampsToReturn::Both | TimestampsToReturn::Server
    ) {
        value.server_timestamp = None;
    }
    value
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

    async fn read_values(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        nodes: &[&ParsedReadValueId],
        max_age: f64,
        timestamps_to_return: TimestampsToReturn,
    ) -> Vec<DataValue> {
        let address_space = address_space.read();
        let genuine = self.genuine.check(context);
        nodes
            .iter()
            .map(|node| {
                let may = genuine
                    .and_then(|()| address_space.validate_node_read(context, node).map(drop));
                if let Err(status) = may {
                    return DataValue {
                        status: Some(status),
                        ..DataValue::default()
                    };
                }
                let answer = self.answer(&node.node_id, &node.index_range);
                match answer.or_else(|| self.alarms.read(&node.node_id)) {
                    Some(value) => stamped(value, timestamps_to_return),
                    None => address_space.read(context, node, max_age, timestamps_to_return),
                }
            })
            .collect()
    }

    async fn create_value_monitored_items(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        items: &mut [&mut &mut CreateMonitoredItem],
    ) {
        let address_space = address_space.read();
        let genuine = self.genuine.check(context);
        for item in items {
            if let Err(status) = genuine {
                item.set_status(status);
                continue;
            }
            let handle = item.handle();
            let queue = item.queue_size();
            let unfiltered = unfiltered(item);
            let node = item.item_to_monitor();
            let exists = match address_space.find(&node.node_id) {
                Some(node) if has_attribute(node, AttributeId::Value) => Ok(()),
                Some(_) => Err(StatusCode::BadAttributeIdInvalid),
                None => Err(StatusCode::BadNodeIdUnknown),
            };
            if let Err(status) = exists {
                item.set_status(status);
                continue;
            }
            let read = address_space.validate_node_read(context, node).map(drop);
            // Later values would reach the client without another check.
            if let Err(StatusCode::BadUserAccessDenied) = read {
                item.set_status(StatusCode::BadUserAccessDenied);
                continue;
            }
            self.live.items().insert(handle, unfiltered, queue);
            let value = match read {
                Ok(()) => {
                    let answer = self.answer_item(&node.node_id, handle);
                    answer.or_else(|| self.alarms.read(&node.node_id))
                }
                Err(_) => None,
            };
            let value = value.unwrap_or_else(|| {
                address_space.read(context, node, 0.0, TimestampsToReturn::Both)
            });
            item.set_initial_value(value);
            item.set_status(StatusCode::Good);
            // The unpatched library changes the source timestamp of a value that arrives within the
            // sampling interval, so that every change is reported on arrival.
            if !plant_opcua::patches::are_applied() && item.sampling_interval() > 0.0 {
                item.revise_sampling_interval(AS_IT_COMES_MS);
            }
            // A value that arrives between this read and the registration of the item is seen only
            // by a second check.
            let _missed = self
                .created
                .try_send((item.item_to_monitor().node_id.clone(), handle));
        }
    }

    async fn modify_monitored_items(
        &self,
        _context: &RequestContext,
        items: &[&MonitoredItemUpdateRef],
    ) {
        self.live.items().resize(items.iter().map(|item| {
            let queue = usize::try_from(item.update().revised_queue_size);
            (item.handle(), queue.unwrap_or(usize::MAX))
        }));
    }

    /// Reports the present values of items that are no longer disabled. The library reports no
    /// value twice, so items that were enabled before are not disturbed.
    async fn set_monitoring_mode(
        &self,
        context: &RequestContext,
        mode: MonitoringMode,
        items: &[&MonitoredItemRef],
    ) {
        if mode == MonitoringMode::Disabled {
            return;
        }
        let access = &self.access;
        for item in items {
            let node = item.node_id();
            let may = access.allows(&context.token, node, Right::Read);
            // An item of events gets no values.
            if may && item.attribute() == AttributeId::Value {
                self.look_at(&context.subscriptions, node, item.handle());
            }
        }
    }

    async fn delete_monitored_items(&self, _context: &RequestContext, items: &[&MonitoredItemRef]) {
        let handles = items.iter().map(|item| item.handle());
        self.live.items().remove(handles);
    }

    async fn write(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        nodes_to_write: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        let writer = &WriteClient::of(context);
        let writes = nodes_to_write.iter_mut().map(|write| async {
            let result = self.write_one(address_space, writer, write.value()).await;
            let (Ok(status) | Err(status)) = result;
            write.set_status(status);
        });
        futures_util::future::join_all(writes).await;
        Ok(())
    }

    async fn history_read_raw_modified(
        &self,
        context: &RequestContext,
        details: &ReadRawModifiedDetails,
        nodes: &mut [&mut &mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.answer_past(context, nodes, wanted, |series, node, room| {
            series.raw(details, node, (wanted, room));
        })
    }

    async fn history_read_processed(
        &self,
        context: &RequestContext,
        details: &ReadProcessedDetails,
        nodes: &mut [&mut &mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        // All aggregates of the request are equal.
        let kind = details
            .aggregate_type
            .as_ref()
            .and_then(|kinds| kinds.first());
        let kind = kind.ok_or(StatusCode::BadAggregateListMismatch)?;
        self.answer_past(context, nodes, wanted, |series, node, room| {
            series.processed((details, kind), node, (wanted, room));
        })
    }

    async fn history_read_at_time(
        &self,
        context: &RequestContext,
        details: &ReadAtTimeDetails,
        nodes: &mut [&mut &mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.answer_past(context, nodes, wanted, |series, node, room| {
            series.at_times(details, node, (wanted, room));
        })
    }

    async fn history_read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        nodes: &mut [&mut &mut HistoryNode],
        _wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        for node in nodes {
            if *node.node_id() == address::alarms_folder() {
                self.alarms.read_events(context, details, node);
            } else {
                node.set_status(StatusCode::BadHistoryOperationUnsupported);
            }
        }
        Ok(())
    }

    async fn call(
        &self,
        context: &RequestContext,
        _address_space: &RwLock<AddressSpace>,
        methods_to_call: &mut [&mut &mut MethodCall],
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        // A response is sent over the secure channel of its request, or not at all.
        let channel = context.session().read().secure_channel_id();
        let gone = || {
            let session = context.session().read();
            !session.is_activated() || session.secure_channel_id() != channel
        };
        let calls = methods_to_call.iter_mut().map(|method| async {
            let asked = (method.method_id(), method.arguments());
            let called = self.callables.call(context, asked, gone).await;
            let called =
                called.unwrap_or_else(|| match self.call_pubsub(context, method.method_id()) {
                    StatusCode::Good => Ok(Vec::new()),
                    refused => Err(CallFailure::Status(refused)),
                });
            set_result(method, called);
        });
        futures_util::future::join_all(calls).await;
        Ok(())
    }
}

/// Checks created monitored items again after a delay, for values that arrived while they were
/// created.
pub(crate) async fn look_again(
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    mut created: mpsc::Receiver<(NodeId, MonitoredItemHandle)>,
) {
    let mut items = Vec::new();
    while created.recv_many(&mut items, 1_000).await > 0 {
        tokio::time::sleep(SECOND_LOOK).await;
        for (node, handle) in items.drain(..) {
            manager.inner().look_at(&subscriptions, &node, handle);
        }
    }
}

/// The name of the node manager in the server's log.
const NAME: &str = "space";
/// A sampling interval that is practically zero, but above the 0 that the library treats as "not
/// requested".
const AS_IT_COMES_MS: f64 = 0.000_1;
const SECOND_LOOK: Duration = Duration::from_millis(100);
