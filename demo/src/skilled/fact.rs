//! What the simulated machines of the line tell of themselves.

use serde::{Deserialize, Serialize};

/// Something that a machine did.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "machine", rename_all = "snake_case")]
pub(crate) enum MachineEvent {
    /// The gripper of the arm has closed, at x, y, z in m.
    Grasps { at: [f64; 3] },
    /// It has opened.
    Releases { at: [f64; 3] },
    /// The conveyor runs or stands still.
    Belt { runs: bool },
    /// The mobile robot sets out.
    Leaves,
    /// The mobile robot stands at x, y in m.
    Arrives { at: [f64; 2] },
}
