//! From what a component says of its drivers to drivers.

use std::sync::Arc;

use super::{DriverSetup, Simulation};
use crate::client::Remote;
use crate::driver::Driver;
use crate::model::NAMESPACE;
use crate::parameters::TypeName;
use crate::simulated::{Arm, ArmSettings, Gripper, GripperSettings, Path};

/// Makes the drivers of one component: its skills share one gripper and one robot.
#[derive(Debug, Default)]
pub struct Drivers {
    gripper: Gripper,
    arm: Option<Arm>,
}

/// A driver that cannot do the work of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct DriverFault(String);

impl Drivers {
    /// Those of a new component.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The driver of a skill whose type and supertypes these are, nearest first.
    ///
    /// # Errors
    /// It cannot do the work of that type.
    pub fn make(
        &mut self,
        setup: &DriverSetup,
        types: &[TypeName],
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| {
            types
                .iter()
                .any(|of| of.namespace == NAMESPACE && of.name == name)
        };
        let own = types.first().map(TypeName::to_string).unwrap_or_default();
        match setup {
            DriverSetup::Given(driver) => Ok(Arc::clone(driver)),
            DriverSetup::PickAndPlace(partners) if is("PickAndPlaceSkillType") => {
                Ok(Arc::new(Remote::new(partners.clone())))
            }
            DriverSetup::PickAndPlace(_) => Err(DriverFault(format!(
                "`pick_and_place` does the work of PickAndPlaceSkillType, and this is {own}"
            ))),
            DriverSetup::Simulated(how) if is("GraspSkillType") => {
                Ok(self.gripper.grasp(Some(gripper(how))))
            }
            DriverSetup::Simulated(how) if is("ReleaseSkillType") => {
                Ok(self.gripper.release(Some(gripper(how))))
            }
            DriverSetup::Simulated(how) if is("PtpMoveSkillType") => {
                Ok(self.arm(how).moves(Path::PointToPoint))
            }
            DriverSetup::Simulated(how) if is("LinearMoveSkillType") => {
                Ok(self.arm(how).moves(Path::Linear))
            }
            DriverSetup::Simulated(_) => Err(DriverFault(format!(
                "`simulated` does the work of GraspSkillType, ReleaseSkillType, PtpMoveSkillType, LinearMoveSkillType and \
                 what is below them, and this is {own}"
            ))),
        }
    }

    fn arm(&mut self, how: &Simulation) -> Arm {
        let usual = ArmSettings::default();
        let settings = ArmSettings {
            reach: how.reach.unwrap_or(usual.reach),
            time_scale: how.time_scale.unwrap_or(usual.time_scale),
            ..usual
        };
        let arm = self.arm.get_or_insert_with(|| Arm::new(settings.clone()));
        arm.with(settings)
    }
}

fn gripper(how: &Simulation) -> GripperSettings {
    let usual = GripperSettings::default();
    GripperSettings {
        duration: how.duration.unwrap_or(usual.duration),
        object: how.object.unwrap_or(usual.object),
        time_scale: how.time_scale.unwrap_or(usual.time_scale),
    }
}
