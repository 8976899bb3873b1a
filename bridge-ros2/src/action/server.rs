//! The server: takes goals and requests to cancel, and tells clients what becomes of them.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::task::AbortHandle;

use super::error::ActionError;
use super::server_goals::ServerCounters;
use super::server_handles::{CancelRequest, NewGoal};
use super::serving::{Arrived, Shared, run};
use super::types::Status;
use super::{Action, wire};
use crate::domain::Domain;
use crate::service::{ServicePeers, ServiceServer};

/// What a server holds, and for how long.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionServerOptions {
    /// An `X_GetResult_Response` with nothing in it, little endian CDR with its encapsulation header: for goals that are
    /// unknown, and those that end without a result of yours. Clients of the type have to be able to read it.
    pub empty_result: Bytes,
    /// How long the result of a goal is kept after its end, by the steady clock; `None` keeps it until there is no
    /// room. `rcl_action_server_get_default_options` says 10 seconds, up to ROS 2 Humble 15 minutes.
    pub result_timeout: Option<Duration>,
    /// How many goals are known at once, ended ones included. When there are more, ended ones are forgotten early; when
    /// none has ended, goals are rejected.
    pub max_goals: usize,
    /// How long a request to cancel waits for your decision. Past that it counts as rejected.
    pub cancel_timeout: Duration,
}

impl ActionServerOptions {
    /// Results are kept for 10 seconds; 1000 goals; 5 seconds to decide about cancelling.
    #[must_use]
    pub const fn new(empty_result: Bytes) -> Self {
        Self {
            empty_result,
            result_timeout: Some(Duration::from_secs(10)),
            max_goals: 1000,
            cancel_timeout: Duration::from_secs(5),
        }
    }
}

/// What clients want of a server.
#[derive(Debug)]
pub enum ServerEvent {
    /// A new goal, to be accepted or rejected.
    Goal(NewGoal),
    /// A goal should be cancelled, which is to be agreed to or not.
    Cancel(CancelRequest),
}

/// Takes the goals of an action. Dropping it withdraws the action: its goals are forgotten, and clients that wait for
/// results find that their server has left.
#[derive(Debug)]
pub struct ActionServer {
    shared: Arc<Shared>,
    task: AbortHandle,
    _services: [ServiceServer; 3],
}

impl ActionServer {
    /// Makes the action's endpoints and serves. To be called on a tokio runtime.
    ///
    /// # Errors
    /// [`ActionError`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        action: &Action,
        options: ActionServerOptions,
    ) -> Result<Self, ActionError> {
        if wire::with_status(&options.empty_result, Status::Unknown).is_none() {
            return Err(ActionError::EmptyResult(action.name().to_owned()));
        }
        action.announce_shared(domain);
        let shared = Arc::new(Shared::new(domain, peers, action, options)?);
        let services = shared.serve(domain, peers)?;
        let task = tokio::spawn(run(Arc::clone(&shared))).abort_handle();
        Ok(Self {
            shared,
            task,
            _services: services,
        })
    }

    /// The next event. Cancel-safe. As many wait as there may be goals, and as many requests to cancel.
    pub async fn recv(&mut self) -> ServerEvent {
        loop {
            if let Some(event) = self.try_recv() {
                return event;
            }
            self.shared.arrival.notified().await;
        }
    }

    /// The next event if there is one.
    pub fn try_recv(&mut self) -> Option<ServerEvent> {
        let arrived = self.shared.lock().arrived.pop_front()?;
        let shared = Arc::clone(&self.shared);
        Some(match arrived {
            Arrived::Goal {
                ticket,
                body,
                answer,
            } => ServerEvent::Goal(NewGoal::new(shared, ticket, body, answer)),
            Arrived::Cancel { ticket, answer } => {
                ServerEvent::Cancel(CancelRequest::new(shared, ticket, answer))
            }
        })
    }

    /// The action's ROS name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.shared.action_name()
    }

    /// What could not be used so far, or was lost.
    #[must_use]
    pub fn counters(&self) -> ServerCounters {
        self.shared.lock().goals.counters
    }
}

impl Drop for ActionServer {
    fn drop(&mut self) {
        self.task.abort();
        self.shared.close();
    }
}
