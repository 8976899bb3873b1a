//! Compensation: the completed steps of a run that failed are undone, the last one first.

use skills::SkillValue;
use tracing::{info, warn};

use super::sequence::RunProgress;
use super::{Execution, Plant, StepEnd, close, tools};
use crate::parameter_fault::{GivenFault, ParameterFault};
use crate::plan::{AttachedTools, KeptStep, Offer, Plan};
use crate::process::{GivenParameter, Process, ProcessStep};
use crate::record::{How, Planned, ProcessRun};

/// A completed step.
#[derive(Debug, Clone)]
pub(super) struct Done {
    pub(super) number: usize,
    /// The step with the values of its queries, as the plan used them.
    pub(super) step: ProcessStep,
    pub(super) offer: Offer,
    /// The skill of its compensation, if it has one.
    pub(super) undo: Option<Offer>,
    pub(super) results: Vec<(String, SkillValue)>,
    /// It was done in an earlier round of a loop, and the present round does it again.
    pub(super) is_earlier: bool,
}

/// Returns the choices that later plans keep: for completed steps and for their compensations.
/// Steps that are done again are chosen again.
pub(super) fn kept(process: &Process, done: &[Done]) -> Vec<KeptStep> {
    let one = |done: &Done| {
        let undo = done.undo.clone().map(|offer| KeptStep {
            number: process.compensation_of(done.number),
            offer,
        });
        let step = KeptStep {
            number: done.number,
            offer: done.offer.clone(),
        };
        std::iter::once(step).chain(undo).collect::<Vec<_>>()
    };
    let current = done.iter().filter(|done| !done.is_earlier);
    current.flat_map(one).collect()
}

/// Returns the parameters of a step, with the results of completed steps and of queries in them.
///
/// # Errors
/// The result that a step did not return, or the query without a value.
pub(super) async fn resolved(
    plant: &dyn Plant,
    step: &ProcessStep,
    done: &[&Done],
) -> Result<Vec<GivenParameter>, ParameterFault> {
    let one = |given: &GivenParameter| -> Result<GivenParameter, ParameterFault> {
        let Some(of) = &given.result else {
            return Ok(given.clone());
        };
        let wrong = |why| ParameterFault::Given(given.name.clone(), why);
        let from = done.iter().find(|done| done.number == of.step);
        let from = from.ok_or_else(|| wrong(GivenFault::NotDone))?;
        let mut results = from.results.iter();
        let value = results.find(|(name, _)| *name == of.name);
        let (_, value) = value.ok_or_else(|| {
            wrong(GivenFault::NoResult {
                skill: from.offer.name.clone(),
                result: of.name.clone(),
            })
        })?;
        Ok(GivenParameter {
            name: given.name.clone(),
            value: value.to_json(),
            unit: plant.result(&from.offer.skill, &of.name)?,
            result: None,
            query: None,
        })
    };
    let mut all = Vec::new();
    for given in &step.parameters {
        all.push(match &given.query {
            Some(query) => given.evaluated(plant.query(query).await)?,
            None => one(given)?,
        });
    }
    Ok(all)
}

/// A completed step to compensate.
struct Undone<'a> {
    number: usize,
    step: &'a ProcessStep,
    compensation: &'a ProcessStep,
    /// The skill that runs the compensation.
    offer: &'a Offer,
    /// The completed steps up to this one: the results that the compensation may take.
    until: &'a [Done],
}

/// Returns the names of the completed steps that have no compensation, each of them once.
fn without_compensation(done: &[Done]) -> String {
    let mut names: Vec<String> = Vec::new();
    for done in done.iter().rev() {
        let is_undone = done.step.compensation.is_some() && done.undo.is_some();
        let name = format!("`{}`", done.step.name);
        if !is_undone && !names.contains(&name) {
            names.push(name);
        }
    }
    names.join(", ")
}

/// Returns the names of the completed steps.
fn names(steps: &[Undone<'_>]) -> String {
    let names = steps.iter().map(|one| format!("`{}`", one.step.name));
    names.collect::<Vec<_>>().join(", ")
}

impl Execution<'_> {
    /// Compensates the completed steps of a failed run, and adds the compensations to the reason.
    /// Completed steps that have none are named too, unless the caller stopped the run.
    ///
    /// Nothing is compensated after the caller stopped the run, and while the end of a skill is not
    /// confirmed: its machine may still move.
    pub(super) async fn compensated(&self, mut why: String, progress: &mut RunProgress) -> String {
        let is_stopped = self.is_stopped().await;
        let left = without_compensation(&progress.done);
        if !left.is_empty() && !is_stopped {
            why = format!("{why}; without a compensation: {left}");
        }
        let RunProgress { done, tools, .. } = progress;
        let undone = (1..=done.len()).rev().filter_map(|count| {
            let until = done.get(..count)?;
            let done = until.last()?;
            Some(Undone {
                number: done.number,
                step: &done.step,
                compensation: done.step.compensation.as_deref()?,
                offer: done.undo.as_ref()?,
                until,
            })
        });
        let undone: Vec<Undone<'_>> = undone.collect();
        if undone.is_empty() {
            return why;
        }
        let not = match (is_stopped, is_open(&self.log.run())) {
            (true, _) => Some("it was stopped"),
            (_, true) => Some("the end of a skill is not confirmed"),
            (false, false) => None,
        };
        if let Some(reason) = not {
            return format!(
                "{why}; not compensated, because {reason}: {}",
                names(&undone)
            );
        }
        let plan = Plan::of(undone.iter().map(|one| (one.compensation, one.offer)));
        self.log.change(|kept, now| {
            kept.run.waits_for = None;
            let number = kept.run.plans.len().saturating_add(1);
            kept.run.plans.push(Planned {
                compensates: true,
                ..Planned::begins(number, now, plan)
            });
        });
        match self.undo_all(&undone, tools).await {
            Ok(()) => {
                self.end(How::Done, None);
                format!("{why}; compensated: {}", names(&undone))
            }
            Err((reason, left)) => {
                self.end(How::Failed, Some(reason.clone()));
                let left = match left {
                    [] => String::new(),
                    left => format!("; not compensated: {}", names(left)),
                };
                format!("{why}; {reason}{left}")
            }
        }
    }

    /// Runs the compensations in order up to the first that fails. Returns its reason, and the
    /// steps after it.
    async fn undo_all<'a>(
        &self,
        undone: &'a [Undone<'a>],
        tools: &mut AttachedTools,
    ) -> Result<(), (String, &'a [Undone<'a>])> {
        let mut left = undone;
        while let [one, rest @ ..] = left {
            left = rest;
            let name = &one.step.name;
            if let Err(fault) = self.undo(one, tools).await {
                warn!(step = name, "the compensation of a step failed: {fault}");
                let reason = format!("the compensation of `{name}` failed: {fault}");
                return Err((reason, left));
            }
            info!(step = name, "a step is compensated");
        }
        Ok(())
    }

    /// Runs the skill of a compensation.
    async fn undo(&self, undone: &Undone<'_>, attached: &mut AttachedTools) -> Result<(), String> {
        let (step, offer) = (undone.compensation, undone.offer);
        let allows = attached.check_attached(&offer.component);
        allows.map_err(|fault| format!("{}: {fault}", offer.component_name))?;
        self.teller.step("Compensate").await;
        let opened = self.open(std::slice::from_ref(offer)).await;
        let (opened, skills) = opened.map_err(|fault| {
            let name = &offer.component_name;
            format!("{name} cannot be reached: {}", fault.why)
        })?;
        let ended = match skills.first() {
            // The results of the same round are the latest before it.
            Some(skill) => {
                let done: Vec<_> = undone.until.iter().rev().collect();
                match self.prepared(step, offer, &done).await {
                    Ok(values) => {
                        let tool = tools::named(&values);
                        let end = self.one(step, (offer, &**skill), values).await;
                        let number = self.process.compensation_of(undone.number);
                        tools::ended(self.process, (number, offer, tool), &end, attached);
                        end
                    }
                    Err(end) => end,
                }
            }
            None => StepEnd::Failed("its skill is gone".to_owned()),
        };
        close(opened).await;
        match ended {
            StepEnd::Done(_) => Ok(()),
            StepEnd::Failed(why)
            | StepEnd::TimedOut(why)
            | StepEnd::Outdated(why)
            | StepEnd::Lost(why)
            | StepEnd::LostInRun(why)
            | StepEnd::Stopped(why)
            | StepEnd::Unresolved(why) => Err(why),
        }
    }

    fn end(&self, outcome: How, reason: Option<String>) {
        self.log.change(|kept, now| {
            if let Some(plan) = kept.run.plan() {
                plan.end(now, outcome, reason);
            }
        });
    }

    /// Returns whether the caller has stopped the run.
    async fn is_stopped(&self) -> bool {
        tokio::select! {
            biased;
            () = self.teller.stopped() => true,
            () = std::future::ready(()) => false,
        }
    }
}

/// Returns whether the end of a skill is not confirmed.
fn is_open(run: &ProcessRun) -> bool {
    let mut ran = run.plans.iter().flat_map(|plan| &plan.ran);
    ran.any(|ran| matches!(ran.outcome, How::Running | How::Unknown | How::Lost))
}
