//! Audit events: who came in, wrote and called, and who was refused (OPC 10000-5, 6.4).
//!
//! They are events of the Server object, for whoever watches it, and lines of the log with the target `audit`, at level debug but for who is refused. What was called
//! with is not told: it may be a secret.

use opcua::nodes::{BaseEventType, Event, EventField};
use opcua::server::node_manager::RequestContext;
use opcua::server::{ANONYMOUS_USER_TOKEN_ID, SubscriptionCache};
use opcua::types::{
    AttributeId, DateTime, LocalizedText, NodeId, NumericRange, ObjectId, ObjectTypeId,
    QualifiedName, StatusCode, Variant,
};
use tracing::{debug, warn};

/// What is told.
#[derive(Debug, Clone)]
pub struct Audit {
    /// What somebody did.
    pub action: Action,
    /// How it ended.
    pub status: StatusCode,
    /// Who did it: the name of a user, or `anonymous`.
    pub user: String,
    /// The session; `None` where it is not known yet.
    pub session: Option<NodeId>,
    /// The id that the client gave the request for its own books.
    pub client_entry: String,
    /// The ApplicationUri of the server.
    pub server: String,
}

/// What somebody did.
#[derive(Debug, Clone)]
pub enum Action {
    /// Came in, or wanted to, by these means.
    CameIn {
        /// `anonymous`, `password` or `certificate`.
        by: &'static str,
        /// The policy and mode of the endpoint.
        endpoint: String,
    },
    /// Wrote the value of a node.
    Wrote {
        /// The node.
        node: NodeId,
        /// The IndexRange; empty for all of it.
        range: String,
        /// What was there, as far as everybody may know it.
        old: Variant,
        /// What it wrote, as far as everybody may know it.
        new: Variant,
    },
    /// Called a Method.
    Called {
        /// The object.
        object: NodeId,
        /// The Method.
        method: NodeId,
    },
}

impl Action {
    /// The type of the event, and those above it.
    const fn types(&self) -> &'static [ObjectTypeId] {
        match self {
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
        }
    }

    /// The SourceName that the standard gives the event.
    const fn source(&self) -> &'static str {
        match self {
            Self::CameIn { .. } => "Session/ActivateSession",
            Self::Wrote { .. } => "Attribute/Write",
            Self::Called { .. } => "Attribute/Call",
        }
    }

    fn node(&self) -> NodeId {
        match self {
            Self::CameIn { .. } => ObjectId::Server.into(),
            Self::Wrote { node, .. } => node.clone(),
            Self::Called { object, .. } => object.clone(),
        }
    }
}

impl std::fmt::Display for Action {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::CameIn { by, endpoint } => write!(f, "comes in ({by}, {endpoint})"),
            Self::Wrote { node, .. } => write!(f, "writes {node}"),
            Self::Called { method, .. } => write!(f, "calls {method}"),
        }
    }
}

impl Audit {
    /// What whoever is behind a request did.
    #[must_use]
    pub fn of(context: &RequestContext, action: Action, status: StatusCode) -> Self {
        Self {
            action,
            status,
            user: Self::named(&context.token.0),
            session: Some(context.session.read().session_id().clone()),
            client_entry: String::new(),
            server: context.info.application_uri.as_ref().to_owned(),
        }
    }

    /// The name that is told of a user.
    #[must_use]
    pub fn named(user: &str) -> String {
        match user {
            "" | ANONYMOUS_USER_TOKEN_ID => "anonymous".to_owned(),
            user => user.to_owned(),
        }
    }

    /// Writes it into the log, and tells who watches the Server object.
    pub fn tell(self, subscriptions: &SubscriptionCache) {
        self.log();
        let told = Told::new(self);
        let server: NodeId = ObjectId::Server.into();
        subscriptions.notify_events([(&told as &dyn Event, &server)].into_iter());
    }

    fn log(&self) {
        let (user, action, status) = (&self.user, &self.action, self.status);
        // Each who is not let in has waited for a second or shown a trusted certificate: there are not many.
        let is_turned_away = !status.is_good() && matches!(action, Action::CameIn { .. });
        if is_turned_away {
            warn!(target: "audit", user, %status, "{action}: refused");
        } else {
            debug!(target: "audit", user, %status, "{action}");
        }
    }
}

/// An audit on its way to clients.
struct Told {
    base: BaseEventType,
    audit: Audit,
    types: Vec<NodeId>,
}

impl Told {
    fn new(audit: Audit) -> Self {
        let now = DateTime::now();
        let types: Vec<NodeId> = audit.action.types().iter().map(|id| (*id).into()).collect();
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
            (Action::CameIn { .. }, "SessionId") => {
                Some(audit.session.clone().unwrap_or_default().into())
            }
            (Action::Wrote { .. }, "AttributeId") => Some(13_u32.into()),
            (Action::Wrote { range, .. }, "IndexRange") => Some(range.as_str().into()),
            (Action::Wrote { old, .. }, "OldValue") => Some(old.clone()),
            (Action::Wrote { new, .. }, "NewValue") => Some(new.clone()),
            (Action::Called { method, .. }, "MethodId") => Some(method.clone().into()),
            _ => None,
        }
    }
}

impl Event for Told {
    fn get_field(
        &self,
        type_definition_id: &NodeId,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        browse_path: &[QualifiedName],
    ) -> Variant {
        if !self.types.contains(type_definition_id) {
            return Variant::Empty;
        }
        self.get_value(attribute_id, index_range, browse_path)
    }

    fn time(&self) -> &DateTime {
        &self.base.time
    }

    fn event_type_id(&self) -> &NodeId {
        &self.base.event_type
    }
}

impl EventField for Told {
    fn get_value(
        &self,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        remaining_path: &[QualifiedName],
    ) -> Variant {
        if attribute_id == AttributeId::Value
            && let [name] = remaining_path
            && name.namespace_index == 0
            && let Some(value) = self.field(name.name.as_ref())
        {
            return value.range_of_owned(index_range).unwrap_or(Variant::Empty);
        }
        self.base
            .get_value(attribute_id, index_range, remaining_path)
    }
}
