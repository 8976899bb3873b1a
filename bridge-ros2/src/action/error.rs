//! What can go wrong with an action, on either side.

use thiserror::Error;

use super::types::GoalId;
use crate::domain::DomainError;
use crate::service::ServiceError;

/// Why a server or client cannot be opened.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ActionError {
    /// An endpoint could not be made.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// The empty result of a server's options cannot be one.
    #[error("the empty result of the action {0} is not CDR in little endian with a status in it")]
    EmptyResult(String),
}

/// A goal was not sent, because its client holds one of the same id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("the client has a goal {0} already")]
pub struct IdInUse(pub GoalId);

/// No server is ready to take goals.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("no server of the action {action}: {missing}")]
pub struct NoServer {
    /// The action's ROS name.
    pub action: String,
    /// What is not there, or not yet.
    pub missing: String,
}

/// Why nothing more will be heard of a goal. A goal that was accepted may still run.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LostReason {
    /// There was no server to send it to. It was not sent.
    #[error(transparent)]
    NoServer(#[from] NoServer),
    /// The client has as many goals as its options allow. It was not sent.
    #[error("{0} goals of the action are open already")]
    Busy(usize),
    /// It was withdrawn before it was sent.
    #[error("the goal was withdrawn before it was sent")]
    Withdrawn,
    /// The message is not CDR in little endian with its encapsulation header. It was not sent.
    #[error("the goal is not CDR in little endian")]
    Message,
    /// No answer to the goal came; [`ServiceError::may_have_run`] tells whether a server may have accepted it.
    #[error("the goal was not answered: {0}")]
    Unanswered(ServiceError),
    /// It was accepted, and its server has left since: it died, was restarted, or is out of reach.
    #[error("the server has left: {0}")]
    ServerLost(ServiceError),
    /// It was accepted, and all of that action's servers have been away for too long.
    #[error("the server of {action} has left")]
    ServerGone {
        /// The action's ROS name.
        action: String,
    },
    /// The server does not know the goal any more: it was restarted, or did not keep the result for long enough.
    #[error("the server does not know the goal")]
    Unknown,
    /// The server's answer does not read.
    #[error("the server's {0} does not read")]
    Malformed(&'static str),
    /// The client was dropped.
    #[error("the action client was closed")]
    ClientClosed,
}

impl LostReason {
    /// Whether a server may have accepted the goal, or has. When this is false, none has had it.
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
