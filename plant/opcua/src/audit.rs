//! Audit events for sessions, writes and method calls, accepted or refused (OPC 10000-5, 6.4).
//!
//! Clients receive the events from the Server object. The log receives the events with the target
//! `audit`: at level warn if a session is refused, otherwise at level debug. The arguments of calls
//! are left out because an argument may be a secret.

use opcua::nodes::{BaseEventType, Event};
use opcua::server::node_manager::RequestContext;
use opcua::server::{ANONYMOUS_USER_TOKEN_ID, SubscriptionCache};
use opcua::types::{
    ByteString, DateTime, LocalizedText, NodeId, ObjectId, ObjectTypeId, StatusCode, Variant,
};
use tracing::{debug, warn};

/// An audited action and its result.
#[derive(Debug, Clone)]
pub struct Audit {
    /// The action.
    pub action: AuditedAction,
    /// The status code of the result.
    pub status: StatusCode,
    /// The name of the user, or `anonymous`.
    pub user: String,
    /// The session; `None` if the session is not identified yet.
    pub session: Option<NodeId>,
    /// The ClientAuditEntryId, which the client chooses for its own records.
    pub client_entry: String,
    /// The ApplicationUri of the server.
    pub server: String,
}

/// An action that is audited.
#[derive(Debug, Clone)]
pub enum AuditedAction {
    /// A client activated a session or tried to.
    CameIn {
        /// The kind of user identity: `anonymous`, `password` or `certificate`.
        by: &'static str,
        /// The security policy and mode of the endpoint.
        endpoint: String,
    },
    /// A client wrote the value of a node.
    Wrote {
        /// The node.
        node: NodeId,
        /// The IndexRange; empty for the whole value.
        range: String,
        /// The previous value, without content that not every user may read.
        old: Variant,
        /// The written value, without content that not every user may read.
        new: Variant,
    },
    /// A client called a method.
    Called {
        /// The object.
        object: NodeId,
        /// The method.
        method: NodeId,
    },
    /// A client called a method of a condition (OPC 10000-9, 5.10).
    Condition {
        /// The SourceName of the event, such as `Method/Acknowledge`.
        source: &'static str,
        /// The type of the event, a subtype of AuditConditionEventType.
        kind: ObjectTypeId,
        /// The condition.
        condition: NodeId,
        /// The method.
        method: NodeId,
        /// The EventId that the client named.
        event: Option<ByteString>,
        /// The comment of the client.
        comment: Option<LocalizedText>,
    },
}

impl AuditedAction {
    /// Returns the type of the event and its supertypes.
    fn types(&self) -> Vec<NodeId> {
        let types: &[ObjectTypeId] = match self {
            Self::CameIn { .. } => &[
                ObjectTypeId::AuditActivateSessionEventType,
                ObjectTypeId::AuditSessionEventType,
                ObjectTypeId::AuditSecurityEventType,
                ObjectTypeId::AuditEventType,
                ObjectTypeId::BaseEventType,
            ],
            Self::Wrote { .. } => &[
                ObjectTypeId::AuditWriteUpdateEventType,
                ObjectTypeId::AuditUpdateEventType,
                ObjectTypeId::AuditEventType,
                ObjectTypeId::BaseEventType,
            ],
            Self::Called { .. } => &[
                ObjectTypeId::AuditUpdateMethodEventType,
                ObjectTypeId::AuditEventType,
                ObjectTypeId::BaseEventType,
            ],
            Self::Condition { kind, .. } => &[
                *kind,
                ObjectTypeId::AuditConditionEventType,
                ObjectTypeId::AuditUpdateMethodEventType,
                ObjectTypeId::AuditEventType,
                ObjectTypeId::BaseEventType,
            ],
        };
        types.iter().map(|id| (*id).into()).collect()
    }

    /// Returns the SourceName of the event in the standard.
    const fn source(&self) -> &'static str {
        match self {
            Self::CameIn { .. } => "Session/ActivateSession",
            Self::Wrote { .. } => "Attribute/Write",
            Self::Called { .. } => "Attribute/Call",
            Self::Condition { source, .. } => source,
        }
    }

    fn node(&self) -> NodeId {
        match self {
            Self::CameIn { .. } => ObjectId::Server.into(),
            Self::Wrote { node, .. } => node.clone(),
            Self::Called { object, .. } => object.clone(),
            Self::Condition { condition, .. } => condition.clone(),
        }
    }
}

impl std::fmt::Display for AuditedAction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::CameIn { by, endpoint } => write!(f, "comes in ({by}, {endpoint})"),
            Self::Wrote { node, .. } => write!(f, "writes {node}"),
            Self::Called { method, .. } => write!(f, "calls {method}"),
            Self::Condition {
                condition, method, ..
            } => write!(f, "calls {method} of {condition}"),
        }
    }
}

impl Audit {
    /// Creates the audit of an action by the session of a request.
    #[must_use]
    pub fn of(context: &RequestContext, action: AuditedAction, status: StatusCode) -> Self {
        Self {
            action,
            status,
            user: Self::named(&context.token.0),
            session: Some(context.session.read().session_id().clone()),
            client_entry: String::new(),
            server: context.info.application_uri.as_ref().to_owned(),
        }
    }

    /// Creates the audit of an action without a session, such as the action of a user of the page.
    #[must_use]
    pub fn without_session(
        action: AuditedAction,
        status: StatusCode,
        user: &str,
        server: &str,
    ) -> Self {
        Self {
            action,
            status,
            user: Self::named(user),
            session: None,
            client_entry: String::new(),
            server: server.to_owned(),
        }
    }

    /// Returns the name of a user in audits.
    #[must_use]
    pub fn named(user: &str) -> String {
        match user {
            "" | ANONYMOUS_USER_TOKEN_ID => "anonymous".to_owned(),
            user => user.to_owned(),
        }
    }

    /// Logs the audit and sends its event to the subscribers of the Server object.
    pub fn tell(self, subscriptions: &SubscriptionCache) {
        self.log();
        let mut notifier = subscriptions.event_notifier();
        let has_subscriber = notifier.notify_for(ObjectId::Server).is_some();
        drop(notifier);
        if !has_subscriber {
            // Composing the event would be a large part of the time of a write.
            return;
        }
        let told = Told::new(self);
        let server: NodeId = ObjectId::Server.into();
        subscriptions.notify_events([(&told as &dyn Event, &server)].into_iter());
    }

    fn log(&self) {
        let (user, action, status) = (&self.user, &self.action, self.status);
        // Refusals are few: each refused client waited for a second or presented a trusted
        // certificate.
        let is_turned_away = !status.is_good() && matches!(action, AuditedAction::CameIn { .. });
        if is_turned_away {
            warn!(target: "audit", user, %status, "{action}: refused");
        } else {
            debug!(target: "audit", user, %status, "{action}");
        }
    }
}

/// The audit as an OPC UA event.
struct Told {
    base: BaseEventType,
    audit: Audit,
    types: Vec<NodeId>,
}

impl Told {
    fn new(audit: Audit) -> Self {
        let now = DateTime::now();
        let types = audit.action.types();
        let message = format!("{} {}: {}", audit.user, audit.action, audit.status);
        let base = BaseEventType {
            event_id: opcua::crypto::random::byte_string(16),
            event_type: types.first().cloned().unwrap_or_default(),
            source_node: audit.action.node(),
            source_name: audit.action.source().into(),
            time: now,
            receive_time: now,
            message: LocalizedText::from(&message),
            severity: if audit.status.is_good() { 100 } else { 500 },
            ..BaseEventType::default()
        };
        Self { base, audit, types }
    }

    fn field(&self, name: &str) -> Option<Variant> {
        let audit = &self.audit;
        let common = match name {
            "ActionTimeStamp" => Some(self.base.time.into()),
            "Status" => Some(audit.status.is_good().into()),
            "StatusCodeId" => Some(audit.status.into()),
            "ServerId" => Some(audit.server.as_str().into()),
            "ClientAuditEntryId" => Some(audit.client_entry.as_str().into()),
            "ClientUserId" => Some(audit.user.as_str().into()),
            _ => None,
        };
        if common.is_some() {
            return common;
        }
        match (&audit.action, name) {
            (AuditedAction::CameIn { .. }, "SessionId") => {
                Some(audit.session.clone().unwrap_or_default().into())
            }
            (AuditedAction::Wrote { .. }, "AttributeId") => Some(13_u32.into()),
            (AuditedAction::Wrote { range, .. }, "IndexRange") => Some(range.as_str().into()),
            (AuditedAction::Wrote { old, .. }, "OldValue") => Some(old.clone()),
            (AuditedAction::Wrote { new, .. }, "NewValue") => Some(new.clone()),
            (
                AuditedAction::Called { method, .. } | AuditedAction::Condition { method, .. },
                "MethodId",
            ) => Some(method.clone().into()),
            (AuditedAction::Condition { event, .. }, "ConditionEventId") => {
                event.clone().map(Into::into)
            }
            (AuditedAction::Condition { comment, .. }, "Comment") => {
                comment.clone().map(Into::into)
            }
            _ => None,
        }
    }
}

crate::impl_event!(
    Told,
    |event, id| event.types.contains(id),
    |event, path| match path {
        [name] if name.namespace_index == 0 => event.field(name.name.as_ref()),
        _ => None,
    }
);
