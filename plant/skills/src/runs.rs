//! Runs a local or remote skill to its end.

use std::future::pending;
use std::time::Duration;

use async_trait::async_trait;
use program::{ProgramMachineState, ProgramMethod};

use crate::authority::SkillOwner;
use crate::grip::GripPoint;
use crate::refusal::RefusalCode;
use crate::shown::{RunOutcome, is_work};
use crate::skill::Skill;
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;

/// A skill that can be run: a skill of another component or of this program.
#[async_trait]
pub trait RunnableSkill: Send + Sync {
    /// Returns the name for messages, as `parallel-gripper.Grasp`.
    fn name(&self) -> String;

    /// Resets the skill if necessary, starts it and waits for the end of the run. The run is halted
    /// when the time `within` has passed. A failed run has an [`RunOutcome`] too.
    ///
    /// # Errors
    /// The reason why there is no outcome.
    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Duration,
    ) -> Result<RunOutcome, SkillFault>;

    /// Halts the skill unless it is Halted, and waits until its run has ended. Work that is done
    /// elsewhere may take a while to end.
    ///
    /// # Errors
    /// The reason why the skill may not have stopped.
    async fn halt(&self) -> Result<(), SkillFault>;

    /// Ends the lease of the caller on the component, so that other clients may use the component
    /// until the next run.
    ///
    /// # Errors
    /// A refusal, or no response.
    async fn release(&self) -> Result<(), SkillFault> {
        Ok(())
    }

    /// Returns the grip point of a grasp skill, if its component states it.
    fn grip_point(&self) -> Option<GripPoint> {
        None
    }

    /// Completes with the reason when the component is lost. Pends while the component is
    /// available.
    async fn lost(&self) -> String {
        pending().await
    }
}

/// A skill of this program, run by an owner of the lease.
#[derive(Debug, Clone)]
pub struct LocalRun {
    /// The skill.
    pub skill: Skill,
    /// The owner of the lease.
    pub by: SkillOwner,
}

#[async_trait]
impl RunnableSkill for LocalRun {
    fn name(&self) -> String {
        self.skill.facts().name.clone()
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        let shown = self.skill.shown();
        if shown.needs_reset {
            return Err(SkillFault::Refused {
                status: RefusalCode::InvalidState.name().to_owned(),
                text: format!(
                    "the outcome of run {} is unknown; Reset makes the skill ready",
                    shown.run
                ),
            });
        }
        if shown.state == ProgramMachineState::Halted {
            let reset = self.skill.call(self.by.clone(), ProgramMethod::Reset).await;
            // The Reset of a caller that gave up earlier may have taken effect first.
            if self.skill.shown().state != ProgramMachineState::Ready {
                reset?;
            }
        }
        let run = self.skill.start_with(self.by.clone(), parameters).await?;
        let mut watch = self.skill.watch();
        let ended = watch.wait_for(|shown| shown.run != run || !is_work(shown.state));
        let ended = tokio::time::timeout(within, ended).await;
        match ended.map(|ended| ended.is_ok()) {
            Ok(true) => {}
            Ok(false) => return Err(SkillFault::Lost("the component ends".to_owned())),
            Err(_) => {
                self.halt().await?;
                return Err(match self.skill.outcome(run) {
                    Some(outcome) if outcome.unknown => {
                        SkillFault::NotHalted(outcome.message.clone())
                    }
                    Some(_) | None => SkillFault::TimedOut(within),
                });
            }
        }
        let outcome = self.skill.outcome(run);
        let outcome =
            outcome.ok_or_else(|| SkillFault::Unexpected(format!("run {run} left no outcome")))?;
        Ok(RunOutcome::clone(&outcome))
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        if self.skill.shown().state != ProgramMachineState::Halted {
            self.skill
                .call(self.by.clone(), ProgramMethod::Halt)
                .await?;
        }
        let mut watch = self.skill.watch();
        let ended = watch.wait_for(|shown| !is_work(shown.state));
        match tokio::time::timeout(HALTS_WITHIN, ended).await {
            Ok(_ended_or_gone) => Ok(()),
            Err(_) => Err(goes_on(&self.name())),
        }
    }
}

/// Returns the reason why a halted skill may not have stopped.
pub(crate) fn goes_on(name: &str) -> SkillFault {
    SkillFault::NotHalted(format!(
        "{name} was told to halt, and its run has not ended within {HALTS_WITHIN:?}: whether it moves is unknown"
    ))
}

/// Time limit for the end of a run after Halt.
pub(crate) const HALTS_WITHIN: Duration = Duration::from_secs(10);
/// Time after Halt during which a composite waits for the ends of the runs of its skills.
pub const COMPOSITE_HALT_TIMEOUT: Duration = Duration::from_secs(12);
