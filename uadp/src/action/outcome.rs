//! Outcomes of calls.

use super::ActionFields;
use crate::StatusCode;

/// Outcome of a call, as far as the Requestor knows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionOutcome<'a> {
    /// The call was executed.
    Answered {
        /// Good, or the error of the execution.
        status: StatusCode,
        /// Fields of the response.
        fields: ActionFields<'a>,
    },
    /// The call was not executed.
    Refused(Refusal),
    /// The call may have been executed, or may still be executing.
    Unknown(Unknown),
}

/// Reason why a call is not executed. Each reason is sent as a StatusCode in a response without
/// fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// No Action has this address: Bad_MethodInvalid.
    #[error("no such Action")]
    NoSuchAction,
    /// The Requestor has no permission: Bad_UserAccessDenied.
    #[error("not allowed")]
    NotAllowed,
    /// Not executable in the present state: Bad_NotExecutable.
    #[error("not executable at the moment")]
    NotExecutable,
    /// The limit of concurrent executions is reached: Bad_TooManyOperations.
    #[error("busy")]
    Busy,
    /// The arguments do not match the Action: Bad_InvalidArgument.
    #[error("invalid arguments")]
    InvalidArgument,
    /// The arguments are too big: Bad_RequestTooLarge.
    #[error("arguments too large")]
    TooBig,
    /// The Responder is shutting down: Bad_Shutdown.
    #[error("shutting down")]
    Shutdown,
}

/// Reason why the outcome of a call is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Unknown {
    /// The deadline passed without a response. A Responder reports its own timeout as Bad_Timeout.
    #[error("no response before the deadline")]
    Deadline,
    /// The receive timeout passed without a message of the Responder.
    #[error("the responder is lost")]
    Silent,
    /// The Responder lost the connection to the executor: Bad_NoCommunication.
    #[error("the executor was lost")]
    Lost,
}

impl Refusal {
    /// All reasons.
    pub const ALL: [Self; 7] = [
        Self::NoSuchAction,
        Self::NotAllowed,
        Self::NotExecutable,
        Self::Busy,
        Self::InvalidArgument,
        Self::TooBig,
        Self::Shutdown,
    ];

    /// Returns the StatusCode of the response (OPC 10000-6, A.2).
    #[must_use]
    pub const fn status_code(self) -> StatusCode {
        StatusCode(match self {
            Self::NoSuchAction => 0x8075_0000,
            Self::NotAllowed => 0x801F_0000,
            Self::NotExecutable => 0x8111_0000,
            Self::Busy => 0x8010_0000,
            Self::InvalidArgument => 0x80AB_0000,
            Self::TooBig => 0x80B8_0000,
            Self::Shutdown => 0x800C_0000,
        })
    }
}

impl Unknown {
    /// Returns the StatusCode of the response of a Responder (OPC 10000-6, A.2).
    /// [`Silent`](Self::Silent) has the code of [`Deadline`](Self::Deadline).
    #[must_use]
    pub const fn status_code(self) -> StatusCode {
        StatusCode(match self {
            Self::Deadline | Self::Silent => 0x800A_0000,
            Self::Lost => 0x8031_0000,
        })
    }
}

impl<'a> ActionOutcome<'a> {
    /// Returns the outcome in a response with ActionState Done. A missing status is Good.
    ///
    /// If a Responder executes an Action and responds with the status of a refusal and without
    /// fields, the response cannot be distinguished from a refusal.
    #[must_use]
    pub fn of(status: Option<u16>, fields: ActionFields<'a>) -> Self {
        let status = StatusCode::from_status(status.unwrap_or_default());
        let empty = match fields {
            ActionFields::Variants(block) => block.iter().all(|byte| *byte == 0),
            ActionFields::RawData { payload, .. } => payload.is_empty(),
        };
        if empty && let Some(refusal) = find(Refusal::ALL, status, Refusal::status_code) {
            return Self::Refused(refusal);
        }
        let unknown = [Unknown::Deadline, Unknown::Lost];
        match find(unknown, status, Unknown::status_code) {
            Some(unknown) if empty => Self::Unknown(unknown),
            Some(_) | None => Self::Answered { status, fields },
        }
    }

    /// Returns status and fields of the response with this outcome.
    #[must_use]
    pub const fn to_response(self) -> (StatusCode, ActionFields<'a>) {
        match self {
            Self::Answered { status, fields } => (status, fields),
            Self::Refused(refusal) => (refusal.status_code(), ActionFields::NONE),
            Self::Unknown(unknown) => (unknown.status_code(), ActionFields::NONE),
        }
    }
}

fn find<T: Copy, const N: usize>(
    of: [T; N],
    status: StatusCode,
    status_code: impl Fn(T) -> StatusCode,
) -> Option<T> {
    of.into_iter().find(|it| status_code(*it) == status)
}
