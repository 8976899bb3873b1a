//! Types and events of other servers: a server that shows the nodes of another server repeats the
//! names of their types and forwards their events.

use opcua::nodes::{BaseEventType, Event, ObjectType};
use opcua::types::{
    ByteString, DateTime, LocalizedText, NodeClass, NodeId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, UAString, Variant,
};

use super::instances::insert;
use super::{InstanceError, OpcUaServer, events};

/// The description of a type without declarations.
#[derive(Debug, Clone)]
pub struct TypeSpec {
    /// The NodeId of the type.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// Its supertype.
    pub supertype: NodeId,
}

/// An event of another server.
#[derive(Debug, Clone)]
pub struct ForwardedEvent {
    /// The node of this server that stands for the source.
    pub source: NodeId,
    /// The name of the source.
    pub source_name: UAString,
    /// The EventId, unchanged.
    pub event_id: ByteString,
    /// The type, as a node of this server.
    pub event_type: NodeId,
    /// The time of the event.
    pub time: DateTime,
    /// The message text.
    pub message: LocalizedText,
    /// The severity, 1 to 1000.
    pub severity: u16,
    /// The values of other fields, by their paths.
    pub fields: Vec<(Vec<QualifiedName>, Variant)>,
}

impl OpcUaServer {
    /// Returns the index of a namespace for BrowseNames, and adds the namespace if it is unknown.
    /// `None` if the server has 4096 namespaces.
    #[must_use]
    pub fn add_namespace(&self, uri: &str) -> Option<u16> {
        if let Some(known) = self.namespace(uri) {
            return Some(known);
        }
        let mut types = self.inner.handle.type_tree().write();
        let namespaces = types.namespaces_mut();
        if namespaces.known_namespaces().len() >= MOST_NAMESPACES {
            return None;
        }
        let index = namespaces.add_namespace(uri);
        drop(types);
        self.inner.manager.inner().add_namespace(uri, index);
        Some(index)
    }

    /// Adds an ObjectType without declarations. Instances of the type can be found by it; its
    /// events inherit the fields of the supertype.
    ///
    /// # Errors
    /// Returns an error for an invalid NodeId or a missing supertype.
    pub fn add_type(&self, spec: &TypeSpec) -> Result<(), InstanceError> {
        let _alone = self.inner.making.lock();
        let spaces = &self.inner.spaces;
        spaces.with(|view| self.checked(view, &spec.node_id, &spec.supertype))?;
        let name = spec.browse_name.name.as_ref().to_owned();
        let display_name = LocalizedText::new("", &name);
        let of = ObjectType::new(&spec.node_id, spec.browse_name.clone(), display_name, false);
        let mut own = spaces.own().write();
        let reference = ReferenceTypeId::HasSubtype.into();
        insert(&mut own, of.into(), &spec.supertype, &reference);
        drop(own);
        let is_event = self.is_subtype_of(&spec.node_id, &ObjectTypeId::BaseEventType.into());
        let events = is_event.then(|| spaces.event_fields(std::slice::from_ref(&spec.node_id)));
        // No lock of an address space may be held while the type tree is locked.
        let mut types = self.inner.handle.type_tree().write();
        types.add_type_node(&spec.node_id, &spec.supertype, NodeClass::ObjectType);
        if let Some(events) = events {
            events.register(&mut types);
        }
        Ok(())
    }

    /// Raises an event of another server on its source and on the Server object.
    pub fn forward(&self, event: ForwardedEvent) {
        let types = self.inner.spaces.with(|view| {
            let supertypes = view.supertypes(&event.event_type);
            events::answered(&event.event_type, supertypes)
        });
        let source = event.source.clone();
        let raised = Forwarded::new(event, types);
        let subscriptions = self.inner.handle.subscriptions();
        // The notification also reaches the subscribers of the Server object.
        subscriptions.notify_events([(&raised as &dyn Event, &source)].into_iter());
    }
}

struct Forwarded {
    base: BaseEventType,
    fields: Vec<(Vec<QualifiedName>, Variant)>,
    /// The event type and its supertypes.
    types: Vec<NodeId>,
}

impl Forwarded {
    fn new(event: ForwardedEvent, types: Vec<NodeId>) -> Self {
        let base = BaseEventType {
            event_id: event.event_id,
            event_type: event.event_type,
            source_node: event.source,
            source_name: event.source_name,
            time: event.time,
            receive_time: DateTime::now(),
            message: event.message,
            severity: event.severity,
            ..BaseEventType::default()
        };
        Self {
            base,
            fields: event.fields,
            types,
        }
    }
}

crate::impl_event!(
    Forwarded,
    |event, id| event.types.contains(id),
    |event, path| {
        let own = event.fields.iter().find(|(own, _)| own == path);
        own.map(|(_, value)| value.clone())
    }
);

/// Maximum number of namespaces of a server.
const MOST_NAMESPACES: usize = 4_096;
