//! Services and actions in both directions: of other spaces for the graph, and of the graph for
//! other spaces.

use std::collections::{BTreeMap, VecDeque};
use std::future::poll_fn;
use std::sync::Arc;

use bridge_node::{
    AskId, BridgeActions, CallDescription, CallResponse, ExecutedServices, Execution, ExecutionId,
    Handover, LocalDelivery, PortEvent, Present, RosRequests, now,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use tcpros::{Node, ServiceServer};

use super::action_servers::{server, server_of, type_of};
use super::kinds::ServiceTypeLookup;
use super::side::Ros1Side;
use crate::definitions::Ros1Definitions;
use crate::ends::Ends;
use crate::services::{Ros1Graph, ServiceExecutor};

/// The services and actions in both directions.
#[derive(Debug)]
pub(super) struct Ros1Requests {
    both: RosRequests<ServiceServer, ServiceExecutor>,
    /// Whether this bridge is one of several redundant bridges of its space.
    is_redundant: bool,
    /// The action clients and servers.
    ends: Ends,
    /// The types of services with a name of the space.
    kinds: ServiceTypeLookup,
}

impl Ros1Requests {
    /// Starts the services that values call. Returns the events about their types too.
    pub(super) fn start(
        node: &Node,
        definitions: &mut Ros1Definitions,
        (own, mapping): (SpaceId, &Mapping),
    ) -> (Self, Vec<PortEvent>) {
        let mut ends = Ends::default();
        let mut graph = Ros1Graph {
            node,
            definitions,
            ends: &mut ends,
        };
        let (both, bound) = RosRequests::start(&mut graph, own, mapping);
        let requests = Self {
            both,
            is_redundant: false,
            ends,
            kinds: ServiceTypeLookup::default(),
        };
        (requests, bound)
    }

    /// Waits for the next events and adds them to `events`. Returns true if the type of a service
    /// was queried, after which [`find_services`](Self::find_services) is due. Cancel-safe.
    pub(super) async fn recv(&mut self, events: &mut VecDeque<PortEvent>) -> bool {
        let (both, kinds) = (&mut self.both, &mut self.kinds);
        tokio::select! {
            biased;
            () = poll_fn(|cx| both.poll_events::<Ros1Graph<'_>>(cx, events)) => false,
            () = kinds.recv() => true,
        }
    }

    /// Hands a value over to the service or action that takes it. Returns `None` for the values of
    /// topics.
    pub(super) fn publish(
        &mut self,
        side: &mut Ros1Side,
        sample: &LocalDelivery,
    ) -> Option<Result<(), &'static str>> {
        self.both.publish(&side.policy, sample, &mut side.events)
    }

    /// Returns the handover of the newest value of a topic that calls a service.
    pub(super) fn handover(&self, topic: TopicId) -> Option<Handover> {
        self.both.handover(topic)
    }

    /// Returns whether an action takes the values of a topic.
    pub(super) fn is_of_action(&self, side: &Ros1Side, topic: TopicId) -> bool {
        self.both.is_of_action(&side.policy, topic)
    }

    /// Records that this bridge is one of several redundant bridges of its space.
    pub(super) const fn is_one_of_several(&mut self) {
        self.is_redundant = true;
    }

    /// Offers a call of another space.
    pub(super) fn known(
        &mut self,
        side: &mut Ros1Side,
        topic: TopicId,
        description: &Arc<CallDescription>,
    ) {
        self.both.known(topic, description);
        self.offer_calls(side);
        self.offer_actions(side);
    }

    /// Withdraws a call of another space.
    pub(super) fn gone(&mut self, topic: TopicId) {
        self.both.gone(topic, now().monotonic);
    }

    /// Answers a request of the graph.
    pub(super) fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        self.both.answered(ask, answer);
    }

    /// Executes a call of the graph for another space.
    pub(super) fn execute(&mut self, side: &mut Ros1Side, execution: Execution) {
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
    pub(super) fn ask_for_mapped(&self, side: &mut Ros1Side) {
        side.events.extend(self.both.ask_for_mapped(&side.policy));
    }

    /// Compares the services and actions with the graph.
    pub(super) fn look(&mut self, side: &mut Ros1Side) {
        self.find_services(side);
        self.find_actions(side);
        self.offer_calls(side);
        self.offer_actions(side);
    }

    /// Removes calls and actions that were lost some time ago.
    pub(super) fn tidy(&mut self, side: &Ros1Side) {
        self.both.tidy(&side.policy, now().monotonic);
    }

    /// Switches to the mapping of the policy.
    pub(super) fn reload(&mut self, side: &mut Ros1Side, before: &Mapping) {
        let mapping = Arc::clone(side.policy.mapping());
        let mut graph = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        let own = side.policy.own();
        let events = self.both.reload(&mut graph, own, (before, &mapping));
        side.events.extend(events);
        self.both.calls_mut().look_again(&mut graph, &side.policy);
        self.offer_calls(side);
        let mut graph = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        let events = self.both.look_again(&mut graph, &mut side.policy);
        side.events.extend(events);
        self.find_services(side);
        self.find_actions(side);
        self.offer_actions(side);
        self.ask_for_mapped(side);
    }

    /// Offers the known calls as services. A call under a name from the mapping gives way to a
    /// service of another node, because the master keeps a single server per name, the last to
    /// register.
    fn offer_calls(&mut self, side: &mut Ros1Side) {
        let (services, own) = (&side.graph.services, side.node.name());
        let is_redundant = self.is_redundant;
        let other = |service: &str| {
            let nodes = services.get(service)?;
            nodes
                .iter()
                .find(|node| *node != own && !(is_redundant && is_redundant_peer(own, node)))
        };
        let is_chosen = |topic: TopicId, service: &str| service != format!("/{topic}");
        for (topic, service) in self.both.calls().chosen(&side.policy) {
            if let Some(node) = other(&service) {
                side.policy.told.once(&service, "taken", || {
                    format!(
                        "{topic} is not offered as {service}: the node {node} already offers this service; \
                         use another name, or stop the node"
                    )
                });
            }
        }
        let left =
            |topic: TopicId, service: &str| is_chosen(topic, service) && other(service).is_some();
        let calls = self.both.calls_mut();
        calls.leave(left);
        if !calls.is_waiting() {
            return;
        }
        let mut graph = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        // The owners of names are known once the master has responded.
        let has_master = side.has_master;
        let may = |topic: TopicId, service: &str| {
            !left(topic, service) && (has_master || !is_chosen(topic, service))
        };
        let events = calls.offer_waiting(&mut graph, &mut side.policy, may, usize::MAX);
        side.events.extend(events);
    }

    /// Offers the services of other nodes that are calls of this space, and withdraws calls of lost
    /// services.
    pub(super) fn find_services(&mut self, side: &mut Ros1Side) {
        let own = side.node.name();
        let services = side.graph.services.iter();
        let others = services.filter(|(_, nodes)| nodes.iter().any(|node| node != own));
        let policy = &side.policy;
        let mapping = Arc::clone(policy.mapping());
        let mapped = ExecutedServices::<ServiceExecutor>::mapped(&mapping, policy);
        let wanted = others.filter(|(service, _)| {
            let named = || ExecutedServices::<ServiceExecutor>::is_named(policy, service);
            service.len() <= MAX_NAME && (mapped.contains(service.as_str()) || named())
        });
        let others: BTreeMap<&str, &[String]> = wanted
            .map(|(service, nodes)| (service.as_str(), nodes.as_slice()))
            .collect();
        for (service, error) in self.kinds.look(&side.node, others.iter()) {
            side.policy.told.once(&service, "type of the service", || {
                format!("the type of the service {service} is unknown: {error}")
            });
        }
        let present: Present = others
            .keys()
            .map(|service| ((*service).to_owned(), self.kinds.of(service).cloned()))
            .collect();
        let mut graph = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        let executing = self.both.executing_mut();
        let events = executing.reconcile(&mut graph, &mut side.policy, (&present, usize::MAX));
        side.events.extend(events);
    }

    /// Offers the known actions. An action under a name from the mapping gives way to an action
    /// server of another node, because both servers would take each goal.
    fn offer_actions(&mut self, side: &mut Ros1Side) {
        let (graph, own) = (&side.graph, side.node.name());
        let is_redundant = self.is_redundant;
        let is_other = |node: &str| node != own && !(is_redundant && is_redundant_peer(own, node));
        let other = |action: &str| server_of(graph, is_other, action);
        let is_chosen = |topic: TopicId, action: &str| action != format!("/{topic}");
        for (topic, action) in self.both.actions().chosen(&side.policy) {
            if let Some(node) = other(&action) {
                side.policy.told.once(&action, "taken", || {
                    format!(
                        "{topic} is not offered as {action}: the node {node} already serves this action; \
                         use another name, or stop the node"
                    )
                });
            }
        }
        let left =
            |topic: TopicId, action: &str| is_chosen(topic, action) && other(action).is_some();
        let actions = self.both.actions_mut();
        actions.leave(left);
        if !actions.is_waiting() {
            return;
        }
        let mut ros = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        // The owners of names are known once the master has responded.
        let has_master = side.has_master;
        let may = |topic: TopicId, action: &str| {
            !left(topic, action) && (has_master || !is_chosen(topic, action))
        };
        let with = (&mut ros, &mut side.policy);
        let events = self.both.offer_actions(with, may, usize::MAX);
        side.events.extend(events);
    }

    /// Offers the action servers of other nodes that are actions of this space, and withdraws
    /// actions of lost servers.
    fn find_actions(&mut self, side: &mut Ros1Side) {
        let mapping = Arc::clone(side.policy.mapping());
        let mapped = BridgeActions::mapped(&mapping, &side.policy);
        let (graph, own) = (&side.graph, side.node.name());
        let mut present = Present::new();
        for topic in graph.subscribers.keys() {
            let Some(action) = topic.strip_suffix("/goal") else {
                continue;
            };
            let wanted = mapped.contains(action) || BridgeActions::is_named(&side.policy, action);
            if action.len() > MAX_NAME || !wanted || server(graph, own, action).is_none() {
                continue;
            }
            present.insert(action.to_owned(), type_of(graph, action));
        }
        let mut ros = Ros1Graph {
            node: &side.node,
            definitions: &mut side.definitions,
            ends: &mut self.ends,
        };
        let actions = self.both.actions_mut();
        let events = actions.reconcile(&mut ros, &mut side.policy, (&present, usize::MAX));
        side.events.extend(events);
    }
}

/// Returns whether a node is a redundant bridge of the space, by its name: NAME, NAME_2 or NAME_3.
/// The master still lists the services of a bridge that was killed.
pub(super) fn is_redundant_peer(own: &str, node: &str) -> bool {
    fn base(name: &str) -> &str {
        let mut ranks = ["_2", "_3"].into_iter();
        let stripped = ranks.find_map(|rank| name.strip_suffix(rank));
        stripped.unwrap_or(name)
    }
    own != node && base(own) == base(node)
}

/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 255;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nodes_of_redundant_bridges_differ_by_their_rank() {
        for (own, node) in [
            ("/cell", "/cell_2"),
            ("/cell_3", "/cell"),
            ("/cell_2", "/cell_3"),
        ] {
            assert!(is_redundant_peer(own, node), "{own} {node}");
        }
        for (own, node) in [
            ("/cell", "/cell"),
            ("/cell", "/cell_4"),
            ("/cell_2", "/arm_2"),
        ] {
            assert!(!is_redundant_peer(own, node), "{own} {node}");
        }
    }
}
