//! What clients are told of nodes that a server has added, taken away or changed (OPC 10000-3, 9.32).
//!
//! GeneralModelChangeEvents of the Server object: who watches it browses again what they name, and nothing else.

use opcua::nodes::{BaseEventType, Event, EventField};
use opcua::server::SubscriptionCache;
use opcua::types::{
    AttributeId, DateTime, ExtensionObject, LocalizedText, ModelChangeStructureDataType, NodeId,
    NumericRange, ObjectId, ObjectTypeId, QualifiedName, Variant,
};

/// What became of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Became {
    /// It is new.
    Added,
    /// It is gone.
    Deleted,
    /// It is of another type.
    OfAnotherType,
}

impl Became {
    /// The bit of ModelChangeStructureDataType (OPC 10000-3, 9.32.7).
    fn verb(self) -> u8 {
        match self {
            Self::Added => 1,
            Self::Deleted => 2,
            Self::OfAnotherType => 16,
        }
    }
}

/// One node, and what became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelChange {
    /// The node.
    pub node: NodeId,
    /// Its type definition.
    pub type_definition: NodeId,
    /// What became of it.
    pub became: Became,
}

/// Tells who watches the Server object, 500 changes an event.
pub fn tell(subscriptions: &SubscriptionCache, changes: &[ModelChange]) {
    let server: NodeId = ObjectId::Server.into();
    for changes in changes.chunks(MOST_TOLD) {
        let changed = Changed::new(changes);
        subscriptions.notify_events([(&changed as &dyn Event, &server)].into_iter());
    }
}

/// Changes of one event; more come in several.
const MOST_TOLD: usize = 500;

/// An event on its way to clients.
struct Changed {
    base: BaseEventType,
    changes: Variant,
}

impl Changed {
    fn new(changes: &[ModelChange]) -> Self {
        let now = DateTime::now();
        let message = format!("{} nodes are others than before", changes.len());
        let base = BaseEventType {
            event_id: opcua::crypto::random::byte_string(16),
            event_type: ObjectTypeId::GeneralModelChangeEventType.into(),
            source_node: ObjectId::Server.into(),
            source_name: "Server".into(),
            time: now,
            receive_time: now,
            message: LocalizedText::from(&message),
            severity: 100,
            ..BaseEventType::default()
        };
        let changes: Vec<ExtensionObject> = changes
            .iter()
            .map(|change| ModelChangeStructureDataType {
                affected: change.node.clone(),
                affected_type: change.type_definition.clone(),
                verb: change.became.verb(),
            })
            .map(ExtensionObject::from_message)
            .collect();
        Self {
            base,
            changes: changes.into(),
        }
    }
}

impl Event for Changed {
    fn get_field(
        &self,
        type_definition_id: &NodeId,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        browse_path: &[QualifiedName],
    ) -> Variant {
        let is_own = TYPES.iter().any(|known| *type_definition_id == *known);
        if !is_own {
            return Variant::Empty;
        }
        self.get_value(attribute_id, index_range, browse_path)
    }

    fn time(&self) -> &DateTime {
        &self.base.time
    }

    fn event_type_id(&self) -> &NodeId {
        &self.base.event_type
    }
}

impl EventField for Changed {
    fn get_value(
        &self,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        remaining_path: &[QualifiedName],
    ) -> Variant {
        if attribute_id == AttributeId::Value
            && let [name] = remaining_path
            && name.namespace_index == 0
            && name.name.as_ref() == "Changes"
        {
            let changes = self.changes.clone();
            return changes
                .range_of_owned(index_range)
                .unwrap_or(Variant::Empty);
        }
        self.base
            .get_value(attribute_id, index_range, remaining_path)
    }
}

/// The type of the event, and those above it.
const TYPES: [ObjectTypeId; 3] = [
    ObjectTypeId::GeneralModelChangeEventType,
    ObjectTypeId::BaseModelChangeEventType,
    ObjectTypeId::BaseEventType,
];
