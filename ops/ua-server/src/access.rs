//! Permissions of clients on the nodes of the space, as the mapping defines them.

use std::collections::HashMap;

use mappings::{Mapping, Permissions as Said};
use opcua::server::node_manager::RequestContext;
use opcua::sync::Mutex;
use opcua::types::{MethodId, NodeId, StatusCode};
use plant_opcua::certificates::application_uri;
use plant_opcua::configuration::Configuration;
use plant_opcua::users::{AnonymousRights, NodePermissions, PermissionRules, Roles, UserRole};
use tracing::warn;

use crate::address;
use crate::alarms;
use crate::layout::{Layout, node_id};

/// Records, for each session, if its ApplicationUri matches its certificate.
///
/// The unpatched library does not compare the two when a session is created (OPC 10000-4, 5.7.2).
/// The space refuses every request of a session with the ApplicationUri of another application.
#[derive(Default)]
pub(crate) struct Genuine(Mutex<HashMap<u32, bool>>);

impl Genuine {
    /// # Errors
    /// Returns `BadCertificateUriInvalid` if the ApplicationUri of the session differs from the
    /// ApplicationUri of its certificate.
    pub(crate) fn check(&self, context: &RequestContext) -> Result<(), StatusCode> {
        let known = self.0.lock().get(&context.session_id).copied();
        let genuine = known.unwrap_or_else(|| {
            let genuine = is_genuine(context);
            let mut all = self.0.lock();
            if all.len() >= MOST_REMEMBERED {
                all.clear();
            }
            all.insert(context.session_id, genuine);
            genuine
        });
        if genuine {
            Ok(())
        } else {
            Err(StatusCode::BadCertificateUriInvalid)
        }
    }
}

fn is_genuine(context: &RequestContext) -> bool {
    let session = context.session.read();
    let Some(certificate) = session.client_certificate() else {
        return true;
    };
    let said = &session.application_description().application_uri;
    let genuine = application_uri(certificate).is_some_and(|uri| uri == said.as_ref());
    if !genuine {
        warn!(
            said = ?said.as_ref(),
            thumbprint = certificate.thumbprint().as_hex_string(),
            "rejected a client: its certificate has another ApplicationUri than the client announces"
        );
    }
    genuine
}

/// Largest number of cached sessions. At this number the cache is cleared, and sessions are checked
/// again.
const MOST_REMEMBERED: usize = 10_000;

/// Returns the access rules of a mapping for the nodes of its layout.
pub(crate) fn rules(mapping: &Mapping, layout: &Layout) -> PermissionRules {
    let mut nodes = HashMap::new();
    for topic in &layout.topics {
        let said = mapping.variable(topic.topic).map(|one| &*one.permissions);
        let Some(said) = said.filter(|said| **said != Said::default()) else {
            continue;
        };
        let usual = NodePermissions::default();
        let permissions = NodePermissions {
            read: said.read.as_deref().map_or(usual.read, roles),
            write: said.write.as_deref().map_or(usual.write, roles),
            ..usual
        };
        nodes.extend(topic.nodes().map(|node| (node.clone(), permissions)));
    }
    for call in mapping.calls() {
        let Some(callers) = &call.callers else {
            continue;
        };
        let permissions = NodePermissions {
            call: roles(callers),
            ..NodePermissions::default()
        };
        // The parts of an action are Methods too. The first part has the node of the mapping or a
        // node of its own.
        nodes.insert(node_id(&call.node), permissions);
        for topic in call.topics() {
            nodes.insert(address::unmapped_call(topic), permissions);
        }
    }
    // Methods of the core namespace are open to every client by default.
    let switches = SWITCHES.map(|method| (method.into(), NodePermissions::default()));
    nodes.extend(switches);
    nodes.extend(alarms::permissions());
    let certificates = NodePermissions {
        call: roles(&[mappings::Role::SecurityAdmin]),
        ..NodePermissions::default()
    };
    nodes.extend(Configuration::nodes().map(|method| (method, certificates)));
    let keys: NodeId = MethodId::PublishSubscribe_GetSecurityKeys.into();
    PermissionRules {
        anonymous: anonymous(mapping.server().anonymous),
        nodes,
        encrypted: Configuration::nodes().chain([keys]).collect(),
    }
}

/// Methods that change which messages are sent and received.
const SWITCHES: [MethodId; 3] = [
    MethodId::PublishSubscribe_Status_Enable,
    MethodId::PublishSubscribe_Status_Disable,
    MethodId::PublishSubscribe_Diagnostics_Reset,
];

fn anonymous(said: mappings::Anonymous) -> AnonymousRights {
    match said {
        mappings::Anonymous::Usual => AnonymousRights::Usual,
        mappings::Anonymous::Refused => AnonymousRights::Refused,
        mappings::Anonymous::Has(has) => AnonymousRights::Has(roles(&[has])),
    }
}

fn roles(said: &[mappings::Role]) -> Roles {
    let roles = said.iter().map(|role| match role {
        mappings::Role::Observer => UserRole::Observer,
        mappings::Role::Operator => UserRole::Operator,
        mappings::Role::Engineer => UserRole::Engineer,
        mappings::Role::SecurityAdmin => UserRole::SecurityAdmin,
    });
    roles.collect()
}
