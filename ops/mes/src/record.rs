//! Records of plans and runs, for `/status` and for the graph.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use knowledge::vocabulary as v;
use mtp::{Object, Triple, escaped};
use serde::Serialize;
use serde_json::{Map, Value as Json};
use skills::SkillValue;

use crate::plan::{Fallen, Plan};
use crate::process::{Process, literal, step_iri};

/// The outcome of a process, plan or skill run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum How {
    Running,
    Done,
    Failed,
    /// Its component was lost during the run.
    Lost,
    /// It was halted for another reason.
    Stopped,
    /// Its end is not confirmed: it may go on.
    Unknown,
}

/// A run of a process. Times are in ms since 1970.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ProcessRun {
    /// The IRI of the run.
    pub(crate) run: String,
    pub(crate) process: String,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: How,
    pub(crate) reason: Option<String>,
    /// The missing components that the run waits for, if any.
    pub(crate) waits_for: Option<String>,
    pub(crate) plans: Vec<Planned>,
}

/// A plan of a run, and the skill runs of the plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Planned {
    pub(crate) number: usize,
    pub(crate) at_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    #[serde(flatten)]
    pub(crate) plan: Plan,
    pub(crate) ran: Vec<SkillRun>,
    pub(crate) outcome: How,
    pub(crate) reason: Option<String>,
    /// After a fault, whether the robot has retreated.
    pub(crate) retreated: Option<bool>,
    /// Whether its skills undo completed steps of the run.
    pub(crate) compensates: bool,
}

/// A run of a skill.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SkillRun {
    /// The step of the composite, or the name of the step.
    pub(crate) step: String,
    /// The step of the process.
    pub(crate) of: String,
    pub(crate) skill: String,
    pub(crate) component: String,
    /// The parameters that it was given.
    pub(crate) parameters: RecordValues,
    /// The results that it returned.
    pub(crate) results: RecordValues,
    pub(crate) started_ms: u64,
    /// `None` while it is running, and if its end is unknown.
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: How,
    pub(crate) reason: Option<String>,
}

/// Named values of a record.
pub(crate) type RecordValues = Map<String, Json>;

/// Returns the values for a record. A value of more than 4 KiB is replaced by its size.
pub(crate) fn recorded(values: &[(String, SkillValue)]) -> RecordValues {
    let one = |(name, value): &(String, SkillValue)| {
        let json = value.to_json();
        let length = json.to_string().len();
        let json = match length > MOST_VALUE {
            true => Json::from(format!("not recorded: {length} bytes")),
            false => json,
        };
        (name.clone(), json)
    };
    values.iter().map(one).collect()
}

/// The newest runs, in order; old runs are removed.
#[derive(Debug, Default)]
pub(crate) struct NewestRuns(Mutex<VecDeque<ProcessRun>>);

impl NewestRuns {
    /// Adds or updates a run. Returns the runs that were removed to make space.
    pub(crate) fn put(&self, run: &ProcessRun) -> Vec<String> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match all.iter_mut().find(|known| known.run == run.run) {
            Some(known) => *known = run.clone(),
            None => all.push_back(run.clone()),
        }
        let mut gone = Vec::new();
        while all.len() > MOST_RUNS {
            gone.extend(all.pop_front().map(|run| run.run));
        }
        gone
    }

    /// Returns all runs.
    pub(crate) fn all(&self) -> Vec<ProcessRun> {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .iter()
            .cloned()
            .collect()
    }
}

impl ProcessRun {
    /// Creates a run. `number` distinguishes runs that start in the same millisecond.
    pub(crate) fn begins(process: &Process, at: u64, number: u64) -> Self {
        Self {
            run: format!("urn:ua-bridge:run:{at}-{number}"),
            process: process.iri.clone(),
            started_ms: at,
            ended_ms: None,
            outcome: How::Running,
            reason: None,
            waits_for: None,
            plans: Vec::new(),
        }
    }

    /// Returns the number of the run.
    pub(crate) fn number(&self) -> Option<u64> {
        self.run.rsplit_once('-')?.1.parse().ok()
    }

    /// Returns the triples of the run.
    pub(crate) fn triples(&self) -> Vec<Triple> {
        let mut graph = Graph(Vec::new());
        let run = &self.run;
        graph.say(run, v::RDF_TYPE, iri(v::RUN));
        graph.say(run, v::RDF_TYPE, iri(v::PROV_ACTIVITY));
        graph.say(run, v::PROV_USED, iri(&self.process));
        graph.say(run, v::OF_PROCESS, iri(&self.process));
        graph.ends(
            run,
            self.started_ms,
            (self.ended_ms, self.outcome),
            self.reason.as_deref(),
        );
        let mut previous = None;
        for plan in &self.plans {
            let plan_iri = format!("{run}/plan/{}", plan.number);
            graph.say(run, v::HAS_PLAN, iri(&plan_iri));
            graph.say(&plan_iri, v::RDF_TYPE, iri(v::PLAN));
            graph.say(&plan_iri, v::RDF_TYPE, iri(v::PROV_ACTIVITY));
            graph.say(
                &plan_iri,
                v::NUMBER,
                Object::Integer(i64::try_from(plan.number).unwrap_or(i64::MAX)),
            );
            if plan.compensates {
                graph.say(&plan_iri, v::COMPENSATES, Object::Boolean(true));
            }
            graph.ends(
                &plan_iri,
                plan.at_ms,
                (plan.ended_ms, plan.outcome),
                plan.reason.as_deref(),
            );
            for (ran, position) in plan.ran.iter().zip(1_i64..) {
                let part = format!("{plan_iri}/{position}");
                let step = match plan.compensates {
                    true => format!("{}/compensation", step_iri(&self.process, &ran.of)),
                    false => step_iri(&self.process, &ran.of),
                };
                graph.say(&plan_iri, v::HAS_STEP, iri(&part));
                graph.say(&part, v::RDF_TYPE, iri(v::STEP_RUN));
                graph.say(&part, v::RDFS_LABEL, Object::Text(ran.step.clone()));
                graph.say(&part, v::OF_STEP, iri(&step));
                graph.say(&part, v::POSITION, Object::Integer(position));
                graph.say(&part, v::USES_SKILL, iri(&ran.skill));
                graph.say(&part, v::USES_COMPONENT, iri(&ran.component));
                graph.ends(
                    &part,
                    ran.started_ms,
                    (ran.ended_ms, ran.outcome),
                    ran.reason.as_deref(),
                );
                graph.provenance(&part, ran, &step);
                if let Some(previous) = previous.replace(part.clone()) {
                    graph.say(&part, v::PROV_WAS_INFORMED_BY, iri(&previous));
                }
            }
        }
        graph.0
    }

    /// Returns the plan that is being executed.
    pub(crate) fn plan(&mut self) -> Option<&mut Planned> {
        self.plans.last_mut()
    }

    /// Returns whether the end of a skill is unknown.
    pub(crate) fn is_unknown(&self) -> bool {
        self.plans.iter().any(Planned::is_unknown)
    }
}

impl SkillRun {
    pub(crate) fn is_running(&self) -> bool {
        self.outcome == How::Running
    }
}

impl Planned {
    /// Creates the record of a plan that begins.
    pub(crate) fn begins(number: usize, at_ms: u64, plan: Plan) -> Self {
        Self {
            number,
            at_ms,
            ended_ms: None,
            plan,
            ran: Vec::new(),
            outcome: How::Running,
            reason: None,
            retreated: None,
            compensates: false,
        }
    }

    /// Ends the plan. The ends of skills that are still running are unknown. The outcome of a plan
    /// with such a skill is unknown, unless the plan is done.
    pub(crate) fn end(&mut self, at: u64, outcome: How, reason: Option<String>) {
        for ran in self.ran.iter_mut().filter(|ran| ran.is_running()) {
            ran.outcome = How::Unknown;
            ran.reason = Some("the plan ended before it".to_owned());
        }
        self.ended_ms = Some(at);
        self.outcome = match outcome == How::Failed && self.is_unknown() {
            true => How::Unknown,
            false => outcome,
        };
        self.reason = reason;
    }

    fn is_unknown(&self) -> bool {
        self.ran.iter().any(|ran| ran.outcome == How::Unknown)
    }

    /// Records the loss of a component: its running skills end as lost.
    pub(crate) fn lost(&mut self, at: u64, fallen: &Fallen) {
        let of_component =
            |ran: &&mut SkillRun| ran.is_running() && ran.component == fallen.component;
        for ran in self.ran.iter_mut().filter(of_component) {
            ran.ended_ms = Some(at);
            ran.outcome = How::Lost;
            ran.reason = Some(fallen.why.clone());
        }
    }
}

struct Graph(Vec<Triple>);

impl Graph {
    fn say(&mut self, subject: &str, predicate: &str, object: Object) {
        self.0.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    }

    /// States the provenance (PROV-O) of a skill run: its component, step, parameters and results.
    fn provenance(&mut self, part: &str, ran: &SkillRun, step: &str) {
        self.say(part, v::RDF_TYPE, iri(v::PROV_ACTIVITY));
        self.say(part, v::PROV_WAS_ASSOCIATED_WITH, iri(&ran.component));
        self.say(&ran.component, v::RDF_TYPE, iri(v::PROV_AGENT));
        let association = format!("{part}/association");
        self.say(part, v::PROV_QUALIFIED_ASSOCIATION, iri(&association));
        self.say(&association, v::RDF_TYPE, iri(v::PROV_ASSOCIATION));
        self.say(&association, v::PROV_HAD_AGENT, iri(&ran.component));
        self.say(&association, v::PROV_HAD_PLAN, iri(step));
        self.say(step, v::RDF_TYPE, iri(v::PROV_PLAN));
        for (values, kind) in [(&ran.parameters, "parameter"), (&ran.results, "result")] {
            for (name, value) in values {
                let entity = format!("{part}/{kind}/{}", escaped(name));
                if kind == "parameter" {
                    self.say(part, v::PROV_USED, iri(&entity));
                } else {
                    self.say(&entity, v::PROV_WAS_GENERATED_BY, iri(part));
                }
                self.say(&entity, v::RDF_TYPE, iri(v::PROV_ENTITY));
                self.say(&entity, v::HAS_VARIABLE_NAME, Object::Text(name.clone()));
                let (predicate, value) = literal(value);
                self.say(&entity, predicate, value);
            }
        }
    }

    fn ends(
        &mut self,
        what: &str,
        started: u64,
        (ended, outcome): (Option<u64>, How),
        reason: Option<&str>,
    ) {
        for predicate in [v::STARTED, v::PROV_STARTED_AT_TIME] {
            self.say(what, predicate, Object::Time(date_time(started)));
        }
        // PROV has no time at which an activity was given up or its component was lost.
        let is_confirmed = !matches!(outcome, How::Lost | How::Unknown);
        if let Some(ended) = ended {
            let ended = Object::Time(date_time(ended));
            if is_confirmed {
                self.say(what, v::PROV_ENDED_AT_TIME, ended.clone());
            }
            self.say(what, v::ENDED, ended);
        }
        let outcome = match outcome {
            How::Running => "running",
            How::Done => "done",
            How::Failed => "failed",
            How::Lost => "lost",
            How::Stopped => "stopped",
            How::Unknown => "unknown",
        };
        self.say(what, v::OUTCOME, Object::Text(outcome.to_owned()));
        if let Some(reason) = reason {
            self.say(what, v::REASON, Object::Text(reason.to_owned()));
        }
    }
}

fn iri(iri: &str) -> Object {
    Object::Iri(iri.to_owned())
}

/// Formats ms since 1970 as an xsd:dateTime in UTC.
pub(crate) fn date_time(ms: u64) -> String {
    let (seconds, ms) = (ms / 1000, ms % 1000);
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Years start in March in this calculation, so that the leap day is the last day of a year.
    let days = days + 719_468;
    let (era, of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let day_of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{ms:03}Z")
}

const MOST_RUNS: usize = 100;
/// Maximum length of a recorded value as JSON, in bytes.
const MOST_VALUE: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_written_as_the_calendar_has_them() {
        assert_eq!(date_time(0), "1970-01-01T00:00:00.000Z");
        assert_eq!(date_time(951_782_399_999), "2000-02-28T23:59:59.999Z");
        assert_eq!(date_time(951_782_400_000), "2000-02-29T00:00:00.000Z");
        assert_eq!(date_time(1_795_574_096_007), "2026-11-25T02:34:56.007Z");
        assert_eq!(date_time(4_107_542_400_000), "2100-03-01T00:00:00.000Z");
    }
}
