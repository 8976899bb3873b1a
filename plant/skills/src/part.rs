//! A skill of another component as a part of the work of a composite skill.

use std::future::Future;
use std::pin::{Pin, pin};
use std::time::Duration;

use async_trait::async_trait;
use tokio::time::timeout;
use tracing::{debug, warn};

use crate::driver::Work;
use crate::runs::{RunnableSkill, goes_on};
use crate::shown::RunOutcome;
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;

/// Receives the steps of a job, and can stop it.
#[async_trait]
pub trait JobObserver: Send + Sync {
    /// Reports the start of a step.
    async fn step(&self, step: &'static str);

    /// Reports the end of a part of the step.
    async fn did(&self, what: &str) {
        debug!("{what}");
    }

    /// Reports the reason why the work has not ended after it was halted.
    async fn pending(&self, why: &str) {
        debug!("{why}");
    }

    /// Reports that the end of a part is unknown: the skill is not started again before a Reset.
    async fn unknown(&self, why: &str) {
        warn!("{why}");
    }

    /// Reports that the component of a part was lost after the start of the run: its machine may
    /// move.
    async fn lost_in_run(&self, why: &str) {
        debug!("{why}");
    }

    /// Completes when the job is to be stopped.
    async fn stopped(&self) {
        std::future::pending().await
    }
}

#[async_trait]
impl JobObserver for Work {
    async fn step(&self, step: &'static str) {
        Self::step(self, step).await;
    }

    async fn did(&self, what: &str) {
        self.note(what).await;
    }

    async fn pending(&self, why: &str) {
        Self::pending(self, why).await;
    }

    async fn unknown(&self, why: &str) {
        Self::unknown(self, why).await;
    }

    async fn lost_in_run(&self, why: &str) {
        Self::unknown(self, why).await;
    }

    async fn stopped(&self) {
        Self::stopped(self).await;
    }
}

#[async_trait]
impl<F: Fn(&'static str) + Send + Sync> JobObserver for F {
    async fn step(&self, step: &'static str) {
        self(step);
    }
}

/// The end of a part.
#[derive(Debug)]
pub enum PartEnd<T> {
    /// The run has ended by itself, or its component is lost.
    Ended(Result<RunOutcome, SkillFault>),
    /// The run was halted because of `by`.
    Interrupted {
        /// The output of the future that interrupted the part.
        by: T,
        /// An error if the end of the run is unknown.
        halted: Result<(), SkillFault>,
    },
}

/// Runs one skill to its end, or until `interrupted` is ready. An interrupted run is halted, and
/// the function returns when the run has ended. Until then the teller shows that the cancellation
/// is pending. If the end is unknown, the composite needs a Reset; the end of a run whose component
/// is lost is unknown too.
pub async fn run_part<T>(
    skill: &dyn RunnableSkill,
    parameters: Vec<(String, SkillValue)>,
    within: Duration,
    teller: &dyn JobObserver,
    interrupted: impl Future<Output = T>,
) -> PartEnd<T> {
    let mut run = pin!(skill.run(parameters, within));
    let mut has_begun = false;
    let by = tokio::select! {
        // A run is never started after the interruption.
        biased;
        why = skill.lost() => {
            let fault = SkillFault::Lost(why);
            if has_begun {
                teller.lost_in_run(&lost_in_run(skill, &fault)).await;
            }
            return PartEnd::Ended(Err(fault));
        }
        by = interrupted => by,
        ended = async {
            has_begun = true;
            run.as_mut().await
        } => {
            let ended = known(skill, ended);
            match &ended {
                Err(fault @ SkillFault::NotHalted(_)) => teller.unknown(&fault.to_string()).await,
                Err(fault @ SkillFault::Lost(_)) => {
                    teller.lost_in_run(&lost_in_run(skill, fault)).await;
                }
                Ok(_)
                | Err(
                    SkillFault::Refused { .. }
                    | SkillFault::TimedOut(_)
                    | SkillFault::Unexpected(_),
                ) => {}
            }
            return PartEnd::Ended(ended);
        }
    };
    let halted = match has_begun {
        true => halt(skill, run, teller).await,
        false => Ok(()),
    };
    if let Err(fault) = &halted {
        teller.unknown(&fault.to_string()).await;
    }
    PartEnd::Interrupted { by, halted }
}

fn lost_in_run(skill: &dyn RunnableSkill, fault: &SkillFault) -> String {
    let name = skill.name();
    format!("{name} was lost in its run, whose end is unknown: {fault}")
}

/// Halts a skill and waits for the end of its run.
async fn halt(
    skill: &dyn RunnableSkill,
    mut run: Pin<&mut (impl Future<Output = Result<RunOutcome, SkillFault>> + ?Sized)>,
    teller: &dyn JobObserver,
) -> Result<(), SkillFault> {
    // A Halt can overtake the request that starts the run, so it is repeated.
    for _ in 0..HALTS {
        if let Err(fault) = skill.halt().await {
            let why = format!("{} is not halted: {fault}", skill.name());
            teller.pending(&why).await;
        }
        if let Ok(ended) = timeout(HALT_AGAIN, run.as_mut()).await {
            return confirmed(known(skill, ended));
        }
    }
    teller.pending(&goes_on(&skill.name()).to_string()).await;
    tokio::select! {
        ended = run => confirmed(known(skill, ended)),
        why = skill.lost() => Err(SkillFault::Lost(why)),
    }
}

/// Turns an outcome that is unknown into an error: the machine may move.
fn known(
    skill: &dyn RunnableSkill,
    ended: Result<RunOutcome, SkillFault>,
) -> Result<RunOutcome, SkillFault> {
    ended.and_then(|outcome| match outcome.unknown {
        false => Ok(outcome),
        true => Err(SkillFault::NotHalted(format!(
            "the end of run {} of {} is unknown: {}",
            outcome.run,
            skill.name(),
            outcome.message
        ))),
    })
}

/// An error if the run may go on.
fn confirmed(ended: Result<RunOutcome, SkillFault>) -> Result<(), SkillFault> {
    match ended {
        Err(fault @ (SkillFault::Lost(_) | SkillFault::NotHalted(_))) => Err(fault),
        Ok(_)
        | Err(SkillFault::Refused { .. } | SkillFault::TimedOut(_) | SkillFault::Unexpected(_)) => {
            Ok(())
        }
    }
}

/// Number of Halt requests to a run.
const HALTS: u32 = 3;
/// Pause before Halt is requested again from a run that goes on.
const HALT_AGAIN: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use async_trait::async_trait;
    use program::{ProgramMachineState, ProgramMethod};
    use tokio::sync::watch;

    use super::*;
    use crate::authority::{Authority, SkillOwner};
    use crate::composite::PickAndPlace;
    use crate::description::SkillDescription;
    use crate::model;
    use crate::parameters::ParameterType;
    use crate::shown::SkillSnapshot;
    use crate::skill::Skill;

    const BY: SkillOwner = SkillOwner::Local("the test");

    /// The way of a run to its end.
    #[derive(Clone, Copy, PartialEq)]
    enum Way {
        /// The run is done at once.
        Done,
        /// The run takes a Halt, and ends when the test lets it.
        Halts,
        /// The run refuses a Halt.
        Refuses,
        /// The run takes a Halt, and its outcome is unknown.
        Lost,
        /// The component is lost when the test lets it.
        Vanishes,
    }

    struct Scripted {
        way: Way,
        runs: AtomicU32,
        halts: AtomicU32,
        may_end: watch::Sender<bool>,
    }

    impl Scripted {
        fn new(way: Way) -> Arc<Self> {
            Arc::new(Self {
                way,
                runs: AtomicU32::new(0),
                halts: AtomicU32::new(0),
                may_end: watch::channel(way == Way::Done).0,
            })
        }
    }

    #[async_trait]
    impl RunnableSkill for Scripted {
        fn name(&self) -> String {
            "gripper.Grasp".to_owned()
        }

        async fn run(
            &self,
            _parameters: Vec<(String, SkillValue)>,
            _within: Duration,
        ) -> Result<RunOutcome, SkillFault> {
            let run = self.runs.fetch_add(1, Ordering::Relaxed) + 1;
            let mut may_end = self.may_end.subscribe();
            may_end.wait_for(|may_end| *may_end).await.unwrap();
            match self.way {
                Way::Refuses => return Err(goes_on("gripper.Grasp")),
                Way::Vanishes => return Err(SkillFault::Lost("no response".to_owned())),
                Way::Done | Way::Halts | Way::Lost => {}
            }
            Ok(RunOutcome {
                run,
                succeeded: self.way == Way::Done,
                unknown: self.way == Way::Lost,
                message: String::new(),
                results: Vec::new(),
                trace: Vec::new(),
            })
        }

        async fn halt(&self) -> Result<(), SkillFault> {
            self.halts.fetch_add(1, Ordering::Relaxed);
            match self.way {
                Way::Done | Way::Halts | Way::Lost | Way::Vanishes => Ok(()),
                Way::Refuses => Err(goes_on("gripper.Grasp")),
            }
        }
    }

    /// A started composite with a Grasp that ends as given.
    async fn at_grasp(way: Way) -> (Skill, Arc<Scripted>) {
        let grasp = Scripted::new(way);
        let composite = PickAndPlace {
            ptp: Scripted::new(Way::Done),
            linear: Scripted::new(Way::Done),
            grasp: Arc::clone(&grasp) as Arc<dyn RunnableSkill>,
            release: Scripted::new(Way::Done),
            plate: crate::frame::Frame::IDENTITY,
            within: Duration::from_secs(60),
        };
        let of = model::find("PickAndPlaceSkillType").unwrap();
        let facts = SkillDescription {
            name: "PickAndPlace".to_owned(),
            types: vec![ParameterType::own(of.name)],
            parameters: of.parameters(),
            results: of.results(),
            capabilities: Vec::new(),
            timeout: None,
            rests_in: of.rests_in,
        };
        let skill = Skill::spawn(facts, Arc::new(composite), Authority::new(), Vec::new());
        skill.call(BY, ProgramMethod::Reset).await.unwrap();
        let six = |name: &str| (name.to_owned(), SkillValue::from([0.0; 6]));
        let parameters = vec![six("PickPosition"), six("PlacePosition")];
        skill.start_with(BY, parameters).await.unwrap();
        until(&skill, |shown| shown.step == "Grasp").await;
        (skill, grasp)
    }

    async fn until(
        skill: &Skill,
        is: impl FnMut(&Arc<SkillSnapshot>) -> bool,
    ) -> Arc<SkillSnapshot> {
        let mut watch = skill.watch();
        let shown = timeout(Duration::from_secs(60), watch.wait_for(is)).await;
        Arc::clone(&shown.unwrap().unwrap())
    }

    #[tokio::test]
    async fn a_halted_composite_halts_the_running_grasp_and_is_halted_when_the_grasp_has_ended() {
        let (skill, grasp) = at_grasp(Way::Halts).await;
        skill.call(BY, ProgramMethod::Halt).await.unwrap();
        assert_eq!(skill.shown().state, ProgramMachineState::Running);
        assert_ne!(grasp.halts.load(Ordering::Relaxed), 0);
        grasp.may_end.send_replace(true);
        let shown = until(&skill, |shown| shown.state == ProgramMachineState::Halted).await;
        assert!(!shown.needs_reset);
    }

    #[tokio::test]
    async fn a_composite_with_a_part_that_does_not_halt_says_so_and_needs_a_reset() {
        let (skill, grasp) = at_grasp(Way::Refuses).await;
        skill.call(BY, ProgramMethod::Halt).await.unwrap();
        let shown = skill.shown();
        let pending = shown.pending.clone().unwrap_or_default();
        assert_eq!(shown.state, ProgramMachineState::Running);
        assert!(pending.contains("gripper.Grasp is not halted"), "{pending}");
        grasp.may_end.send_replace(true);
        let shown = until(&skill, |shown| shown.state == ProgramMachineState::Halted).await;
        assert!(shown.needs_reset);
        let message = shown.outcome.as_ref().unwrap().message.clone();
        assert!(message.contains("whether it moves is unknown"), "{message}");
        skill.call(BY, ProgramMethod::Reset).await.unwrap();
        assert!(!skill.shown().needs_reset);
    }

    #[tokio::test]
    async fn a_composite_with_a_part_whose_outcome_is_unknown_needs_a_reset() {
        for is_halted in [true, false] {
            let (skill, grasp) = at_grasp(Way::Lost).await;
            if is_halted {
                skill.call(BY, ProgramMethod::Halt).await.unwrap();
            }
            grasp.may_end.send_replace(true);
            let shown = until(&skill, |shown| shown.state == ProgramMachineState::Halted).await;
            assert!(shown.needs_reset);
            let outcome = shown.outcome.clone().unwrap();
            assert!(outcome.unknown);
            let why = "the end of run 1 of gripper.Grasp is unknown";
            assert!(outcome.message.contains(why), "{outcome:?}");
        }
    }

    #[tokio::test]
    async fn a_composite_whose_part_is_lost_in_its_run_has_an_unknown_outcome() {
        let (skill, grasp) = at_grasp(Way::Vanishes).await;
        grasp.may_end.send_replace(true);
        let shown = until(&skill, |shown| shown.state == ProgramMachineState::Halted).await;
        assert!(shown.needs_reset);
        let outcome = shown.outcome.clone().unwrap();
        assert!(outcome.unknown);
        // The robot, which is not lost, has retreated.
        assert!(
            outcome.message.ends_with("the robot has retreated"),
            "{outcome:?}"
        );
        let start = skill.start_with(BY, Vec::new()).await.unwrap_err();
        assert!(start.text.contains("Reset"), "{start:?}");
    }

    #[tokio::test]
    async fn a_part_is_never_started_after_the_interruption() {
        let skill = Scripted::new(Way::Done);
        let teller = |_step: &'static str| {};
        let within = Duration::from_secs(1);
        let interrupted = std::future::ready(7);
        let part = run_part(&*skill, Vec::new(), within, &teller, interrupted).await;
        assert!(matches!(
            part,
            PartEnd::Interrupted {
                by: 7,
                halted: Ok(())
            }
        ));
        assert_eq!(skill.runs.load(Ordering::Relaxed), 0);
    }
}
