//! `ua-space job`: starts, lists and stops runs of processes.

use std::io::{self, Write as _};
use std::time::Duration;

use serde::Deserialize;

use crate::arguments::{JobArguments, JobVerb, SourceAt};
use crate::ask::refusal;
use crate::exit::CommandFailure;
use crate::http::HttpServer;
use crate::live::{TextTable, harmless, is_coloured};
use crate::report::say;
use crate::source::change;
use crate::survey::look;

/// Runs `ua-space job`.
pub(crate) fn job(arguments: &JobArguments) -> Result<(), CommandFailure> {
    match &arguments.verb {
        JobVerb::Start { process, wait, at } => {
            let body = serde_json::json!({ "process": process }).to_string();
            let answer = change("POST", "/jobs", ("application/json", body.into_bytes()), at)?;
            let started: Started = read(&answer.body)?;
            say(&format!("job {}: started", started.job))?;
            if *wait {
                follow(started.job, at)
            } else {
                Ok(())
            }
        }
        JobVerb::List { json, at } => list(*json, at),
        JobVerb::Stop { number, at } => {
            change("DELETE", &format!("/jobs/{number}"), ("", Vec::new()), at)?;
            // The running skill may still move, and a job that has ended is not stopped.
            say(&format!(
                "job {number}: stop requested; `ua-space job list` shows its end"
            ))
        }
    }
}

#[derive(Debug, Deserialize)]
struct Started {
    job: u64,
}

#[derive(Debug, Deserialize)]
struct Jobs {
    jobs: Vec<Job>,
}

#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
struct Job {
    job: u64,
    process: String,
    outcome: String,
    step: Option<String>,
    waits_for: Option<String>,
    reason: Option<String>,
    #[serde(default)]
    holds: Vec<String>,
}

impl Job {
    /// Returns the remark of the list: the reason of the end, or what the job waits for.
    fn remark(&self) -> String {
        let waits = self.waits_for.as_ref().map(|what| format!("waits: {what}"));
        let mut said = self.reason.clone().or(waits).unwrap_or_default();
        if !self.holds.is_empty() {
            let holds = self.holds.join(", ");
            let number = self.job;
            said.push_str(&format!(
                "; no other job may use {holds} before `ua-space job stop {number}`"
            ));
        }
        said
    }

    /// Returns the line that `--wait` prints.
    fn line(&self) -> String {
        let step = self.step.as_deref().unwrap_or("-");
        let of = match self.outcome.as_str() {
            "running" => step,
            ended => ended,
        };
        let line = match self.remark().as_str() {
            "" => format!("job {}: {of}", self.job),
            remark => format!("job {}: {of}: {remark}", self.job),
        };
        harmless(&line)
    }

    /// Returns how `--wait` ends, if the job has ended.
    fn end(&self) -> Option<Result<(), CommandFailure>> {
        match self.outcome.as_str() {
            "running" => None,
            "done" => Some(Ok(())),
            "unknown" => Some(Err(CommandFailure::Unavailable(harmless(&self.line())))),
            _ => Some(Err(CommandFailure::Failed(harmless(&self.line())))),
        }
    }
}

fn read<'a, T: Deserialize<'a>>(body: &'a str) -> Result<T, CommandFailure> {
    serde_json::from_str(body)
        .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))
}

async fn jobs(server: &HttpServer) -> Result<(String, Vec<Job>), CommandFailure> {
    let answer = server.get("/jobs").await?;
    if answer.status != 200 {
        return Err(refusal(&answer));
    }
    let jobs: Jobs = read(&answer.body)?;
    Ok((answer.body, jobs.jobs))
}

/// Prints the changes of a job until it ends.
fn follow(number: u64, at: &SourceAt) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&at.mes.url)?;
    look(async {
        let mut last = None;
        loop {
            let (_, jobs) = jobs(&server).await?;
            let job = jobs.into_iter().find(|job| job.job == number);
            let job =
                job.ok_or_else(|| CommandFailure::Unavailable(format!("job {number} is gone")))?;
            if let Some(end) = job.end() {
                if end.is_ok() {
                    say(&job.line())?;
                }
                return end;
            }
            if last.as_ref() != Some(&job) {
                say(&job.line())?;
                last = Some(job);
            }
            tokio::time::sleep(AGAIN).await;
        }
    })
}

fn list(json: bool, at: &SourceAt) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&at.mes.url)?;
    look(async {
        let (body, jobs) = jobs(&server).await?;
        let mut out = io::stdout().lock();
        if json {
            writeln!(out, "{}", mappings::harmless_json(body.trim_end()))?;
            return Ok(());
        }
        let columns = ["JOB", "PROCESS", "OUTCOME", "STEP", "REMARK"];
        let mut table = TextTable::new(columns.map(str::to_owned));
        for job in &jobs {
            table.row([
                job.job.to_string(),
                job.process.clone(),
                job.outcome.clone(),
                job.step.clone().unwrap_or_else(|| "-".to_owned()),
                job.remark(),
            ]);
        }
        table.write(&mut out, is_coloured())?;
        Ok(())
    })
}

/// Pause between two looks at a job.
const AGAIN: Duration = Duration::from_millis(200);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_is_shown_with_its_step_its_wait_and_its_end() {
        let job = |outcome: &str, step: Option<&str>| Job {
            job: 7,
            process: "urn:p".to_owned(),
            outcome: outcome.to_owned(),
            step: step.map(str::to_owned),
            waits_for: None,
            reason: None,
            holds: Vec::new(),
        };
        let mut running = job("running", Some("Step"));
        assert_eq!(running.line(), "job 7: Step");
        assert!(running.end().is_none());
        running.waits_for = Some("grip needs a skill".to_owned());
        assert_eq!(running.line(), "job 7: Step: waits: grip needs a skill");
        assert!(matches!(job("done", None).end(), Some(Ok(()))));
        assert!(matches!(
            job("failed", None).end(),
            Some(Err(CommandFailure::Failed(_)))
        ));
        let mut unknown = job("unknown", None);
        unknown.reason = Some("no answer".to_owned());
        unknown.holds = vec!["urn:gripper".to_owned()];
        let expected = "job 7: unknown: no answer; no other job may use urn:gripper before `ua-space job stop 7`";
        assert_eq!(unknown.line(), expected);
        assert!(matches!(
            unknown.end(),
            Some(Err(CommandFailure::Unavailable(_)))
        ));
    }
}
