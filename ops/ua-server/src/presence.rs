//! The servers in the network as values of the space: `ua_0_1_<n>` for the component with the
//! number n (`ua_msgs/Component`).
//!
//! Namespace 1 is the namespace of the server's own URI (OPC 10000-5, 6.3.1), so no component owns
//! it.

use std::collections::{BTreeMap, VecDeque};
use std::time::{SystemTime, UNIX_EPOCH};

use bridge_core::ValueDescription;
use bridge_node::PortEvent;
use bytes::Bytes;
use discovery::PresentServer;
use mappings::{Overflow, TopicId};
use messages::{ArrayRank, Leaf, TypeName};
use opcua::types::{UAString, Variant};
use tracing::warn;
use uadp::{BuiltinType, Timestamp};

use crate::value;

/// Whether a server is online or offline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OnlineState {
    pub(crate) online: bool,
    /// The time since which it is.
    pub(crate) since: SystemTime,
}

/// A published server.
#[derive(Debug)]
struct PublishedServer {
    identifier: u16,
    /// The name on the network. A component has another name for each port at which it is started.
    name: String,
    online: bool,
}

/// The values, and the events to be reported.
#[derive(Debug)]
pub(crate) struct ValuePresence {
    /// The network on which the servers are discovered.
    level: String,
    /// The published servers by their identities.
    told: BTreeMap<String, PublishedServer>,
    /// Identifiers of servers without a number, by their identities. They are stable as long as
    /// this program runs.
    given: BTreeMap<String, u16>,
    events: VecDeque<PortEvent>,
    told_full: bool,
}

impl ValuePresence {
    /// Creates an empty state for servers discovered on that network.
    pub(crate) const fn new(level: String) -> Self {
        Self {
            level,
            told: BTreeMap::new(),
            given: BTreeMap::new(),
            events: VecDeque::new(),
            told_full: false,
        }
    }

    /// Returns the network.
    pub(crate) fn level(&self) -> &str {
        &self.level
    }

    /// Publishes at the time `now` that a server is online or offline. Returns its name in the
    /// space.
    pub(crate) fn show(
        &mut self,
        known: &PresentServer,
        state: OnlineState,
        now: Timestamp,
    ) -> Option<TopicId> {
        let online = state.online;
        let who = who(known);
        let before = self.told.get(who);
        let other = before.filter(|before| before.name != known.name && before.online);
        if let Some(other) = other.filter(|_| !online) {
            // The server is online under another name.
            return TopicId::new(0, NAMESPACE, other.identifier);
        }
        let before = before.map(|before| before.identifier);
        let identifier = self.identifier(known, before.filter(|_| !online))?;
        if let Some(before) = before.filter(|before| *before != identifier) {
            self.withdraw(before);
        }
        // An offline server gives way to an online server.
        let is_new = self.give_way(identifier, who) || before != Some(identifier);
        let server = PublishedServer {
            identifier,
            name: known.name.clone(),
            online,
        };
        self.told.insert(who.to_owned(), server);
        let topic = TopicId::new(0, NAMESPACE, identifier)?;
        if is_new {
            let description = description(known.application_uri.as_deref());
            self.events
                .push_back(PortEvent::Described { topic, description });
            self.events.push_back(PortEvent::Live { topic, live: true });
        }
        // Unreported samples of this server are outdated.
        let of_it = |event: &PortEvent| matches!(event, PortEvent::Sample { topic: of, .. } if *of == topic);
        self.events.retain(|event| !of_it(event));
        let fields = fields(known, state, &self.level);
        match value::fields_block(&fields) {
            Ok(block) => self.events.push_back(PortEvent::Sample {
                topic,
                payload: Bytes::from(block),
                received: now,
                latched_by: None,
            }),
            Err(status) => {
                warn!(name = known.name, %status, "cannot publish the presence of a server")
            }
        }
        Some(topic)
    }

    /// Stops publishing an offline server with that name.
    pub(crate) fn forget(&mut self, name: &str) {
        let is_it = |told: &PublishedServer| told.name == name && !told.online;
        let gone = self.told.values().filter(|told| is_it(told));
        let gone: Vec<u16> = gone.map(|told| told.identifier).collect();
        self.told.retain(|_, told| !is_it(told));
        for identifier in gone {
            self.withdraw(identifier);
        }
    }

    /// Returns the next event to be reported.
    pub(crate) fn event(&mut self) -> Option<PortEvent> {
        self.events.pop_front()
    }

    fn withdraw(&mut self, identifier: u16) {
        if let Some(topic) = TopicId::new(0, NAMESPACE, identifier) {
            self.events.push_back(PortEvent::Withdrawn { topic });
        }
    }

    /// Takes an identifier from an offline server. Returns true if the identifier was in use.
    fn give_way(&mut self, identifier: u16, to: &str) -> bool {
        let before = self.told.len();
        self.told
            .retain(|who, told| told.identifier != identifier || who == to);
        self.told.len() < before
    }

    /// Returns the identifier of a server. `before` is kept if the server goes offline. Otherwise
    /// the identifier is the server's number if no other online server has it, or else an own
    /// identifier that stays assigned.
    fn identifier(&mut self, known: &PresentServer, before: Option<u16>) -> Option<u16> {
        if before.is_some() {
            return before;
        }
        let own = who(known);
        let has = |identifier: u16| {
            let mut others = self.told.iter();
            others.any(|(who, told)| told.identifier == identifier && told.online && who != own)
        };
        let number = known.number.map(u16::from);
        if let Some(number) = number.filter(|number| *number < FIRST_GIVEN && !has(*number)) {
            return Some(number);
        }
        if let Some(given) = self.given.get(own) {
            return Some(*given);
        }
        let next = (FIRST_GIVEN..=u16::MAX).nth(self.given.len());
        if next.is_none() && !std::mem::replace(&mut self.told_full, true) {
            warn!(
                "the limit of servers with a presence in the space is reached: the presence of others is not published"
            );
        }
        self.given.insert(own.to_owned(), next?);
        next
    }
}

/// Returns the identity of a server.
fn who(known: &PresentServer) -> &str {
    known.application_uri.as_deref().unwrap_or(&known.name)
}

fn description(uri: Option<&str>) -> ValueDescription {
    let leaf = |(name, builtin, rank): (&str, BuiltinType, ArrayRank)| Leaf {
        path: name.to_owned(),
        builtin,
        rank,
    };
    let many = ArrayRank::Array { fixed: None };
    let fields = [
        ("online", BuiltinType::Boolean, ArrayRank::Scalar),
        ("since", BuiltinType::Double, ArrayRank::Scalar),
        ("started", BuiltinType::Double, ArrayRank::Scalar),
        ("number", BuiltinType::UInt16, ArrayRank::Scalar),
        ("name", BuiltinType::String, ArrayRank::Scalar),
        ("uri", BuiltinType::String, ArrayRank::Scalar),
        ("urls", BuiltinType::String, many),
        ("capabilities", BuiltinType::String, many),
        ("level", BuiltinType::String, ArrayRank::Scalar),
    ];
    ValueDescription {
        name: format!("Components.{}", uri.unwrap_or_default()),
        message_type: TypeName::new("ua_msgs", "Component").ok(),
        about: "who is there".to_owned(),
        fields: fields.into_iter().map(leaf).collect(),
        overflow: Overflow::KeepLatest,
    }
}

fn fields(known: &PresentServer, state: OnlineState, level: &str) -> [Variant; 9] {
    let text = |text: &str| Variant::from(text);
    let texts = |all: &[String]| {
        let all: Vec<UAString> = all.iter().map(|one| one.as_str().into()).collect();
        Variant::from(all)
    };
    [
        state.online.into(),
        seconds(state.since).into(),
        known.started.map_or(0.0, seconds).into(),
        known.number.map_or(0, u16::from).into(),
        text(&known.name),
        text(known.application_uri.as_deref().unwrap_or_default()),
        texts(std::slice::from_ref(&known.url)),
        texts(&known.capabilities),
        text(level),
    ]
}

/// Returns the seconds since 1970.
fn seconds(at: SystemTime) -> f64 {
    at.duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_secs_f64()
}

/// The server's own namespace.
pub(crate) const NAMESPACE: u16 = 1;
/// First identifier of servers without a number.
const FIRST_GIVEN: u16 = 60_001;

#[cfg(test)]
mod tests {
    use std::num::NonZeroU16;

    use super::*;

    fn known(name: &str, number: u16) -> PresentServer {
        PresentServer {
            name: name.to_owned(),
            url: "opc.tcp://127.0.0.1:4841/".to_owned(),
            capabilities: vec!["DA".to_owned()],
            application_uri: Some(format!("urn:{name}")),
            since: UNIX_EPOCH,
            started: None,
            number: NonZeroU16::new(number),
        }
    }

    fn show(presence: &mut ValuePresence, known: &PresentServer, online: bool) -> Option<TopicId> {
        let since = UNIX_EPOCH;
        let now = Timestamp::from_unix_nanos(0);
        presence.show(known, OnlineState { online, since }, now)
    }

    fn shown(presence: &mut ValuePresence, known: &PresentServer) -> u16 {
        show(presence, known, true).unwrap().triple().2
    }

    fn events(presence: &mut ValuePresence) -> Vec<PortEvent> {
        std::iter::from_fn(|| presence.event()).collect()
    }

    #[test]
    fn a_component_has_its_number_and_others_keep_what_they_are_given() {
        let mut presence = ValuePresence::new("lo".to_owned());
        assert_eq!(shown(&mut presence, &known("gripper", 7)), 7);
        assert_eq!(shown(&mut presence, &known("plc", 0)), FIRST_GIVEN);
        assert_eq!(shown(&mut presence, &known("thief", 7)), FIRST_GIVEN + 1);
        assert_eq!(shown(&mut presence, &known("gripper", 7)), 7);
        assert_eq!(shown(&mut presence, &known("plc", 0)), FIRST_GIVEN);
        // The gripper is offline: its number is free for an online server.
        show(&mut presence, &known("gripper", 7), false);
        assert_eq!(shown(&mut presence, &known("thief", 7)), 7);
    }

    #[test]
    fn a_component_that_is_started_anew_at_another_port_is_the_same() {
        let mut presence = ValuePresence::new("lo".to_owned());
        let first = known("gripper", 7);
        let again = PresentServer {
            name: "gripper at another port".to_owned(),
            ..first.clone()
        };
        assert_eq!(shown(&mut presence, &first), 7);
        assert_eq!(shown(&mut presence, &again), 7);
        events(&mut presence);
        // The previous name is reported as lost only after that.
        let topic = show(&mut presence, &first, false);
        assert_eq!(topic.unwrap().triple(), (0, 1, 7));
        assert!(presence.event().is_none(), "it is there");
        presence.forget(&first.name);
        assert!(presence.event().is_none(), "and is told of");
    }

    #[test]
    fn what_has_not_been_reported_gives_way_to_what_is_true_now() {
        let mut presence = ValuePresence::new("lo".to_owned());
        let gripper = known("gripper", 7);
        for online in [true, false, true] {
            show(&mut presence, &gripper, online).unwrap();
        }
        let events = events(&mut presence);
        assert!(
            matches!(
                &events[..],
                [
                    PortEvent::Described { .. },
                    PortEvent::Live { live: true, .. },
                    PortEvent::Sample { .. }
                ]
            ),
            "{events:?}"
        );
    }

    #[test]
    fn an_offline_server_is_published_until_it_is_forgotten_or_its_number_is_used() {
        let mut presence = ValuePresence::new("lo".to_owned());
        let (gripper, thief) = (known("gripper", 7), known("thief", 7));
        shown(&mut presence, &gripper);
        presence.forget(&gripper.name);
        show(&mut presence, &gripper, false);
        let reported = events(&mut presence);
        assert!(
            !reported
                .iter()
                .any(|event| matches!(event, PortEvent::Withdrawn { .. })),
            "an online server is not forgotten: {reported:?}"
        );
        presence.forget(&gripper.name);
        let topic = TopicId::new(0, NAMESPACE, 7).unwrap();
        let reported = events(&mut presence);
        assert!(
            matches!(&reported[..], [PortEvent::Withdrawn { topic: of }] if *of == topic),
            "{reported:?}"
        );
        // The name of a server that gave way is described again for the other server.
        shown(&mut presence, &gripper);
        show(&mut presence, &gripper, false);
        events(&mut presence);
        assert_eq!(shown(&mut presence, &thief), 7);
        let reported = events(&mut presence);
        assert!(
            matches!(&reported[0], PortEvent::Described { topic: of, .. } if *of == topic),
            "{reported:?}"
        );
    }

    #[test]
    fn numbers_are_given_to_so_many_servers_as_there_are_identifiers() {
        let mut presence = ValuePresence::new("lo".to_owned());
        for at in FIRST_GIVEN..=u16::MAX {
            assert_eq!(shown(&mut presence, &known(&at.to_string(), 0)), at);
            events(&mut presence);
        }
        assert_eq!(show(&mut presence, &known("more", 0), true), None);
        assert_eq!(shown(&mut presence, &known("gripper", 7)), 7);
    }
}
