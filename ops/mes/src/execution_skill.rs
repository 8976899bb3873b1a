//! ExecuteProcess, the skill of the MES.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use skills::{
    COMPOSITE_HALT_TIMEOUT, Driver, DriverError, InvalidParameter, JobObserver, Parameters,
    RunResults, SkillValue, Work,
};

use crate::cell::PlantState;
use crate::execute::{Plant, dry_run, execute};
use crate::record::How;

/// Plans and runs the process of its parameter.
pub(crate) struct ExecuteProcess {
    pub(crate) cell: Arc<PlantState>,
    /// The number of the last run, unless its end is known. A run that was given up has not
    /// returned its outcome. The skill needs a Reset after such a run.
    unknown: Mutex<Option<u64>>,
}

impl ExecuteProcess {
    pub(crate) fn new(cell: Arc<PlantState>) -> Self {
        Self {
            cell,
            unknown: Mutex::default(),
        }
    }

    fn unknown(&self) -> MutexGuard<'_, Option<u64>> {
        self.unknown.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[async_trait]
impl Driver for ExecuteProcess {
    /// Halt waits for the end of the skills that do the work.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        let unexpected = |name: &str, given: &str, expected| InvalidParameter::Unexpected {
            name: name.to_owned(),
            given: Some(given.into()),
            expected,
        };
        let iri = parameters.text("ProcessIri").unwrap_or_default();
        if let Err(why) = self.cell.process(iri) {
            return Err(unexpected(
                "ProcessIri",
                iri,
                format!("cannot be used: {why}"),
            ));
        }
        match parameters.text("ExecutionMode") {
            Some("execute" | "plan") | None => Ok(()),
            Some(other) => Err(unexpected(
                "ExecutionMode",
                other,
                format!("is `{other}`, which is neither execute nor plan"),
            )),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let iri = work
            .parameters()
            .text("ProcessIri")
            .unwrap_or_default()
            .to_owned();
        let process = self.cell.process(&iri);
        let process = process.map_err(DriverError::reported)?;
        let report = |report: &serde_json::Value| {
            Ok(vec![(
                "Report".to_owned(),
                SkillValue::String(report.to_string()),
            )])
        };
        if work.parameters().text("ExecutionMode") == Some("plan") {
            let plan = dry_run(&*self.cell, &process).await;
            let (complete, missing) = (plan.is_complete(), plan.missing());
            let whole = serde_json::json!({ "process": iri, "complete": complete, "missing": missing, "plan": plan });
            if whole.to_string().len() <= MOST_REPORT {
                return report(&whole);
            }
            // The page of the plan contains the reasons.
            let short: String = missing.chars().take(1000).collect();
            return report(
                &serde_json::json!({ "process": iri, "complete": complete, "missing": short }),
            );
        }
        let plant: Arc<dyn Plant> = Arc::clone(&self.cell) as Arc<dyn Plant>;
        let number = self.cell.next_run();
        // The Reset that the skill needed confirms that the machines of the last run stand still.
        let last = self.unknown().replace(number);
        if let Some(last) = last {
            self.cell.give_back_of(last);
        }
        let run = execute(&plant, &process, number, &Telling(&work)).await;
        if run.outcome != How::Unknown {
            *self.unknown() = None;
        }
        match (run.outcome, run.reason) {
            (How::Done, _) => report(
                &serde_json::json!({ "run": run.run, "process": iri, "plans": run.plans.len(), "outcome": "done" }),
            ),
            (_, reason) => Err(DriverError::reported(reason.unwrap_or_default())),
        }
    }
}

/// Reports steps and progress to the skill.
struct Telling<'a>(&'a Work);

#[async_trait]
impl JobObserver for Telling<'_> {
    async fn step(&self, step: &'static str) {
        if let Some((_, done)) = DONE.iter().find(|(known, _)| *known == step) {
            self.0.progress(*done);
        }
        self.0.step(step).await;
    }

    async fn pending(&self, why: &str) {
        self.0.pending(why).await;
    }

    async fn unknown(&self, why: &str) {
        self.0.unknown(why).await;
    }

    async fn stopped(&self) {
        self.0.stopped().await;
    }
}

/// Maximum size of a report in bytes. The report crosses the space as a value, and clients read it
/// as a whole.
const MOST_REPORT: usize = 32 << 10;

/// Progress at the start of each step of the composite.
const DONE: [(&str, f32); 10] = [
    ("Init", 0.0),
    ("MovePickApproachBefore", 0.05),
    ("MovePick", 0.2),
    ("Grasp", 0.3),
    ("MovePickApproachAfter", 0.4),
    ("MovePlaceApproachBefore", 0.5),
    ("MovePlace", 0.7),
    ("Release", 0.8),
    ("MovePlaceApproachAfter", 0.9),
    ("Idle", 1.0),
];
