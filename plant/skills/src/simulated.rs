//! Drivers that simulate a machine: its timing and its state.

mod arm;
mod base;
mod changer;
mod gripper;
mod profile;

pub use arm::{Arm, ArmSettings, Hole, Path};
pub use base::Base;
pub use changer::{Changer, ToolChange};
pub use gripper::{Gripper, GripperSettings};
pub use profile::Profile;
