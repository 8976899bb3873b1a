//! Pick and place: one skill composed of the skills of a robot and a gripper.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tracing::warn;

use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{Broken, DriverError, INIT, InvalidParameter, RetreatFault};
use crate::frame::Frame;
use crate::grip::{Hold, PartShape};
use crate::parameters::Parameters;
use crate::part::{JobObserver, PartEnd, run_part};
use crate::runs::{COMPOSITE_HALT_TIMEOUT, RunnableSkill};
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;

/// Skills of other components that together move an object from one pose to another.
#[derive(Clone)]
pub struct PickAndPlace {
    /// PtpMoveSkillType of the robot.
    pub ptp: Arc<dyn RunnableSkill>,
    /// LinearMoveSkillType of the same robot.
    pub linear: Arc<dyn RunnableSkill>,
    /// GraspSkillType of the gripper.
    pub grasp: Arc<dyn RunnableSkill>,
    /// ReleaseSkillType of the same gripper.
    pub release: Arc<dyn RunnableSkill>,
    /// The tool plate of the gripper in the frame of the flange, for example behind a tool changer.
    pub plate: Frame,
    /// Time limit of each run.
    pub within: Duration,
}

/// A pick and place job.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Job {
    /// The pose of the object, whose z axis points up: m, m, m, rad, rad, rad. If the gripper
    /// states no grip point, it is the pose of the flange.
    pub pick: [f64; 6],
    /// The target pose of the object.
    pub place: [f64; 6],
    /// Distance from both poses at which the straight moves start and end, along the z axis of the
    /// tool, m.
    pub approach: f64,
    /// The shape of the object, if it is known.
    pub shape: Option<PartShape>,
}

/// A retreat move: its name, the skill and the target pose.
type Retreat<'s> = (&'static str, &'s Arc<dyn RunnableSkill>, [f64; 6]);

/// A step: its name, the skill, the target pose of a move, and the retreat from there.
type Step<'s> = (
    &'static str,
    &'s Arc<dyn RunnableSkill>,
    Option<[f64; 6]>,
    Retreat<'s>,
);

/// The reason why a step failed.
enum Fault {
    /// Halt: everything stops where it is.
    Stopped(String),
    /// The robot is lost or cannot be halted, or its movement is unknown, so it cannot retreat.
    RobotLost(String),
    Other(String),
}

impl Fault {
    /// The fault after a part that could not be halted.
    fn goes_on(self, part: &UnhaltedSkill, is_robot: bool) -> Self {
        match self {
            Self::RobotLost(why) => Self::RobotLost(format!("{why}; {part}")),
            Self::Stopped(why) => Self::Stopped(format!("{why}; {part}")),
            Self::Other(why) if is_robot => Self::RobotLost(format!("{why}; {part}")),
            Self::Other(why) => Self::Other(format!("{why}; {part}")),
        }
    }
}

impl PickAndPlace {
    /// Runs the job. When a step fails or a component is lost, moving skills are halted and the
    /// robot retreats.
    ///
    /// # Errors
    /// [`Broken`].
    pub async fn run(&self, job: &Job, teller: &dyn JobObserver) -> Result<(), Broken> {
        teller.step(INIT).await;
        let grip = self.grasp.grip_point();
        let hold = Hold::new(grip.as_ref(), &self.plate, job.shape.as_ref()).map_err(|why| {
            let name = self.grasp.name();
            Broken {
                step: INIT,
                why: format!("{name} does not fit: {why}"),
                retreated: Ok(()),
            }
        })?;
        let (pick, place) = (hold.at(job.pick), hold.at(job.place));
        let over_pick = hold.before(job.pick, job.approach);
        let over_place = hold.before(job.place, job.approach);
        // Name, skill and target of each step, and the retreat from there.
        let at_pick = ("MovePickApproachError", &self.linear, over_pick);
        let between = ("MovePlaceApproachError", &self.ptp, over_place);
        let at_place = ("MovePlaceApproachError", &self.linear, over_place);
        let steps: [Step<'_>; 8] = [
            (
                "MovePickApproachBefore",
                &self.ptp,
                Some(over_pick),
                at_pick,
            ),
            ("MovePick", &self.linear, Some(pick), at_pick),
            ("Grasp", &self.grasp, None, at_pick),
            (
                "MovePickApproachAfter",
                &self.linear,
                Some(over_pick),
                at_pick,
            ),
            (
                "MovePlaceApproachBefore",
                &self.ptp,
                Some(over_place),
                between,
            ),
            ("MovePlace", &self.linear, Some(place), at_place),
            ("Release", &self.release, None, at_place),
            (
                "MovePlaceApproachAfter",
                &self.linear,
                Some(over_place),
                at_place,
            ),
        ];
        for (step, skill, target, retreat) in steps {
            teller.step(step).await;
            let fault = match self.part(skill, target, teller).await {
                Ok(()) => continue,
                Err(fault) => fault,
            };
            let (why, retreated) = match fault {
                Fault::Stopped(why) => (why, Err(RetreatFault::Halted)),
                Fault::RobotLost(why) => (why.clone(), Err(RetreatFault::Incomplete(why))),
                Fault::Other(why) => (why, self.retreat(retreat, teller).await),
            };
            warn!("pick and place: {step}: {why}");
            return Err(Broken {
                step,
                why,
                retreated,
            });
        }
        teller.step("Idle").await;
        Ok(())
    }

    async fn part(
        &self,
        skill: &Arc<dyn RunnableSkill>,
        target: Option<[f64; 6]>,
        teller: &dyn JobObserver,
    ) -> Result<(), Fault> {
        let interrupted = async {
            tokio::select! {
                biased;
                () = teller.stopped() => Fault::Stopped("stopped".to_owned()),
                why = self.ptp.lost() => Fault::RobotLost(lost(&*self.ptp, &why)),
                why = self.linear.lost() => Fault::RobotLost(lost(&*self.linear, &why)),
                why = self.grasp.lost() => Fault::Other(lost(&*self.grasp, &why)),
                why = self.release.lost() => Fault::Other(lost(&*self.release, &why)),
            }
        };
        let is_robot = target.is_some();
        let ran = run(&**skill, target, self.within, teller, interrupted);
        match ran.await {
            Ok(()) => Ok(()),
            Err(Ran::Lost(why) | Ran::NotHalted(why)) if is_robot => Err(Fault::RobotLost(why)),
            Err(Ran::Lost(why) | Ran::NotHalted(why) | Ran::Failed(why)) => Err(Fault::Other(why)),
            Err(Ran::Interrupted(fault, Ok(()))) => Err(fault),
            Err(Ran::Interrupted(fault, Err(part))) => Err(fault.goes_on(&part, is_robot)),
        }
    }

    async fn retreat(
        &self,
        (step, skill, to): Retreat<'_>,
        teller: &dyn JobObserver,
    ) -> Result<(), RetreatFault> {
        teller.step(step).await;
        let ran = run(&**skill, Some(to), self.within, teller, teller.stopped());
        ran.await.map_err(|fault| match fault {
            Ran::Lost(why) | Ran::NotHalted(why) | Ran::Failed(why) => {
                RetreatFault::Incomplete(why)
            }
            Ran::Interrupted((), Ok(())) => RetreatFault::Halted,
            Ran::Interrupted((), Err(moving)) => RetreatFault::Incomplete(moving.to_string()),
        })
    }
}

/// The reason why the run of a skill did not succeed.
enum Ran<T> {
    Lost(String),
    NotHalted(String),
    Failed(String),
    /// With an error if the skill could not be halted.
    Interrupted(T, Result<(), UnhaltedSkill>),
}

/// A skill that could not be halted.
#[derive(Debug, thiserror::Error)]
#[error("{skill} cannot be halted: {fault}")]
struct UnhaltedSkill {
    skill: String,
    fault: SkillFault,
}

async fn run<T>(
    skill: &dyn RunnableSkill,
    target: Option<[f64; 6]>,
    within: Duration,
    teller: &dyn JobObserver,
    interrupted: impl Future<Output = T> + Send,
) -> Result<(), Ran<T>> {
    let parameters = target.map(|target| ("TargetPosition".to_owned(), SkillValue::from(target)));
    let parameters = parameters.into_iter().collect();
    let name = skill.name();
    let ran = match run_part(skill, parameters, within, teller, interrupted).await {
        PartEnd::Ended(ran) => ran,
        PartEnd::Interrupted { by, halted } => {
            let halted = halted.map_err(|fault| UnhaltedSkill { skill: name, fault });
            return Err(Ran::Interrupted(by, halted));
        }
    };
    let what = match &ran {
        Ok(outcome) if outcome.succeeded => format!("{name} run {} is done", outcome.run),
        Ok(outcome) => format!("{name} run {} failed: {}", outcome.run, outcome.message),
        Err(fault) => format!("{name}: {fault}"),
    };
    teller.did(&what).await;
    match ran {
        Ok(outcome) if outcome.succeeded => Ok(()),
        Ok(outcome) => Err(Ran::Failed(format!("{name} failed: {}", outcome.message))),
        Err(SkillFault::Lost(why)) => Err(Ran::Lost(lost(skill, &why))),
        Err(SkillFault::NotHalted(why)) => Err(Ran::NotHalted(why)),
        Err(fault) => Err(Ran::Failed(format!("{name}: {fault}"))),
    }
}

fn lost(skill: &dyn RunnableSkill, why: &str) -> String {
    format!("{} is lost: {why}", skill.name())
}

#[async_trait]
impl Driver for PickAndPlace {
    /// Halt waits for the end of the skills that do the work.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        job(parameters).map(drop)
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let job = job(work.parameters())?;
        Self::run(self, &job, &work).await?;
        Ok(Vec::new())
    }
}

pub(crate) fn job(parameters: &Parameters) -> Result<Job, InvalidParameter> {
    let six = |name: &str| {
        parameters
            .six(name)
            .ok_or_else(|| InvalidParameter::missing(name, "six numbers"))
    };
    Ok(Job {
        pick: six("PickPosition")?,
        place: six("PlacePosition")?,
        approach: parameters
            .number("ApproachOffset")
            .ok_or_else(|| InvalidParameter::missing("ApproachOffset", "number"))?,
        shape: None,
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use tokio::sync::watch;

    use super::*;
    use crate::authority::{Authority, SkillOwner};
    use crate::conformance;
    use crate::description::SkillDescription;
    use crate::lock::lock;
    use crate::model;
    use crate::parameters::ParameterType;
    use crate::runs::LocalRun;
    use crate::shown::RunOutcome;
    use crate::simulated::{Arm, ArmSettings, Gripper, GripperSettings, Path};
    use crate::skill::Skill;

    const PICK: [f64; 6] = [0.4, 0.2, 0.1, 0.0, 0.0, 0.0];
    const PLACE: [f64; 6] = [0.4, -0.2, 0.1, 0.0, 0.0, 0.0];
    const JOB: Job = Job {
        pick: PICK,
        place: PLACE,
        approach: 0.05,
        shape: None,
    };

    /// A skill of a component that can be lost.
    struct Losable {
        inner: LocalRun,
        gone: watch::Receiver<bool>,
    }

    #[async_trait]
    impl RunnableSkill for Losable {
        fn name(&self) -> String {
            self.inner.name()
        }

        async fn run(
            &self,
            parameters: Vec<(String, SkillValue)>,
            within: Duration,
        ) -> Result<RunOutcome, SkillFault> {
            if *self.gone.borrow() {
                return Err(SkillFault::Lost("no answer".to_owned()));
            }
            self.inner.run(parameters, within).await
        }

        async fn halt(&self) -> Result<(), SkillFault> {
            self.inner.halt().await
        }

        async fn lost(&self) -> String {
            let mut gone = self.gone.clone();
            let _gone = gone.wait_for(|gone| *gone).await;
            "no answer".to_owned()
        }
    }

    struct Cell {
        arm: Arm,
        gripper: Gripper,
        composite: PickAndPlace,
        gone: watch::Sender<bool>,
        steps: Mutex<Vec<&'static str>>,
    }

    fn skill(name: &str, driver: Arc<dyn Driver>, authority: &Authority) -> LocalRun {
        let of = model::find(name).unwrap();
        let facts = SkillDescription {
            name: name.trim_end_matches("SkillType").to_owned(),
            types: vec![ParameterType::own(name)],
            parameters: of.parameters(),
            results: of.results(),
            capabilities: Vec::new(),
            timeout: None,
            rests_in: of.rests_in,
        };
        let skill = Skill::spawn(facts, driver, authority.clone(), Vec::new());
        LocalRun {
            skill,
            by: SkillOwner::Local("composite"),
        }
    }

    fn cell(object: bool) -> Cell {
        let arm = Arm::new(ArmSettings {
            time_scale: 50.0,
            ..ArmSettings::default()
        });
        let gripper = Gripper::new(GripperSettings {
            duration: Duration::from_millis(20),
            object,
            time_scale: 1.0,
        });
        let (robot, hand) = (Authority::new(), Authority::new());
        let (gone, watched) = watch::channel(false);
        let losable = |name: &str, driver| {
            Arc::new(Losable {
                inner: skill(name, driver, &hand),
                gone: watched.clone(),
            })
        };
        let composite = PickAndPlace {
            ptp: Arc::new(skill(
                "PtpMoveSkillType",
                arm.moves(Path::PointToPoint),
                &robot,
            )),
            linear: Arc::new(skill(
                "LinearMoveSkillType",
                arm.moves(Path::Linear),
                &robot,
            )),
            grasp: losable("GraspSkillType", gripper.grasp(None)),
            release: losable("ReleaseSkillType", gripper.release(None)),
            plate: Frame::IDENTITY,
            within: Duration::from_secs(5),
        };
        Cell {
            arm,
            gripper,
            composite,
            gone,
            steps: Mutex::default(),
        }
    }

    impl Cell {
        async fn run(&self, lose_at: Option<&'static str>) -> Result<(), Broken> {
            let teller = |step| {
                lock(&self.steps).push(step);
                if lose_at == Some(step) {
                    self.gone.send_replace(true);
                }
            };
            self.composite.run(&JOB, &teller).await
        }

        fn steps(&self) -> Vec<&'static str> {
            lock(&self.steps).clone()
        }
    }

    #[tokio::test]
    async fn the_steps_come_in_order_and_the_tool_ends_above_the_place() {
        let cell = cell(true);
        assert_eq!(cell.run(None).await, Ok(()));
        let expected = [
            "Init",
            "MovePickApproachBefore",
            "MovePick",
            "Grasp",
            "MovePickApproachAfter",
            "MovePlaceApproachBefore",
            "MovePlace",
            "Release",
            "MovePlaceApproachAfter",
            "Idle",
        ];
        assert_eq!(cell.steps(), expected);
        assert!((cell.arm.position()[2] - 0.15).abs() < 1e-9);
        assert!(!cell.gripper.holds());
    }

    #[tokio::test]
    async fn without_a_thing_to_grasp_the_robot_retreats_from_the_pick() {
        let cell = cell(false);
        let broken = cell.run(None).await.unwrap_err();
        assert_eq!(
            broken.to_string(),
            "Grasp: Grasp failed: nothing is between the fingers; the robot has retreated"
        );
        assert_eq!(cell.steps().last(), Some(&"MovePickApproachError"));
        assert!((cell.arm.position()[2] - 0.15).abs() < 1e-9);
    }

    #[tokio::test]
    async fn when_the_gripper_is_lost_on_the_way_the_move_is_halted_and_the_robot_retreats() {
        for (step, retreat) in [
            ("MovePick", "MovePickApproachError"),
            ("MovePlaceApproachBefore", "MovePlaceApproachError"),
            ("MovePlace", "MovePlaceApproachError"),
        ] {
            let cell = cell(true);
            let broken = cell.run(Some(step)).await.unwrap_err();
            assert_eq!(broken.step, step);
            assert!(broken.why.ends_with("is lost: no answer"), "{}", broken.why);
            assert_eq!(broken.retreated, Ok(()));
            assert_eq!(cell.steps().last(), Some(&retreat));
            let y = if step == "MovePick" { 0.2 } else { -0.2 };
            let [_, at_y, at_z, ..] = cell.arm.position();
            assert!((at_y - y).abs() < 1e-9 && (at_z - 0.15).abs() < 1e-9);
        }
    }

    #[tokio::test]
    async fn as_a_driver_it_hears_halt_and_the_robot_stands_still() {
        let cell = cell(true);
        let parameters: Vec<(String, SkillValue)> = vec![
            ("PickPosition".to_owned(), PICK.into()),
            ("PlacePosition".to_owned(), PLACE.into()),
        ];
        conformance::check(
            "PickAndPlaceSkillType",
            Arc::new(cell.composite.clone()),
            || parameters.clone(),
        )
        .await
        .unwrap();
        assert!(!cell.gripper.holds());
    }
}
