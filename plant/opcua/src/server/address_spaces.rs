//! The address spaces of a server's node managers.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use opcua::nodes::{DefaultTypeTree, NodeType};
use opcua::server::address_space::AddressSpace;
use opcua::server::node_manager::memory::CoreNodeManager;
use opcua::sync::RwLock;
use opcua::types::{
    Argument, DataEncoding, DataValue, NodeClass, NodeId, NumericRange, ObjectTypeId,
    QualifiedName, ReferenceTypeId, StatusCode, TimestampsToReturn, Variant,
};

use super::view::ServerView;

/// The address spaces of both node managers.
pub(crate) struct AddressSpaces {
    core: Arc<CoreNodeManager>,
    own: Arc<RwLock<AddressSpace>>,
    indexes: BTreeSet<u16>,
    no_types: DefaultTypeTree,
}

impl AddressSpaces {
    pub(crate) fn new(core: Arc<CoreNodeManager>, own: Arc<RwLock<AddressSpace>>) -> Self {
        let indexes = own.read().namespaces().keys().copied().collect();
        Self {
            core,
            own,
            indexes,
            no_types: DefaultTypeTree::new(),
        }
    }

    pub(crate) fn own(&self) -> &RwLock<AddressSpace> {
        &self.own
    }

    /// Returns whether a node belongs to the server's own namespaces.
    pub(crate) fn owns(&self, id: &NodeId) -> bool {
        self.indexes.contains(&id.namespace)
    }

    /// Calls a function with a view of both address spaces.
    pub(crate) fn with<T>(&self, look: impl FnOnce(ServerView<'_>) -> T) -> T {
        let core = self.core.address_space().read();
        let own = self.own.read();
        look(ServerView {
            core: &core,
            own: &own,
            no_types: &self.no_types,
        })
    }

    /// Returns the input arguments of a method of the own namespaces; empty without the property.
    ///
    /// # Errors
    /// Returns an error if the value of the property is not a list of arguments.
    pub(crate) fn input_arguments(&self, method: &NodeId) -> Result<Vec<Argument>, StatusCode> {
        self.with(|view| {
            let properties = view.targets(method, ReferenceTypeId::HasProperty, true);
            let mut nodes = properties.into_iter().filter_map(|id| view.node(id));
            let property = nodes.find(|node| {
                let name = node.as_node().browse_name();
                name.namespace_index == 0 && name.name.as_ref() == "InputArguments"
            });
            property.map_or(Ok(Vec::new()), |node| {
                arguments(node).ok_or(StatusCode::BadInternalError)
            })
        })
    }

    pub(crate) fn executable(&self, method: &NodeId) -> bool {
        match self.own.read().find(method) {
            Some(NodeType::Method(method)) => method.executable(),
            Some(_) | None => false,
        }
    }

    /// Registers the inherited fields and the optional fields of event types for select clauses.
    /// The library registers only the fields that a type itself declares.
    pub(crate) fn inherit_event_fields(&self, types: &mut DefaultTypeTree) {
        let event_types = self.with(|view| {
            let base: NodeId = ObjectTypeId::BaseEventType.into();
            let below = view.subtypes(&base).into_iter();
            below.cloned().collect::<Vec<_>>()
        });
        self.event_fields(&event_types).register(types);
    }

    /// Returns the fields of event types, including inherited and optional fields.
    pub(crate) fn event_fields(&self, event_types: &[NodeId]) -> EventFields {
        self.with(|view| {
            let mut known = HashMap::new();
            let mut fields = Vec::new();
            for event_type in event_types {
                for (path, node) in view.event_fields(event_type, &mut known) {
                    if let Some(class) = view.class(&node) {
                        fields.push(EventFieldOf {
                            event_type: event_type.clone(),
                            path,
                            node,
                            class,
                        });
                    }
                }
            }
            EventFields(fields)
        })
    }
}

/// Fields of event types, to be registered without a lock of the address spaces.
pub(crate) struct EventFields(Vec<EventFieldOf>);

struct EventFieldOf {
    event_type: NodeId,
    path: Vec<QualifiedName>,
    node: NodeId,
    class: NodeClass,
}

impl EventFields {
    pub(crate) fn register(&self, types: &mut DefaultTypeTree) {
        for field in &self.0 {
            let path: Vec<_> = field.path.iter().collect();
            types.add_type_property(&field.node, &field.event_type, &path, field.class);
        }
    }
}

/// Returns the arguments of an InputArguments property.
pub(crate) fn arguments(property: &NodeType) -> Option<Vec<Argument>> {
    let NodeType::Variable(variable) = property else {
        return None;
    };
    arguments_in(Some(variable.value(
        TimestampsToReturn::Neither,
        &NumericRange::None,
        &DataEncoding::Binary,
        0.0,
    )))
}

/// Returns the arguments in the value of an InputArguments or OutputArguments property.
#[must_use]
pub fn arguments_in(value: Option<DataValue>) -> Option<Vec<Argument>> {
    let Variant::Array(array) = value?.value? else {
        return None;
    };
    let each = array.values.into_iter().map(|value| {
        let Variant::ExtensionObject(object) = value else {
            return None;
        };
        object.into_inner_as::<Argument>().map(|one| *one)
    });
    each.collect()
}
