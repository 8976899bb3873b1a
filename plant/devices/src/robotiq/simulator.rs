//! The registers of a 2F-85 that holds nothing real.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::{ACTION, STATUS, STROKE};
use crate::modbus::server::{Registers, Table};

/// How the gripper is.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// How wide the thing between the fingers is, m, if there is one.
    pub object: Option<f64>,
    /// How many times faster than time it works.
    pub time_scale: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            object: Some(0.04),
            time_scale: 1.0,
        }
    }
}

/// One gripper; clones are of the same.
#[derive(Debug, Clone)]
pub struct Simulator {
    gripper: Arc<Mutex<Gripper>>,
}

#[derive(Debug)]
struct Gripper {
    settings: Settings,
    /// The three registers as they were written last.
    written: [u16; 3],
    /// When activation is over.
    active_at: Option<Instant>,
    /// From 0, open, to 255, closed.
    position: f64,
    moved: Instant,
    /// gOBJ
    object: u8,
}

impl Simulator {
    /// One that was just switched on, its fingers open.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
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

    /// Switches it off and on again: it keeps where its fingers are, and nothing else.
    pub fn reboot(&self) {
        let mut gripper = self.lock();
        gripper.advance();
        gripper.written = [0; 3];
        gripper.active_at = None;
    }

    /// Puts the fingers to a position from 0, open, to 255, closed.
    pub fn put(&self, position: u8) {
        let mut gripper = self.lock();
        gripper.advance();
        gripper.position = f64::from(position);
    }

    /// Where the fingers are.
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

impl Registers for Simulator {
    fn read(&self, table: Table, address: u16, count: u16) -> Option<Vec<u16>> {
        let mut gripper = self.lock();
        gripper.advance();
        let status = gripper.status();
        (address..address.checked_add(count)?)
            .map(|address| match (table, address) {
                // It answers both functions for both ranges, as the manual has it.
                (Table::Holding | Table::Input, STATUS..) => {
                    status.get(usize::from(address - STATUS)).copied()
                }
                (Table::Holding | Table::Input, ACTION..) => {
                    gripper.written.get(usize::from(address - ACTION)).copied()
                }
                (Table::Holding | Table::Input, _) => None,
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

    /// The position in which the thing stops fingers that close.
    fn stop(&self) -> f64 {
        let object = self.settings.object.unwrap_or(0.0);
        (1.0 - object / STROKE).clamp(0.0, 1.0) * CLOSED
    }

    /// Moves the fingers by the time that has passed.
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

    /// Whether the fingers stand, and why.
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
        // Told to go before it is activated.
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
/// The gripper opens and closes once meanwhile; that is left out.
const ACTIVATION: Duration = Duration::from_millis(1500);
