//! The conditions on the page of the server.

use opcua::server::SubscriptionCache;
use opcua::server::authenticator::UserToken;
use opcua::types::{ByteString, LocalizedText, MethodId, NodeId, ObjectTypeId, StatusCode};
use plant_opcua::audit::{Audit, AuditedAction as Audited};
use plant_opcua::users::{Right, UserAccess};
use supervisor::{ConditionAction, ConditionChange, ConditionState, MOST_CONDITIONS};
use uadp::Timestamp;

use super::condition::{Action, AlarmCondition};
use super::event::ConditionIdentity;
use super::methods::LONGEST_COMMENT;
use super::{Alarms, EventStamp};
use crate::value;

impl Alarms {
    /// Returns the states of the conditions: open conditions first, by falling severity.
    pub(crate) fn states(&self) -> Vec<ConditionState> {
        let inner = self.inner.lock();
        let all = inner.conditions.values();
        let all = all.map(|entry| state(&entry.identity, &entry.condition));
        let mut all: Vec<ConditionState> = all.collect();
        drop(inner);
        all.sort_by(|one, other| {
            let key = |one: &ConditionState| (!one.is_open(), u16::MAX - one.severity);
            key(one)
                .cmp(&key(other))
                .then_with(|| one.name.cmp(&other.name))
        });
        all.truncate(MOST_CONDITIONS);
        all
    }

    /// Changes a condition for a user of the page, and reports it to the audit as the Method of an
    /// OPC UA client.
    ///
    /// # Errors
    /// Returns `BadUserAccessDenied`, or the status of the Method.
    pub(crate) fn change(
        &self,
        change: &ConditionChange,
        (user, server): (&str, &str),
        (access, subscriptions): (&UserAccess, &SubscriptionCache),
    ) -> Result<(), StatusCode> {
        let (method, kind, source) = match change.action {
            ConditionAction::Acknowledge => (
                MethodId::AcknowledgeableConditionType_Acknowledge,
                ObjectTypeId::AuditConditionAcknowledgeEventType,
                "Method/Acknowledge",
            ),
            ConditionAction::Confirm => (
                MethodId::AcknowledgeableConditionType_Confirm,
                ObjectTypeId::AuditConditionConfirmEventType,
                "Method/Confirm",
            ),
        };
        let method = NodeId::from(method);
        let may = access.allows(&UserToken(user.to_owned()), &method, Right::Call);
        let (condition, event) = match ids(change) {
            Ok(ids) => ids,
            Err(status) if may => return Err(status),
            // The denial is audited, without the ids.
            Err(_) => (NodeId::null(), ByteString::null()),
        };
        // An empty comment leaves the comment of the condition as it is.
        let comment = match change.comment.trim() {
            "" => LocalizedText::null(),
            text => LocalizedText::from(text),
        };
        let done = match may {
            false => Err(StatusCode::BadUserAccessDenied),
            true if change.comment.len() > LONGEST_COMMENT => Err(StatusCode::BadOutOfRange),
            true => {
                let action = Action {
                    user: user.to_owned(),
                    comment: comment.clone(),
                };
                let act = |one: &mut AlarmCondition, stamp: EventStamp| match change.action {
                    ConditionAction::Acknowledge => one.acknowledge(&event, action, stamp),
                    ConditionAction::Confirm => one.confirm(&event, action, stamp),
                };
                self.act(&condition, user, act)
            }
        };
        let action = Audited::Condition {
            source,
            kind,
            condition,
            method,
            event: Some(event),
            comment: Some(comment),
        };
        let status = done.err().unwrap_or(StatusCode::Good);
        Audit::without_session(action, status, user, server).tell(subscriptions);
        done
    }
}

/// Returns the NodeId of the condition and the id of the event.
fn ids(change: &ConditionChange) -> Result<(NodeId, ByteString), StatusCode> {
    let condition = change.condition.parse();
    let condition = condition.map_err(|_| StatusCode::BadNodeIdUnknown)?;
    let event = bytes(&change.event).ok_or(StatusCode::BadEventIdUnknown)?;
    Ok((condition, ByteString::from(event)))
}

fn state(identity: &ConditionIdentity, condition: &AlarmCondition) -> ConditionState {
    let state = condition.state();
    let time = Timestamp {
        time: value::ticks(state.event.time),
        picoseconds: 0,
    };
    ConditionState {
        condition: identity.node.to_string(),
        event: hexadecimal(&state.event.id),
        name: identity.name.clone(),
        severity: state.severity,
        level: state.levels.name(),
        is_active: state.active.on,
        is_enabled: state.enabled.on,
        is_acknowledged: state.acked.on,
        is_confirmed: state.confirmed.on,
        message: state.message.clone(),
        comment: state.comment.0.text.as_ref().to_owned(),
        user: state.user.clone(),
        since_ms: i64::try_from(time.unix_nanos() / 1_000_000).unwrap_or_default(),
    }
}

/// Returns an event id in hexadecimal.
pub(super) fn hexadecimal(id: &ByteString) -> String {
    let bytes = id.as_ref().iter();
    bytes.map(|byte| format!("{byte:02x}")).collect()
}

/// Parses an event id in hexadecimal.
pub(super) fn bytes(text: &str) -> Option<Vec<u8>> {
    if text.len() > LONGEST_ID || !text.is_ascii() || !text.len().is_multiple_of(2) {
        return None;
    }
    let pairs = text.as_bytes().chunks_exact(2);
    let bytes = pairs.map(|pair| {
        let pair = std::str::from_utf8(pair).ok()?;
        u8::from_str_radix(pair, 16).ok()
    });
    bytes.collect()
}

/// The longest event id in hexadecimal.
const LONGEST_ID: usize = 64;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use opcua::types::DateTime;

    use super::super::condition::{Levels, SourceReport};
    use super::super::event::ConditionType;
    use super::*;

    #[test]
    fn event_ids_are_hexadecimal() {
        assert_eq!(bytes("00ff10"), Some(vec![0, 255, 16]));
        for wrong in ["0", "0g", "\u{e9}", &"00".repeat(40)] {
            assert_eq!(bytes(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_condition_is_shown_with_the_id_that_acknowledges_it() {
        let stamp = |number: u8| EventStamp {
            time: DateTime::now(),
            id: ByteString::from(vec![number; 16]),
        };
        let mut condition = AlarmCondition::new(true, 500, stamp(1));
        let report = SourceReport {
            levels: Levels::HIGH,
            severity: 700,
            message: "Speed is 7: High".to_owned(),
            quality: StatusCode::Good,
        };
        let _effect = condition.report(report, stamp(2));
        let identity = ConditionIdentity {
            node: NodeId::new(1, "ua_0_2_30.alarm"),
            kind: ConditionType::ExclusiveLevel,
            source: NodeId::new(2, 30),
            source_name: "Speed".to_owned(),
            name: "Speed".to_owned(),
            input: NodeId::new(2, 30),
            limits: [None, None, Some(5.0), None],
            normal: NodeId::null(),
            confirms: true,
            delay: Duration::ZERO,
        };
        let shown = state(&identity, &condition);
        assert!(shown.is_open() && shown.is_active && !shown.is_acknowledged);
        assert_eq!((shown.level, shown.severity), ("High", 700));
        let change = ConditionChange {
            condition: shown.condition.clone(),
            event: shown.event,
            action: ConditionAction::Acknowledge,
            comment: String::new(),
        };
        let (node, event) = ids(&change).unwrap();
        assert_eq!(node, identity.node);
        let action = Action {
            user: "anna".to_owned(),
            comment: LocalizedText::null(),
        };
        condition.acknowledge(&event, action, stamp(3)).unwrap();
        let shown = state(&identity, &condition);
        assert!(shown.is_acknowledged && !shown.is_confirmed);
        assert_eq!(shown.user, "anna");
    }
}
