//! The MES of a scenario: its plans, its jobs, and the steps of a run.

use std::path::PathBuf;
use std::process::{Output, Stdio};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use tokio::time::{Instant, sleep, timeout};

use super::{EventSource, LOOPBACK, Show, StopReason, command, fetch};

/// A MES that answers on this host.
pub(crate) struct Mes {
    /// The program `ua-space`.
    tool: PathBuf,
    /// The port at which the MES answers.
    port: u16,
}

/// A run of a skill, as `ua-mes` records it. Times are in ms since 1970.
#[derive(Clone, Debug, Default, Deserialize, Serialize)]
pub(crate) struct StepRun {
    pub(crate) step: String,
    pub(crate) component: String,
    pub(crate) parameters: Map<String, Value>,
    #[serde(default)]
    pub(crate) results: Map<String, Value>,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: String,
}

/// The status page of the MES.
#[derive(Debug, Deserialize)]
struct Page {
    #[serde(default)]
    components: Vec<PageComponent>,
    runs: Vec<JobRun>,
}

#[derive(Debug, Deserialize)]
struct PageComponent {
    name: String,
}

/// A run of a process, as `ua-mes` shows it.
#[derive(Debug, Default, Deserialize)]
pub(crate) struct JobRun {
    run: String,
    pub(crate) outcome: String,
    pub(crate) reason: Option<String>,
    /// The reason for which the run waits: missing skills, or a component that another run uses.
    pub(crate) waits_for: Option<String>,
    plans: Vec<Planned>,
}

#[derive(Debug, Deserialize)]
struct Planned {
    ran: Vec<StepRun>,
}

impl JobRun {
    /// Returns whether the run goes on.
    pub(crate) fn is_running(&self) -> bool {
        matches!(self.outcome.as_str(), "running" | "")
    }

    /// Returns the number of plans.
    pub(crate) fn plans(&self) -> usize {
        self.plans.len()
    }

    /// Returns the runs of skills of all plans.
    pub(crate) fn steps(&self) -> Vec<StepRun> {
        self.plans
            .iter()
            .flat_map(|plan| plan.ran.clone())
            .collect()
    }

    /// Returns whether a step has begun.
    pub(crate) fn began(&self, step: &str) -> bool {
        let mut steps = self.plans.iter().flat_map(|plan| &plan.ran);
        steps.any(|known| known.step == step)
    }

    /// Prints the beginnings and ends of steps. `shown` has the steps as they were printed last.
    pub(crate) fn show_news(
        &self,
        shown: &mut Vec<StepRun>,
        show: &mut Show,
        names: &[&'static str],
    ) -> Result<(), StopReason> {
        let now = self.steps();
        for (number, step) in now.iter().enumerate() {
            describe(step, shown.get(number), show, names)?;
        }
        *shown = now;
        Ok(())
    }
}

impl Mes {
    pub(crate) fn new(tool: PathBuf, port: u16) -> Self {
        Self { tool, port }
    }

    /// Waits until the plan of a process has a skill for each step or, without `complete`, until a
    /// step has no skill. Returns the waiting time in ms.
    pub(crate) async fn planned(&self, process: &str, complete: bool) -> Result<f64, StopReason> {
        let began = Instant::now();
        loop {
            let planned = self.run_tool(&["plan", process, "--json"]).await?;
            if planned.status.success() == complete {
                return Ok(began.elapsed().as_secs_f64() * 1e3);
            }
            if began.elapsed() > FOUND {
                let why = String::from_utf8_lossy(&planned.stdout).into_owned();
                let not = if complete { "no" } else { "still a" };
                return Err(StopReason::Broken(format!(
                    "the process has {not} complete plan after {FOUND:?}: {why}"
                )));
            }
            sleep(POLL).await;
        }
    }

    /// Starts a job. Returns the number of its run.
    pub(crate) async fn start(&self, process: &str) -> Result<u64, StopReason> {
        let ran = self.run_tool(&["job", "start", process]).await?;
        let said = String::from_utf8_lossy(&ran.stdout).into_owned();
        let number = said
            .strip_prefix("job ")
            .and_then(|rest| rest.split_once(':'));
        let number = number.and_then(|(number, _)| number.parse().ok());
        number.ok_or_else(|| {
            let why = String::from_utf8_lossy(&ran.stderr).into_owned();
            StopReason::Broken(format!("the process is not started: {said}{why}"))
        })
    }

    /// Prints the steps of a run until it has ended, and returns them. `steps` has the steps so far
    /// at any time.
    ///
    /// # Errors
    /// The run does not end, or is not done.
    pub(crate) async fn follow(
        &self,
        number: u64,
        show: &mut Show,
        names: &[&'static str],
        steps: &mut Vec<StepRun>,
    ) -> Result<(), StopReason> {
        let began = Instant::now();
        loop {
            if let Some(run) = self.run(number).await? {
                run.show_news(steps, show, names)?;
                match run.outcome.as_str() {
                    "running" => {}
                    "done" => return Ok(()),
                    other => {
                        let why = run.reason.unwrap_or_default();
                        return Err(StopReason::Broken(format!("the process is {other}: {why}")));
                    }
                }
            }
            if began.elapsed() > RUN_LIMIT {
                return Err(StopReason::Broken(format!(
                    "the process does not end within {RUN_LIMIT:?}"
                )));
            }
            sleep(POLL).await;
        }
    }

    /// Returns the state of a run; `None` before it has begun.
    pub(crate) async fn run(&self, number: u64) -> Result<Option<JobRun>, StopReason> {
        let end = format!("-{number}");
        let runs = self.page().await?.runs.into_iter();
        let mut found = runs.filter(|run| run.run.ends_with(&end));
        Ok(found.next())
    }

    /// Returns the names of the components in the graph.
    pub(crate) async fn components(&self) -> Result<Vec<String>, StopReason> {
        let components = self.page().await?.components.into_iter();
        Ok(components.map(|component| component.name).collect())
    }

    async fn page(&self) -> Result<Page, StopReason> {
        let page = fetch(self.port).await;
        page.map_err(|error| StopReason::Broken(format!("ua-mes does not answer: {error}")))
    }

    /// Runs `ua-space` to its end.
    async fn run_tool(&self, arguments: &[&str]) -> Result<Output, StopReason> {
        let url = format!("http://{LOOPBACK}:{}", self.port);
        let run = command(&self.tool)
            .args(arguments)
            .args(["--url", &url])
            .stdin(Stdio::null())
            .output();
        let ran = timeout(TOOL_LIMIT, run).await;
        let ran = ran.map_err(|_late| StopReason::Broken("`ua-space` does not end".to_owned()))?;
        ran.map_err(|error| StopReason::Broken(format!("cannot run `ua-space`: {error}")))
    }
}

/// Prints the beginning and the end of a step. `before` is the step as it was printed last.
fn describe(
    step: &StepRun,
    before: Option<&StepRun>,
    show: &mut Show,
    names: &[&'static str],
) -> Result<(), StopReason> {
    let name = names.iter().find(|name| step.component.contains(**name));
    let who = EventSource(name.copied().unwrap_or("component"), "36");
    if before.is_none() {
        let parameters = Value::from(step.parameters.clone());
        show.note(who, format!("`{}` begins with {parameters}", step.step))?;
    }
    let was_running = before.is_none_or(|before| before.outcome == "running");
    if was_running && step.outcome != "running" {
        let results = match step.results.is_empty() {
            true => String::new(),
            false => format!(", {}", Value::from(step.results.clone())),
        };
        show.note(
            who,
            format!("`{}` ends: {}{results}", step.step, step.outcome),
        )?;
    }
    Ok(())
}

/// The name of the MES in the timeline.
pub(crate) const MES_WHO: EventSource = EventSource("ua-mes", "35");
const POLL: Duration = Duration::from_millis(100);
const TOOL_LIMIT: Duration = Duration::from_secs(20);
/// Time limit until all skills are found, and until a component is lost.
const FOUND: Duration = Duration::from_secs(60);
const RUN_LIMIT: Duration = Duration::from_secs(240);
