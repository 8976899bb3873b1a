//! The errors of a call.

use std::fmt;
use std::io;
use std::time::Duration;

use thiserror::Error;

use crate::master::MasterError;

/// Phase of a call at the time of its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallPhase {
    /// Waiting for earlier calls: for the persistent connection, or for a turn to connect.
    Queue,
    /// Looking up the service at the master.
    Lookup,
    /// Connecting to the server.
    Connect,
    /// Exchanging connection headers.
    Handshake,
    /// Sending the request.
    Request,
    /// Waiting for the response after the request was sent.
    Answer,
}

impl fmt::Display for CallPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Queue => "waiting for earlier calls to the same service",
            Self::Lookup => "looking it up at the master",
            Self::Connect => {
                "connecting to it (if its node has died, remove it from the master with `rosnode cleanup`)"
            }
            Self::Handshake => "exchanging connection headers",
            Self::Request => "sending the request",
            Self::Answer => "waiting for the response",
        })
    }
}

/// Error of a service call.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The master knows no node that offers the service.
    #[error("no node offers {service}: `rosservice list` shows the registered services")]
    NotAdvertised {
        /// The resolved service.
        service: String,
    },
    /// The call to the master failed.
    #[error("cannot look up {service} at the ROS master at {uri}: {source}")]
    Master {
        /// The resolved service.
        service: String,
        /// URI of the master.
        uri: String,
        /// The error of the call.
        #[source]
        source: MasterError,
    },
    /// No server listens at the registered address of the service, or its host name does not
    /// resolve.
    #[error(
        "cannot connect to {host}:{port}, the registered address of {service}: {source}. If the node has \
         died, remove it from the master with `rosnode cleanup`; if it runs, check that {host} resolves and \
         is reachable from this host"
    )]
    NoConnection {
        /// The resolved service.
        service: String,
        /// The server's host, as registered.
        host: String,
        /// The server's port.
        port: u16,
        /// The error of the system.
        #[source]
        source: io::Error,
    },
    /// The server replied to the connection header with `error=`, most often because of another
    /// type.
    #[error("the server of {service} refuses: {message}")]
    Refused {
        /// The resolved service.
        service: String,
        /// The text of the server.
        message: String,
    },
    /// The server accepted the connection, and its header contains another type.
    #[error("{service} has the type {theirs}, but {ours} is required")]
    OtherType {
        /// The resolved service.
        service: String,
        /// Name and checksum of the server's type.
        theirs: String,
        /// Name and checksum of the client's type.
        ours: String,
    },
    /// The server executed the call and reports that it failed.
    #[error("{service} failed: {message}")]
    Failed {
        /// The resolved service.
        service: String,
        /// The text of the server; U+FFFD replaces bytes that are not UTF-8.
        message: String,
    },
    /// The time limit of the call has passed.
    #[error("{service}: no response within {limit:?}, while {phase}")]
    Timeout {
        /// The resolved service.
        service: String,
        /// The phase that was not completed.
        phase: CallPhase,
        /// The time limit of the whole call.
        limit: Duration,
    },
    /// The time until which the request could be sent has passed before it was sent.
    #[error("the request for {service} was not sent: the time until which it may start has passed")]
    TooLate {
        /// The resolved service.
        service: String,
    },
    /// The connection ended within the call.
    #[error("the connection to the server of {service} was lost while {phase}: {source}")]
    Lost {
        /// The resolved service.
        service: String,
        /// The phase of the call.
        phase: CallPhase,
        /// The error of the system.
        #[source]
        source: io::Error,
    },
    /// The length of the request exceeds the wire format.
    #[error("a request of {bytes} bytes for {service} exceeds the length limit of TCPROS")]
    RequestTooLong {
        /// The resolved service.
        service: String,
        /// Length of the request.
        bytes: usize,
    },
    /// The response is longer than the options allow.
    #[error("the response of {service} has {announced} bytes, more than the limit of {limit}")]
    AnswerTooLong {
        /// The resolved service.
        service: String,
        /// Length of the response.
        announced: u32,
        /// The limit that it exceeds.
        limit: usize,
    },
    /// The master or the server violated the protocol.
    #[error("{service}: {what}")]
    Malformed {
        /// The resolved service.
        service: String,
        /// The phase of the call.
        phase: CallPhase,
        /// Description of the violation.
        what: String,
    },
}

impl ServiceError {
    /// Returns whether the server may have executed the call without a received response: the whole
    /// request was sent, and the response was lost or not accepted. If false, the server either
    /// responded with [`ServiceError::Failed`], or never received the whole request.
    pub const fn may_have_run(&self) -> bool {
        match self {
            Self::Timeout { phase, .. }
            | Self::Lost { phase, .. }
            | Self::Malformed { phase, .. } => matches!(phase, CallPhase::Answer),
            Self::AnswerTooLong { .. } => true,
            Self::NotAdvertised { .. }
            | Self::Master { .. }
            | Self::NoConnection { .. }
            | Self::Refused { .. }
            | Self::OtherType { .. }
            | Self::Failed { .. }
            | Self::TooLate { .. }
            | Self::RequestTooLong { .. } => false,
        }
    }

    pub(super) const fn is_lost_in_request(&self) -> bool {
        matches!(
            self,
            Self::Lost {
                phase: CallPhase::Request,
                ..
            }
        )
    }
}
