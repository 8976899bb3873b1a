//! Skills whose runs are recorded.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use skills::{GripPoint, RunOutcome, RunnableSkill, SkillFault, SkillValue};
use tokio::time::Instant;

use super::Log;
use crate::plan::{Fallen, Offer};
use crate::process::{Process, StepJob};
use crate::record::{How, RecordValues, SkillRun, recorded};

/// A skill that records its runs in the log.
pub(super) struct RecordedSkill {
    inner: Arc<dyn RunnableSkill>,
    offer: Offer,
    process: Process,
    log: Arc<Log>,
    /// Whether the run was halted because of another skill, which says nothing against this one.
    is_halted: AtomicBool,
}

impl RecordedSkill {
    pub(super) fn new(
        inner: Arc<dyn RunnableSkill>,
        offer: &Offer,
        log: &Arc<Log>,
        process: &Process,
    ) -> Self {
        Self {
            inner,
            offer: offer.clone(),
            log: Arc::clone(log),
            process: process.clone(),
            is_halted: AtomicBool::new(false),
        }
    }

    fn begins(&self, parameters: RecordValues) {
        self.log.change(|kept, now| {
            let step = kept.step.clone();
            if let Some(plan) = kept.run.plan() {
                let of = match plan.compensates {
                    true => undone_step(&self.process, &step),
                    false => of_step(&self.process, &step),
                };
                plan.ran.push(SkillRun {
                    step,
                    of,
                    skill: self.offer.skill.clone(),
                    component: self.offer.component.clone(),
                    parameters,
                    results: RecordValues::new(),
                    started_ms: now,
                    ended_ms: None,
                    outcome: How::Running,
                    reason: None,
                });
            }
        });
    }

    fn ends(&self, outcome: How, reason: Option<String>, results: RecordValues) {
        self.log.change(|kept, now| {
            let is_this = |ran: &&mut SkillRun| ran.is_running() && ran.skill == self.offer.skill;
            if let Some(ran) = kept
                .run
                .plan()
                .and_then(|plan| plan.ran.iter_mut().rev().find(is_this))
            {
                ran.ended_ms = (outcome != How::Unknown).then_some(now);
                ran.outcome = outcome;
                ran.reason = reason;
                ran.results = results;
            }
        });
    }

    /// Records that the end of the run is unknown.
    fn unknown(&self, why: &str) {
        self.ends(How::Unknown, Some(why.to_owned()), RecordValues::new());
    }

    /// Records the loss of the component. The end of a run that was halted before is unknown: the
    /// Halt is not confirmed.
    fn went(&self, why: &str) {
        if self.is_halted.load(Ordering::Relaxed) {
            self.unknown(why);
        }
        self.fell(true, why);
    }

    fn fell(&self, is_lost: bool, why: &str) {
        let skill = (!is_lost).then(|| self.offer.skill.clone());
        let why = if is_lost {
            format!("it was lost in this run: {why}")
        } else {
            format!("it failed in this run: {why}")
        };
        self.log.fell(Fallen {
            component: self.offer.component.clone(),
            since_ms: self.offer.since_ms,
            skill,
            why,
        });
    }
}

#[async_trait]
impl RunnableSkill for RecordedSkill {
    fn grip_point(&self) -> Option<GripPoint> {
        self.inner.grip_point()
    }

    fn name(&self) -> String {
        self.inner.name()
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        self.is_halted.store(false, Ordering::Relaxed);
        self.begins(recorded(&parameters));
        let began = Instant::now();
        let outcome = self.inner.run(parameters, within).await;
        match &outcome {
            Ok(outcome) if outcome.succeeded => {
                self.ends(How::Done, None, recorded(&outcome.results));
            }
            Ok(outcome) if outcome.unknown => self.unknown(&outcome.message),
            Ok(_) if self.is_halted.load(Ordering::Relaxed) => {
                self.ends(How::Stopped, None, RecordValues::new());
            }
            Ok(outcome) => {
                self.fell(false, &outcome.message);
                self.ends(
                    How::Failed,
                    Some(outcome.message.clone()),
                    RecordValues::new(),
                );
            }
            Err(SkillFault::Lost(why)) => self.went(why),
            Err(fault) if may_go_on(fault, began.elapsed() >= within) => {
                self.unknown(&fault.to_string());
            }
            Err(fault) => {
                self.fell(false, &fault.to_string());
                self.ends(How::Failed, Some(fault.to_string()), RecordValues::new());
            }
        }
        outcome
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        self.is_halted.store(true, Ordering::Relaxed);
        self.inner.halt().await
    }

    async fn release(&self) -> Result<(), SkillFault> {
        self.inner.release().await
    }

    async fn lost(&self) -> String {
        let why = self.inner.lost().await;
        self.went(&why);
        why
    }
}

/// Returns whether a run may go on after a fault. `is_late` is true if the time of the run was
/// over: a refusal can then be the refusal of its Halt.
const fn may_go_on(fault: &SkillFault, is_late: bool) -> bool {
    match fault {
        // The run may have been started, and its end was not seen.
        SkillFault::NotHalted(_) | SkillFault::Lost(_) | SkillFault::Unexpected(_) => true,
        SkillFault::Refused { .. } => is_late,
        // The Halt was confirmed.
        SkillFault::TimedOut(_) => false,
    }
}

/// Returns the step of the process that contains a step of the composite: picking, up to the lift
/// of the object, or placing.
fn of_step(process: &Process, step: &str) -> String {
    let is_picking = step.starts_with("MovePick") || matches!(step, "Init" | "Grasp");
    let of = match (&process.work, process.steps.as_slice()) {
        (StepJob::PickAndPlace(_), [picks, .., places]) => {
            if is_picking {
                Some(picks)
            } else {
                Some(places)
            }
        }
        (StepJob::PickAndPlace(_), [all]) => Some(all),
        (StepJob::PickAndPlace(_), []) | (StepJob::Sequence, _) => None,
    };
    of.map_or_else(|| step.to_owned(), |of| of.name.clone())
}

/// Returns the step that a compensation undoes.
fn undone_step(process: &Process, compensation: &str) -> String {
    let mut steps = process.steps.iter();
    let of = steps.find(|step| {
        let undo = step.compensation.as_deref();
        undo.is_some_and(|undo| undo.name == compensation)
    });
    of.map_or(compensation, |step| &step.name).to_owned()
}
