//! How a program ends.

use std::process::ExitCode;

/// Why a program cannot run or had to end: what to tell, and the exit code of `sysexits.h` that
/// says whose it is to mend.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    kind: FailureKind,
    message: String,
}

/// Whose it is to mend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// What was typed. Exit code 64.
    Usage,
    /// A needed peer, port or interface is not available. Exit code 69.
    Unavailable,
    /// Reading or writing went wrong. Exit code 74.
    Io,
    /// The mapping cannot run. Exit code 78.
    Configuration,
}

impl Failure {
    /// A failure with a message that says what, where and what to do.
    pub fn new(kind: FailureKind, message: impl Into<String>) -> Self {
        Self {
            kind,
            message: message.into(),
        }
    }

    /// Whose it is to mend.
    #[must_use]
    pub const fn kind(&self) -> FailureKind {
        self.kind
    }
}

impl From<FailureKind> for ExitCode {
    fn from(kind: FailureKind) -> Self {
        Self::from(match kind {
            FailureKind::Usage => 64,
            FailureKind::Unavailable => 69,
            FailureKind::Io => 74,
            FailureKind::Configuration => 78,
        })
    }
}
