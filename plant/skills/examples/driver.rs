//! A skill with an own driver, run once and then halted in its second run.
//!
//! The driver stands for a gripper whose fingers need two seconds to close. It reports steps and
//! progress, and stops when the skill is halted.

#![expect(clippy::print_stdout, reason = "the outcomes are its output")]

use std::{error::Error, sync::Arc, time::Duration};

use program::{ProgramMachineState, ProgramMethod};
use skills::{
    Authority, Driver, DriverError, ParameterType, RunResults, Skill, SkillDescription, SkillOwner,
    SkillSnapshot, SkillValue, Work, model,
};

const OPERATOR: SkillOwner = SkillOwner::Local("the example");

struct Fingers;

#[async_trait::async_trait]
impl Driver for Fingers {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let force = work.parameters().number("Force").unwrap_or_default();
        work.step(format!("closing with {force} N")).await;
        for tenth in 1..=10_u8 {
            // Ends with an error on Halt; a real driver stops the machine here.
            work.spend(Duration::from_millis(200)).await?;
            work.progress(f32::from(tenth) / 10.0);
        }
        Ok(vec![("Gripped".to_owned(), SkillValue::from(true))])
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let of = model::find("GraspSkillType").ok_or("the type is not in the model")?;
    let facts = SkillDescription {
        name: "Grasp".to_owned(),
        types: of.chain().map(|of| ParameterType::own(of.name)).collect(),
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: Some(Duration::from_secs(10)),
        rests_in: of.rests_in,
    };
    let skill = Skill::spawn(facts, Arc::new(Fingers), Authority::new(), Vec::new());

    let force = vec![("Force".to_owned(), SkillValue::from(20.0))];
    let run = skill.execute(OPERATOR, force.clone(), None).await?;
    show(&ended(&skill, run).await?);

    let run = skill.execute(OPERATOR, force, None).await?;
    skill.call(OPERATOR, ProgramMethod::Halt).await?;
    show(&ended(&skill, run).await?);
    skill.close().await;
    Ok(())
}

/// Waits for the end of a run.
async fn ended(skill: &Skill, run: u32) -> Result<SkillSnapshot, Box<dyn Error>> {
    let mut watch = skill.watch();
    let shown = watch.wait_for(|shown| {
        shown.run == run
            && matches!(
                shown.state,
                ProgramMachineState::Ready | ProgramMachineState::Halted
            )
    });
    Ok(SkillSnapshot::clone(&*shown.await?))
}

fn show(shown: &SkillSnapshot) {
    if let Some(outcome) = &shown.outcome {
        println!(
            "run {}: {:?}: {}",
            outcome.run, shown.state, outcome.message
        );
        for line in &outcome.trace {
            println!("  {line}");
        }
        for (name, value) in &outcome.results {
            println!("  {name} = {}", value.to_json());
        }
    }
}
