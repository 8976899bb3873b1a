//! The node manager of the space: values of nodes, writes of clients, and monitored items.
//!
//! Locks are taken in this order and never across an await: the address space, the places, the
//! conditions, the values, the past values, the subscriptions, the watched items. While a lock is
//! held, only the subscriptions are called: a write leaves through a bounded channel.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use mappings::{Mapping, TopicId};
use opcua::server::address_space::{AddressSpace, NodeType};
use opcua::server::authenticator::UserToken;
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{InMemoryNodeManager, InMemoryNodeManagerImpl};
use opcua::server::node_manager::{
    HistoryNode, MethodCall, MonitoredItemRef, MonitoredItemUpdateRef, ParsedReadValueId,
    ParsedWriteValue, RequestContext, ServerContext, WriteNode,
};
use opcua::server::{CreateMonitoredItem, MonitoredItemHandle, SubscriptionCache};
use opcua::sync::{Mutex, RwLock};
use opcua::types::{
    AttributeId, DataEncoding, DataValue, DateTime, MonitoringMode, NodeId, NumericRange,
    ReadAtTimeDetails, ReadEventDetails, ReadProcessedDetails, ReadRawModifiedDetails, StatusCode,
    TimestampsToReturn, Variant,
};
use plant_opcua::nodeset::NodeSets;
use plant_opcua::server::{Caller, EventHistory as _};
use plant_opcua::users::{Access, Right};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tracing::{info, warn};
use uadp::Timestamp;

use crate::access::Genuine;
use crate::address;
use crate::alarms::Alarms;
use crate::arrivals::Awaited;
use crate::asking::{Drive, Drives, Questions, Refused, Table};
use crate::budget::{Answers, LARGEST, SMALL, Watched};
use crate::commanders::Commander;
use crate::confirm::Confirms;
use crate::folders;
use crate::history::{Past, Room, Series, Store, Stored};
use crate::identity;
use crate::layout::{FieldNode, Layout, TopicNode};
use crate::leaving::{Departing, Departure, LONGEST_WAY_OUT, NOT_ACTIVE, departure};
use crate::nodesets::Loaded;
use crate::properties;
use crate::pubsub::PubSub;
use crate::redundant::ServerRole;
use crate::value;
use crate::values::{self, Shown, Stamp, Values, View};

/// The node manager in the server.
pub(crate) type SpaceManager = InMemoryNodeManager<SpaceNodes>;

/// Serves the nodes of the space.
pub(crate) struct SpaceNodes {
    namespaces: Vec<NamespaceMetadata>,
    places: RwLock<Places>,
    /// Rank of each node among the children of its parent.
    order: RwLock<HashMap<NodeId, usize>>,
    values: RwLock<Values>,
    past: RwLock<Past>,
    watched: Mutex<Watched>,
    answers: Mutex<Answers>,
    genuine: Genuine,
    exits: Exits,
    nodesets: Loaded,
    /// The Methods that clients can call.
    methods: Table,
    programs: Drives,
    /// Serializes the writes of clients.
    writing: Mutex<()>,
    /// Size limit of a written value, in bytes.
    largest_write: AtomicUsize,
    /// Number of values that were refused to clients because of their size.
    refused: AtomicU64,
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
    pub(crate) access: Arc<Access>,
    /// The PubSub configuration; clients can disable parts of it.
    pub(crate) pubsub: Arc<PubSub>,
    /// The confirmations of writes.
    pub(crate) confirms: Arc<Confirms>,
    /// Whether a redundant server sends the values that clients write.
    pub(crate) role: ServerRole,
    /// The conditions of values.
    pub(crate) alarms: Arc<Alarms>,
}

/// A value that a client wrote to a topic of the OPC UA side.
#[derive(Debug)]
pub(crate) struct ClientWrite {
    pub(crate) topic: TopicId,
    /// The fields of the DataSet as a key frame carries them.
    pub(crate) block: Bytes,
    pub(crate) source: Timestamp,
    /// The session of the write.
    pub(crate) commander: Commander,
    /// Released when the value has been sent.
    pub(crate) room: OwnedSemaphorePermit,
    /// Receives the result of sending the value.
    pub(crate) departure: Departure,
    /// Receives the result of the server that the value is written to. Dropped if there is no such
    /// server.
    pub(crate) answer: oneshot::Sender<StatusCode>,
    /// Receives the confirmation of the bridges.
    pub(crate) awaited: Option<Awaited>,
}

/// The client of a write.
pub(crate) struct Writer {
    pub(crate) subscriptions: Arc<SubscriptionCache>,
    pub(crate) token: UserToken,
    /// Returns the session that commands a topic by a write.
    pub(crate) commander: Box<dyn Fn() -> Commander + Send + Sync>,
}

impl Writer {
    fn of(context: &RequestContext) -> Self {
        Self {
            subscriptions: Arc::clone(&context.subscriptions),
            token: context.token.clone(),
            commander: Commander::of(context),
        }
    }
}

/// The pending results of a value that is being sent.
struct OnItsWay {
    departing: Departing,
    answered: oneshot::Receiver<StatusCode>,
}

/// A callback for the fields of a write before it is sent, and the confirmation that the write
/// waits for.
type Registration<'r> = (&'r dyn Fn(&[Variant]), Option<Awaited>);

impl SpaceNodes {
    /// Registers the namespaces and adds the nodes of `layout` to `address_space`.
    pub(crate) fn build(
        (layout, sets): (&Layout, &NodeSets),
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
        Self {
            namespaces,
            places: RwLock::new(places),
            order: RwLock::new(folders::order(layout)),
            values: RwLock::new(Values::new(MOST_HELD)),
            past: RwLock::new(Past::new(0, 0)),
            watched: Mutex::new(Watched::default()),
            answers: Mutex::new(Answers::default()),
            genuine: Genuine::default(),
            exits,
            nodesets,
            methods: Table::default(),
            programs: Drives::default(),
            writing: Mutex::new(()),
            largest_write: AtomicUsize::new(usize::MAX),
            refused: AtomicU64::new(0),
        }
    }

    /// Returns the nodes of NodeSets.
    pub(crate) const fn nodesets(&self) -> &Loaded {
        &self.nodesets
    }

    /// Returns the PubSub configuration.
    pub(crate) fn pubsub(&self) -> &PubSub {
        &self.exits.pubsub
    }

    /// Returns the Methods that clients can call.
    pub(crate) const fn methods(&self) -> &Table {
        &self.methods
    }

    /// Returns the Programs that clients can control, by their methods.
    pub(crate) const fn programs(&self) -> &Drives {
        &self.programs
    }

    /// Returns the channel for calls of clients.
    pub(crate) const fn questions(&self) -> &Questions {
        &self.exits.questions
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
        let mut values = self.values.write();
        let mut past = self.past.write();
        for topic in gone {
            values.remove(topic.topic);
            past.remove(topic.topic);
        }
        for topic in new {
            past.describe(topic);
        }
        drop(past);
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
            let nothing =
                |status| values::data_value(Some(Variant::Empty), Shown::nothing(status).stamp);
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

    /// Sets the limits of past values.
    pub(crate) fn limit_past(&self, mapping: &Mapping) {
        let usual = mapping.server().history;
        let variables = mapping.variables().iter();
        let own = variables.filter_map(|one| Some((one.topic, usize::from(one.history?))));
        let most = (usize::from(usual.values), usual.bytes);
        self.past.write().limit(most, own.collect());
    }

    /// Adds the past values of a file, and stores all further values there.
    pub(crate) fn keep_past_in(&self, (store, stored): (Store, Vec<Stored>)) {
        self.past.write().keep_in(store, stored);
    }

    /// Writes the remaining past values to their file.
    pub(crate) fn close_past(&self) {
        self.past.write().close();
    }

    /// Sets the size limit of written values, in bytes.
    pub(crate) fn limit_writes(&self, largest: usize) {
        self.largest_write.store(largest, Ordering::Relaxed);
    }

    /// Returns the namespaces of these nodes with the indexes that the server assigned.
    pub(crate) fn served_namespaces(&self) -> impl Iterator<Item = (u16, &str)> {
        self.namespaces
            .iter()
            .map(|ns| (ns.namespace_index, ns.namespace_uri.as_str()))
    }

    /// Returns the current value of a topic.
    pub(crate) fn shown(&self, topic: TopicId) -> Shown {
        let shown = self.values.read().get(topic).cloned();
        shown.unwrap_or_else(Shown::waiting)
    }

    /// Shows a new value of a topic, notifies the monitored items of its nodes, and adds the value
    /// to the history.
    ///
    /// # Errors
    /// Returns `BadOutOfMemory` if there is not enough memory for the value; the nodes then show
    /// this status.
    pub(crate) fn show(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown: Shown,
    ) -> Result<(), StatusCode> {
        self.put(subscriptions, topic, (shown, true))
    }

    /// Shows the current value of a topic with another status.
    pub(crate) fn show_again(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown: Shown,
    ) {
        // The value is stored already, so the memory limit does not apply.
        let _kept = self.put(subscriptions, topic, (shown, false));
    }

    /// Shows a written value as uncertain if it is unknown whether it has arrived, until it is
    /// confirmed or a newer value replaces it.
    pub(crate) fn show_arrival(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        has_arrived: bool,
    ) {
        // A write is sent and shown under this lock.
        let _alone = self.writing.lock();
        let mut shown = self.shown(topic.topic);
        if let Some(status) = arrived(shown.stamp.status, has_arrived) {
            shown.stamp.status = status;
            shown.stamp.server = DateTime::now();
            self.show_again(subscriptions, topic, shown);
        }
    }

    /// Shows a written value as uncertain that was not sent, unless a newer value replaced it.
    fn show_not_sent(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown_at: DateTime,
    ) {
        let _alone = self.writing.lock();
        let mut shown = self.shown(topic.topic);
        if shown.stamp.server == shown_at && shown.stamp.status == StatusCode::Good {
            shown.stamp.status = UNCONFIRMED;
            shown.stamp.server = DateTime::now();
            self.show_again(subscriptions, topic, shown);
        }
    }

    fn put(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        (shown, is_new): (Shown, bool),
    ) -> Result<(), StatusCode> {
        // The lock is held until all items are notified, so that notifications keep their order.
        let mut values = self.values.write();
        let (before, kept) = values.put(topic.topic, shown);
        let Some(shown) = values.get(topic.topic) else {
            return kept;
        };
        if is_new {
            self.past.write().keep(topic.topic, shown);
            self.exits.confirms.heard(topic.topic, shown);
        }
        let before = before.unwrap_or_else(Shown::waiting);
        let views = before.views(topic).zip(shown.views(topic));
        for (node, (before, view)) in topic.nodes().zip(views) {
            self.notify(subscriptions, node, &view, &before);
        }
        drop(values);
        let alarms = &self.exits.alarms;
        alarms.look(topic.topic, || self.shown(topic.topic));
        kept
    }

    /// Notifies the monitored items of a node. For an item without a filter the unpatched library
    /// compares values only, although a changed status has to be reported too (OPC 10000-4, 7.22.2:
    /// the default trigger is StatusValue). A DataValue without a value in between makes it report
    /// both; clients with a queue size of 1 see only the second.
    fn notify(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        view: &View<'_>,
        before: &View<'_>,
    ) {
        let mut notifier = subscriptions.data_notifier();
        let Some(mut items) = notifier.notify_for(node, AttributeId::Value) else {
            return;
        };
        let flipped = !plant_opcua::patches::are_applied()
            && before.stamp().status != view.stamp().status
            && before.has_value_of(view);
        let between = flipped.then(|| view.between());
        let weight = view.weight();
        if weight <= SMALL {
            if let Some(between) = between {
                let watched = self.watched.lock();
                for (handle, _) in items.entries() {
                    if watched.is_unfiltered(*handle) {
                        items.data_value_to_item(between.clone(), handle);
                    }
                }
            }
            items.data_value(view.data_value(&NumericRange::None));
            return;
        }
        let mut decoded = None;
        for (handle, _) in items.entries() {
            let (value, unfiltered) = self.for_item(*handle, view, &mut decoded);
            if let Some(between) = &between
                && unfiltered
            {
                items.data_value_to_item(between.clone(), handle);
            }
            items.data_value_to_item(value, handle);
        }
    }

    /// Returns the value for a monitored item, or the reason why it is refused, and if the item has
    /// no filter. The value is decoded once for all items.
    fn for_item(
        &self,
        handle: MonitoredItemHandle,
        view: &View<'_>,
        decoded: &mut Option<DataValue>,
    ) -> (DataValue, bool) {
        let weight = view.weight();
        let (status, unfiltered) = {
            let mut watched = self.watched.lock();
            let status = match weight {
                LARGEST.. => Some(StatusCode::BadResponseTooLarge),
                _ if watched.take(handle, weight) => None,
                _ => Some(StatusCode::BadOutOfMemory),
            };
            (status, watched.is_unfiltered(handle))
        };
        let value = match status {
            Some(status) => self.refuse(view, weight, status),
            None => decoded
                .get_or_insert_with(|| view.data_value(&NumericRange::None))
                .clone(),
        };
        (value, unfiltered)
    }

    /// Returns the DataValue of a refused value. The refusal is logged at the 1st, 10th, 100th ...
    /// time.
    fn refuse(&self, view: &View<'_>, weight: usize, status: StatusCode) -> DataValue {
        let total = self.refused.fetch_add(1, Ordering::Relaxed) + 1;
        if 10_u64.pow(total.ilog10()) == total {
            warn!(
                total,
                "a client receives {status} instead of a value of {} MiB, which exceeds its limit; it can read fewer elements with an IndexRange",
                weight >> 20
            );
        }
        view.refused(status)
    }

    /// Returns the value of a node for a client, or the reason why it is refused. Returns `None`
    /// for nodes without a topic.
    fn answer(&self, node: &NodeId, range: &NumericRange) -> Option<DataValue> {
        let (topic, field) = self.place(node)?;
        let shown = self.shown(topic.topic);
        let (view, range) = shown.view(&topic, field).narrowed(range);
        let weight = view.weight();
        let refused = match weight {
            ..=SMALL => None,
            LARGEST.. => Some(StatusCode::BadResponseTooLarge),
            _ if self.answers.lock().take(weight, now()) => None,
            _ => Some(StatusCode::BadOutOfMemory),
        };
        Some(match refused {
            Some(status) => self.refuse(&view, weight, status),
            None => view.data_value(&range),
        })
    }

    /// Returns true if every admitted client may read a node.
    pub(crate) fn is_public(&self, node: &NodeId) -> bool {
        self.exits.access.is_public(node)
    }

    /// Returns the value of a node, unless it is large.
    pub(crate) fn shown_at(&self, node: &NodeId) -> Option<Variant> {
        let (topic, field) = self.place(node)?;
        let shown = self.shown(topic.topic);
        let view = shown.view(&topic, field);
        let small = view.weight() <= SMALL;
        small.then(|| view.data_value(&NumericRange::None).value)?
    }

    /// Sends the current value of a node to a single monitored item.
    fn look_at(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        handle: MonitoredItemHandle,
    ) {
        let Some((topic, field)) = self.place(node) else {
            return;
        };
        // The lock is held until the item is notified, as for every value.
        let values = self.values.read();
        if let Some(shown) = values.get(topic.topic) {
            let (value, _) = self.for_item(handle, &shown.view(&topic, field), &mut None);
            let mut notifier = subscriptions.data_notifier();
            if let Some(mut batch) = notifier.notify_for(node, AttributeId::Value) {
                batch.data_value_to_item(value, &handle);
            }
        }
    }

    /// Returns the value of a node for a single monitored item.
    fn answer_item(&self, node: &NodeId, handle: MonitoredItemHandle) -> Option<DataValue> {
        let (topic, field) = self.place(node)?;
        let shown = self.shown(topic.topic);
        let view = shown.view(&topic, field);
        Some(self.for_item(handle, &view, &mut None).0)
    }

    /// Writes a value for a client: an OPC UA session, or a user of the page.
    pub(crate) async fn write_one(
        &self,
        address_space: &RwLock<AddressSpace>,
        writer: &Writer,
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
            .exits
            .access
            .allows(&writer.token, &write.node_id, Right::Write)
        {
            return Err(StatusCode::BadUserAccessDenied);
        }
        let place = (&*topic, field);
        if let Some(rule) = self.exits.confirms.of(topic.topic) {
            let send =
                |register: &dyn Fn(&[Variant])| self.send_written(writer, place, write, register);
            let arrived = self.exits.confirms.write(topic.topic, &rule, send).await?;
            // The value has arrived, even if there is not enough memory to show it.
            let _shown = self.show(&writer.subscriptions, &topic, arrived);
            return Ok(StatusCode::Good);
        }
        let arrivals = &self.exits.confirms.arrivals;
        let (awaited, awaiting) = arrivals.await_write(topic.topic, field).unzip();
        if topic.targeted {
            let (sent, on_its_way) = {
                let _alone = self.writing.lock();
                self.send_alone(writer, place, write, (&|_| {}, awaited))?
            };
            let left = on_its_way.departing.left().await;
            // The other server may have the value although the group does not.
            let status = match tokio::time::timeout(LONGEST_WAY_OUT, on_its_way.answered).await {
                Ok(Ok(status)) => status,
                // A reload of the mapping or a change of the role dropped the value.
                Ok(Err(_)) => left.err().unwrap_or(StatusCode::BadNoCommunication),
                Err(_) => StatusCode::BadTimeout,
            };
            if status.is_bad() {
                return Err(status);
            }
            let _shown = self.show(&writer.subscriptions, &topic, sent);
            if let Some(awaiting) = awaiting {
                awaiting.arrived().await?;
            }
            return Ok(status);
        }
        let (on_its_way, shown_at) = self.write_and_show(writer, place, (write, awaited))?;
        if let Err(status) = on_its_way.departing.left().await {
            self.show_not_sent(&writer.subscriptions, &topic, shown_at);
            return Err(status);
        }
        if let Some(awaiting) = awaiting {
            awaiting.arrived().await?;
        }
        Ok(StatusCode::Good)
    }

    /// Sends a value and shows it. Returns the server timestamp of the shown value.
    fn write_and_show(
        &self,
        writer: &Writer,
        place: (&TopicNode, Option<usize>),
        (write, awaited): (&ParsedWriteValue, Option<Awaited>),
    ) -> Result<(OnItsWay, DateTime), StatusCode> {
        // No other write may come between sending and showing, because a write of a single field
        // keeps the current values of the other fields.
        let _alone = self.writing.lock();
        let (sent, on_its_way) = self.send_alone(writer, place, write, (&|_| {}, awaited))?;
        let shown_at = sent.stamp.server;
        let _shown = self.show(&writer.subscriptions, place.0, sent);
        Ok((on_its_way, shown_at))
    }

    /// Calls [`send_alone`](Self::send_alone) with the write lock held. The confirmation replaces
    /// the result of sending.
    fn send_written(
        &self,
        writer: &Writer,
        place: (&TopicNode, Option<usize>),
        write: &ParsedWriteValue,
        register: &dyn Fn(&[Variant]),
    ) -> Result<Shown, StatusCode> {
        let _alone = self.writing.lock();
        let (sent, _on_its_way) = self.send_alone(writer, place, write, (register, None))?;
        Ok(sent)
    }

    /// Computes all fields of the topic after a write, registers and sends them. Returns the value
    /// to show afterwards, and the pending results of sending. The caller holds the write lock.
    fn send_alone(
        &self,
        writer: &Writer,
        (topic, field): (&TopicNode, Option<usize>),
        write: &ParsedWriteValue,
        (register, awaited): Registration<'_>,
    ) -> Result<(Shown, OnItsWay), StatusCode> {
        if self.exits.pubsub.is_off(topic.topic) || self.exits.role.is_standby() {
            // The writer of the topic is disabled, or another server is active: the value would
            // not be sent.
            return Err(NOT_ACTIVE);
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
        let shown = self.shown(topic.topic);
        let field = field.and_then(|field| topic.fields.get(field));
        let fields = new_fields(&shown, topic, field, (value, &write.index_range))?;
        if !properties::are_within(topic, &fields) {
            return Err(StatusCode::BadOutOfRange);
        }
        let block = Bytes::from(value::fields_block(&fields)?);
        register(&fields);
        drop(fields);
        let source = source_of(&write.value);
        let value = (block.clone(), source);
        let on_its_way = self.send(topic, value, ((writer.commander)(), awaited))?;
        let stamp = Stamp {
            status: StatusCode::Good,
            source: Some(source),
            server: DateTime::now(),
        };
        let block = Some(block);
        Ok((Shown { block, stamp }, on_its_way))
    }

    /// Passes a written value to the run loop.
    fn send(
        &self,
        topic: &TopicNode,
        (block, source): (Bytes, Timestamp),
        (commander, awaited): (Commander, Option<Awaited>),
    ) -> Result<OnItsWay, StatusCode> {
        if block.len() > self.largest_write.load(Ordering::Relaxed) {
            return Err(StatusCode::BadRequestTooLarge);
        }
        let full = StatusCode::BadResourceUnavailable;
        let size = u32::try_from(block.len() >> 10).map_err(|_| full)?;
        let room = Arc::clone(&self.exits.room);
        let room = room.try_acquire_many_owned(size).map_err(|_| full)?;
        let (departure, departing) = departure();
        let (answer, answered) = oneshot::channel();
        let write = ClientWrite {
            topic: topic.topic,
            block,
            source,
            commander,
            room,
            departure,
            answer,
            awaited,
        };
        self.exits.writes.try_send(write).map_err(|_| full)?;
        Ok(OnItsWay {
            departing,
            answered,
        })
    }

    fn program(&self, method: &NodeId) -> Option<Drive> {
        self.programs.lock().get(method).cloned()
    }

    /// Calls a method of a Program. The call continues if its client is lost.
    async fn drive(
        &self,
        context: &RequestContext,
        asked: Drive,
        arguments: &[Variant],
    ) -> Result<Vec<Variant>, Refused> {
        // Clients with permission to send goals may call the method.
        let may = context
            .authenticator
            .is_user_executable(&context.token, &asked.goal);
        if !may {
            return Err(Refused::Status(StatusCode::BadUserAccessDenied));
        }
        let ended = tokio::spawn((asked.carry_out)(arguments.to_vec())).await;
        ended.unwrap_or(Err(Refused::Status(StatusCode::BadInternalError)))
    }

    /// Calls a method of the PubSub configuration.
    fn call_pubsub(&self, context: &RequestContext, method: &NodeId) -> StatusCode {
        let may = context
            .authenticator
            .is_user_executable(&context.token, method);
        if !may {
            return StatusCode::BadUserAccessDenied;
        }
        let called = self.exits.pubsub.call(method, &Caller::of(context).user);
        called.unwrap_or_else(|| match self.nodesets.has(method) {
            true => StatusCode::BadNotExecutable,
            false => StatusCode::BadNodeIdUnknown,
        })
    }

    /// Returns the past values of a node.
    fn series(&self, node: &NodeId) -> Option<Series> {
        let place = self.place(node).filter(|(topic, _)| topic.historizing)?;
        let kept = self.past.read().of(place.0.topic);
        Some(Series::new(place, kept))
    }

    /// Answers the request of each node from its past values.
    fn answer_past(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut &mut HistoryNode],
        wanted: TimestampsToReturn,
        answer: impl Fn(&Series, &mut HistoryNode, &mut Room<'_>),
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        if matches!(
            wanted,
            TimestampsToReturn::Neither | TimestampsToReturn::Invalid
        ) {
            return Err(StatusCode::BadTimestampsToReturnInvalid);
        }
        let large = |weight| self.answers.lock().take(weight, now());
        let mut room = Room::new(&large);
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

/// Returns the new status of a written value, or `None` if its status stays.
fn arrived(shown: StatusCode, has_arrived: bool) -> Option<StatusCode> {
    let (before, after) = match has_arrived {
        true => (UNCONFIRMED, StatusCode::Good),
        false => (StatusCode::Good, UNCONFIRMED),
    };
    (shown == before).then_some(after)
}

/// Returns the source timestamp of a client's value, or the current time.
fn source_of(value: &DataValue) -> Timestamp {
    let picoseconds = value.source_picoseconds.unwrap_or_default().min(9_999);
    let (time, picoseconds) = match value.source_timestamp {
        Some(time) => (time, picoseconds),
        None => (DateTime::now(), 0),
    };
    Timestamp {
        time: value::ticks(time),
        picoseconds,
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

/// Returns all fields of a topic after a write to the topic or to one of its fields.
fn new_fields(
    shown: &Shown,
    topic: &TopicNode,
    field: Option<&FieldNode>,
    (value, range): (&Variant, &NumericRange),
) -> Result<Vec<Variant>, StatusCode> {
    let current = |field: Option<usize>| {
        let view = shown.view(topic, field);
        let weight = view.weight();
        // The written value is as large and was accepted.
        (weight <= LARGEST).then(|| view.data_value(&NumericRange::None).value)?
    };
    let current = |field| current(field).filter(|value| !matches!(value, Variant::Empty));
    let at = |field: &FieldNode| topic.fields.iter().position(|one| one.node == field.node);
    let value = if range.has_range() {
        let whole = match field.and_then(at) {
            None if topic.compound => None,
            place => current(place.filter(|_| topic.compound)),
        };
        let mut whole = whole.ok_or(StatusCode::BadIndexRangeNoData)?;
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
            .enumerate()
            .map(|(at, other)| match current(Some(at)) {
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

/// Returns the elements of a Variant array.
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
                match answer.or_else(|| self.exits.alarms.read(&node.node_id)) {
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
            self.watched.lock().insert(handle, unfiltered, queue);
            let value = match read {
                Ok(()) => {
                    let answer = self.answer_item(&node.node_id, handle);
                    answer.or_else(|| self.exits.alarms.read(&node.node_id))
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
                .exits
                .created
                .try_send((item.item_to_monitor().node_id.clone(), handle));
        }
    }

    async fn modify_monitored_items(
        &self,
        _context: &RequestContext,
        items: &[&MonitoredItemUpdateRef],
    ) {
        let mut watched = self.watched.lock();
        for item in items {
            let queue = usize::try_from(item.update().revised_queue_size);
            watched.resize(item.handle(), queue.unwrap_or(usize::MAX));
        }
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
        let access = &self.exits.access;
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
        let mut watched = self.watched.lock();
        for item in items {
            watched.remove(item.handle());
        }
    }

    async fn write(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        nodes_to_write: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        self.genuine.check(context)?;
        let writer = &Writer::of(context);
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
                self.exits.alarms.read_events(context, details, node);
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
            // The Method may have been removed after the check of the server.
            let callable = self.methods.lock().get(method.method_id()).cloned();
            let called = match callable {
                Some(callable) => {
                    let arguments = method.arguments().to_vec();
                    callable.call(&arguments, &self.exits.questions, gone).await
                }
                None if let Some(asked) = self.program(method.method_id()) => {
                    self.drive(context, asked, method.arguments()).await
                }
                None => match self.call_pubsub(context, method.method_id()) {
                    StatusCode::Good => Ok(Vec::new()),
                    refused => Err(Refused::Status(refused)),
                },
            };
            match called {
                Ok(outputs) => {
                    method.set_outputs(outputs);
                    method.set_status(StatusCode::Good);
                }
                Err(Refused::Arguments(statuses)) => {
                    method.set_argument_error(statuses);
                    method.set_status(StatusCode::BadInvalidArgument);
                }
                Err(Refused::Asked(error)) => {
                    info!(method = %method.method_id(), "a call came to nothing: {error}");
                    method.set_status(StatusCode::from(error.status.0));
                }
                Err(Refused::Status(status)) => method.set_status(status),
            }
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

#[expect(
    clippy::disallowed_methods,
    reason = "answers to clients are given now"
)]
fn now() -> Instant {
    Instant::now()
}

/// The name of the node manager in the server's log.
const NAME: &str = "space";
/// Status of a written value while it is unknown if it has arrived.
const UNCONFIRMED: StatusCode = StatusCode::UncertainLastUsableValue;
/// A sampling interval that is practically zero, but above the 0 that the library treats as "not
/// requested".
const AS_IT_COMES_MS: f64 = 0.000_1;
const SECOND_LOOK: Duration = Duration::from_millis(100);
/// Size limit of all current values, in bytes.
const MOST_HELD: usize = 512 << 20;
