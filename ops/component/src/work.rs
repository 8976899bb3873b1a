//! A skill that is executed by a call or an action of the space: of ROS, of another component, or
//! of a server.

mod answer;

use std::hash::{BuildHasher as _, RandomState};
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use bridge_node::{AskError, AskErrorKind, CallDescription, CallField, CallRole};
use bytes::Bytes;
use mappings::TopicId;
use serde_json::Value as Json;
use skills::{
    Component, Driver, DriverError, DriverSetup, Parameters, RequestKind, RunResults, SpaceWork,
    Stopped, Work,
};
use tokio::time::sleep;

use self::answer::{AnsweredEnd, SpaceAnswer, is, plain};
use crate::asking::{Asking, RequestSender};
use crate::definition::field_name;
use crate::encoding::{NULL, block, bytes, encoded, no_time, nothing};
use crate::topics::Topics;

/// Returns the component with drivers for the skills that other participants of the space execute,
/// and with sensors for the values that they publish.
pub(crate) fn with_drivers(
    component: &Component,
    asking: &mut Asking,
    topics: &mut Topics,
) -> Component {
    let mut component = crate::exec::with_programs(component.clone());
    topics.add_sensors(&mut component);
    for skill in &mut component.skills {
        if let DriverSetup::Space(work) = &skill.driver
            && let Ok(topic) = work.topic.parse()
        {
            let driver = SpaceDriver {
                work: SpaceWork::clone(work),
                topic,
                asks: asking.asks(topic),
            };
            skill.driver = DriverSetup::Given(Arc::new(driver));
        }
    }
    component
}

#[derive(Debug)]
struct SpaceDriver {
    work: SpaceWork,
    topic: TopicId,
    asks: RequestSender,
}

#[async_trait]
impl Driver for SpaceDriver {
    fn halt_timeout(&self) -> Option<Duration> {
        Some(self.work.halt_timeout)
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let ended = match self.work.asked {
            RequestKind::Call => self.call(&work).await,
            RequestKind::Action => self.act(&work).await,
        };
        ended.map_err(DriverError::reported)
    }
}

/// The reason why a goal was not accepted.
enum NotSent {
    /// The goal was not executed.
    Never(String),
    /// The goal may be executed, or may be executed later.
    Unknown(String),
}

impl SpaceDriver {
    async fn call(&self, work: &Work) -> Result<RunResults, String> {
        let call = tokio::select! {
            () = work.stopped() => return Err(Stopped.to_string()),
            call = self.asks.known(self.topic, self.work.within) => call?,
        };
        let request = self.request(&call.request, work.parameters(), None)?;
        work.step("Asked").await;
        let mut asked = pin!(self.asks.ask(self.topic, request, self.work.within));
        let answer = tokio::select! {
            answer = &mut asked => answer,
            () = work.stopped() => {
                work.pending(format!(
                    "cancellation pending: the call {} cannot be cancelled, and its answer is awaited",
                    self.topic
                ))
                .await;
                asked.await
            }
        };
        if let Err(fault) = &answer
            && is_unknown(fault.as_ref())
        {
            work.unknown(why(fault.clone())).await;
        }
        let answer = SpaceAnswer::read(&answer.map_err(why)?, &call.response)?;
        self.outcome(&answer, "", work.parameters())
    }

    async fn act(&self, work: &Work) -> Result<RunResults, String> {
        let id = new_id();
        let sending = OnceLock::new();
        let sent = tokio::select! {
            () = work.stopped() => Err(NotSent::Unknown(Stopped.to_string())),
            sent = self.send(work, id, &sending) => sent,
        };
        // Without an action, no request was sent.
        let action = sending.get();
        let action = match (sent, action) {
            (Ok(()), Some(action)) => action,
            (Err(NotSent::Unknown(why)), Some(action)) => {
                // The goal may have been accepted, or may be accepted later.
                return self.withdraw(work, action, (id, &why)).await;
            }
            (Err(NotSent::Never(why) | NotSent::Unknown(why)), _) => return Err(why),
            (Ok(()), None) => return Err(format!("{} has no parts", self.topic)),
        };
        work.step("Accepted").await;
        let result = tokio::select! {
            () = work.stopped() => None,
            result = self.result(action, id) => Some(result),
        };
        let answer = match result {
            None => {
                let stopped = Stopped.to_string();
                return self.withdraw(work, action, (id, &stopped)).await;
            }
            Some(Err(why)) => {
                work.unknown(why.clone()).await;
                return Err(why);
            }
            Some(Ok(answer)) => answer,
        };
        match answer.end() {
            AnsweredEnd::Succeeded => self.outcome(&answer, "result.", work.parameters()),
            AnsweredEnd::Canceled => Err(answer.end_text("cancelled by somebody else")),
            AnsweredEnd::Aborted => Err(answer.end_text("aborted")),
            AnsweredEnd::NeverRan => Err(answer.end_text("rejected")),
            AnsweredEnd::Unknown => {
                let why = self.lost(&answer);
                work.unknown(why.clone()).await;
                Err(why)
            }
        }
    }

    /// Cancels the goal until its end is known.
    async fn withdraw(
        &self,
        work: &Work,
        action: &Action,
        (id, why): ([u8; 16], &str),
    ) -> Result<RunResults, String> {
        work.pending(format!(
            "cancellation pending: the goal at {} has not ended",
            self.topic
        ))
        .await;
        let ended = async {
            loop {
                let why = match self.result(action, id).await {
                    Ok(answer) => match answer.end() {
                        AnsweredEnd::Unknown => self.lost(&answer),
                        AnsweredEnd::Succeeded
                        | AnsweredEnd::Canceled
                        | AnsweredEnd::Aborted
                        | AnsweredEnd::NeverRan => {
                            return Ok(answer);
                        }
                    },
                    Err(why) => why,
                };
                work.unknown(why.clone()).await;
                // After Halt, the skill stays Running until its client knows that the outcome is
                // unknown.
                if !work.is_stopped() {
                    return Err(why);
                }
                sleep(ASK_AGAIN).await;
            }
        };
        let cancels = async {
            loop {
                if self.cancel(action, id).await == Some(REJECTED) {
                    work.cancel_refused(format!(
                        "the executor of {} refuses to cancel the goal, which goes on",
                        self.topic
                    ))
                    .await;
                }
                sleep(ASK_AGAIN).await;
            }
        };
        let answer = tokio::select! {
            answer = ended => answer?,
            never = cancels => never,
        };
        let why = |how: &str| match why == Stopped.to_string() {
            true => why.to_owned(),
            false => format!("{why}; {}", answer.end_text(how)),
        };
        match answer.end() {
            AnsweredEnd::Succeeded => self.outcome(&answer, "result.", work.parameters()),
            AnsweredEnd::Canceled => Err(why("cancelled")),
            AnsweredEnd::NeverRan => Err(why("rejected")),
            AnsweredEnd::Aborted | AnsweredEnd::Unknown => Err(why("aborted")),
        }
    }

    fn lost(&self, answer: &SpaceAnswer) -> String {
        format!(
            "the executor of {} has lost the goal, whose end is unknown: {}",
            self.topic,
            answer.text("message")
        )
    }

    /// Sends the goal. Returns when the goal is accepted. `sending` is set when the request is
    /// sent.
    async fn send(
        &self,
        work: &Work,
        id: [u8; 16],
        sending: &OnceLock<Action>,
    ) -> Result<(), NotSent> {
        let never = NotSent::Never;
        let goal = self.asks.known(self.topic, self.work.within).await;
        let goal = goal.map_err(never)?;
        let action = self.action(self.work.within).await.map_err(never)?;
        let request = self.request(&goal.request, work.parameters(), Some(id));
        let request = request.map_err(never)?;
        work.step("Sent").await;
        let _is_first = sending.set(action).is_ok();
        let answer = self.asks.ask(self.topic, request, self.work.within).await;
        let answer = answer.map_err(|fault| match is_unknown(fault.as_ref()) {
            true => NotSent::Unknown(why(fault)),
            false => NotSent::Never(why(fault)),
        })?;
        let answer = SpaceAnswer::read(&answer, &goal.response).map_err(NotSent::Unknown)?;
        if answer.field("accepted") != Some(&true.into()) {
            return Err(NotSent::Never(format!(
                "the goal is rejected: {}",
                answer.text("message")
            )));
        }
        Ok(())
    }

    /// Waits until the calls for cancelling goals and for their results have executors, and returns
    /// them.
    async fn action(&self, within: Duration) -> Result<Action, String> {
        let goal = self.asks.known(self.topic, within).await?;
        let CallRole::Goal(family) = goal.role else {
            return Err(format!("{} is a call and no action", self.topic));
        };
        let (cancel, result) = (self.part(family.cancel)?, self.part(family.result)?);
        let described = self.asks.known(result, within).await?;
        let cancels = self.asks.known(cancel, within).await?;
        Ok(Action {
            cancel,
            cancels,
            result,
            described,
        })
    }

    /// Returns a call of the action by its identifier.
    fn part(&self, id: u16) -> Result<TopicId, String> {
        let (space, namespace, _) = self.topic.triple();
        TopicId::new(space, namespace, id).ok_or_else(|| format!("{} names no parts", self.topic))
    }

    /// Waits for the end of the goal.
    async fn result(&self, action: &Action, id: [u8; 16]) -> Result<SpaceAnswer, String> {
        loop {
            let request = Bytes::from(block(&[bytes(&id)]));
            let fault = match self.asks.ask(action.result, request, RESULT_WITHIN).await {
                Ok(answer) => return SpaceAnswer::read(&answer, &action.described.response),
                Err(fault) => fault,
            };
            let goes_on = fault
                .as_ref()
                .is_some_and(|fault| fault.kind != AskErrorKind::Failed);
            // An executor that returns answers for its goals: its action may have been withdrawn
            // for a moment only, and after a restart it does not know them.
            if !goes_on || self.asks.known(action.result, RETURNS).await.is_err() {
                let topic = self.topic;
                return Err(format!(
                    "{topic} is gone, and the goal may go on: {}",
                    why(fault)
                ));
            }
            // The request has reached its time limit, or the executor is unreachable for the
            // moment.
            sleep(PAUSE).await;
        }
    }

    /// Sends a cancel request. Returns the code of `action_msgs/CancelGoal`, or `None` without an
    /// answer.
    async fn cancel(&self, action: &Action, id: [u8; 16]) -> Option<i64> {
        let request = Bytes::from(block(&[bytes(&id), no_time()]));
        let answer = self.asks.ask(action.cancel, request, CANCEL_WITHIN).await;
        let answer = SpaceAnswer::read(&answer.ok()?, &action.cancels.response).ok()?;
        answer.code()
    }

    /// Encodes the request: fields that the YAML file sets, parameters with the same names, and
    /// default values for the others.
    fn request(
        &self,
        takes: &[CallField],
        parameters: &Parameters,
        goal: Option<[u8; 16]>,
    ) -> Result<Bytes, String> {
        let prefix = if goal.is_some() { "goal." } else { "" };
        let own = |field: &CallField| {
            let name = field.name.strip_prefix(prefix);
            name.unwrap_or(&field.name).to_owned()
        };
        let none = |name: &str| format!("{} has no field `{name}`", self.topic);
        let named = self.work.request.iter();
        for (name, _) in named.clone() {
            if !takes.iter().any(|field| own(field) == *name) {
                return Err(none(name));
            }
        }
        let mut written = Vec::new();
        for taken in takes {
            if let (Some(id), GOAL_ID) = (goal, taken.name.as_str()) {
                written.push(bytes(&id));
                continue;
            }
            let name = own(taken);
            let said = named.clone().find(|(known, _)| *known == name);
            let of_its_name = || {
                let all = parameters.all().iter();
                let mut fit = all.filter(|(known, _)| {
                    known.eq_ignore_ascii_case(&name) || field_name(known) == name
                });
                fit.next().map(|(_, value)| value.to_json())
            };
            let value = match said {
                Some((_, source)) => {
                    let value = source.value(parameters, &|_| None);
                    Some(value.map_err(|error| error.to_string())?)
                }
                None => of_its_name(),
            };
            written.push(match value {
                Some(value) => {
                    let (_, namespace, _) = self.topic.triple();
                    encoded(taken, &value, namespace).map_err(|why| format!("{name}: {why}"))?
                }
                None if taken.optional => vec![NULL],
                None => nothing(taken)
                    .ok_or_else(|| format!("{name}: nothing is said of it, and it must be set"))?,
            });
        }
        Ok(Bytes::from(block(&written)))
    }

    /// Returns the results if the answer reports success.
    fn outcome(
        &self,
        answer: &SpaceAnswer,
        prefix: &str,
        parameters: &Parameters,
    ) -> Result<RunResults, String> {
        let of = |name: &str| answer.field(&format!("{prefix}{name}")).cloned();
        let message = of("message").and_then(|message| message.as_str().map(str::to_owned));
        let no = |name: &str, value: &Json| match &message {
            Some(message) if !message.is_empty() => Err(format!("{message} ({name} is {value})")),
            Some(_) | None => Err(format!("{name} is {value}")),
        };
        for (name, wanted) in &self.work.succeeds {
            let value = of(name).ok_or_else(|| format!("the answer has no field {name}"))?;
            if !is(&value, wanted) {
                return no(name, &value);
            }
        }
        if self.work.succeeds.is_empty()
            && let Some(value @ Json::Bool(false)) = of("success")
        {
            return no("success", &value);
        }
        let mut results = Vec::new();
        for (name, source) in &self.work.results {
            let value = source.value(parameters, &of);
            let value = value.map_err(|error| error.to_string())?;
            // The texts `true` and `false` become Booleans, because constants are written as texts.
            let value = match value.as_str() {
                Some("true") => true.into(),
                Some("false") => false.into(),
                Some(_) | None => value,
            };
            let value = plain(&value).ok_or_else(|| format!("{name} is nothing for a result"))?;
            results.push((name.clone(), value));
        }
        let said = |name: &str| self.work.results.iter().any(|(known, _)| known == name);
        results.extend(answer.results(prefix).filter(|(name, _)| !said(name)));
        Ok(results)
    }
}

/// An action with an accepted goal.
struct Action {
    cancel: TopicId,
    cancels: Arc<CallDescription>,
    result: TopicId,
    described: Arc<CallDescription>,
}

/// Returns true if the request may have been executed, or may be executed later.
fn is_unknown(fault: Option<&AskError>) -> bool {
    fault.is_none_or(|fault| fault.kind == AskErrorKind::Unknown)
}

fn new_id() -> [u8; 16] {
    let mut id = [0; 16];
    for place in id.chunks_exact_mut(8) {
        place.copy_from_slice(&RandomState::new().hash_one(0).to_le_bytes());
    }
    id
}

fn why(fault: Option<AskError>) -> String {
    let Some(fault) = fault else {
        return "the component ends".to_owned();
    };
    match fault.kind {
        AskErrorKind::Refused => format!("not executed: {fault}"),
        AskErrorKind::Failed => fault.to_string(),
        AskErrorKind::Unknown => format!("{fault}; whether it was executed is not known"),
    }
}

const GOAL_ID: &str = "goal_id";
/// Time limit of a single request for a result.
const RESULT_WITHIN: Duration = Duration::from_secs(30);
const CANCEL_WITHIN: Duration = Duration::from_secs(4);
/// Pause before a goal is cancelled again.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// Time that an executor has to return before the outcome of its goal is unknown.
const RETURNS: Duration = Duration::from_secs(3);
/// Pause before the result is requested again.
const PAUSE: Duration = Duration::from_millis(200);
/// ERROR_REJECTED of `action_msgs/CancelGoal`.
const REJECTED: i64 = 1;

#[cfg(test)]
mod tests;
