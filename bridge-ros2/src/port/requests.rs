//! Services and actions in both directions: of other spaces for the domain, and of the domain for
//! other spaces.

use std::sync::Arc;
use std::task::{Context, Poll};

use bridge_node::policy::Policy;
use bridge_node::{
    AskId, BridgeActions, CallDescription, CallResponse, CallRole, ExecutedServices, Execution,
    ExecutionId, Handover, LocalDelivery, PortEvent, RosRequests, now,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use ros2_node::domain::Domain;
use ros2_node::graph::Graph;
use ros2_node::service::{
    ServiceCounters, ServicePeers, ServiceServer, Snapshot, action_type, service_type,
};
use rustdds::RTPSEntity;
use tokio::time::Instant;

use super::bridges::{BridgeIdentity, is_at_home};
use super::services::{DomainServiceClient, Ros2Graph};
use super::side::{Ros2Side, SETTLED, ServerKind};
use crate::definitions::Ros2Definitions;

/// The services and actions in both directions.
pub(super) struct Ros2Requests {
    both: RosRequests<ServiceServer, DomainServiceClient>,
    /// The endpoints of other participants on the topics of services and actions.
    peers: ServicePeers,
    /// Whether this bridge is one of several redundant bridges of its space.
    is_redundant: bool,
}

impl Ros2Requests {
    /// Starts the services that values call. Returns the events about their types too.
    pub(super) fn start(
        domain: &Domain,
        peers: ServicePeers,
        definitions: &mut Ros2Definitions,
        (own, mapping): (SpaceId, &Mapping),
    ) -> (Self, Vec<PortEvent>) {
        let mut graph = Ros2Graph {
            peers: &peers,
            domain,
            definitions,
        };
        let (both, bound) = RosRequests::start(&mut graph, own, mapping);
        let requests = Self {
            both,
            peers,
            is_redundant: false,
        };
        (requests, bound)
    }

    /// Polls for the next events, and adds them to the events of the side.
    pub(super) fn poll_events(&mut self, side: &mut Ros2Side, cx: &mut Context<'_>) -> Poll<()> {
        let events = &mut side.events;
        self.both.poll_events::<Ros2Graph<'_>>(cx, events)
    }

    /// Hands a value over to the service or action that takes it. Returns `None` for the values of
    /// topics.
    pub(super) fn publish(
        &mut self,
        side: &mut Ros2Side,
        sample: &LocalDelivery,
    ) -> Option<Result<(), &'static str>> {
        self.both.publish(&side.policy, sample, &mut side.events)
    }

    /// Returns the handover of the newest value of a topic that calls a service.
    pub(super) fn handover(&self, topic: TopicId) -> Option<Handover> {
        self.both.handover(topic)
    }

    /// Returns whether a service or an action takes the values of a topic.
    pub(super) fn takes(&self, side: &Ros2Side, topic: TopicId) -> bool {
        self.both.is_of_action(&side.policy, topic) || self.both.is_of_service(topic)
    }

    /// Records that this bridge is one of several redundant bridges of its space.
    pub(super) const fn is_one_of_several(&mut self) {
        self.is_redundant = true;
    }

    /// Records the description of a call of another space, which is offered in the next pass.
    pub(super) fn known(
        &mut self,
        side: &mut Ros2Side,
        topic: TopicId,
        description: &Arc<CallDescription>,
    ) {
        self.both.known(topic, description);
        side.schedule.look_next();
    }

    /// Withdraws a call of another space.
    pub(super) fn gone(&mut self, topic: TopicId) {
        self.both.gone(topic, now().monotonic);
    }

    /// Answers a request of the domain.
    pub(super) fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        self.both.answered(ask, answer);
    }

    /// Executes a call of the domain for another space.
    pub(super) fn execute(&mut self, side: &mut Ros2Side, execution: Execution) {
        self.both.execute(execution, &mut side.events);
    }

    /// Records that the requestor of an execution has stopped waiting.
    pub(super) fn abandoned(&mut self, execution: ExecutionId) {
        self.both.abandoned(execution);
    }

    /// Returns the executions with a pending cancellation.
    pub(super) fn pending(&self) -> Vec<String> {
        self.both.pending()
    }

    /// Asks for the calls of the mapping.
    pub(super) fn ask_for_mapped(&self, side: &mut Ros2Side) {
        side.events.extend(self.both.ask_for_mapped(&side.policy));
    }

    /// Removes calls and actions that were lost some time ago.
    pub(super) fn tidy(&mut self, side: &Ros2Side) {
        self.both.tidy(&side.policy, now().monotonic);
    }

    /// Offers the known calls and actions.
    pub(super) fn offer(&mut self, side: &mut Ros2Side) {
        self.offer_calls(side);
        self.offer_actions(side);
    }

    /// Compares the services and actions with the domain.
    pub(super) fn find(&mut self, side: &mut Ros2Side) {
        self.find_services(side);
        self.find_actions(side);
    }

    /// Returns the counters of the offered services.
    pub(super) fn counters(&self) -> ServiceCounters {
        let calls = self.both.calls().servers().map(ServiceServer::counters);
        calls.fold(ServiceCounters::default(), ServiceCounters::plus)
    }

    /// Returns the endpoints of other participants on the topics of services and actions.
    pub(super) const fn peers(&self) -> &ServicePeers {
        &self.peers
    }

    /// Switches to the mapping of the policy.
    pub(super) fn reload(&mut self, side: &mut Ros2Side, before: &Mapping) {
        let mapping = Arc::clone(side.policy.mapping());
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &side.domain,
            definitions: &mut side.definitions,
        };
        let own = side.policy.own();
        let events = self.both.reload(&mut graph, own, (before, &mapping));
        side.events.extend(events);
        self.both.calls_mut().look_again(&mut graph, &side.policy);
        let events = self.both.look_again(&mut graph, &mut side.policy);
        side.events.extend(events);
        self.ask_for_mapped(side);
    }

    /// Offers the known calls as services, within the budget of endpoints.
    ///
    /// Not offered, because a client calls all servers of a name:
    /// - calls of a space that another bridge of the domain serves
    /// - calls that such a bridge offers too
    /// - calls under a chosen name that another node offers
    fn offer_calls(&mut self, side: &mut Ros2Side) {
        let snapshot = self.peers.current(Instant::now());
        let mut taken = Vec::new();
        for (topic, service) in self.both.calls().chosen(&side.policy) {
            if is_offered(&side.graph, &snapshot, &service) {
                side.policy.told.once(&service, "taken", || {
                    format!("{topic} is not offered as {service}: another node already offers this service; \
                             use another name, or stop the node")
                });
                taken.push(service);
            }
        }
        let (bridge, mapping) = (self.bridge(side), Arc::clone(side.policy.mapping()));
        let left = Left {
            graph: &side.graph,
            mapping: &mapping,
            bridge,
            domain: side.domain_id,
            taken,
        };
        self.both
            .calls_mut()
            .leave(|topic, service| left.is(topic, service));
        if !self.both.calls().is_waiting() {
            return;
        }
        let mut services = Ros2Graph {
            peers: &self.peers,
            domain: &side.domain,
            definitions: &mut side.definitions,
        };
        let (calls, policy) = (self.both.calls_mut(), &mut side.policy);
        // Other bridges of the domain are discovered by this time.
        let settled = side.joined.elapsed() >= SETTLED;
        let may = |topic: TopicId, service: &str| settled && !left.is(topic, service);
        // Each service has a reader and a writer.
        let events = calls.offer_waiting(&mut services, policy, may, side.budget / 2);
        side.budget = side.budget.saturating_sub(2 * events.len());
        for event in &events {
            if let PortEvent::CallBound { service_type, .. } = event {
                side.tell_service(service_type.name());
            }
        }
        side.events.extend(events);
    }

    /// Offers the services of other nodes that are calls of our space, and withdraws the lost
    /// services. If servers of one name have two types, neither can be called.
    fn find_services(&mut self, side: &mut Ros2Side) {
        let snapshot = self.peers.current(Instant::now());
        let mapping = Arc::clone(side.policy.mapping());
        let mapped = ExecutedServices::<DomainServiceClient>::mapped(&mapping, &side.policy);
        let is_wanted = |policy: &Policy, service: &str| {
            ExecutedServices::<DomainServiceClient>::is_named(policy, service)
                || mapped.contains(service)
        };
        let kind = ServerKind {
            noun: "service",
            told: "type of the service",
            type_of: service_type,
        };
        let present = side.present(snapshot.offered(), kind, is_wanted);
        let called = snapshot.called().chain(snapshot.called_actions());
        let looked_for = called.filter_map(|(name, clients)| {
            let topic: TopicId = name.parse().ok()?;
            let ours = side.policy.own() == topic.space;
            let mut clients = clients.iter();
            let somebody = clients.any(|one| !side.graph.is_bridge(one.guid));
            (!ours && somebody).then_some(topic)
        });
        let events = self.both.calls_mut().looked_for(looked_for.collect());
        side.events.extend(events);
        let mut services = Ros2Graph {
            peers: &self.peers,
            domain: &side.domain,
            definitions: &mut side.definitions,
        };
        let most = side.budget / 2;
        let executing = self.both.executing_mut();
        let events = executing.reconcile(&mut services, &mut side.policy, (&present, most));
        let made = events
            .iter()
            .filter(|event| matches!(event, PortEvent::OfferTyped { .. }));
        let made = made.count();
        side.budget = side.budget.saturating_sub(2 * made);
        side.schedule.unfinished |= made == most;
        side.events.extend(events);
    }

    /// Returns the identity of this bridge.
    fn bridge(&self, side: &Ros2Side) -> BridgeIdentity {
        BridgeIdentity {
            space: side.policy.own(),
            participant: side.domain.participant().guid(),
            is_redundant: self.is_redundant,
        }
    }

    /// Serves the known actions, as [`offer_calls`](Self::offer_calls) does for services.
    fn offer_actions(&mut self, side: &mut Ros2Side) {
        let snapshot = self.peers.current(Instant::now());
        let mut taken = Vec::new();
        for (topic, action) in self.both.actions().chosen(&side.policy) {
            if is_served(&side.graph, &snapshot, &action) {
                side.policy.told.once(&action, "taken", || {
                    format!("{topic} is not offered as {action}: another node already serves this action; \
                             use another name, or stop the node")
                });
                taken.push(action);
            }
        }
        let (bridge, mapping) = (self.bridge(side), Arc::clone(side.policy.mapping()));
        let left = Left {
            graph: &side.graph,
            mapping: &mapping,
            bridge,
            domain: side.domain_id,
            taken,
        };
        self.both
            .actions_mut()
            .leave(|topic, action| left.is(topic, action));
        if !self.both.actions().is_waiting() {
            return;
        }
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &side.domain,
            definitions: &mut side.definitions,
        };
        let settled = side.joined.elapsed() >= SETTLED;
        let before = self.both.actions().offered().len();
        let with = (&mut graph, &mut side.policy);
        let may = |topic: TopicId, action: &str| settled && !left.is(topic, action);
        let most = side.budget / ENDPOINTS;
        let events = self.both.offer_actions(with, may, most);
        let made = self.both.actions().offered().len().saturating_sub(before);
        side.budget = side.budget.saturating_sub(ENDPOINTS * made);
        for event in &events {
            if let PortEvent::CallBound { service_type, .. } = event {
                side.tell_action(service_type.name());
            }
        }
        side.events.extend(events);
    }

    /// Offers the action servers of other nodes that are actions of our space, and withdraws the
    /// lost servers. If servers of one name have two types, neither can be called.
    fn find_actions(&mut self, side: &mut Ros2Side) {
        let snapshot = self.peers.current(Instant::now());
        let mapping = Arc::clone(side.policy.mapping());
        let mapped = BridgeActions::mapped(&mapping, &side.policy);
        let is_wanted = |policy: &Policy, action: &str| {
            BridgeActions::is_named(policy, action) || mapped.contains(action)
        };
        let kind = ServerKind {
            noun: "action",
            told: "type of the action",
            type_of: action_type,
        };
        let present = side.present(snapshot.served_actions(), kind, is_wanted);
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &side.domain,
            definitions: &mut side.definitions,
        };
        let most = side.budget / ENDPOINTS;
        let actions = self.both.actions_mut();
        let events = actions.reconcile(&mut graph, &mut side.policy, (&present, most));
        let made = events.iter().filter(|event| is_goal(event)).count();
        side.budget = side.budget.saturating_sub(ENDPOINTS * made);
        side.schedule.unfinished |= most > 0 && made == most;
        side.events.extend(events);
    }
}

/// Selects the calls of other spaces that are left to other servers of the domain.
struct Left<'p> {
    graph: &'p Graph,
    mapping: &'p Mapping,
    bridge: BridgeIdentity,
    domain: u16,
    /// The names that another node offers.
    taken: Vec<String>,
}

impl Left<'_> {
    /// Returns whether this bridge must not offer the call under the name.
    fn is(&self, topic: TopicId, name: &str) -> bool {
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
