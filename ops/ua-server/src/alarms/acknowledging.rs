//! Acknowledging an alarm by a call of the space, which bridges offer as a service of ROS.

use bridge_node::{CallDescription, CallField, CallRole, Executed, Execution, Refusal};
use mappings::Call;
use opcua::types::{
    ByteString, LocalizedText, MethodId, NodeId, ObjectTypeId, StatusCode, Variant,
};
use plant_opcua::audit::{Audit, AuditedAction as Audited};
use uadp::{BuiltinType, Fields, Scalar};

use super::condition::Action;
use super::methods::LONGEST_COMMENT;
use super::{Alarms, page};
use crate::value;

/// The request of a call: the id of an event in hexadecimal, and a comment.
#[derive(Debug, PartialEq, Eq)]
struct Request<'a> {
    event: &'a str,
    comment: &'a str,
}

/// Returns the description of a call that acknowledges alarms.
pub(crate) fn description(call: &Call) -> CallDescription {
    let text = |name: &str| CallField::scalar(name, BuiltinType::String);
    CallDescription {
        name: call.name.clone(),
        about: call.about.clone(),
        role: CallRole::Call,
        request: vec![text("event_id"), text("comment")],
        response: vec![
            CallField::scalar("success", BuiltinType::Boolean),
            text("message"),
        ],
    }
}

impl Alarms {
    /// Executes a call that acknowledges an alarm. The comment names the space of the caller as its
    /// user.
    pub(crate) fn execute(&self, execution: &Execution) -> Executed {
        let Some(request) = Request::decoded(&execution.request) else {
            return Executed::Refused(Refusal::InvalidArgument);
        };
        let user = match execution.requestor {
            Some(space) => format!("space {space}"),
            None => "a space".to_owned(),
        };
        let done = self.acknowledge(&request, &user);
        let message = done.err().map_or_else(String::new, reason);
        let response = [Variant::from(done.is_ok()), Variant::from(message)];
        match value::fields_block(&response) {
            Ok(block) => Executed::Answered(block),
            Err(status) => Executed::Failed(uadp::StatusCode(status.bits())),
        }
    }

    /// Acknowledges the condition of an event, and reports it to the audit as the Method of an OPC
    /// UA client.
    ///
    /// # Errors
    /// Returns the status of the Method.
    fn acknowledge(&self, request: &Request<'_>, user: &str) -> Result<(), StatusCode> {
        if request.comment.len() > LONGEST_COMMENT {
            return Err(StatusCode::BadOutOfRange);
        }
        let place = self.place.get().ok_or(StatusCode::BadShutdown)?;
        let event = page::bytes(request.event).ok_or(StatusCode::BadEventIdUnknown)?;
        let event = ByteString::from(event);
        let comment = match request.comment.trim() {
            "" => LocalizedText::null(),
            text => LocalizedText::from(text),
        };
        let condition = self.condition_of(&event);
        let action = Action {
            user: user.to_owned(),
            comment: comment.clone(),
        };
        let done = match &condition {
            Some(node) => self.act(node, user, |one, stamp| {
                one.acknowledge(&event, action, stamp)
            }),
            None => Err(StatusCode::BadEventIdUnknown),
        };
        let action = Audited::Condition {
            source: "Method/Acknowledge",
            kind: ObjectTypeId::AuditConditionAcknowledgeEventType,
            condition: condition.unwrap_or_else(NodeId::null),
            method: MethodId::AcknowledgeableConditionType_Acknowledge.into(),
            event: Some(event),
            comment: Some(comment),
        };
        let status = done.err().unwrap_or(StatusCode::Good);
        let server = place.handle.info().application_uri.as_ref();
        let audit = Audit::without_session(action, status, user, server);
        audit.tell(place.handle.subscriptions());
        done
    }

    /// Returns the condition with a recent event of that id.
    fn condition_of(&self, event: &ByteString) -> Option<NodeId> {
        let inner = self.inner.lock();
        let mut all = inner.conditions.iter();
        let found = all.find(|(_, entry)| entry.condition.has_event(event));
        found.map(|(node, _)| node.clone())
    }
}

impl<'a> Request<'a> {
    /// Decodes the fields of a request.
    fn decoded(request: &'a [u8]) -> Option<Self> {
        let mut fields = Fields::parse(request).ok()?;
        let mut text = || {
            let uadp::Variant::Scalar(Scalar::String(text)) = fields.next()?.ok()? else {
                return None;
            };
            Some(text.unwrap_or_default())
        };
        let (event, comment) = (text()?, text()?);
        fields.next().is_none().then_some(Self { event, comment })
    }
}

/// Returns the reason of a status, for users of ROS.
fn reason(status: StatusCode) -> String {
    match status {
        StatusCode::BadEventIdUnknown => {
            "no alarm has this event_id: the alarm has changed, or the id is of another server"
                .to_owned()
        }
        StatusCode::BadConditionBranchAlreadyAcked => "it is acknowledged already".to_owned(),
        StatusCode::BadConditionDisabled => "the condition is disabled".to_owned(),
        StatusCode::BadOutOfRange => {
            format!("the comment is longer than {LONGEST_COMMENT} bytes")
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_two_texts() {
        let block = |fields: &[Variant]| value::fields_block(fields).unwrap();
        let decoded = block(&["0aff".into(), "on my way".into()]);
        let request = Request {
            event: "0aff",
            comment: "on my way",
        };
        assert_eq!(Request::decoded(&decoded), Some(request));
        let wrong = [
            block(&["0aff".into()]),
            block(&["0aff".into(), 5_i32.into()]),
            block(&["0aff".into(), "".into(), "".into()]),
            vec![9],
        ];
        for request in wrong {
            assert_eq!(Request::decoded(&request), None, "{request:?}");
        }
    }

    #[test]
    fn without_a_server_no_alarm_is_acknowledged() {
        let alarms = Alarms::default();
        let request = Request {
            event: "00",
            comment: "",
        };
        let refused = alarms.acknowledge(&request, "space 1");
        assert_eq!(refused, Err(StatusCode::BadShutdown));
    }
}
