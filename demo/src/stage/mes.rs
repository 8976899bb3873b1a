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
    runs: Vec<Run>,
}

#[derive(Debug, Deserialize)]
struct Run {
    run: String,
    outcome: String,
    reason: Option<String>,
    plans: Vec<Planned>,
}

#[derive(Debug, Deserialize)]
struct Planned {
    ran: Vec<StepRun>,
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
        let end = format!("-{number}");
        let began = Instant::now();
        loop {
            let page: Page = fetch(self.port)
                .await
                .map_err(|error| StopReason::Broken(format!("ua-mes does not answer: {error}")))?;
            let run = page.runs.into_iter().find(|run| run.run.ends_with(&end));
            if let Some(run) = run {
                let now: Vec<StepRun> = run.plans.into_iter().flat_map(|plan| plan.ran).collect();
                for (number, step) in now.iter().enumerate() {
                    describe(step, steps.get(number), show, names)?;
                }
                *steps = now;
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
