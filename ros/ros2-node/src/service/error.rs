//! Errors of service calls.

use std::fmt;
use std::time::Duration;

use thiserror::Error;

/// The phase in which a call ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallPhase {
    /// Waiting in the queue of the client task.
    Queue,
    /// Waiting for a server.
    Discovery,
    /// Sending the request.
    Request,
    /// Waiting for the reply; the request is sent.
    Answer,
}

impl From<CallPhase> for u8 {
    fn from(phase: CallPhase) -> Self {
        match phase {
            CallPhase::Queue => 0,
            CallPhase::Discovery => 1,
            CallPhase::Request => 2,
            CallPhase::Answer => 3,
        }
    }
}

impl From<u8> for CallPhase {
    fn from(number: u8) -> Self {
        match number {
            0 => Self::Queue,
            1 => Self::Discovery,
            2 => Self::Request,
            _ => Self::Answer,
        }
    }
}

impl fmt::Display for CallPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Queue => "waiting for earlier calls",
            Self::Discovery => {
                "waiting for a node that offers it (`ros2 service list` shows the available services)"
            }
            Self::Request => "sending the request",
            Self::Answer => "waiting for the response",
        })
    }
}

/// The reason for which a call returned no reply.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The timeout of the call has expired.
    #[error("{service}: no response within {limit:?}, while {phase}")]
    Timeout {
        /// The service.
        service: String,
        /// The phase that was not completed in time.
        phase: CallPhase,
        /// The timeout of the whole call.
        limit: Duration,
    },
    /// The time until which the request could be sent has passed before it was sent.
    #[error("the request for {service} was not sent: the time until which it may start has passed")]
    TooLate {
        /// The service.
        service: String,
    },
    /// Every server that received the request has left or its lease has expired.
    #[error("the servers of {service} left the domain before they responded")]
    Lost {
        /// The service.
        service: String,
    },
    /// A server exists, but with another type.
    #[error("{service} has the type {theirs}, but {ours} is required")]
    OtherType {
        /// The service.
        service: String,
        /// The DDS type of the server's requests.
        theirs: String,
        /// The DDS type of the client's requests.
        ours: String,
    },
    /// The client has reached its limit of concurrent calls.
    #[error("the limit of {limit} calls of {service} in progress is reached")]
    Busy {
        /// The service.
        service: String,
        /// The limit.
        limit: usize,
    },
    /// The request cannot be sent.
    #[error("the request for {service} cannot be sent: {why}")]
    Request {
        /// The service.
        service: String,
        /// The fault of the request.
        why: &'static str,
    },
    /// The reply does not have the service's type.
    #[error("the response of {service} is malformed")]
    Reply {
        /// The service.
        service: String,
    },
    /// The client was closed.
    #[error("the client of {service} was closed while {phase}")]
    Closed {
        /// The service.
        service: String,
        /// The phase of the call.
        phase: CallPhase,
    },
}

impl ServiceError {
    /// Returns whether a server may have acted on the request without a reply: the request was
    /// sent, and no reply was received. If false, no server has received the request.
    #[must_use]
    pub const fn may_have_run(&self) -> bool {
        match self {
            Self::Timeout { phase, .. } | Self::Closed { phase, .. } => {
                matches!(phase, CallPhase::Answer)
            }
            Self::Lost { .. } | Self::Reply { .. } => true,
            Self::OtherType { .. }
            | Self::Busy { .. }
            | Self::TooLate { .. }
            | Self::Request { .. } => false,
        }
    }
}
