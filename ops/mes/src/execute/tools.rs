//! The tools that are attached in a run.

use std::collections::BTreeSet;
use std::sync::Arc;

use skills::{RunnableSkill, SkillValue};

use super::sequence::{RunProgress, StepEnd};
use super::{Chosen, Execution, Offer, Plant, Process, ProcessStep, SkillRole};
use crate::plan::{AttachedTools, ShownTools, TOOL, ToolFault, ToolStep, ToolUser, ToolWork};
use crate::process::By;

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

/// Returns the tools of the tool changers: those that the changers show, and the tools that the
/// steps of a process name. The tool of a changer that shows none is not known.
pub(super) fn shown(plant: &dyn Plant, process: &Process, offers: &[Offer]) -> ShownTools {
    let mut shown = plant.tools();
    let changers = offers.iter().filter(|offer| ToolWork::of(offer).is_some());
    for changer in changers {
        shown.attached.entry(changer.component.clone()).or_default();
    }
    let named = process.numbered().filter_map(|(_, step)| literal(step));
    shown.tools.extend(named.map(str::to_owned));
    shown
}

/// Returns the tool that the parameters of a step name; `None` if a result of a step names it.
fn literal(step: &ProcessStep) -> Option<&str> {
    let given = step.parameters.iter().find(|given| given.name == TOOL);
    let tool = given.and_then(|given| given.value.as_str());
    tool.filter(|tool| !tool.is_empty())
}

/// Returns the tools that the steps that are left attach or detach, and the tools of the changers
/// that do so: another run must not use them meanwhile.
///
/// The robots that carry the changers are among them: a changer moves its robot.
pub(super) fn used_by_steps(
    process: &Process,
    progress: &RunProgress,
    (chosen, plant): (&Chosen, &dyn Plant),
) -> BTreeSet<String> {
    let offers = chosen.open.iter().map(|(_, offer)| offer);
    let offers = offers.chain(chosen.undo.values());
    let changers = || {
        let changers = offers.clone();
        changers.filter(|offer| ToolWork::of(offer).is_some())
    };
    let at = changers().filter_map(|offer| progress.tools.at(&offer.component));
    let movers = changers().flat_map(|changer| movers(plant, changer));
    let passed = progress.passed_or_ruled_out(process);
    let steps = process.steps.iter().enumerate();
    let left = steps
        .filter(|(number, _)| !progress.is_over(*number) && !passed.contains(number))
        .flat_map(|(_, step)| std::iter::once(step).chain(step.compensation.as_deref()));
    let named = left.filter_map(literal);
    let tools = at.chain(named).map(str::to_owned);
    tools.chain(movers).collect()
}

impl Execution<'_> {
    /// Ends the leases on the robot that carries the tool changer of a step, because the changer
    /// moves this robot.
    ///
    /// # Errors
    /// The end of the step, which must not begin: it was stopped, or the end of a lease is not
    /// confirmed.
    pub(super) async fn release_movers(
        &self,
        changer: &Offer,
        (chosen, skills): (&Chosen, &[Arc<dyn RunnableSkill>]),
    ) -> Result<(), StepEnd> {
        if ToolWork::of(changer).is_none() {
            return Ok(());
        }
        let mut released = BTreeSet::new();
        for ((_, offer), skill) in chosen.open.iter().zip(skills) {
            if !is_mover(self.plant, offer, changer) || !released.insert(&offer.component) {
                continue;
            }
            let released = self.unless_stopped(skill.release()).await;
            let released = released.map_err(StepEnd::Stopped)?;
            released.map_err(|fault| {
                let (changer, robot) = (&changer.component_name, &offer.component_name);
                let why = "which has to move it, because the end of its lease is not confirmed";
                StepEnd::Failed(format!("{robot} is not left to {changer}, {why}: {fault}"))
            })?;
        }
        Ok(())
    }
}

/// Returns the components that move the tool changer of an offer.
fn movers(plant: &dyn Plant, changer: &Offer) -> BTreeSet<String> {
    let offers = plant.offers().into_iter();
    let movers = offers.filter(|of| is_mover(plant, of, changer));
    movers.map(|of| of.component).collect()
}

/// Returns whether the component of an offer moves the tool changer of another.
fn is_mover(plant: &dyn Plant, offer: &Offer, changer: &Offer) -> bool {
    offer.component != changer.component && plant.moves(&offer.component, &changer.component)
}

impl Chosen {
    /// Returns the components that a step uses: that of its skill, and, if it changes a tool, the
    /// tools and the robot that carries the changer.
    pub(super) fn uses(
        &self,
        number: usize,
        (tools, plant): (&AttachedTools, &dyn Plant),
    ) -> Vec<String> {
        let mut open = self.open.iter();
        let of_step = open.find(|(role, _)| *role == SkillRole::Alone(number));
        let Some((_, offer)) = of_step else {
            return Vec::new();
        };
        let mut uses = vec![offer.component.clone()];
        if ToolWork::of(offer).is_some() {
            uses.extend(tools.at(&offer.component).map(str::to_owned));
            let step = self.steps.get(number);
            uses.extend(step.and_then(literal).map(str::to_owned));
            uses.extend(movers(plant, offer));
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
    (progress, offers): (&RunProgress, &dyn Fn() -> Vec<Offer>),
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
    progress.tools.check(&user, &offer.component)?;
    // A tool that gets its power from its changer enters the graph after it is attached.
    let is_new = |tool: &&str| *tool != offer.component && !chosen.known.contains(*tool);
    if let (Some(tool), By::Any) = (progress.tools.tool_for(&user).filter(is_new), step.by)
        && offers()
            .iter()
            .any(|of| of.component == tool && step.may_be_done_by(of))
    {
        let tool = BTreeSet::from([tool.to_owned()]);
        let user = ToolUser {
            able: &tool,
            ..user
        };
        return progress.tools.check(&user, &offer.component);
    }
    Ok(())
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
    match (work, text(results, ATTACHED).or_else(|| tool.clone())) {
        (ToolWork::Detach, _) => tools.detach(changer, &step),
        (ToolWork::Attach, Some(shown)) if !shown.is_empty() => {
            tools.attach(changer, Some(shown), step);
        }
        // Servers of others leave the result empty: the named tool may be attached.
        (ToolWork::Attach, _) => {
            let named = tool.filter(|tool| !tool.is_empty());
            tools.lose(changer, named, step);
        }
    }
}
