//! How a call ends.

use super::ActionFields;
use crate::StatusCode;

/// What became of a call, as far as it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome<'a> {
    /// It was executed, and this came out.
    Answered {
        /// Good, or what went wrong in it.
        status: StatusCode,
        /// The fields of the response.
        fields: ActionFields<'a>,
    },
    /// It was not executed.
    Refused(Refusal),
    /// It may have been executed, or may be still.
    Unknown(Unknown),
}

/// Why a call is not executed. Each has a StatusCode that tells it in a response without fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// Nothing there with this address: Bad_MethodInvalid.
    #[error("no such Action")]
    NoSuchAction,
    /// The Requestor may not: Bad_UserAccessDenied.
    #[error("not allowed")]
    NotAllowed,
    /// Not now: Bad_NotExecutable.
    #[error("not executable now")]
    NotExecutable,
    /// As many as can be are executed already: Bad_TooManyOperations.
    #[error("busy")]
    Busy,
    /// The arguments are not those of the Action: Bad_InvalidArgument.
    #[error("invalid arguments")]
    InvalidArgument,
    /// The arguments are too big: Bad_RequestTooLarge.
    #[error("arguments too big")]
    TooBig,
    /// The Responder is about to end: Bad_Shutdown.
    #[error("shutting down")]
    Shutdown,
}

/// Why it is not known whether a call was executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Unknown {
    /// There was no answer before the deadline. A Responder tells its own by Bad_Timeout.
    #[error("no answer before the deadline")]
    Deadline,
    /// Nothing was heard of the Responder for the receive timeout.
    #[error("the responder is silent")]
    Silent,
    /// What executed it was lost behind the Responder: Bad_NoCommunication.
    #[error("what executed it was lost")]
    Lost,
}

impl Refusal {
    /// All there are.
    pub const ALL: [Self; 7] = [
        Self::NoSuchAction,
        Self::NotAllowed,
        Self::NotExecutable,
        Self::Busy,
        Self::InvalidArgument,
        Self::TooBig,
        Self::Shutdown,
    ];

    /// The StatusCode it is told by (OPC 10000-6, A.2).
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
    /// The StatusCode a Responder tells it by (OPC 10000-6, A.2); [`Silent`](Self::Silent) as
    /// [`Deadline`](Self::Deadline).
    #[must_use]
    pub const fn status_code(self) -> StatusCode {
        StatusCode(match self {
            Self::Deadline | Self::Silent => 0x800A_0000,
            Self::Lost => 0x8031_0000,
        })
    }
}

impl<'a> Outcome<'a> {
    /// What a response with ActionState Done says. Without a status it is good.
    ///
    /// A Responder that executes an Action and gives it the status of a refusal, without fields, is not told from one
    /// that refuses it.
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

    /// Status and fields of the response that says this.
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
