//! The methods of conditions. Clients call the methods of the types with a condition as the object
//! (OPC 10000-9, 5.5 and 5.7), and ConditionRefresh with the type itself.

use std::sync::Arc;

use opcua::server::node_manager::MethodCall;
use opcua::types::{
    ByteString, LocalizedText, MethodId, NodeId, ObjectTypeId, StatusCode, Variant,
};
use plant_opcua::audit::AuditedAction as Audited;
use plant_opcua::server::{CoreMethod, MethodHandler, MethodRefusal, MethodRequest, method};
use plant_opcua::users::NodePermissions;

use super::Alarms;
use super::condition::{Action, AlarmCondition};

impl Alarms {
    /// Returns the methods of all conditions.
    pub(crate) fn methods(self: &Arc<Self>) -> Vec<CoreMethod> {
        let of_type = |id: MethodId, name: &str, act: Act| {
            let alarms = Arc::clone(self);
            let handler: Arc<dyn MethodHandler> = method(move |request| {
                let done = act(&alarms, &request);
                done.map(|()| Vec::new()).map_err(MethodRefusal::Status)
            });
            CoreMethod::of_type(id.into(), name, handler)
        };
        let acknowledge = MethodId::AcknowledgeableConditionType_Acknowledge;
        let confirm = MethodId::AcknowledgeableConditionType_Confirm;
        let add_comment = MethodId::ConditionType_AddComment;
        let (enable, disable) = (
            MethodId::ConditionType_Enable,
            MethodId::ConditionType_Disable,
        );
        let refresh = MethodId::ConditionType_ConditionRefresh;
        let refresh2 = MethodId::ConditionType_ConditionRefresh2;
        vec![
            of_type(acknowledge, "Acknowledge", Self::call_acknowledge).audited(|call| {
                let kind = ObjectTypeId::AuditConditionAcknowledgeEventType;
                audit(call, kind, "Method/Acknowledge")
            }),
            of_type(confirm, "Confirm", Self::call_confirm).audited(|call| {
                let kind = ObjectTypeId::AuditConditionConfirmEventType;
                audit(call, kind, "Method/Confirm")
            }),
            of_type(add_comment, "AddComment", Self::call_add_comment).audited(|call| {
                let kind = ObjectTypeId::AuditConditionCommentEventType;
                audit(call, kind, "Method/AddComment")
            }),
            of_type(enable, "Enable", Self::call_enable).audited(|call| {
                let kind = ObjectTypeId::AuditConditionEnableEventType;
                audit(call, kind, "Method/Enable")
            }),
            of_type(disable, "Disable", Self::call_disable).audited(|call| {
                let kind = ObjectTypeId::AuditConditionEnableEventType;
                audit(call, kind, "Method/Disable")
            }),
            of_type(refresh, "ConditionRefresh", Self::call_refresh),
            of_type(refresh2, "ConditionRefresh2", Self::call_refresh2),
        ]
    }

    fn call_acknowledge(&self, request: &MethodRequest) -> Done {
        let (event, action) = action(request)?;
        let act = |one: &mut AlarmCondition, stamp| one.acknowledge(&event, action, stamp);
        self.act(&request.object, &request.caller.user, act)
    }

    fn call_confirm(&self, request: &MethodRequest) -> Done {
        let (event, action) = action(request)?;
        let act = |one: &mut AlarmCondition, stamp| one.confirm(&event, action, stamp);
        self.act(&request.object, &request.caller.user, act)
    }

    fn call_add_comment(&self, request: &MethodRequest) -> Done {
        let (event, action) = action(request)?;
        let act = |one: &mut AlarmCondition, stamp| one.add_comment(&event, action, stamp);
        self.act(&request.object, &request.caller.user, act)
    }

    fn call_enable(&self, request: &MethodRequest) -> Done {
        let user = &request.caller.user;
        self.act(&request.object, user, |one, stamp| one.enable(user, stamp))
    }

    fn call_disable(&self, request: &MethodRequest) -> Done {
        let user = &request.caller.user;
        self.act(&request.object, user, |one, stamp| one.disable(user, stamp))
    }

    fn call_refresh(&self, request: &MethodRequest) -> Done {
        self.refresh(request.caller.session, number(request, 0)?, None)
    }

    fn call_refresh2(&self, request: &MethodRequest) -> Done {
        let item = Some(number(request, 1)?);
        self.refresh(request.caller.session, number(request, 0)?, item)
    }
}

type Done = Result<(), StatusCode>;
type Act = fn(&Alarms, &MethodRequest) -> Done;

/// Returns the methods that change conditions, for operators and engineers.
pub(crate) fn permissions() -> impl Iterator<Item = (NodeId, NodePermissions)> {
    let methods = [
        MethodId::AcknowledgeableConditionType_Acknowledge,
        MethodId::AcknowledgeableConditionType_Confirm,
        MethodId::ConditionType_AddComment,
        MethodId::ConditionType_Enable,
        MethodId::ConditionType_Disable,
    ];
    methods
        .into_iter()
        .map(|method| (method.into(), NodePermissions::default()))
}

fn number(request: &MethodRequest, at: usize) -> Result<u32, StatusCode> {
    match request.arguments.get(at) {
        Some(Variant::UInt32(number)) => Ok(*number),
        Some(_) | None => Err(StatusCode::BadInvalidArgument),
    }
}

/// Returns the EventId and the Comment of a call.
fn arguments(arguments: &[Variant]) -> Option<(ByteString, LocalizedText)> {
    let [Variant::ByteString(event), comment] = arguments else {
        return None;
    };
    if let Variant::LocalizedText(comment) = comment {
        return Some((event.clone(), (**comment).clone()));
    }
    let is_null = matches!(comment, Variant::Empty);
    is_null.then(|| (event.clone(), LocalizedText::null()))
}

fn action(request: &MethodRequest) -> Result<(ByteString, Action), StatusCode> {
    let (event, comment) = arguments(&request.arguments).ok_or(StatusCode::BadInvalidArgument)?;
    if comment.text.as_ref().len() + comment.locale.as_ref().len() > LONGEST_COMMENT {
        return Err(StatusCode::BadOutOfRange);
    }
    let user = request.caller.user.clone();
    Ok((event, Action { user, comment }))
}

/// Returns the audited action of a call.
fn audit(call: &MethodCall, kind: ObjectTypeId, source: &'static str) -> Audited {
    let (event, comment) = arguments(call.arguments()).unzip();
    Audited::Condition {
        source,
        kind,
        condition: call.object_id().clone(),
        method: call.method_id().clone(),
        event,
        comment,
    }
}

/// The largest comment, in bytes.
pub(super) const LONGEST_COMMENT: usize = 4096;
