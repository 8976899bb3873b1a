//! The exit codes of the program.

use std::io;
use std::process::ExitCode;

/// The reason why a command failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CommandFailure {
    /// A malformed datagram, JSON file, key file or metadata file.
    #[error("{0}")]
    Data(String),
    /// Some datagrams are malformed; each was reported when it was read.
    #[error("some datagrams are malformed")]
    Told,
    /// A mapping cannot run; the reasons were reported.
    #[error("a mapping cannot run")]
    Configuration,
    /// A configuration cannot run, with the reason.
    #[error("{0}")]
    Unconfigured(String),
    /// The arguments are wrong, or contradict each other.
    #[error("{0}")]
    Usage(String),
    /// A master, domain or server is not available.
    #[error("{0}")]
    Unavailable(String),
    /// A part of the environment is not available, which was reported.
    #[error("not all of the environment is there")]
    NotThere,
    /// The request was refused, or did not succeed.
    #[error("{0}")]
    Failed(String),
    /// The user interrupted the command before its end.
    #[error("interrupted")]
    Interrupted,
    /// A file cannot be read, or the output cannot be written.
    #[error("{0}")]
    Io(String),
    /// The reader of the output closed it.
    #[error("the output was closed")]
    Closed,
}

impl CommandFailure {
    pub(crate) fn reading(file: &str, error: &io::Error) -> Self {
        Self::Io(format!("cannot read {file}: {error}"))
    }
}

/// Maps errors of the output.
impl From<io::Error> for CommandFailure {
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::BrokenPipe {
            return Self::Closed;
        }
        Self::Io(format!("cannot write the output: {error}"))
    }
}

/// Returns the exit code, as in `sysexits.h`.
impl From<&CommandFailure> for ExitCode {
    fn from(failure: &CommandFailure) -> Self {
        match failure {
            CommandFailure::Data(_) | CommandFailure::Told => Self::from(65),
            CommandFailure::Configuration | CommandFailure::Unconfigured(_) => Self::from(78),
            CommandFailure::Usage(_) => Self::from(USAGE),
            CommandFailure::Unavailable(_) | CommandFailure::NotThere => Self::from(69),
            CommandFailure::Io(_) => Self::from(74),
            CommandFailure::Failed(_) => Self::FAILURE,
            CommandFailure::Interrupted => Self::from(130),
            CommandFailure::Closed => Self::SUCCESS,
        }
    }
}

/// The exit code of wrong arguments.
pub(crate) const USAGE: u8 = 64;
