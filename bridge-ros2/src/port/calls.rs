//! Calls of other spaces, as services of the domain; and services of the domain, executed for other spaces.

use std::sync::Arc;

use bridge_node::{Executing, PortEvent, Present};
use mappings::TopicId;
use messages::TypeName;

use super::Ros2Port;
use super::bridges::is_at_home;
use super::services::{Client, Ros2Graph};

impl Ros2Port {
    /// Offers the calls that are known as services, as far as there is room for endpoints; those of a space that another
    /// bridge of the domain serves are left to it.
    pub(super) fn offer_calls(&mut self) {
        let mapping = Arc::clone(self.policy.mapping());
        let (graph, domain) = (&self.graph, self.domain_id);
        let at_home = |topic: TopicId| is_at_home(graph, &mapping, topic.space, domain);
        self.calls.leave(at_home);
        if !self.calls.is_waiting() {
            return;
        }
        let mut services = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let (calls, policy) = (&mut self.calls, &mut self.policy);
        let may = |topic| !at_home(topic);
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
        let mut present = Present::new();
        for (service, types) in self.domain.services() {
            let type_name = match types.first() {
                Some(name) if types.len() == 1 => name.parse().ok(),
                Some(_) | None => None,
            };
            if type_name.is_none() && Executing::<Client>::is_wanted(&self.policy, &service) {
                let types: Vec<String> = types.into_iter().collect();
                self.policy.told.once(&service, "type of the service", || {
                    format!(
                        "the service {service} cannot be asked for from other spaces: its type is {}",
                        types.join(" and ")
                    )
                });
            }
            present.insert(service, type_name);
        }
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

    /// Has the node tell who asks what the type of a service is.
    fn tell_service(&self, name: &TypeName) {
        if let Some(hashes) = self.definitions.service_type_hashes(name)
            && let Ok(described) = self.definitions.described_service(name)
        {
            self.told_types.learn(described, hashes.service);
        }
    }
}
