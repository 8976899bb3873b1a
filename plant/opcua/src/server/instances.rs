//! Instances of types (OPC 10000-3, 6.3): the mandatory children of a type, of its supertypes and
//! of its interfaces, and the selected optional children, each as declared by the most derived
//! type.

use std::collections::BTreeMap;

use opcua::nodes::{Base, EventNotifier, Method, Node, NodeType, Object, Variable};
use opcua::server::address_space::{AccessLevel, AddressSpace};
use opcua::types::{
    DataValue, LocalizedText, NodeClass, NodeId, ObjectId, QualifiedName, ReferenceTypeId,
    StatusCode, Variant,
};

use super::nodes::plain;
use super::view::{Declared, ServerView};
use super::{OpcUaServer, value_of};

/// The description of an instance.
#[derive(Debug, Clone)]
pub struct InstanceSpec {
    /// The type of the object.
    pub type_id: NodeId,
    /// The NodeId of the object.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// The parent node.
    pub parent: NodeId,
    /// The reference type from the parent, for example HasComponent.
    pub reference: NodeId,
    /// The paths of optional children, for example `ProgramDiagnostic` or `FinalResultData/Force`.
    pub optional: Vec<String>,
    /// The interfaces in addition to the interfaces of the type.
    pub interfaces: Vec<NodeId>,
    /// Whether clients can subscribe to its events. The Server object then has a HasNotifier
    /// reference to it.
    pub event_notifier: bool,
}

impl InstanceSpec {
    /// Creates the description of a component of `parent`.
    #[must_use]
    pub fn new(
        type_id: NodeId,
        node_id: NodeId,
        browse_name: QualifiedName,
        parent: NodeId,
    ) -> Self {
        Self {
            type_id,
            node_id,
            display_name: LocalizedText::from(browse_name.name.as_ref()),
            browse_name,
            parent,
            reference: ReferenceTypeId::HasComponent.into(),
            optional: Vec::new(),
            interfaces: Vec::new(),
            event_notifier: false,
        }
    }
}

/// An instance of a type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Instance {
    /// The NodeId of the object.
    pub node_id: NodeId,
    nodes: BTreeMap<String, NodeId>,
}

impl Instance {
    /// Returns a node below the instance by its path: BrowseNames without namespaces, joined by
    /// `/`.
    #[must_use]
    pub fn node(&self, path: &str) -> Option<&NodeId> {
        self.nodes.get(path)
    }

    /// Returns all nodes below the instance by their paths.
    pub fn nodes(&self) -> impl Iterator<Item = (&str, &NodeId)> {
        self.nodes.iter().map(|(path, id)| (path.as_str(), id))
    }
}

/// A range of ascending numeric NodeIds.
#[derive(Debug, Clone)]
pub struct IdRange {
    namespace: u16,
    next: u32,
}

impl IdRange {
    /// Creates a range that starts with `first`.
    #[must_use]
    pub fn new(namespace: u16, first: u32) -> Self {
        Self {
            namespace,
            next: first,
        }
    }

    /// Returns the next NodeId.
    #[expect(clippy::should_implement_trait, reason = "it never ends")]
    pub fn next(&mut self) -> NodeId {
        let id = NodeId::new(self.namespace, self.next);
        self.next = self.next.saturating_add(1);
        id
    }
}

/// The description of an object without children.
#[derive(Debug, Clone)]
pub struct ObjectSpec {
    /// The NodeId of the object.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// Its type definition, for example FolderType.
    pub type_definition: NodeId,
    /// The parent node.
    pub parent: NodeId,
    /// The reference type from the parent.
    pub reference: NodeId,
    /// Whether clients can subscribe to its events.
    pub event_notifier: bool,
}

/// The description of a variable without children.
#[derive(Debug, Clone)]
pub struct VariableSpec {
    /// The NodeId of the variable.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// Its type definition, for example PropertyType.
    pub type_definition: NodeId,
    /// The parent node.
    pub parent: NodeId,
    /// The reference type from the parent.
    pub reference: NodeId,
    /// Its DataType.
    pub data_type: NodeId,
    /// Its ValueRank.
    pub value_rank: i32,
    /// Its initial value.
    pub value: DataValue,
    /// Whether clients may write the value.
    pub writable: bool,
}

/// An error of creating nodes. No node is created in this case.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InstanceError {
    /// The type does not exist.
    #[error("unknown ObjectType {0}")]
    NoType(NodeId),
    /// The type is abstract and cannot have instances.
    #[error("{0} is abstract: only its subtypes have instances")]
    Abstract(NodeId),
    /// The interface does not exist.
    #[error("unknown interface {0}")]
    NoInterface(NodeId),
    /// The parent does not exist.
    #[error("the parent {0} does not exist")]
    NoParent(NodeId),
    /// The NodeId is not in a namespace for instances.
    #[error("{0} is not in a namespace for instances")]
    Foreign(NodeId),
    /// A node with this NodeId exists already.
    #[error("a node {0} already exists")]
    Taken(NodeId),
    /// The type is too deep or too large, or contains itself.
    #[error("{0} has more children than a server can have, or contains itself")]
    TooLarge(NodeId),
    /// No type declares a requested optional child.
    #[error("the type has no optional child {0}")]
    NoOptional(String),
}

/// A node that is about to be created.
struct Planned {
    path: String,
    parent: NodeId,
    reference: NodeId,
    /// The declarations of the node, under which a method can also be called.
    declared: Vec<NodeId>,
    type_definition: Option<NodeId>,
    node: NodeType,
}

impl OpcUaServer {
    /// Creates an instance of a type. `ids` returns the NodeId of each child by its path.
    ///
    /// # Errors
    /// Returns an error for a type without instances, an invalid NodeId, or an optional child
    /// without declaration.
    pub fn instantiate(
        &self,
        spec: &InstanceSpec,
        ids: &mut dyn FnMut(&str) -> NodeId,
    ) -> Result<Instance, InstanceError> {
        let _alone = self.inner.making.lock();
        let spaces = &self.inner.spaces;
        let planned = spaces.with(|view| {
            self.checked(view, &spec.node_id, &spec.parent)?;
            let abstract_type = match view.node(&spec.type_id) {
                Some(NodeType::ObjectType(node)) => node.is_abstract(),
                Some(_) | None => return Err(InstanceError::NoType(spec.type_id.clone())),
            };
            if abstract_type {
                return Err(InstanceError::Abstract(spec.type_id.clone()));
            }
            for interface in &spec.interfaces {
                if view.class(interface) != Some(NodeClass::ObjectType) {
                    return Err(InstanceError::NoInterface(interface.clone()));
                }
            }
            let mut plan = Plan {
                view,
                spec,
                ids,
                planned: Vec::new(),
            };
            let declared = view.declared(&[], Some(&spec.type_id), &spec.interfaces);
            plan.add(&declared, &spec.node_id, "", 0)?;
            for path in &spec.optional {
                if !plan.planned.iter().any(|node| node.path == *path) {
                    return Err(InstanceError::NoOptional(path.clone()));
                }
            }
            let planned = plan.planned;
            let mut taken = vec![&spec.node_id];
            for node in &planned {
                let id = node.node.as_node().node_id();
                if !spaces.owns(id) {
                    return Err(InstanceError::Foreign(id.clone()));
                }
                if view.exists(id) || taken.contains(&id) {
                    return Err(InstanceError::Taken(id.clone()));
                }
                taken.push(id);
            }
            Ok(planned)
        })?;
        Ok(self.put(spec, planned))
    }

    fn put(&self, spec: &InstanceSpec, planned: Vec<Planned>) -> Instance {
        let mut own = self.inner.spaces.own().write();
        let notifier = notifier(spec.event_notifier);
        let object = Object::new(
            &spec.node_id,
            spec.browse_name.clone(),
            spec.display_name.clone(),
            notifier,
        );
        insert(&mut own, object.into(), &spec.parent, &spec.reference);
        own.insert_reference(
            &spec.node_id,
            &spec.type_id,
            ReferenceTypeId::HasTypeDefinition,
        );
        for interface in &spec.interfaces {
            own.insert_reference(&spec.node_id, interface, ReferenceTypeId::HasInterface);
        }
        if spec.event_notifier {
            let server: NodeId = ObjectId::Server.into();
            own.insert_reference(&server, &spec.node_id, ReferenceTypeId::HasNotifier);
        }
        let mut nodes = BTreeMap::new();
        for planned in planned {
            let id = planned.node.as_node().node_id().clone();
            let name = planned
                .node
                .as_node()
                .browse_name()
                .name
                .as_ref()
                .to_owned();
            if planned.node.node_class() == NodeClass::Method {
                let calls = &self.inner.calls;
                calls.add(&planned.parent, &id, &name, &planned.declared);
            }
            insert(&mut own, planned.node, &planned.parent, &planned.reference);
            if let Some(type_definition) = &planned.type_definition {
                own.insert_reference(&id, type_definition, ReferenceTypeId::HasTypeDefinition);
            }
            nodes.insert(planned.path, id);
        }
        Instance {
            node_id: spec.node_id.clone(),
            nodes,
        }
    }

    /// Creates an object.
    ///
    /// # Errors
    /// Returns an error for an invalid NodeId or a missing parent.
    pub fn add_object(&self, spec: &ObjectSpec) -> Result<(), InstanceError> {
        let object = Object::new(
            &spec.node_id,
            spec.browse_name.clone(),
            spec.display_name.clone(),
            notifier(spec.event_notifier),
        );
        self.add(
            object.into(),
            &spec.parent,
            &spec.reference,
            &spec.type_definition,
        )?;
        if spec.event_notifier {
            let server: NodeId = ObjectId::Server.into();
            self.add_reference(&server, &ReferenceTypeId::HasNotifier.into(), &spec.node_id);
        }
        Ok(())
    }

    /// Creates a variable.
    ///
    /// # Errors
    /// Returns an error for an invalid NodeId or a missing parent.
    pub fn add_variable(&self, spec: &VariableSpec) -> Result<(), InstanceError> {
        let base = Base::new(
            NodeClass::Variable,
            &spec.node_id,
            spec.browse_name.clone(),
            spec.display_name.clone(),
        );
        let readable = AccessLevel::CURRENT_READ.bits();
        let mut variable = Variable::new_full(
            base,
            spec.data_type.clone(),
            false,
            spec.value_rank,
            plain(spec.value.clone()),
            readable,
            readable,
            None,
            None,
        );
        set_writable(&mut variable, spec.writable);
        self.add(
            variable.into(),
            &spec.parent,
            &spec.reference,
            &spec.type_definition,
        )
    }

    fn add(
        &self,
        node: NodeType,
        parent: &NodeId,
        reference: &NodeId,
        type_definition: &NodeId,
    ) -> Result<(), InstanceError> {
        let _alone = self.inner.making.lock();
        let id = node.as_node().node_id().clone();
        let spaces = &self.inner.spaces;
        spaces.with(|view| self.checked(view, &id, parent))?;
        let mut own = spaces.own().write();
        insert(&mut own, node, parent, reference);
        own.insert_reference(&id, type_definition, ReferenceTypeId::HasTypeDefinition);
        Ok(())
    }

    pub(super) fn checked(
        &self,
        view: ServerView<'_>,
        id: &NodeId,
        parent: &NodeId,
    ) -> Result<(), InstanceError> {
        if !self.inner.spaces.owns(id) {
            return Err(InstanceError::Foreign(id.clone()));
        }
        if view.exists(id) {
            return Err(InstanceError::Taken(id.clone()));
        }
        if !view.exists(parent) {
            return Err(InstanceError::NoParent(parent.clone()));
        }
        Ok(())
    }

    /// Adds a reference between two nodes, including nodes of the core namespace. A reference from
    /// a node to itself is ignored.
    pub fn add_reference(&self, source: &NodeId, reference: &NodeId, target: &NodeId) {
        if source != target {
            let mut own = self.inner.spaces.own().write();
            own.insert_reference(source, target, reference.clone());
        }
    }

    /// Removes a node and all nodes below it, with their handlers. Subscribers of the nodes receive
    /// `BadNodeIdUnknown`.
    pub fn remove(&self, node: &NodeId) {
        let _alone = self.inner.making.lock();
        let spaces = &self.inner.spaces;
        let gone = spaces.with(|view| {
            let mut gone = vec![node.clone()];
            let mut at = 0;
            while let Some(id) = gone.get(at).cloned() {
                for child in view.children(&id) {
                    if spaces.owns(&child.node_id) && !gone.contains(&child.node_id) {
                        gone.push(child.node_id);
                    }
                }
                at += 1;
            }
            gone.retain(|id| spaces.owns(id));
            gone
        });
        let mut own = spaces.own().write();
        for id in &gone {
            drop(own.delete(id, true));
            self.inner.calls.remove(id);
            self.inner.manager.inner().remove(id);
        }
        let mut notifier = self.inner.handle.subscriptions().data_notifier();
        for id in &gone {
            let value = DataValue::new_now_status(Variant::Empty, StatusCode::BadNodeIdUnknown);
            notifier.notify(id, opcua::types::AttributeId::Value, value);
        }
    }
}

/// Sets whether clients may write a variable, in AccessLevel and UserAccessLevel.
pub(crate) fn set_writable(variable: &mut Variable, writable: bool) {
    let mut access = variable.access_level();
    access.set(AccessLevel::CURRENT_WRITE, writable);
    variable.set_access_level(access);
    variable.set_user_access_level(access);
}

fn notifier(events: bool) -> EventNotifier {
    if events {
        EventNotifier::SUBSCRIBE_TO_EVENTS
    } else {
        EventNotifier::empty()
    }
}

pub(super) fn insert(own: &mut AddressSpace, node: NodeType, parent: &NodeId, reference: &NodeId) {
    let id = node.as_node().node_id().clone();
    own.insert(
        node,
        None::<&[(&NodeId, &NodeId, opcua::nodes::ReferenceDirection)]>,
    );
    own.insert_reference(parent, &id, reference.clone());
}

struct Plan<'a> {
    view: ServerView<'a>,
    spec: &'a InstanceSpec,
    ids: &'a mut dyn FnMut(&str) -> NodeId,
    planned: Vec<Planned>,
}

impl Plan<'_> {
    fn add(
        &mut self,
        declared: &[Declared],
        parent: &NodeId,
        above: &str,
        depth: usize,
    ) -> Result<(), InstanceError> {
        if depth > DEEPEST || self.planned.len() > MOST_NODES {
            return Err(InstanceError::TooLarge(self.spec.type_id.clone()));
        }
        for child in declared {
            let name = child.name.name.as_ref();
            let path = if above.is_empty() {
                name.to_owned()
            } else {
                format!("{above}/{name}")
            };
            if !self.wanted(child, &path) {
                continue;
            }
            let id = (self.ids)(&path);
            let Some(first) = child.nodes.first() else {
                continue;
            };
            let Some(node) = self
                .view
                .node(first)
                .and_then(|node| copy(node, id.clone()))
            else {
                continue;
            };
            let mut definitions = child.nodes.iter();
            let type_definition = definitions.find_map(|node| self.view.type_definition(node));
            self.planned.push(Planned {
                path: path.clone(),
                parent: parent.clone(),
                reference: child.reference.clone(),
                declared: child.nodes.clone(),
                type_definition: type_definition.cloned(),
                node,
            });
            let parental = child
                .nodes
                .iter()
                .find_map(|node| self.view.parental_type(node));
            let below = self.view.declared(&child.nodes, parental, &[]);
            self.add(&below, &id, &path, depth + 1)?;
        }
        Ok(())
    }

    fn wanted(&self, child: &Declared, path: &str) -> bool {
        let name = child.name.name.as_ref();
        let arguments =
            matches!(name, "InputArguments" | "OutputArguments") && child.name.namespace_index == 0;
        let named = self.spec.optional.iter().any(|wanted| {
            wanted
                .strip_prefix(path)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        });
        match self.view.modelling_rule(child) {
            Some(rule) if *rule == ObjectId::ModellingRule_Mandatory => true,
            Some(rule) if *rule == ObjectId::ModellingRule_Optional => named,
            // Some tools omit the modelling rule of arguments, which belong to their method.
            Some(_) | None => arguments,
        }
    }
}

/// Copies a declaration to a node of an instance.
fn copy(node: &NodeType, id: NodeId) -> Option<NodeType> {
    let base = |node: &dyn Node, class| {
        Base::new_full(
            id.clone(),
            class,
            node.browse_name().clone(),
            node.display_name().clone(),
            node.description().cloned(),
            node.write_mask().map(|mask| mask.bits()),
            node.user_write_mask().map(|mask| mask.bits()),
        )
    };
    match node {
        NodeType::Object(object) => {
            let base = base(&**object, NodeClass::Object);
            Some(Object::new_full(base, object.event_notifier()).into())
        }
        NodeType::Method(method) => {
            Some(Method::new_full(base(&**method, NodeClass::Method), true, true).into())
        }
        NodeType::Variable(variable) => {
            let mut value = value_of(variable);
            if value
                .value
                .as_ref()
                .is_none_or(|value| *value == Variant::Empty)
            {
                // The library returns a status only together with a value.
                value = DataValue {
                    value: Some(Variant::Empty),
                    status: Some(StatusCode::BadWaitingForInitialData),
                    ..DataValue::default()
                };
            }
            let access = variable.access_level().bits();
            Some(
                Variable::new_full(
                    base(&**variable, NodeClass::Variable),
                    variable.data_type(),
                    false,
                    variable.value_rank(),
                    value,
                    access,
                    access,
                    variable.array_dimensions(),
                    variable.minimum_sampling_interval(),
                )
                .into(),
            )
        }
        NodeType::ObjectType(_)
        | NodeType::ReferenceType(_)
        | NodeType::VariableType(_)
        | NodeType::View(_)
        | NodeType::DataType(_) => None,
    }
}

/// Deepest level of children of a type.
const DEEPEST: usize = 16;
/// Maximum number of nodes of an instance.
const MOST_NODES: usize = 10_000;
