//! Warnings and errors of a program for sinks beside its log, such as `/rosout`.

use tracing::Level;

/// A warning or an error of the program.
#[derive(Debug, Clone)]
pub struct LogRecord {
    /// The level: warning or error.
    pub level: Level,
    /// The message, followed by the fields.
    pub message: String,
    /// The source file.
    pub file: Option<&'static str>,
    /// The module.
    pub module: Option<&'static str>,
    /// The line in the file.
    pub line: Option<u32>,
}

/// A receiver of the program's warnings and errors beside stderr.
pub trait LogSink: Send + Sync + 'static {
    /// Receives one record. Called on the thread that logs, so it must neither wait nor log.
    fn hear(&self, record: LogRecord);
}
