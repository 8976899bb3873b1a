//! The steps of a sequence: each begins when the steps that it waits for are over, and its
//! conditions hold. Steps that do not wait for each other run in parallel. The steps of a loop are
//! done again, by a plan of their own, while its conditions hold.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use futures_util::stream::{FuturesUnordered, StreamExt as _};
use skills::{PartEnd, RunnableSkill, SkillFault, SkillValue, run_part};
use tracing::info;

use super::compensate::{self, Done};
use super::tools;
use super::{Chosen, Ended, Execution, Fallen, Offer, ProcessStep, SkillRole};
use crate::plan::{AttachedTools, TOOL};
use crate::process::{BadEnd, Incomparable, Loop, Process, StepCondition, Test};

/// The steps of a run that are over.
#[derive(Debug, Default)]
pub(super) struct RunProgress {
    /// In the order in which they ended.
    pub(super) done: Vec<Done>,
    /// The other steps, by their numbers.
    pub(super) passed: BTreeMap<usize, Passed>,
    /// The completed rounds of loops whose steps are done again, by the numbers of the loops.
    rounds: BTreeMap<usize, u32>,
    /// The completed rounds of all loops after which another one began.
    all_rounds: u32,
    /// The loops after their last round.
    left: BTreeSet<usize>,
    /// The tools that the steps and compensations have attached and detached.
    pub(super) tools: AttachedTools,
}

/// The reason why the process goes on behind a step that is not done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Passed {
    /// Its conditions did not hold.
    Skipped,
    /// Other steps handle its end, which is confirmed.
    Ended(BadEnd),
}

impl RunProgress {
    pub(super) fn is_over(&self, number: usize) -> bool {
        self.passed.contains_key(&number) || self.current().any(|done| done.number == number)
    }

    /// Returns whether all steps are over, in the last round of each loop.
    fn is_complete(&self, process: &Process) -> bool {
        let mut steps = 0..process.steps.len();
        let mut loops = 0..process.loops.len();
        steps.all(|step| self.is_over(step)) && loops.all(|number| self.left.contains(&number))
    }

    /// Returns the completed steps, without the steps of earlier rounds.
    pub(super) fn current(&self) -> impl Iterator<Item = &Done> {
        self.done.iter().filter(|done| !done.is_earlier)
    }

    /// Returns whether a step need not wait for another step any longer: the other step is over,
    /// and no other round does it again.
    fn is_behind(&self, process: &Process, (step, other): (usize, usize)) -> bool {
        let mut loops = process.loops.iter().enumerate();
        let is_last = |(number, one): (usize, &Loop)| {
            let is_outside = one.steps.contains(&other) && !one.steps.contains(&step);
            !is_outside || self.left.contains(&number)
        };
        self.is_over(other) && loops.all(is_last)
    }

    /// Begins the next round of a loop whose steps are over, if one is due. Returns whether it did.
    ///
    /// # Errors
    /// The condition that cannot be decided, or the maximum number of rounds.
    pub(super) fn next_round(&mut self, process: &Process) -> Result<bool, ConditionFault> {
        loop {
            let mut loops = process.loops.iter().enumerate();
            let over = loops.find(|(number, one)| {
                let is_inner = |(_, other): &(usize, &Loop)| other.is_within(one);
                let mut inner = process.loops.iter().enumerate().filter(is_inner);
                !self.left.contains(number)
                    && one.steps.iter().all(|step| self.is_over(*step))
                    && inner.all(|(inner, _)| self.left.contains(&inner))
            });
            let Some((number, over)) = over else {
                return Ok(false);
            };
            let first = over.steps.first().and_then(|step| process.steps.get(*step));
            let name = first.map_or("", |step| step.name.as_str());
            let is_due = self.holds_one(process, &over.again);
            let is_due = is_due.map_err(|fault| ConditionFault::Loop {
                first: name.to_owned(),
                fault: Box::new(fault),
            });
            if !is_due? {
                self.left.insert(number);
                continue;
            }
            let rounds = self.rounds.entry(number).or_default();
            *rounds = rounds.saturating_add(1);
            if *rounds >= over.rounds {
                return Err(ConditionFault::Rounds {
                    first: name.to_owned(),
                    rounds: *rounds,
                });
            }
            if self.all_rounds >= Loop::MOST_ROUNDS_OF_RUN {
                return Err(ConditionFault::AllRounds {
                    first: name.to_owned(),
                    rounds: self.all_rounds,
                });
            }
            self.all_rounds = self.all_rounds.saturating_add(1);
            info!(step = name, rounds, "another round of a loop begins");
            self.repeat(process, over);
            return Ok(true);
        }
    }

    /// Makes the steps of a loop, and the loops within it, begin again.
    fn repeat(&mut self, process: &Process, over: &Loop) {
        for done in &mut self.done {
            done.is_earlier |= over.steps.contains(&done.number);
        }
        self.passed.retain(|step, _| !over.steps.contains(step));
        self.tools.repeat(&over.steps);
        for (number, inner) in process.loops.iter().enumerate() {
            if inner.is_within(over) {
                self.left.remove(&number);
                self.rounds.remove(&number);
            }
        }
    }

    /// Returns the steps that are passed, or are not over and will be skipped in this round: each
    /// of their alternatives has a condition that is decided and does not hold.
    pub(super) fn passed_or_ruled_out(&self, process: &Process) -> Vec<usize> {
        let steps = process.steps.iter().enumerate();
        let is_passed = |(number, step): &(usize, &ProcessStep)| {
            self.passed.contains_key(number)
                || (!self.is_over(*number) && self.is_ruled_out(process, (*number, step)))
        };
        steps.filter(is_passed).map(|(number, _)| number).collect()
    }

    fn is_ruled_out(&self, process: &Process, (number, step): (usize, &ProcessStep)) -> bool {
        let does_not_hold = |alternative: &Vec<StepCondition>| {
            for condition in alternative {
                let is_decided = self.is_behind(process, (number, condition.step));
                match self.holds(process, condition) {
                    Ok(true) if is_decided => {}
                    Ok(false) if is_decided => return true,
                    // The fault ends the run when the step is due.
                    Ok(_) | Err(_) => return false,
                }
            }
            false
        };
        !step.when.is_empty() && step.when.iter().all(does_not_hold)
    }

    /// Returns whether a step is not skipped: it has no alternatives, or one of them holds.
    ///
    /// # Errors
    /// The condition that cannot be decided.
    fn allows(&self, process: &Process, step: &ProcessStep) -> Result<bool, ConditionFault> {
        match step.when.is_empty() {
            true => Ok(true),
            false => self.holds_one(process, &step.when),
        }
    }

    /// Returns whether all conditions of one of the alternatives hold.
    fn holds_one(
        &self,
        process: &Process,
        all: &[Vec<StepCondition>],
    ) -> Result<bool, ConditionFault> {
        for alternative in all {
            let mut holds = true;
            // The conditions of an outer branch come first: an inner condition is not decidable
            // when its branch was not taken.
            for condition in alternative {
                if !self.holds(process, condition)? {
                    holds = false;
                    break;
                }
            }
            if holds {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn holds(&self, process: &Process, condition: &StepCondition) -> Result<bool, ConditionFault> {
        let test = match &condition.test {
            Test::Ended(end) => self.passed.get(&condition.step) == Some(&Passed::Ended(*end)),
            Test::Result {
                name,
                compare,
                value,
            } => {
                let of = process.steps.get(condition.step);
                let step = || of.map_or_else(String::new, |step| step.name.clone());
                let done = self.current().find(|done| done.number == condition.step);
                let done = done.ok_or_else(|| ConditionFault::NotDone {
                    step: step(),
                    result: name.clone(),
                })?;
                let mut results = done.results.iter();
                let result = results.find(|(known, _)| known == name);
                let (_, result) = result.ok_or_else(|| ConditionFault::NoResult {
                    step: step(),
                    result: name.clone(),
                })?;
                let holds = compare.holds(&result.to_json(), value);
                holds.map_err(|fault| ConditionFault::Incomparable {
                    step: step(),
                    result: name.clone(),
                    fault,
                })?
            }
        };
        Ok(test != condition.is_negated)
    }
}

/// The reason why a run cannot decide about a step or another round of a loop, or must not begin
/// the round. `first` is the first step of the loop.
#[derive(Debug, thiserror::Error)]
pub(super) enum ConditionFault {
    #[error("`{step}` is not done, and has no {result}")]
    NotDone { step: String, result: String },
    #[error("`{step}` returned no result {result}")]
    NoResult { step: String, result: String },
    #[error("{result} of `{step}`: {fault}")]
    Incomparable {
        step: String,
        result: String,
        fault: Incomparable,
    },
    #[error("the loop of `{first}`: {fault}")]
    Loop { first: String, fault: Box<Self> },
    #[error("the loop of `{first}` has had {rounds} rounds, its maximum, and another one is due")]
    Rounds { first: String, rounds: u32 },
    #[error(
        "the loops of the process have had {rounds} rounds in all, the maximum of a run, \
         and another one of `{first}` is due"
    )]
    AllRounds { first: String, rounds: u32 },
}

/// The end of a step.
pub(super) enum StepEnd {
    /// With its results.
    Done(Vec<(String, SkillValue)>),
    /// The caller stopped the run.
    Stopped(String),
    /// An earlier step did not return a result.
    Unresolved(String),
    /// It has not begun, because its plan does not apply any longer.
    Outdated(String),
    Failed(String),
    /// It was halted after its time limit.
    TimedOut(String),
    /// Its component is lost.
    Lost(String),
    /// Its component is lost, and its skill may go on.
    LostInRun(String),
}

/// A step that can begin: its number, and its place among the chosen skills.
type Ready = (usize, usize);

impl Execution<'_> {
    /// Runs the steps that are not over. When a step fails, no other step begins, and the running
    /// steps are awaited. The queries of a step are evaluated while other steps run.
    pub(super) async fn sequence(
        &self,
        chosen: &Chosen,
        skills: &[Arc<dyn RunnableSkill>],
        progress: &mut RunProgress,
    ) -> Ended {
        let mut preparing = FuturesUnordered::new();
        let mut running = FuturesUnordered::new();
        let mut begun: BTreeMap<usize, &str> = BTreeMap::new();
        let mut ended = Ended::Done;
        loop {
            while matches!(ended, Ended::Done) && !*self.paused.borrow() {
                let (number, place) = match self.next(chosen, &begun, &mut *progress) {
                    Ok(Some(ready)) => ready,
                    Ok(None) => break,
                    Err(end) => {
                        ended = end;
                        break;
                    }
                };
                let (Some((_, offer)), Some(skill), Some(step)) = (
                    chosen.open.get(place),
                    skills.get(place),
                    chosen.steps.get(number),
                ) else {
                    ended = Ended::Over("the plan has another step than the process".to_owned());
                    break;
                };
                begun.insert(number, &offer.component);
                let done: Vec<Done> = progress.current().cloned().collect();
                preparing.push(async move {
                    let done: Vec<&Done> = done.iter().collect();
                    let of_step = (step, offer, &done[..]);
                    let values = self.prepared_alone(of_step, (chosen, skills)).await;
                    (number, (step, offer, skill), values)
                });
            }
            if !matches!(ended, Ended::Done) {
                preparing.clear();
            }
            let is_left = !progress.is_complete(self.process);
            let is_paused = *self.paused.borrow() && matches!(ended, Ended::Done) && is_left;
            let (number, offer, end) = tokio::select! {
                biased;
                Some((number, (step, offer, skill), values)) = preparing.next() => match values {
                    // It is prepared again when steps may begin.
                    Ok(_) if *self.paused.borrow() => {
                        begun.remove(&number);
                        continue;
                    }
                    Ok(values) => {
                        running.push(async move {
                            self.teller.step("Step").await;
                            let tool = tools::named(&values);
                            let end = self.one(step, (offer, &**skill), values).await;
                            (number, (offer, tool), end)
                        });
                        continue;
                    }
                    Err(end) => (number, offer, end),
                },
                Some((number, (offer, tool), end)) = running.next() => {
                    let begun = (number, offer, tool);
                    tools::ended(self.process, begun, &end, &mut progress.tools);
                    (number, offer, end)
                }
                () = self.resumed(), if is_paused => continue,
                // A step that runs or is prepared ends by itself when the run is stopped.
                () = self.teller.stopped(),
                    if is_paused && running.is_empty() && preparing.is_empty() =>
                {
                    ended = Ended::Over("stopped".to_owned());
                    break;
                }
                else => break,
            };
            begun.remove(&number);
            self.over((number, offer), end, (chosen, &mut *progress), &mut ended);
        }
        if matches!(ended, Ended::Done) && !progress.is_complete(self.process) {
            return Ended::Over("steps of the process wait for each other".to_owned());
        }
        ended
    }

    /// Completes when steps may begin.
    async fn resumed(&self) {
        let mut paused = self.paused.clone();
        if paused.wait_for(|is_paused| !is_paused).await.is_err() {
            // The sender of Resume was dropped: the run can only be stopped.
            std::future::pending::<()>().await;
        }
    }

    /// Returns a step that can begin.
    ///
    /// # Errors
    /// The end of the plan: another round of a loop, or the reason why the process cannot go on.
    fn next(
        &self,
        chosen: &Chosen,
        begun: &BTreeMap<usize, &str>,
        progress: &mut RunProgress,
    ) -> Result<Option<Ready>, Ended> {
        loop {
            let is_due = progress.next_round(self.process);
            if is_due.map_err(|fault| Ended::Over(fault.to_string()))? {
                return Err(Ended::Round);
            }
            let skipped = progress.passed.len();
            let ready = self.ready(chosen, begun, progress)?;
            // A skipped step may be the last one of its round.
            if ready.is_some() || progress.passed.len() == skipped {
                return Ok(ready);
            }
        }
    }

    /// Returns a step that can begin. Steps whose conditions do not hold are skipped. A component
    /// does one step at a time, and a tool does none while it is attached or detached.
    ///
    /// # Errors
    /// The end of the plan: the step was planned for another tool than the attached one, or the
    /// reason why the process cannot go on.
    fn ready(
        &self,
        chosen: &Chosen,
        begun: &BTreeMap<usize, &str>,
        progress: &mut RunProgress,
    ) -> Result<Option<Ready>, Ended> {
        let other_step = || Ended::Over("the plan has another step than the process".to_owned());
        let busy: BTreeSet<String> = begun
            .keys()
            .flat_map(|number| chosen.uses(*number, (&progress.tools, self.plant)))
            .collect();
        for (number, step) in self.process.steps.iter().enumerate() {
            let mut waits = step.waits_for(number).into_iter();
            let is_waiting = waits.any(|other| !progress.is_behind(self.process, (number, other)));
            if progress.is_over(number) || begun.contains_key(&number) || is_waiting {
                continue;
            }
            let allows = progress.allows(self.process, step);
            if !allows.map_err(|why| Ended::Over(format!("{}: {why}", step.name)))? {
                info!(
                    step = step.name,
                    "a step is skipped: its conditions do not hold"
                );
                progress.passed.insert(number, Passed::Skipped);
                continue;
            }
            let mut open = chosen.open.iter();
            let place = open.position(|(role, _)| *role == SkillRole::Alone(number));
            let place = place.ok_or_else(other_step)?;
            let (_, offer) = chosen.open.get(place).ok_or_else(other_step)?;
            let mut uses = chosen
                .uses(number, (&progress.tools, self.plant))
                .into_iter();
            if uses.any(|component| busy.contains(&component)) {
                continue;
            }
            let offers = || self.plant.offers();
            let of_step = (number, step);
            let checked = tools::check(self.process, of_step, (chosen, offer), (progress, &offers));
            checked.map_err(|fault| {
                let (name, component) = (&step.name, &offer.component_name);
                Ended::OtherTool(format!("{name}: {component}: {fault}"))
            })?;
            return Ok(Some((number, place)));
        }
        Ok(None)
    }

    /// Records the end of a step.
    fn over(
        &self,
        (number, offer): (usize, &Offer),
        end: StepEnd,
        (chosen, progress): (&Chosen, &mut RunProgress),
        ended: &mut Ended,
    ) {
        // The machine of a step whose end is unknown may move: no other step handles it.
        let handled = |end| {
            let is_known = !self.log.run().is_unknown();
            is_known && self.process.handles(number, end)
        };
        let (bad, why) = match end {
            StepEnd::Done(results) => {
                let step = chosen
                    .steps
                    .get(number)
                    .or_else(|| self.process.steps.get(number));
                progress.done.push(Done {
                    number,
                    step: step.cloned().unwrap_or_default(),
                    offer: offer.clone(),
                    undo: chosen.undo.get(&number).cloned(),
                    results,
                    is_earlier: false,
                });
                return;
            }
            StepEnd::Failed(why) => (Some(BadEnd::Failed), Ended::Broken(why)),
            StepEnd::TimedOut(why) if self.process.handles(number, BadEnd::TimedOut) => {
                (Some(BadEnd::TimedOut), Ended::Broken(why))
            }
            StepEnd::TimedOut(why) => (Some(BadEnd::Failed), Ended::Broken(why)),
            StepEnd::Lost(why) | StepEnd::Outdated(why) => (None, Ended::Broken(why)),
            // Another component must not repeat the step.
            StepEnd::Stopped(why) | StepEnd::Unresolved(why) | StepEnd::LostInRun(why) => {
                (None, Ended::Over(why))
            }
        };
        if let Some(bad) = bad.filter(|bad| handled(*bad)) {
            info!(
                step = number,
                end = bad.name(),
                "other steps handle the end of a step"
            );
            progress.passed.insert(number, Passed::Ended(bad));
            return;
        }
        ended.and(why);
    }

    /// Returns the parameters of a step like [`Self::prepared`], after the leases on a robot that
    /// its tool changer moves have ended.
    async fn prepared_alone(
        &self,
        (step, offer, done): (&ProcessStep, &Offer, &[&Done]),
        skills: (&Chosen, &[Arc<dyn RunnableSkill>]),
    ) -> Result<Vec<(String, SkillValue)>, StepEnd> {
        let values = self.prepared(step, offer, done).await?;
        self.release_movers(offer, skills).await?;
        Ok(values)
    }

    /// Returns the parameters of a step as its plan used it, or the end of a step that cannot
    /// begin.
    pub(super) async fn prepared(
        &self,
        step: &ProcessStep,
        offer: &Offer,
        done: &[&Done],
    ) -> Result<Vec<(String, SkillValue)>, StepEnd> {
        let given = self.unless_stopped(compensate::resolved(self.plant, step, done));
        let given = given.await.map_err(StepEnd::Stopped)?;
        let given = given.map_err(|why| StepEnd::Unresolved(format!("{}: {why}", step.name)))?;
        // The plan has chosen the later steps for the tool that it knows.
        let other = step.parameters.iter().zip(&given).find(|(planned, given)| {
            let is_tool = planned.name == TOOL && planned.query.is_some();
            is_tool && planned.value != given.value
        });
        if let Some((planned, given)) = other {
            return Err(StepEnd::Outdated(format!(
                "{}: {}: its value is {}, and was {} for the plan",
                step.name,
                planned.shown(),
                given.value,
                planned.value
            )));
        }
        self.plant.values(&offer.skill, &given).map_err(|why| {
            self.log.fell(Fallen {
                component: offer.component.clone(),
                since_ms: offer.since_ms,
                skill: Some(offer.skill.clone()),
                why: format!("it does not take the parameters: {why}"),
            });
            StepEnd::Failed(format!("{}: {why}", step.name))
        })
    }

    /// Runs the skill of a step or of a compensation to its end.
    pub(super) async fn one(
        &self,
        step: &ProcessStep,
        (offer, skill): (&Offer, &dyn RunnableSkill),
        values: Vec<(String, SkillValue)>,
    ) -> StepEnd {
        let before = self.log.ran(&offer.skill);
        // The skill records the step at its first poll, which follows without a pause.
        self.log.step(&step.name);
        let within = step.within.unwrap_or(self.process.within);
        let part = run_part(skill, values, within, self, self.teller.stopped());
        let outcome = match part.await {
            PartEnd::Ended(outcome) => outcome,
            PartEnd::Interrupted { halted: Ok(()), .. } => {
                return StepEnd::Stopped("stopped".to_owned());
            }
            PartEnd::Interrupted {
                halted: Err(fault), ..
            } => {
                let name = skill.name();
                return StepEnd::Stopped(format!("stopped, but {name} may go on: {fault}"));
            }
        };
        let (fault, why) = match outcome {
            Ok(outcome) if outcome.succeeded => return StepEnd::Done(outcome.results),
            Ok(outcome) => (None, outcome.message),
            Err(fault) => {
                let why = fault.to_string();
                (Some(fault), why)
            }
        };
        let why = format!("{}: {} {why}", step.name, skill.name());
        match fault {
            Some(SkillFault::Lost(_)) if self.log.ran(&offer.skill) > before => {
                StepEnd::LostInRun(why)
            }
            Some(SkillFault::Lost(_)) => StepEnd::Lost(why),
            Some(SkillFault::TimedOut(_)) => StepEnd::TimedOut(why),
            _ => StepEnd::Failed(why),
        }
    }
}

impl Ended {
    /// Adds the end of another step. No other plan can do the work if it cannot for one of them.
    fn and(&mut self, other: Self) {
        *self = match (std::mem::replace(self, Self::Done), other) {
            (Self::Done | Self::Round | Self::OtherTool(_), other) => other,
            (before, Self::Done | Self::Round | Self::OtherTool(_)) => before,
            (Self::Broken(one), Self::Broken(two)) => Self::Broken(format!("{one}; {two}")),
            // All running steps are stopped together.
            (Self::Over(one), Self::Over(two)) if one == two => Self::Over(one),
            (Self::Broken(one) | Self::Over(one), Self::Broken(two) | Self::Over(two)) => {
                Self::Over(format!("{one}; {two}"))
            }
        };
    }
}
