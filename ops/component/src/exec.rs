//! A skill that a program of the user executes: a process for each run, and a JSON object in each
//! line.
//!
//! The process leads a process group of its own. A program that does not obey is killed with its
//! group. Then the state of its machine is unknown: the `stop` command runs, and the skill
//! needs a Reset.

use std::path::Path;
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use rustix::process::{Pid, Signal, kill_process_group};
use serde_json::{Value as Json, json};
use skills::{Component, Driver, DriverError, DriverSetup, ExecWork, RunResults, SkillValue, Work};
use tokio::io::{
    AsyncBufRead, AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader,
};
use tokio::process::{Child, ChildStdin, Command};
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{info, warn};

mod sensor;

/// The JSON schema of the lines of programs.
pub(crate) const SCHEMA: &str = include_str!("exec/lines.schema.json");

/// Replaces the description of programs by drivers and sensors that run them.
pub(crate) fn with_programs(mut component: Component) -> Component {
    sensor::with_sensors(&mut component);
    for skill in &mut component.skills {
        if let DriverSetup::Exec(work) = &skill.driver {
            let driver = Program {
                skill: skill.name.clone(),
                work: ExecWork::clone(work),
            };
            skill.driver = DriverSetup::Given(std::sync::Arc::new(driver));
        }
    }
    component
}

#[derive(Debug)]
struct Program {
    skill: String,
    work: ExecWork,
}

/// The end of a program.
enum Ended {
    /// The program has reported the results, or why the work is not done.
    Told(Result<RunResults, String>),
    /// The program has not obeyed, or has ended without a result: the state of the machine is
    /// unknown.
    Unknown(String),
}

#[async_trait]
impl Driver for Program {
    /// Halt waits for the program, and for the `stop` command.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(self.work.halt_timeout + STOP_WITHIN + ENDS_WITHIN)
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let child = start(&self.work.command, &self.work.folder, [Stdio::piped; 2]);
        let mut child = child.map_err(DriverError::reported)?;
        let group = group_of(&child);
        let _group = KilledGroup(group);
        let ended = self.follow(&mut child, &work).await;
        match ended {
            Ended::Told(result) => {
                // The result counts; a program that stays is killed with its group.
                let _ended = timeout(ENDS_WITHIN, child.wait()).await;
                result.map_err(DriverError::reported)
            }
            Ended::Unknown(why) => {
                kill(group);
                let stopped = self.stop().await;
                let why = format!("the outcome is unknown: {why}; {stopped}");
                work.unknown(&why).await;
                Err(DriverError::reported(why))
            }
        }
    }
}

impl Program {
    /// Follows a run to its end.
    async fn follow(&self, child: &mut Child, work: &Work) -> Ended {
        let unknown = |why: &str| Ended::Unknown(format!("{}: {why}", self.name()));
        let (Some(mut input), Some(output)) = (child.stdin.take(), child.stdout.take()) else {
            return unknown("its input and output are not connected");
        };
        let errors = child.stderr.take();
        let last_error = LastLine::default();
        let logging = async {
            if let Some(errors) = errors {
                log(&self.skill, BufReader::new(errors), &last_error).await;
            }
        };
        let mut output = BufReader::new(output);
        let parameters = work.parameters().all().iter();
        let parameters: serde_json::Map<String, Json> = parameters
            .map(|(name, value)| (name.clone(), value.to_json()))
            .collect();
        let mut start = json!({"skill": self.skill, "run": work.run(), "parameters": parameters});
        let configured = work.configuration().iter();
        let configured: serde_json::Map<String, Json> = configured
            .map(|(name, value)| (name.clone(), value.to_json()))
            .collect();
        if let (false, Some(start)) = (configured.is_empty(), start.as_object_mut()) {
            start.insert("configuration".to_owned(), Json::Object(configured));
        }
        let start = json!({"start": start});
        // A program that reads nothing may have written its result and ended.
        let deaf = send(&mut input, &start).await.err();
        let mut until = deaf.as_ref().map(|_| Instant::now() + SENT_WITHIN);
        work.step("Run").await;
        tokio::pin!(logging);
        let mut line = Vec::new();
        let mut is_logged = false;
        loop {
            tokio::select! {
                read = next_line(&mut output, &mut line) => {
                    let told = match read {
                        Ok(Some(text)) => reported(&text),
                        Ok(None) => {
                            // The reason is on its standard error, which its descendants keep open.
                            kill(group_of(child));
                            if !is_logged {
                                let _ended = timeout(ERRORS_WITHIN, &mut logging).await;
                            }
                            return unknown(&last_error.after("it has ended without a result"));
                        }
                        Err(why) => Err(why),
                    };
                    match told {
                        Ok(Report::Ended(result)) => return Ended::Told(result),
                        Ok(Report::Progress { progress, step, note }) => {
                            if let Some(progress) = progress {
                                work.progress(progress);
                            }
                            if let Some(step) = step {
                                work.step(step).await;
                            }
                            if let Some(note) = note {
                                work.note(note).await;
                            }
                        }
                        Err(why) => return unknown(&why),
                    }
                }
                () = work.stopped(), if until.is_none() => {
                    until = Some(Instant::now() + self.work.halt_timeout);
                    work.pending(format!("{} is asked to halt", self.name())).await;
                    if let Err(why) = send(&mut input, &json!({"halt": {"run": work.run()}})).await {
                        return unknown(&why);
                    }
                }
                () = at(until) => {
                    if let Some(why) = &deaf {
                        return unknown(why);
                    }
                    let limit = self.work.halt_timeout;
                    return unknown(&format!("it has not halted within {limit:?} and was killed"));
                }
                () = &mut logging, if !is_logged => is_logged = true,
            }
        }
    }

    /// Runs the command that stops the machine. Returns its outcome as text.
    async fn stop(&self) -> String {
        let Some(command) = &self.work.stop else {
            return "there is no `stop` command".to_owned();
        };
        let mut child = match start(command, &self.work.folder, [Stdio::null; 2]) {
            Ok(child) => child,
            Err(why) => return format!("the `stop` command has failed: {why}"),
        };
        let _group = KilledGroup(group_of(&child));
        match timeout(STOP_WITHIN, child.wait()).await {
            Ok(Ok(status)) if status.success() => "the `stop` command is done".to_owned(),
            Ok(Ok(status)) => format!("the `stop` command has failed: {status}"),
            Ok(Err(error)) => format!("the `stop` command has failed: {error}"),
            Err(_) => format!("the `stop` command has not ended within {STOP_WITHIN:?}"),
        }
    }

    fn name(&self) -> &str {
        self.work.command.first().map_or("", String::as_str)
    }
}

/// Starts a command without the environment of this program, which may contain secrets. The
/// streams are the input, and the output with the errors.
fn start(
    command: &[String],
    folder: &Path,
    [input, output]: [fn() -> Stdio; 2],
) -> Result<Child, String> {
    let (program, arguments) = command.split_first().ok_or("no program is named")?;
    let kept = KEPT_VARIABLES.iter();
    let kept = kept.filter_map(|name| Some((*name, std::env::var_os(name)?)));
    let started = Command::new(program)
        .args(arguments)
        .current_dir(folder)
        .env_clear()
        .envs(kept)
        .stdin(input())
        .stdout(output())
        .stderr(output())
        .process_group(0)
        .kill_on_drop(true)
        .spawn();
    started.map_err(|error| format!("cannot start {program}: {error}"))
}

/// Returns the process group that a program leads.
fn group_of(child: &Child) -> Option<Pid> {
    let id = child.id().and_then(|id| i32::try_from(id).ok());
    id.and_then(Pid::from_raw)
}

/// Kills a process group when it is dropped, so that no descendant outlives its run.
struct KilledGroup(Option<Pid>);

impl Drop for KilledGroup {
    fn drop(&mut self) {
        kill(self.0);
    }
}

fn kill(group: Option<Pid>) {
    if let Some(group) = group {
        // An error means that no process of the group is left.
        let _killed = kill_process_group(group, Signal::KILL);
    }
}

async fn at(until: Option<Instant>) {
    match until {
        Some(until) => sleep_until(until).await,
        None => std::future::pending().await,
    }
}

async fn send(input: &mut ChildStdin, message: &Json) -> Result<(), String> {
    let line = format!("{message}\n");
    let written = async {
        input.write_all(line.as_bytes()).await?;
        input.flush().await
    };
    match timeout(SENT_WITHIN, written).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(error)) => Err(format!("it reads no messages: {error}")),
        Err(_) => Err(format!("it reads no messages within {SENT_WITHIN:?}")),
    }
}

/// Returns the next line without its end; `None` at the end of the output. Cancel safe: an
/// incomplete line stays in `line`.
async fn next_line(
    output: &mut (impl AsyncBufRead + Unpin),
    line: &mut Vec<u8>,
) -> Result<Option<String>, String> {
    loop {
        let room = LONGEST_LINE.saturating_sub(u64::try_from(line.len()).unwrap_or(u64::MAX));
        let read = (&mut *output).take(room).read_until(b'\n', line).await;
        let count = read.map_err(|error| format!("its output cannot be read: {error}"))?;
        if line.last() == Some(&b'\n') {
            let text = String::from_utf8_lossy(line).trim().to_owned();
            line.clear();
            if text.is_empty() {
                continue;
            }
            return Ok(Some(text));
        }
        if room == 0 {
            return Err(format!(
                "it has written a line of more than {LONGEST_LINE} bytes"
            ));
        }
        if count == 0 {
            return Ok(None);
        }
    }
}

/// The last line of the standard error of a program.
#[derive(Debug, Default)]
struct LastLine(Mutex<String>);

impl LastLine {
    fn put(&self, text: &str) {
        if !text.is_empty() {
            let shown = text.chars().take(LONGEST_ERROR).collect();
            *self.0.lock().unwrap_or_else(PoisonError::into_inner) = shown;
        }
    }

    /// Returns a reason with the line, if there is one.
    fn after(&self, reason: &str) -> String {
        let line = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match line.is_empty() {
            true => reason.to_owned(),
            false => format!("{reason}, and its last error is `{}`", line.escape_debug()),
        }
    }
}

/// Logs the standard error of a program to its end.
async fn log(skill: &str, mut errors: impl AsyncBufRead + Unpin, last: &LastLine) {
    let mut line = Vec::new();
    loop {
        match next_line(&mut errors, &mut line).await {
            Ok(Some(text)) => {
                last.put(&text);
                show(skill, &text);
            }
            Ok(None) => {
                let text = String::from_utf8_lossy(&line);
                last.put(&text);
                return show(skill, &text);
            }
            Err(_) if line.is_empty() => return,
            Err(_) => {
                show_discarded(skill);
                line.clear();
            }
        }
    }
}

fn show(skill: &str, text: &str) {
    if !text.is_empty() {
        info!(skill, "{}", text.escape_debug());
    }
}

fn show_discarded(skill: &str) {
    warn!(
        skill,
        "discarded a part of a long line of the standard error"
    );
}

/// A line of a program.
#[derive(Debug, PartialEq)]
enum Report {
    Progress {
        progress: Option<f32>,
        step: Option<String>,
        note: Option<String>,
    },
    Ended(Result<RunResults, String>),
}

/// The keys of a line of a program.
const KEYS: [&str; 5] = ["progress", "step", "note", "result", "failed"];

fn reported(text: &str) -> Result<Report, String> {
    let shown: String = text.chars().take(80).collect();
    let wrong = |why: &str| format!("its line `{shown}` {why}");
    let Ok(Json::Object(line)) = serde_json::from_str(text) else {
        return Err(wrong("is not a JSON object"));
    };
    if let Some(other) = line.keys().find(|key| !KEYS.contains(&key.as_str())) {
        let known = KEYS.join(", ");
        return Err(wrong(&format!("has the key `{other}`; known are {known}")));
    }
    let text_of = |key: &str| match line.get(key) {
        None => Ok(None),
        Some(Json::String(text)) => Ok(Some(text.clone())),
        Some(_) => Err(wrong(&format!("has a `{key}` that is not a text"))),
    };
    if let Some(why) = text_of("failed")? {
        return Ok(Report::Ended(Err(why)));
    }
    match line.get("result") {
        Some(Json::Object(results)) => {
            let results = results.iter().map(|(name, value)| {
                let value = SkillValue::of_json(value);
                let value = value
                    .ok_or_else(|| wrong(&format!("has a result `{name}` of a wrong type")))?;
                Ok((name.clone(), value))
            });
            return results
                .collect::<Result<_, String>>()
                .map(|results| Report::Ended(Ok(results)));
        }
        Some(_) => return Err(wrong("has a `result` that is not an object")),
        None => {}
    }
    let progress = match line.get("progress") {
        None => None,
        #[expect(clippy::cast_possible_truncation, reason = "a fraction from 0 to 1")]
        Some(number) => match number.as_f64() {
            Some(number) if (0.0..=1.0).contains(&number) => Some(number as f32),
            Some(_) | None => return Err(wrong("has a `progress` that is not from 0 to 1")),
        },
    };
    Ok(Report::Progress {
        progress,
        step: text_of("step")?,
        note: text_of("note")?,
    })
}

/// The environment variables that a program keeps.
const KEPT_VARIABLES: [&str; 5] = ["PATH", "HOME", "LANG", "TZ", "PYTHONPATH"];
/// Longest line of a program, in bytes.
const LONGEST_LINE: u64 = 64 << 10;
/// Time for the standard error of a program that has ended and was killed. The machine is stopped
/// after it.
const ERRORS_WITHIN: Duration = Duration::from_millis(100);
/// Characters of the last error of a program in a reason.
const LONGEST_ERROR: usize = 160;
/// Time limit for the `stop` command.
const STOP_WITHIN: Duration = Duration::from_secs(5);
/// Time after its result in which a program ends by itself.
const ENDS_WITHIN: Duration = Duration::from_secs(1);
/// Time limit for a program to read a message.
const SENT_WITHIN: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests;
