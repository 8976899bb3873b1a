//! The nodes of conditions. The address space has no values of them: they are read from the
//! condition.

use opcua::nodes::{ObjectBuilder, ReferenceDirection, VariableBuilder};
use opcua::server::address_space::{AddressSpace, EventNotifier};
use opcua::types::{
    DataTypeId, Identifier, LocalizedText, MethodId, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, VariableTypeId,
};

use super::event::{ConditionIdentity, ConditionType};
use crate::address::{self, alarms_folder};

/// A variable of a condition: its path, its DataType and its type.
type Spec = (&'static str, DataTypeId, VariableTypeId);

const PROPERTY: VariableTypeId = VariableTypeId::PropertyType;
const TWO_STATE: VariableTypeId = VariableTypeId::TwoStateVariableType;
const CONDITION: VariableTypeId = VariableTypeId::ConditionVariableType;

/// The mandatory variables of AlarmConditionType.
const ALARM: &[Spec] = &[
    ("EventId", DataTypeId::ByteString, PROPERTY),
    ("EventType", DataTypeId::NodeId, PROPERTY),
    ("SourceNode", DataTypeId::NodeId, PROPERTY),
    ("SourceName", DataTypeId::String, PROPERTY),
    ("Time", DataTypeId::UtcTime, PROPERTY),
    ("ReceiveTime", DataTypeId::UtcTime, PROPERTY),
    ("Message", DataTypeId::LocalizedText, PROPERTY),
    ("Severity", DataTypeId::UInt16, PROPERTY),
    ("ConditionClassId", DataTypeId::NodeId, PROPERTY),
    ("ConditionClassName", DataTypeId::LocalizedText, PROPERTY),
    ("ConditionName", DataTypeId::String, PROPERTY),
    ("BranchId", DataTypeId::NodeId, PROPERTY),
    ("Retain", DataTypeId::Boolean, PROPERTY),
    ("EnabledState", DataTypeId::LocalizedText, TWO_STATE),
    ("EnabledState.Id", DataTypeId::Boolean, PROPERTY),
    ("Quality", DataTypeId::StatusCode, CONDITION),
    ("Quality.SourceTimestamp", DataTypeId::UtcTime, PROPERTY),
    ("LastSeverity", DataTypeId::UInt16, CONDITION),
    (
        "LastSeverity.SourceTimestamp",
        DataTypeId::UtcTime,
        PROPERTY,
    ),
    ("Comment", DataTypeId::LocalizedText, CONDITION),
    ("Comment.SourceTimestamp", DataTypeId::UtcTime, PROPERTY),
    ("ClientUserId", DataTypeId::String, PROPERTY),
    ("AckedState", DataTypeId::LocalizedText, TWO_STATE),
    ("AckedState.Id", DataTypeId::Boolean, PROPERTY),
    ("ActiveState", DataTypeId::LocalizedText, TWO_STATE),
    ("ActiveState.Id", DataTypeId::Boolean, PROPERTY),
    ("InputNode", DataTypeId::NodeId, PROPERTY),
    ("SuppressedOrShelved", DataTypeId::Boolean, PROPERTY),
];

const CONFIRMED: &[Spec] = &[
    ("ConfirmedState", DataTypeId::LocalizedText, TWO_STATE),
    ("ConfirmedState.Id", DataTypeId::Boolean, PROPERTY),
];

const OFF_NORMAL: &[Spec] = &[("NormalState", DataTypeId::NodeId, PROPERTY)];

const DELAYED: &[Spec] = &[("OnDelay", DataTypeId::Duration, PROPERTY)];

const EXCLUSIVE: &[Spec] = &[
    (
        "LimitState.CurrentState",
        DataTypeId::LocalizedText,
        VariableTypeId::FiniteStateVariableType,
    ),
    ("LimitState.CurrentState.Id", DataTypeId::NodeId, PROPERTY),
];

/// The limits in the order of [`ConditionIdentity::limits`].
const LIMITS: [Spec; 4] = [
    ("LowLowLimit", DataTypeId::Double, PROPERTY),
    ("LowLimit", DataTypeId::Double, PROPERTY),
    ("HighLimit", DataTypeId::Double, PROPERTY),
    ("HighHighLimit", DataTypeId::Double, PROPERTY),
];

/// The states of the limits of a non-exclusive alarm.
const LIMIT_STATES: [[Spec; 2]; 4] = [
    [
        ("LowLowState", DataTypeId::LocalizedText, TWO_STATE),
        ("LowLowState.Id", DataTypeId::Boolean, PROPERTY),
    ],
    [
        ("LowState", DataTypeId::LocalizedText, TWO_STATE),
        ("LowState.Id", DataTypeId::Boolean, PROPERTY),
    ],
    [
        ("HighState", DataTypeId::LocalizedText, TWO_STATE),
        ("HighState.Id", DataTypeId::Boolean, PROPERTY),
    ],
    [
        ("HighHighState", DataTypeId::LocalizedText, TWO_STATE),
        ("HighHighState.Id", DataTypeId::Boolean, PROPERTY),
    ],
];

/// Returns the variables of a condition. The parent of a variable comes before it.
fn specs(identity: &ConditionIdentity) -> Vec<Spec> {
    let mut specs = ALARM.to_vec();
    if identity.confirms {
        specs.extend(CONFIRMED);
    }
    if identity.kind.is_off_normal() {
        specs.extend(OFF_NORMAL);
    }
    if !identity.delay.is_zero() {
        specs.extend(DELAYED);
    }
    for (at, limit) in identity.limits.iter().enumerate() {
        if limit.is_none() {
            continue;
        }
        specs.extend(LIMITS.get(at));
        if identity.kind == ConditionType::NonExclusiveLevel {
            specs.extend(LIMIT_STATES.get(at).into_iter().flatten());
        }
    }
    if identity.kind == ConditionType::ExclusiveLevel {
        specs.extend(EXCLUSIVE);
    }
    specs
}

/// Returns the node of a variable of a condition.
fn below(condition: &NodeId, path: &str) -> NodeId {
    let Identifier::String(id) = &condition.identifier else {
        return NodeId::null();
    };
    NodeId::new(condition.namespace, format!("{id}{SEPARATOR}{path}"))
}

/// Returns the condition of a variable and the path of the variable in it.
pub(super) fn split(node: &NodeId) -> Option<(NodeId, Vec<&str>)> {
    let Identifier::String(id) = &node.identifier else {
        return None;
    };
    let (condition, path) = id.as_ref().rsplit_once(SEPARATOR)?;
    let condition = NodeId::new(node.namespace, condition);
    Some((condition, path.split('.').collect()))
}

/// Returns the variables of a condition with their paths.
pub(super) fn variables(
    identity: &ConditionIdentity,
) -> impl Iterator<Item = (NodeId, &'static str)> {
    let specs = specs(identity).into_iter();
    specs.map(|(path, ..)| (below(&identity.node, path), path))
}

/// Adds the folder of all conditions, which is the notifier of their events.
pub(super) fn add_folder(address_space: &mut AddressSpace) {
    let folder = alarms_folder();
    if address_space.node_exists(&folder) {
        return;
    }
    ObjectBuilder::new(
        &folder,
        QualifiedName::new(folder.namespace, "Alarms"),
        LocalizedText::from("Alarms"),
    )
    .is_folder()
    .event_notifier(EventNotifier::SUBSCRIBE_TO_EVENTS | EventNotifier::HISTORY_READ)
    .organized_by(address::root())
    .reference(
        ObjectId::Server,
        ReferenceTypeId::HasNotifier,
        ReferenceDirection::Inverse,
    )
    .insert(address_space);
}

/// Adds a condition.
pub(super) fn insert(address_space: &mut AddressSpace, identity: &ConditionIdentity) {
    remove(address_space, identity);
    let node = &identity.node;
    ObjectBuilder::new(
        node,
        QualifiedName::new(node.namespace, identity.name.as_str()),
        LocalizedText::from(identity.name.as_str()),
    )
    .has_type_definition(identity.kind.type_id())
    .component_of(alarms_folder())
    .insert(address_space);
    if identity.kind == ConditionType::ExclusiveLevel {
        ObjectBuilder::new(&below(node, "LimitState"), "LimitState", "LimitState")
            .has_type_definition(ObjectTypeId::ExclusiveLimitStateMachineType)
            .component_of(node.clone())
            .insert(address_space);
    }
    for (path, data_type, kind) in specs(identity) {
        let (parent, name) = match path.rsplit_once('.') {
            Some((parent, name)) => (below(node, parent), name),
            None => (node.clone(), path),
        };
        let reference = if kind == PROPERTY {
            ReferenceTypeId::HasProperty
        } else {
            ReferenceTypeId::HasComponent
        };
        VariableBuilder::new(&below(node, path), name, name)
            .data_type(data_type)
            .value_rank(-1)
            .has_type_definition(kind)
            .reference(parent, reference, ReferenceDirection::Inverse)
            .insert(address_space);
    }
    // The methods of the type serve all conditions.
    let methods = METHODS.into_iter();
    for method in methods.chain(identity.confirms.then_some(CONFIRM)) {
        address_space.insert_reference(node, &method.into(), ReferenceTypeId::HasComponent);
    }
    address_space.insert_reference(&identity.source, node, ReferenceTypeId::HasCondition);
    address_space.insert_reference(
        &alarms_folder(),
        &identity.source,
        ReferenceTypeId::HasEventSource,
    );
}

/// Removes a condition.
pub(super) fn remove(address_space: &mut AddressSpace, identity: &ConditionIdentity) {
    let node = &identity.node;
    if !address_space.node_exists(node) {
        return;
    }
    for (variable, _) in variables(identity) {
        drop(address_space.delete(&variable, true));
    }
    drop(address_space.delete(&below(node, "LimitState"), true));
    drop(address_space.delete(node, true));
}

/// The methods of every condition.
const METHODS: [MethodId; 4] = [
    MethodId::ConditionType_Enable,
    MethodId::ConditionType_Disable,
    MethodId::ConditionType_AddComment,
    MethodId::AcknowledgeableConditionType_Acknowledge,
];
const CONFIRM: MethodId = MethodId::AcknowledgeableConditionType_Confirm;
/// Separates the id of a condition from the path of its variable.
const SEPARATOR: char = '|';

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variable_of_a_condition_is_found_whatever_the_name_of_the_condition() {
        let condition = NodeId::new(1, "ua_1_2_10.alarm/arm|left/a.b");
        let node = below(&condition, "LimitState.CurrentState.Id");
        let (found, path) = split(&node).unwrap();
        assert_eq!(found, condition);
        assert_eq!(path, ["LimitState", "CurrentState", "Id"]);
        assert_eq!(split(&NodeId::new(2, 10)), None);
    }
}
