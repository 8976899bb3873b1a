//! Conditions as events: the fields of AlarmConditionType and its subtypes (OPC 10000-9, 5). The
//! nodes of a condition show the same fields.

use std::sync::Arc;
use std::time::Duration;

use opcua::nodes::{BaseEventType, Event, EventField};
use opcua::types::{
    AttributeId, DateTime, LocalizedText, NodeId, NumericRange, ObjectId, ObjectTypeId,
    QualifiedName, Variant,
};

use super::condition::{AlarmConditionState, EventStamp, Levels, TwoState};

/// The type of a condition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ConditionType {
    ExclusiveLevel,
    NonExclusiveLevel,
    Discrete,
    OffNormal,
    /// A fault of the communication with a publisher.
    SystemOffNormal,
    /// A status of a robot's diagnostics.
    SystemDiagnostic,
}

impl ConditionType {
    /// Returns the type and its supertypes.
    pub(crate) const fn types(self) -> &'static [ObjectTypeId] {
        match self {
            Self::ExclusiveLevel => &[
                ObjectTypeId::ExclusiveLevelAlarmType,
                ObjectTypeId::ExclusiveLimitAlarmType,
                ObjectTypeId::LimitAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
            Self::NonExclusiveLevel => &[
                ObjectTypeId::NonExclusiveLevelAlarmType,
                ObjectTypeId::NonExclusiveLimitAlarmType,
                ObjectTypeId::LimitAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
            Self::Discrete => &[
                ObjectTypeId::DiscreteAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
            Self::OffNormal => &[
                ObjectTypeId::OffNormalAlarmType,
                ObjectTypeId::DiscreteAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
            Self::SystemOffNormal => &[
                ObjectTypeId::SystemOffNormalAlarmType,
                ObjectTypeId::OffNormalAlarmType,
                ObjectTypeId::DiscreteAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
            Self::SystemDiagnostic => &[
                ObjectTypeId::SystemDiagnosticAlarmType,
                ObjectTypeId::OffNormalAlarmType,
                ObjectTypeId::DiscreteAlarmType,
                ObjectTypeId::AlarmConditionType,
                ObjectTypeId::AcknowledgeableConditionType,
                ObjectTypeId::ConditionType,
                ObjectTypeId::BaseEventType,
            ],
        }
    }

    /// Returns the type itself.
    pub(crate) fn type_id(self) -> NodeId {
        self.types()
            .first()
            .copied()
            .map(NodeId::from)
            .unwrap_or_default()
    }

    /// Returns true if the alarm has limits.
    const fn has_limits(self) -> bool {
        matches!(self, Self::ExclusiveLevel | Self::NonExclusiveLevel)
    }

    /// Returns true if the value is normal or off normal.
    pub(crate) const fn is_off_normal(self) -> bool {
        match self {
            Self::OffNormal | Self::SystemOffNormal | Self::SystemDiagnostic => true,
            Self::ExclusiveLevel | Self::NonExclusiveLevel | Self::Discrete => false,
        }
    }
}

/// The constant properties of a condition.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ConditionIdentity {
    /// The ConditionId, which is also the node of the condition.
    pub(crate) node: NodeId,
    pub(crate) kind: ConditionType,
    /// The node that the condition is about.
    pub(crate) source: NodeId,
    pub(crate) source_name: String,
    /// The ConditionName.
    pub(crate) name: String,
    /// The variable with the value; null without a value.
    pub(crate) input: NodeId,
    /// LowLow, Low, High and HighHigh.
    pub(crate) limits: [Option<f64>; 4],
    /// The variable that shows the normal value; null without a normal value.
    pub(crate) normal: NodeId,
    /// True if the condition has a ConfirmedState.
    pub(crate) confirms: bool,
    pub(crate) delay: Duration,
}

impl ConditionIdentity {
    fn class(&self) -> (ObjectTypeId, &'static str) {
        match self.kind {
            ConditionType::SystemOffNormal => (ObjectTypeId::SystemConditionClassType, "System"),
            ConditionType::SystemDiagnostic => {
                (ObjectTypeId::MaintenanceConditionClassType, "Maintenance")
            }
            ConditionType::ExclusiveLevel
            | ConditionType::NonExclusiveLevel
            | ConditionType::Discrete
            | ConditionType::OffNormal => (ObjectTypeId::ProcessConditionClassType, "Process"),
        }
    }

    /// Returns the limit of a level.
    fn limit(&self, name: &str) -> Option<f64> {
        let at = LEVELS.iter().position(|(level, _)| *level == name)?;
        self.limits.get(at).copied()?
    }
}

/// The levels in the order of the limits.
const LEVELS: [(&str, Levels); 4] = [
    ("LowLow", Levels::LOW_LOW),
    ("Low", Levels::LOW),
    ("High", Levels::HIGH),
    ("HighHigh", Levels::HIGH_HIGH),
];

/// A condition in a state.
#[derive(Debug, Clone)]
pub(crate) struct ConditionEvent {
    identity: Arc<ConditionIdentity>,
    state: AlarmConditionState,
    event_type: NodeId,
}

impl ConditionEvent {
    pub(crate) fn new(identity: &Arc<ConditionIdentity>, state: &AlarmConditionState) -> Self {
        Self {
            event_type: identity.kind.type_id(),
            identity: Arc::clone(identity),
            state: state.clone(),
        }
    }

    /// Returns the value of the field with this path of names in the core namespace. Returns
    /// `None` for a field that the condition does not have.
    pub(crate) fn field(&self, path: &[&str]) -> Option<Variant> {
        let (identity, state) = (&*self.identity, &self.state);
        let (name, below) = path.split_first()?;
        let value: Variant = match (*name, below) {
            ("EventId", []) => state.event.id.clone().into(),
            ("EventType", []) => self.event_type.clone().into(),
            ("SourceNode", []) => identity.source.clone().into(),
            ("SourceName", []) => identity.source_name.as_str().into(),
            ("Time" | "ReceiveTime", []) => state.event.time.into(),
            ("Message", []) => LocalizedText::new("en", &state.message).into(),
            ("Severity", []) => state.severity.into(),
            ("ConditionClassId", []) => NodeId::from(identity.class().0).into(),
            ("ConditionClassName", []) => english(identity.class().1),
            ("ConditionName", []) => identity.name.as_str().into(),
            ("BranchId", []) => NodeId::null().into(),
            ("Retain", []) => state.retain().into(),
            ("EnabledState", below) => two_state(state.enabled, ["Disabled", "Enabled"], below)?,
            ("Quality", []) => state.quality.0.into(),
            ("Quality", ["SourceTimestamp"]) => state.quality.1.into(),
            ("LastSeverity", []) => state.last_severity.0.into(),
            ("LastSeverity", ["SourceTimestamp"]) => state.last_severity.1.into(),
            ("Comment", []) => state.comment.0.clone().into(),
            ("Comment", ["SourceTimestamp"]) => state.comment.1.into(),
            ("ClientUserId", []) => state.user.as_str().into(),
            ("AckedState", below) => {
                two_state(state.acked, ["Unacknowledged", "Acknowledged"], below)?
            }
            ("ConfirmedState", below) if identity.confirms => {
                two_state(state.confirmed, ["Unconfirmed", "Confirmed"], below)?
            }
            ("ActiveState", ["EffectiveDisplayName"]) if identity.kind.has_limits() => {
                english(state.levels.name())
            }
            ("ActiveState", below) => two_state(state.active, ["Inactive", "Active"], below)?,
            ("InputNode", []) => identity.input.clone().into(),
            ("SuppressedOrShelved", []) => false.into(),
            ("OnDelay", []) if !identity.delay.is_zero() => {
                (identity.delay.as_secs_f64() * 1000.0).into()
            }
            ("NormalState", []) if identity.kind.is_off_normal() => identity.normal.clone().into(),
            (name, below) => self.limit_field(name, below)?,
        };
        Some(value)
    }

    /// Returns a field of LimitAlarmType and its subtypes.
    fn limit_field(&self, name: &str, below: &[&str]) -> Option<Variant> {
        let (identity, state) = (&*self.identity, &self.state);
        if let (Some(level), []) = (name.strip_suffix("Limit"), below) {
            return identity.limit(level).map(Variant::from);
        }
        match (identity.kind, name, below) {
            (ConditionType::ExclusiveLevel, "LimitState", ["CurrentState"]) => {
                Some(if state.active.on {
                    english(state.levels.name())
                } else {
                    Variant::from(LocalizedText::null())
                })
            }
            (ConditionType::ExclusiveLevel, "LimitState", ["CurrentState", "Id"]) => {
                Some(limit_state(state.levels).into())
            }
            (ConditionType::NonExclusiveLevel, name, below) => {
                let (level, flag) = LEVELS
                    .iter()
                    .find(|(level, _)| name.strip_suffix("State") == Some(level))?;
                identity.limit(level)?;
                let on = TwoState {
                    on: state.levels.has(*flag),
                    at: state.event.time,
                };
                match below {
                    [] => Some(english(if on.on { level } else { "Inactive" })),
                    ["Id"] => Some(on.on.into()),
                    _ => None,
                }
            }
            _ => None,
        }
    }

    fn browsed(&self, path: &[QualifiedName]) -> Option<Variant> {
        let core = path.iter().all(|name| name.namespace_index == 0);
        let names: Vec<&str> = path.iter().map(|name| name.name.as_ref()).collect();
        self.field(core.then_some(&names[..])?)
    }
}

fn english(text: &str) -> Variant {
    LocalizedText::new("en", text).into()
}

/// Returns a field of a TwoStateVariable (OPC 10000-9, 5.2).
fn two_state(state: TwoState, texts: [&str; 2], below: &[&str]) -> Option<Variant> {
    let [off, on] = texts;
    match below {
        [] | ["EffectiveDisplayName"] => Some(english(if state.on { on } else { off })),
        ["Id"] => Some(state.on.into()),
        ["TransitionTime"] => Some(state.at.into()),
        ["TrueState"] => Some(english(on)),
        ["FalseState"] => Some(english(off)),
        _ => None,
    }
}

/// Returns the state of an ExclusiveLimitStateMachine; null if the alarm is inactive.
fn limit_state(levels: Levels) -> NodeId {
    let state = match levels.outermost() {
        Levels::HIGH_HIGH => ObjectId::ExclusiveLimitStateMachineType_HighHigh,
        Levels::HIGH => ObjectId::ExclusiveLimitStateMachineType_High,
        Levels::LOW => ObjectId::ExclusiveLimitStateMachineType_Low,
        Levels::LOW_LOW => ObjectId::ExclusiveLimitStateMachineType_LowLow,
        _ => return NodeId::null(),
    };
    state.into()
}

impl Event for ConditionEvent {
    fn get_field(
        &self,
        type_definition_id: &NodeId,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        browse_path: &[QualifiedName],
    ) -> Variant {
        let types = self.identity.kind.types();
        if !types.iter().any(|known| *type_definition_id == *known) {
            return Variant::Empty;
        }
        self.get_value(attribute_id, index_range, browse_path)
    }

    fn time(&self) -> &DateTime {
        &self.state.event.time
    }

    fn event_type_id(&self) -> &NodeId {
        &self.event_type
    }
}

impl EventField for ConditionEvent {
    fn get_value(
        &self,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        remaining_path: &[QualifiedName],
    ) -> Variant {
        match (attribute_id, remaining_path) {
            // The ConditionId (OPC 10000-9, 5.5.2).
            (AttributeId::NodeId, []) => self.identity.node.clone().into(),
            (AttributeId::Value, path) => {
                let value = self.browsed(path).unwrap_or_default();
                value.range_of_owned(index_range).unwrap_or_default()
            }
            _ => Variant::Empty,
        }
    }
}

/// Returns an event about the conditions of the whole server: RefreshStartEventType,
/// RefreshEndEventType or RefreshRequiredEventType (OPC 10000-9, 5.11).
pub(crate) fn refresh(kind: ObjectTypeId, stamp: EventStamp) -> RefreshEvent {
    let message = if kind == ObjectTypeId::RefreshStartEventType {
        "the conditions follow"
    } else if kind == ObjectTypeId::RefreshEndEventType {
        "all conditions were sent"
    } else {
        "the conditions have changed"
    };
    RefreshEvent {
        kind,
        base: BaseEventType {
            event_id: stamp.id,
            event_type: kind.into(),
            source_node: ObjectId::Server.into(),
            source_name: "Server".into(),
            time: stamp.time,
            receive_time: stamp.time,
            message: LocalizedText::new("en", message),
            severity: 100,
            ..BaseEventType::default()
        },
    }
}

/// An event about the conditions of the whole server.
pub(crate) struct RefreshEvent {
    kind: ObjectTypeId,
    base: BaseEventType,
}

plant_opcua::impl_event!(
    RefreshEvent,
    |event, id| {
        let types = [
            event.kind,
            ObjectTypeId::SystemEventType,
            ObjectTypeId::BaseEventType,
        ];
        types.iter().any(|known| *id == *known)
    },
    |_, _| None
);

#[cfg(test)]
mod tests {
    use opcua::types::{ByteString, StatusCode};

    use super::super::condition::{AlarmCondition, SourceReport};
    use super::*;

    fn event(kind: ConditionType, levels: Levels) -> ConditionEvent {
        let identity = ConditionIdentity {
            node: NodeId::new(1, "ua_1_2_10.alarm"),
            kind,
            source: NodeId::new(2, 10),
            source_name: "Temperature".to_owned(),
            name: "Alarm".to_owned(),
            input: NodeId::new(2, 10),
            limits: [None, Some(0.0), Some(70.0), Some(90.0)],
            normal: NodeId::null(),
            confirms: false,
            delay: Duration::ZERO,
        };
        let stamp = EventStamp {
            time: DateTime::from(1_000),
            id: ByteString::from(vec![1]),
        };
        let mut condition = AlarmCondition::new(false, 500, stamp.clone());
        let report = SourceReport {
            levels,
            severity: 500,
            message: "hot".to_owned(),
            quality: StatusCode::Good,
        };
        condition.report(report, stamp);
        ConditionEvent::new(&Arc::new(identity), condition.state())
    }

    fn selected(event: &ConditionEvent, of: ObjectTypeId, path: &[&str]) -> Variant {
        let path: Vec<QualifiedName> = path.iter().map(|name| (*name).into()).collect();
        event.get_field(&of.into(), AttributeId::Value, &NumericRange::None, &path)
    }

    #[test]
    fn the_condition_id_is_the_node_id_of_the_event() {
        let event = event(ConditionType::Discrete, Levels::ON);
        let of = |kind: ObjectTypeId, attribute| {
            event.get_field(&kind.into(), attribute, &NumericRange::None, &[])
        };
        let node = Variant::from(NodeId::new(1, "ua_1_2_10.alarm"));
        assert_eq!(of(ObjectTypeId::ConditionType, AttributeId::NodeId), node);
        let other = of(ObjectTypeId::LimitAlarmType, AttributeId::NodeId);
        assert_eq!(other, Variant::Empty, "of another type");
        let value = of(ObjectTypeId::ConditionType, AttributeId::Value);
        assert_eq!(value, Variant::Empty);
    }

    #[test]
    fn a_field_is_selected_by_each_type_above_the_event_type() {
        let event = event(ConditionType::ExclusiveLevel, Levels::HIGH_HIGH);
        let active = ["ActiveState", "Id"];
        for kind in [
            ObjectTypeId::BaseEventType,
            ObjectTypeId::AlarmConditionType,
        ] {
            assert_eq!(selected(&event, kind, &active), Variant::from(true));
        }
        let state = selected(
            &event,
            ObjectTypeId::ExclusiveLimitAlarmType,
            &["LimitState", "CurrentState", "Id"],
        );
        let high_high = NodeId::from(ObjectId::ExclusiveLimitStateMachineType_HighHigh);
        assert_eq!(state, Variant::from(high_high));
        let limit = selected(&event, ObjectTypeId::LimitAlarmType, &["HighHighLimit"]);
        assert_eq!(limit, Variant::from(90.0));
        let none = selected(&event, ObjectTypeId::LimitAlarmType, &["LowLowLimit"]);
        assert_eq!(none, Variant::Empty);
        let confirmed = selected(&event, ObjectTypeId::BaseEventType, &["ConfirmedState"]);
        assert_eq!(confirmed, Variant::Empty, "without confirmation");
    }

    #[test]
    fn a_non_exclusive_alarm_has_a_state_for_each_of_its_limits() {
        let levels = Levels::HIGH.with(Levels::HIGH_HIGH);
        let event = event(ConditionType::NonExclusiveLevel, levels);
        let id = |name| selected(&event, ObjectTypeId::BaseEventType, &[name, "Id"]);
        assert_eq!(id("HighState"), Variant::from(true));
        assert_eq!(id("HighHighState"), Variant::from(true));
        assert_eq!(id("LowState"), Variant::from(false));
        assert_eq!(id("LowLowState"), Variant::Empty);
    }
}
