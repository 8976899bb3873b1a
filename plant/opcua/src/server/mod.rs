//! A server whose nodes are instances of the types of NodeSets.
//!
//! Reading order: `build` (from a configuration to a server), `view` (all nodes as one), `instances` (nodes from types), `methods` (without types),
//! `nodes` (values and writes), `calls` and `routed` (methods), `overlay` (methods of the core namespace), `sessions`,
//! `events`.

mod build;
mod calls;
mod events;
mod instances;
mod methods;
mod nodes;
mod overlay;
mod routed;
mod sessions;
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

pub use self::build::{Security, ServerBuilder, ServerConfig, ServerError};
pub use self::calls::{MethodHandler, MethodRequest, Refusal, arguments_in, method};
pub use self::events::{StateRef, TransitionEvent};
pub use self::instances::{
    IdRange, Instance, InstanceError, InstanceSpec, ObjectSpec, VariableSpec,
};
pub use self::methods::MethodSpec;
pub use self::nodes::{WriteHandler, WriteRequest, write};
pub use self::overlay::{CoreMethod, core_of, core_with};
pub(crate) use self::sessions::ANONYMOUS;
pub use self::sessions::{Caller, Presence};
pub use self::view::Child;
pub use crate::endpoint::EndpointUrl;

use self::calls::Calls;
use self::nodes::{Nodes, Spaces};
use crate::changes::{self, ModelChange};
use crate::door::Door;
use crate::pki::Pki;
use crate::users::Access;

/// What is known of a variable, or of a variable in a type.
#[derive(Debug, Clone)]
pub struct VariableFacts {
    /// Its DataType.
    pub data_type: NodeId,
    /// Its ValueRank.
    pub value_rank: i32,
    /// What it shows.
    pub value: DataValue,
    /// Its Description; null without one.
    pub description: LocalizedText,
}

/// A server. Clones are handles to the same one; it stops when the last is dropped.
#[derive(Clone)]
pub struct Server {
    inner: Arc<Inner>,
}

struct Inner {
    handle: ServerHandle,
    manager: Arc<InMemoryNodeManager<Nodes>>,
    spaces: Arc<Spaces>,
    calls: Arc<Calls>,
    application_uri: String,
    url: String,
    port: u16,
    /// One at a time makes or removes nodes.
    making: Mutex<()>,
    /// Until it is started.
    waiting: Mutex<Option<Waiting>>,
    running: Mutex<Vec<JoinHandle<()>>>,
}

/// What serves when it is started.
struct Waiting {
    server: opcua::server::Server,
    listener: TcpListener,
    pki: Option<Pki>,
    /// Where clients come to first, if the server listens for that alone.
    door: Option<(Door, TcpListener)>,
    users: Option<Arc<Access>>,
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.handle.cancel();
        // The one that serves ends by itself, and closes its connections.
        for task in self.running.lock().drain(..).skip(1) {
            task.abort();
        }
    }
}

impl Server {
    /// Serves clients from now on. The second time does nothing.
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
                error!(error, "the OPC UA server has ended");
            }
        });
        let sessions = Arc::clone(&self.inner.calls.sessions);
        let looking = tokio::spawn(async move {
            let mut look = tokio::time::interval(sessions::LOOK);
            look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
            for looks in 1_u64.. {
                look.tick().await;
                sessions.look();
                if !looks.is_multiple_of(LOOKS_AT_REJECTED) {
                    continue;
                }
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

    /// Where clients connect, as the server tells them.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.inner.url
    }

    /// The port that is listened on.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.inner.port
    }

    /// The ApplicationUri, which is the namespace with index 1 too.
    #[must_use]
    pub fn application_uri(&self) -> &str {
        &self.inner.application_uri
    }

    /// The index of a namespace.
    #[must_use]
    pub fn namespace(&self, uri: &str) -> Option<u16> {
        self.inner.handle.get_namespace_index(uri)
    }

    /// The URIs of the namespaces, by their indexes.
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

    /// The BrowseName of a node, also of one of the core namespace.
    #[must_use]
    pub fn browse_name(&self, node: &NodeId) -> Option<QualifiedName> {
        let spaces = &self.inner.spaces;
        spaces.with(|view| Some(view.node(node)?.as_node().browse_name().clone()))
    }

    /// A type by its namespace and BrowseName.
    #[must_use]
    pub fn find_type(&self, namespace_uri: &str, browse_name: &str) -> Option<NodeId> {
        let index = self.namespace(namespace_uri)?;
        self.inner
            .spaces
            .with(|view| view.find_type(index, browse_name))
    }

    /// The supertypes of a type, nearest first, without itself.
    #[must_use]
    pub fn supertypes(&self, type_id: &NodeId) -> Vec<NodeId> {
        let spaces = &self.inner.spaces;
        spaces.with(|view| view.supertypes(type_id).into_iter().cloned().collect())
    }

    /// Whether a type is another one or a subtype of it.
    #[must_use]
    pub fn is_subtype_of(&self, type_id: &NodeId, base: &NodeId) -> bool {
        self.inner
            .spaces
            .with(|view| view.is_subtype_of(type_id, base))
    }

    /// What is directly below a node, in no order that means anything.
    #[must_use]
    pub fn children(&self, node: &NodeId) -> Vec<Child> {
        self.inner.spaces.with(|view| view.children(node))
    }

    /// What is known of a variable.
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

    /// Shows a value with the time now.
    ///
    /// # Errors
    /// The node is no variable of ours.
    pub fn show(&self, node: &NodeId, value: impl Into<Variant>) -> Result<(), StatusCode> {
        self.show_value(node, DataValue::new_now(value.into()))
    }

    /// Shows a value; status and times that are missing are Good and now.
    ///
    /// # Errors
    /// The node is no variable of ours.
    pub fn show_value(&self, node: &NodeId, value: DataValue) -> Result<(), StatusCode> {
        self.show_all(vec![(node.clone(), value)])
    }

    /// Shows several values, which clients see either all or none of.
    ///
    /// # Errors
    /// One of the nodes is no variable of ours; none is shown then.
    pub fn show_all(&self, values: Vec<(NodeId, DataValue)>) -> Result<(), StatusCode> {
        let subscriptions = self.inner.handle.subscriptions();
        nodes::show(self.inner.spaces.own(), subscriptions, values)
    }

    /// What a variable shows.
    #[must_use]
    pub fn value(&self, node: &NodeId) -> Option<DataValue> {
        self.variable_facts(node).map(|facts| facts.value)
    }

    /// Lets clients write a variable or not.
    ///
    /// # Errors
    /// The node is no variable of ours.
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

    /// Shows whether a method can be called now. Its handler is asked all the same.
    ///
    /// # Errors
    /// The node is no method of ours.
    pub fn set_executable(&self, method: &NodeId, executable: bool) -> Result<(), StatusCode> {
        let attributes = [AttributeId::Executable, AttributeId::UserExecutable];
        self.inner.manager.set_attributes(
            self.inner.handle.subscriptions(),
            attributes
                .iter()
                .map(|attribute| (method, *attribute, Variant::from(executable))),
        )
    }

    /// Asks a handler before a value is shown that a client writes. Without one what is written is shown.
    pub fn on_write(&self, node: &NodeId, handler: Arc<dyn WriteHandler>) {
        self.inner.manager.inner().on_write(node, handler);
    }

    /// Carries out a method of an object. Without a handler it answers `BadNotImplemented`.
    pub fn on_call(&self, object: &NodeId, method: &NodeId, handler: Arc<dyn MethodHandler>) {
        self.inner.calls.handle(object, method, handler);
    }

    /// Tells of each session that has called or written something and is closed now or has expired. It is told from a
    /// task of the server, which waits for it.
    pub fn on_session_closed(&self, told: impl Fn(u32) + Send + Sync + 'static) {
        self.inner.calls.sessions.tell(Arc::new(told));
    }

    /// Tells who watches the Server object which nodes are others than before.
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
        // Who watches the Server object is told by the same.
        subscriptions
            .notify_events([(&raised as &dyn opcua::nodes::Event, &event.source)].into_iter());
    }
}

/// What a variable shows, with its times.
#[must_use]
pub fn value_of(variable: &Variable) -> DataValue {
    variable.value(
        TimestampsToReturn::Both,
        &NumericRange::None,
        &DataEncoding::Binary,
        0.0,
    )
}

/// How many looks at sessions there are to one at refused certificates and users.
const LOOKS_AT_REJECTED: u64 = 20;
/// How long stopping may take.
pub const LONGEST_STOP: Duration = Duration::from_secs(2);
