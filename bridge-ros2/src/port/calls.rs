//! Offers calls of other spaces as services of the domain, and executes services of the domain for
//! other spaces.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::policy::Policy;
use bridge_node::{Actions, Executing, PortEvent, Present};
use mappings::{Mapping, TopicId};
use messages::TypeName;
use ros2_node::graph::{Endpoint, Graph};
use ros2_node::service::{Snapshot, service_type};
use rustdds::RTPSEntity;
use tokio::time::Instant;

use super::Ros2Port;
use super::bridges::{Bridge, is_at_home};
use super::services::{Client, Ros2Graph};

impl Ros2Port {
    /// Offers the known calls as services, within the budget of endpoints.
    ///
    /// Not offered, because a client calls all servers of a name:
    /// - calls of a space that another bridge of the domain serves
    /// - calls that such a bridge offers too
    /// - calls under a chosen name that another node offers
    pub(super) fn offer_calls(&mut self) {
        let snapshot = self.peers.current(Instant::now());
        let mut taken = Vec::new();
        for (topic, service) in self.calls.chosen(&self.policy) {
            if is_offered(&self.graph, &snapshot, &service) {
                self.policy.told.once(&service, "taken", || {
                    format!("{topic} is not offered as {service}: another node already offers this service; \
                             use another name, or stop the node")
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
        // Other bridges of the domain are discovered by this time.
        let settled = self.joined.elapsed() >= SETTLED;
        let may = |topic: TopicId, service: &str| settled && !left.is(topic, service);
        // Each service has a reader and a writer.
        let events = calls.offer_waiting(&mut services, policy, may, self.budget / 2);
        self.budget = self.budget.saturating_sub(2 * events.len());
        for event in &events {
            if let PortEvent::CallBound { service_type, .. } = event {
                self.tell_service(service_type.name());
            }
        }
        self.events.extend(events);
    }

    /// Offers the services of other nodes that are calls of our space, and withdraws the lost
    /// services. If servers of one name have two types, neither can be called.
    pub(super) fn find_services(&mut self) {
        let snapshot = self.peers.current(Instant::now());
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

    /// Returns the wanted servers of other nodes with their types. Servers of other bridges are
    /// left out: they are executed elsewhere. If servers of one name have two types, neither can be
    /// called.
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
                        "the {noun} {name} is not offered to other spaces: its type is {}",
                        types.join(" and ")
                    )
                });
            }
            present.insert(name, type_name);
        }
        present
    }

    /// Returns the identity of this bridge.
    pub(super) fn bridge(&self) -> Bridge {
        Bridge {
            space: self.policy.own(),
            participant: self.domain.participant().guid(),
            is_redundant: self.is_redundant,
        }
    }

    /// Serves the description of the type of a service.
    fn tell_service(&self, name: &TypeName) {
        if let Some(hashes) = self.definitions.service_type_hashes(name)
            && let Ok(described) = self.definitions.described_service(name)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hashes.service);
        }
    }
}

/// A kind of servers: services or actions.
#[derive(Clone, Copy)]
pub(super) struct Kind {
    /// The noun in log messages.
    pub(super) noun: &'static str,
    /// The key under which an unusable type is logged once.
    pub(super) told: &'static str,
    /// Converts the DDS type of the requests to the ROS type.
    pub(super) type_of: fn(&str) -> String,
}

/// Selects the calls of other spaces that are left to other servers of the domain.
pub(super) struct Left<'p> {
    pub(super) graph: &'p Graph,
    pub(super) mapping: &'p Mapping,
    pub(super) bridge: Bridge,
    pub(super) domain: u16,
    /// The names that another node offers.
    pub(super) taken: Vec<String>,
}

impl Left<'_> {
    /// Returns whether this bridge must not offer the call under the name.
    pub(super) fn is(&self, topic: TopicId, name: &str) -> bool {
        let (graph, mapping) = (self.graph, self.mapping);
        is_at_home(graph, mapping, topic.space, self.domain)
            || self
                .bridge
                .is_second(graph, mapping, (topic, name), self.domain)
            || self.taken.iter().any(|taken| taken == name)
    }
}

/// Returns whether a node that is not a bridge offers the service.
fn is_offered(graph: &Graph, snapshot: &Snapshot, service: &str) -> bool {
    let topic = format!("rq/{}Request", service.trim_start_matches('/'));
    let mut servers = snapshot.readers(&topic).iter();
    servers.any(|one| !graph.is_bridge(one.guid))
}

/// The delay after joining a domain before services are offered.
pub(super) const SETTLED: Duration = Duration::from_secs(1);
