//! The services and actions of a ROS port in both directions.

use std::collections::VecDeque;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use bridge_core::{
    AskId, CallDescription, CallResponse, Executed, ExecutionId, Handover, Reason, ValueRelation,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};

use crate::actions::{ActionGraph, BridgeActions};
use crate::calls::{CallGraph, SpaceCalls};
use crate::clock::now;
use crate::executing::{ExecutedServices, ExecutorGraph};
use crate::policy::{Policy, is_bad};
use crate::port::{Execution, LocalDelivery, PortEvent};
use crate::services::{BridgeServiceCalls, ServiceCall, ServiceGraph};

/// The services and actions of a ROS port in both directions: calls of other spaces that are
/// offered to the local side, and calls of the local side that are executed for other spaces. `S`
/// is the server of an offered service, and `E` the client of an executed service.
#[derive(Debug)]
pub struct RosRequests<S, E> {
    /// Services that are called for values.
    services: BridgeServiceCalls,
    /// Calls of other spaces, offered as services.
    calls: SpaceCalls<S>,
    /// Services of the local side, executed for other spaces.
    executing: ExecutedServices<E>,
    /// Actions in both directions.
    actions: BridgeActions,
}

impl<S: Send, E: ServiceCall + Sync> RosRequests<S, E> {
    /// Starts the services that values call. Returns the events about their types too.
    pub fn start(
        graph: &mut impl ServiceGraph,
        own: SpaceId,
        mapping: &Mapping,
    ) -> (Self, Vec<PortEvent>) {
        let (services, bound) = BridgeServiceCalls::start(graph, own, mapping);
        let requests = Self {
            services,
            calls: SpaceCalls::default(),
            executing: ExecutedServices::default(),
            actions: BridgeActions::default(),
        };
        (requests, bound)
    }

    /// Polls for the next events, and adds them to `events`.
    pub fn poll_events<G: CallGraph<Server = S>>(
        &mut self,
        cx: &mut Context<'_>,
        events: &mut VecDeque<PortEvent>,
    ) -> Poll<()> {
        if let Poll::Ready(outcome) = self.services.poll_recv(cx) {
            events.extend(self.services.ended(outcome, now().utc));
        } else if let Poll::Ready(executed) = self.executing.poll_recv(cx) {
            events.extend(executed);
        } else if let Poll::Ready(reports) = self.actions.poll_recv(cx) {
            events.extend(reports);
        } else if let Poll::Ready(event) = self.calls.poll_recv::<G>(cx) {
            // After the others, so that a flood of requests does not delay outcomes.
            events.push_back(event);
        } else {
            return Poll::Pending;
        }
        Poll::Ready(())
    }

    /// Hands a value over to the service or action that takes it. Returns `None` for the values of
    /// topics.
    ///
    /// # Errors
    /// The inner result is the reason for which the value was not handed over.
    pub fn publish(
        &mut self,
        policy: &Policy,
        sample: &LocalDelivery,
        events: &mut VecDeque<PortEvent>,
    ) -> Option<Result<(), &'static str>> {
        let topic = sample.topic;
        if self.actions.takes(policy, topic) {
            return Some(self.actions.publish(sample));
        }
        if !self.services.takes(topic) {
            return None;
        }
        // A repeated value is for late joiners, and a service is not a late joiner.
        if sample.kept == ValueRelation::Again {
            return Some(Ok(()));
        }
        if is_bad(sample.status) {
            return Some(Err("bad status"));
        }
        let replaced = self.services.hand_over(topic, &sample.payload)?;
        if replaced > 0 {
            events.push_back(PortEvent::Lost {
                topic: Some(topic),
                reason: Reason::Overflow,
                why: "service too slow",
                count: replaced,
            });
        }
        Some(Ok(()))
    }

    /// Returns the handover of the newest value of a topic that calls a service; `None` for other
    /// topics.
    #[must_use]
    pub fn handover(&self, topic: TopicId) -> Option<Handover> {
        self.services.handover(topic)
    }

    /// Returns whether an action takes the values of a topic. They are bound when the action is
    /// served.
    #[must_use]
    pub fn is_of_action(&self, policy: &Policy, topic: TopicId) -> bool {
        self.actions.takes(policy, topic)
    }

    /// Returns whether the values of a topic call a service.
    #[must_use]
    pub fn is_of_service(&self, topic: TopicId) -> bool {
        self.services.takes(topic)
    }

    /// Records the description of a call of another space.
    pub fn known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.calls.known(topic, Arc::clone(description));
        self.actions.known(topic, description);
    }

    /// Records that the executor of a call of another space was lost.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        self.calls.gone(topic, now);
        self.actions.gone(topic, now);
    }

    /// Answers a request of the local side.
    pub fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        self.calls.answered(ask, answer);
    }

    /// Executes a call of the local side for another space. A refusal is added to `events`.
    pub fn execute(&mut self, execution: Execution, events: &mut VecDeque<PortEvent>) {
        let id = execution.id;
        let begun = if self.actions.serves(execution.topic) {
            self.actions.execute(execution)
        } else {
            self.executing.execute(execution)
        };
        if let Err(refusal) = begun {
            events.push_back(PortEvent::Executed {
                execution: id,
                outcome: Executed::Refused(refusal),
            });
        }
    }

    /// Records that the requestor of an execution has stopped waiting.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        self.actions.abandoned(execution);
    }

    /// Returns the executions with a pending cancellation.
    #[must_use]
    pub fn pending(&self) -> Vec<String> {
        self.actions.pending()
    }

    /// Removes calls and actions that were lost some time ago.
    pub fn tidy(&mut self, policy: &Policy, now: Instant) {
        self.calls.tidy(now);
        self.actions.tidy(policy, now);
    }

    /// Returns the requests for the calls of the mapping that are not known.
    #[must_use]
    pub fn ask_for_mapped(&self, policy: &Policy) -> Vec<PortEvent> {
        self.calls.ask_for_mapped(policy)
    }

    /// Switches the services that values call to another mapping.
    pub fn reload(
        &mut self,
        graph: &mut impl ServiceGraph,
        own: SpaceId,
        mappings: (&Mapping, &Mapping),
    ) -> Vec<PortEvent> {
        self.services.reload(graph, own, mappings)
    }

    /// Checks the executed services and actions again after a change of the mapping or of the
    /// definitions.
    pub fn look_again<G>(&mut self, graph: &mut G, policy: &mut Policy) -> Vec<PortEvent>
    where
        G: ExecutorGraph<Executor = E> + ActionGraph,
    {
        let mut events = self.executing.look_again(graph);
        events.extend(self.actions.look_again(graph, policy));
        events
    }

    /// Serves waiting actions of other spaces for which `may` returns true, up to `most`.
    pub fn offer_actions<G: ActionGraph>(
        &mut self,
        with: (&mut G, &mut Policy),
        may: impl Fn(TopicId, &str) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let calls = &self.calls;
        self.actions
            .offer_waiting(with, |topic| calls.asker(topic), may, most)
    }

    /// Returns the calls of other spaces.
    #[must_use]
    pub const fn calls(&self) -> &SpaceCalls<S> {
        &self.calls
    }

    /// Returns the calls of other spaces, to offer them as services.
    pub const fn calls_mut(&mut self) -> &mut SpaceCalls<S> {
        &mut self.calls
    }

    /// Returns the services of the local side, to compare them with the graph.
    pub const fn executing_mut(&mut self) -> &mut ExecutedServices<E> {
        &mut self.executing
    }

    /// Returns the actions of both directions.
    #[must_use]
    pub const fn actions(&self) -> &BridgeActions {
        &self.actions
    }

    /// Returns the actions of both directions, to compare them with the graph.
    pub const fn actions_mut(&mut self) -> &mut BridgeActions {
        &mut self.actions
    }
}
