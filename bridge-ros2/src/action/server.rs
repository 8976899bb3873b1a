//! The server: takes goals and requests to cancel, and tells clients what becomes of them.

use std::sync::Arc;

use tokio::task::AbortHandle;

use super::error::ActionError;
use super::server_goals::ServerCounters;
use super::server_handles::{CancelRequest, NewGoal};
use super::serving::{ActionServerOptions, Arrived, Shared, run};
use super::types::Status;
use super::{Action, wire};
use crate::domain::Domain;
use crate::service::{ServicePeers, ServiceServer};

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
