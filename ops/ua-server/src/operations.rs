//! The users of the server on the page, and their commands. Permissions are those of OPC UA
//! clients.

use std::sync::Arc;

use bridge_node::{AskErrorKind, BoxFuture};
use bytes::Bytes;
use mappings::{NodeIdText, TopicId};
use opcua::server::SubscriptionCache;
use opcua::server::authenticator::UserToken;
use opcua::server::node_manager::ParsedWriteValue;
use opcua::types::{AttributeId, DataValue, NumericRange, StatusCode, Variant};
use plant_opcua::users::{Right, Roles, UserAccess, UserRole};
use supervisor::{ConditionChange, ConditionState, OperationFault, Operations};
use uadp::Fields;

use crate::alarms::Alarms;
use crate::asking::CallFailure;
use crate::commanders::Commander;
use crate::layout::node_id;
use crate::nodes::{SpaceManager, WriteClient};
use crate::value::from_field;

/// The server as operators use it on the page.
pub(crate) struct PageOperations {
    access: Arc<UserAccess>,
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    alarms: Arc<Alarms>,
    /// The ApplicationUri of the server.
    server: String,
}

impl PageOperations {
    pub(crate) fn new(
        access: Arc<UserAccess>,
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        (alarms, server): (Arc<Alarms>, &str),
    ) -> Self {
        Self {
            access,
            manager,
            subscriptions,
            alarms,
            server: server.to_owned(),
        }
    }
}

impl Operations for PageOperations {
    fn has_users(&self) -> bool {
        self.access.has_users()
    }

    fn sign_in(&self, user: String, password: String) -> BoxFuture<bool> {
        let access = Arc::clone(&self.access);
        Box::pin(async move { access.sign_in(&user, password, "page").await })
    }

    fn roles(&self, user: &str) -> Option<String> {
        self.access
            .roles_of_user(user)
            .map(|roles| roles.to_string())
    }

    fn may_operate(&self, user: &str) -> bool {
        let runs = Roles::of(&[UserRole::Operator, UserRole::Engineer]);
        self.access
            .roles_of_user(user)
            .is_some_and(|roles| roles.meets(runs))
    }

    fn may_load(&self, user: &str) -> bool {
        let loads = Roles::of(&[UserRole::Engineer]);
        self.access
            .roles_of_user(user)
            .is_some_and(|roles| roles.meets(loads))
    }

    fn call(
        &self,
        user: String,
        topic: TopicId,
        request: Bytes,
    ) -> BoxFuture<Result<Bytes, OperationFault>> {
        let found = {
            let methods = self.manager.inner().callables().methods().lock();
            let mut methods = methods.iter();
            let found = methods.find(|(_, callable)| callable.topic() == topic);
            found.map(|(node, callable)| (node.clone(), callable.clone()))
        };
        let access = Arc::clone(&self.access);
        let questions = self.manager.inner().callables().questions().clone();
        Box::pin(async move {
            let Some((node, callable)) = found else {
                let why = format!("{topic} is no Method of this server");
                return Err(OperationFault::Refused(why));
            };
            if !access.allows(&UserToken(user), &node, Right::Call) {
                return Err(OperationFault::Denied);
            }
            // The request is abandoned when the browser closes the connection, because the future
            // is dropped.
            let answered = callable.ask(request, &questions, || false).await;
            answered.map_err(fault)
        })
    }

    fn write(
        &self,
        user: String,
        node: &NodeIdText,
        block: Bytes,
    ) -> BoxFuture<Result<(), OperationFault>> {
        let manager = Arc::clone(&self.manager);
        let writer = WriteClient {
            subscriptions: Arc::clone(&self.subscriptions),
            token: UserToken(user),
            commander: Box::new(Commander::lasting),
        };
        let node_id = node_id(node);
        Box::pin(async move {
            let fields = Fields::parse(&block);
            let mut fields = fields.map_err(|error| OperationFault::Refused(error.to_string()))?;
            let value = fields.next().and_then(Result::ok);
            let write = ParsedWriteValue {
                node_id,
                attribute_id: AttributeId::Value,
                index_range: NumericRange::None,
                value: DataValue::new_now(value.map_or(Variant::Empty, |value| from_field(&value))),
            };
            let written = manager
                .inner()
                .write_one(manager.address_space(), &writer, &write)
                .await;
            match written {
                Ok(StatusCode::GoodCompletesAsynchronously) => {
                    Err(OperationFault::Unknown(WHEN_CONNECTED.to_owned()))
                }
                Ok(_) => Ok(()),
                Err(status) => Err(write_fault(status)),
            }
        })
    }

    fn conditions(&self) -> Vec<ConditionState> {
        self.alarms.states()
    }

    fn change_condition(&self, user: &str, change: &ConditionChange) -> Result<(), OperationFault> {
        let by = (user, self.server.as_str());
        let changed = self
            .alarms
            .change(change, by, (&*self.access, &*self.subscriptions));
        changed.map_err(condition_fault)
    }
}

/// Returns the fault of a change of a condition.
fn condition_fault(status: StatusCode) -> OperationFault {
    let why = match status {
        StatusCode::BadEventIdUnknown => "the condition has changed: look at its present state",
        StatusCode::BadNodeIdUnknown => "there is no such condition any more",
        StatusCode::BadConditionBranchAlreadyAcked => "it is acknowledged already",
        StatusCode::BadConditionBranchAlreadyConfirmed => "it is confirmed already",
        StatusCode::BadConditionDisabled => "the condition is disabled",
        StatusCode::BadMethodInvalid => "the condition is not to be confirmed",
        StatusCode::BadOutOfRange => "the comment is too long",
        StatusCode::BadUserAccessDenied => return OperationFault::Denied,
        other => return OperationFault::Refused(other.to_string()),
    };
    OperationFault::Refused(why.to_owned())
}

/// The reason of an outcome that is not known yet.
const WHEN_CONNECTED: &str =
    "the server of this variable is not connected: it gets the value when it returns";

/// Returns the fault of a write without success.
fn write_fault(status: StatusCode) -> OperationFault {
    if status == StatusCode::BadUserAccessDenied {
        return OperationFault::Denied;
    }
    let text = status.to_string();
    // The value may have been sent before.
    let is_unknown = matches!(
        status,
        StatusCode::BadTimeout
            | StatusCode::BadNoCommunication
            | StatusCode::BadRequestCancelledByRequest
            | StatusCode::BadShutdown
    );
    if is_unknown {
        return OperationFault::Unknown(text);
    }
    OperationFault::Refused(text)
}

fn fault(refused: CallFailure) -> OperationFault {
    match refused {
        CallFailure::Arguments(_) => {
            OperationFault::Refused("arguments of the wrong type".to_owned())
        }
        CallFailure::Status(status @ StatusCode::BadShutdown) => {
            OperationFault::Unknown(status.to_string())
        }
        CallFailure::Status(status) => OperationFault::Refused(status.to_string()),
        CallFailure::Asked(error) => match error.kind {
            AskErrorKind::Refused => OperationFault::Refused(error.text),
            AskErrorKind::Failed => OperationFault::Failed(error.text),
            AskErrorKind::Unknown => OperationFault::Unknown(error.text),
        },
    }
}
