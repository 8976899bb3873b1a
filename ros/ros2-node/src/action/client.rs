//! The action client: sends goals and reports the events of each goal.

use std::sync::{Arc, MutexGuard};
use std::time::Duration;

use tokio::sync::{Notify, mpsc};
use tokio::task::AbortHandle;
use tokio::time::Instant;
use tracing::warn;

use super::asking::{
    ActionClientOptions, ActionClientShared, ActionClientState, ActionServiceClients, GoalEnd,
};
use super::client_goals::{ClientCounters, Outcome};
use super::error::{ActionError, IdInUse, LostReason, NoServer};
use super::goal::GoalHandle;
use super::types::{CancelAnswer, CancelWhat, GoalId};
use super::{ActionName, STATUS_TYPE, status_policies, wire};
use crate::domain::Domain;
use crate::raw::PayloadReader;
use crate::service::{
    ServiceClient, ServiceClientOptions, ServiceError, ServicePeers, next, policies,
};

/// Sends goals to the server of an action. Dropping the client ends its goals as lost; it does not
/// cancel them, and logs for each withdrawn goal that its end is unknown.
///
/// If several servers have the same name, each server receives each goal, as with any ROS 2 client,
/// and the first reply counts.
#[derive(Debug)]
pub struct ActionClient {
    shared: Arc<ActionClientShared>,
    task: AbortHandle,
}

impl ActionClient {
    /// Creates the endpoints of the action. The server may be absent, and may come and go. Call
    /// this on a tokio runtime.
    ///
    /// # Errors
    /// [`ActionError::Domain`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        action: &ActionName,
        options: ActionClientOptions,
    ) -> Result<Self, ActionError> {
        action.announce_shared(domain);
        // These readers come before the clients that send goals: a server that knows the clients
        // then knows the readers too.
        let feedback_type = action.feedback_type();
        let feedback = domain.open_reader(&action.feedback_topic(), &feedback_type, &policies())?;
        let status = domain.open_reader(&action.status_topic(), STATUS_TYPE, &status_policies())?;
        let open = |service, timeout| {
            let max_calls = options.max_goals;
            let options = ServiceClientOptions { timeout, max_calls };
            ServiceClient::open(domain, peers, &service, options)
        };
        // The execution of a goal has no time limit.
        let result = open(action.get_result(), None)?;
        let cancel = open(action.cancel_goal(), Some(options.cancel_timeout))?;
        // The client waits for the decision about a goal until the server is lost, because a
        // withdrawn goal is cancelled after the decision.
        let send = open(action.send_goal(), None)?;
        let (ends, ended) = mpsc::channel(MOST_ENDS);
        let asked = ActionServiceClients {
            send,
            cancel,
            result,
        };
        let shared = ActionClientShared::new((domain, peers), action, options, (asked, ends));
        let shared = Arc::new(shared);
        let listening = listen(Arc::clone(&shared), (status, feedback), ended);
        let task = tokio::spawn(listening).abort_handle();
        Ok(Self { shared, task })
    }

    /// Sends a goal, which is the `X_Goal` as little-endian CDR with its encapsulation header.
    /// Never waits: the handle reports the outcome. Call this on a tokio runtime.
    #[must_use]
    pub fn send_goal(&self, body: &[u8]) -> GoalHandle {
        let id = self.shared.new_id();
        self.send_new(self.shared.lock(), id, (body, None))
    }

    /// Sends a goal as [`send_goal`](Self::send_goal) does, with an id chosen by the caller. A
    /// server rejects an id that it knows already.
    ///
    /// # Errors
    /// [`IdInUse`] while a handle for a goal with this id exists: nothing is sent.
    pub fn send_goal_as(&self, id: GoalId, body: &[u8]) -> Result<GoalHandle, IdInUse> {
        self.send_goal_by(id, body, None)
    }

    /// Sends a goal as [`send_goal_as`](Self::send_goal_as) does, but not after `start_by`. A goal
    /// that is not sent in time is lost, and does not run.
    ///
    /// # Errors
    /// [`IdInUse`] while a handle for a goal with this id exists: nothing is sent.
    pub fn send_goal_by(
        &self,
        id: GoalId,
        body: &[u8],
        start_by: Option<Instant>,
    ) -> Result<GoalHandle, IdInUse> {
        let state = self.shared.lock();
        if state.goals.is_held(id) {
            return Err(IdInUse(id));
        }
        Ok(self.send_new(state, id, (body, start_by)))
    }

    fn send_new(
        &self,
        mut state: MutexGuard<'_, ActionClientState>,
        id: GoalId,
        (body, start_by): (&[u8], Option<Instant>),
    ) -> GoalHandle {
        let wake: Arc<Notify> = Arc::default();
        state.goals.sent(id, Arc::clone(&wake));
        match wire::join(id, body) {
            None => drop(state.goals.end(id, Outcome::Lost(LostReason::Message))),
            Some(request) if state.goals.outcome(id).is_none() => {
                let task = tokio::spawn(Arc::clone(&self.shared).drive(id, (request, start_by)));
                state.tasks.insert(id, task.abort_handle());
            }
            Some(_) => {}
        }
        drop(state);
        GoalHandle::new(Arc::clone(&self.shared), id, wake)
    }

    /// Requests the server to cancel goals, including goals of other clients if `what` selects
    /// them. The goals report the outcome. A goal of this client that the server has not decided
    /// about is withdrawn and named in the answer: it is not sent, or it is cancelled as soon as it
    /// is accepted.
    ///
    /// # Errors
    /// [`ServiceError`]; a server may have received the request if [`ServiceError::may_have_run`]
    /// returns true.
    pub async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        self.shared.cancel(what).await
    }

    /// Checks for a server with all services and topics known to this client.
    ///
    /// # Errors
    /// [`NoServer`] names the missing endpoint.
    pub fn server(&self) -> Result<(), NoServer> {
        self.shared.server()
    }

    /// Waits until [`Self::server`] succeeds. Cancel-safe.
    ///
    /// # Errors
    /// [`NoServer`] after `limit`.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<(), NoServer> {
        self.shared.wait_for_server(limit).await
    }

    /// Returns the ROS name of the action.
    #[must_use]
    pub fn name(&self) -> &str {
        self.shared.action.name()
    }

    /// Returns the counters of unusable samples.
    #[must_use]
    pub fn counters(&self) -> ClientCounters {
        self.shared.lock().goals.counters
    }
}

impl Drop for ActionClient {
    fn drop(&mut self) {
        self.task.abort();
        let mut state = self.shared.lock();
        for task in state.tasks.values() {
            task.abort();
        }
        for (goal, age) in state.goals.pending(Instant::now()) {
            warn!(
                action = self.name(), %goal, ?age,
                "cannot confirm the cancellation of a withdrawn goal: the action server may still execute \
                 it; check the robot"
            );
        }
        let closed = Outcome::Lost(LostReason::ClientClosed);
        state.goals.end_all(&closed);
    }
}

/// Receives statuses and feedback until aborted. Ends each goal after all samples received before
/// its result are processed.
async fn listen(
    shared: Arc<ActionClientShared>,
    (status, feedback): (PayloadReader, PayloadReader),
    mut ended: mpsc::Receiver<GoalEnd>,
) {
    loop {
        // All branches are cancel-safe.
        tokio::select! {
            sample = next(&status) => shared.hear_status(sample),
            sample = next(&feedback) => shared.hear_feedback(sample),
            Some(end) = ended.recv() => {
                for _ in 0..MOST_OVERTAKEN {
                    tokio::select! {
                        biased;
                        sample = next(&status) => shared.hear_status(sample),
                        sample = next(&feedback) => shared.hear_feedback(sample),
                        () = std::future::ready(()) => break,
                    }
                }
                shared.end(end);
            }
        }
    }
}

/// Capacity of the queue of ended goals; further goals wait in their tasks.
const MOST_ENDS: usize = 64;
/// Maximum number of samples that are processed before a goal ends, so that a server that keeps
/// sending does not delay the end.
const MOST_OVERTAKEN: usize = 10_000;
