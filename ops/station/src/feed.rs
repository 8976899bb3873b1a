//! The values and events of a server, which a face repeats for any number of clients over one
//! session.

use std::sync::Arc;
use std::time::Duration;

use plant_opcua::client::{
    ClientSubscription, MonitoredWatch, Notice, OpcUaClient, Sampled, Select,
};
use plant_opcua::server::{ForwardedEvent, OpcUaServer};
use plant_opcua::types::{
    ByteString, DataValue, DateTime, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    UAString, Variant,
};
use tracing::{debug, warn};

use crate::copy::{CopiedVariable, Translation};

/// The target of the values and events of a server.
#[derive(Clone)]
pub(crate) struct FeedTarget {
    pub(crate) face: OpcUaServer,
    pub(crate) translation: Arc<Translation>,
    /// The node of the server itself, the source of events whose own source is not shown.
    pub(crate) root: NodeId,
    /// The name of the server, for log messages.
    pub(crate) name: String,
}

/// Repeats the values of variables until the client is closed. `lost` receives the number of
/// notifications that were lost; the current values are then requested again.
pub(crate) async fn values(
    client: OpcUaClient,
    variables: Vec<CopiedVariable>,
    target: FeedTarget,
    lost: impl Fn(u64) + Send,
) {
    loop {
        let watches = variables.iter().map(|variable| {
            MonitoredWatch::Sampled(Sampled {
                node: variable.at_server.clone(),
                interval: SAMPLING,
                queue: QUEUE,
                deadband: 0.0,
            })
        });
        // The first notifications are the current values of all variables.
        let room = variables.len() * 2 + MOST_NOTICES;
        let mut values = client.subscribe(watches.collect(), PUBLISHING, room);
        while let Some(notice) = values.next().await {
            repeat(&variables, &target, notice);
            let dropped = values.dropped();
            if dropped > 0 {
                warn!(
                    server = target.name,
                    dropped, "values of a server were lost and are requested again"
                );
                lost(dropped);
                break;
            }
        }
        if values.dropped() == 0 {
            return;
        }
    }
}

fn repeat(variables: &[CopiedVariable], target: &FeedTarget, notice: Notice) {
    let (watch, value) = match notice {
        Notice::Value { watch, value } => (watch, value),
        Notice::Refused { watch, status } => {
            let value = crate::copy::without_value(status);
            (watch, value)
        }
        Notice::Subscribed | Notice::Event { .. } => return,
    };
    if let Some(variable) = variables.get(watch) {
        target.show(variable, value);
    }
}

impl FeedTarget {
    /// Shows a value of the server.
    fn show(&self, variable: &CopiedVariable, mut value: DataValue) {
        value.value = value.value.map(|value| self.translation.value(value));
        // Each server stamps the time of its own copy.
        value.server_timestamp = None;
        // The variable may have been removed meanwhile.
        if let Err(status) = self.face.show_value(&variable.shown, value) {
            debug!(server = self.name, node = %variable.shown, %status, "cannot show a value");
        }
    }

    /// Reads the values of variables once, so that clients find values in announced variables.
    pub(crate) async fn read(&self, client: &OpcUaClient, variables: &[CopiedVariable]) {
        let nodes: Vec<NodeId> = variables.iter().map(|one| one.at_server.clone()).collect();
        match client.read(&nodes).await {
            Ok(values) => {
                for (variable, value) in variables.iter().zip(values) {
                    self.show(variable, value);
                }
            }
            // The subscription requests them again.
            Err(error) => debug!(server = self.name, %error, "cannot read the first values"),
        }
    }
}

/// Repeats the events of a server until the client is closed. `declared` are the fields of its own
/// event types. `lost` receives the number of events that were lost.
pub(crate) async fn events(
    client: OpcUaClient,
    declared: Vec<Select>,
    target: FeedTarget,
    lost: impl Fn(u64) + Send,
) {
    let select: Vec<Select> = usual_fields().chain(declared).collect();
    let watch = MonitoredWatch::Events {
        node: ObjectId::Server.into(),
        select: select.clone(),
        of_type: None,
    };
    let mut events: ClientSubscription = client.subscribe(vec![watch], PUBLISHING, MOST_NOTICES);
    let mut dropped = 0;
    while let Some(notice) = events.next().await {
        if events.dropped() > dropped {
            let more = events.dropped() - dropped;
            warn!(
                server = target.name,
                lost = more,
                "events of a server were lost"
            );
            lost(more);
            dropped = events.dropped();
        }
        if let Notice::Event { fields, .. } = notice
            && let Some(event) = event(&client, &select, fields, &target).await
        {
            target.face.forward(event);
        }
    }
}

/// Returns the event for the face. `None` for events that concern the other server only.
async fn event(
    client: &OpcUaClient,
    select: &[Select],
    fields: Vec<Variant>,
    target: &FeedTarget,
) -> Option<ForwardedEvent> {
    let translation = &target.translation;
    let mut event = ForwardedEvent {
        source: target.root.clone(),
        source_name: UAString::null(),
        event_id: ByteString::null(),
        event_type: ObjectTypeId::BaseEventType.into(),
        time: DateTime::now(),
        message: LocalizedText::null(),
        severity: 1,
        fields: Vec::new(),
    };
    for (select, value) in select.iter().zip(fields) {
        let name = match select.path.as_slice() {
            [name] if name.namespace_index == 0 => name.name.as_ref(),
            _ => "",
        };
        match (name, value) {
            (_, Variant::Empty) => {}
            ("EventId", Variant::ByteString(id)) => event.event_id = id,
            ("EventType", Variant::NodeId(of)) => {
                event.event_type = shown_type(client, &of, translation).await?;
            }
            ("SourceNode", Variant::NodeId(source)) => {
                let shown = translation.node(&source).filter(|one| one.namespace != 0);
                event.source = shown.unwrap_or(event.source);
            }
            ("SourceName", Variant::String(name)) => event.source_name = name,
            ("Time", Variant::DateTime(time)) => event.time = *time,
            ("Message", Variant::LocalizedText(message)) => event.message = *message,
            ("Severity", Variant::UInt16(severity)) => event.severity = severity,
            (_, value) => {
                if let Some(path) = translation.path(&select.path) {
                    event.fields.push((path, translation.value(value)));
                }
            }
        }
    }
    Some(event)
}

/// Returns the type of an event on the face: the type itself or the nearest supertype that is
/// shown. `None` for model changes and audit events, which concern the other server only.
async fn shown_type(
    client: &OpcUaClient,
    of: &NodeId,
    translation: &Translation,
) -> Option<NodeId> {
    let above = client.supertypes(of).await.unwrap_or_default();
    let own = [
        ObjectTypeId::BaseModelChangeEventType,
        ObjectTypeId::SemanticChangeEventType,
        ObjectTypeId::AuditEventType,
    ];
    let mut chain = std::iter::once(of).chain(&above);
    if chain.any(|one| own.iter().any(|own| one == own)) {
        return None;
    }
    let mut chain = std::iter::once(of).chain(&above);
    let shown = chain.find_map(|one| translation.node(one));
    Some(shown.unwrap_or_else(|| ObjectTypeId::BaseEventType.into()))
}

fn usual_fields() -> impl Iterator<Item = Select> {
    let base = BASE_FIELDS.map(|path| (ObjectTypeId::BaseEventType, path));
    let transition = TRANSITION_FIELDS.map(|path| (ObjectTypeId::TransitionEventType, path));
    let program = [(
        ObjectTypeId::ProgramTransitionEventType,
        "IntermediateResult",
    )];
    let all = base.into_iter().chain(transition).chain(program);
    all.map(|(of, path)| Select {
        type_id: of.into(),
        path: path
            .split('/')
            .map(|name| QualifiedName::new(0, name))
            .collect(),
    })
}

const BASE_FIELDS: [&str; 7] = [
    "EventId",
    "EventType",
    "SourceNode",
    "SourceName",
    "Time",
    "Message",
    "Severity",
];
const TRANSITION_FIELDS: [&str; 12] = [
    "FromState",
    "FromState/Id",
    "FromState/Name",
    "FromState/Number",
    "ToState",
    "ToState/Id",
    "ToState/Name",
    "ToState/Number",
    "Transition",
    "Transition/Id",
    "Transition/Name",
    "Transition/Number",
];
/// Publishing interval. Two levels add it twice.
const PUBLISHING: Duration = Duration::from_millis(20);
/// Sampling interval, for servers that do not report each change at once.
const SAMPLING: Duration = Duration::from_millis(50);
/// Queue size of a variable at the server, so that states that follow each other closely are all
/// repeated.
const QUEUE: u32 = 32;
/// Maximum number of waiting notifications, beside the first values.
const MOST_NOTICES: usize = 4_096;
