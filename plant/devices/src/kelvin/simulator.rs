//! Simulates a tool changer at a robot's flange, and the converter that measures its voltage. The
//! position of the flange is received over RTDE.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::sleep;
use tracing::debug;

use super::{ChangerReading, DIVIDER, volts};
use crate::modbus::server::{RegisterTable, Registers};
use crate::ur::{Follower, RtdeError};

/// A dock, with the tool that is in it at first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Docked {
    /// The number of the tool at the changer, from 1 to 10; 0 for an empty dock.
    pub number: u8,
    /// Pose of the flange before the tool is locked: m and rad.
    pub dock: [f64; 6],
}

/// A simulated changer; clones share the same changer.
#[derive(Debug, Clone)]
pub struct KelvinSimulator {
    changer: Arc<Mutex<Changer>>,
}

#[derive(Debug)]
struct Changer {
    docks: Vec<Docked>,
    attached: Option<u8>,
    reading: ChangerReading,
    cut: bool,
}

/// A changer that follows a robot. It stops following on drop.
#[derive(Debug)]
pub struct Following {
    _tasks: JoinSet<()>,
}

impl KelvinSimulator {
    /// Creates a changer without an attached tool.
    #[must_use]
    pub fn new(docks: Vec<Docked>) -> Self {
        let changer = Changer {
            docks,
            attached: None,
            reading: ChangerReading::NoTool,
            cut: false,
        };
        Self {
            changer: Arc::new(Mutex::new(changer)),
        }
    }

    /// Follows the robot with RTDE at `host:port`, and reconnects after a loss. Needs a tokio
    /// runtime.
    #[must_use]
    pub fn follow(&self, rtde: &str) -> Following {
        let (simulator, rtde) = (self.clone(), rtde.to_owned());
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            loop {
                let lost = simulator.followed(&rtde).await;
                debug!("the tool changer does not follow: {lost:?}");
                sleep(LATER).await;
            }
        });
        Following { _tasks: tasks }
    }

    async fn followed(&self, rtde: &str) -> Result<(), RtdeError> {
        let mut follower = Follower::open(rtde).await?;
        loop {
            self.flange_at(follower.position().await?);
        }
    }

    /// Applies a pose of the flange: m and rad.
    pub fn flange_at(&self, at: [f64; 6]) {
        self.lock().flange_at(at);
    }

    /// Cuts or repairs the wire to the converter.
    pub fn set_cut(&self, cut: bool) {
        self.lock().cut = cut;
    }

    /// Returns the state of the changer.
    #[must_use]
    pub fn reading(&self) -> ChangerReading {
        self.lock().reading
    }

    fn lock(&self) -> MutexGuard<'_, Changer> {
        self.changer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Registers for KelvinSimulator {
    fn read(&self, table: RegisterTable, address: u16, count: u16) -> Option<Vec<u16>> {
        let changer = self.lock();
        let (line, ground) = DIVIDER;
        // A cut wire gives a voltage above all valid levels.
        let volts = if changer.cut {
            23.0
        } else {
            volts(changer.reading)
        };
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "from 0 to 3000 mV"
        )]
        let millivolts = (volts * 1000.0 * ground / (line + ground)).round() as u16;
        (table == RegisterTable::Input && address == 0 && count == 1).then(|| vec![millivolts])
    }

    fn write(&self, _address: u16, _words: &[u16]) -> bool {
        false
    }
}

impl Changer {
    fn flange_at(&mut self, [x, y, z, _, _, c]: [f64; 6]) {
        let near = self.docks.iter_mut().find(|dock| {
            let [at_x, at_y, at_z, ..] = dock.dock;
            ((x - at_x).powi(2) + (y - at_y).powi(2) + (z - at_z).powi(2)).sqrt() < NEAR
        });
        let Some(dock) = near else {
            self.reading = self
                .attached
                .map_or(ChangerReading::NoTool, ChangerReading::Tool);
            return;
        };
        let [.., at_c] = dock.dock;
        let turned = (c - at_c).to_degrees();
        self.reading = match (self.attached, dock.number) {
            (None, 0) => ChangerReading::NoTool,
            (None, number) if turned <= LOCKS => {
                self.attached = Some(number);
                dock.number = 0;
                ChangerReading::Tool(number)
            }
            (None, _) if turned < UNLOCKS => ChangerReading::Intermediate,
            (None, _) => ChangerReading::NoTool,
            // A tool is put into an empty dock only.
            (Some(attached), 0) if turned >= UNLOCKS => {
                self.attached = None;
                dock.number = attached;
                ChangerReading::NoTool
            }
            (Some(_), 0) if turned > LOCKS => ChangerReading::Intermediate,
            (Some(attached), _) => ChangerReading::Tool(attached),
        };
    }
}

/// m
const NEAR: f64 = 0.004;
/// degrees
const LOCKS: f64 = -60.0;
const UNLOCKS: f64 = -2.0;
const LATER: Duration = Duration::from_millis(200);
