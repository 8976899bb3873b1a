//! Log lines for people (text) or for machines (one JSON object a line), on stderr.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// Lines for people; in colour on a terminal.
    Text,
    /// One JSON object a line.
    Json,
}

/// Starts logging. `UA_LOG` sets levels as `debug` or `info,bridge_core=trace`; `quiet` holds the directives that
/// hush what a library says without need.
pub(crate) fn start(format: LogFormat, quiet: &str) {
    let levels = std::env::var("UA_LOG").unwrap_or_else(|_| "info".to_owned());
    let filter = EnvFilter::builder().parse_lossy(format!("{levels},{quiet}"));
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    // A second start, as tests make it, keeps the first one's.
    let started = match format {
        LogFormat::Text => builder.with_target(false).try_init(),
        LogFormat::Json => builder.json().flatten_event(true).try_init(),
    };
    if let Err(error) = started {
        tracing::debug!(%error, "logging had been started before");
    }
}
