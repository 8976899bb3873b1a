//! Offers actions of other spaces as action servers of the domain, and executes action servers of
//! the domain for other spaces.

use std::sync::Arc;

use bridge_node::policy::Policy;
use bridge_node::{Actions, CallRole, PortEvent};
use messages::TypeName;
use ros2_node::graph::Graph;
use ros2_node::service::{Snapshot, action_type};
use tokio::time::Instant;

use super::Ros2Port;
use super::calls::{Kind, Left, SETTLED};
use super::services::Ros2Graph;

impl Ros2Port {
    /// Serves the known actions, as [`offer_calls`](Self::offer_calls) does for services.
    pub(super) fn offer_actions(&mut self) {
        let snapshot = self.peers.current(Instant::now());
        let mut taken = Vec::new();
        for (topic, action) in self.actions.chosen(&self.policy) {
            if is_served(&self.graph, &snapshot, &action) {
                self.policy.told.once(&action, "taken", || {
                    format!("{topic} is not offered as {action}: another node already serves this action; \
                             use another name, or stop the node")
                });
                taken.push(action);
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
        self.actions.leave(|topic, action| left.is(topic, action));
        if !self.actions.is_waiting() {
            return;
        }
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let (calls, actions) = (&self.calls, &mut self.actions);
        let settled = self.joined.elapsed() >= SETTLED;
        let before = actions.offered().len();
        let events = actions.offer_waiting(
            (&mut graph, &mut self.policy),
            |topic| calls.asker(topic),
            |topic, action| settled && !left.is(topic, action),
            self.budget / ENDPOINTS,
        );
        let made = actions.offered().len().saturating_sub(before);
        self.budget = self.budget.saturating_sub(ENDPOINTS * made);
        for event in &events {
            if let PortEvent::CallBound { service_type, .. } = event {
                self.tell_action(service_type.name());
            }
        }
        self.events.extend(events);
    }

    /// Offers the action servers of other nodes that are actions of our space, and withdraws the
    /// lost servers. If servers of one name have two types, neither can be called.
    pub(super) fn find_actions(&mut self) {
        let snapshot = self.peers.current(Instant::now());
        let mapping = Arc::clone(self.policy.mapping());
        let mapped = Actions::mapped(&mapping, &self.policy);
        let is_wanted = |policy: &Policy, action: &str| {
            Actions::is_named(policy, action) || mapped.contains(action)
        };
        let kind = Kind {
            noun: "action",
            told: "type of the action",
            type_of: action_type,
        };
        let present = self.present(snapshot.served_actions(), kind, is_wanted);
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let most = self.budget / ENDPOINTS;
        let actions = &mut self.actions;
        let events = actions.reconcile(&mut graph, &mut self.policy, (&present, most));
        let made = events.iter().filter(|event| is_goal(event)).count();
        self.budget = self.budget.saturating_sub(ENDPOINTS * made);
        self.schedule.unfinished |= most > 0 && made == most;
        self.events.extend(events);
    }

    /// Serves the description of the type of an action. The name of a call that sends goals is the
    /// name of the action type.
    fn tell_action(&mut self, name: &TypeName) {
        if let Some(hashes) = self.definitions.action_type_hashes(name)
            && let Ok(described) = self.definitions.described_action(name)
        {
            let sources = self.definitions.sources(&described);
            self.told_types.learn(described, sources, hashes.action);
        }
    }
}

/// Returns whether the event starts the execution of an action, judged by its call that takes
/// goals.
fn is_goal(event: &PortEvent) -> bool {
    matches!(
        event,
        PortEvent::OfferTyped { offered, .. } if matches!(offered.role, CallRole::Goal(_))
    )
}

/// Returns whether a node that is not a bridge serves the action.
fn is_served(graph: &Graph, snapshot: &Snapshot, action: &str) -> bool {
    let action = action.trim_start_matches('/');
    let mut served = snapshot.served_actions();
    let servers = served.find_map(|(name, servers)| (name == action).then_some(servers));
    let mut servers = servers.unwrap_or_default().iter();
    servers.any(|one| !graph.is_bridge(one.guid))
}

/// The endpoints of an action on either side: a reader and a writer for each of three services, and
/// two for topics.
const ENDPOINTS: usize = 8;
