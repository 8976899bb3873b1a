//! Audit events of writes and calls of clients.

use opcua::server::node_manager::{MethodCall, RequestContext, WriteNode};
use opcua::types::{AttributeId, NodeId, NumericRange, StatusCode, Variant};
use plant_opcua::audit::{Audit, AuditedAction};
use plant_opcua::users::Login;

use crate::nodes::SpaceManager;

/// The state of a node before a write.
pub(crate) struct PreviousState {
    node: NodeId,
    /// True if every client may read the node. Audit events are visible to all clients.
    is_public: bool,
    old: Variant,
}

/// Returns the values of the nodes before they are written. The values of nodes with restricted
/// read access, and large values, are omitted.
pub(crate) fn before(space: &SpaceManager, writes: &[&mut WriteNode]) -> Vec<PreviousState> {
    let before = writes.iter().map(|write| {
        let node = write.value().node_id.clone();
        let is_public = space.inner().is_public(&node);
        let shown = || space.inner().shown_at(&node).filter(is_small);
        let old = is_public.then(shown).flatten();
        PreviousState {
            node,
            is_public,
            old: old.unwrap_or_default(),
        }
    });
    before.collect()
}

/// Reports writes and their results to the audit.
pub(crate) fn wrote(
    context: &RequestContext,
    before: Vec<PreviousState>,
    (writes, done): (&[&mut WriteNode], Result<(), StatusCode>),
) {
    for (before, write) in before.into_iter().zip(writes) {
        let PreviousState {
            node,
            is_public,
            old,
        } = before;
        let value = write.value();
        if value.attribute_id != AttributeId::Value {
            continue;
        }
        let new = value
            .value
            .value
            .as_ref()
            .filter(|new| is_public && is_small(new));
        let action = AuditedAction::Wrote {
            new: new.cloned().unwrap_or_default(),
            range: range_text(&value.index_range),
            node,
            old,
        };
        tell(
            context,
            action,
            done.err().unwrap_or_else(|| write.status()),
        );
    }
}

/// Reports calls and their results to the audit.
pub(crate) fn called(
    context: &RequestContext,
    (calls, done): (&[&mut MethodCall], Result<(), StatusCode>),
) {
    for call in calls {
        let action = AuditedAction::Called {
            object: call.object_id().clone(),
            method: call.method_id().clone(),
        };
        tell(context, action, done.err().unwrap_or_else(|| call.status()));
    }
}

/// Returns the audit event of a login, successful or refused.
pub(crate) fn came_in(login: &Login, server: &str) -> Audit {
    let action = AuditedAction::CameIn {
        by: login.by,
        endpoint: login.endpoint.clone(),
    };
    let status = login.fault.map_or(StatusCode::Good, |fault| fault.status());
    Audit::without_session(action, status, &login.user, server)
}

/// Returns true if a value is small enough for an audit event.
fn is_small(value: &Variant) -> bool {
    if let Variant::Array(array) = value {
        return array.values.len() <= MOST_ELEMENTS && array.values.iter().all(is_small);
    }
    if let Variant::String(text) = value {
        return text.as_ref().len() <= MOST_BYTES;
    }
    if let Variant::ByteString(bytes) = value {
        return bytes.as_ref().len() <= MOST_BYTES;
    }
    value.is_numeric() || matches!(value, Variant::Boolean(_) | Variant::DateTime(_))
}

fn range_text(range: &NumericRange) -> String {
    if matches!(range, NumericRange::None) {
        return String::new();
    }
    range.to_string()
}

fn tell(context: &RequestContext, action: AuditedAction, status: StatusCode) {
    Audit::of(context, action, status).tell(&context.subscriptions);
}

/// Largest number of elements and bytes of a value in an audit event.
const MOST_ELEMENTS: usize = 64;
const MOST_BYTES: usize = 1_024;
