//! A robot that moves nothing real, behind the two interfaces that drivers use.
//!
//! It has no joints: the tool goes straight to each pose, with the speed and acceleration that it was told, and joints stand
//! still in what it tells. Programs are those of a few statements: movel, movej (to a pose), stopl, stopj, sleep,
//! write_output_integer_register.

mod motion;
mod served;
mod variables;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

pub use served::Serving;
use tokio::time::Instant;

use self::motion::Motion;
use super::pose::{of_vector, to_vector};
use super::script::Statement;

/// How the robot is.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// How many times faster than time it works.
    pub time_scale: f64,
    /// Where its tool is when it is switched on: x, y, z and a rotation vector.
    pub home: [f64; 6],
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            time_scale: 1.0,
            home: [0.4, 0.0, 0.5, 0.0, 0.0, 0.0],
        }
    }
}

/// One robot; clones are of the same.
#[derive(Debug, Clone)]
pub struct Simulator {
    robot: Arc<Mutex<Robot>>,
}

#[derive(Debug)]
struct Robot {
    settings: Settings,
    switched_on: Instant,
    seen: Instant,
    pose: [f64; 6],
    program: Option<Running>,
    registers: [i32; 48],
    slider: f64,
    safety: i32,
    silent: bool,
    /// How often it was switched on: connections of before have ended.
    life: u32,
}

#[derive(Debug)]
struct Running {
    waiting: VecDeque<Statement>,
    motion: Option<Motion>,
    sleep: f64,
}

impl Simulator {
    /// One that stands at home.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        let now = Instant::now();
        let robot = Robot {
            pose: settings.home,
            settings,
            switched_on: now,
            seen: now,
            program: None,
            registers: [0; 48],
            slider: 1.0,
            safety: NORMAL,
            silent: false,
            life: 0,
        };
        Self {
            robot: Arc::new(Mutex::new(robot)),
        }
    }

    /// Where its tool is.
    #[must_use]
    pub fn pose(&self) -> [f64; 6] {
        self.lock().pose
    }

    /// Puts its tool somewhere; what it did has ended.
    pub fn reset(&self, pose: [f64; 6]) {
        let mut robot = self.lock();
        robot.program = None;
        robot.pose = pose;
    }

    /// Whether it says nothing.
    pub fn set_silent(&self, silent: bool) {
        self.lock().silent = silent;
    }

    /// Stops it as when it has touched something, or lets it go again.
    pub fn set_protective_stop(&self, stopped: bool) {
        let mut robot = self.lock();
        robot.safety = if stopped { PROTECTIVE_STOP } else { NORMAL };
        if stopped {
            robot.program = None;
        }
    }

    /// Switches it off and on: connections end, and so does what it did; its tool is where it was.
    pub fn reboot(&self) {
        let mut robot = self.lock();
        robot.program = None;
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
        // A program takes the place of the one that runs; its motion goes on until the new one says otherwise, as it would take
        // a moment to come to a stand.
        let motion = robot.program.take().and_then(|program| program.motion);
        robot.program = Some(Running {
            waiting: statements.into(),
            motion: motion.map(Motion::interrupted),
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

    fn velocity(&self) -> [f64; 6] {
        let motion = self
            .program
            .as_ref()
            .and_then(|program| program.motion.as_ref());
        motion.map_or([0.0; 6], |motion| {
            let scale = self.slider * self.settings.time_scale;
            motion.velocity().map(|part| part * scale)
        })
    }

    /// Goes on by the time that has passed.
    fn advance(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.seen).min(LONGEST);
        self.seen = now;
        let mut left = passed.as_secs_f64() * self.settings.time_scale * self.slider;
        while let Some(program) = &mut self.program {
            if let Some(motion) = &mut program.motion {
                let step = left.min(STEP);
                let ended = motion.step(step);
                left -= step;
                self.pose = motion.pose();
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

    /// Begins the next statement; false where there is none.
    fn next(&mut self) -> bool {
        let Some(program) = &mut self.program else {
            return false;
        };
        match program.waiting.pop_front() {
            None => return false,
            Some(Statement::Nothing | Statement::Stop) => {}
            Some(Statement::Sleep(time)) => program.sleep = time,
            Some(Statement::Register { number, value }) => {
                if let Some(register) = self.registers.get_mut(number) {
                    *register = value;
                }
            }
            Some(Statement::Move {
                linear,
                to,
                acceleration,
                speed,
            }) => {
                // A joint that turns by v moves the tool by v times the reach.
                let by = if linear { 1.0 } else { super::REACH };
                program.motion = Some(Motion::new(self.pose, to, speed * by, acceleration * by));
            }
        }
        true
    }
}

/// The same orientation is never told in two ways.
fn tidy([x, y, z, rx, ry, rz]: [f64; 6]) -> [f64; 6] {
    let [rx, ry, rz] = to_vector(of_vector([rx, ry, rz]));
    [x, y, z, rx, ry, rz]
}

/// `robot_mode` of one that is ready.
const RUNNING: i32 = 7;
/// `safety_mode`
const NORMAL: i32 = 1;
const PROTECTIVE_STOP: i32 = 3;
/// Steps in which motions are added up, s.
const STEP: f64 = 0.002;
/// More time than this does not pass unseen.
const LONGEST: Duration = Duration::from_secs(10);
