//! Errors of action clients and action servers.

use thiserror::Error;

use super::types::GoalId;
use crate::domain::DomainError;
use crate::service::ServiceError;

/// The reason for which a server or client cannot be opened.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ActionError {
    /// An endpoint could not be created.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// The empty result in a server's options is invalid.
    #[error("the empty result of the action {0} is not little-endian CDR with a status")]
    EmptyResult(String),
}

/// A goal was not sent, because its client has a goal with the same id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("the client already has a goal {0}")]
pub struct IdInUse(pub GoalId);

/// No server is ready to receive goals.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("no server of the action {action}: {missing}")]
pub struct NoServer {
    /// The ROS name of the action.
    pub action: String,
    /// The missing endpoint.
    pub missing: String,
}

/// The reason for which the client receives nothing more about a goal. An accepted goal may still
/// run.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LostReason {
    /// No server was present. The goal was not sent.
    #[error(transparent)]
    NoServer(#[from] NoServer),
    /// The client has reached its limit of goals. The goal was not sent.
    #[error("the limit of {0} open goals of the action is reached")]
    Busy(usize),
    /// The goal was withdrawn before it was sent.
    #[error("the goal was withdrawn before it was sent")]
    Withdrawn,
    /// The message is not little-endian CDR with its encapsulation header. The goal was not sent.
    #[error("the goal is not little-endian CDR")]
    Message,
    /// The server did not reply to the goal; [`ServiceError::may_have_run`] returns whether a
    /// server may have accepted it.
    #[error("no response to the goal: {0}")]
    Unanswered(ServiceError),
    /// The goal was accepted, and its server was lost: it died, restarted, or is unreachable.
    #[error("the server has left the domain: {0}")]
    ServerLost(ServiceError),
    /// The goal was accepted, and all servers of the action have been absent for too long.
    #[error("the server of {action} has left the domain")]
    ServerGone {
        /// The ROS name of the action.
        action: String,
    },
    /// The server no longer knows the goal: it restarted, or the time limit of the result expired.
    #[error("the server does not know the goal")]
    Unknown,
    /// The server's reply could not be decoded.
    #[error("the {0} of the server is malformed")]
    Malformed(&'static str),
    /// The client was dropped.
    #[error("the action client was closed")]
    ClientClosed,
}

impl LostReason {
    /// Returns whether a server has accepted the goal or may have. If false, no server has received
    /// it.
    #[must_use]
    pub const fn may_run(&self) -> bool {
        match self {
            Self::NoServer(_) | Self::Busy(_) | Self::Withdrawn | Self::Message => false,
            Self::Unanswered(error) => error.may_have_run(),
            Self::ServerLost(_)
            | Self::ServerGone { .. }
            | Self::Unknown
            | Self::Malformed(_)
            | Self::ClientClosed => true,
        }
    }
}
