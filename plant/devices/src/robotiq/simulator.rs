//! Simulates the registers of a 2F-85 without a real gripper.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::{ACTION, STATUS, STROKE};
use crate::modbus::server::{RegisterTable, Registers};

/// Settings of the simulated gripper.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotiqSettings {
    /// Width of the object between the fingers in m, if any.
    pub object: Option<f64>,
    /// Speed factor of the simulated time.
    pub time_scale: f64,
}

impl Default for RobotiqSettings {
    fn default() -> Self {
        Self {
            object: Some(0.04),
            time_scale: 1.0,
        }
    }
}

/// A simulated gripper; clones share the same gripper.
#[derive(Debug, Clone)]
pub struct RobotiqSimulator {
    gripper: Arc<Mutex<Gripper>>,
}

#[derive(Debug)]
struct Gripper {
    settings: RobotiqSettings,
    /// The three command registers as written last.
    written: [u16; 3],
    /// End of the activation.
    active_at: Option<Instant>,
    /// From 0, open, to 255, closed.
    position: f64,
    moved: Instant,
    /// gOBJ
    object: u8,
}

impl RobotiqSimulator {
    /// Creates a gripper that was just switched on, with open fingers.
    #[must_use]
    pub fn new(settings: RobotiqSettings) -> Self {
        let gripper = Gripper {
            settings,
            written: [0; 3],
            active_at: None,
            position: 0.0,
            moved: Instant::now(),
            object: 3,
        };
        Self {
            gripper: Arc::new(Mutex::new(gripper)),
        }
    }

    /// Switches the gripper off and on again: it keeps only the position of its fingers.
    pub fn reboot(&self) {
        let mut gripper = self.lock();
        gripper.advance();
        gripper.written = [0; 3];
        gripper.active_at = None;
    }

    /// Sets the position of the fingers, from 0, open, to 255, closed.
    pub fn put(&self, position: u8) {
        let mut gripper = self.lock();
        gripper.advance();
        gripper.position = f64::from(position);
    }

    /// Returns the position of the fingers.
    #[must_use]
    pub fn position(&self) -> u8 {
        let mut gripper = self.lock();
        gripper.advance();
        whole(gripper.position)
    }

    fn lock(&self) -> MutexGuard<'_, Gripper> {
        self.gripper.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Registers for RobotiqSimulator {
    fn read(&self, table: RegisterTable, address: u16, count: u16) -> Option<Vec<u16>> {
        let mut gripper = self.lock();
        gripper.advance();
        let status = gripper.status();
        (address..address.checked_add(count)?)
            .map(|address| match (table, address) {
                // The gripper answers both functions for both ranges, as in the manual.
                (RegisterTable::Holding | RegisterTable::Input, STATUS..) => {
                    status.get(usize::from(address - STATUS)).copied()
                }
                (RegisterTable::Holding | RegisterTable::Input, ACTION..) => {
                    gripper.written.get(usize::from(address - ACTION)).copied()
                }
                (RegisterTable::Holding | RegisterTable::Input, _) => None,
            })
            .collect()
    }

    fn write(&self, address: u16, words: &[u16]) -> bool {
        let mut gripper = self.lock();
        gripper.advance();
        let mut written = gripper.written;
        for (address, word) in (address..).zip(words) {
            let Some(slot) = address
                .checked_sub(ACTION)
                .and_then(|at| written.get_mut(usize::from(at)))
            else {
                return false;
            };
            *slot = *word;
        }
        gripper.take(written);
        true
    }
}

impl Gripper {
    fn take(&mut self, written: [u16; 3]) {
        let was = self.activates();
        self.written = written;
        match (was, self.activates()) {
            (false, true) => {
                self.active_at =
                    Some(Instant::now() + ACTIVATION.div_f64(self.settings.time_scale));
            }
            (true, false) => self.active_at = None,
            (true, true) | (false, false) => {}
        }
        if self.goes() {
            self.object = 0;
            self.settle();
        }
    }

    fn bytes(&self) -> [u8; 6] {
        let [[action, _], [_, position], [speed, force]] = self.written.map(u16::to_be_bytes);
        [action, 0, 0, position, speed, force]
    }

    fn activates(&self) -> bool {
        let [action, ..] = self.bytes();
        action & 0x01 != 0
    }

    fn active(&self) -> bool {
        self.active_at.is_some_and(|at| at <= Instant::now())
    }

    fn goes(&self) -> bool {
        let [action, ..] = self.bytes();
        action & 0x08 != 0 && self.active()
    }

    /// Returns the position at which the object stops closing fingers.
    fn stop(&self) -> f64 {
        let object = self.settings.object.unwrap_or(0.0);
        (1.0 - object / STROKE).clamp(0.0, 1.0) * CLOSED
    }

    /// Moves the fingers by the elapsed time.
    fn advance(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.moved).as_secs_f64() * self.settings.time_scale;
        self.moved = now;
        if !self.goes() || self.object != 0 {
            return;
        }
        let [_, _, _, wanted, speed, _] = self.bytes();
        // 20 to 150 mm/s.
        let speed = (20.0 + 130.0 * f64::from(speed) / 255.0) / 85.0 * CLOSED;
        let way = f64::from(wanted) - self.position;
        self.position += way.clamp(-speed * passed, speed * passed);
        self.settle();
    }

    /// Determines whether the fingers have stopped, and the reason.
    fn settle(&mut self) {
        let [_, _, _, wanted, ..] = self.bytes();
        let wanted = f64::from(wanted);
        let stop = self.stop();
        if self.settings.object.is_some() && wanted > stop && self.position >= stop {
            self.position = stop;
            self.object = 2;
        } else if (self.position - wanted).abs() < 0.5 {
            self.position = wanted;
            self.object = 3;
        }
    }

    fn status(&self) -> [u16; 3] {
        let [action, _, _, wanted, ..] = self.bytes();
        let activation = match (self.activates(), self.active()) {
            (false, _) => 0,
            (true, false) => 1,
            (true, true) => 3,
        };
        // A motion was requested before the activation.
        let fault = if action & 0x08 != 0 && !self.active() {
            if self.activates() { 0x05 } else { 0x07 }
        } else {
            0
        };
        let current = if self.goes() && self.object == 0 {
            20
        } else {
            0
        };
        let status = action & 0x09 | activation << 4 | self.object << 6;
        [
            u16::from_be_bytes([status, 0]),
            u16::from_be_bytes([fault, wanted]),
            u16::from_be_bytes([whole(self.position), current]),
        ]
    }
}

fn whole(position: f64) -> u8 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "from 0 to 255"
    )]
    let whole = position.clamp(0.0, CLOSED).round() as u8;
    whole
}

const CLOSED: f64 = 255.0;
/// The gripper opens and closes once during the activation; the simulator omits this.
const ACTIVATION: Duration = Duration::from_millis(1500);
