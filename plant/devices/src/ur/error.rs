//! The reasons why a move of a robot is not done.

use std::fmt;
use std::io;

use skills::{DriverError, InvalidParameter};

use super::rtde::RtdeError;
use super::state::UnfitRobot;
use super::{BRAKED, TAKEN};

/// The reason why a move of a robot is not done.
#[derive(Debug, thiserror::Error)]
pub(super) enum UrError {
    #[error(transparent)]
    Parameter(#[from] InvalidParameter),
    #[error(transparent)]
    Rtde(#[from] RtdeError),
    #[error(transparent)]
    Unfit(#[from] UnfitRobot),
    #[error("the robot tells values of other types")]
    OtherTypes,
    #[error("{address} cannot be reached: {error}")]
    Unreachable { address: String, error: io::Error },
    #[error("{address} takes no program")]
    NotTaken { address: String },
    #[error("the program of the robot has ended before its move: another one took its place")]
    Replaced,
    #[error(
        "the robot has not taken the program within {:?}: is it in remote control?",
        TAKEN
    )]
    NotStarted,
    #[error("halted before the robot has taken the program")]
    HaltedBefore,
    #[error("{0}")]
    Stopped(StoppedRobot),
    #[error("another client has the speed slider: {stopped}")]
    SliderTaken { stopped: StoppedRobot },
    /// A program was withdrawn for this reason, and the robot stands.
    #[error("{why}; {stopped}")]
    Withdrawn {
        why: Box<Self>,
        stopped: StoppedRobot,
    },
    #[error("the robot is not seen to stop within {:?}", BRAKED)]
    NotStopped,
    #[error("{why}, and its program may go on when it is released")]
    MayGoOn { why: Box<Self> },
    /// The force limit was exceeded, and the robot was not braked.
    #[error("{force}, and {why}")]
    Contact { force: String, why: Box<Self> },
    /// The robot may move.
    #[error("{why}; the outcome is unknown, {stop}")]
    Unknown { why: Box<Self>, stop: StopProgram },
}

impl From<UrError> for DriverError {
    fn from(error: UrError) -> Self {
        if let UrError::Parameter(error) = error {
            return error.into();
        }
        Self::device(error)
    }
}

/// The position at which a robot was stopped, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StoppedRobot(pub(super) [f64; 3]);

impl fmt::Display for StoppedRobot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.0;
        write!(f, "stopped at {x:.3}, {y:.3}, {z:.3} m")
    }
}

/// The outcome of the program that stops the robot.
#[derive(Debug)]
pub(super) enum StopProgram {
    Sent,
    NotSent,
    Failed(Box<UrError>),
}

impl fmt::Display for StopProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sent => f.write_str("the stop program is sent"),
            Self::NotSent => f.write_str("the stop program is not sent"),
            Self::Failed(why) => write!(f, "the stop program is not sent: {why}"),
        }
    }
}
