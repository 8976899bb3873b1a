//! Executes a process: plans it with the available skills, runs the plan, and plans again when a
//! step fails or a component is lost. Completed steps are not repeated; they are compensated if the
//! run fails.

mod compensate;
mod composite;
mod facts;
mod plant;
mod sequence;
mod tools;
mod watched;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use skills::{JobObserver, RunnableSkill};
use tokio::sync::watch;
use tracing::{info, warn};

use crate::plan::{AttachedTools, Fallen, Offer, Plan, Situation, plan};
use crate::process::{Process, ProcessStep, SkillRole, StepJob};
use crate::record::{How, Planned, ProcessRun};

use facts::{EvaluatedProcess, OfPlant};
pub(crate) use plant::{OpenFault, Opened, Plant};
use sequence::{RunProgress, StepEnd};
use watched::RecordedSkill;

/// Runs a process to its end. `teller` receives each step, and can stop the run.
pub(crate) async fn execute(
    plant: &Arc<dyn Plant>,
    process: &Process,
    number: u64,
    teller: &dyn JobObserver,
) -> ProcessRun {
    let (_going, paused) = watch::channel(false);
    execute_pausable(plant, process, number, (teller, paused)).await
}

/// Runs a process to its end. No step of a sequence begins while `paused` is true.
pub(crate) async fn execute_pausable(
    plant: &Arc<dyn Plant>,
    process: &Process,
    number: u64,
    (teller, paused): (&dyn JobObserver, watch::Receiver<bool>),
) -> ProcessRun {
    let run = ProcessRun::begins(process, plant.now(), number);
    plant.keep(&run);
    info!(process = process.iri, run = run.run, "a process begins");
    let log = Arc::new(Log {
        plant: Arc::clone(plant),
        kept: Mutex::new(Kept {
            run,
            step: String::new(),
            fallen: Vec::new(),
        }),
    });
    let _whole = Whole(Arc::clone(&log));
    let ended = Execution {
        plant: &**plant,
        process,
        log: &log,
        teller,
        paused,
    }
    .run()
    .await;
    let ended = match ended {
        Err(why) if log.run().is_unknown() => {
            let why = match why.contains("unknown") {
                true => why,
                false => format!("{why}; the outcome is unknown"),
            };
            // The process cannot be started again before a Reset.
            teller.unknown(&why).await;
            Err(why)
        }
        Ok(()) | Err(_) => ended,
    };
    log.change(|kept, now| {
        kept.run.ended_ms = Some(now);
        kept.run.waits_for = None;
        (kept.run.outcome, kept.run.reason) = match ended {
            Ok(()) => (How::Done, None),
            Err(why) => (ended_badly(&kept.run), Some(why)),
        };
    });
    let run = log.run();
    tell(&run);
    run
}

/// Completes the record of a run when its execution is dropped, for example when its skill is
/// halted and does not end in time.
struct Whole(Arc<Log>);

impl Drop for Whole {
    fn drop(&mut self) {
        let run = self.0.run();
        if run.ended_ms.is_some() {
            self.give_back();
            return;
        }
        self.0.change(|kept, now| {
            let why = "it was given up in the middle";
            if let Some(plan) = kept.run.plan().filter(|plan| plan.ended_ms.is_none()) {
                plan.end(now, How::Failed, Some(why.to_owned()));
            }
            kept.run.ended_ms = Some(now);
            kept.run.waits_for = None;
            kept.run.outcome = ended_badly(&kept.run);
            kept.run.reason = Some(why.to_owned());
        });
        self.give_back();
    }
}

impl Whole {
    /// Gives back the components of the run, unless its outcome is unknown: a machine may still
    /// move.
    fn give_back(&self) {
        let run = self.0.run();
        if !run.is_unknown() {
            self.0.plant.lease(&run.run, &BTreeSet::new());
        }
    }
}

/// Returns the outcome of a run that is not done.
fn ended_badly(run: &ProcessRun) -> How {
    match run.is_unknown() {
        true => How::Unknown,
        false => How::Failed,
    }
}

fn tell(run: &ProcessRun) {
    let (plans, process) = (run.plans.len(), &run.process);
    match &run.reason {
        None => info!(process, run = run.run, plans, "a process is done"),
        Some(reason) => {
            let what = match run.is_unknown() {
                true => "the outcome of a process is unknown",
                false => "a process failed",
            };
            warn!(process, run = run.run, "{what}: {reason}");
        }
    }
}

/// Plans a process without running it, as if no other process was running.
pub(crate) async fn dry_run(plant: &dyn Plant, process: &Process) -> Plan {
    let evaluated = EvaluatedProcess::of(plant, process, &RunProgress::default()).await;
    let (process, evaluated) = (&evaluated.process, &evaluated);
    let facts = OfPlant { plant, evaluated };
    plant.read_tools().await;
    let offers = plant.offers();
    let mut tools = AttachedTools::default();
    tools.observe(&tools::shown(plant, process, &offers));
    let situation = Situation {
        tools: Some(&tools),
        ..Situation::default()
    };
    plan(process, &offers, situation, &facts)
}

struct Execution<'a> {
    plant: &'a dyn Plant,
    process: &'a Process,
    log: &'a Arc<Log>,
    teller: &'a dyn JobObserver,
    /// Whether no step may begin.
    paused: watch::Receiver<bool>,
}

/// The result of a plan.
enum Ended {
    Done,
    /// Another round of a loop is due, which is planned anew.
    Round,
    /// The attached tool is not the tool of the plan for the next step: a new plan is needed.
    OtherTool(String),
    /// Another plan can do the work.
    Broken(String),
    /// No other plan can do the work.
    Over(String),
}

/// The skills that a plan runs.
struct Chosen {
    /// The offers by their roles, in the order of the steps that are not done.
    open: Vec<(SkillRole, Offer)>,
    /// The offers of compensations, by the numbers of the steps.
    undo: BTreeMap<usize, Offer>,
    /// The components that can do steps with the right tool, by the numbers of the steps.
    able: BTreeMap<usize, BTreeSet<String>>,
    /// The components that the plan knew.
    known: BTreeSet<String>,
    /// The steps of the process with the values of their queries, as the plan used them.
    steps: Vec<ProcessStep>,
}

impl Execution<'_> {
    /// Runs the process. If it fails, its completed steps are compensated.
    async fn run(&self) -> Result<(), String> {
        let mut progress = RunProgress::default();
        let ended = self.forward(&mut progress).await;
        match ended {
            Ok(()) => Ok(()),
            Err(why) => Err(self.compensated(why, &mut progress).await),
        }
    }

    /// Runs plans until all steps are done.
    async fn forward(&self, progress: &mut RunProgress) -> Result<(), String> {
        let mut last = String::new();
        let mut number = 0_usize;
        let mut broken = 0_usize;
        // The steps that were over when a plan had another tool than the attached one.
        let mut retooled = None;
        while broken < MOST_PLANS {
            number = number.saturating_add(1);
            let after = (&*last, retooled.is_some());
            let (plan, chosen) = self.planned(after, progress).await?;
            self.log.change(|kept, now| {
                kept.run.waits_for = None;
                kept.run.plans.push(Planned::begins(number, now, plan));
            });
            let ended = self.carry_out(&chosen, progress).await;
            let (outcome, reason) = match &ended {
                Ended::Done | Ended::Round => (How::Done, None),
                Ended::OtherTool(why) => (How::Done, Some(why.clone())),
                Ended::Broken(why) | Ended::Over(why) => (How::Failed, Some(why.clone())),
            };
            self.log.change(|kept, now| {
                if let Some(plan) = kept.run.plan() {
                    plan.end(now, outcome, reason);
                }
            });
            match ended {
                Ended::Done => return Ok(()),
                Ended::Round => {
                    self.log.forgive();
                    retooled = None;
                    last.clear();
                }
                Ended::OtherTool(why) => {
                    info!(plan = number, "the next step is planned again: {why}");
                    let over = (progress.done.len(), progress.passed.len());
                    // The new plan knew the tools of its first step.
                    if retooled.replace(over) == Some(over) {
                        return Err(why);
                    }
                    last.clear();
                }
                Ended::Over(why) => return Err(why),
                // The step whose end is unknown may go on; no other component repeats it.
                Ended::Broken(why) if self.log.run().is_unknown() => return Err(why),
                Ended::Broken(why) => {
                    warn!(plan = number, "a plan failed: {why}");
                    broken = broken.saturating_add(1);
                    last = why;
                }
            }
        }
        Err(format!("{MOST_PLANS} plans broke; the last: {last}"))
    }

    /// Waits for a complete plan of the steps that are not done, and returns it with the chosen
    /// offers. The run has the use of their components then. A plan for another tool is not waited
    /// for if the tools of the run exclude all candidates of a step.
    async fn planned(
        &self,
        (last, is_retooled): (&str, bool),
        progress: &mut RunProgress,
    ) -> Result<(Plan, Chosen), String> {
        let run = self.log.run().run;
        let kept = compensate::kept(self.process, &progress.done);
        let passed = progress.passed_or_ruled_out(self.process);
        let after = if last.is_empty() {
            String::new()
        } else {
            format!("{last}; ")
        };
        let mut changes = self.plant.changes();
        let wait = tokio::time::sleep(self.process.wait);
        tokio::pin!(wait);
        loop {
            changes.mark_unchanged();
            // A tool changer or a query that does not respond delays no stop.
            self.unless_stopped(self.plant.read_tools()).await?;
            let evaluated = EvaluatedProcess::of(self.plant, self.process, progress);
            let evaluated = self.unless_stopped(evaluated).await?;
            if let Some(fault) = evaluated.fault() {
                return Err(format!("{after}{fault}"));
            }
            let offers = self.plant.offers();
            let shown = tools::shown(self.plant, &evaluated.process, &offers);
            if progress.done.is_empty() && !progress.tools.is_changed() {
                // The run has not begun, and other runs may change the tools.
                progress.tools = AttachedTools::default();
            }
            progress.tools.observe(&shown);
            let (fallen, used) = (self.log.fallen(), self.plant.used_by_others(&run));
            let situation = Situation {
                fallen: &fallen,
                kept: &kept,
                passed: &passed,
                used: Some(&used),
                tools: Some(&progress.tools),
            };
            let facts = OfPlant {
                plant: self.plant,
                evaluated: &evaluated,
            };
            let plan = plan(&evaluated.process, &offers, situation, &facts);
            let mut in_use = None;
            if plan.is_complete() {
                let chosen = self.chosen(&plan, &offers, progress);
                let all = chosen.open.iter().map(|(_, offer)| offer);
                let all = all.chain(chosen.undo.values());
                let all = all.chain(kept.iter().map(|kept| &kept.offer));
                // Earlier rounds of loops are compensated by their own components.
                let all = all.chain(progress.done.iter().filter_map(|done| done.undo.as_ref()));
                let components = all.map(|offer| offer.component.clone());
                let mut components: BTreeSet<String> = components.collect();
                let used_by_steps = (&chosen, self.plant);
                let tools = tools::used_by_steps(&evaluated.process, progress, used_by_steps);
                components.extend(tools);
                let other = components
                    .iter()
                    .find_map(|one| Some((one, used.get(one)?)));
                in_use = other.map(|(one, run)| format!("the run {run} uses {one}"));
                if self.plant.lease(&run, &components) {
                    let steps = evaluated.process.steps;
                    return Ok((plan, Chosen { steps, ..chosen }));
                }
            }
            let missing = in_use.unwrap_or_else(|| plan.missing());
            if plan.is_hopeless() || (is_retooled && plan.lacks_tool()) {
                return Err(format!("{after}{missing}"));
            }
            self.log
                .change(|kept, _| kept.run.waits_for = Some(missing.clone()));
            self.teller.step("Wait").await;
            tokio::select! {
                changed = changes.changed() => {
                    if changed.is_err() {
                        return Err("the plant is not watched any more".to_owned());
                    }
                }
                () = &mut wait => {
                    return Err(format!("{after}nobody came in {} s: {missing}", self.process.wait.as_secs_f64()));
                }
                () = self.teller.stopped() => return Err("stopped".to_owned()),
            }
        }
    }

    /// Waits for the plant.
    ///
    /// # Errors
    /// The caller stopped the run meanwhile.
    async fn unless_stopped<T>(&self, wait: impl Future<Output = T> + Send) -> Result<T, String> {
        tokio::select! {
            biased;
            () = self.teller.stopped() => Err("stopped".to_owned()),
            value = wait => Ok(value),
        }
    }

    /// Returns the chosen offers of a plan, without the offers of steps that are over.
    fn chosen(&self, plan: &Plan, offers: &[Offer], progress: &RunProgress) -> Chosen {
        let of = |role: SkillRole| {
            let skill = plan.chosen(role)?;
            offers.iter().find(|offer| offer.skill == skill).cloned()
        };
        let mut open: Vec<(SkillRole, Offer)> = Vec::new();
        let left = self.process.steps.iter().enumerate();
        let left = left.filter(|(number, _)| !progress.is_over(*number));
        for role in left.flat_map(|(_, step)| &step.needs).map(|need| need.role) {
            if open.iter().all(|(known, _)| *known != role) {
                open.extend(of(role).map(|offer| (role, offer)));
            }
        }
        let left = (0..self.process.steps.len()).filter(|number| !progress.is_over(*number));
        let undo = left.filter_map(|number| {
            let role = SkillRole::Alone(self.process.compensation_of(number));
            Some((number, of(role)?))
        });
        Chosen {
            open,
            undo: undo.collect(),
            able: (0..self.process.steps.len())
                .map(|number| (number, plan.able(SkillRole::Alone(number))))
                .collect(),
            known: offers.iter().map(|offer| offer.component.clone()).collect(),
            steps: Vec::new(),
        }
    }

    /// Opens skills to run them. Their runs are recorded in the log.
    async fn open(
        &self,
        offers: &[Offer],
    ) -> Result<(Box<dyn Opened>, Vec<Arc<dyn RunnableSkill>>), OpenFault> {
        let opened = self.plant.open(offers).await?;
        let watched = opened
            .skills()
            .into_iter()
            .zip(offers)
            .map(|(skill, offer)| {
                let watched = RecordedSkill::new(skill, offer, self.log, self.process);
                Arc::new(watched) as Arc<dyn RunnableSkill>
            });
        let watched = watched.collect();
        Ok((opened, watched))
    }

    async fn carry_out(&self, chosen: &Chosen, progress: &mut RunProgress) -> Ended {
        let offers: Vec<Offer> = chosen.open.iter().map(|(_, offer)| offer.clone()).collect();
        let (opened, skills) = match self.open(&offers).await {
            Ok(opened) => opened,
            Err(fault) => {
                let since_ms = offers
                    .iter()
                    .find(|offer| offer.component == fault.component)
                    .map_or(0, |offer| offer.since_ms);
                let why = format!("it cannot be reached: {}", fault.why);
                self.log.fell(Fallen {
                    component: fault.component.clone(),
                    since_ms,
                    skill: None,
                    why,
                });
                return Ended::Broken(format!(
                    "{} cannot be reached: {}",
                    fault.component, fault.why
                ));
            }
        };
        let ended = match &self.process.work {
            StepJob::PickAndPlace(job) => {
                let roles = chosen.open.iter().map(|(role, _)| *role);
                let roles: Vec<_> = roles.zip(skills).collect();
                match self.plate(chosen) {
                    Ok(plate) => self.pick_and_place(job, plate, &roles).await,
                    // The tool was changed after the plan, which has to know it.
                    Err(why) => Ended::Broken(why.to_string()),
                }
            }
            StepJob::Sequence => self.sequence(chosen, &skills, progress).await,
        };
        close(opened).await;
        ended
    }
}

/// Releases the leases of components. A lost component does not respond to the close.
async fn close(opened: Box<dyn Opened>) {
    if tokio::time::timeout(CLOSE, opened.close()).await.is_err() {
        warn!(
            "the components of a plan were not released in time; they stay reserved until their sessions end"
        );
    }
}

/// Forwards the steps of the composite to the log and to the caller.
#[async_trait]
impl JobObserver for Execution<'_> {
    async fn step(&self, step: &'static str) {
        self.log.step(step);
        self.teller.step(step).await;
    }

    async fn pending(&self, why: &str) {
        self.teller.pending(why).await;
    }

    async fn unknown(&self, why: &str) {
        self.teller.unknown(why).await;
    }

    async fn stopped(&self) {
        self.teller.stopped().await;
    }
}

/// The record of a run.
struct Log {
    plant: Arc<dyn Plant>,
    kept: Mutex<Kept>,
}

struct Kept {
    run: ProcessRun,
    step: String,
    fallen: Vec<Fallen>,
}

impl Log {
    /// Changes the record and stores it. The lock is not held while the record is stored.
    fn change(&self, change: impl FnOnce(&mut Kept, u64)) {
        let now = self.plant.now();
        let run = {
            let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
            change(&mut kept, now);
            kept.run.clone()
        };
        self.plant.keep(&run);
    }

    fn run(&self) -> ProcessRun {
        self.kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .run
            .clone()
    }

    fn fallen(&self) -> Vec<Fallen> {
        self.kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .fallen
            .clone()
    }

    /// Returns the number of runs of a skill in the current plan.
    fn ran(&self, skill: &str) -> usize {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.run.plans.last().map_or(0, |plan| {
            plan.ran.iter().filter(|ran| ran.skill == skill).count()
        })
    }

    fn step(&self, step: &str) {
        step.clone_into(
            &mut self
                .kept
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .step,
        );
    }

    /// Forgets failed skills: the process repeats their steps, so another round may use them again.
    /// Lost components stay.
    fn forgive(&self) {
        self.change(|kept, _| kept.fallen.retain(|fallen| fallen.skill.is_none()));
    }

    fn fell(&self, fallen: Fallen) {
        self.change(|kept, now| {
            if let Some(plan) = kept.run.plan().filter(|_| fallen.skill.is_none()) {
                plan.lost(now, &fallen);
            }
            if kept.fallen.len() < MOST_FALLEN && !kept.fallen.contains(&fallen) {
                kept.fallen.push(fallen);
            }
        });
    }
}

/// Maximum number of plans of a run that may break. Rounds of loops have maximums of their own,
/// for each loop and for all loops of a run.
const MOST_PLANS: usize = 10;
const MOST_FALLEN: usize = 100;
const CLOSE: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests;
