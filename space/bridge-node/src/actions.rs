//! Actions between a ROS graph and the space.
//!
//! An action server of the graph is executed for other spaces if it is a call of the own space, by
//! the mapping or by its name (`/ua_1_2_70`). Sending a goal, cancelling and waiting for a result
//! are requests; feedback and goal statuses are values. An action of another space is offered as an
//! action server of the graph.

mod block;
mod encoding;
mod executors;
mod facade;
mod facades;
mod graph;
mod own;
mod pending;
mod serving;
mod table;
mod wire;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use bridge_core::{CallDescription, ExecutionId, Refusal};
use mappings::{CallKind, Mapping, TopicId};
use tokio::sync::mpsc;

pub use self::graph::{
    ActionGraph, GraphActionClient, GraphActionServer, GraphCancelRequest, GraphCancelResponse,
    GraphCancelSelection, GraphGoalEvent, GraphGoalId, GraphNewGoal, GraphServerEvent, NO_GOAL,
    SentGoal, ServedGoal, Waits,
};

pub use self::own::{OwnAction, OwnActions};

use self::executors::Executors;
use self::facades::Facades;
use crate::policy::Policy;
use crate::port::{Execution, LocalDelivery};
use crate::present::{self, Present};
use crate::{Asker, PortEvent};

/// The actions of one bridge: actions of its graph that are executed for other spaces, and actions
/// of other spaces that are offered in its graph.
#[derive(Debug)]
pub struct BridgeActions {
    executors: Executors,
    facades: Facades,
    reports: mpsc::Receiver<PortEvent>,
    report: mpsc::Sender<PortEvent>,
}

impl Default for BridgeActions {
    fn default() -> Self {
        let (report, reports) = mpsc::channel(MOST_REPORTS);
        Self {
            executors: Executors::default(),
            facades: Facades::default(),
            reports,
            report,
        }
    }
}

/// Actions of the graph, executed for other spaces.
impl BridgeActions {
    /// Returns whether the name of an action makes it a call of the own space, so that its type has
    /// to be found out.
    #[must_use]
    pub fn is_named(policy: &Policy, action: &str) -> bool {
        present::named(policy, action).is_some()
    }

    /// Returns the names of the actions that the mapping has executed in the own space.
    #[must_use]
    pub fn mapped<'m>(mapping: &'m Mapping, policy: &Policy) -> BTreeSet<&'m str> {
        present::mapped(mapping, policy, CallKind::Action)
    }

    /// Compares the present action servers, each with its type if known, with the actions that are
    /// offered to other spaces. Starts to offer at most `most` further actions.
    pub fn reconcile<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        (present, most): (&Present, usize),
    ) -> Vec<PortEvent> {
        let (executors, report) = (&mut self.executors, &self.report);
        executors.reconcile((graph, policy), (present, most), report)
    }

    /// Returns whether a call is executed here as a part of an action.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        self.executors.serves(topic)
    }

    /// Executes a request for a part of an action. The outcome is reported by [`recv`](Self::recv).
    ///
    /// # Errors
    /// The reason why the request is refused.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        self.executors.execute(execution)
    }

    /// Handles a caller that gives up an execution. An accepted goal goes on. A goal that its
    /// server has not decided about is cancelled as soon as it is accepted.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        self.executors.abandoned(execution);
    }

    /// Returns the goals with a pending cancellation, a line each.
    #[must_use]
    pub fn pending(&self) -> Vec<String> {
        self.executors.pending()
    }
}

/// Actions of other spaces, offered in the graph.
impl BridgeActions {
    /// Adds or updates a call of another space.
    pub fn known(&mut self, topic: TopicId, described: &Arc<CallDescription>) {
        self.facades.known(topic, described);
    }

    /// Notes that a call is lost. Its action server stays for `receive_timeout`, after which its
    /// goals are aborted.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        self.facades.gone(topic, now);
    }

    /// Withdraws the action servers of actions that are lost. To be called periodically.
    pub fn tidy(&mut self, policy: &Policy, now: Instant) {
        for event in self.facades.tidy(policy, now) {
            // A binding that remains if the queue is full costs memory only.
            drop(self.report.try_send(event));
        }
    }

    /// Returns the known actions that have a name in this space by the mapping, with the name.
    #[must_use]
    pub fn chosen(&self, policy: &Policy) -> Vec<(TopicId, String)> {
        self.facades.chosen(policy)
    }

    /// Returns whether any action waits to be offered.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        self.facades.is_waiting()
    }

    /// Withdraws the servers of the actions that are left to other bridges, by their names in this
    /// space. The actions wait to be offered again.
    pub fn leave(&mut self, to_others: impl Fn(TopicId, &str) -> bool) {
        self.facades.leave(to_others);
    }

    /// Offers at most `most` waiting actions that `may` be offered under their names in this space.
    /// `asker` returns the [`Asker`] of a call ([`SpaceCalls::asker`](crate::SpaceCalls::asker)).
    /// Reports the types of their calls and values.
    pub fn offer_waiting<G: ActionGraph>(
        &mut self,
        with: (&mut G, &mut Policy),
        asker: impl Fn(TopicId) -> Asker,
        may: impl Fn(TopicId, &str) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let (facades, report) = (&mut self.facades, &self.report);
        facades.offer_waiting(with, (asker, report), may, most)
    }

    /// Returns the names of the offered action servers.
    #[must_use]
    pub fn offered(&self) -> BTreeMap<TopicId, &str> {
        self.facades.offered()
    }

    /// Returns whether the values of a topic belong to an action server offered here. Such values
    /// are not published as a topic of the graph.
    #[must_use]
    pub fn takes(&self, policy: &Policy, topic: TopicId) -> bool {
        self.facades.takes(policy, topic)
    }

    /// Delivers a value of a topic for which [`takes`](Self::takes) returns true.
    ///
    /// # Errors
    /// A short reason under which the value is counted as dropped.
    pub fn publish(&mut self, value: &LocalDelivery) -> Result<(), &'static str> {
        self.facades.publish(value)
    }
}

/// Both directions.
impl BridgeActions {
    /// Checks all actions again, because definitions or the mapping may have changed.
    pub fn look_again<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
    ) -> Vec<PortEvent> {
        self.facades.look_again(graph, policy);
        self.executors.look_again(graph)
    }

    /// Returns the outcomes of executions and the reports of goals. Cancel-safe.
    pub async fn recv(&mut self) -> Vec<PortEvent> {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// Polls for the events of [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<Vec<PortEvent>> {
        let mut events = Vec::new();
        // Returns pending without an event only after the channel has registered the waker.
        while events.len() < MOST_AT_A_TIME
            && let Poll::Ready(Some(event)) = self.reports.poll_recv(cx)
        {
            if let PortEvent::Executed { execution, .. } = &event {
                self.executors.ended(*execution);
            }
            events.push(event);
        }
        if events.is_empty() {
            Poll::Pending
        } else {
            Poll::Ready(events)
        }
    }
}

/// The maximal number of queued reports.
const MOST_REPORTS: usize = 256;
/// The maximal number of reports returned at a time.
const MOST_AT_A_TIME: usize = 64;

#[cfg(test)]
mod tests;
