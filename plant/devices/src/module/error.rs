//! The reasons why a procedure of a module is not run.

use std::time::Duration;

use mtp::state::{Command, State};
use plant_opcua::client::ClientError;
use plant_opcua::types::StatusCode;
use skills::{DriverError, InvalidParameter, SkillValue, ValueShape};

/// The reason why a node of a module cannot be read or written.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModuleNodeError {
    /// The server cannot be reached.
    #[error("cannot connect to the module at {endpoint}: {error}")]
    Unreachable {
        /// The endpoint of the server.
        endpoint: String,
        /// The error of the client.
        error: ClientError,
    },
    /// There is no response.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The server refuses a value.
    #[error("{0}")]
    Refused(StatusCode),
    /// The response has no result for a value.
    #[error("the server gave no result")]
    NoResult,
    /// The server has no namespace of the manifest.
    #[error("the server of the module has no namespace {namespace}")]
    NoNamespace {
        /// The URI of the namespace.
        namespace: String,
    },
    /// A value cannot be converted to the type of its node.
    #[error("{value} is no {shape}")]
    WrongType {
        /// The value.
        value: SkillValue,
        /// The type of the node.
        shape: ValueShape,
    },
}

/// The reason why a procedure is not run, or its end is unknown.
#[derive(Debug, thiserror::Error)]
pub(super) enum ModuleError {
    #[error(transparent)]
    Parameter(#[from] InvalidParameter),
    #[error(transparent)]
    Node(#[from] ModuleNodeError),
    #[error("the service {service} runs another procedure")]
    Busy { service: String },
    #[error("the manifest has no {node} for {service}")]
    NoNode { node: &'static str, service: String },
    #[error("{what} is not active, and the manifest has no node to request it")]
    NoRequest { what: String },
    #[error("the manifest has no node to select the procedure")]
    NoSelection,
    #[error("{parameter} has no node for writing")]
    NotWritable { parameter: String },
    #[error("{parameter} is from {} to {} in the module, and {given} was given", bound(*low), bound(*high))]
    OutOfRange {
        parameter: String,
        low: Option<f64>,
        high: Option<f64>,
        given: f64,
    },
    #[error("cannot write {what} ({node}): {error}")]
    Write {
        what: String,
        node: String,
        error: ModuleNodeError,
    },
    #[error("{what} ({node}) has no value")]
    NoValue { what: String, node: String },
    #[error("{what} was not confirmed within {within:?}: {node} has {}", found(value.as_ref()))]
    NotConfirmed {
        what: String,
        within: Duration,
        node: String,
        value: Option<SkillValue>,
    },
    #[error("{what}: the service is {state} after {within:?}")]
    NotReached {
        what: &'static str,
        state: StateWord,
        within: Duration,
    },
    #[error("{what}: {why}")]
    NoState { what: &'static str, why: Box<Self> },
    #[error("the service {service} is {state}, so it cannot be started")]
    NotIdle { service: String, state: StateWord },
    #[error("stopped before Start")]
    StoppedBeforeStart,
    #[error("stopped before the service left Idle")]
    StoppedInIdle,
    #[error("{why}; Start was withdrawn")]
    Withdrawn { why: Box<Self> },
    #[error("{why}; whether the procedure runs is unknown: {silent}")]
    UnknownStart { why: Box<Self>, silent: Box<Self> },
    #[error("the service is {end}, and not Completed")]
    NotCompleted { end: State },
    #[error("the service is Idle again, and was not Completed")]
    IdleAgain,
    #[error("Complete had no effect")]
    CompleteIgnored,
    #[error("no answer for {lost:?}, so the end is unknown: {why}")]
    Lost { lost: Duration, why: Box<Self> },
    /// The service was stopped by its skill.
    #[error("stopped: the service is {state}")]
    Stopped { state: StateWord },
    #[error("{command} is not confirmed, so the end is unknown: {why}")]
    NotStopped { command: Command, why: Box<Self> },
    /// The service was stopped for a reason.
    #[error("{why}; {end}")]
    StoppedFor { why: Box<Self>, end: Box<Self> },
    #[error("it has no value")]
    ResultWithoutValue,
    #[error("the service is Completed, the result {name} is unknown: {why}")]
    NoResult { name: String, why: Box<Self> },
}

impl From<ModuleError> for DriverError {
    fn from(error: ModuleError) -> Self {
        if let ModuleError::Parameter(error) = error {
            return error.into();
        }
        Self::device(error)
    }
}

fn bound(limit: Option<f64>) -> String {
    limit.map_or_else(|| "any".to_owned(), |limit| limit.to_string())
}

fn found(value: Option<&SkillValue>) -> String {
    value.map_or_else(|| "no value".to_owned(), SkillValue::to_string)
}

/// The word StateCur.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StateWord {
    Known(State),
    /// A word that is no state of the standard.
    Unknown(u32),
}

impl std::fmt::Display for StateWord {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Known(state) => state.fmt(f),
            Self::Unknown(word) => write!(f, "the unknown state {word}"),
        }
    }
}
