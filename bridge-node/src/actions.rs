//! Actions between a ROS graph and the space.
//!
//! An action server of the graph that is a call of our own space, by the mapping or by its name (`/ua_1_2_70`), is executed for
//! others: a goal is a request, and so are cancelling and waiting for a result; feedback and the statuses of goals are values.
//! The action of another space is offered as an action server of the graph.

mod graph;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use bridge_core::{CallDescription, ExecutionId, Refusal};
use mappings::{Mapping, TopicId};

pub use self::graph::{
    ActionClient, ActionGraph, ActionServer, CancelAnswer, CancelRequest, CancelWhat, GoalEvent,
    GoalId, NewGoal, SentGoal, ServedGoal, ServerEvent, Waits,
};

use crate::policy::Policy;
use crate::port::{Delivery, Execution};
use crate::{Asker, PortEvent, Present};

/// The actions of one bridge: those of its graph that it executes for others, and those of other spaces that it offers.
#[derive(Debug, Default)]
pub struct Actions {}

impl Actions {
    // What the graph has, executed for others.

    /// Whether an action of that name is one of our own space by its name, so that its type has to be found out.
    #[must_use]
    pub fn is_named(policy: &Policy, action: &str) -> bool {
        let _unused = (policy, action);
        false
    }

    /// The names of the actions that the mapping has executed in our own space.
    pub fn mapped<'m>(mapping: &'m Mapping, policy: &Policy) -> BTreeSet<&'m str> {
        let _unused = (mapping, policy);
        BTreeSet::new()
    }

    /// Compares the action servers there are, each with its type as far as that is known, with those that are offered to
    /// others, and begins to offer `most` at most.
    pub fn reconcile<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        (present, most): (&Present, usize),
    ) -> Vec<PortEvent> {
        let _unused = (graph, policy, present, most);
        Vec::new()
    }

    /// Whether it executes that call: a part of an action.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        let _unused = topic;
        false
    }

    /// Executes a request for a part of an action. What becomes of it comes from [`recv`](Self::recv).
    ///
    /// # Errors
    /// Why it is not executed.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        let _unused = execution;
        Err(Refusal::NotExecutable)
    }

    /// Who asked for an execution does not want it any longer. Goals go on.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        let _unused = execution;
    }

    // What other spaces have, offered here.

    /// A call of another space is known, or is another than before.
    pub fn known(&mut self, topic: TopicId, described: &Arc<CallDescription>) {
        let _unused = (topic, described);
    }

    /// A call is gone. Its action server stays for `receive_timeout`, after which its goals are aborted.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        let _unused = (topic, now);
    }

    /// Withdraws the action servers of actions that are gone. To be called now and then.
    pub fn tidy(&mut self, policy: &Policy, now: Instant) {
        let _unused = (policy, now);
    }

    /// The actions that are known and have a name of the mapping here, with that.
    #[must_use]
    pub fn chosen(&self, policy: &Policy) -> Vec<(TopicId, String)> {
        let _unused = policy;
        Vec::new()
    }

    /// Whether any action waits to be offered.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        false
    }

    /// Withdraws the servers of the actions that are left to others, by their names here, and has them wait.
    pub fn leave(&mut self, to_others: impl Fn(TopicId, &str) -> bool) {
        let _unused = to_others;
    }

    /// Offers actions that wait and `may` be offered under their names here, at most so many. `asker` makes what asks a call
    /// ([`Calls::asker`](crate::Calls::asker)). Reports the types of their calls and values.
    pub fn offer_waiting<G: ActionGraph>(
        &mut self,
        (graph, policy): (&mut G, &mut Policy),
        asker: impl Fn(TopicId) -> Asker,
        may: impl Fn(TopicId, &str) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let _unused = (graph, policy, asker, may, most);
        Vec::new()
    }

    /// The names of the action servers that are there.
    pub fn offered(&self) -> BTreeMap<TopicId, &str> {
        BTreeMap::new()
    }

    /// Whether the values of a topic are for an action server here: they are no topic of the graph by themselves.
    #[must_use]
    pub fn takes(&self, topic: TopicId) -> bool {
        let _unused = topic;
        false
    }

    /// Takes a value of a topic that it [takes](Self::takes).
    ///
    /// # Errors
    /// A short reason under which it is counted as dropped.
    pub fn publish(&mut self, value: &Delivery) -> Result<(), &'static str> {
        let _unused = value;
        Ok(())
    }

    // Both.

    /// Has everything looked at again: definitions or the mapping may be others.
    pub fn look_again<G: ActionGraph>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
    ) -> Vec<PortEvent> {
        let _unused = (graph, policy);
        Vec::new()
    }

    /// What came of executions, and what goals report. Cancel-safe.
    pub async fn recv(&mut self) -> Vec<PortEvent> {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    /// As [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<Vec<PortEvent>> {
        let _unused = cx;
        Poll::Pending
    }
}
