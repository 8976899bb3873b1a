//! What went wrong with a call.

use std::fmt;
use std::time::Duration;

use thiserror::Error;

/// What a call was at when it ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallPhase {
    /// Waiting to be taken by the client's task.
    Queue,
    /// Waiting for a server.
    Discovery,
    /// Sending the request.
    Request,
    /// The request is sent, the reply awaited.
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
                "waiting for a node that offers it (`ros2 service list` shows what there is)"
            }
            Self::Request => "sending the request",
            Self::Answer => "waiting for the answer",
        })
    }
}

/// Why a call brought no answer.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The time for the call is over.
    #[error("{service}: the call was given up after {limit:?} while {phase}")]
    Timeout {
        /// The service.
        service: String,
        /// What took too long.
        phase: CallPhase,
        /// The time given to the whole call.
        limit: Duration,
    },
    /// Every server that was asked has left, in order or by the end of its lease.
    #[error("the servers of {service} left before they answered")]
    Lost {
        /// The service.
        service: String,
    },
    /// There is a server, of another type.
    #[error("{service} has the type {theirs}, and {ours} is wanted")]
    OtherType {
        /// The service.
        service: String,
        /// DDS type of the server's requests.
        theirs: String,
        /// DDS type of ours.
        ours: String,
    },
    /// The client has as many calls in progress as its options allow.
    #[error("{limit} calls of {service} are in progress already")]
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
        /// What is wrong with it.
        why: &'static str,
    },
    /// The reply is none of the service's type.
    #[error("the reply of {service} does not read")]
    Reply {
        /// The service.
        service: String,
    },
    /// The client was closed.
    #[error("the client of {service} was closed while {phase}")]
    Closed {
        /// The service.
        service: String,
        /// What the call was at.
        phase: CallPhase,
    },
}

impl ServiceError {
    /// Whether a server may have acted on the request though no answer tells so: it was sent, and no reply came. When
    /// this is false, no server has had it.
    #[must_use]
    pub const fn may_have_run(&self) -> bool {
        match self {
            Self::Timeout { phase, .. } | Self::Closed { phase, .. } => {
                matches!(phase, CallPhase::Answer)
            }
            Self::Lost { .. } | Self::Reply { .. } => true,
            Self::OtherType { .. } | Self::Busy { .. } | Self::Request { .. } => false,
        }
    }
}
