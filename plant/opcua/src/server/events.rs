//! The events of state machines: TransitionEventType, ProgramTransitionEventType and its subtypes.
//!
//! The generated structs of the library cannot carry the NodeId of a state. The event of this
//! module supports select clauses of the three types of the core namespace and of the declared
//! type.

use opcua::nodes::{BaseEventType, Event};
use opcua::server::SubscriptionCache;
use opcua::types::{
    ByteString, DateTime, LocalizedText, NodeId, ObjectTypeId, QualifiedName, Variant,
};

/// A state or a transition of a state machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateRef {
    /// The name, for example `ReadyToRunning`.
    pub name: String,
    /// The node of the state or transition, in the type of the state machine.
    pub id: NodeId,
    /// The number of the state or transition in the type.
    pub number: u32,
}

/// A transition of a program (OPC 10000-10, 5.2.5).
#[derive(Debug, Clone)]
pub struct TransitionEvent {
    /// The state machine.
    pub source: NodeId,
    /// The name of the state machine.
    pub source_name: String,
    /// ProgramTransitionEventType or a subtype of it.
    pub event_type: NodeId,
    /// The message text.
    pub message: String,
    /// The severity, 1 to 1000.
    pub severity: u16,
    /// The previous state.
    pub from_state: StateRef,
    /// The present state.
    pub to_state: StateRef,
    /// The transition between the states.
    pub transition: StateRef,
    /// The IntermediateResult of the program.
    pub intermediate_result: Variant,
    /// The further fields of the declared type.
    pub fields: Vec<(QualifiedName, Variant)>,
    /// The time of the transition.
    pub time: DateTime,
}

impl TransitionEvent {
    /// Creates a BaseEventType event of a state machine that stays in its state.
    #[must_use]
    pub fn without_transition(
        (source, source_name): (NodeId, &str),
        state: StateRef,
        (message, severity): (&str, u16),
    ) -> Self {
        Self {
            source,
            source_name: source_name.to_owned(),
            event_type: ObjectTypeId::BaseEventType.into(),
            message: message.to_owned(),
            severity,
            from_state: state.clone(),
            to_state: state,
            transition: StateRef {
                name: String::new(),
                id: NodeId::null(),
                number: 0,
            },
            intermediate_result: Variant::Empty,
            fields: Vec::new(),
            time: DateTime::now(),
        }
    }

    /// Raises the event on its source and on the Server object, as a ProgramTransitionEventType
    /// without subtype. A [`OpcUaServer`](super::OpcUaServer) also raises events of its own types.
    pub fn raise(&self, subscriptions: &SubscriptionCache) {
        let types = [
            ObjectTypeId::ProgramTransitionEventType,
            ObjectTypeId::TransitionEventType,
            ObjectTypeId::BaseEventType,
        ];
        let types = types.map(NodeId::from).to_vec();
        let id = opcua::crypto::random::byte_string(16);
        let raised = Raised::new(self, types, id);
        subscriptions.notify_events([(&raised as &dyn Event, &self.source)].into_iter());
    }
}

/// A transition event as an OPC UA event.
pub(crate) struct Raised {
    base: BaseEventType,
    event: TransitionEvent,
    /// The event type and its supertypes.
    types: Vec<NodeId>,
}

impl Raised {
    pub(crate) fn new(event: &TransitionEvent, types: Vec<NodeId>, id: ByteString) -> Self {
        let base = BaseEventType {
            event_id: id,
            event_type: event.event_type.clone(),
            source_node: event.source.clone(),
            source_name: event.source_name.as_str().into(),
            time: event.time,
            receive_time: event.time,
            message: LocalizedText::from(&event.message),
            severity: event.severity,
            ..BaseEventType::default()
        };
        Self {
            base,
            event: event.clone(),
            types,
        }
    }

    fn state(&self, state: &StateRef, is_transition: bool, below: Option<&str>) -> Variant {
        let text = || LocalizedText::from(&state.name);
        match below {
            None | Some("EffectiveDisplayName") => text().into(),
            Some("Id") => state.id.clone().into(),
            Some("Name") => QualifiedName::from(state.name.as_str()).into(),
            Some("Number") => state.number.into(),
            Some("TransitionTime" | "EffectiveTransitionTime") if is_transition => {
                self.event.time.into()
            }
            Some(_) => Variant::Empty,
        }
    }

    fn field(&self, path: &[QualifiedName]) -> Option<Variant> {
        let names: Vec<&str> = path.iter().map(|name| name.name.as_ref()).collect();
        let core = path.iter().all(|name| name.namespace_index == 0);
        let own = self
            .event
            .fields
            .iter()
            .find(|(name, _)| path == [name.clone()]);
        if let Some((_, value)) = own {
            return Some(value.clone());
        }
        if !core {
            return None;
        }
        let (first, below) = match names.as_slice() {
            [first] => (*first, None),
            [first, below] => (*first, Some(*below)),
            _ => return None,
        };
        match first {
            "FromState" => Some(self.state(&self.event.from_state, false, below)),
            "ToState" => Some(self.state(&self.event.to_state, false, below)),
            "Transition" => Some(self.state(&self.event.transition, true, below)),
            "IntermediateResult" if below.is_none() => Some(self.event.intermediate_result.clone()),
            _ => None,
        }
    }
}

crate::impl_event!(
    Raised,
    |event, id| event.types.contains(id),
    |event, path| event.field(path)
);

/// Returns the types with select clauses that apply to events of this type.
pub(crate) fn answered(event_type: &NodeId, supertypes: Vec<&NodeId>) -> Vec<NodeId> {
    let above = supertypes.into_iter().cloned();
    let mut types: Vec<NodeId> = std::iter::once(event_type.clone()).chain(above).collect();
    types.retain(|id| *id != ObjectTypeId::BaseObjectType);
    types
}
