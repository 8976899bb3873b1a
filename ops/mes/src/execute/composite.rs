//! The composite that moves an object by the skills of a plan.

use std::sync::Arc;

use skills::frame::Frame;
use skills::{PickAndPlace, RunnableSkill, Unchosen};

use super::{Chosen, Ended, Execution};
use crate::process::SkillRole;

impl Execution<'_> {
    /// Returns the tool plate between the chosen robot and gripper.
    pub(super) fn plate(&self, chosen: &Chosen) -> Result<Frame, Unchosen> {
        let of = |wanted: SkillRole| {
            let mut open = chosen.open.iter();
            let offer = open.find(|(role, _)| *role == wanted);
            offer.map_or("", |(_, offer)| &offer.component)
        };
        let plate = self.plant.plate(of(SkillRole::Ptp), of(SkillRole::Grasp))?;
        Ok(Frame::of_pose(plate))
    }

    /// Moves the object of a process.
    pub(super) async fn pick_and_place(
        &self,
        job: &skills::Job,
        plate: Frame,
        roles: &[(SkillRole, Arc<dyn RunnableSkill>)],
    ) -> Ended {
        let of = |wanted: SkillRole| {
            roles
                .iter()
                .find(|(role, _)| *role == wanted)
                .map(|(_, skill)| Arc::clone(skill))
        };
        let (Some(ptp), Some(linear), Some(grasp), Some(release)) = (
            of(SkillRole::Ptp),
            of(SkillRole::Linear),
            of(SkillRole::Grasp),
            of(SkillRole::Release),
        ) else {
            return Ended::Over(
                "the process does not say who moves, grasps and releases".to_owned(),
            );
        };
        let composite = PickAndPlace {
            ptp,
            linear,
            grasp,
            release,
            plate,
            within: self.process.within,
        };
        match composite.run(job, self).await {
            Ok(()) => Ended::Done,
            Err(broken) => {
                let has_retreated = broken.retreated.is_ok();
                self.log.change(|kept, _| {
                    if let Some(plan) = kept.run.plan() {
                        plan.retreated = Some(has_retreated);
                    }
                });
                // If the robot may still be above the place, another robot must not start.
                if has_retreated {
                    Ended::Broken(broken.to_string())
                } else {
                    Ended::Over(broken.to_string())
                }
            }
        }
    }
}
