//! Browsing in the order of the mapping. The address space of the server keeps references
//! unordered.

use std::sync::Arc;

use async_trait::async_trait;
use opcua::nodes::{DefaultTypeTree, ReferenceDirection, TypeTree};
use opcua::server::CreateMonitoredItem;
use opcua::server::address_space::AddressSpace;
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{
    InMemoryNodeManagerBuilder, InMemoryNodeManagerImplBuilder,
};
use opcua::server::node_manager::{
    AddReferenceResult, BrowseNode, BrowsePathItem, DynNodeManager, ExternalReference,
    ExternalReferenceRequest, HistoryNode, MethodCall, MonitoredItemRef, MonitoredItemUpdateRef,
    NodeManager, NodeManagerBuilder as _, ReadNode, RequestContext, ServerContext, WriteNode,
};
use opcua::types::{
    BrowseDirection, ExpandedNodeId, MonitoringMode, NodeId, ReadAtTimeDetails, ReadEventDetails,
    ReadProcessedDetails, ReadRawModifiedDetails, ReferenceDescription, ReferenceTypeId,
    StatusCode, TimestampsToReturn,
};
use plant_opcua::server::{NodeFacts, Supplement};
use plant_opcua::users::UserAccess;

use crate::auditing;
use crate::nodes::{SpaceManager, SpaceNodes};

/// The node manager of the space. It returns the children of folders and variables in the order of
/// the mapping.
pub(crate) struct Ordered {
    inner: Arc<DynNodeManager>,
    /// The attributes of permissions.
    supplement: Supplement,
}

/// The remaining references of a browse, in reverse order.
struct Rest(Vec<ReferenceDescription>);

impl Ordered {
    /// Builds the node manager of `nodes` and wraps it.
    pub(crate) fn around<N>(
        nodes: N,
        access: &Arc<UserAccess>,
    ) -> impl FnOnce(ServerContext) -> Self + use<N>
    where
        N: InMemoryNodeManagerImplBuilder<Impl = SpaceNodes> + 'static,
    {
        let supplement = Supplement::new(Vec::new(), Some(Arc::clone(access)));
        |context| Self {
            inner: Box::new(InMemoryNodeManagerBuilder::new(nodes)).build(context),
            supplement,
        }
    }

    /// Adds the nodes of the PubSub readers before a client sees that they are missing.
    fn look_for_readers<'n>(&self, nodes: impl Iterator<Item = &'n NodeId>) {
        if let Some(space) = self.space() {
            space.inner().pubsub().look_for_readers(nodes);
        }
    }

    /// Returns the wrapped node manager.
    pub(crate) fn space(&self) -> Option<Arc<SpaceManager>> {
        Arc::clone(&self.inner).into_any_arc().downcast().ok()
    }
}

/// Browses a node with ordered children.
fn browse(
    space: &SpaceManager,
    address_space: &AddressSpace,
    type_tree: &dyn TypeTree,
    node: &mut BrowseNode,
) {
    node.set_status(StatusCode::Good);
    let mut rest = match node.take_continuation_point::<Rest>() {
        Some(rest) => rest.0,
        None => {
            let mut found = references(space, address_space, type_tree, node);
            found.sort_by_key(|(rank, _)| std::cmp::Reverse(*rank));
            found.into_iter().map(|(_, reference)| reference).collect()
        }
    };
    while let Some(reference) = rest.pop() {
        if let AddReferenceResult::Full(reference) = node.add(type_tree, reference) {
            rest.push(reference);
            break;
        }
    }
    if !rest.is_empty() {
        node.set_next_continuation_point(Box::new(Rest(rest)));
    }
}

/// Returns the references of a node with the ranks of their targets. References to nodes outside
/// this address space are left to the server.
fn references(
    space: &SpaceManager,
    address_space: &AddressSpace,
    type_tree: &dyn TypeTree,
    node: &mut BrowseNode,
) -> Vec<(usize, ReferenceDescription)> {
    let source = node.node_id().clone();
    let filter = match node.reference_type_id().as_reference_type_id() {
        Ok(wanted) if !node.reference_type_id().is_null() => {
            Some((wanted, node.include_subtypes()))
        }
        Ok(_) | Err(_) => None,
    };
    let direction = node.browse_direction();
    let mut found = Vec::new();
    for reference in address_space.find_references(&source, filter, type_tree, direction) {
        let Some(target) = address_space.find(reference.target_node) else {
            node.push_external_reference(ExternalReference::new(
                reference.target_node.into(),
                reference.reference_type.clone(),
                reference.direction,
            ));
            continue;
        };
        let rank = space.inner().rank(reference.target_node);
        let forward = matches!(reference.direction, ReferenceDirection::Forward);
        let target = target.as_node();
        found.push((
            rank,
            ReferenceDescription {
                reference_type_id: reference.reference_type.clone(),
                is_forward: forward,
                node_id: ExpandedNodeId::new(target.node_id().clone()),
                browse_name: target.browse_name().clone(),
                display_name: target.display_name().clone(),
                node_class: target.node_class(),
                type_definition: type_definition(address_space, type_tree, target.node_id()),
            },
        ));
    }
    found
}

fn type_definition(
    address_space: &AddressSpace,
    type_tree: &dyn TypeTree,
    node: &NodeId,
) -> ExpandedNodeId {
    let filter = Some((ReferenceTypeId::HasTypeDefinition, false));
    let mut found =
        address_space.find_references(node, filter, type_tree, BrowseDirection::Forward);
    found.next().map_or_else(ExpandedNodeId::null, |found| {
        ExpandedNodeId::new(found.target_node.clone())
    })
}

#[async_trait]
impl NodeManager for Ordered {
    fn owns_node(&self, id: &NodeId) -> bool {
        self.inner.owns_node(id)
    }

    fn name(&self) -> &str {
        self.inner.name()
    }

    fn namespaces_for_user(&self, context: &RequestContext) -> Vec<NamespaceMetadata> {
        self.inner.namespaces_for_user(context)
    }

    async fn init(&self, type_tree: &mut DefaultTypeTree, context: ServerContext) {
        self.inner.init(type_tree, context).await;
    }

    async fn resolve_external_references(
        &self,
        context: &RequestContext,
        items: &mut [&mut ExternalReferenceRequest],
    ) {
        self.inner.resolve_external_references(context, items).await;
    }

    async fn browse(
        &self,
        context: &RequestContext,
        nodes_to_browse: &mut [BrowseNode],
    ) -> Result<(), StatusCode> {
        let Some(space) = self.space() else {
            return self.inner.browse(context, nodes_to_browse).await;
        };
        let browsed = nodes_to_browse.iter().map(BrowseNode::node_id);
        space.inner().pubsub().look_for_readers(browsed);
        for node in nodes_to_browse {
            if space.inner().has_order(node.node_id()) {
                let address_space = space.address_space().read();
                let type_tree = context.type_tree.read();
                browse(&space, &address_space, &*type_tree, node);
            } else {
                let alone = std::slice::from_mut(node);
                self.inner.browse(context, alone).await?;
            }
        }
        Ok(())
    }

    #[expect(
        elided_lifetimes_in_paths,
        reason = "written out it is another one than the trait's"
    )]
    async fn translate_browse_paths_to_node_ids(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut BrowsePathItem],
    ) -> Result<(), StatusCode> {
        self.look_for_readers(nodes.iter().map(|item| item.node_id()));
        let inner = &self.inner;
        inner
            .translate_browse_paths_to_node_ids(context, nodes)
            .await
    }

    async fn read(
        &self,
        context: &RequestContext,
        max_age: f64,
        timestamps_to_return: TimestampsToReturn,
        nodes_to_read: &mut [&mut ReadNode],
    ) -> Result<(), StatusCode> {
        self.look_for_readers(nodes_to_read.iter().map(|node| &node.node().node_id));
        let inner = &self.inner;
        inner
            .read(context, max_age, timestamps_to_return, nodes_to_read)
            .await?;
        if let Some(space) = self.space() {
            let facts = |node: &_| NodeFacts::find(&space.address_space().read(), node);
            self.supplement
                .complete(context, timestamps_to_return, nodes_to_read, facts);
        }
        Ok(())
    }

    async fn history_read_raw_modified(
        &self,
        context: &RequestContext,
        details: &ReadRawModifiedDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        let inner = &self.inner;
        inner
            .history_read_raw_modified(context, details, nodes, wanted)
            .await
    }

    async fn history_read_at_time(
        &self,
        context: &RequestContext,
        details: &ReadAtTimeDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        let inner = &self.inner;
        inner
            .history_read_at_time(context, details, nodes, wanted)
            .await
    }

    /// Reads processed history. `details` has an aggregate for each node, but the inner node
    /// manager does not know which nodes of the request it receives. The nodes are therefore passed
    /// individually, or all together if their aggregates are equal.
    async fn history_read_processed(
        &self,
        context: &RequestContext,
        details: &ReadProcessedDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        let inner = &self.inner;
        let kinds = details.aggregate_type.as_deref().unwrap_or_default();
        let Some((first, others)) = kinds.split_first() else {
            return Err(StatusCode::BadAggregateListMismatch);
        };
        if others.iter().all(|kind| kind == first) && kinds.len() >= nodes.len() {
            return inner
                .history_read_processed(context, details, nodes, wanted)
                .await;
        }
        if kinds.len() != nodes.len() {
            return Err(StatusCode::BadAggregateListMismatch);
        }
        for (node, kind) in nodes.chunks_mut(1).zip(kinds) {
            let details = ReadProcessedDetails {
                aggregate_type: Some(vec![kind.clone()]),
                ..details.clone()
            };
            inner
                .history_read_processed(context, &details, node, wanted)
                .await?;
        }
        Ok(())
    }

    async fn history_read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        let inner = &self.inner;
        inner
            .history_read_events(context, details, nodes, wanted)
            .await
    }

    async fn write(
        &self,
        context: &RequestContext,
        nodes_to_write: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        let Some(space) = self.space() else {
            return self.inner.write(context, nodes_to_write).await;
        };
        let before = auditing::before(&space, nodes_to_write);
        let done = self.inner.write(context, nodes_to_write).await;
        auditing::wrote(context, before, (nodes_to_write, done));
        done
    }

    async fn create_monitored_items(
        &self,
        context: &RequestContext,
        items: &mut [&mut CreateMonitoredItem],
    ) -> Result<(), StatusCode> {
        self.look_for_readers(items.iter().map(|item| &item.item_to_monitor().node_id));
        self.inner.create_monitored_items(context, items).await
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

    async fn call(
        &self,
        context: &RequestContext,
        methods_to_call: &mut [&mut MethodCall],
    ) -> Result<(), StatusCode> {
        self.look_for_readers(methods_to_call.iter().map(|call| call.object_id()));
        let done = self.inner.call(context, methods_to_call).await;
        auditing::called(context, (methods_to_call, done));
        done
    }
}
