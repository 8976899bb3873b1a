//! Events of the simulated machines of the line.

use serde::{Deserialize, Serialize};

/// An action of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "machine", rename_all = "snake_case")]
pub(crate) enum MachineEvent {
    /// The gripper of the arm has closed at x, y, z in m.
    Grasps { at: [f64; 3] },
    /// The gripper of the arm has opened at x, y, z in m.
    Releases { at: [f64; 3] },
    /// The conveyor runs or has stopped.
    Belt { runs: bool },
    /// The mobile robot departs.
    Leaves,
    /// The mobile robot has arrived at x, y in m.
    Arrives { at: [f64; 2] },
}
