//! The client's handle of a goal.

use std::sync::Arc;

use tokio::sync::Notify;

use super::asking::ActionClientShared;
use super::client_goals::{GoalEvent, Outcome};
use super::error::LostReason;
use super::types::{CancelAnswer, CancelWhat, GoalId, GoalStatusCode};
use crate::service::ServiceError;

/// The handle of a sent goal. Dropping it does not cancel the goal. A goal that was cancelled
/// before the server decided about it is still cancelled on acceptance.
#[derive(Debug)]
pub struct GoalHandle {
    shared: Arc<ActionClientShared>,
    id: GoalId,
    wake: Arc<Notify>,
}

impl GoalHandle {
    pub(super) const fn new(
        shared: Arc<ActionClientShared>,
        id: GoalId,
        wake: Arc<Notify>,
    ) -> Self {
        Self { shared, id, wake }
    }

    /// Returns the id of the goal.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.id
    }

    /// Returns the last status that the server reported; unknown before its reply.
    #[must_use]
    pub fn status(&self) -> GoalStatusCode {
        self.shared.lock().goals.known_status(self.id)
    }

    /// Returns the next event, in order; `None` after the goal's last event. Cancel-safe.
    pub async fn recv(&mut self) -> Option<GoalEvent> {
        loop {
            let rung = self.wake.notified();
            {
                let mut state = self.shared.lock();
                let event = state.goals.next_event(self.id);
                if event.is_some() {
                    return event;
                }
                if state.goals.outcome(self.id).is_some() {
                    return None;
                }
            }
            rung.await;
        }
    }

    /// Waits for the end of the goal and discards its other events. May be called again.
    /// Cancel-safe.
    pub async fn outcome(&mut self) -> Outcome {
        while self.recv().await.is_some() {}
        let state = self.shared.lock();
        let outcome = state.goals.outcome(self.id).cloned();
        // The outcome is kept as long as this handle.
        outcome.unwrap_or(Outcome::Lost(LostReason::ClientClosed))
    }

    /// Requests the server to cancel the goal, and returns its response. The goal continues until
    /// the server ends it, possibly as succeeded. If the server has not decided about the goal yet,
    /// the answer reports it as being cancelled: the request is sent as soon as the server accepts
    /// the goal.
    ///
    /// # Errors
    /// [`ServiceError`]; the server may have received the request if [`ServiceError::may_have_run`]
    /// returns true.
    pub async fn cancel(&self) -> Result<CancelAnswer, ServiceError> {
        self.shared.cancel(CancelWhat::Goal(self.id)).await
    }
}

impl Drop for GoalHandle {
    fn drop(&mut self) {
        self.shared.forget(self.id);
    }
}
