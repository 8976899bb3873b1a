//! Nodes from types (OPC 10000-3, 6.3): the mandatory children of a type and of its supertypes and interfaces, and the
//! optional ones that are named, each as the most derived type declares it.

use std::collections::BTreeMap;

use opcua::nodes::{Base, EventNotifier, Method, Node, NodeType, Object, Variable};
use opcua::server::address_space::{AccessLevel, AddressSpace};
use opcua::types::{
    DataValue, LocalizedText, NodeClass, NodeId, ObjectId, QualifiedName, ReferenceTypeId,
    StatusCode, Variant,
};

use super::nodes::plain;
use super::view::{Declared, View};
use super::{Server, value_of};

/// What is to be made of a type.
#[derive(Debug, Clone)]
pub struct InstanceSpec {
    /// The type of the object.
    pub type_id: NodeId,
    /// The object.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// What it is below of.
    pub parent: NodeId,
    /// How it is below that, as HasComponent.
    pub reference: NodeId,
    /// The paths of the optional children it has too, as `ProgramDiagnostic` or `FinalResultData/Force`.
    pub optional: Vec<String>,
    /// The interfaces it has beside those of its type.
    pub interfaces: Vec<NodeId>,
    /// Whether clients can subscribe to its events. It is below the Server by HasNotifier then.
    pub event_notifier: bool,
}

impl InstanceSpec {
    /// A component of `parent`.
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

/// An object that is made of a type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Instance {
    /// The object.
    pub node_id: NodeId,
    nodes: BTreeMap<String, NodeId>,
}

impl Instance {
    /// A node below it by its path: BrowseNames joined by `/`, without namespaces.
    #[must_use]
    pub fn node(&self, path: &str) -> Option<&NodeId> {
        self.nodes.get(path)
    }

    /// All nodes below it, by path.
    pub fn nodes(&self) -> impl Iterator<Item = (&str, &NodeId)> {
        self.nodes.iter().map(|(path, id)| (path.as_str(), id))
    }
}

/// NodeIds with rising numbers.
#[derive(Debug, Clone)]
pub struct IdRange {
    namespace: u16,
    next: u32,
}

impl IdRange {
    /// Begins with `first`.
    #[must_use]
    pub fn new(namespace: u16, first: u32) -> Self {
        Self {
            namespace,
            next: first,
        }
    }

    /// The next one.
    #[expect(clippy::should_implement_trait, reason = "it never ends")]
    pub fn next(&mut self) -> NodeId {
        let id = NodeId::new(self.namespace, self.next);
        self.next = self.next.saturating_add(1);
        id
    }
}

/// An object without anything below it.
#[derive(Debug, Clone)]
pub struct ObjectSpec {
    /// The object.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// Its type, as FolderType.
    pub type_definition: NodeId,
    /// What it is below of.
    pub parent: NodeId,
    /// How it is below that.
    pub reference: NodeId,
    /// Whether clients can subscribe to its events.
    pub event_notifier: bool,
}

/// A variable without anything below it.
#[derive(Debug, Clone)]
pub struct VariableSpec {
    /// The variable.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its DisplayName.
    pub display_name: LocalizedText,
    /// Its type, as PropertyType.
    pub type_definition: NodeId,
    /// What it is below of.
    pub parent: NodeId,
    /// How it is below that.
    pub reference: NodeId,
    /// Its DataType.
    pub data_type: NodeId,
    /// Its ValueRank.
    pub value_rank: i32,
    /// What it shows.
    pub value: DataValue,
    /// Whether clients may write it.
    pub writable: bool,
}

/// Why nodes are not made. None is then.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InstanceError {
    /// The type is not there.
    #[error("there is no ObjectType {0}")]
    NoType(NodeId),
    /// The type has no instances.
    #[error("{0} is abstract: only its subtypes have instances")]
    Abstract(NodeId),
    /// An interface is not there.
    #[error("there is no interface {0}")]
    NoInterface(NodeId),
    /// The parent is not there.
    #[error("the parent {0} is not there")]
    NoParent(NodeId),
    /// The NodeId is not of a namespace of this server's.
    #[error("{0} is not of a namespace for instances")]
    Foreign(NodeId),
    /// There is a node with the NodeId.
    #[error("there is a node {0} already")]
    Taken(NodeId),
    /// The type is deeper or larger than anything sensible.
    #[error("{0} has more children than a server can have, or is made of itself")]
    TooLarge(NodeId),
    /// No type declares an optional child that is asked for.
    #[error("the type has no optional child {0}")]
    NoOptional(String),
}

/// A node that is going to be made.
struct Planned {
    path: String,
    parent: NodeId,
    reference: NodeId,
    /// The declarations of a method.
    declared: Vec<NodeId>,
    type_definition: Option<NodeId>,
    node: NodeType,
}

impl Server {
    /// Makes an object of a type, with NodeIds that `ids` gives by the path of each child.
    ///
    /// # Errors
    /// A type without instances, a NodeId that cannot be, or an optional child nobody declares.
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

    /// Makes an object.
    ///
    /// # Errors
    /// A NodeId that cannot be, or a parent that is not there.
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

    /// Makes a variable.
    ///
    /// # Errors
    /// A NodeId that cannot be, or a parent that is not there.
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
        view: View<'_>,
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

    /// Lets a node refer to another, either of which may be of the core namespace. One to itself is not made.
    pub fn add_reference(&self, source: &NodeId, reference: &NodeId, target: &NodeId) {
        if source != target {
            let mut own = self.inner.spaces.own().write();
            own.insert_reference(source, target, reference.clone());
        }
    }

    /// Removes a node of ours and all below it, with their handlers. Who watches them is told `BadNodeIdUnknown`.
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

/// Lets clients write a variable or not: both attributes that say so.
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
    view: View<'a>,
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
            // Tools leave the rule out at arguments, which belong to their method.
            Some(_) | None => arguments,
        }
    }
}

/// The declaration as a node of an instance.
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
                // The library tells a status only beside a value.
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

/// How deep the children of a type go at most.
const DEEPEST: usize = 16;
/// How many nodes an instance has at most.
const MOST_NODES: usize = 10_000;
