//! Drivers without a machine: they take the time that one would, and keep its state.

mod arm;
mod gripper;
mod profile;

pub use arm::{Arm, ArmSettings, Path};
pub use gripper::{Gripper, GripperSettings};
pub use profile::Profile;
