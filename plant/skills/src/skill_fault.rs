//! The reasons why a request to a skill failed.

use std::time::Duration;

use crate::refusal::SkillRefusal;

/// The reason why a request to a skill failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SkillFault {
    /// The component does not respond: the state of the run is unknown.
    #[error("its component is lost: {0}")]
    Lost(String),
    /// The component refused the request; nothing has changed.
    #[error("{status}: {text}")]
    Refused {
        /// The name of the StatusCode, as `BadInvalidState`.
        status: String,
        /// The reason, for people.
        text: String,
    },
    /// The run did not end in time and was halted.
    #[error("it did not end within {0:?} and was halted")]
    TimedOut(Duration),
    /// The end of the run is unknown, for example after a Halt that was not confirmed: its machine
    /// may move.
    #[error("{0}")]
    NotHalted(String),
    /// The skill does not have the expected form.
    #[error("{0}")]
    Unexpected(String),
}

impl From<SkillRefusal> for SkillFault {
    fn from(refusal: SkillRefusal) -> Self {
        Self::Refused {
            status: refusal.code.name().to_owned(),
            text: refusal.text,
        }
    }
}
