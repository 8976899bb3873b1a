//! Calls of other spaces, as services of the domain; and services of the domain, executed for other spaces.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::policy::Policy;
use bridge_node::{Actions, Executing, PortEvent, Present};
use mappings::{Mapping, TopicId};
use messages::TypeName;
use rustdds::RTPSEntity;
use tokio::time::Instant;

use super::Ros2Port;
use super::bridges::{Bridge, is_at_home};
use super::services::{Client, Ros2Graph};
use crate::graph::{Endpoint, Graph};
use crate::service::{Snapshot, service_type};

impl Ros2Port {
    /// Offers the calls that are known as services, as far as there is room for endpoints; those of a space that another
    /// bridge of the domain serves are left to it, as are those that such a bridge offers too and that under a chosen name
    /// somebody else offers: a client asks all servers of a name.
    pub(super) fn offer_calls(&mut self) {
        let snapshot = self.peers.look(Instant::now(), SEEN);
        let mut taken = Vec::new();
        for (topic, service) in self.calls.chosen(&self.policy) {
            if is_offered(&self.graph, &snapshot, &service) {
                self.policy.told.once(&service, "taken", || {
                    format!("{topic} is not offered as {service}: another node has such a service")
                });
                taken.push(service);
            }
        }
        let (bridge, mapping) = (self.bridge(), Arc::clone(self.policy.mapping()));
        let left = Left {
            graph: &self.graph,
            mapping: &mapping,
            bridge,
            domain: self.domain_id,
            taken,
        };
        self.calls.leave(|topic, service| left.is(topic, service));
        if !self.calls.is_waiting() {
            return;
        }
        let mut services = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let (calls, policy) = (&mut self.calls, &mut self.policy);
        // Other bridges that are there are known by then.
        let settled = self.joined.elapsed() >= SETTLED;
        let may = |topic: TopicId, service: &str| settled && !left.is(topic, service);
        // Each has a reader and a writer.
        let events = calls.offer_waiting(&mut services, policy, may, self.budget / 2);
        self.budget = self.budget.saturating_sub(2 * events.len());
        for event in &events {
            if let PortEvent::CallBound { service_type, .. } = event {
                self.tell_service(service_type.name());
            }
        }
        self.events.extend(events);
    }

    /// Offers the services of other nodes that are calls of our space, and withdraws those that are gone. Of two types under
    /// one name neither can be called.
    pub(super) fn find_services(&mut self) {
        let snapshot = self.peers.look(Instant::now(), SEEN);
        let mapping = Arc::clone(self.policy.mapping());
        let mapped = Executing::<Client>::mapped(&mapping, &self.policy);
        let is_wanted = |policy: &Policy, service: &str| {
            Executing::<Client>::is_named(policy, service) || mapped.contains(service)
        };
        let kind = Kind {
            noun: "service",
            told: "type of the service",
            type_of: service_type,
        };
        let present = self.present(snapshot.offered(), kind, is_wanted);
        let called = snapshot.called().chain(snapshot.called_actions());
        let looked_for = called.filter_map(|(name, clients)| {
            let topic: TopicId = name.parse().ok()?;
            let ours = self.policy.own() == topic.space;
            let mut clients = clients.iter();
            let somebody = clients.any(|one| !self.graph.is_bridge(one.guid));
            (!ours && somebody).then_some(topic)
        });
        let events = self.calls.looked_for(looked_for.collect());
        self.events.extend(events);
        let mut services = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let most = self.budget / 2;
        let executing = &mut self.executing;
        let events = executing.reconcile(&mut services, &mut self.policy, (&present, most));
        let made = events
            .iter()
            .filter(|event| matches!(event, PortEvent::OfferTyped { .. }));
        let made = made.count();
        self.budget = self.budget.saturating_sub(2 * made);
        self.schedule.unfinished |= made == most;
        self.events.extend(events);
    }

    /// The servers of others that are wanted, each with its type. What another bridge serves is executed elsewhere. Of two types
    /// under one name neither can be asked.
    pub(super) fn present<'s>(
        &mut self,
        offered: impl Iterator<Item = (&'s str, &'s [Endpoint])>,
        kind: Kind,
        is_wanted: impl Fn(&Policy, &str) -> bool,
    ) -> Present {
        let Kind {
            noun,
            told,
            type_of,
        } = kind;
        let mut present = Present::new();
        for (name, servers) in offered {
            let name = format!("/{name}");
            if !is_wanted(&self.policy, &name) {
                continue;
            }
            let servers = servers.iter().filter(|one| !self.graph.is_bridge(one.guid));
            let types: BTreeSet<String> = servers.map(|one| type_of(&one.type_name)).collect();
            let type_name = match types.first() {
                None => continue,
                Some(name) if types.len() == 1 => name.parse().ok(),
                Some(_) => None,
            };
            if type_name.is_none() && Actions::is_named(&self.policy, &name) {
                let types: Vec<String> = types.into_iter().collect();
                self.policy.told.once(&name, told, || {
                    format!(
                        "the {noun} {name} cannot be asked for from other spaces: its type is {}",
                        types.join(" and ")
                    )
                });
            }
            present.insert(name, type_name);
        }
        present
    }

    /// This bridge, beside others of the domain.
    pub(super) fn bridge(&self) -> Bridge {
        Bridge {
            space: self.policy.own(),
            participant: self.domain.participant().guid(),
        }
    }

    /// Has the node tell who asks what the type of a service is.
    fn tell_service(&self, name: &TypeName) {
        if let Some(hashes) = self.definitions.service_type_hashes(name)
            && let Ok(described) = self.definitions.described_service(name)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hashes.service);
        }
    }
}

/// What kind of servers there are.
#[derive(Clone, Copy)]
pub(super) struct Kind {
    /// For people.
    pub(super) noun: &'static str,
    /// Under which it is told that a type is none.
    pub(super) told: &'static str,
    /// The ROS type by that of DDS of its requests.
    pub(super) type_of: fn(&str) -> String,
}

/// Which calls of other spaces are left to others of the domain.
pub(super) struct Left<'p> {
    pub(super) graph: &'p Graph,
    pub(super) mapping: &'p Mapping,
    pub(super) bridge: Bridge,
    pub(super) domain: u16,
    /// The names that another node has.
    pub(super) taken: Vec<String>,
}

impl Left<'_> {
    /// Whether that call is not to be offered under that name here.
    pub(super) fn is(&self, topic: TopicId, name: &str) -> bool {
        let (graph, mapping) = (self.graph, self.mapping);
        is_at_home(graph, mapping, topic.space, self.domain)
            || self
                .bridge
                .is_second(graph, mapping, (topic, name), self.domain)
            || self.taken.iter().any(|taken| taken == name)
    }
}

/// Whether another node than a bridge offers that service.
fn is_offered(graph: &Graph, snapshot: &Snapshot, service: &str) -> bool {
    let topic = format!("rq/{}Request", service.trim_start_matches('/'));
    let mut servers = snapshot.readers(&topic).iter();
    servers.any(|one| !graph.is_bridge(one.guid))
}

/// From when on after joining a domain services are offered in it.
pub(super) const SETTLED: Duration = Duration::from_secs(1);
/// How old what is known of others may be.
pub(super) const SEEN: Duration = Duration::from_millis(100);
