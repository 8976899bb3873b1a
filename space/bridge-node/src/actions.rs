//! Actions between a ROS graph and the space.
//!
//! An action server of the graph that is a call of our own space, by the mapping or by its name (`/ua_1_2_70`), is executed for
//! others: a goal is a request, and so are cancelling and waiting for a result; feedback and the statuses of goals are values.
//! The action of another space is offered as an action server of the graph.

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
    ActionClient, ActionGraph, ActionServer, CancelAnswer, CancelRequest, CancelWhat, GoalEvent,
    GoalId, NO_GOAL, NewGoal, SentGoal, ServedGoal, ServerEvent, Waits,
};

pub use self::own::{OwnAction, OwnActions};

use self::executors::Executors;
use self::facades::Facades;
use crate::policy::Policy;
use crate::port::{Delivery, Execution};
use crate::present::{self, Present};
use crate::{Asker, PortEvent};

/// The actions of one bridge: those of its graph that it executes for others, and those of other spaces that it offers.
#[derive(Debug)]
pub struct Actions {
    executors: Executors,
    facades: Facades,
    reports: mpsc::Receiver<PortEvent>,
    report: mpsc::Sender<PortEvent>,
}

impl Default for Actions {
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

/// What the graph has, executed for others.
impl Actions {
    /// Whether an action of that name is one of our own space by its name, so that its type has to be found out.
    #[must_use]
    pub fn is_named(policy: &Policy, action: &str) -> bool {
        present::named(policy, action).is_some()
    }

    /// The names of the actions that the mapping has executed in our own space.
    #[must_use]
    pub fn mapped<'m>(mapping: &'m Mapping, policy: &Policy) -> BTreeSet<&'m str> {
        present::mapped(mapping, policy, CallKind::Action)
    }

    /// Compares the action servers there are, each with its type as far as that is known, with those that are offered to
    /// others, and begins to offer `most` at most.
    pub fn reconcile<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        (present, most): (&Present, usize),
    ) -> Vec<PortEvent> {
        let (executors, report) = (&mut self.executors, &self.report);
        executors.reconcile((graph, policy), (present, most), report)
    }

    /// Whether it executes that call: a part of an action.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        self.executors.serves(topic)
    }

    /// Executes a request for a part of an action. What becomes of it comes from [`recv`](Self::recv).
    ///
    /// # Errors
    /// Why it is not executed.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        self.executors.execute(execution)
    }

    /// The caller of an execution has given it up. An accepted goal goes on. A goal that its server has not decided about is
    /// cancelled as soon as it is accepted.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        self.executors.abandoned(execution);
    }

    /// The goals whose cancellation is pending, a line each.
    #[must_use]
    pub fn pending(&self) -> Vec<String> {
        self.executors.pending()
    }
}

/// What other spaces have, offered here.
impl Actions {
    /// A call of another space is known, or is another than before.
    pub fn known(&mut self, topic: TopicId, described: &Arc<CallDescription>) {
        self.facades.known(topic, described);
    }

    /// A call is gone. Its action server stays for `receive_timeout`, after which its goals are aborted.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        self.facades.gone(topic, now);
    }

    /// Withdraws the action servers of actions that are gone. To be called now and then.
    pub fn tidy(&mut self, policy: &Policy, now: Instant) {
        for event in self.facades.tidy(policy, now) {
            // What stays bound has no consequence but its place.
            drop(self.report.try_send(event));
        }
    }

    /// The actions that are known and have a name of the mapping here, with that.
    #[must_use]
    pub fn chosen(&self, policy: &Policy) -> Vec<(TopicId, String)> {
        self.facades.chosen(policy)
    }

    /// Whether any action waits to be offered.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        self.facades.is_waiting()
    }

    /// Withdraws the servers of the actions that are left to others, by their names here, and has them wait.
    pub fn leave(&mut self, to_others: impl Fn(TopicId, &str) -> bool) {
        self.facades.leave(to_others);
    }

    /// Offers actions that wait and `may` be offered under their names here, at most so many. `asker` makes what asks a call
    /// ([`Calls::asker`](crate::Calls::asker)). Reports the types of their calls and values.
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

    /// The names of the action servers that are there.
    #[must_use]
    pub fn offered(&self) -> BTreeMap<TopicId, &str> {
        self.facades.offered()
    }

    /// Whether the values of a topic are for an action server here: they are no topic of the graph by themselves.
    #[must_use]
    pub fn takes(&self, policy: &Policy, topic: TopicId) -> bool {
        self.facades.takes(policy, topic)
    }

    /// Takes a value of a topic that it [takes](Self::takes).
    ///
    /// # Errors
    /// A short reason under which it is counted as dropped.
    pub fn publish(&mut self, value: &Delivery) -> Result<(), &'static str> {
        self.facades.publish(value)
    }
}

/// Both.
impl Actions {
    /// Has everything looked at again: definitions or the mapping may be others.
    pub fn look_again<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
    ) -> Vec<PortEvent> {
        self.facades.look_again(graph, policy);
        self.executors.look_again(graph)
    }

    /// What came of executions, and what goals report. Cancel-safe.
    pub async fn recv(&mut self) -> Vec<PortEvent> {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// As [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<Vec<PortEvent>> {
        let mut events = Vec::new();
        // Pending without a taken one only where the next is waited for.
        while events.len() < MOST_AT_A_TIME
            && let Poll::Ready(Some(event)) = self.reports.poll_recv(cx)
        {
            if let PortEvent::Executed { execution, .. } = &event {
                self.executors.ended(*execution);
            }
            events.push(event);
        }
        match events.is_empty() {
            true => Poll::Pending,
            false => Poll::Ready(events),
        }
    }
}

/// What came of executions and waits to be taken.
const MOST_REPORTS: usize = 256;
/// What is taken of it at a time.
const MOST_AT_A_TIME: usize = 64;

#[cfg(test)]
mod tests;
