//! The client: sends goals, and hands each what its server says of it.

use std::sync::{Arc, MutexGuard};
use std::time::Duration;

use tokio::sync::{Notify, mpsc};
use tokio::task::AbortHandle;
use tokio::time::Instant;
use tracing::warn;

use super::asking::{ActionClientOptions, Asked, GoalEnd, Shared, State};
use super::client_goals::{ClientCounters, Outcome};
use super::error::{ActionError, IdInUse, LostReason, NoServer};
use super::goal::GoalHandle;
use super::types::{CancelAnswer, CancelWhat, GoalId};
use super::{Action, STATUS_TYPE, status_policies, wire};
use crate::domain::Domain;
use crate::raw::Reader;
use crate::service::{
    ServiceClient, ServiceClientOptions, ServiceError, ServicePeers, next, policies,
};

/// Sends goals to the server of an action. Dropping it ends its goals as lost; it does not cancel them. Of withdrawn
/// goals it logs then that their end is unknown.
///
/// With several servers of one name, all get each goal, as everywhere in ROS 2, and the first answer counts.
#[derive(Debug)]
pub struct ActionClient {
    shared: Arc<Shared>,
    task: AbortHandle,
}

impl ActionClient {
    /// Makes the action's endpoints; the server need not be there yet, and may come and go. To be called on a tokio
    /// runtime.
    ///
    /// # Errors
    /// [`ActionError::Domain`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        action: &Action,
        options: ActionClientOptions,
    ) -> Result<Self, ActionError> {
        action.announce_shared(domain);
        // Before what asks for goals: a server that knows the latter knows these too.
        let feedback_type = action.feedback_type();
        let feedback = domain.open_reader(&action.feedback_topic(), &feedback_type, &policies())?;
        let status = domain.open_reader(&action.status_topic(), STATUS_TYPE, &status_policies())?;
        let open = |service, timeout| {
            let max_calls = options.max_goals;
            let options = ServiceClientOptions { timeout, max_calls };
            ServiceClient::open(domain, peers, &service, options)
        };
        // A goal takes as long as it takes.
        let result = open(action.get_result(), None)?;
        let cancel = open(action.cancel_goal(), Some(options.cancel_timeout))?;
        // The decision about a goal is awaited until the server has left, since a withdrawn goal is cancelled then.
        let send = open(action.send_goal(), None)?;
        let (ends, ended) = mpsc::channel(MOST_ENDS);
        let asked = Asked {
            send,
            cancel,
            result,
        };
        let shared = Shared::new((domain, peers), action, options, (asked, ends));
        let shared = Arc::new(shared);
        let listening = listen(Arc::clone(&shared), (status, feedback), ended);
        let task = tokio::spawn(listening).abort_handle();
        Ok(Self { shared, task })
    }

    /// Sends a goal, the `X_Goal` as CDR in little endian with its encapsulation header. Never waits: what becomes of it
    /// is told by the handle. To be called on a tokio runtime.
    #[must_use]
    pub fn send_goal(&self, body: &[u8]) -> GoalHandle {
        let id = self.shared.new_id();
        self.send_new(self.shared.lock(), id, body)
    }

    /// As [`send_goal`](Self::send_goal), under an id that was chosen elsewhere. A server rejects one that it knows already.
    ///
    /// # Errors
    /// [`IdInUse`] while somebody holds a goal of that id: nothing is sent.
    pub fn send_goal_as(&self, id: GoalId, body: &[u8]) -> Result<GoalHandle, IdInUse> {
        let state = self.shared.lock();
        if state.goals.is_held(id) {
            return Err(IdInUse(id));
        }
        Ok(self.send_new(state, id, body))
    }

    fn send_new(&self, mut state: MutexGuard<'_, State>, id: GoalId, body: &[u8]) -> GoalHandle {
        let wake: Arc<Notify> = Arc::default();
        state.goals.sent(id, Arc::clone(&wake));
        match wire::join(id, body) {
            None => drop(state.goals.end(id, Outcome::Lost(LostReason::Message))),
            Some(request) if state.goals.outcome(id).is_none() => {
                let task = tokio::spawn(Arc::clone(&self.shared).drive(id, request));
                state.tasks.insert(id, task.abort_handle());
            }
            Some(_) => {}
        }
        drop(state);
        GoalHandle::new(Arc::clone(&self.shared), id, wake)
    }

    /// Asks the server to cancel goals, those of other clients too where `what` includes them. The goals tell what
    /// comes of it. A goal of this client that the server has not decided about is withdrawn, and named in the answer:
    /// it is not sent, or is cancelled as soon as it is accepted.
    ///
    /// # Errors
    /// [`ServiceError`]; a server may have heard the request where [`ServiceError::may_have_run`] says so.
    pub async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        self.shared.cancel(what).await
    }

    /// Whether there is a server whose every service and topic is known here.
    ///
    /// # Errors
    /// [`NoServer`] tells what is missing.
    pub fn server(&self) -> Result<(), NoServer> {
        self.shared.server()
    }

    /// Waits until there is a [`Self::server`]. Cancel-safe.
    ///
    /// # Errors
    /// [`NoServer`] after `limit`.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<(), NoServer> {
        self.shared.wait_for_server(limit).await
    }

    /// The action's ROS name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.shared.action.name()
    }

    /// What was received so far and could not be used.
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
                "withdrawn goal is left behind: whether the action server works on it is unknown"
            );
        }
        let closed = Outcome::Lost(LostReason::ClientClosed);
        state.goals.end_all(&closed);
    }
}

/// Receives statuses and feedback until aborted. A goal ends here, once what was received before
/// its result is taken.
async fn listen(
    shared: Arc<Shared>,
    (status, feedback): (Reader, Reader),
    mut ended: mpsc::Receiver<GoalEnd>,
) {
    loop {
        // All are cancel-safe.
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

/// Goals that may wait for their end here; others wait in their tasks.
const MOST_ENDS: usize = 64;
/// Samples that are taken before a goal ends. A server that keeps sending does not hold up the end.
const MOST_OVERTAKEN: usize = 10_000;
