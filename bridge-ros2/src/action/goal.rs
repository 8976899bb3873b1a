//! A goal as its client holds it.

use std::sync::Arc;

use tokio::sync::Notify;

use super::asking::Shared;
use super::client_goals::{GoalEvent, Outcome};
use super::error::LostReason;
use super::types::{CancelAnswer, CancelWhat, GoalId, Status};
use crate::service::ServiceError;

/// A goal that was sent. Dropping it ends the interest in the goal; it does not cancel it. A goal that was cancelled
/// before the server decided about it is cancelled on acceptance all the same.
#[derive(Debug)]
pub struct GoalHandle {
    shared: Arc<Shared>,
    id: GoalId,
    wake: Arc<Notify>,
}

impl GoalHandle {
    pub(super) const fn new(shared: Arc<Shared>, id: GoalId, wake: Arc<Notify>) -> Self {
        Self { shared, id, wake }
    }

    /// The goal's id.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.id
    }

    /// What the server has said last of how far the goal is; unknown until it was answered.
    #[must_use]
    pub fn status(&self) -> Status {
        self.shared.lock().goals.known_status(self.id)
    }

    /// The next event, in order; `None` after the one that ends the goal. Cancel-safe.
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

    /// Waits for the end of the goal, passing over what else happens to it. May be asked again. Cancel-safe.
    pub async fn outcome(&mut self) -> Outcome {
        while self.recv().await.is_some() {}
        let state = self.shared.lock();
        let outcome = state.goals.outcome(self.id).cloned();
        // It is known as long as this handle is.
        outcome.unwrap_or(Outcome::Lost(LostReason::ClientClosed))
    }

    /// Asks the server to cancel the goal, and returns what it says to that. The goal goes on until the server ends it,
    /// be it as succeeded. While the server has not decided about the goal, the answer is that it is being cancelled:
    /// the request goes to the server as soon as it accepts the goal.
    ///
    /// # Errors
    /// [`ServiceError`]; the server may have heard the request where [`ServiceError::may_have_run`] says so.
    pub async fn cancel(&self) -> Result<CancelAnswer, ServiceError> {
        self.shared.cancel(CancelWhat::Goal(self.id)).await
    }
}

impl Drop for GoalHandle {
    fn drop(&mut self) {
        self.shared.forget(self.id);
    }
}
