//! Values and attributes that the library does not serve: values of the core namespace, and the
//! attributes of permissions (OPC 10000-3, 5.2.9 to 5.2.11, 5.6.2).

use std::sync::Arc;

use opcua::nodes::NodeType;
use opcua::server::CreateMonitoredItem;
use opcua::server::address_space::AddressSpace;
use opcua::server::node_manager::{HistoryNode, ParsedReadValueId, ReadNode, RequestContext};
use opcua::types::{
    AttributeId, DataValue, DateTime, ExtensionObject, NodeClass, NodeId, ObjectId, PermissionType,
    ReadEventDetails, RolePermissionType, StatusCode, TimestampsToReturn, VariableId, Variant,
};

use crate::users::{NodePermissions, Roles, UserAccess, UserRole};

/// A value of a variable of the core namespace.
#[derive(Clone)]
pub enum CoreValue {
    /// A constant.
    Fixed(Variant),
    /// A value that is computed for each request.
    Read(Arc<dyn Fn(&RequestContext) -> Variant + Send + Sync>),
}

impl From<Variant> for CoreValue {
    fn from(value: Variant) -> Self {
        Self::Fixed(value)
    }
}

/// The class of a node, and the AccessLevel of a variable.
#[derive(Debug, Clone, Copy)]
pub struct NodeFacts {
    class: NodeClass,
    access_level: Option<u8>,
}

impl NodeFacts {
    /// Returns the facts of a node.
    #[must_use]
    pub fn of(node: &NodeType) -> Self {
        let access_level = match node {
            NodeType::Variable(variable) => Some(variable.access_level().bits()),
            NodeType::Object(_)
            | NodeType::ObjectType(_)
            | NodeType::ReferenceType(_)
            | NodeType::VariableType(_)
            | NodeType::View(_)
            | NodeType::DataType(_)
            | NodeType::Method(_) => None,
        };
        Self {
            class: node.node_class(),
            access_level,
        }
    }

    /// Returns the facts of a node of an address space.
    #[must_use]
    pub fn find(address_space: &AddressSpace, node: &NodeId) -> Option<Self> {
        address_space.find(node).map(Self::of)
    }
}

/// Values and attributes that the library does not serve.
#[derive(Clone)]
pub struct Supplement {
    values: Vec<(VariableId, CoreValue)>,
    access: Option<Arc<UserAccess>>,
    /// The history of the events of the Server object.
    events: Option<Arc<dyn EventHistory>>,
    started: DateTime,
}

/// A history of events (OPC 10000-11, 6.4.2).
pub trait EventHistory: Send + Sync + 'static {
    /// Reads the events of a request, and sets the result and status of `node`.
    fn read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        node: &mut HistoryNode,
    );
}

impl Supplement {
    /// Creates a supplement with values of the core namespace. Without `access`, nodes have no
    /// RolePermissions.
    #[must_use]
    pub fn new(values: Vec<(VariableId, CoreValue)>, access: Option<Arc<UserAccess>>) -> Self {
        Self {
            values,
            access,
            events: None,
            started: DateTime::now(),
        }
    }

    /// Adds the history of the events of the Server object.
    #[must_use]
    pub fn with_events(self, events: Arc<dyn EventHistory>) -> Self {
        Self {
            events: Some(events),
            ..self
        }
    }

    /// Returns true if the Server object has a history of events.
    pub(crate) const fn has_events(&self) -> bool {
        self.events.is_some()
    }

    /// Reads the history of the events of the Server object.
    pub(crate) fn read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        nodes: &mut [&mut HistoryNode],
    ) {
        let Some(events) = &self.events else { return };
        for node in nodes {
            if *node.node_id() == ObjectId::Server {
                events.read_events(context, details, node);
            }
        }
    }

    /// Replaces results of the library. `find` returns the facts of a node.
    pub fn complete(
        &self,
        context: &RequestContext,
        timestamps: TimestampsToReturn,
        nodes: &mut [&mut ReadNode],
        find: impl Fn(&NodeId) -> Option<NodeFacts>,
    ) {
        for node in nodes {
            let wanted = node.node();
            if wanted.attribute_id == AttributeId::Value {
                let replaced = may_replace(node.status());
                let value = replaced.then(|| self.value(context, node.node(), timestamps));
                if let Some(value) = value.flatten() {
                    node.set_result(value);
                }
            } else if node.status() == StatusCode::BadAttributeIdInvalid
                && let Some(facts) = find(&wanted.node_id)
                && let Some(value) = self.attribute(context, wanted, facts)
            {
                node.set_result(DataValue {
                    status: Some(StatusCode::Good),
                    ..DataValue::value_only(value)
                });
            }
        }
    }

    /// Replaces the initial values of monitored items.
    pub fn begin(&self, context: &RequestContext, items: &mut [&mut CreateMonitoredItem]) {
        for item in items {
            let wanted = item.item_to_monitor();
            if wanted.attribute_id != AttributeId::Value || !item.status_code().is_good() {
                continue;
            }
            let value = self.value(context, wanted, TimestampsToReturn::Both);
            if let Some(value) = value {
                item.set_initial_value(value);
            }
        }
    }

    fn value(
        &self,
        context: &RequestContext,
        wanted: &ParsedReadValueId,
        timestamps: TimestampsToReturn,
    ) -> Option<DataValue> {
        let id = wanted.node_id.as_variable_id().ok()?;
        let (_, value) = self.values.iter().find(|(known, _)| *known == id)?;
        let now = DateTime::now();
        let (value, source) = match value {
            CoreValue::Fixed(value) => (value.clone(), self.started),
            CoreValue::Read(read) => (read(context), now),
        };
        let (value, status) = if wanted.index_range.has_range() {
            match value.range_of(&wanted.index_range) {
                Ok(part) => (Some(part), StatusCode::Good),
                Err(status) => (None, status),
            }
        } else {
            (Some(value), StatusCode::Good)
        };
        let both = timestamps == TimestampsToReturn::Both;
        Some(DataValue {
            value,
            status: Some(status),
            source_timestamp: (both || timestamps == TimestampsToReturn::Source).then_some(source),
            server_timestamp: (both || timestamps == TimestampsToReturn::Server).then_some(now),
            ..DataValue::default()
        })
    }

    fn attribute(
        &self,
        context: &RequestContext,
        wanted: &ParsedReadValueId,
        facts: NodeFacts,
    ) -> Option<Variant> {
        let node = &wanted.node_id;
        match wanted.attribute_id {
            AttributeId::AccessLevelEx => {
                // Reads and writes of arrays are atomic, and parts of arrays can be written, so
                // the further bits are 0.
                let level = facts.access_level?;
                Some(Variant::UInt32(level.into()))
            }
            AttributeId::AccessRestrictions => {
                let is_encrypted = self.access.as_ref()?.is_encrypted(node);
                let restrictions = if is_encrypted { ENCRYPTION_REQUIRED } else { 0 };
                Some(Variant::UInt16(restrictions))
            }
            AttributeId::RolePermissions => {
                let permissions = self.access.as_ref()?.permissions(node);
                Some(listed(permissions, Roles::ALL, facts.class))
            }
            AttributeId::UserRolePermissions => {
                let access = self.access.as_ref()?;
                let roles = access.roles(&context.token);
                Some(listed(access.permissions(node), roles, facts.class))
            }
            AttributeId::NodeId
            | AttributeId::NodeClass
            | AttributeId::BrowseName
            | AttributeId::DisplayName
            | AttributeId::Description
            | AttributeId::WriteMask
            | AttributeId::UserWriteMask
            | AttributeId::IsAbstract
            | AttributeId::Symmetric
            | AttributeId::InverseName
            | AttributeId::ContainsNoLoops
            | AttributeId::EventNotifier
            | AttributeId::Value
            | AttributeId::DataType
            | AttributeId::ValueRank
            | AttributeId::ArrayDimensions
            | AttributeId::AccessLevel
            | AttributeId::UserAccessLevel
            | AttributeId::MinimumSamplingInterval
            | AttributeId::Historizing
            | AttributeId::Executable
            | AttributeId::UserExecutable
            | AttributeId::DataTypeDefinition => None,
        }
    }
}

/// Returns whether a value can replace a result of the library. The library has no value for a part
/// of these variables.
fn may_replace(status: StatusCode) -> bool {
    !status.is_bad() || status == StatusCode::BadIndexRangeNoData
}

/// Returns the permissions of roles on a node.
fn listed(permissions: NodePermissions, roles: Roles, class: NodeClass) -> Variant {
    let all = roles.iter().map(|role| RolePermissionType {
        role_id: node_of(role).into(),
        permissions: bits(permissions, role, class),
    });
    let all: Vec<ExtensionObject> = all.map(ExtensionObject::from_message).collect();
    Variant::from(all)
}

/// Returns the permissions of a role on a node of a class.
fn bits(permissions: NodePermissions, role: UserRole, class: NodeClass) -> PermissionType {
    let mut bits = PermissionType::Browse | PermissionType::ReadRolePermissions;
    let (read, write) = match class {
        NodeClass::Variable => (
            PermissionType::Read | PermissionType::ReadHistory,
            PermissionType::Write,
        ),
        NodeClass::VariableType => (PermissionType::Read, PermissionType::empty()),
        NodeClass::Object | NodeClass::View => {
            (PermissionType::ReceiveEvents, PermissionType::empty())
        }
        NodeClass::Unspecified
        | NodeClass::Method
        | NodeClass::ObjectType
        | NodeClass::ReferenceType
        | NodeClass::DataType => (PermissionType::empty(), PermissionType::empty()),
    };
    if permissions.read.contains(role) {
        bits |= read;
    }
    if permissions.write.contains(role) {
        bits |= write;
    }
    if class == NodeClass::Method && permissions.call.contains(role) {
        bits |= PermissionType::Call;
    }
    bits
}

/// Returns the node of a role.
pub(super) const fn node_of(role: UserRole) -> ObjectId {
    match role {
        UserRole::Observer => ObjectId::WellKnownRole_Observer,
        UserRole::Operator => ObjectId::WellKnownRole_Operator,
        UserRole::Engineer => ObjectId::WellKnownRole_Engineer,
        UserRole::SecurityAdmin => ObjectId::WellKnownRole_SecurityAdmin,
        UserRole::ConfigureAdmin => ObjectId::WellKnownRole_ConfigureAdmin,
    }
}

/// EncryptionRequired of AccessRestrictionType.
const ENCRYPTION_REQUIRED: u16 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn permissions_are_those_of_the_class_and_of_the_role() {
        let usual = NodePermissions::default();
        let seen = PermissionType::Browse | PermissionType::ReadRolePermissions;
        let read = seen | PermissionType::Read | PermissionType::ReadHistory;
        let variable = |role| bits(usual, role, NodeClass::Variable);
        assert_eq!(variable(UserRole::Observer), read);
        assert_eq!(variable(UserRole::Operator), read | PermissionType::Write);
        let method = |role| bits(usual, role, NodeClass::Method);
        assert_eq!(method(UserRole::Observer), seen);
        assert_eq!(method(UserRole::Engineer), seen | PermissionType::Call);
        assert_eq!(bits(usual, UserRole::Engineer, NodeClass::DataType), seen);
    }

    #[test]
    fn a_part_of_a_value_that_the_library_lacks_is_replaced_and_a_refusal_is_not() {
        assert!(may_replace(StatusCode::Good));
        assert!(may_replace(StatusCode::BadIndexRangeNoData));
        assert!(!may_replace(StatusCode::BadUserAccessDenied));
    }
}
