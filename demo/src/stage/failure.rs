//! The reasons why a scenario fails.

use std::io;
use std::path::PathBuf;
use std::process::ExitStatus;

use thiserror::Error;

/// The error, with a hint for its solution.
#[derive(Debug, Error)]
pub(crate) enum DemoFailure {
    #[error(
        "these programs are missing beside the demo: {}; `cargo xtask demo` builds them and runs \
         the demo", list(.0)
    )]
    Missing(Vec<PathBuf>),
    #[error(
        "127.0.0.1:{port} is taken, where the demo's {program} is to listen; end the program that \
         listens there (`ss -ltnp 'sport = :{port}'` names it)"
    )]
    PortTaken { port: u16, program: &'static str },
    #[error("{what}: {source}")]
    Io {
        what: &'static str,
        #[source]
        source: io::Error,
    },
    #[error(
        "{name} ended before the demo was done ({status}){}\nthe logs of all programs are in {}",
        indented(.last_lines), .logs.display()
    )]
    ChildEnded {
        name: &'static str,
        status: ExitStatus,
        last_lines: String,
        logs: PathBuf,
    },
    #[error("the line has not begun after {seconds} s: {standing}\nthe logs are in {}", .logs.display())]
    NotBegun {
        seconds: u64,
        standing: String,
        logs: PathBuf,
    },
    #[error("the line is stuck: {standing}\nthe logs are in {}", .logs.display())]
    Stuck { standing: String, logs: PathBuf },
    #[error("after {seconds} s this has not happened:{}\nthe logs are in {}", items(.lacks), .logs.display())]
    Missed {
        seconds: u64,
        lacks: Vec<String>,
        logs: PathBuf,
    },
    #[error("{why}\nthe logs are in {}", .logs.display())]
    Broken { why: String, logs: PathBuf },
    #[error("interrupted: {standing}")]
    Interrupted { standing: String },
}

impl DemoFailure {
    /// Returns a converter for `map_err` of IO errors.
    pub(crate) fn io(what: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io { what, source }
    }

    /// Returns the exit code of `sysexits.h` for the kind of error; 1 for a scenario that did not
    /// finish.
    pub(crate) const fn exit_code(&self) -> u8 {
        match self {
            Self::Missing(_) | Self::PortTaken { .. } => 69,
            Self::Io { .. } => 74,
            Self::ChildEnded { .. }
            | Self::NotBegun { .. }
            | Self::Stuck { .. }
            | Self::Missed { .. }
            | Self::Broken { .. } => 1,
            Self::Interrupted { .. } => 130,
        }
    }
}

/// Returns the exit code of a scenario, for an end that was printed or not.
pub(crate) fn exit_code(outcome: &Result<(), DemoFailure>, printed: &io::Result<()>) -> u8 {
    match (outcome, printed) {
        (Err(failure), _) => failure.exit_code(),
        // Standard output is closed, for example by `| head`.
        (Ok(()), Err(_)) => 74,
        (Ok(()), Ok(())) => 0,
    }
}

fn items(lacks: &[String]) -> String {
    lacks.iter().map(|what| format!("\n  - {what}")).collect()
}

fn list(paths: &[PathBuf]) -> String {
    let names: Vec<String> = paths
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    names.join(", ")
}

fn indented(lines: &str) -> String {
    if lines.is_empty() {
        return ", without a word in its log".to_owned();
    }
    let lines: Vec<String> = lines.lines().map(|line| format!("\n  | {line}")).collect();
    format!("; its last lines:{}", lines.concat())
}
