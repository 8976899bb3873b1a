//! A conformance test for drivers of any kind: simulations, devices, ROS and MTPs.

use std::sync::Arc;
use std::time::Duration;

use program::{ProgramMachineState, ProgramMethod};

use crate::authority::{Authority, SkillOwner};
use crate::driver::Driver;
use crate::model;
use crate::parameters::ParameterType;
use crate::shown::{RunOutcome, SkillSnapshot};
use crate::skill::{Skill, SkillDescription};
use crate::value::SkillValue;

const BY: SkillOwner = SkillOwner::Local("the conformance check");
const WAIT: Duration = Duration::from_secs(10);

/// Tests a driver of a skill type of the table. With the `parameters`, which are requested before
/// each run, each run must succeed and must take at least 20 ms, so that it can be stopped and
/// suspended.
///
/// # Errors
/// The first deviation of the driver, as text for people.
pub async fn check(
    skill_type: &str,
    driver: Arc<dyn Driver>,
    mut parameters: impl FnMut() -> Vec<(String, SkillValue)>,
) -> Result<(), String> {
    let can_suspend = driver.can_suspend();
    let skill = skill(skill_type, driver)?;
    let outcome = run(&skill, &parameters()).await?;
    if !outcome.succeeded {
        return Err(format!("the run failed: {}", outcome.message));
    }
    let declared: Vec<&str> = skill
        .facts()
        .results
        .iter()
        .map(|result| result.name.as_str())
        .collect();
    let given: Vec<&str> = outcome
        .results
        .iter()
        .map(|(name, _)| name.as_str())
        .collect();
    if declared != given {
        return Err(format!(
            "the type has the results {declared:?}, the driver gave {given:?}"
        ));
    }

    start(&skill, &parameters()).await?;
    let asked = tokio::time::Instant::now();
    call(&skill, ProgramMethod::Halt).await?;
    let outcome = skill
        .shown()
        .outcome
        .clone()
        .ok_or("a halted run has no outcome")?;
    if outcome.message.contains("broken off") {
        return Err(format!(
            "the driver did not hear Halt within {:?}",
            asked.elapsed()
        ));
    }
    if skill.shown().state != ProgramMachineState::Halted {
        return Err(format!("after Halt the skill is {}", skill.shown().state));
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
            return Err(format!(
                "the work went on while it was suspended: {before} to {}",
                shown.progress
            ));
        }
        call(&skill, ProgramMethod::Resume).await?;
        let shown = until(&skill, |shown| shown.state != ProgramMachineState::Running).await?;
        let succeeded = shown
            .outcome
            .as_ref()
            .is_some_and(|outcome| outcome.run == shown.run && outcome.succeeded);
        if !succeeded {
            return Err("the run did not succeed after it was resumed".to_owned());
        }
        start(&skill, &parameters()).await?;
        call(&skill, ProgramMethod::Suspend).await?;
        call(&skill, ProgramMethod::Reset).await?;
    }
    let outcome = run(&skill, &parameters()).await?;
    if !outcome.succeeded {
        return Err(format!(
            "it does not work again after it was stopped: {}",
            outcome.message
        ));
    }
    Ok(())
}

/// Runs a driver of a skill type of the table once.
///
/// # Errors
/// The reason why there is no outcome, as text for people; a refusal with its code.
pub async fn run_once(
    skill_type: &str,
    driver: Arc<dyn Driver>,
    parameters: Vec<(String, SkillValue)>,
) -> Result<RunOutcome, String> {
    run(&skill(skill_type, driver)?, &parameters).await
}

fn skill(skill_type: &str, driver: Arc<dyn Driver>) -> Result<Skill, String> {
    let of = model::find(skill_type).ok_or_else(|| format!("there is no type {skill_type}"))?;
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

async fn run(skill: &Skill, parameters: &[(String, SkillValue)]) -> Result<RunOutcome, String> {
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
        .ok_or_else(|| "the run left no outcome".to_owned())
}

async fn start(skill: &Skill, parameters: &[(String, SkillValue)]) -> Result<(), String> {
    if skill.shown().state == ProgramMachineState::Halted {
        call(skill, ProgramMethod::Reset).await?;
    }
    skill
        .start_with(BY, parameters.to_vec())
        .await
        .map_err(|refusal| refusal.to_string())?;
    Ok(())
}

async fn call(skill: &Skill, method: ProgramMethod) -> Result<(), String> {
    let taken = skill.call(BY, method).await;
    taken
        .map(drop)
        .map_err(|refusal| format!("{method} is refused: {refusal}"))
}

async fn until(
    skill: &Skill,
    is: impl FnMut(&Arc<SkillSnapshot>) -> bool,
) -> Result<Arc<SkillSnapshot>, String> {
    let mut watch = skill.watch();
    match tokio::time::timeout(WAIT, watch.wait_for(is)).await {
        Ok(Ok(shown)) => Ok(Arc::clone(&shown)),
        Ok(Err(_)) => Err("the skill has ended".to_owned()),
        Err(_) => Err(format!("the run does not end within {WAIT:?}")),
    }
}
