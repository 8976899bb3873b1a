//! Events for nodes that a server added, deleted or changed (OPC 10000-3, 9.32).
//!
//! A GeneralModelChangeEvent of the Server object names the changed nodes, so that its subscribers
//! browse only these nodes again.

use opcua::nodes::{BaseEventType, Event};
use opcua::server::SubscriptionCache;
use opcua::types::{
    DateTime, ExtensionObject, LocalizedText, ModelChangeStructureDataType, NodeId, ObjectId,
    ObjectTypeId, Variant,
};

/// The kind of a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Became {
    /// The node was added.
    Added,
    /// The node was deleted.
    Deleted,
    /// The type definition of the node changed.
    OfAnotherType,
}

impl Became {
    /// Returns the verb bit of ModelChangeStructureDataType (OPC 10000-3, 9.32.7).
    fn verb(self) -> u8 {
        match self {
            Self::Added => 1,
            Self::Deleted => 2,
            Self::OfAnotherType => 16,
        }
    }
}

/// A changed node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelChange {
    /// The node.
    pub node: NodeId,
    /// The type definition of the node.
    pub type_definition: NodeId,
    /// The kind of the change.
    pub became: Became,
}

/// Sends the changes to the subscribers of the Server object, at most 500 changes in an event.
pub fn tell(subscriptions: &SubscriptionCache, changes: &[ModelChange]) {
    let server: NodeId = ObjectId::Server.into();
    for changes in changes.chunks(MOST_TOLD) {
        let changed = Changed::new(changes);
        subscriptions.notify_events([(&changed as &dyn Event, &server)].into_iter());
    }
}

/// Maximum number of changes in an event; further changes follow in further events.
const MOST_TOLD: usize = 500;

/// A list of changes as an OPC UA event.
struct Changed {
    base: BaseEventType,
    changes: Variant,
}

impl Changed {
    fn new(changes: &[ModelChange]) -> Self {
        let now = DateTime::now();
        let message = format!("{} nodes have changed", changes.len());
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

crate::impl_event!(
    Changed,
    |_, id| TYPES.iter().any(|known| *id == *known),
    |event, path| match path {
        [name] if name.namespace_index == 0 && name.name.as_ref() == "Changes" => {
            Some(event.changes.clone())
        }
        _ => None,
    }
);

/// The type of the event and its supertypes.
const TYPES: [ObjectTypeId; 3] = [
    ObjectTypeId::GeneralModelChangeEventType,
    ObjectTypeId::BaseModelChangeEventType,
    ObjectTypeId::BaseEventType,
];
