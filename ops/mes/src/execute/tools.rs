//! The tools that are attached in a run.

use skills::SkillValue;

use super::sequence::{RunProgress, StepEnd};
use super::{Chosen, Offer, Process, ProcessStep, SkillRole};
use crate::plan::{AttachedTools, TOOL, ToolFault, ToolStep, ToolUser, ToolWork};

/// The result of a skill that changes tools: the ApplicationUri of the attached tool.
const ATTACHED: &str = "Tool";

/// Returns the tool that parameters name.
pub(super) fn named(values: &[(String, SkillValue)]) -> Option<String> {
    text(values, TOOL)
}

fn text(values: &[(String, SkillValue)], name: &str) -> Option<String> {
    let mut values = values.iter();
    let (_, value) = values.find(|(known, _)| known == name)?;
    value.as_str().map(str::to_owned)
}

impl Chosen {
    /// Returns the components that a step uses: that of its skill, and the tools that it changes.
    pub(super) fn uses(&self, number: usize, tools: &AttachedTools) -> Vec<String> {
        let mut open = self.open.iter();
        let of_step = open.find(|(role, _)| *role == SkillRole::Alone(number));
        let Some((_, offer)) = of_step else {
            return Vec::new();
        };
        let mut uses = vec![offer.component.clone()];
        if ToolWork::of(offer).is_some() {
            uses.extend(tools.at(&offer.component).map(str::to_owned));
            let given = self.steps.get(number).map(|step| &step.parameters);
            let named = given.into_iter().flatten().find(|given| given.name == TOOL);
            uses.extend(
                named
                    .and_then(|given| given.value.as_str())
                    .map(str::to_owned),
            );
        }
        uses
    }
}

/// Checks that the tools that are attached allow the component of a step to do it.
///
/// # Errors
/// The reason why it must not.
pub(super) fn check(
    process: &Process,
    (number, step): (usize, &ProcessStep),
    (chosen, offer): (&Chosen, &Offer),
    progress: &RunProgress,
) -> Result<(), ToolFault> {
    if ToolWork::of(offer).is_some() {
        return Ok(());
    }
    let able = chosen.able.get(&number).cloned().unwrap_or_default();
    let user = ToolUser {
        number,
        by: step.by,
        behind: &process.behind(number),
        able: &able,
        loops: &process.loops,
    };
    progress.tools.check(&user, &offer.component)
}

/// Records the effect of a step or compensation that has ended. `tool` is the tool that its
/// parameters named; the result of the skill comes before it.
pub(super) fn ended(
    process: &Process,
    (number, offer, tool): (usize, &Offer, Option<String>),
    end: &StepEnd,
    tools: &mut AttachedTools,
) {
    let Some(work) = ToolWork::of(offer) else {
        return;
    };
    let step = ToolStep {
        number,
        name: process
            .step(number)
            .map(|step| step.name.clone())
            .unwrap_or_default(),
    };
    let changer = &offer.component;
    let results = match end {
        StepEnd::Done(results) => results,
        // The step has not begun.
        StepEnd::Unresolved(_) | StepEnd::Outdated(_) | StepEnd::Lost(_) => return,
        StepEnd::Failed(_) | StepEnd::TimedOut(_) | StepEnd::Stopped(_) | StepEnd::LostInRun(_) => {
            tools.lose(changer, tool, step);
            return;
        }
    };
    match (work, text(results, ATTACHED).or(tool)) {
        (ToolWork::Detach, None) => tools.detach(changer, &step),
        (_, Some(none)) if none.is_empty() => tools.detach(changer, &step),
        (_, Some(tool)) => tools.attach(changer, Some(tool), step),
        (ToolWork::Attach, None) => tools.lose(changer, None, step),
    }
}
