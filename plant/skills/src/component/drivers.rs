//! Creates the drivers of a component from its description.

use std::sync::Arc;
use std::time::Duration;

use super::{Component, Device, DriverSetup, Simulation, World};
use crate::client::{PeerAccess, Remote};
use crate::driver::Driver;
use crate::model::NAMESPACE;
use crate::parameters::ParameterType;
use crate::simulated::{
    Arm, ArmSettings, Base, Changer, Gripper, GripperSettings, Hole, Path, ToolChange,
};
use crate::workspace::RobotWorkspace;

/// Creates the drivers of a component. Its skills share a gripper, a robot, a tool changer and a
/// base.
#[derive(Debug, Default)]
pub struct Drivers {
    gripper: Gripper,
    arm: Option<Arm>,
    changer: Changer,
    base: Base,
    device: Option<Arc<dyn Device>>,
    peers: PeerAccess,
    world: World,
    workspace: Option<Arc<RobotWorkspace>>,
}

/// A driver that cannot do the work of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct DriverFault(pub String);

impl Drivers {
    /// Creates the factory for a component, which reaches others by `peers`.
    #[must_use]
    pub fn new(component: &Component, peers: PeerAccess) -> Self {
        Self {
            device: component.device.clone(),
            world: Arc::clone(&component.world),
            workspace: component.workspace.clone(),
            peers,
            ..Self::default()
        }
    }

    /// Replaces the objects of the cell for the drivers that are made later.
    pub(crate) fn set_world(&mut self, world: World) {
        self.world = world;
    }

    /// Returns whether the component has a tool changer.
    #[must_use]
    pub fn has_tool_changer(&self) -> bool {
        let device = self.device.as_ref();
        device.is_some_and(|device| device.tool_changer().is_some())
    }

    /// Returns the driver of a skill with this type and these supertypes, nearest first.
    ///
    /// # Errors
    /// The driver cannot do the work of that type.
    pub fn make(
        &mut self,
        setup: &DriverSetup,
        types: &[ParameterType],
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let driver = self.make_unbounded(setup, types)?;
        Ok(match &self.workspace {
            Some(workspace) => workspace.bounded(driver),
            None => driver,
        })
    }

    fn make_unbounded(
        &mut self,
        setup: &DriverSetup,
        types: &[ParameterType],
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| {
            types
                .iter()
                .any(|of| of.namespace == NAMESPACE && of.name == name)
        };
        let own = types
            .first()
            .map(ParameterType::to_string)
            .unwrap_or_default();
        match setup {
            DriverSetup::Given(driver) => Ok(Arc::clone(driver)),
            DriverSetup::Device => match &self.device {
                Some(device) => device.driver(types, &self.peers),
                None => Err(DriverFault("the component has no `device`".to_owned())),
            },
            DriverSetup::Space(work) => Err(DriverFault(format!(
                "this program asks nobody in the space for {}",
                work.topic
            ))),
            DriverSetup::Exec(work) => Err(DriverFault(format!(
                "this program does not start `{}`",
                work.command.join(" ")
            ))),
            DriverSetup::PickAndPlace(partners) if is("PickAndPlaceSkillType") => {
                let peers = self.peers.clone();
                let world = Arc::clone(&self.world);
                Ok(Arc::new(Remote::new(partners.clone(), world, peers)))
            }
            DriverSetup::PickAndPlace(_) => Err(DriverFault(format!(
                "`pick_and_place` does the work of PickAndPlaceSkillType, and this is {own}"
            ))),
            DriverSetup::Simulated(how) => self.simulated(how, &is).ok_or_else(|| {
                DriverFault(format!(
                    "`simulated` does the work of {} and what is below them, and this is {own}",
                    SIMULATED.join(", ")
                ))
            }),
        }
    }

    fn simulated(
        &mut self,
        how: &Simulation,
        is: &dyn Fn(&str) -> bool,
    ) -> Option<Arc<dyn Driver>> {
        let which = SIMULATED.iter().find(|name| is(name))?;
        let (duration, scale) = (how.duration, how.time_scale.unwrap_or(1.0));
        let takes = duration.unwrap_or(USUAL_CHANGE).div_f64(scale);
        Some(match *which {
            "GraspSkillType" => self.gripper.grasp(Some(gripper(how))),
            "ReleaseSkillType" => self.gripper.release(Some(gripper(how))),
            "MoveGripperSkillType" => self.gripper.moves(Some(gripper(how))),
            "PtpMoveSkillType" => self.arm(how).moves(Path::PointToPoint),
            "ForceMoveSkillType" => self.arm(how).yields(),
            "LinearMoveSkillType" => self.arm(how).moves(Path::Linear),
            "JointPtpMoveSkillType" | "JointLinearMoveSkillType" => self.arm(how).turns(),
            "AttachToolSkillType" => self.changer.driver(ToolChange::Attach, takes),
            "DetachToolSkillType" => self.changer.driver(ToolChange::Detach, takes),
            "ChangeToolSkillType" => self.changer.driver(ToolChange::Change, takes),
            "NavigateToSkillType" => self.base.navigates(scale),
            _ => return None,
        })
    }

    fn arm(&mut self, how: &Simulation) -> Arm {
        let usual = ArmSettings::default();
        let settings = ArmSettings {
            reach: how.reach.unwrap_or(usual.reach),
            time_scale: how.time_scale.unwrap_or(usual.time_scale),
            contact: how.contact,
            hole: how.hole.map(Hole::new),
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

/// The types with a simulation, subtypes before their supertypes.
const SIMULATED: [&str; 12] = [
    "GraspSkillType",
    "ReleaseSkillType",
    "MoveGripperSkillType",
    "PtpMoveSkillType",
    "ForceMoveSkillType",
    "LinearMoveSkillType",
    "JointPtpMoveSkillType",
    "JointLinearMoveSkillType",
    "AttachToolSkillType",
    "DetachToolSkillType",
    "ChangeToolSkillType",
    "NavigateToSkillType",
];
/// Default time to attach or detach a tool.
const USUAL_CHANGE: Duration = Duration::from_secs(2);
