//! The servers found in the network, as objects and as values of the space: their names, locations
//! and states.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bridge_node::{PortEvent, now};
use discovery::{MdnsInterface, PresentServer, ServerChange, ServerWatcher};
use mappings::TopicId;
use opcua::nodes::{ObjectBuilder, VariableBuilder};
use opcua::server::SubscriptionCache;
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    AttributeId, DataTypeId, DataValue, DateTime, LocalizedText, NodeId, ObjectTypeId,
    QualifiedName, VariableTypeId, Variant,
};
use tracing::info;
use uadp::Timestamp;

use crate::address;
use crate::nodes::SpaceManager;
use crate::presence::{OnlineState, ValuePresence};

/// The next event of [`Components`].
pub(crate) enum ComponentEvent {
    /// An event of a server that is to be reported.
    Told(PortEvent),
    /// A discovered server, which is already shown.
    Heard(ServerChange),
}

/// Shows the servers that a watcher reports. Lost servers stay visible for some time.
pub(crate) struct Components {
    watcher: ServerWatcher,
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    /// ApplicationUri of this server, which is not shown.
    own_uri: String,
    /// Names of the lost servers, longest lost first.
    gone: VecDeque<String>,
    presence: ValuePresence,
}

impl Components {
    pub(crate) fn new(
        (watcher, heard_on): (ServerWatcher, &MdnsInterface),
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        own_uri: String,
    ) -> Self {
        address::add_folder(
            &address::components_folder(),
            "Components",
            address::root(),
            &mut manager.address_space().write(),
        );
        Self {
            watcher,
            manager,
            subscriptions,
            own_uri,
            gone: VecDeque::new(),
            presence: ValuePresence::new(heard_on.to_string()),
        }
    }

    /// Waits for the next event and shows it. Cancel-safe.
    pub(crate) async fn next(&mut self) -> ComponentEvent {
        if let Some(event) = self.presence.event() {
            return ComponentEvent::Told(event);
        }
        match self.watcher.next().await {
            Some(found) => {
                self.show(&found);
                ComponentEvent::Heard(found)
            }
            None => std::future::pending().await,
        }
    }

    fn show(&mut self, found: &ServerChange) {
        let known = found.known();
        if known.is_lds() || known.application_uri.as_ref() == Some(&self.own_uri) {
            return;
        }
        let name = &known.name;
        log(found);
        let online = !matches!(found, ServerChange::Gone { .. });
        if online {
            self.gone.retain(|gone| gone != name)
        } else {
            self.gone.push_back(name.clone())
        }
        let now = now().utc;
        let since = if online {
            known.since
        } else {
            system_time(now)
        };
        let state = OnlineState { online, since };
        let topic = self.presence.show(known, state, now);
        let oldest = (self.gone.len() > MOST_GONE)
            .then(|| self.gone.pop_front())
            .flatten();
        if let Some(oldest) = &oldest {
            self.presence.forget(oldest);
        }
        let values = values(known, state, (topic, self.presence.level()));
        {
            let mut address_space = self.manager.address_space().write();
            if let Some(oldest) = oldest {
                drop(address_space.delete(&node(&oldest, ""), true));
            }
            add(&mut address_space, name, &values);
        }
        let values = values.map(|(property, _, _, value)| (node(name, property), value));
        let mut notifier = self.subscriptions.data_notifier();
        for (node, value) in &values {
            let value = DataValue::new_now(value.clone());
            notifier.notify(node, AttributeId::Value, value);
        }
    }
}

fn log(found: &ServerChange) {
    match found {
        ServerChange::Seen(known) | ServerChange::Restarted(known) => info!(
            name = ?known.name,
            url = known.url,
            uri = known.application_uri,
            "discovered a server"
        ),
        ServerChange::Gone { known, loss } => info!(
            name = ?known.name,
            url = known.url,
            loss = loss.label(),
            "lost a server"
        ),
    }
}

type Property = (&'static str, DataTypeId, i32, Variant);

fn values(
    known: &PresentServer,
    state: OnlineState,
    (topic, level): (Option<TopicId>, &str),
) -> [Property; 9] {
    let capabilities: Vec<_> = known
        .capabilities
        .iter()
        .map(|code| code.as_str().into())
        .collect();
    let capabilities: Vec<opcua::types::UAString> = capabilities;
    let uri = known.application_uri.as_deref().unwrap_or_default();
    let started = known.started.map_or_else(DateTime::null, time);
    let number = known.number.map_or(0, u16::from);
    let topic = topic.map_or_else(String::new, |topic| topic.to_string());
    [
        ("ApplicationUri", DataTypeId::String, -1, uri.into()),
        ("Url", DataTypeId::String, -1, known.url.as_str().into()),
        ("Capabilities", DataTypeId::String, 1, capabilities.into()),
        ("Online", DataTypeId::Boolean, -1, state.online.into()),
        ("Since", DataTypeId::UtcTime, -1, time(state.since).into()),
        ("StartTime", DataTypeId::UtcTime, -1, started.into()),
        ("Number", DataTypeId::UInt16, -1, number.into()),
        ("Level", DataTypeId::String, -1, level.into()),
        ("Topic", DataTypeId::String, -1, topic.as_str().into()),
    ]
}

/// Adds the object of a server, or replaces it.
fn add(address_space: &mut AddressSpace, name: &str, values: &[Property]) {
    let object = node(name, "");
    drop(address_space.delete(&object, true));
    let names = QualifiedName::new(object.namespace, name);
    ObjectBuilder::new(&object, names, LocalizedText::from(name))
        .has_type_definition(ObjectTypeId::BaseObjectType)
        .organized_by(address::components_folder())
        .insert(address_space);
    for (property, data_type, rank, value) in values {
        let id = node(name, property);
        drop(address_space.delete(&id, true));
        let names = QualifiedName::new(id.namespace, *property);
        VariableBuilder::new(&id, names, LocalizedText::from(*property))
            .data_type(*data_type)
            .value_rank(*rank)
            .value(value.clone())
            .has_type_definition(VariableTypeId::PropertyType)
            .property_of(object.clone())
            .insert(address_space);
    }
}

/// Returns the node of a server's object, or of one of its properties.
fn node(name: &str, property: &str) -> NodeId {
    let folder = address::components_folder();
    let dot = if property.is_empty() { "" } else { "." };
    NodeId::new(
        folder.namespace,
        format!("UaSpace.Components.{name}{dot}{property}"),
    )
}

fn system_time(at: Timestamp) -> SystemTime {
    let nanos = u64::try_from(at.unix_nanos()).unwrap_or_default();
    SystemTime::UNIX_EPOCH + Duration::from_nanos(nanos)
}

fn time(at: SystemTime) -> DateTime {
    let since = at
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default()
        + TO_1970;
    DateTime::from(i64::try_from(since.as_nanos() / 100).unwrap_or(i64::MAX))
}

/// Largest number of lost servers that are still shown.
const MOST_GONE: usize = 64;
/// Time from 1601 to 1970.
const TO_1970: Duration = Duration::from_secs(11_644_473_600);
