//! A server with instances of the types of NodeSets.
//!
//! Reading order: `build` (creates a server from its configuration), `view` (the nodes of both node
//! managers), `instances` (nodes from types), `methods` (methods without declaration in a type),
//! `nodes` (values and writes), `calls` and `routed` (method calls), `overlay` (methods of the core
//! namespace), `supplement` (attributes and values that the library does not serve), `roles`,
//! `capabilities`, `sessions`, `events`, `copies` (types and events of other servers).

mod address_spaces;
mod build;
mod calls;
mod capabilities;
mod copies;
mod events;
mod instances;
mod methods;
mod nodes;
mod overlay;
pub mod roles;
mod routed;
mod sessions;
mod supplement;
mod view;

use std::sync::Arc;
use std::time::Duration;

use opcua::nodes::{NodeType, Variable};
use opcua::server::ServerHandle;
use opcua::server::node_manager::memory::InMemoryNodeManager;
use opcua::sync::Mutex;
use opcua::types::{
    AttributeId, ByteString, DataEncoding, DataValue, LocalizedText, NodeId, NumericRange,
    QualifiedName, StatusCode, TimestampsToReturn, Variant,
};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tracing::{error, warn};

pub use self::address_spaces::arguments_in;
pub use self::build::{ServerBuilder, ServerConfig, ServerError, ServerSecurity};
pub use self::calls::{MethodHandler, MethodRefusal, MethodRequest, method};
pub use self::capabilities::{Facets, capabilities, profiles};
pub use self::copies::{ForwardedEvent, TypeSpec};
pub use self::events::{StateRef, TransitionEvent};
pub use self::instances::{
    IdRange, Instance, InstanceError, InstanceSpec, ObjectSpec, VariableSpec,
};
pub use self::methods::MethodSpec;
pub use self::nodes::{WriteHandler, WriteRequest, write};
pub use self::overlay::CoreMethod;
pub use self::routed::{core_of, core_with};
pub(crate) use self::sessions::ANONYMOUS;
pub use self::sessions::{SessionCaller, SessionPresence};
pub use self::supplement::{CoreValue, EventHistory, NodeFacts, Supplement};
pub use self::view::ChildNode;
pub use crate::endpoint::EndpointUrl;

use self::address_spaces::AddressSpaces;
use self::calls::MethodCalls;
use self::nodes::ServerNodes;
use crate::changes::{self, ModelChange};
use crate::door::Door;
use crate::pki::Pki;
use crate::users::UserAccess;

/// The attributes of a variable, or of a variable declaration in a type.
#[derive(Debug, Clone)]
pub struct VariableFacts {
    /// Its DataType.
    pub data_type: NodeId,
    /// Its ValueRank.
    pub value_rank: i32,
    /// Its value.
    pub value: DataValue,
    /// Its Description; null without one.
    pub description: LocalizedText,
}

/// A server. Clones share the same server, which stops when the last clone is dropped.
#[derive(Clone)]
pub struct OpcUaServer {
    inner: Arc<Inner>,
}

struct Inner {
    handle: ServerHandle,
    manager: Arc<InMemoryNodeManager<ServerNodes>>,
    spaces: Arc<AddressSpaces>,
    calls: Arc<MethodCalls>,
    application_uri: String,
    url: String,
    port: u16,
    /// Held while nodes are created or removed.
    making: Mutex<()>,
    /// Set until the server is started.
    waiting: Mutex<Option<Waiting>>,
    running: Mutex<Vec<JoinHandle<()>>>,
}

/// The parts that serve clients after the start.
struct Waiting {
    server: opcua::server::Server,
    listener: TcpListener,
    pki: Option<Pki>,
    /// The door and its public listener, if the server listens for the door only.
    door: Option<(Door, TcpListener)>,
    users: Option<Arc<UserAccess>>,
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.handle.cancel();
        // The serving task ends by itself, and closes its connections.
        for task in self.running.lock().drain(..).skip(1) {
            task.abort();
        }
    }
}

impl OpcUaServer {
    /// Starts serving clients. A second call has no effect.
    pub fn start(&self) {
        let Some(waiting) = self.inner.waiting.lock().take() else {
            return;
        };
        let Waiting {
            server,
            listener,
            mut pki,
            door,
            users,
        } = waiting;
        let serving = tokio::spawn(async move {
            if let Err(error) = server.run_with(listener).await {
                error!(error, "the OPC UA server has stopped");
            }
        });
        let sessions = Arc::clone(&self.inner.calls.sessions);
        let looking = tokio::spawn(async move {
            let mut waited = Duration::ZERO;
            loop {
                waited += sessions.wait(LOOK_AT_REJECTED).await;
                sessions.look();
                if waited < LOOK_AT_REJECTED {
                    continue;
                }
                waited = Duration::ZERO;
                if let Some(users) = &users {
                    users.look();
                }
                if let Some(pki) = &mut pki {
                    pki.report_rejected();
                }
            }
        });
        let standing = door.map(|(door, listener)| tokio::spawn(door.stand(listener)));
        let mut running = self.inner.running.lock();
        running.extend([serving, looking]);
        running.extend(standing);
    }

    /// Closes all connections and stops listening, within [`LONGEST_STOP`].
    pub async fn stop(&self) {
        self.inner.handle.cancel();
        drop(self.inner.waiting.lock().take());
        let tasks: Vec<_> = self.inner.running.lock().drain(..).collect();
        for (task, is_serving) in tasks.into_iter().zip([true, false, false]) {
            let abort = task.abort_handle();
            if !is_serving {
                abort.abort();
            }
            if tokio::time::timeout(LONGEST_STOP, task).await.is_err() {
                warn!("the OPC UA server did not stop in time");
                abort.abort();
            }
        }
    }

    /// Returns the endpoint URL for clients.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.inner.url
    }

    /// Returns the listening port.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.inner.port
    }

    /// Returns the ApplicationUri, which is also the namespace with index 1.
    #[must_use]
    pub fn application_uri(&self) -> &str {
        &self.inner.application_uri
    }

    /// Returns the index of a namespace.
    #[must_use]
    pub fn namespace(&self, uri: &str) -> Option<u16> {
        self.inner.handle.get_namespace_index(uri)
    }

    /// Returns the URIs of the namespaces, by index.
    #[must_use]
    pub fn namespaces(&self) -> Vec<String> {
        let mut all = Vec::new();
        for (uri, index) in self
            .inner
            .handle
            .type_tree()
            .read()
            .namespaces()
            .known_namespaces()
        {
            let index = usize::from(*index);
            if all.len() <= index {
                all.resize(index + 1, String::new());
            }
            if let Some(slot) = all.get_mut(index) {
                slot.clone_from(uri);
            }
        }
        all
    }

    /// Returns the BrowseName of a node, including nodes of the core namespace.
    #[must_use]
    pub fn browse_name(&self, node: &NodeId) -> Option<QualifiedName> {
        let spaces = &self.inner.spaces;
        spaces.with(|view| Some(view.node(node)?.as_node().browse_name().clone()))
    }

    /// Returns a type by its namespace and BrowseName.
    #[must_use]
    pub fn find_type(&self, namespace_uri: &str, browse_name: &str) -> Option<NodeId> {
        let index = self.namespace(namespace_uri)?;
        self.inner
            .spaces
            .with(|view| view.find_type(index, browse_name))
    }

    /// Returns the supertypes of a type, nearest first, without the type itself.
    #[must_use]
    pub fn supertypes(&self, type_id: &NodeId) -> Vec<NodeId> {
        let spaces = &self.inner.spaces;
        spaces.with(|view| view.supertypes(type_id).into_iter().cloned().collect())
    }

    /// Returns whether a type is `base` or a subtype of `base`.
    #[must_use]
    pub fn is_subtype_of(&self, type_id: &NodeId, base: &NodeId) -> bool {
        self.inner
            .spaces
            .with(|view| view.is_subtype_of(type_id, base))
    }

    /// Returns the direct children of a node, in arbitrary order.
    #[must_use]
    pub fn children(&self, node: &NodeId) -> Vec<ChildNode> {
        self.inner.spaces.with(|view| view.children(node))
    }

    /// Returns the attributes of a variable.
    #[must_use]
    pub fn variable_facts(&self, node: &NodeId) -> Option<VariableFacts> {
        self.inner.spaces.with(|view| {
            let Some(NodeType::Variable(variable)) = view.node(node) else {
                return None;
            };
            let description = opcua::nodes::NodeBase::description(&**variable);
            Some(VariableFacts {
                data_type: variable.data_type(),
                value_rank: variable.value_rank(),
                value: value_of(variable),
                description: description.cloned().unwrap_or_default(),
            })
        })
    }

    /// Sets the value of a variable, with the current time.
    ///
    /// # Errors
    /// Returns an error if the node is not a variable of this server's namespaces.
    pub fn show(&self, node: &NodeId, value: impl Into<Variant>) -> Result<(), StatusCode> {
        self.show_value(node, DataValue::new_now(value.into()))
    }

    /// Sets the value of a variable. A missing status becomes Good, and missing timestamps become
    /// the current time.
    ///
    /// # Errors
    /// Returns an error if the node is not a variable of this server's namespaces.
    pub fn show_value(&self, node: &NodeId, value: DataValue) -> Result<(), StatusCode> {
        self.show_all(vec![(node.clone(), value)])
    }

    /// Sets the values of several variables atomically.
    ///
    /// # Errors
    /// Returns an error if a node is not a variable of this server's namespaces. No value is set in
    /// this case.
    pub fn show_all(&self, values: Vec<(NodeId, DataValue)>) -> Result<(), StatusCode> {
        let subscriptions = self.inner.handle.subscriptions();
        nodes::show(self.inner.spaces.own(), subscriptions, values)
    }

    /// Returns the value of a variable.
    #[must_use]
    pub fn value(&self, node: &NodeId) -> Option<DataValue> {
        self.variable_facts(node).map(|facts| facts.value)
    }

    /// Sets whether clients may write a variable.
    ///
    /// # Errors
    /// Returns an error if the node is not a variable of this server's namespaces.
    pub fn set_writable(&self, node: &NodeId, writable: bool) -> Result<(), StatusCode> {
        let mut own = self.inner.spaces.own().write();
        match own.find_mut(node) {
            Some(NodeType::Variable(variable)) => {
                instances::set_writable(variable, writable);
                Ok(())
            }
            Some(_) => Err(StatusCode::BadAttributeIdInvalid),
            None => Err(StatusCode::BadNodeIdUnknown),
        }
    }

    /// Sets the Executable attributes of a method. Calls still reach its handler.
    ///
    /// # Errors
    /// Returns an error if the node is not a method of this server's namespaces.
    pub fn set_executable(&self, method: &NodeId, executable: bool) -> Result<(), StatusCode> {
        let attributes = [AttributeId::Executable, AttributeId::UserExecutable];
        self.inner.manager.set_attributes(
            self.inner.handle.subscriptions(),
            attributes
                .iter()
                .map(|attribute| (method, *attribute, Variant::from(executable))),
        )
    }

    /// Sets the handler that decides on client writes to a variable. Without a handler, written
    /// values are accepted.
    pub fn on_write(&self, node: &NodeId, handler: Arc<dyn WriteHandler>) {
        self.inner.manager.inner().on_write(node, handler);
    }

    /// Sets the handler of a method of an object. Without a handler, calls fail with
    /// `BadNotImplemented`.
    pub fn on_call(&self, object: &NodeId, method: &NodeId, handler: Arc<dyn MethodHandler>) {
        self.inner.calls.handle(object, method, handler);
    }

    /// Registers a callback for the end of sessions that called or wrote something, by closing or
    /// by timeout. It runs before the next call or write is answered, and must not block.
    pub fn on_session_closed(&self, told: impl Fn(u32) + Send + Sync + 'static) {
        self.inner.calls.sessions.tell(Arc::new(told));
    }

    /// Sends changes of nodes to the subscribers of the Server object.
    pub fn tell_changes(&self, changes: &[ModelChange]) {
        changes::tell(self.inner.handle.subscriptions(), changes);
    }

    /// Raises an event on its source and on the Server object.
    pub fn raise(&self, event: &TransitionEvent) {
        let types = self.inner.spaces.with(|view| {
            let supertypes = view.supertypes(&event.event_type);
            events::answered(&event.event_type, supertypes)
        });
        let id: ByteString = opcua::crypto::random::byte_string(16);
        let raised = events::Raised::new(event, types, id);
        let subscriptions = self.inner.handle.subscriptions();
        // The notification also reaches the subscribers of the Server object.
        subscriptions
            .notify_events([(&raised as &dyn opcua::nodes::Event, &event.source)].into_iter());
    }
}

/// Returns the value of a variable with its timestamps.
#[must_use]
pub fn value_of(variable: &Variable) -> DataValue {
    variable.value(
        TimestampsToReturn::Both,
        &NumericRange::None,
        &DataEncoding::Binary,
        0.0,
    )
}

/// Interval of checking rejected certificates and users.
const LOOK_AT_REJECTED: Duration = Duration::from_secs(1);
/// Longest duration of stopping.
pub const LONGEST_STOP: Duration = Duration::from_secs(2);
