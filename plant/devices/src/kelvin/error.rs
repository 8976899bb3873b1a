//! The reasons why a tool is not changed.

use std::time::Duration;

use skills::{DriverError, InvalidParameter, PartnerError, SkillFault};

use super::SWITCHED;
use super::volts::{ChangerReading, InvalidVoltage};
use crate::modbus::ModbusFault;

/// The reason why a tool is not changed.
#[derive(Debug, thiserror::Error)]
pub(super) enum KelvinError {
    #[error(transparent)]
    Parameter(#[from] InvalidParameter),
    #[error(transparent)]
    Modbus(#[from] ModbusFault),
    #[error(transparent)]
    Voltage(#[from] InvalidVoltage),
    #[error(transparent)]
    Partner(#[from] PartnerError),
    #[error("the voltage of the tool changer does not come to rest")]
    Unsteady,
    #[error("the tool changer has not switched within {:?}", SWITCHED)]
    NotSwitched,
    #[error("the tool changer has tool {found} in the place of tool {wanted}")]
    OtherTool { wanted: u8, found: u8 },
    #[error("nothing is moved: {now}, and somebody has to look at it")]
    Between { now: ChangerReading },
    #[error("nothing is moved: tool {number} has to be detached first")]
    Occupied { number: u8 },
    #[error("nothing is moved: tool {number} is attached, and has no dock")]
    NoDock { number: u8 },
    #[error("{uri} is not switched off: {fault}")]
    NotOff { uri: String, fault: SkillFault },
    #[error("the tool is locked, and its component {uri} is not ready within {within:?}: {why}")]
    NotReady {
        uri: String,
        within: Duration,
        /// The reason of the last attempt.
        why: String,
    },
    #[error("stopped")]
    Stopped,
    #[error("stopped at {step}{}", not_halted(halted))]
    StoppedAt {
        step: &'static str,
        /// An error if the robot may move.
        halted: Result<(), SkillFault>,
    },
    #[error("{step}: {skill}: {fault}")]
    Skill {
        step: &'static str,
        skill: String,
        fault: SkillFault,
    },
    #[error("{step}: {skill} failed: {message}")]
    Failed {
        step: &'static str,
        skill: String,
        message: String,
    },
    /// The change has failed, with the reading after that, or the reason why there is none.
    #[error("{why}; {}", now.as_ref().map_or_else(ToString::to_string, ToString::to_string))]
    After {
        why: Box<Self>,
        now: Result<ChangerReading, Box<Self>>,
    },
}

fn not_halted(halted: &Result<(), SkillFault>) -> String {
    match halted {
        Ok(()) => String::new(),
        Err(fault) => format!(", and the robot cannot be halted: {fault}"),
    }
}

impl From<KelvinError> for DriverError {
    fn from(error: KelvinError) -> Self {
        match error {
            KelvinError::Stopped => Self::Stopped,
            KelvinError::Parameter(error) => error.into(),
            KelvinError::Partner(error) => error.into(),
            error @ (KelvinError::Modbus(_)
            | KelvinError::Voltage(_)
            | KelvinError::Unsteady
            | KelvinError::NotSwitched
            | KelvinError::OtherTool { .. }
            | KelvinError::Between { .. }
            | KelvinError::Occupied { .. }
            | KelvinError::NoDock { .. }
            | KelvinError::NotOff { .. }
            | KelvinError::NotReady { .. }
            | KelvinError::StoppedAt { .. }
            | KelvinError::Skill { .. }
            | KelvinError::Failed { .. }
            | KelvinError::After { .. }) => Self::device(error),
        }
    }
}
