//! The end of a program: messages and exit codes.

use std::process::ExitCode;

/// The reason why a program cannot run or had to end: a message, and the kind of failure with its
/// exit code of `sysexits.h`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    kind: FailureKind,
    message: String,
}

/// The kind of a failure: the cause that has to be corrected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// Wrong command line. Exit code 64.
    Usage,
    /// A needed peer, port or interface is not available. Exit code 69.
    Unavailable,
    /// An error of reading or writing. Exit code 74.
    Io,
    /// The mapping or another configuration file cannot be used. Exit code 78.
    Configuration,
}

impl Failure {
    /// Creates a failure with a message that states the problem, its location and the remedy.
    pub fn new(kind: FailureKind, message: impl Into<String>) -> Self {
        Self {
            kind,
            message: message.into(),
        }
    }

    /// Returns the kind of the failure.
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
