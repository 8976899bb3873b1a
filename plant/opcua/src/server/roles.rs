//! The RoleSet of a server (OPC 10000-18, 4.3): the roles that the server knows, and the identities
//! that have them. Roles are managed by commands of the program, so that clients cannot change
//! them.

use std::sync::Arc;

use opcua::nodes::{DefaultTypeTree, NodeType};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    BrowseDirection, ExtensionObject, IdentityCriteriaType, IdentityMappingRuleType, MethodId,
    NodeId, ObjectId, ReferenceTypeId, UAString, VariableId, Variant,
};

use super::supplement::CoreValue;
use crate::users::{UserAccess, UserRole};

/// Removes the roles that the server does not know, and the parts of roles that it does not
/// support, from the core namespace.
pub fn prepare(core: &mut AddressSpace) {
    for role in UNKNOWN {
        delete(core, &role.into());
    }
    let known = UserRole::ALL
        .iter()
        .copied()
        .map(super::supplement::node_of);
    for role in known.chain([
        ObjectId::WellKnownRole_Anonymous,
        ObjectId::WellKnownRole_AuthenticatedUser,
    ]) {
        for part in parts(core, &role.into()) {
            let is_identities = core
                .find(&part)
                .is_some_and(|node| node.as_node().browse_name().name.as_ref() == "Identities");
            if !is_identities {
                delete(core, &part);
            }
        }
    }
    for method in [
        MethodId::Server_ServerCapabilities_RoleSet_AddRole,
        MethodId::Server_ServerCapabilities_RoleSet_RemoveRole,
    ] {
        if let Some(NodeType::Method(method)) = core.find_mut(&method.into()) {
            method.set_executable(false);
            method.set_user_executable(false);
        }
    }
}

/// Returns the Identities of the roles. Names and certificates of users are returned to users with
/// the role SecurityAdmin only.
#[must_use]
pub fn values(access: &Arc<UserAccess>) -> Vec<(VariableId, CoreValue)> {
    let fixed = |criteria| CoreValue::from(rules(vec![rule(criteria, "")]));
    let mut values = vec![
        (
            VariableId::WellKnownRole_Anonymous_Identities,
            fixed(IdentityCriteriaType::Anonymous),
        ),
        (
            VariableId::WellKnownRole_AuthenticatedUser_Identities,
            fixed(IdentityCriteriaType::AuthenticatedUser),
        ),
    ];
    values.extend(IDENTITIES.map(|(role, variable)| {
        let access = Arc::clone(access);
        let read = CoreValue::Read(Arc::new(move |context| {
            let sees = access
                .roles(&context.token)
                .contains(UserRole::SecurityAdmin);
            identities(&access, role, sees)
        }));
        (variable, read)
    }));
    values
}

fn identities(access: &UserAccess, role: UserRole, with_users: bool) -> Variant {
    let mut all = Vec::new();
    if access.roles_of_anonymous().contains(role) {
        all.push(rule(IdentityCriteriaType::Anonymous, ""));
    }
    if with_users {
        let users = access.users_of(role).into_iter();
        all.extend(users.map(|(name, certificate)| match certificate {
            // Thumbprints of identity rules are upper-case (OPC 10000-18, 4.4.2).
            Some(thumbprint) => rule(
                IdentityCriteriaType::Thumbprint,
                &thumbprint.to_ascii_uppercase(),
            ),
            None => rule(IdentityCriteriaType::UserName, &name),
        }));
    }
    rules(all)
}

fn rule(criteria_type: IdentityCriteriaType, criteria: &str) -> IdentityMappingRuleType {
    IdentityMappingRuleType {
        criteria_type,
        criteria: UAString::from(criteria),
    }
}

fn rules(all: Vec<IdentityMappingRuleType>) -> Variant {
    let all: Vec<ExtensionObject> = all.into_iter().map(ExtensionObject::from_message).collect();
    Variant::from(all)
}

/// Returns the components and properties of a node.
fn parts(core: &AddressSpace, node: &NodeId) -> Vec<NodeId> {
    let types = DefaultTypeTree::new();
    let kinds = [ReferenceTypeId::HasComponent, ReferenceTypeId::HasProperty];
    let references = kinds.into_iter().flat_map(|kind| {
        core.find_references(node, Some((kind, false)), &types, BrowseDirection::Forward)
    });
    references
        .map(|reference| reference.target_node.clone())
        .collect()
}

/// Deletes a node with its components and properties.
fn delete(core: &mut AddressSpace, node: &NodeId) {
    for part in parts(core, node) {
        delete(core, &part);
    }
    drop(core.delete(node, true));
}

/// Well-known roles that no user can have.
const UNKNOWN: [ObjectId; 5] = [
    ObjectId::WellKnownRole_Supervisor,
    ObjectId::WellKnownRole_TrustedApplication,
    ObjectId::WellKnownRole_SecurityKeyServerAdmin,
    ObjectId::WellKnownRole_SecurityKeyServerPush,
    ObjectId::WellKnownRole_SecurityKeyServerAccess,
];

const IDENTITIES: [(UserRole, VariableId); 5] = [
    (
        UserRole::Observer,
        VariableId::WellKnownRole_Observer_Identities,
    ),
    (
        UserRole::Operator,
        VariableId::WellKnownRole_Operator_Identities,
    ),
    (
        UserRole::Engineer,
        VariableId::WellKnownRole_Engineer_Identities,
    ),
    (
        UserRole::SecurityAdmin,
        VariableId::WellKnownRole_SecurityAdmin_Identities,
    ),
    (
        UserRole::ConfigureAdmin,
        VariableId::WellKnownRole_ConfigureAdmin_Identities,
    ),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::users::{AnonymousRights, PermissionRules, Roles};

    #[test]
    fn a_role_has_the_identities_that_its_rules_grant() {
        let access = UserAccess::new(None, false).unwrap();
        access.set_rules(PermissionRules {
            anonymous: AnonymousRights::Has(Roles::of(&[UserRole::Operator])),
            ..PermissionRules::default()
        });
        let anonymous = rules(vec![rule(IdentityCriteriaType::Anonymous, "")]);
        assert_eq!(identities(&access, UserRole::Operator, true), anonymous);
        assert_eq!(
            identities(&access, UserRole::Observer, true),
            rules(Vec::new())
        );
    }
}
