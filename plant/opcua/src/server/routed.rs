//! A node manager that wraps another node manager, and intercepts method calls on instances.
//!
//! The library routes a call by the namespace of the method, and requires that the object has
//! exactly this method. Clients may instead pass the method of the object's type (OPC 10000-4,
//! 5.12.2.2), which for programs is in the core namespace. Therefore both node managers are
//! wrapped: the node manager of the core namespace and the node manager of the other namespaces.

use std::sync::Arc;

use async_trait::async_trait;
use opcua::nodes::DefaultTypeTree;
use opcua::server::address_space::AddressSpace;
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{
    CoreNodeManager, CoreNodeManagerBuilder, InMemoryNodeManagerBuilder,
};
use opcua::server::node_manager::{
    AddNodeItem, AddReferenceItem, BrowseNode, BrowsePathItem, DeleteNodeItem, DeleteReferenceItem,
    DynNodeManager, ExternalReferenceRequest, HistoryNode, HistoryUpdateNode, MethodCall,
    MonitoredItemRef, MonitoredItemUpdateRef, NodeManager, NodeManagerBuilder, QueryRequest,
    ReadNode, RegisterNodeItem, RequestContext, ServerContext, WriteNode,
};
use opcua::server::{CreateMonitoredItem, ServerHandle};
use opcua::types::{
    ExpandedNodeId, MonitoringMode, NodeId, ReadAnnotationDataDetails, ReadAtTimeDetails,
    ReadEventDetails, ReadProcessedDetails, ReadRawModifiedDetails, StatusCode, TimestampsToReturn,
};

use super::address_spaces::AddressSpaces;
use super::calls::MethodCalls;
use super::overlay::{CoreMethod, Overlay};
use super::supplement::{NodeFacts, Supplement};

pub(crate) struct Routed {
    pub(crate) inner: Arc<DynNodeManager>,
    pub(crate) front: Front,
    /// Set for the last node manager, which is initialized after all types exist.
    pub(crate) last: Option<Arc<AddressSpaces>>,
    pub(crate) supplement: Supplement,
}

impl Routed {
    fn facts(&self, node: &NodeId) -> Option<NodeFacts> {
        match &self.front {
            Front::Core(overlay) => overlay.facts(node),
            Front::Calls(calls) => {
                let spaces = calls.spaces.get()?;
                spaces.with(|view| view.node(node).map(NodeFacts::of))
            }
        }
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

/// The handler of calls before the library.
pub(crate) enum Front {
    /// Handles the methods of instances.
    Calls(Arc<MethodCalls>),
    /// Handles the methods of objects of the core namespace.
    Core(Arc<Overlay>),
}

type Done = Result<(), StatusCode>;

#[expect(
    elided_lifetimes_in_paths,
    reason = "the trait omits them and must be matched exactly"
)]
#[async_trait]
impl NodeManager for Routed {
    fn owns_node(&self, id: &NodeId) -> bool {
        self.inner.owns_node(id)
    }

    fn name(&self) -> &str {
        self.inner.name()
    }

    fn owns_server_events(&self) -> bool {
        self.supplement.has_events() || self.inner.owns_server_events()
    }

    fn handle_new_node(&self, parent_id: &ExpandedNodeId) -> bool {
        self.inner.handle_new_node(parent_id)
    }

    fn namespaces_for_user(&self, context: &RequestContext) -> Vec<NamespaceMetadata> {
        self.inner.namespaces_for_user(context)
    }

    async fn init(&self, type_tree: &mut DefaultTypeTree, context: ServerContext) {
        self.inner.init(type_tree, context).await;
        if let Some(spaces) = &self.last {
            spaces.inherit_event_fields(type_tree);
        }
    }

    async fn resolve_external_references(
        &self,
        context: &RequestContext,
        items: &mut [&mut ExternalReferenceRequest],
    ) {
        self.inner.resolve_external_references(context, items).await;
    }

    async fn read(
        &self,
        context: &RequestContext,
        max_age: f64,
        timestamps: TimestampsToReturn,
        nodes: &mut [&mut ReadNode],
    ) -> Done {
        self.inner.read(context, max_age, timestamps, nodes).await?;
        self.supplement
            .complete(context, timestamps, nodes, |node| self.facts(node));
        Ok(())
    }

    async fn history_read_raw_modified(
        &self,
        context: &RequestContext,
        details: &ReadRawModifiedDetails,
        nodes: &mut [&mut HistoryNode],
        timestamps: TimestampsToReturn,
    ) -> Done {
        self.inner
            .history_read_raw_modified(context, details, nodes, timestamps)
            .await
    }

    async fn history_read_processed(
        &self,
        context: &RequestContext,
        details: &ReadProcessedDetails,
        nodes: &mut [&mut HistoryNode],
        timestamps: TimestampsToReturn,
    ) -> Done {
        self.inner
            .history_read_processed(context, details, nodes, timestamps)
            .await
    }

    async fn history_read_at_time(
        &self,
        context: &RequestContext,
        details: &ReadAtTimeDetails,
        nodes: &mut [&mut HistoryNode],
        timestamps: TimestampsToReturn,
    ) -> Done {
        self.inner
            .history_read_at_time(context, details, nodes, timestamps)
            .await
    }

    async fn history_read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        nodes: &mut [&mut HistoryNode],
        timestamps: TimestampsToReturn,
    ) -> Done {
        let done = self
            .inner
            .history_read_events(context, details, nodes, timestamps)
            .await;
        if let Err(status) = done {
            for node in nodes.iter_mut() {
                node.set_status(status);
            }
        }
        self.supplement.read_events(context, details, nodes);
        Ok(())
    }

    async fn history_read_annotations(
        &self,
        context: &RequestContext,
        details: &ReadAnnotationDataDetails,
        nodes: &mut [&mut HistoryNode],
        timestamps: TimestampsToReturn,
    ) -> Done {
        self.inner
            .history_read_annotations(context, details, nodes, timestamps)
            .await
    }

    async fn write(&self, context: &RequestContext, nodes: &mut [&mut WriteNode]) -> Done {
        self.inner.write(context, nodes).await
    }

    async fn history_update(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut HistoryUpdateNode],
    ) -> Done {
        self.inner.history_update(context, nodes).await
    }

    async fn browse(&self, context: &RequestContext, nodes: &mut [BrowseNode]) -> Done {
        self.inner.browse(context, nodes).await
    }

    async fn translate_browse_paths_to_node_ids(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut BrowsePathItem],
    ) -> Done {
        self.inner
            .translate_browse_paths_to_node_ids(context, nodes)
            .await
    }

    async fn register_nodes(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut RegisterNodeItem],
    ) -> Done {
        self.inner.register_nodes(context, nodes).await
    }

    async fn unregister_nodes(&self, context: &RequestContext, nodes: &[&NodeId]) -> Done {
        self.inner.unregister_nodes(context, nodes).await
    }

    async fn create_monitored_items(
        &self,
        context: &RequestContext,
        items: &mut [&mut CreateMonitoredItem],
    ) -> Done {
        self.inner.create_monitored_items(context, items).await?;
        self.supplement.begin(context, items);
        Ok(())
    }

    async fn modify_monitored_items(
        &self,
        context: &RequestContext,
        items: &[&MonitoredItemUpdateRef],
    ) {
        self.inner.modify_monitored_items(context, items).await;
    }

    async fn set_monitoring_mode(
        &self,
        context: &RequestContext,
        mode: MonitoringMode,
        items: &[&MonitoredItemRef],
    ) {
        self.inner.set_monitoring_mode(context, mode, items).await;
    }

    async fn delete_monitored_items(&self, context: &RequestContext, items: &[&MonitoredItemRef]) {
        self.inner.delete_monitored_items(context, items).await;
    }

    async fn query(&self, context: &RequestContext, request: &mut QueryRequest) -> Done {
        self.inner.query(context, request).await
    }

    async fn call(&self, context: &RequestContext, methods: &mut [&mut MethodCall]) -> Done {
        let mut others = match &self.front {
            Front::Calls(calls) => calls.answer(context, methods).await,
            Front::Core(overlay) => overlay.answer(context, methods).await,
        };
        if others.is_empty() {
            return Ok(());
        }
        let ended = self.inner.call(context, &mut others).await;
        if let Err(status) = ended {
            // Calls that have a result already keep it.
            for call in others {
                call.set_status(status);
            }
        }
        Ok(())
    }

    async fn add_nodes(&self, context: &RequestContext, nodes: &mut [&mut AddNodeItem]) -> Done {
        self.inner.add_nodes(context, nodes).await
    }

    async fn add_references(
        &self,
        context: &RequestContext,
        references: &mut [&mut AddReferenceItem],
    ) -> Done {
        self.inner.add_references(context, references).await
    }

    async fn delete_nodes(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut DeleteNodeItem],
    ) -> Done {
        self.inner.delete_nodes(context, nodes).await
    }

    async fn delete_node_references(&self, context: &RequestContext, nodes: &[&DeleteNodeItem]) {
        self.inner.delete_node_references(context, nodes).await;
    }

    async fn delete_references(
        &self,
        context: &RequestContext,
        references: &mut [&mut DeleteReferenceItem],
    ) -> Done {
        self.inner.delete_references(context, references).await
    }
}
