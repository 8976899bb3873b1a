//! How the program ends.

use std::io;
use std::process::ExitCode;

/// Why a verb could not do what was asked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// A datagram, JSON, keys or metadata that are not what they should be.
    #[error("{0}")]
    Data(String),
    /// Datagrams that were not; each was told of when it came.
    #[error("some datagrams are malformed")]
    Told,
    /// A mapping that cannot run; why was told.
    #[error("a mapping cannot run")]
    Configuration,
    /// A configuration that cannot run, and why.
    #[error("{0}")]
    Unconfigured(String),
    /// What was typed makes no sense together.
    #[error("{0}")]
    Usage(String),
    /// A master, domain or server that is not there.
    #[error("{0}")]
    Unavailable(String),
    /// Somebody of an environment is not there, which was told.
    #[error("not all of the environment is there")]
    NotThere,
    /// What was asked for was answered with a no, or did not succeed.
    #[error("{0}")]
    Failed(String),
    /// Whoever started it wants it to end, and it had not come to an end.
    #[error("interrupted")]
    Interrupted,
    /// A file that cannot be read, or an output that cannot be written.
    #[error("{0}")]
    Io(String),
    /// Whoever read the output has seen enough.
    #[error("the output was closed")]
    Closed,
}

impl Failure {
    pub(crate) fn reading(file: &str, error: &io::Error) -> Self {
        Self::Io(format!("cannot read {file}: {error}"))
    }
}

/// What went wrong with the output.
impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::BrokenPipe {
            return Self::Closed;
        }
        Self::Io(format!("cannot write the output: {error}"))
    }
}

/// As in `sysexits.h`.
impl From<&Failure> for ExitCode {
    fn from(failure: &Failure) -> Self {
        match failure {
            Failure::Data(_) | Failure::Told => Self::from(65),
            Failure::Configuration | Failure::Unconfigured(_) => Self::from(78),
            Failure::Usage(_) => Self::from(USAGE),
            Failure::Unavailable(_) | Failure::NotThere => Self::from(69),
            Failure::Io(_) => Self::from(74),
            Failure::Failed(_) => Self::FAILURE,
            Failure::Interrupted => Self::from(130),
            Failure::Closed => Self::SUCCESS,
        }
    }
}

/// What was typed is none of the program's words.
pub(crate) const USAGE: u8 = 64;
