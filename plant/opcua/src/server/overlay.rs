//! Methods of objects of the core namespace. The library has their nodes, but implements few of the
//! methods.

use std::sync::Arc;

use opcua::nodes::{NodeType, ReferenceDirection};
use opcua::server::node_manager::memory::CoreNodeManager;
use opcua::server::node_manager::{MethodCall, RequestContext};
use opcua::types::{Argument, BrowseDirection, NodeId, ReferenceTypeId, StatusCode};
use tokio::time::Instant;

use super::address_spaces::arguments;
use super::calls::{self, MethodHandler, MethodRefusal, MethodRequest, check_arguments, within};
use super::sessions::{SessionCaller, SessionPresence};
use super::supplement::NodeFacts;
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

/// The methods, and the address space with their declarations.
pub(crate) struct Overlay {
    pub(crate) methods: Vec<CoreMethod>,
    pub(crate) core: Option<Arc<CoreNodeManager>>,
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
            arguments(node).ok_or(StatusCode::BadInternalError)
        })
    }
}
