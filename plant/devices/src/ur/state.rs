//! The state of a robot, as RTDE sends it.

use super::wire::RecipeValue;

/// State of the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct UrState {
    pub(super) pose: [f64; 6],
    pub(super) speed: f64,
    pub(super) mode: i32,
    pub(super) safety: i32,
    /// `runtime_state`: the state of the program.
    pub(super) runtime: u32,
    /// Position of the speed slider, from 0 to 1.
    pub(super) slider: f64,
    pub(super) started: i32,
    pub(super) done: i32,
    /// Force and torque at the tool, in the frame of the base.
    pub(super) force: [f64; 6],
    /// Positions of the joints, rad.
    pub(super) joints: [f64; 6],
}

/// The outputs of RTDE with the state.
pub(super) const OUTPUTS: [&str; 10] = [
    "actual_TCP_pose",
    "actual_TCP_speed",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "target_speed_fraction",
    "output_int_register_24",
    "output_int_register_25",
    "actual_TCP_force",
    "actual_q",
];
/// The inputs of RTDE that runs set.
pub(super) const INPUTS: [&str; 2] = ["speed_slider_mask", "speed_slider_fraction"];

/// The reason why a robot does not move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum UnfitRobot {
    #[error("the robot does not move: it is in a protective stop")]
    ProtectiveStop,
    #[error("the robot does not move: a safeguard stops it")]
    Safeguard,
    #[error("the robot does not move: its emergency stop is pressed")]
    EmergencyStop,
    #[error("the robot does not move: its safety system has a fault")]
    SafetyFault,
    #[error("the robot does not move: it is starting")]
    Starting,
    #[error("the robot does not move: it is switched off")]
    Off,
    #[error("the robot does not move: its brakes are not released")]
    Braked,
    #[error("the robot does not move: it is not running")]
    NotRunning,
}

impl UrState {
    /// Returns the state in the values of [`OUTPUTS`]; `None` for values of other types.
    pub(super) fn of(values: &[RecipeValue]) -> Option<Self> {
        let [
            RecipeValue::Vector(pose),
            RecipeValue::Vector([x, y, z, rx, ry, rz]),
            RecipeValue::I32(mode),
            RecipeValue::I32(safety),
            RecipeValue::U32(runtime),
            RecipeValue::F64(slider),
            RecipeValue::I32(started),
            RecipeValue::I32(done),
            RecipeValue::Vector(force),
            RecipeValue::Vector(joints),
        ] = values
        else {
            return None;
        };
        Some(Self {
            pose: *pose,
            speed: (x * x + y * y + z * z)
                .sqrt()
                .max(LEVER * (rx * rx + ry * ry + rz * rz).sqrt()),
            mode: *mode,
            safety: *safety,
            runtime: *runtime,
            slider: *slider,
            started: *started,
            done: *done,
            force: *force,
            joints: *joints,
        })
    }

    /// Returns whether the robot can move.
    ///
    /// # Errors
    /// The reason why it cannot.
    pub(super) fn fit(&self) -> Result<(), UnfitRobot> {
        Err(match (self.safety, self.mode) {
            (1 | 2, 7) => return Ok(()),
            (3, _) => UnfitRobot::ProtectiveStop,
            (5, _) => UnfitRobot::Safeguard,
            (6 | 7, _) => UnfitRobot::EmergencyStop,
            (8 | 9, _) => UnfitRobot::SafetyFault,
            (_, ..=2) => UnfitRobot::Starting,
            (_, 3) => UnfitRobot::Off,
            (_, 4 | 5) => UnfitRobot::Braked,
            (_, _) => UnfitRobot::NotRunning,
        })
    }
}

/// `runtime_state` without a program. A paused program is another state.
pub(super) const STOPPED: u32 = 1;
/// `runtime_state` with a paused program.
pub(super) const PAUSED: u32 = 4;
/// Distance from the tool at which its rotation counts as speed, m.
const LEVER: f64 = 0.1;
