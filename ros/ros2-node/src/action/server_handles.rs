//! The handles of a server's user: new goals, cancel requests and accepted goals.

use std::sync::Arc;

use bytes::Bytes;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tracing::warn;

use super::server_goals::{End, GoalError, Ticket};
use super::serving::{Acceptance, ActionServerShared, CancelAgreed};
use super::types::{GoalId, GoalStatusCode};
use super::wire;
use crate::raw::Payload;

/// A new goal to accept or reject. A dropped goal is rejected.
#[derive(Debug)]
pub struct NewGoal {
    shared: Arc<ActionServerShared>,
    ticket: Ticket,
    body: Bytes,
    answer: Option<oneshot::Sender<Acceptance>>,
}

impl NewGoal {
    pub(super) const fn new(
        shared: Arc<ActionServerShared>,
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

    /// Returns the id of the goal.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// Returns the `X_Goal`: CDR with its encapsulation header, in the client's byte order. The
    /// bytes after the header are not validated.
    #[must_use]
    pub const fn body(&self) -> &Bytes {
        &self.body
    }

    /// Accepts the goal. Returns after the client was notified, or after one second without
    /// success: clients ignore feedback for goals that they do not know as accepted. Dropping the
    /// future during the wait aborts the goal.
    ///
    /// # Errors
    /// [`GoalError::Closed`] if the server was dropped.
    pub async fn accept(mut self) -> Result<ServerGoal, GoalError> {
        let answer = self.answer.take().ok_or(GoalError::Closed)?;
        let stamp = self.shared.accept(self.ticket)?;
        let goal = ServerGoal {
            shared: Arc::clone(&self.shared),
            ticket: self.ticket,
            body: self.body.clone(),
        };
        let (written, told) = oneshot::channel();
        // A client that cannot receive the reply any more does not stop the goal.
        drop(answer.send(Acceptance { stamp, written }));
        drop(told.await);
        self.shared.accepted();
        Ok(goal)
    }

    /// Rejects the goal and notifies its client.
    pub fn reject(self) {}
}

impl Drop for NewGoal {
    fn drop(&mut self) {
        // An accepted goal stays.
        self.shared.lock().goals.reject(self.ticket);
    }
}

/// A request to cancel a goal. A dropped request is rejected: the goal continues.
#[derive(Debug)]
pub struct CancelRequest {
    shared: Arc<ActionServerShared>,
    ticket: Ticket,
    answer: oneshot::Sender<CancelAgreed>,
}

impl CancelRequest {
    pub(super) const fn new(
        shared: Arc<ActionServerShared>,
        ticket: Ticket,
        answer: oneshot::Sender<CancelAgreed>,
    ) -> Self {
        Self {
            shared,
            ticket,
            answer,
        }
    }

    /// Returns the id of the goal.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// Agrees to cancel: the goal changes to [`GoalStatusCode::Canceling`]. The goal still has to
    /// be ended, as canceled or otherwise.
    ///
    /// # Errors
    /// [`GoalError`] if the goal has ended in the meantime, or the client no longer waits.
    pub fn accept(self) -> Result<(), GoalError> {
        if self.answer.is_closed() {
            return Err(GoalError::Forgotten(self.ticket.id));
        }
        self.shared
            .decide(|goals| goals.cancel(self.ticket).map(|()| Vec::new()))?;
        drop(self.answer.send(CancelAgreed));
        Ok(())
    }

    /// Refuses to cancel: the goal continues, and the client is notified.
    pub fn reject(self) {}
}

/// An accepted goal. A goal that is dropped before its end is aborted with the empty result.
#[derive(Debug)]
pub struct ServerGoal {
    shared: Arc<ActionServerShared>,
    ticket: Ticket,
    body: Bytes,
}

impl ServerGoal {
    /// Returns the id of the goal.
    #[must_use]
    pub const fn id(&self) -> GoalId {
        self.ticket.id
    }

    /// Returns the `X_Goal`, as [`NewGoal::body`] does.
    #[must_use]
    pub const fn body(&self) -> &Bytes {
        &self.body
    }

    /// Returns the status of the goal; unknown after the ended goal was removed.
    #[must_use]
    pub fn status(&self) -> GoalStatusCode {
        let state = self.shared.lock();
        state
            .goals
            .status(self.ticket)
            .unwrap_or(GoalStatusCode::Unknown)
    }

    /// Starts work: changes the goal from accepted to executing.
    ///
    /// # Errors
    /// [`GoalError`].
    pub fn execute(&self) -> Result<(), GoalError> {
        self.shared
            .decide(|goals| goals.execute(self.ticket).map(|()| Vec::new()))
    }

    /// Changes the goal to canceling without a request from a client of this domain, such as for a
    /// goal that is executed and cancelled elsewhere.
    ///
    /// # Errors
    /// [`GoalError`].
    pub fn cancel_unasked(&self) -> Result<(), GoalError> {
        self.shared
            .decide(|goals| goals.cancel(self.ticket).map(|()| Vec::new()))
    }

    /// Returns the empty result of the server's options.
    #[must_use]
    pub fn empty_result(&self) -> Bytes {
        self.shared.empty_result()
    }

    /// Publishes feedback: an `X_Feedback`, little-endian CDR with its encapsulation header. Never
    /// waits.
    ///
    /// # Errors
    /// [`GoalError`], once the goal has ended.
    pub fn feedback(&self, body: &[u8]) -> Result<(), GoalError> {
        let id = self.ticket.id;
        let message = wire::join(id, body).and_then(|bytes| Payload::to_write(bytes).ok());
        let message = message.ok_or(GoalError::Message(id))?;
        self.shared.feedback(self.ticket, message, Instant::now())
    }

    /// Ends the goal as succeeded, with an `X_GetResult_Response` in little-endian CDR with its
    /// encapsulation header. This method fills in the status of the result.
    ///
    /// # Errors
    /// [`GoalError`]; the goal stays as it is.
    pub fn succeed(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Succeed, result)
    }

    /// Ends the goal as aborted, with a result as for [`succeed`](Self::succeed).
    ///
    /// # Errors
    /// As for [`succeed`](Self::succeed).
    pub fn abort(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Abort, result)
    }

    /// Ends the goal as canceled after a cancel request was accepted, with a result as for
    /// [`succeed`](Self::succeed).
    ///
    /// # Errors
    /// As for [`succeed`](Self::succeed).
    pub fn canceled(&self, result: &[u8]) -> Result<(), GoalError> {
        self.end(End::Cancel, result)
    }

    /// Waits until a cancel request for the goal was accepted, the goal has ended, or the server
    /// was dropped. Cancel-safe.
    pub async fn cancel_agreed(&self) {
        let mut changed = self.shared.changed.subscribe();
        while self.shared.is_open()
            && matches!(
                self.status(),
                GoalStatusCode::Accepted | GoalStatusCode::Executing
            )
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
                warn!(action = self.shared.action_name(), %error, "cannot end an abandoned goal");
            }
        }
    }
}
