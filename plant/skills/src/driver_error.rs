//! The reasons why a driver does not do its work.

use std::error::Error;

use crate::out_of_workspace::OutOfWorkspace;
use crate::partner_error::PartnerError;
use crate::value::SkillValue;

/// The work was stopped by Halt, by Reset or by the end of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Stopped;

/// The reason why the work of a skill is not done.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// The work was stopped and has ended. There is nothing to add.
    #[error("stopped")]
    Stopped,
    /// The work was stopped and has ended; the text describes the machine, as `at 0.1, 0.2 m`.
    #[error("stopped {0}")]
    StoppedWith(String),
    /// A parameter does not fit.
    #[error(transparent)]
    Parameter(#[from] InvalidParameter),
    /// A component that the work needs is missing, or does not fit.
    #[error(transparent)]
    Partner(#[from] PartnerError),
    /// A step of a composite skill failed.
    #[error(transparent)]
    Composite(#[from] Broken),
    /// The device failed, with the error of its driver.
    #[error(transparent)]
    Device(Box<dyn Error + Send + Sync>),
    /// The program, call or component that does the work gave this reason.
    #[error("{0}")]
    Reported(String),
}

impl DriverError {
    /// Returns the error of a device.
    #[must_use]
    pub fn device(error: impl Error + Send + Sync + 'static) -> Self {
        Self::Device(Box::new(error))
    }

    /// Returns the error with a reason that a program, call or component gave. The text of
    /// [`Stopped`] becomes that error.
    #[must_use]
    pub fn reported(why: impl Into<String>) -> Self {
        let why = why.into();
        if why == Stopped.to_string() {
            return Self::Stopped;
        }
        Self::Reported(why)
    }
}

impl From<Stopped> for DriverError {
    fn from(Stopped: Stopped) -> Self {
        Self::Stopped
    }
}

/// A parameter that has the type of its skill, and with which the driver does not work. The text
/// starts with the name of the parameter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidParameter {
    /// The parameter has no value of the expected form.
    #[error("{name} has no {expected}")]
    Missing {
        /// The name of the parameter.
        name: String,
        /// The expected form, as `six numbers`.
        expected: &'static str,
    },
    /// The value is outside of a limit.
    #[error("{name} is {given}, and {limit}")]
    OutOfRange {
        /// The name of the parameter.
        name: String,
        /// The given value with its unit.
        given: String,
        /// The limit, as a clause.
        limit: String,
    },
    /// The robot does not move to the position.
    #[error("{name}: {why}")]
    OutOfWorkspace {
        /// The name of the parameter.
        name: String,
        /// The position and the limit.
        why: OutOfWorkspace,
    },
    /// The value is another one than the driver accepts.
    #[error("{name} {expected}")]
    Unexpected {
        /// The name of the parameter.
        name: String,
        /// The given value; `None` if it is missing.
        given: Option<SkillValue>,
        /// The accepted values, as a predicate: `is one of a, b`.
        expected: String,
    },
}

impl InvalidParameter {
    /// Returns the error of a parameter without a value of the expected form.
    #[must_use]
    pub fn missing(name: &str, expected: &'static str) -> Self {
        Self::Missing {
            name: name.to_owned(),
            expected,
        }
    }

    /// Returns the name of the parameter.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Missing { name, .. }
            | Self::OutOfRange { name, .. }
            | Self::OutOfWorkspace { name, .. }
            | Self::Unexpected { name, .. } => name,
        }
    }
}

/// The failure of a job.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{step}: {why}; {}", match retreated {
    Ok(()) if *step == INIT => "nothing has moved".to_owned(),
    Ok(()) => "the robot has retreated".to_owned(),
    Err(why) => format!("the robot has not retreated: {why}"),
})]
pub struct Broken {
    /// The failed step.
    pub step: &'static str,
    /// The reason.
    pub why: String,
    /// Whether the robot has retreated, or why not.
    pub retreated: Result<(), RetreatFault>,
}

/// The reason why a robot has not retreated after the failure of a job.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RetreatFault {
    /// Halt was requested.
    #[error("it was halted, and stands still")]
    Halted,
    /// The move of the retreat failed, or the robot is lost or cannot be halted. Its position is
    /// unknown.
    #[error("{0}")]
    Incomplete(String),
}

/// The step before anything moves.
pub(crate) const INIT: &str = "Init";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_parameter_starts_with_its_name() {
        let missing = InvalidParameter::missing("Width", "number");
        let given = Some(SkillValue::from("odom"));
        let unexpected = InvalidParameter::Unexpected {
            name: "Frame".to_owned(),
            given,
            expected: "is one of map".to_owned(),
        };
        for (error, text) in [
            (missing, "Width has no number"),
            (unexpected, "Frame is one of map"),
        ] {
            assert_eq!(error.to_string(), text);
            assert!(text.starts_with(error.name()), "{text}");
        }
    }

    #[test]
    fn a_program_that_reports_stopped_adds_nothing_to_the_reason_of_the_stop() {
        let stopped = DriverError::reported("stopped");
        assert!(matches!(stopped, DriverError::Stopped));
        let jammed = DriverError::reported("stopped by a jam");
        assert!(matches!(jammed, DriverError::Reported(why) if why == "stopped by a jam"));
    }
}
