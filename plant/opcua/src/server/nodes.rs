//! Nodes of the server's own namespaces: their values, and writes of clients.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use opcua::nodes::NodeType;
use opcua::server::address_space::{AccessLevel, AddressSpace, user_access_level};
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::InMemoryNodeManagerImpl;
use opcua::server::node_manager::{ParsedWriteValue, RequestContext, ServerContext, WriteNode};
use opcua::server::{CreateMonitoredItem, SubscriptionCache};
use opcua::sync::RwLock;
use opcua::types::{
    AttributeId, DataEncoding, DataValue, DateTime, NodeId, NumericRange, StatusCode,
    TimestampsToReturn, Variant,
};
use tokio::time::{Instant, timeout_at};

use super::calls::fits;
use super::sessions::{SessionCaller, SessionPresence, Sessions};
use crate::limits::LONGEST_REQUEST;

/// A write that passed the checks of access, DataType and ValueRank.
#[derive(Debug, Clone)]
pub struct WriteRequest {
    /// The writing client.
    pub caller: SessionCaller,
    /// The variable.
    pub node: NodeId,
    /// The complete resulting value of the variable.
    pub value: DataValue,
    /// Whether the session of the client is still active.
    pub presence: SessionPresence,
}

/// Decides on client writes to a variable. A decision that takes longer than [`LONGEST_REQUEST`] is
/// cancelled.
#[async_trait]
pub trait WriteHandler: Send + Sync + 'static {
    /// Accepts a value, which the server then sets.
    ///
    /// # Errors
    /// Returns the status code of the refusal.
    async fn write(&self, request: WriteRequest) -> Result<(), StatusCode>;

    /// Converts a value of another DataType that means the same into the DataType of the variable.
    /// Other values are returned unchanged. The result is checked against the DataType.
    fn converted(&self, value: Variant) -> Variant {
        value
    }
}

struct Function<F>(F);

#[async_trait]
impl<F> WriteHandler for Function<F>
where
    F: Fn(WriteRequest) -> Result<(), StatusCode> + Send + Sync + 'static,
{
    async fn write(&self, request: WriteRequest) -> Result<(), StatusCode> {
        (self.0)(request)
    }
}

/// Creates a handler from a function that returns at once.
pub fn write<F>(function: F) -> Arc<dyn WriteHandler>
where
    F: Fn(WriteRequest) -> Result<(), StatusCode> + Send + Sync + 'static,
{
    Arc::new(Function(function))
}

/// The implementation of the node manager.
pub(crate) struct ServerNodes {
    namespaces: RwLock<Vec<NamespaceMetadata>>,
    writers: RwLock<HashMap<NodeId, Arc<dyn WriteHandler>>>,
    sessions: Arc<Sessions>,
}

impl ServerNodes {
    pub(crate) fn new(namespaces: Vec<NamespaceMetadata>, sessions: Arc<Sessions>) -> Self {
        Self {
            namespaces: RwLock::new(namespaces),
            writers: RwLock::default(),
            sessions,
        }
    }

    pub(crate) fn on_write(&self, node: &NodeId, handler: Arc<dyn WriteHandler>) {
        self.writers.write().insert(node.clone(), handler);
    }

    /// Adds a namespace for BrowseNames to the NamespaceArray.
    pub(crate) fn add_namespace(&self, uri: &str, index: u16) {
        let mut namespaces = self.namespaces.write();
        if !namespaces.iter().any(|one| one.namespace_index == index) {
            namespaces.push(NamespaceMetadata {
                namespace_uri: uri.to_owned(),
                namespace_index: index,
                ..NamespaceMetadata::default()
            });
        }
    }

    pub(crate) fn remove(&self, node: &NodeId) {
        self.writers.write().remove(node);
    }

    /// Returns the resulting value of a write of this value if the variable may be written.
    fn checked(
        context: &RequestContext,
        address_space: &AddressSpace,
        (write, value): (&ParsedWriteValue, Option<Variant>),
    ) -> Result<DataValue, StatusCode> {
        let node = address_space
            .find(&write.node_id)
            .ok_or(StatusCode::BadNodeIdUnknown)?;
        let none = NumericRange::None;
        let attribute = node.as_node().get_attribute(
            TimestampsToReturn::Neither,
            write.attribute_id,
            &none,
            &DataEncoding::Binary,
        );
        if attribute.is_none() {
            return Err(StatusCode::BadAttributeIdInvalid);
        }
        let NodeType::Variable(variable) = node else {
            return Err(StatusCode::BadNotWritable);
        };
        if write.attribute_id != AttributeId::Value || !variable.is_writable() {
            return Err(StatusCode::BadNotWritable);
        }
        if !user_access_level(context, node).contains(AccessLevel::CURRENT_WRITE) {
            return Err(StatusCode::BadUserAccessDenied);
        }
        let given = &write.value;
        if given
            .status
            .is_some_and(|status| status != StatusCode::Good)
        {
            return Err(StatusCode::BadWriteNotSupported);
        }
        let value = value.ok_or(StatusCode::BadTypeMismatch)?;
        let whole = if write.index_range.has_range() {
            let shown = super::value_of(variable);
            let mut whole = shown.value.ok_or(StatusCode::BadIndexRangeNoData)?;
            whole.set_range_of(&write.index_range, &value)?;
            whole
        } else {
            value
        };
        let types = context.type_tree.read();
        if !fits(
            &whole,
            &variable.data_type(),
            variable.value_rank(),
            &*types,
        ) {
            return Err(StatusCode::BadTypeMismatch);
        }
        Ok(DataValue {
            value: Some(whole),
            status: Some(StatusCode::Good),
            source_timestamp: given.source_timestamp,
            ..DataValue::default()
        })
    }
}

/// Removes picoseconds of 0, which asyncua would decode as a part of the next timestamp.
pub(crate) fn plain(mut value: DataValue) -> DataValue {
    for picoseconds in [&mut value.source_picoseconds, &mut value.server_picoseconds] {
        picoseconds.take_if(|count| *count == 0);
    }
    value
}

/// Sets values atomically, and notifies subscribers.
///
/// # Errors
/// Returns an error if a node is not a variable of the own namespaces.
pub(crate) fn show(
    address_space: &RwLock<AddressSpace>,
    subscriptions: &SubscriptionCache,
    values: Vec<(NodeId, DataValue)>,
) -> Result<(), StatusCode> {
    let mut address_space = address_space.write();
    for (node, _) in &values {
        match address_space.find(node) {
            Some(NodeType::Variable(_)) => {}
            Some(_) => return Err(StatusCode::BadAttributeIdInvalid),
            None => return Err(StatusCode::BadNodeIdUnknown),
        }
    }
    let now = DateTime::now();
    let mut shown = Vec::with_capacity(values.len());
    for (node, value) in values {
        let mut value = plain(value);
        // The OPC UA library reads a variable without a value without its status.
        value.value.get_or_insert(Variant::Empty);
        value.status.get_or_insert(StatusCode::Good);
        value.source_timestamp.get_or_insert(now);
        value.server_timestamp.get_or_insert(now);
        if let Some(NodeType::Variable(variable)) = address_space.find_mut(&node) {
            variable.set_data_value(value);
            shown.push(node);
        }
    }
    // The lock is held until all notifications are queued, so that their order equals the order of
    // the changes.
    subscriptions.maybe_notify(
        shown.iter().map(|node| (node, AttributeId::Value)),
        |node, attribute, range, encoding| {
            let node = address_space.find(node)?.as_node();
            node.get_attribute(TimestampsToReturn::Both, attribute, range, encoding)
        },
    );
    Ok(())
}

#[async_trait]
impl InMemoryNodeManagerImpl for ServerNodes {
    async fn init(&self, _address_space: &mut AddressSpace, _context: ServerContext) {}

    fn name(&self) -> &'static str {
        "plant"
    }

    fn namespaces(&self) -> Vec<NamespaceMetadata> {
        self.namespaces.read().clone()
    }

    async fn create_value_monitored_items(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        items: &mut [&mut &mut CreateMonitoredItem],
    ) {
        let address_space = address_space.read();
        for item in items {
            let what = item.item_to_monitor();
            let value = address_space.read(context, what, 0.0, TimestampsToReturn::Both);
            let refused = value.status().is_bad() && value.value.is_none();
            if refused && value.status() != StatusCode::BadIndexRangeNoData {
                item.set_status(value.status());
                continue;
            }
            item.set_initial_value(value);
            item.set_status(StatusCode::Good);
            // Every change is reported at once, as far as the queue of the client permits. With a
            // sampling interval the library would delay changes, and of two changes within the
            // interval only the last change would be reported.
            if item.sampling_interval() > 0.0 {
                item.revise_sampling_interval(AS_IT_COMES_MS);
            }
        }
    }

    async fn write(
        &self,
        context: &RequestContext,
        address_space: &RwLock<AddressSpace>,
        nodes: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        let end = Instant::now() + LONGEST_REQUEST;
        for write in nodes {
            let node = write.value().node_id.clone();
            let handler = self.writers.read().get(&node).cloned();
            let given = write.value().value.value.clone();
            let given = match &handler {
                Some(handler) => given.map(|value| handler.converted(value)),
                None => given,
            };
            let checked = Self::checked(context, &address_space.read(), (write.value(), given));
            let value = match checked {
                Ok(value) => value,
                Err(status) => {
                    write.set_status(status);
                    continue;
                }
            };
            if let Some(handler) = handler {
                let request = WriteRequest {
                    caller: self.sessions.caller(context),
                    node: node.clone(),
                    value: value.clone(),
                    presence: SessionPresence::of(context),
                };
                let decided = timeout_at(end, handler.write(request)).await;
                if let Err(status) = decided.unwrap_or(Err(StatusCode::BadTimeout)) {
                    write.set_status(status);
                    continue;
                }
            }
            let shown = show(address_space, &context.subscriptions, vec![(node, value)]);
            write.set_status(shown.err().unwrap_or(StatusCode::Good));
        }
        Ok(())
    }

    async fn call(
        &self,
        _context: &RequestContext,
        _address_space: &RwLock<AddressSpace>,
        methods: &mut [&mut &mut opcua::server::node_manager::MethodCall],
    ) -> Result<(), StatusCode> {
        // Methods without handler, of objects in a NodeSet.
        for call in methods {
            call.set_status(StatusCode::BadNotImplemented);
        }
        Ok(())
    }
}

/// Effectively no interval, but above 0, which the library treats as unspecified.
const AS_IT_COMES_MS: f64 = 0.000_1;
