//! Executes a process: plans it with the available skills, runs the plan, and plans again when a
//! component is lost.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use skills::frame::Frame;
use skills::{
    GripPoint, Outcome, PartEnd, PickAndPlace, Runs, SkillFault, Teller, Value, run_part,
};
use tokio::sync::watch;
use tokio::time::Instant;
use tracing::{info, warn};

use crate::plan::{Fallen, Offer, Plan, plan};
use crate::process::{Given, Job, Process, Role};
use crate::record::{How, Planned, Ran, Run, Values, recorded};

/// The plant as the execution of a process needs it.
#[async_trait]
pub(crate) trait Plant: Send + Sync {
    /// Returns the available skills.
    fn offers(&self) -> Vec<Offer>;

    /// Returns a counter that is incremented when the available skills change.
    fn changes(&self) -> watch::Receiver<u64>;

    /// Opens these skills to run them, in the order of the offers. The caller holds the leases of
    /// their components until it calls [`Opened::close`].
    async fn open(&self, offers: &[Offer]) -> Result<Box<dyn Opened>, OpenFault>;

    /// Converts the parameters of a step to the parameters of a skill.
    fn values(&self, skill: &str, given: &[Given]) -> Result<Vec<(String, Value)>, String>;

    /// Stores the state of a run.
    fn keep(&self, run: &Run);

    /// Returns the time in ms since 1970.
    fn now(&self) -> u64;
}

/// Skills that can be run.
#[async_trait]
pub(crate) trait Opened: Send + Sync {
    /// Returns the skills in the order in which they were requested.
    fn skills(&self) -> Vec<Arc<dyn Runs>>;

    /// Releases the leases of the components.
    async fn close(self: Box<Self>);
}

/// The component that could not be opened, and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OpenFault {
    pub(crate) component: String,
    pub(crate) why: String,
}

/// Runs a process to its end. `teller` receives each step, and can stop the run.
pub(crate) async fn execute(
    plant: &Arc<dyn Plant>,
    process: &Process,
    number: u64,
    teller: &dyn Teller,
) -> Run {
    let run = Run::begins(process, plant.now(), number);
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
    }
    .run()
    .await;
    let ended = match ended {
        Err(why) if log.run().is_unknown() => {
            let why = match why.contains("unknown") {
                true => why,
                false => format!("{why}; the outcome is unknown"),
            };
            // Nobody starts the process again before a Reset.
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
        if self.0.run().ended_ms.is_some() {
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
    }
}

/// Returns the outcome of a run that is not done.
fn ended_badly(run: &Run) -> How {
    match run.is_unknown() {
        true => How::Unknown,
        false => How::Failed,
    }
}

fn tell(run: &Run) {
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

/// Plans a process without running it.
pub(crate) fn dry_run(plant: &dyn Plant, process: &Process) -> Plan {
    plan_now(plant, process, &plant.offers(), &[])
}

fn plan_now(plant: &dyn Plant, process: &Process, offers: &[Offer], fallen: &[Fallen]) -> Plan {
    plan(process, offers, fallen, &|offer, step| {
        plant.values(&offer.skill, &step.parameters).map(drop)
    })
}

struct Execution<'a> {
    plant: &'a dyn Plant,
    process: &'a Process,
    log: &'a Arc<Log>,
    teller: &'a dyn Teller,
}

/// The result of a plan.
enum Ended {
    Done,
    /// Another plan can do the work.
    Broken(String),
    /// No other plan can do the work.
    Over(String),
}

impl Execution<'_> {
    async fn run(&self) -> Result<(), String> {
        let mut last = String::new();
        for number in 1..=MOST_PLANS {
            let (plan, offers) = self.planned(&last).await?;
            self.log.change(|kept, now| {
                kept.run.waits_for = None;
                kept.run.plans.push(Planned {
                    number,
                    at_ms: now,
                    ended_ms: None,
                    plan,
                    ran: Vec::new(),
                    outcome: How::Running,
                    reason: None,
                    retreated: None,
                });
            });
            let ended = self.carry_out(&offers).await;
            let (outcome, reason) = match &ended {
                Ended::Done => (How::Done, None),
                Ended::Broken(why) | Ended::Over(why) => (How::Failed, Some(why.clone())),
            };
            self.log.change(|kept, now| {
                if let Some(plan) = kept.run.plan() {
                    plan.end(now, outcome, reason);
                }
            });
            match ended {
                Ended::Done => return Ok(()),
                Ended::Over(why) => return Err(why),
                // The step whose end is unknown may go on; no other component repeats it.
                Ended::Broken(why) if self.log.run().is_unknown() => return Err(why),
                Ended::Broken(why) => {
                    warn!(plan = number, "a plan failed: {why}");
                    last = why;
                }
            }
        }
        Err(format!("{MOST_PLANS} plans broke; the last: {last}"))
    }

    /// Waits for a complete plan, and returns it with the chosen offers by their roles.
    async fn planned(&self, last: &str) -> Result<(Plan, Vec<(Role, Offer)>), String> {
        let mut changes = self.plant.changes();
        let wait = tokio::time::sleep(self.process.wait);
        tokio::pin!(wait);
        loop {
            changes.mark_unchanged();
            let offers = self.plant.offers();
            let plan = plan_now(self.plant, self.process, &offers, &self.log.fallen());
            if plan.is_complete() {
                let mut chosen: Vec<(Role, Offer)> = Vec::new();
                for role in self
                    .process
                    .steps
                    .iter()
                    .flat_map(|step| &step.needs)
                    .map(|need| need.role)
                {
                    let offer = plan
                        .chosen(role)
                        .and_then(|skill| offers.iter().find(|offer| offer.skill == skill));
                    if let Some(offer) =
                        offer.filter(|_| chosen.iter().all(|(known, _)| *known != role))
                    {
                        chosen.push((role, offer.clone()));
                    }
                }
                return Ok((plan, chosen));
            }
            let missing = plan.missing();
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
                    let after = if last.is_empty() { String::new() } else { format!("{last}; ") };
                    return Err(format!("{after}nobody came in {} s: {missing}", self.process.wait.as_secs_f64()));
                }
                () = self.teller.stopped() => return Err("stopped".to_owned()),
            }
        }
    }

    async fn carry_out(&self, chosen: &[(Role, Offer)]) -> Ended {
        let offers: Vec<Offer> = chosen.iter().map(|(_, offer)| offer.clone()).collect();
        let opened = match self.plant.open(&offers).await {
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
        let watched = opened
            .skills()
            .into_iter()
            .zip(&offers)
            .map(|(skill, offer)| {
                let watched = Watched {
                    inner: skill,
                    offer: offer.clone(),
                    log: Arc::clone(self.log),
                    process: self.process.clone(),
                    is_halted: AtomicBool::new(false),
                };
                Arc::new(watched) as Arc<dyn Runs>
            });
        let roles: Vec<(Role, Arc<dyn Runs>)> =
            chosen.iter().map(|(role, _)| *role).zip(watched).collect();
        let ended = match &self.process.work {
            Job::PickAndPlace(job) => self.pick_and_place(job, &roles).await,
            Job::Sequence => self.sequence(chosen, &roles).await,
        };
        drop(roles);
        // A lost component does not respond to the close.
        if tokio::time::timeout(CLOSE, opened.close()).await.is_err() {
            warn!(
                "the components of a plan were not released in time; they stay reserved until their sessions end"
            );
        }
        ended
    }

    async fn pick_and_place(&self, job: &skills::Job, roles: &[(Role, Arc<dyn Runs>)]) -> Ended {
        let of = |wanted: Role| {
            roles
                .iter()
                .find(|(role, _)| *role == wanted)
                .map(|(_, skill)| Arc::clone(skill))
        };
        let (Some(ptp), Some(linear), Some(grasp), Some(release)) = (
            of(Role::Ptp),
            of(Role::Linear),
            of(Role::Grasp),
            of(Role::Release),
        ) else {
            return Ended::Over(
                "the process does not say who moves, grasps and releases".to_owned(),
            );
        };
        let composite = PickAndPlace {
            ptp,
            linear,
            grasp,
            release,
            plate: Frame::IDENTITY,
            within: self.process.within,
        };
        match composite.run(job, self).await {
            Ok(()) => Ended::Done,
            Err(broken) => {
                let has_retreated = broken.retreated.is_ok();
                self.log.change(|kept, _| {
                    if let Some(plan) = kept.run.plan() {
                        plan.retreated = Some(has_retreated);
                    }
                });
                // If the robot may still be above the place, another robot must not start.
                if has_retreated {
                    Ended::Broken(broken.to_string())
                } else {
                    Ended::Over(broken.to_string())
                }
            }
        }
    }

    async fn sequence(&self, chosen: &[(Role, Offer)], roles: &[(Role, Arc<dyn Runs>)]) -> Ended {
        for (((_, skill), (_, offer)), step) in roles.iter().zip(chosen).zip(&self.process.steps) {
            self.log.step(&step.name);
            self.teller.step("Step").await;
            let values = match self.plant.values(&offer.skill, &step.parameters) {
                Ok(values) => values,
                Err(why) => return Ended::Over(format!("{}: {why}", step.name)),
            };
            let within = self.process.within;
            let part = run_part(&**skill, values, within, self, self.teller.stopped());
            let outcome = match part.await {
                PartEnd::Ended(outcome) => outcome,
                PartEnd::Interrupted { halted: Ok(()), .. } => {
                    return Ended::Over("stopped".to_owned());
                }
                PartEnd::Interrupted {
                    halted: Err(fault), ..
                } => {
                    let name = skill.name();
                    return Ended::Over(format!("stopped, but {name} may go on: {fault}"));
                }
            };
            // The run of a lost component may go on; another component must not repeat it.
            let is_lost = matches!(outcome, Err(SkillFault::Lost(_)));
            let why = match outcome {
                Ok(outcome) if outcome.succeeded => continue,
                Ok(outcome) => outcome.message,
                Err(fault) => fault.to_string(),
            };
            // Another plan would repeat the completed steps.
            let why = format!("{}: {} {why}", step.name, skill.name());
            let is_first = self.process.steps.first() == Some(step);
            return if is_first && !is_lost {
                Ended::Broken(why)
            } else {
                Ended::Over(why)
            };
        }
        Ended::Done
    }
}

/// Forwards the steps of the composite to the log and to the caller.
#[async_trait]
impl Teller for Execution<'_> {
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
    run: Run,
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

    fn run(&self) -> Run {
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

    fn step(&self, step: &str) {
        step.clone_into(
            &mut self
                .kept
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .step,
        );
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

/// A skill that records its runs in the log.
struct Watched {
    inner: Arc<dyn Runs>,
    offer: Offer,
    process: Process,
    log: Arc<Log>,
    /// Whether the run was halted because of another skill, which says nothing against this one.
    is_halted: AtomicBool,
}

impl Watched {
    fn begins(&self, parameters: Values) {
        self.log.change(|kept, now| {
            let step = kept.step.clone();
            let of = of_step(&self.process, &step);
            if let Some(plan) = kept.run.plan() {
                plan.ran.push(Ran {
                    step,
                    of,
                    skill: self.offer.skill.clone(),
                    component: self.offer.component.clone(),
                    parameters,
                    results: Values::new(),
                    started_ms: now,
                    ended_ms: None,
                    outcome: How::Running,
                    reason: None,
                });
            }
        });
    }

    fn ends(&self, outcome: How, reason: Option<String>, results: Values) {
        self.log.change(|kept, now| {
            let is_this = |ran: &&mut Ran| ran.is_running() && ran.skill == self.offer.skill;
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
        self.ends(How::Unknown, Some(why.to_owned()), Values::new());
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
impl Runs for Watched {
    fn grip_point(&self) -> Option<GripPoint> {
        self.inner.grip_point()
    }

    fn name(&self) -> String {
        self.inner.name()
    }

    async fn run(
        &self,
        parameters: Vec<(String, Value)>,
        within: Duration,
    ) -> Result<Outcome, SkillFault> {
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
                self.ends(How::Stopped, None, Values::new());
            }
            Ok(outcome) => {
                self.fell(false, &outcome.message);
                self.ends(How::Failed, Some(outcome.message.clone()), Values::new());
            }
            Err(SkillFault::Lost(why)) => self.fell(true, why),
            Err(fault) if may_go_on(fault, began.elapsed() >= within) => {
                self.unknown(&fault.to_string());
            }
            Err(fault) => {
                self.fell(false, &fault.to_string());
                self.ends(How::Failed, Some(fault.to_string()), Values::new());
            }
        }
        outcome
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        self.is_halted.store(true, Ordering::Relaxed);
        self.inner.halt().await
    }

    async fn lost(&self) -> String {
        let why = self.inner.lost().await;
        self.fell(true, &why);
        why
    }
}

/// Returns whether a run may go on after a fault. `is_late` tells that the time of the run was
/// over, when a refusal can be that of its Halt.
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
        (Job::PickAndPlace(_), [picks, .., places]) => {
            if is_picking {
                Some(picks)
            } else {
                Some(places)
            }
        }
        (Job::PickAndPlace(_), [all]) => Some(all),
        (Job::PickAndPlace(_), []) | (Job::Sequence, _) => None,
    };
    of.map_or_else(|| step.to_owned(), |of| of.name.clone())
}

/// Maximum number of plans of a run.
const MOST_PLANS: usize = 10;
const MOST_FALLEN: usize = 100;
const CLOSE: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests;
