//! Jobs: runs of processes that clients start over HTTP, several at a time.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use futures_util::future::join_all;
use knowledge::Configuring;
use mtp::product_configuration;
use serde::Serialize;
use skills::JobObserver;
use tokio::runtime::Handle;
use tokio::sync::watch;

use crate::cell::PlantState;
use crate::clock::now;
use crate::execute::{Plant, execute_pausable};
use crate::job_order::{JobOutcome, JobProgress};
use crate::job_orders::JobRuns;
use crate::process::StepJob as Work;
use crate::product_configuration::configure;
use crate::record::{How, ProcessRun};

/// The jobs.
pub(crate) struct ProcessJobs {
    cell: Arc<PlantState>,
    runtime: Handle,
    all: Arc<Mutex<BTreeMap<u64, Job>>>,
    /// Held while a product is configured.
    configuring: Arc<tokio::sync::Mutex<()>>,
}

/// A job.
#[derive(Debug, Clone, Serialize)]
struct Job {
    job: u64,
    process: String,
    outcome: How,
    /// The current step of a running job.
    step: Option<String>,
    /// The missing components that it waits for.
    waits_for: Option<String>,
    reason: Option<String>,
    /// The IRI of its run in the graph.
    run: Option<String>,
    started_ms: u64,
    ended_ms: Option<u64>,
    /// Components that no other run may use, because the outcome is unknown.
    holds: Vec<String>,
    /// Whether no further step begins.
    paused: bool,
    #[serde(skip)]
    can_pause: bool,
    #[serde(skip)]
    stop: watch::Sender<bool>,
    #[serde(skip)]
    pause: watch::Sender<bool>,
}

impl ProcessJobs {
    /// Creates the jobs of a plant, which run in this runtime.
    pub(crate) fn new(cell: Arc<PlantState>, runtime: Handle) -> Self {
        Self {
            cell,
            runtime,
            all: Arc::default(),
            configuring: Arc::default(),
        }
    }
}

impl knowledge::JobRunner for ProcessJobs {
    fn start(&self, process: &str) -> Result<Option<u64>, String> {
        let process = self.cell.process(process)?;
        let number = self.cell.next_run();
        let (stop, stopped) = watch::channel(false);
        let (pause, paused) = watch::channel(false);
        {
            let mut all = locked(&self.all);
            let running = all.values().filter(|job| job.outcome == How::Running);
            if running.count() >= MOST_AT_ONCE {
                return Ok(None);
            }
            let job = Job {
                job: number,
                process: process.iri.clone(),
                outcome: How::Running,
                step: None,
                waits_for: None,
                reason: None,
                run: None,
                started_ms: now(),
                ended_ms: None,
                holds: Vec::new(),
                paused: false,
                can_pause: matches!(process.work, Work::Sequence),
                stop,
                pause,
            };
            all.insert(number, job);
            while all.len() > MOST_JOBS {
                let mut ended = all.values().filter(|job| job.is_over());
                let Some(oldest) = ended.next().map(|job| job.job) else {
                    break;
                };
                all.remove(&oldest);
            }
        }
        let (cell, all) = (Arc::clone(&self.cell), Arc::clone(&self.all));
        drop(self.runtime.spawn(async move {
            let telling = Telling {
                number,
                all: Arc::clone(&all),
                stopped,
            };
            let plant: Arc<dyn Plant> = Arc::clone(&cell) as Arc<dyn Plant>;
            let run = execute_pausable(&plant, &process, number, (&telling, paused)).await;
            let holds = cell.used_by(&run.run);
            ended(&all, number, run, holds);
        }));
        Ok(Some(number))
    }

    fn stop(&self, number: u64) -> bool {
        let run = {
            let mut all = locked(&self.all);
            let Some(job) = all.get_mut(&number) else {
                return false;
            };
            job.stop.send_replace(true);
            job.holds.clear();
            job.run.clone().filter(|_| job.outcome == How::Unknown)
        };
        if let Some(run) = run {
            self.cell.give_back(&run);
        }
        true
    }

    fn configure(&self, document: Vec<u8>, checks_only: bool) -> Configuring {
        let (cell, runtime) = (Arc::clone(&self.cell), self.runtime.clone());
        let alone = Arc::clone(&self.configuring);
        Box::pin(async move {
            let text = String::from_utf8(document);
            let text = text.map_err(|_| "the document is not UTF-8".to_owned())?;
            let named = product_configuration(&text).map_err(|fault| fault.to_string())?;
            let alone = alone.try_lock_owned();
            let alone = alone.map_err(|_| "another product is being configured".to_owned())?;
            // A configuration that has begun ends also if its client leaves.
            let configured = runtime.spawn(async move {
                let _alone = alone;
                let components = join_all(named.iter().map(|of| cell.configured(of))).await;
                configure(&components, checks_only).await
            });
            let report = configured.await.map_err(|error| error.to_string())?;
            serde_json::to_value(&report).map_err(|error| error.to_string())
        })
    }

    fn list(&self) -> serde_json::Value {
        let mut jobs: Vec<Job> = locked(&self.all).values().cloned().collect();
        for run in self.cell.runs() {
            let number = run.number();
            if let Some(job) = jobs.iter_mut().find(|job| Some(job.job) == number) {
                job.waits_for.clone_from(&run.waits_for);
                job.run = Some(run.run);
            }
        }
        serde_json::json!({ "jobs": jobs })
    }
}

impl JobRuns for ProcessJobs {
    fn is_process(&self, process: &str) -> bool {
        let known = self.cell.processes();
        known.all.iter().any(|known| known.iri == process)
    }

    fn start(&self, process: &str) -> Result<Option<u64>, String> {
        knowledge::JobRunner::start(self, process)
    }

    fn stop(&self, job: u64) {
        knowledge::JobRunner::stop(self, job);
    }

    fn pause(&self, job: u64, is_paused: bool) -> bool {
        let mut all = locked(&self.all);
        let job = all.get_mut(&job);
        let Some(job) = job.filter(|job| job.outcome == How::Running && job.can_pause) else {
            return false;
        };
        job.paused = is_paused;
        job.pause.send_replace(is_paused);
        true
    }

    fn progress(&self, job: u64) -> Option<JobProgress> {
        let known = locked(&self.all).get(&job).cloned()?;
        let mut runs = self.cell.runs().into_iter();
        let run = runs.find(|run| run.number() == Some(job));
        let ran = run
            .iter()
            .flat_map(|run| &run.plans)
            .flat_map(|plan| &plan.ran);
        let results = ran.clone().flat_map(|ran| {
            let one = |(name, value): (&String, &serde_json::Value)| {
                (format!("{}.{name}", ran.step), value.clone())
            };
            ran.results.iter().map(one)
        });
        let is_at_rest = ran.clone().all(|ran| ran.outcome != How::Running);
        Some(JobProgress {
            is_paused: known.paused && is_at_rest,
            outcome: match known.outcome {
                How::Running => JobOutcome::Running,
                How::Done => JobOutcome::Done,
                How::Failed | How::Stopped => JobOutcome::Failed,
                How::Lost | How::Unknown => JobOutcome::Unknown,
            },
            reason: known.reason,
            started_ms: known.started_ms,
            ended_ms: known.ended_ms,
            results: results.collect(),
        })
    }
}

impl Job {
    /// Returns whether it has ended and holds no components.
    fn is_over(&self) -> bool {
        self.outcome != How::Running && self.holds.is_empty()
    }
}

fn ended(all: &Mutex<BTreeMap<u64, Job>>, number: u64, run: ProcessRun, holds: Vec<String>) {
    if let Some(job) = locked(all).get_mut(&number) {
        job.paused = false;
        job.outcome = run.outcome;
        job.reason = run.reason;
        job.run = Some(run.run);
        job.ended_ms = run.ended_ms;
        job.step = None;
        job.holds = holds;
    }
}

fn locked(all: &Mutex<BTreeMap<u64, Job>>) -> MutexGuard<'_, BTreeMap<u64, Job>> {
    all.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps the step of a job, and stops its run on request.
struct Telling {
    number: u64,
    all: Arc<Mutex<BTreeMap<u64, Job>>>,
    stopped: watch::Receiver<bool>,
}

#[async_trait]
impl JobObserver for Telling {
    async fn step(&self, step: &'static str) {
        if let Some(job) = locked(&self.all).get_mut(&self.number) {
            job.step = Some(step.to_owned());
        }
    }

    async fn stopped(&self) {
        let mut stopped = self.stopped.clone();
        if stopped.wait_for(|stopped| *stopped).await.is_err() {
            // The job was removed from the list, which only happens after its end.
            std::future::pending::<()>().await;
        }
    }
}

/// Maximum number of running jobs.
const MOST_AT_ONCE: usize = 16;
/// Maximum number of jobs; the oldest ended jobs are removed.
const MOST_JOBS: usize = 100;
