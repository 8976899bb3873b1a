//! Methods of objects of the core namespace. The library has their nodes, but implements few of the
//! methods.

use std::sync::Arc;

use opcua::nodes::{NodeType, ReferenceDirection};
use opcua::server::ServerHandle;
use opcua::server::address_space::AddressSpace;
use opcua::server::node_manager::memory::{
    CoreNodeManager, CoreNodeManagerBuilder, InMemoryNodeManagerBuilder,
};
use opcua::server::node_manager::{
    DynNodeManager, MethodCall, NodeManagerBuilder, RequestContext, ServerContext,
};
use opcua::types::{Argument, BrowseDirection, NodeId, ReferenceTypeId, StatusCode};
use tokio::time::Instant;

use super::calls::{self, MethodHandler, MethodRefusal, MethodRequest, check_arguments, within};
use super::routed::{Front, Routed};
use super::sessions::{SessionCaller, SessionPresence};
use super::supplement::{NodeFacts, Supplement};
use crate::audit::{Audit, AuditedAction};
use crate::limits::LONGEST_REQUEST;

/// A method of an object of the core namespace, and its handler.
#[derive(Clone)]
pub struct CoreMethod {
    /// `None` for every object of the type of the method.
    object: Option<NodeId>,
    /// The method node of the object and the method nodes of its types.
    methods: Vec<NodeId>,
    name: String,
    handler: Arc<dyn MethodHandler>,
    audit: fn(&MethodCall) -> AuditedAction,
}

impl CoreMethod {
    /// Creates the method `name` of `object`. `methods[0]` is its own node, the further nodes are
    /// declarations of its types.
    pub fn new(
        object: impl Into<NodeId>,
        methods: impl IntoIterator<Item = NodeId>,
        name: &str,
        handler: Arc<dyn MethodHandler>,
    ) -> Self {
        Self {
            object: Some(object.into()),
            methods: methods.into_iter().collect(),
            name: name.to_owned(),
            handler,
            audit: called,
        }
    }

    /// Creates the method `name` of a type for all objects, also of other namespaces. The handler
    /// checks the object.
    #[must_use]
    pub fn of_type(method: NodeId, name: &str, handler: Arc<dyn MethodHandler>) -> Self {
        Self {
            object: None,
            methods: vec![method],
            name: name.to_owned(),
            handler,
            audit: called,
        }
    }

    /// Sets the action by which calls are audited.
    #[must_use]
    pub fn audited(self, audit: fn(&MethodCall) -> AuditedAction) -> Self {
        Self { audit, ..self }
    }

    fn is(&self, call: &MethodCall) -> bool {
        let is_of = self
            .object
            .as_ref()
            .is_none_or(|object| object == call.object_id());
        is_of && self.methods.contains(call.method_id())
    }
}

fn called(call: &MethodCall) -> AuditedAction {
    AuditedAction::Called {
        object: call.object_id().clone(),
        method: call.method_id().clone(),
    }
}

/// Builds the node manager of the core namespace with handlers for methods. `prepared` edits its
/// nodes. The library returns its own values for some variables, whatever their nodes contain; the
/// values of `supplement` replace them.
#[must_use]
pub fn core_with(
    methods: Vec<CoreMethod>,
    supplement: Supplement,
    prepared: impl FnOnce(&mut AddressSpace) + Send + 'static,
) -> impl NodeManagerBuilder + 'static {
    move |context: ServerContext| {
        let inner = Box::new(InMemoryNodeManagerBuilder::new(CoreNodeManagerBuilder));
        let inner: Arc<DynNodeManager> = inner.build(context);
        let core: Option<Arc<CoreNodeManager>> = Arc::clone(&inner).into_any_arc().downcast().ok();
        if let Some(core) = &core {
            prepared(&mut core.address_space().write());
        }
        Routed {
            inner,
            front: Front::Core(Arc::new(Overlay { methods, core })),
            last: None,
            supplement,
        }
    }
}

/// Returns the node manager of the core namespace of a server that was built with [`core_with`].
#[must_use]
pub fn core_of(handle: &ServerHandle) -> Option<Arc<CoreNodeManager>> {
    let routed = handle.node_managers().get_of_type::<Routed>()?;
    match &routed.front {
        Front::Core(overlay) => overlay.core.clone(),
        Front::Calls(_) => None,
    }
}

/// The methods, and the address space with their declarations.
pub(crate) struct Overlay {
    methods: Vec<CoreMethod>,
    core: Option<Arc<CoreNodeManager>>,
}

impl Overlay {
    /// Returns the facts of a node of the core namespace.
    pub(crate) fn facts(&self, node: &NodeId) -> Option<NodeFacts> {
        NodeFacts::find(&self.core.as_ref()?.address_space().read(), node)
    }

    /// Executes the calls of these methods sequentially, and returns all other calls.
    pub(crate) async fn answer<'a>(
        &self,
        context: &RequestContext,
        methods: &'a mut [&mut MethodCall],
    ) -> Vec<&'a mut MethodCall> {
        let mut others = Vec::new();
        let end = Instant::now() + LONGEST_REQUEST;
        for call in methods {
            let call: &'a mut MethodCall = call;
            let Some(method) = self.methods.iter().find(|method| method.is(call)) else {
                others.push(call);
                continue;
            };
            let ended = match self.check(context, method, call) {
                Ok(request) => within(end, method.handler.call(request)).await,
                Err(refusal) => Err(refusal),
            };
            calls::end(call, ended);
            let action = (method.audit)(call);
            Audit::of(context, action, call.status()).tell(&context.subscriptions);
        }
        others
    }

    fn check(
        &self,
        context: &RequestContext,
        method: &CoreMethod,
        call: &MethodCall,
    ) -> Result<MethodRequest, MethodRefusal> {
        let own = method.methods.first().unwrap_or_else(|| call.method_id());
        let allowed = context
            .authenticator
            .is_user_executable(&context.token, own);
        if !allowed {
            return Err(MethodRefusal::Status(StatusCode::BadUserAccessDenied));
        }
        let declared = self.input_arguments(context, own)?;
        let types = context.type_tree.read();
        check_arguments(&declared, call.arguments(), &*types)?;
        Ok(MethodRequest {
            caller: SessionCaller::of(context),
            presence: SessionPresence::of(context),
            object: call.object_id().clone(),
            method: own.clone(),
            name: method.name.clone(),
            arguments: call.arguments().to_vec(),
        })
    }

    fn input_arguments(
        &self,
        context: &RequestContext,
        method: &NodeId,
    ) -> Result<Vec<Argument>, StatusCode> {
        let Some(core) = &self.core else {
            return Err(StatusCode::BadInternalError);
        };
        let address_space = core.address_space().read();
        let types = context.type_tree.read();
        let filter = Some((ReferenceTypeId::HasProperty, false));
        let properties =
            address_space.find_references(method, filter, &*types, BrowseDirection::Forward);
        let nodes = properties
            .filter(|reference| matches!(reference.direction, ReferenceDirection::Forward))
            .filter_map(|reference| address_space.find(reference.target_node));
        let mut inputs = nodes.filter(|node: &&NodeType| {
            node.as_node().browse_name().name.as_ref() == "InputArguments"
        });
        inputs.next().map_or(Ok(Vec::new()), |node| {
            calls::arguments(node).ok_or(StatusCode::BadInternalError)
        })
    }
}
