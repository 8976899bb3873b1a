//! The action server: receives goals and cancel requests, and reports the progress of goals to
//! clients.

use std::sync::Arc;

use tokio::task::AbortHandle;

use super::error::ActionError;
use super::server_goals::ServerCounters;
use super::server_handles::{CancelRequest, NewGoal};
use super::serving::{ActionServerOptions, ActionServerShared, Arrived, run};
use super::types::GoalStatusCode;
use super::{ActionName, wire};
use crate::domain::Domain;
use crate::service::{ServicePeers, ServiceServer};

/// A request of a client to an action server.
#[derive(Debug)]
pub enum ServerEvent {
    /// A new goal, to be accepted or rejected.
    Goal(NewGoal),
    /// A request to cancel a goal, to be accepted or rejected.
    Cancel(CancelRequest),
}

/// Receives the goals of an action. Dropping the server withdraws the action: its goals are
/// dropped, and clients that wait for results detect the loss of their server.
#[derive(Debug)]
pub struct ActionServer {
    shared: Arc<ActionServerShared>,
    task: AbortHandle,
    _services: [ServiceServer; 3],
}

impl ActionServer {
    /// Creates the endpoints of the action and serves it. Call this on a tokio runtime.
    ///
    /// # Errors
    /// [`ActionError`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        action: &ActionName,
        options: ActionServerOptions,
    ) -> Result<Self, ActionError> {
        if wire::with_status(&options.empty_result, GoalStatusCode::Unknown).is_none() {
            return Err(ActionError::EmptyResult(action.name().to_owned()));
        }
        action.announce_shared(domain);
        let shared = Arc::new(ActionServerShared::new(domain, peers, action, options)?);
        let services = shared.serve(domain, peers)?;
        let task = tokio::spawn(run(Arc::clone(&shared))).abort_handle();
        Ok(Self {
            shared,
            task,
            _services: services,
        })
    }

    /// Returns the next event. Cancel-safe. The queue holds up to the maximum number of goals, and
    /// as many cancel requests.
    pub async fn recv(&mut self) -> ServerEvent {
        loop {
            if let Some(event) = self.try_recv() {
                return event;
            }
            self.shared.arrival.notified().await;
        }
    }

    /// Returns the next event if an event is waiting.
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

    /// Returns the ROS name of the action.
    #[must_use]
    pub fn name(&self) -> &str {
        self.shared.action_name()
    }

    /// Returns the counters of unusable requests and lost messages.
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
