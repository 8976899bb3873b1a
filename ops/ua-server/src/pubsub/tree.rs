//! Adds objects, variables and methods of the PubSub configuration to the address space.

use opcua::nodes::{MethodBuilder, NodeType, ObjectBuilder, ReferenceDirection, VariableBuilder};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    DataTypeId, LocalizedText, MethodId, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, UAString, VariableTypeId, Variant,
};

/// Adds nodes and records them.
pub(super) struct Tree<'a> {
    pub(super) address_space: &'a mut AddressSpace,
    pub(super) made: Vec<NodeId>,
    /// If set, NodeIds are computed and no node is added.
    pub(super) is_dry: bool,
}

/// An object to which nodes are added.
#[derive(Clone)]
pub(super) struct At {
    pub(super) node: NodeId,
    id: String,
}

impl At {
    /// Returns a node of the core namespace. Nodes below it have identifiers that begin with `id`.
    pub(super) fn core(node: impl Into<NodeId>, id: &str) -> Self {
        Self {
            node: node.into(),
            id: id.to_owned(),
        }
    }

    /// Returns the node of that name below the object.
    pub(super) fn below(&self, name: &str) -> NodeId {
        NodeId::new(APPLICATION, format!("{}.{name}", self.id))
    }
}

impl Tree<'_> {
    /// Adds an object below another object.
    pub(super) fn object(
        &mut self,
        name: &str,
        kind: ObjectTypeId,
        (above, reference): (&At, ReferenceTypeId),
    ) -> At {
        let node = above.below(name);
        if !self.is_dry {
            ObjectBuilder::new(&node, browse_name(name), LocalizedText::from(name))
                .has_type_definition(kind)
                .reference(above.node.clone(), reference, ReferenceDirection::Inverse)
                .insert(self.address_space);
            self.made.push(node.clone());
        }
        At {
            node,
            id: format!("{}.{name}", above.id),
        }
    }

    /// Adds an object as a component of another object.
    pub(super) fn part(&mut self, name: &str, kind: ObjectTypeId, above: &At) -> At {
        self.object(name, kind, (above, ReferenceTypeId::HasComponent))
    }

    /// Adds a property.
    pub(super) fn property(
        &mut self,
        name: &str,
        kind: (DataTypeId, i32),
        value: impl Into<Variant>,
        above: &At,
    ) {
        let as_ = (VariableTypeId::PropertyType, ReferenceTypeId::HasProperty);
        self.variable(name, kind, value, (above, as_));
    }

    /// Adds a variable as a component.
    pub(super) fn value(
        &mut self,
        name: &str,
        kind: (DataTypeId, i32),
        value: impl Into<Variant>,
        above: &At,
    ) -> NodeId {
        let as_ = (
            VariableTypeId::BaseDataVariableType,
            ReferenceTypeId::HasComponent,
        );
        self.variable(name, kind, value, (above, as_))
    }

    /// Adds a value of diagnostics with its DiagnosticsLevel.
    pub(super) fn live_value(
        &mut self,
        name: &str,
        kind: (DataTypeId, i32),
        value: impl Into<Variant>,
        above: &At,
    ) -> NodeId {
        let node = self.value(name, kind, value, above);
        let at = At {
            node: node.clone(),
            id: format!("{}.{name}", above.id),
        };
        let level = (DataTypeId::DiagnosticsLevel, -1);
        self.property("DiagnosticsLevel", level, BASIC, &at);
        node
    }

    /// Adds a variable that selects one of several texts.
    pub(super) fn selection(&mut self, name: &str, text: &str, above: &At) {
        let as_ = (
            VariableTypeId::SelectionListType,
            ReferenceTypeId::HasComponent,
        );
        let node = self.variable(name, (DataTypeId::String, -1), text, (above, as_));
        let list = At {
            node,
            id: format!("{}.{name}", above.id),
        };
        let texts = vec![UAString::from(text)];
        self.property("Selections", (DataTypeId::BaseDataType, 1), texts, &list);
    }

    /// Adds a variable.
    pub(super) fn variable(
        &mut self,
        name: &str,
        (data_type, rank): (DataTypeId, i32),
        value: impl Into<Variant>,
        (above, (kind, reference)): (&At, (VariableTypeId, ReferenceTypeId)),
    ) -> NodeId {
        let node = above.below(name);
        if !self.is_dry {
            VariableBuilder::new(&node, browse_name(name), LocalizedText::from(name))
                .data_type(data_type)
                .value_rank(rank)
                .value(value)
                .has_type_definition(kind)
                .reference(above.node.clone(), reference, ReferenceDirection::Inverse)
                .insert(self.address_space);
            self.made.push(node.clone());
        }
        node
    }

    /// Adds a method without arguments.
    pub(super) fn method(&mut self, name: &str, above: &At) -> NodeId {
        let node = above.below(name);
        if !self.is_dry {
            MethodBuilder::new(&node, browse_name(name), LocalizedText::from(name))
                .component_of(above.node.clone())
                .executable(true)
                .user_executable(true)
                .insert(self.address_space);
            self.made.push(node.clone());
        }
        node
    }

    /// Adds a reference between two nodes.
    pub(super) fn refer(&mut self, from: &NodeId, to: &NodeId, reference: ReferenceTypeId) {
        if !self.is_dry {
            self.address_space.insert_reference(from, to, reference);
        }
    }
}

/// Adds a method of the Status of the object PublishSubscribe, unless it exists.
pub(super) fn core_method(address_space: &mut AddressSpace, method: MethodId, name: &str) {
    let node: NodeId = method.into();
    if !address_space.node_exists(&node) {
        MethodBuilder::new(
            &node,
            QualifiedName::new(0, name),
            LocalizedText::from(name),
        )
        .component_of(NodeId::from(ObjectId::PublishSubscribe_Status))
        .executable(true)
        .user_executable(true)
        .insert(address_space);
    }
}

/// Makes an existing method not executable.
pub(super) fn nobody_executes(address_space: &mut AddressSpace, method: MethodId) {
    if let Some(NodeType::Method(method)) = address_space.find_mut(&method.into()) {
        method.set_executable(false);
        method.set_user_executable(false);
    }
}

/// Returns a BrowseName. Names that begin with a capital letter are names of the standard.
fn browse_name(name: &str) -> QualifiedName {
    let namespace = if name.starts_with(|c: char| c.is_ascii_uppercase()) {
        0
    } else {
        APPLICATION
    };
    QualifiedName::new(namespace, name)
}

/// DiagnosticsLevel Basic.
pub(super) const BASIC: i32 = 0;
/// The namespace index of the application's own URI.
const APPLICATION: u16 = 1;
