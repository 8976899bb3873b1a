//! A conformance test for drivers of any kind: simulations, devices, ROS and MTPs.

use std::sync::Arc;
use std::time::Duration;

use program::{ProgramMachineState, ProgramMethod};

use crate::authority::{Authority, SkillOwner};
use crate::description::SkillDescription;
use crate::driver::Driver;
use crate::model;
use crate::parameters::ParameterType;
use crate::refusal::SkillRefusal;
use crate::shown::{RunOutcome, SkillSnapshot};
use crate::skill::Skill;
use crate::value::SkillValue;

/// The reason why a driver does not conform, or a run has no outcome.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConformanceError {
    /// The table has no such type.
    #[error("there is no type {0}")]
    NoType(String),
    /// Start is refused.
    #[error(transparent)]
    Start(#[from] SkillRefusal),
    /// Another method is refused.
    #[error("{method} is refused: {refusal}")]
    Call {
        /// The method.
        method: ProgramMethod,
        /// The refusal.
        refusal: SkillRefusal,
    },
    /// The actor of the skill has ended.
    #[error("the skill has ended")]
    Ended,
    /// A run does not end.
    #[error("the run does not end within {WAIT:?}")]
    TimedOut,
    /// A run has ended without an outcome.
    #[error("the run left no outcome")]
    NoOutcome,
    /// A run failed.
    #[error("the run failed: {0}")]
    Failed(String),
    /// The results are not those of the type.
    #[error("the type has the results {declared:?}, the driver gave {given:?}")]
    Results {
        /// The results of the type.
        declared: Vec<String>,
        /// The results of the run.
        given: Vec<String>,
    },
    /// A halted run has no outcome.
    #[error("a halted run has no outcome")]
    NoHaltedOutcome,
    /// The driver does not follow Halt.
    #[error("the driver did not hear Halt within {0:?}")]
    LateHalt(Duration),
    /// Halt leaves another state.
    #[error("after Halt the skill is {0}")]
    NotHalted(ProgramMachineState),
    /// The work does not rest while it is suspended.
    #[error("the work went on while it was suspended: {before} to {after}")]
    NotSuspended {
        /// The progress.
        before: f32,
        /// The progress after a pause.
        after: f32,
    },
    /// A resumed run does not succeed.
    #[error("the run did not succeed after it was resumed")]
    NotResumed,
    /// A run after a stop fails.
    #[error("it does not work again after it was stopped: {0}")]
    NotAgain(String),
}

const BY: SkillOwner = SkillOwner::Local("the conformance check");
const WAIT: Duration = Duration::from_secs(10);

/// Tests a driver of a skill type of the table. With the `parameters`, which are requested before
/// each run, each run must succeed and must take at least 20 ms, so that it can be stopped and
/// suspended.
///
/// # Errors
/// The first deviation of the driver.
pub async fn check(
    skill_type: &str,
    driver: Arc<dyn Driver>,
    mut parameters: impl FnMut() -> Vec<(String, SkillValue)>,
) -> Result<(), ConformanceError> {
    let can_suspend = driver.can_suspend();
    let skill = skill(skill_type, driver)?;
    let outcome = run(&skill, &parameters()).await?;
    if !outcome.succeeded {
        return Err(ConformanceError::Failed(outcome.message));
    }
    let declared = skill.facts().results.iter();
    let declared: Vec<String> = declared.map(|result| result.name.clone()).collect();
    let given: Vec<String> = outcome.results.into_iter().map(|(name, _)| name).collect();
    if declared != given {
        return Err(ConformanceError::Results { declared, given });
    }

    start(&skill, &parameters()).await?;
    let asked = tokio::time::Instant::now();
    call(&skill, ProgramMethod::Halt).await?;
    let outcome = skill
        .shown()
        .outcome
        .clone()
        .ok_or(ConformanceError::NoHaltedOutcome)?;
    if outcome.message.contains("broken off") {
        return Err(ConformanceError::LateHalt(asked.elapsed()));
    }
    let state = skill.shown().state;
    if state != ProgramMachineState::Halted {
        return Err(ConformanceError::NotHalted(state));
    }

    if can_suspend {
        start(&skill, &parameters()).await?;
        call(&skill, ProgramMethod::Suspend).await?;
        // Twice the time in which work that is not suspended reports progress.
        tokio::time::sleep(Duration::from_millis(60)).await;
        let before = skill.shown().progress;
        tokio::time::sleep(Duration::from_millis(60)).await;
        let shown = skill.shown();
        if shown.state != ProgramMachineState::Suspended
            || (shown.progress - before).abs() > f32::EPSILON
        {
            let after = shown.progress;
            return Err(ConformanceError::NotSuspended { before, after });
        }
        call(&skill, ProgramMethod::Resume).await?;
        let shown = until(&skill, |shown| shown.state != ProgramMachineState::Running).await?;
        let succeeded = shown
            .outcome
            .as_ref()
            .is_some_and(|outcome| outcome.run == shown.run && outcome.succeeded);
        if !succeeded {
            return Err(ConformanceError::NotResumed);
        }
        start(&skill, &parameters()).await?;
        call(&skill, ProgramMethod::Suspend).await?;
        call(&skill, ProgramMethod::Reset).await?;
    }
    let outcome = run(&skill, &parameters()).await?;
    if !outcome.succeeded {
        return Err(ConformanceError::NotAgain(outcome.message));
    }
    Ok(())
}

/// Runs a driver of a skill type of the table once.
///
/// # Errors
/// The reason why there is no outcome.
pub async fn run_once(
    skill_type: &str,
    driver: Arc<dyn Driver>,
    parameters: Vec<(String, SkillValue)>,
) -> Result<RunOutcome, ConformanceError> {
    run(&skill(skill_type, driver)?, &parameters).await
}

fn skill(skill_type: &str, driver: Arc<dyn Driver>) -> Result<Skill, ConformanceError> {
    let none = || ConformanceError::NoType(skill_type.to_owned());
    let of = model::find(skill_type).ok_or_else(none)?;
    let facts = SkillDescription {
        name: of.name.to_owned(),
        types: of.chain().map(|of| ParameterType::own(of.name)).collect(),
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    };
    Ok(Skill::spawn(facts, driver, Authority::new(), Vec::new()))
}

async fn run(
    skill: &Skill,
    parameters: &[(String, SkillValue)],
) -> Result<RunOutcome, ConformanceError> {
    start(skill, parameters).await?;
    let shown = until(skill, |shown| {
        matches!(
            shown.state,
            ProgramMachineState::Ready | ProgramMachineState::Halted
        )
    })
    .await?;
    let outcome = shown
        .outcome
        .as_ref()
        .filter(|outcome| outcome.run == shown.run);
    outcome
        .map(|outcome| RunOutcome::clone(outcome))
        .ok_or(ConformanceError::NoOutcome)
}

async fn start(skill: &Skill, parameters: &[(String, SkillValue)]) -> Result<(), ConformanceError> {
    if skill.shown().state == ProgramMachineState::Halted {
        call(skill, ProgramMethod::Reset).await?;
    }
    skill.start_with(BY, parameters.to_vec()).await?;
    Ok(())
}

async fn call(skill: &Skill, method: ProgramMethod) -> Result<(), ConformanceError> {
    let taken = skill.call(BY, method).await;
    taken
        .map(drop)
        .map_err(|refusal| ConformanceError::Call { method, refusal })
}

async fn until(
    skill: &Skill,
    is: impl FnMut(&Arc<SkillSnapshot>) -> bool,
) -> Result<Arc<SkillSnapshot>, ConformanceError> {
    let mut watch = skill.watch();
    match tokio::time::timeout(WAIT, watch.wait_for(is)).await {
        Ok(Ok(shown)) => Ok(Arc::clone(&shown)),
        Ok(Err(_)) => Err(ConformanceError::Ended),
        Err(_) => Err(ConformanceError::TimedOut),
    }
}
