//! Skills and values of devices with an HTTP interface of their own: the YAML has the requests, and
//! where the state and the results are in the responses.
//!
//! A request that was sent and has no usable response may have been executed. Then the state of the
//! machine is unknown: the `stop` request is sent, and the skill needs a Reset.

mod template;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use serde_json::Value as Json;
use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode, YamlReader};
use skills::{
    Builtin, Driver, DriverError, InvalidParameter, Measured, Parameters, RunResults, SensorRead,
    SkillValue, UnknownValue, ValueSensor, ValueShape, Work,
};
use tokio::time::{Instant, sleep, sleep_until};

use self::template::{Template, plain};
use crate::http::HttpFault;
use crate::measuring::ticks;

/// A value at a JSON pointer (RFC 6901) and the values that it is compared with.
#[derive(Debug, Clone, PartialEq)]
struct Condition {
    pointer: String,
    values: Vec<String>,
}

impl Condition {
    fn holds(&self, answer: &Json) -> bool {
        let Some(found) = answer.pointer(&self.pointer) else {
            return false;
        };
        let text = found
            .as_str()
            .map_or_else(|| found.to_string(), str::to_owned);
        self.values.contains(&text)
    }
}

/// The polling of the state of a run.
#[derive(Debug, Clone, PartialEq)]
struct Poll {
    request: Template,
    every: Duration,
    done: Condition,
    failed: Option<Condition>,
    progress: Option<String>,
    step: Option<String>,
    reason: Option<String>,
}

impl Poll {
    /// Returns the reason of the failure that a response reports, if any.
    fn failure(&self, answer: &Json) -> Option<String> {
        if !self.failed.as_ref()?.holds(answer) {
            return None;
        }
        let why = text_at(self.reason.as_ref(), answer).filter(|why| !why.is_empty());
        let why = why.unwrap_or_else(|| "the device reports a failure".to_owned());
        Some(why.chars().take(LONGEST_REASON).collect())
    }

    /// Returns the progress in a response, from 0 to 1.
    fn progress(&self, answer: &Json) -> Option<f32> {
        let progress = answer.pointer(self.progress.as_ref()?)?.as_f64()?;
        #[expect(clippy::cast_possible_truncation, reason = "a fraction from 0 to 1")]
        let progress = progress.clamp(0.0, 1.0) as f32;
        Some(progress)
    }

    /// Reports the progress and the step in a response. `step` is the last reported step.
    async fn report(&self, answer: &Json, work: &Work, step: &mut Option<String>) {
        if let Some(progress) = self.progress(answer) {
            work.progress(progress);
        }
        let now = text_at(self.step.as_ref(), answer);
        if now.is_some() && now != *step {
            let shown: String = now.iter().flat_map(|now| now.chars()).take(80).collect();
            work.step(shown).await;
            *step = now;
        }
    }
}

/// Returns the value at a JSON pointer as text.
fn text_at(pointer: Option<&String>, answer: &Json) -> Option<String> {
    answer.pointer(pointer?).map(plain)
}

/// The driver of a skill.
#[derive(Debug, PartialEq)]
struct HttpSkill {
    start: Template,
    poll: Option<Poll>,
    /// The pointers of results by their names.
    results: BTreeMap<String, String>,
    stop: Option<Template>,
    /// Time limit of each response.
    within: Duration,
    halt_timeout: Duration,
}

/// The end of the work at the device.
enum Ended {
    Done(Json),
    Failed(HttpSkillError),
    Unknown(HttpSkillError),
}

/// The reason why the work is not done, or its end is unknown.
#[derive(Debug, thiserror::Error)]
enum HttpSkillError {
    #[error(transparent)]
    Http(#[from] HttpFault),
    /// The device reports a failure with this reason.
    #[error("{0}")]
    Reported(String),
    #[error("the work has not ended within {limit:?} after Halt")]
    NotHalted { limit: Duration },
    #[error("the state is unknown: {fault}")]
    Silent { fault: HttpFault },
    #[error("{name}: the response has no {pointer}")]
    NoResult { name: String, pointer: String },
    #[error("{name}: {pointer} has a wrong type")]
    ResultType { name: String, pointer: String },
    #[error("the outcome is unknown: {why}; {stop}")]
    Unknown { why: Box<Self>, stop: StopRequest },
}

impl From<HttpSkillError> for DriverError {
    fn from(error: HttpSkillError) -> Self {
        if let HttpSkillError::Reported(why) = error {
            return Self::reported(why);
        }
        Self::device(error)
    }
}

/// What became of the `stop` request after an unknown end.
#[derive(Debug, thiserror::Error)]
enum StopRequest {
    #[error("there is no `stop` request")]
    None,
    #[error("the `stop` request is done")]
    Done,
    #[error("the `stop` request has failed: {0}")]
    Failed(HttpFault),
}

#[async_trait]
impl Driver for HttpSkill {
    /// Halt waits for the end of the work, and for the response to the `stop` request.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(self.halt_timeout + self.within + self.within)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        let poll = self.poll.as_ref().map(|of| &of.request);
        let all = [Some(&self.start), poll, self.stop.as_ref()];
        for template in all.into_iter().flatten() {
            template.check(parameters)?;
        }
        Ok(())
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        work.step("Start").await;
        let unknown = match self.work(&work).await {
            // The state of the machine is unknown without its results.
            Ended::Done(answer) => match self.outcome(&answer) {
                Ok(results) => return Ok(results),
                Err(why) => why,
            },
            Ended::Failed(why) => return Err(why.into()),
            Ended::Unknown(why) => why,
        };
        let stop = match self.stop(work.parameters()).await {
            None => StopRequest::None,
            Some(Ok(())) => StopRequest::Done,
            Some(Err(fault)) => StopRequest::Failed(fault),
        };
        let why = Box::new(unknown);
        let error = HttpSkillError::Unknown { why, stop };
        work.unknown(error.to_string()).await;
        Err(error.into())
    }
}

impl HttpSkill {
    async fn work(&self, work: &Work) -> Ended {
        let is_stopped = || work.is_stopped();
        let starting = self
            .start
            .send_unless(work.parameters(), self.within, is_stopped);
        tokio::pin!(starting);
        let started = tokio::select! {
            started = &mut starting => started,
            () = work.stopped() => {
                work.pending("the device has not answered the start yet").await;
                // With polling, the stop follows the response: the device could start the work
                // after a stop that comes too early.
                if self.poll.is_none() && let Some(Err(fault)) = self.stop(work.parameters()).await {
                    return Ended::Unknown(fault.into());
                }
                starting.await
            }
        };
        let answer = match started {
            Ok(answer) => answer,
            Err(fault @ HttpFault::Unreachable(_)) => return Ended::Failed(fault.into()),
            // The status of a request that was not accepted.
            Err(fault @ HttpFault::Refused { status, .. }) if (400..500).contains(&status) => {
                return Ended::Failed(fault.into());
            }
            Err(fault) => return Ended::Unknown(fault.into()),
        };
        match &self.poll {
            None => Ended::Done(answer),
            Some(poll) => self.follow(poll, work).await,
        }
    }

    /// Polls the state until the work has ended.
    async fn follow(&self, poll: &Poll, work: &Work) -> Ended {
        work.step("Run").await;
        let mut answered = Instant::now();
        let mut until = None;
        // After a Halt without a `stop` request: the time of the next report that it is refused.
        let mut refusal = None;
        let mut step = None;
        loop {
            tokio::select! {
                () = sleep(poll.every) => {}
                () = work.stopped(), if until.is_none() && refusal.is_none() => {
                    match self.halt(work).await {
                        Some(Ok(())) => until = Some(Instant::now() + self.halt_timeout),
                        Some(Err(fault)) => return Ended::Unknown(fault.into()),
                        None => {
                            work.cancel_refused(NO_STOP).await;
                            refusal = Some(Instant::now() + REFUSED_AGAIN);
                        }
                    }
                }
                // A later Halt is refused too.
                () = at(refusal) => {
                    work.cancel_refused(NO_STOP).await;
                    refusal = Some(Instant::now() + REFUSED_AGAIN);
                }
                () = at(until) => {
                    let limit = self.halt_timeout;
                    return Ended::Unknown(HttpSkillError::NotHalted { limit });
                }
            }
            let within = self.within.min(LONGEST_SILENCE);
            // A slow response does not delay the stop.
            let asked = tokio::select! {
                asked = poll.request.send(work.parameters(), within) => asked,
                () = work.stopped(), if until.is_none() && refusal.is_none() => continue,
                () = at(until) => continue,
            };
            let answer = match asked {
                Ok(answer) => answer,
                Err(fault) if answered.elapsed() > LONGEST_SILENCE => {
                    return Ended::Unknown(HttpSkillError::Silent { fault });
                }
                Err(_) => continue,
            };
            answered = Instant::now();
            if poll.done.holds(&answer) {
                return Ended::Done(answer);
            }
            if let Some(why) = poll.failure(&answer) {
                return Ended::Failed(HttpSkillError::Reported(why));
            }
            poll.report(&answer, work, &mut step).await;
        }
    }

    /// Asks the device to stop on Halt; `None` if the YAML has no `stop` request.
    async fn halt(&self, work: &Work) -> Option<Result<(), HttpFault>> {
        if self.stop.is_some() {
            work.pending("the device is asked to stop").await;
        }
        self.stop(work.parameters()).await
    }

    /// Sends the `stop` request; `None` if there is none.
    async fn stop(&self, parameters: &Parameters) -> Option<Result<(), HttpFault>> {
        let stop = self.stop.as_ref()?;
        Some(stop.send(parameters, self.within).await.map(drop))
    }

    fn outcome(&self, answer: &Json) -> Result<RunResults, HttpSkillError> {
        let results = self.results.iter().map(|(name, pointer)| {
            let found = answer.pointer(pointer);
            let of = || (name.clone(), pointer.clone());
            let found = found.ok_or_else(|| {
                let (name, pointer) = of();
                HttpSkillError::NoResult { name, pointer }
            })?;
            let value = SkillValue::of_json(found);
            let value = value.ok_or_else(|| {
                let (name, pointer) = of();
                HttpSkillError::ResultType { name, pointer }
            })?;
            Ok((name.clone(), value))
        });
        results.collect()
    }
}

async fn at(until: Option<Instant>) {
    match until {
        Some(until) => sleep_until(until).await,
        None => std::future::pending().await,
    }
}

/// A value that is polled.
#[derive(Debug)]
struct HttpValue {
    request: Template,
    pointer: String,
    within: Duration,
}

#[async_trait]
impl ValueSensor for HttpValue {
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        loop {
            ticks.tick().await;
            let answer = match self.request.ask(self.within).await {
                Ok(answer) => answer,
                Err(fault) => return fault.to_string(),
            };
            match answer.pointer(&self.pointer) {
                Some(found) => out.put_single_json(found),
                None => {
                    let host = self.request.host();
                    let why = format!("the response of {host} has no {}", self.pointer);
                    out.put_single(Err(UnknownValue::Reported(why)));
                }
            }
        }
    }

    fn source(&self) -> String {
        self.request.to_string()
    }

    fn within(&self, period: Duration) -> Duration {
        (period * 10).max(self.within + self.within)
    }
}

/// Reads the value of the key `http` of a driver.
pub(crate) fn read(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Driver>> {
    let keys = ["start", "poll", "results", "stop", "within", "halt_timeout"];
    let [start, poll, results, stop, within, halt_timeout] = reader.map(node, keys)?;
    let start = reader
        .needed(start, "start", node.place)
        .and_then(|node| Template::read(node, "POST", reader));
    let poll = poll.map(|node| read_poll(node, reader));
    let results = results.map_or_else(|| Some(BTreeMap::new()), |node| read_results(node, reader));
    let stop = stop.map(|node| Template::read(node, "POST", reader));
    let within = within.map_or(Some(WITHIN), |node| reader.duration(node));
    let halt_timeout = halt_timeout.map_or(Some(HALT), |node| reader.duration(node));
    Some(Arc::new(HttpSkill {
        start: start?,
        poll: whole(poll)?,
        results: results?,
        stop: whole(stop)?,
        within: within?,
        halt_timeout: halt_timeout?,
    }))
}

/// Reads the source `http` of a value.
pub(crate) fn read_value(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<SensorRead> {
    let [url, pointer, within] = reader.map(node, ["url", "pointer", "within"])?;
    let request = reader
        .needed(url, "url", node.place)
        .and_then(|node| Template::read_url(node, "GET", reader));
    let pointer = match pointer {
        Some(node) => read_pointer(node, reader),
        None => Some(String::new()),
    };
    let within = within.map_or(Some(WITHIN), |node| reader.duration(node));
    let sensor = HttpValue {
        request: request?,
        pointer: pointer?,
        within: within?,
    };
    Some(SensorRead {
        sensor: Arc::new(sensor),
        shape: ValueShape::scalar(Builtin::Double),
    })
}

fn whole<T>(read: Option<Option<T>>) -> Option<Option<T>> {
    match read {
        Some(read) => read.map(Some),
        None => Some(None),
    }
}

fn read_poll(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Poll> {
    let keys = [
        "method", "url", "every", "done", "failed", "progress", "step", "reason",
    ];
    let [method, url, every, done, failed, progress, step, reason] = reader.map(node, keys)?;
    let method = match method.map(|node| reader.text(node, "GET or POST")) {
        None => Some("GET"),
        Some(Some(text @ ("GET" | "POST"))) => Some(text),
        Some(_) => {
            reader.wrong(node, "`method: GET` or `method: POST`");
            None
        }
    };
    let request = reader
        .needed(url, "url", node.place)
        .and_then(|node| Template::read_url(node, method.unwrap_or("GET"), reader));
    let every = every.map_or(Some(POLL), |node| reader.duration(node));
    let done = reader
        .needed(done, "done", node.place)
        .and_then(|node| read_condition(node, reader));
    let failed = failed.map(|node| read_condition(node, reader));
    let pointers = [progress, step, reason];
    let [progress, step, reason] =
        pointers.map(|node| whole(node.map(|node| read_pointer(node, reader))));
    method?;
    Some(Poll {
        request: request?,
        every: every?,
        done: done?,
        failed: whole(failed)?,
        progress: progress?,
        step: step?,
        reason: reason?,
    })
}

/// Reads `{/state: done}` or `{/state: [error, aborted]}`.
fn read_condition(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Condition> {
    let DocumentKind::Map(pairs) = &node.kind else {
        reader.wrong(node, "a map from a JSON pointer to values: {/state: done}");
        return None;
    };
    let [(pointer, values)] = pairs.as_slice() else {
        let message = "a condition has one JSON pointer: {/state: done}".to_owned();
        return reader.refuse(node, YamlFindingCode::WrongValue, message);
    };
    let pointer = read_pointer(pointer, reader)?;
    let values: Vec<String> = reader
        .list(values)
        .iter()
        .filter_map(|node| reader.text(node, "a value").map(str::to_owned))
        .collect();
    Some(Condition { pointer, values })
}

fn read_results(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<BTreeMap<String, String>> {
    let DocumentKind::Map(pairs) = &node.kind else {
        reader.wrong(
            node,
            "a map from results to JSON pointers: {Gripped: /gripped}",
        );
        return None;
    };
    let mut results = BTreeMap::new();
    for (key, value) in pairs {
        let name = reader.text(key, "the name of a result")?.to_owned();
        let pointer = read_pointer(value, reader)?;
        results.insert(name, pointer);
    }
    Some(results)
}

fn read_pointer(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "a JSON pointer, as /state")?;
    if text.is_empty() || text.starts_with('/') {
        return Some(text.to_owned());
    }
    let message = format!("expected a JSON pointer, as /state, found `{text}`");
    reader.refuse(node, YamlFindingCode::WrongValue, message)
}

/// Default time limit of a response.
const WITHIN: Duration = Duration::from_secs(2);
/// Default time from Halt until the outcome is unknown.
const HALT: Duration = Duration::from_secs(5);
/// Default period of polling.
const POLL: Duration = Duration::from_millis(100);
/// The longest time without a response to polling.
const LONGEST_SILENCE: Duration = Duration::from_secs(3);
const LONGEST_REASON: usize = 200;
const NO_STOP: &str = "the YAML has no `stop` request: the work goes on";
/// Time between two reports that a Halt is refused. It is shorter than the time in which a Halt
/// waits for the end of the work.
const REFUSED_AGAIN: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests;
