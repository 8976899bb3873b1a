//! Refusals of calls. A refused call changes nothing.

use std::fmt;

/// The kind of a refusal: a StatusCode of OPC 10000-4.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefusalCode {
    /// Another owner holds the lease of the component.
    Locked,
    /// The state machine does not have this transition in the current state.
    InvalidState,
    /// The skill does not support the method.
    NotSupported,
    /// A mandatory parameter is missing.
    ArgumentsMissing,
    /// A parameter has the wrong type.
    TypeMismatch,
    /// A parameter has an invalid value.
    InvalidArgument,
    /// The requested object is unknown or has been removed.
    NotFound,
    /// The component is shutting down.
    Shutdown,
    /// Too many calls are waiting.
    TooManyOperations,
    /// The executor of the work refuses the request.
    RequestNotAllowed,
}

impl RefusalCode {
    /// Returns its name in OPC 10000-4.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Locked => "BadLocked",
            Self::InvalidState => "BadInvalidState",
            Self::NotSupported => "BadNotSupported",
            Self::ArgumentsMissing => "BadArgumentsMissing",
            Self::TypeMismatch => "BadTypeMismatch",
            Self::InvalidArgument => "BadInvalidArgument",
            Self::NotFound => "BadNotFound",
            Self::Shutdown => "BadShutdown",
            Self::TooManyOperations => "BadTooManyOperations",
            Self::RequestNotAllowed => "BadRequestNotAllowed",
        }
    }

    /// Returns its number (OPC 10000-6, A.2).
    #[must_use]
    pub const fn number(self) -> u32 {
        match self {
            Self::Locked => 0x80E9_0000,
            Self::InvalidState => 0x80AF_0000,
            Self::NotSupported => 0x803D_0000,
            Self::ArgumentsMissing => 0x8076_0000,
            Self::TypeMismatch => 0x8074_0000,
            Self::InvalidArgument => 0x80AB_0000,
            Self::NotFound => 0x803E_0000,
            Self::Shutdown => 0x800C_0000,
            Self::TooManyOperations => 0x8010_0000,
            Self::RequestNotAllowed => 0x80E4_0000,
        }
    }
}

/// A refusal with its reason for people. Its text is `BadInvalidState: <reason>`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct SkillRefusal {
    /// The kind.
    pub code: RefusalCode,
    /// The reason, in a sentence.
    pub text: String,
}

impl SkillRefusal {
    /// Creates the refusal of a skill whose run has an unknown outcome.
    pub(crate) fn unknown_outcome(run: u32) -> Self {
        let text = format!("the outcome of run {run} is unknown; Reset makes the skill ready");
        Self::new(RefusalCode::InvalidState, text)
    }

    pub(crate) fn new(code: RefusalCode, text: impl Into<String>) -> Self {
        Self {
            code,
            text: text.into(),
        }
    }

    /// Returns the refusal of calls of a skill that has ended.
    pub(crate) fn closed() -> Self {
        Self::new(RefusalCode::Shutdown, "the component ends")
    }
}

impl fmt::Display for SkillRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.code.name(), self.text)
    }
}
