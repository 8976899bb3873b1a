//! Drivers without a machine: they take the time that one would, and keep its state.

mod arm;
mod base;
mod changer;
mod gripper;
mod profile;

pub use arm::{Arm, ArmSettings, Path};
pub use base::Base;
pub use changer::{Change, Changer};
pub use gripper::{Gripper, GripperSettings};
pub use profile::Profile;
