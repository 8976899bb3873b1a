//! What the user of a server holds: goals to decide about, requests to cancel them, goals to work on.

use std::sync::Arc;

use bytes::Bytes;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tracing::warn;

use super::server_goals::{End, GoalError, Ticket};
use super::serving::{Acceptance, CancelAgreed, Shared};
use super::types::{GoalId, Status};
use super::wire;
use crate::raw::Payload;

/// A goal to decide about. One that is dropped is rejected.
#[derive(Debug)]
pub struct NewGoal {
    shared: Arc<Shared>,
    ticket: Ticket,
    body: Bytes,
    answer: Option<oneshot::Sender<Acceptance>>,
}

impl NewGoal {
    pub(super) const fn new(
        shared: Arc<Shared>,
        ticket: Ticket,
        body: Bytes,
        answer: oneshot::Sender<Acceptance>,
    ) -> Self {
        Self {
            shared,
            ticket,
            body,
            answer: Some(answer),
        }
    }

    /// The goal's id.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// The `X_Goal`: CDR with its encapsulation header, in the client's byte order. Any bytes may stand behind it.
    #[must_use]
    pub const fn body(&self) -> &Bytes {
        &self.body
    }

    /// Accepts the goal, and returns when its client has been told, or cannot be within a second: clients take no notice
    /// of feedback for goals that they do not know as accepted. Dropping the future then aborts the goal.
    ///
    /// # Errors
    /// [`GoalError::Closed`] when the server was dropped.
    pub async fn accept(mut self) -> Result<ServerGoal, GoalError> {
        let answer = self.answer.take().ok_or(GoalError::Closed)?;
        let stamp = self.shared.accept(self.ticket)?;
        let goal = ServerGoal {
            shared: Arc::clone(&self.shared),
            ticket: self.ticket,
            body: self.body.clone(),
        };
        let (written, told) = oneshot::channel();
        // A client that cannot be answered any more does not stop the goal.
        drop(answer.send(Acceptance { stamp, written }));
        drop(told.await);
        self.shared.accepted();
        Ok(goal)
    }

    /// Rejects the goal, which its client is told.
    pub fn reject(self) {}
}

impl Drop for NewGoal {
    fn drop(&mut self) {
        // One that was accepted stays.
        self.shared.lock().goals.reject(self.ticket);
    }
}

/// A request to cancel a goal. One that is dropped is rejected: the goal goes on.
#[derive(Debug)]
pub struct CancelRequest {
    shared: Arc<Shared>,
    ticket: Ticket,
    answer: oneshot::Sender<CancelAgreed>,
}

impl CancelRequest {
    pub(super) const fn new(
        shared: Arc<Shared>,
        ticket: Ticket,
        answer: oneshot::Sender<CancelAgreed>,
    ) -> Self {
        Self {
            shared,
            ticket,
            answer,
        }
    }

    /// The goal.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// Agrees: the goal is now [`Status::Canceling`]. It still has to be ended, as cancelled or otherwise.
    ///
    /// # Errors
    /// [`GoalError`] when the goal has ended since, or the client waits no longer.
    pub fn accept(self) -> Result<(), GoalError> {
        if self.answer.is_closed() {
            return Err(GoalError::Forgotten(self.ticket.id));
        }
        self.shared
            .decide(|goals| goals.cancel(self.ticket).map(|()| Vec::new()))?;
        drop(self.answer.send(CancelAgreed));
        Ok(())
    }

    /// Does not agree: the goal goes on, which the client is told.
    pub fn reject(self) {}
}

/// A goal to work on. One that is dropped before its end is aborted with the empty result.
#[derive(Debug)]
pub struct ServerGoal {
    shared: Arc<Shared>,
    ticket: Ticket,
    body: Bytes,
}

impl ServerGoal {
    /// The goal's id.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// The `X_Goal`, as [`NewGoal::body`].
    #[must_use]
    pub const fn body(&self) -> &Bytes {
        &self.body
    }

    /// How far the goal is; unknown once it has ended and is forgotten.
    #[must_use]
    pub fn status(&self) -> Status {
        let state = self.shared.lock();
        state.goals.status(self.ticket).unwrap_or(Status::Unknown)
    }

    /// Begins work: from accepted to executing.
    ///
    /// # Errors
    /// [`GoalError`].
    pub fn execute(&self) -> Result<(), GoalError> {
        self.shared
            .decide(|goals| goals.execute(self.ticket).map(|()| Vec::new()))
    }

    /// Goes over to cancelling without a client here having asked, as when the goal is worked on elsewhere and is cancelled
    /// there.
    ///
    /// # Errors
    /// [`GoalError`].
    pub fn cancel_unasked(&self) -> Result<(), GoalError> {
        self.shared
            .decide(|goals| goals.cancel(self.ticket).map(|()| Vec::new()))
    }

    /// The empty result of the server's options.
    #[must_use]
    pub fn empty_result(&self) -> Bytes {
        self.shared.empty_result()
    }

    /// Reports progress: an `X_Feedback`, CDR in little endian with its encapsulation header. Never waits.
    ///
    /// # Errors
    /// [`GoalError`], once the goal has ended.
    pub fn feedback(&self, body: &[u8]) -> Result<(), GoalError> {
        let id = self.ticket.id;
        let message = wire::join(id, body).and_then(|bytes| Payload::to_write(bytes).ok());
        let message = message.ok_or(GoalError::Message(id))?;
        self.shared.feedback(self.ticket, message, Instant::now())
    }

    /// Ends the goal as reached, with an `X_GetResult_Response` in CDR in little endian with its encapsulation header,
    /// whose status is filled in here.
    ///
    /// # Errors
    /// [`GoalError`]; the goal stays as it is.
    pub fn succeed(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Succeed, result)
    }

    /// Ends the goal as failed, with a result as for [`succeed`](Self::succeed).
    ///
    /// # Errors
    /// As there.
    pub fn abort(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Abort, result)
    }

    /// Ends the goal as cancelled, which was agreed to, with a result as for [`succeed`](Self::succeed).
    ///
    /// # Errors
    /// As there.
    pub fn canceled(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Cancel, result)
    }

    /// Waits until a request to cancel the goal was agreed to, or the goal has ended, or the server was dropped.
    /// Cancel-safe.
    pub async fn cancel_agreed(&self) {
        let mut changed = self.shared.changed.subscribe();
        while self.shared.is_open() && matches!(self.status(), Status::Accepted | Status::Executing)
        {
            // The sender lives as long as this goal.
            if changed.changed().await.is_err() {
                return;
            }
        }
    }

    fn end(&self, end: End, result: &[u8]) -> Result<(), GoalError> {
        self.shared.decide(|goals| {
            let status = goals.may_end(self.ticket, end)?;
            let result = wire::with_status(result, status);
            let result = result.ok_or(GoalError::Message(self.ticket.id))?;
            let waiting = goals.end(self.ticket, end, result.clone(), Instant::now())?;
            Ok(waiting
                .into_iter()
                .map(|who| (who, result.clone()))
                .collect())
        })
    }
}

impl Drop for ServerGoal {
    fn drop(&mut self) {
        if self.shared.lock().goals.abandon(self.ticket) {
            let empty = self.shared.empty_result();
            if let Err(error) = self.abort(&empty)
                && error != GoalError::Closed
            {
                warn!(action = self.shared.action_name(), %error, "a goal was dropped");
            }
        }
    }
}
