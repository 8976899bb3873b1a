//! Simulates a robot, behind the two interfaces that drivers use.
//!
//! The robot has no kinematics: the tool moves straight to each pose with the given speed and
//! acceleration, and the joints turn independently of it. Programs consist of a few statements:
//! movel to a pose, movej to a pose or to joint positions, stopl, stopj, sleep, set_payload,
//! write_output_integer_register.

mod motion;
mod served;
mod variables;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

pub use served::ServedRobot;
use skills::simulated::Hole;
use tokio::time::Instant;

use self::motion::SimulatedMotion;
use super::pose::{of_vector, to_vector};
use super::script::Statement;

/// Settings of the simulated robot.
#[derive(Debug, Clone, PartialEq)]
pub struct UrSimulatorSettings {
    /// Speed factor of the simulated time.
    pub time_scale: f64,
    /// Pose of the tool after power-on: x, y, z and a rotation vector.
    pub home: [f64; 6],
    /// The height of a surface that pushes the tool back, m; `None` for none.
    pub surface: Option<f64>,
    /// A hole in that surface.
    pub hole: Option<Hole>,
    /// Outputs of RTDE that the controller does not have, as in earlier versions.
    pub lacks: &'static [&'static str],
}

impl Default for UrSimulatorSettings {
    fn default() -> Self {
        Self {
            time_scale: 1.0,
            home: [0.4, 0.0, 0.5, 0.0, 0.0, 0.0],
            surface: None,
            hole: None,
            lacks: &[],
        }
    }
}

/// A simulated robot; clones share the same robot.
#[derive(Debug, Clone)]
pub struct UrSimulator {
    robot: Arc<Mutex<Robot>>,
}

#[derive(Debug)]
struct Robot {
    settings: UrSimulatorSettings,
    switched_on: Instant,
    seen: Instant,
    pose: [f64; 6],
    /// Positions of the joints, rad.
    joints: [f64; 6],
    program: Option<Running>,
    registers: [i32; 48],
    /// Mass of the payload, kg, and its centre of mass at the flange, m.
    payload: (f64, [f64; 3]),
    slider: f64,
    safety: i32,
    /// Whether the program is paused, as after a protective stop.
    paused: bool,
    silent: bool,
    /// Number of power-ons; connections of earlier power-ons have ended.
    life: u32,
}

#[derive(Debug)]
struct Running {
    waiting: VecDeque<Statement>,
    motion: Option<SimulatedMotion>,
    sleep: f64,
}

impl UrSimulator {
    /// Creates a robot at its home pose.
    #[must_use]
    pub fn new(settings: UrSimulatorSettings) -> Self {
        let now = Instant::now();
        let robot = Robot {
            pose: settings.home,
            joints: [0.0; 6],
            settings,
            switched_on: now,
            seen: now,
            program: None,
            registers: [0; 48],
            payload: (0.0, [0.0; 3]),
            slider: 1.0,
            safety: NORMAL,
            paused: false,
            silent: false,
            life: 0,
        };
        Self {
            robot: Arc::new(Mutex::new(robot)),
        }
    }

    /// Returns the pose of the tool.
    #[must_use]
    pub fn pose(&self) -> [f64; 6] {
        self.lock().pose
    }

    /// Returns an output register; 0 if there is no such register.
    #[must_use]
    pub fn register(&self, number: usize) -> i32 {
        let robot = self.lock();
        robot.registers.get(number).copied().unwrap_or_default()
    }

    /// Sets the pose of the tool and ends the running program.
    pub fn reset(&self, pose: [f64; 6]) {
        let mut robot = self.lock();
        robot.program = None;
        robot.pose = pose;
    }

    /// Sets whether the robot sends nothing.
    pub fn set_silent(&self, silent: bool) {
        self.lock().silent = silent;
    }

    /// Sets or clears a protective stop, as after a contact. The running program is paused, and
    /// goes on after [`play`](Self::play).
    pub fn set_protective_stop(&self, stopped: bool) {
        let mut robot = self.lock();
        robot.safety = if stopped { PROTECTIVE_STOP } else { NORMAL };
        robot.paused |= stopped && robot.program.is_some();
    }

    /// Continues a paused program, as an operator does at the robot.
    pub fn play(&self) {
        let mut robot = self.lock();
        if robot.safety == NORMAL {
            robot.paused = false;
        }
    }

    /// Switches the robot off and on: connections and the running program end; its tool stays in
    /// place.
    pub fn reboot(&self) {
        let mut robot = self.lock();
        robot.program = None;
        robot.paused = false;
        robot.registers = [0; 48];
        robot.slider = 1.0;
        robot.switched_on = Instant::now();
        robot.life = robot.life.wrapping_add(1);
    }

    fn run(&self, statements: Vec<Statement>) {
        let mut robot = self.lock();
        if robot.safety != NORMAL {
            return;
        }
        // A new program replaces the running program. The current motion brakes, because the robot
        // takes a moment to stop.
        let motion = robot.program.take().and_then(|program| program.motion);
        robot.paused = false;
        robot.program = Some(Running {
            waiting: statements.into(),
            motion: motion.map(SimulatedMotion::interrupted),
            sleep: 0.0,
        });
        robot.advance();
    }

    fn lock(&self) -> MutexGuard<'_, Robot> {
        let mut robot = self.robot.lock().unwrap_or_else(PoisonError::into_inner);
        robot.advance();
        robot
    }
}

impl Robot {
    fn mode(&self) -> i32 {
        RUNNING
    }

    /// Returns the force at the tool: that of the surface, N.
    fn force(&self) -> [f64; 6] {
        let [x, y, z, ..] = self.pose;
        let is_over_hole = self.settings.hole.is_some_and(|hole| hole.admits(x, y));
        let surface = self.settings.surface.filter(|_| !is_over_hole);
        let depth = surface.map_or(0.0, |surface| surface - z);
        [0.0, 0.0, depth.max(0.0) * STIFFNESS, 0.0, 0.0, 0.0]
    }

    fn velocity(&self) -> [f64; 6] {
        let running = self.program.as_ref().filter(|_| !self.paused);
        let motion = running.and_then(|program| program.motion.as_ref());
        motion.map_or([0.0; 6], |motion| {
            let scale = self.slider * self.settings.time_scale;
            motion.velocity().map(|part| part * scale)
        })
    }

    /// Advances by the elapsed time.
    fn advance(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.seen).min(LONGEST);
        self.seen = now;
        if self.paused {
            return;
        }
        let mut left = passed.as_secs_f64() * self.settings.time_scale * self.slider;
        while let Some(program) = &mut self.program {
            if let Some(motion) = &mut program.motion {
                let step = left.min(STEP);
                let ended = motion.step(step);
                left -= step;
                match motion.joints() {
                    Some(joints) => self.joints = joints,
                    None => self.pose = motion.pose(),
                }
                if ended {
                    program.motion = None;
                } else if left <= 0.0 {
                    return;
                }
            } else if program.sleep > 0.0 {
                let slept = left.min(program.sleep);
                program.sleep -= slept;
                left -= slept;
                if program.sleep > 0.0 {
                    return;
                }
            } else if !self.next() {
                self.program = None;
            }
        }
    }

    /// Starts the next statement; returns false at the end of the program.
    fn next(&mut self) -> bool {
        let Some(program) = &mut self.program else {
            return false;
        };
        match program.waiting.pop_front() {
            None => return false,
            Some(Statement::Nothing | Statement::Stop) => {}
            Some(Statement::Payload { mass, center }) => self.payload = (mass, center),
            Some(Statement::Sleep(time)) => program.sleep = time,
            Some(Statement::Register { number, value }) => {
                if let Some(register) = self.registers.get_mut(number) {
                    *register = value;
                }
            }
            Some(Statement::Turn {
                to,
                acceleration,
                speed,
            }) => {
                let motion = SimulatedMotion::of_joints(self.joints, to, speed, acceleration);
                program.motion = Some(motion);
            }
            Some(Statement::Move {
                linear,
                to,
                acceleration,
                speed,
            }) => {
                // A joint that turns by v moves the tool by v times the reach.
                let by = if linear { 1.0 } else { super::REACH };
                program.motion = Some(SimulatedMotion::new(
                    self.pose,
                    to,
                    speed * by,
                    acceleration * by,
                ));
            }
        }
        true
    }
}

/// Normalizes a pose, so that equal orientations have equal values.
fn tidy([x, y, z, rx, ry, rz]: [f64; 6]) -> [f64; 6] {
    let [rx, ry, rz] = to_vector(of_vector([rx, ry, rz]));
    [x, y, z, rx, ry, rz]
}

/// Force of the surface for each m below it, N/m.
const STIFFNESS: f64 = 5_000.0;
/// `robot_mode` of a robot that is ready.
const RUNNING: i32 = 7;
/// `safety_mode`
const NORMAL: i32 = 1;
const PROTECTIVE_STOP: i32 = 3;
/// Time step of motions, s.
const STEP: f64 = 0.002;
/// Limit of the elapsed time of a step.
const LONGEST: Duration = Duration::from_secs(10);
