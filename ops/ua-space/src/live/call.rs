//! `ua-space call`: sends a request to a call of the space, and follows the run of a skill or the
//! goal of an action to its end.

mod executor;
mod goal;
pub(in crate::live) mod words;

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use serde::Serialize;
use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionMessage, ActionOutcome, ActionRequest,
    CallId, Requestor, RequestorSettings, ResponseMeaning,
};
use uadp::{Extras, OwnedPublisherId, StatusCode};

use self::executor::AnnouncedExecutor;
use super::book::{DatagramContent, NameKind};
use super::described::{self, AnnouncedDescription};
use super::plain::{self, NamedValues};
use super::run::{FollowedRun, RunEnd, RunEvent, RunTopics};
use super::text::{harmless, json};
use super::{Go, ListenEnd, Live, in_group, parameters, until};
use crate::arguments::{CallArguments, NamedTarget};
use crate::exit::CommandFailure;
use crate::report::warn;
use crate::status;

/// Runs `ua-space call`.
pub(crate) fn call(arguments: &CallArguments) -> Result<(), CommandFailure> {
    ask_for(arguments, true)
}

/// Calls without printing the response.
pub(super) fn call_quietly(arguments: &CallArguments) -> Result<(), CommandFailure> {
    ask_for(arguments, false)
}

fn ask_for(arguments: &CallArguments, is_told: bool) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |live| {
        let mut asking = Asking {
            live,
            requestor: requestor(),
            executor: AnnouncedExecutor::default(),
            arguments,
        };
        let (topic, described) = asking.find().await?;
        if let Some(parts) = goal::ActionParts::of(topic, &described) {
            return Box::pin(asking.send_goal((topic, &described), parts)).await;
        }
        let places = RunTopics::of(topic, &described.name);
        let takes = described.call().map_or(&[][..], |call| &call.request);
        let request = parameters::request(&arguments.parameters, takes).map_err(|wrong| {
            CommandFailure::Usage(format!("{}: {wrong}", called(topic, &described)))
        })?;
        let answer = asking
            .ask((topic, &described), &request, places.as_ref())
            .await?;
        if is_told {
            asking.tell_answer((topic, &described), &answer)?;
        }
        refused((topic, &described), &answer)?;
        match (places, answer.fields.number("run")) {
            (Some(places), Some(run)) if !arguments.no_wait && run > 0 => {
                asking.follow(&places, run).await
            }
            (Some(_) | None, Some(_) | None) => Ok(()),
        }
    })
}

/// Creates the requestor. Its PublisherId is in every request. The id is a String, so it cannot
/// equal the number of a space, even for peers that accept PublisherIds of any width. It has a
/// random part, because process ids of two hosts may be equal.
fn requestor() -> Requestor {
    let random = || RandomState::new().build_hasher().finish();
    let id = format!("ua-space-{}-{:08x}", std::process::id(), random() >> 32);
    let mut instance = [0; 16];
    for (place, bytes) in instance.chunks_exact_mut(8).zip([random(), random()]) {
        place.copy_from_slice(&bytes.to_le_bytes());
    }
    Requestor::new(
        OwnedPublisherId::String(id.into()),
        instance,
        RequestorSettings::default(),
    )
}

/// Returns the topic and name of a call for output.
fn called(topic: TopicId, described: &AnnouncedDescription) -> String {
    match described.name.as_str() {
        "" => topic.to_string(),
        name => format!("{topic} {}", harmless(name)),
    }
}

/// The response of a call.
struct CallAnswer {
    status: StatusCode,
    fields: NamedValues,
}

#[derive(Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
enum CallJson<'a> {
    Answer {
        topic: String,
        name: &'a str,
        status: u32,
        fields: &'a NamedValues,
    },
}

/// The outcome of a call.
enum Came {
    Answer(CallAnswer),
    Lost(String),
    Refused(String),
}

struct Asking<'a> {
    live: Live,
    requestor: Requestor,
    /// The sender that announced the call.
    executor: AnnouncedExecutor,
    arguments: &'a CallArguments,
}

impl Asking<'_> {
    /// Waits until the call is announced.
    async fn find(&mut self) -> Result<(TopicId, Arc<AnnouncedDescription>), CommandFailure> {
        let end = until(self.live.now(), Some(self.arguments.wait));
        let target = (&self.arguments.target, Some(NameKind::Call));
        let mut ignored = |_: DatagramContent<'_>, _| Go::On;
        let topic = self.live.resolve(target, end, &mut ignored).await?;
        let Some(topic) = topic else {
            return Err(self.not_found());
        };
        let mut found = self.announced(topic);
        if found.is_none() {
            let mut each = |news: DatagramContent<'_>, _| match news {
                DatagramContent::Announced {
                    topic: of,
                    kind: NameKind::Call,
                    described,
                    from,
                    ..
                } if of == topic => {
                    found = Some((Arc::clone(described), from));
                    Go::Enough
                }
                DatagramContent::Announced { .. }
                | DatagramContent::Sample(_)
                | DatagramContent::Response(..) => Go::On,
            };
            if self.live.listen(end, &mut each).await? == ListenEnd::Interrupted {
                return Err(CommandFailure::Interrupted);
            }
        }
        let Some((described, from)) = found else {
            return Err(self.not_found());
        };
        self.executor = AnnouncedExecutor::at(from);
        if self.live.book.announcers(topic) > 1 {
            warn(&format!(
                "{topic} is announced from several addresses; the first one counts"
            ));
        }
        Ok((topic, described))
    }

    /// Returns the description of an announced call, and the first sender that announced it.
    fn announced(&self, topic: TopicId) -> Option<(Arc<AnnouncedDescription>, SocketAddr)> {
        let mut all = self.live.book.announced();
        let found = all.find(|(of, kind, ..)| (*of, *kind) == (topic, NameKind::Call));
        found.map(|(_, _, described, from)| (Arc::clone(described), from))
    }

    fn not_found(&self) -> CommandFailure {
        let calls = self.live.book.calls();
        let calls = calls.map(|(topic, described)| called(topic, described));
        let calls: Vec<String> = calls.take(SHOWN).collect();
        let help = match (calls.as_slice(), &self.arguments.target) {
            ([], NamedTarget::Topic(topic)) if self.live.book.heard(*topic).is_some() => {
                "values come under that name; it is no call".to_owned()
            }
            ([], _) => "no call was announced; is this the group and the interface (--address, --interface)?".to_owned(),
            (some, _) => format!("there are {}", some.join(", ")),
        };
        let (target, group, wait) = (
            &self.arguments.target,
            self.live.group(),
            self.arguments.wait,
        );
        CommandFailure::Unavailable(format!(
            "no program in {group} offers the call {target}, asked for {wait} s\n  = help: {help}"
        ))
    }

    /// Sends the request and waits for the response. The first interruption halts the skill, and
    /// the response is still awaited.
    async fn ask(
        &mut self,
        (topic, described): (TopicId, &AnnouncedDescription),
        request: &[u8],
        places: Option<&RunTopics>,
    ) -> Result<CallAnswer, CommandFailure> {
        let mut halts_at = places;
        let mut came = None;
        self.begin((topic, described), request, self.timeout())?;
        loop {
            let ended = self.turn(described, Duration::MAX, &mut came).await?;
            match came.take() {
                Some(Came::Answer(answer)) => return Ok(answer),
                Some(Came::Refused(why)) => {
                    return Err(CommandFailure::Failed(format!(
                        "{}: {why}",
                        called(topic, described)
                    )));
                }
                Some(Came::Lost(why)) => {
                    return Err(CommandFailure::Unavailable(format!(
                        "{}: {why}; whether it was executed is not known",
                        called(topic, described)
                    )));
                }
                None => {}
            }
            if ended == ListenEnd::Interrupted {
                let Some(places) = halts_at.take() else {
                    return Err(CommandFailure::Interrupted);
                };
                self.halt(places)?;
            }
        }
    }

    /// Returns how long to wait for a response.
    fn timeout(&self) -> Duration {
        Duration::try_from_secs_f64(self.arguments.timeout).unwrap_or(Duration::MAX)
    }

    fn begin(
        &mut self,
        (topic, described): (TopicId, &AnnouncedDescription),
        request: &[u8],
        timeout: Duration,
    ) -> Result<CallId, CommandFailure> {
        let (space, namespace, writer_id) = topic.triple();
        let targets = described.call().map_or(&[][..], |call| &call.targets);
        let request = ActionRequest {
            address: ActionAddress {
                publisher_id: OwnedPublisherId::UInt16(space),
                writer_group_id: Some(namespace),
                writer_id,
                target_id: targets.first().copied().unwrap_or(1),
            },
            dialect: ActionDialect::Standard,
            fields: ActionFields::Variants(request),
            timeout,
        };
        let begun = self.requestor.call(request, self.live.now());
        begun.map_err(|error| CommandFailure::Usage(format!("{topic}: {error}")))
    }

    /// Calls Halt. Its response is ignored, because the followed run shows the effect.
    fn halt(&mut self, places: &RunTopics) -> Result<(), CommandFailure> {
        warn("interrupted: calling Halt (once more to leave at once)");
        let halt = AnnouncedDescription {
            name: String::new(),
            description: String::new(),
            ros_topics: Vec::new(),
            command: false,
            what: described::DescribedKind::Value(Vec::new()),
        };
        self.begin((places.halt, &halt), &[0, 0], self.timeout())
            .map(drop)
    }

    /// Sends due requests and listens until more are due, the call has an outcome, or `until` is
    /// reached.
    async fn turn(
        &mut self,
        described: &AnnouncedDescription,
        until: Duration,
        came: &mut Option<Came>,
    ) -> Result<ListenEnd, CommandFailure> {
        self.transmit()?;
        let Self {
            live,
            requestor,
            executor,
            ..
        } = self;
        let next = requestor.poll_timeout().unwrap_or(until).min(until);
        let ended = {
            let mut each = |news: DatagramContent<'_>, now| {
                if let DatagramContent::Response(response, from) = &news
                    && executor.answers(requestor, (response, *from))
                {
                    *came = hear(requestor, response, (described, now));
                }
                if came.is_some() { Go::Enough } else { Go::On }
            };
            live.listen(next, &mut each).await?
        };
        requestor.handle_timeout(live.now());
        if let Some((_, why)) = requestor.poll_given_up()
            && came.is_none()
        {
            *came = Some(Came::Lost(why.to_string()));
        }
        Ok(ended)
    }

    fn transmit(&mut self) -> Result<(), CommandFailure> {
        let now = self.live.now();
        while let Some(request) = self.requestor.poll_transmit(now) {
            let mut datagram = Vec::new();
            let header = self.live.action_header();
            let encoded = request.encode(&mut datagram, &header, &Extras::default());
            encoded
                .and_then(uadp::action::ActionEncoder::finish)
                .map_err(|error| CommandFailure::Usage(format!("cannot be asked for: {error}")))?;
            self.live.send(&datagram);
        }
        Ok(())
    }

    fn tell_answer(
        &self,
        (topic, described): (TopicId, &AnnouncedDescription),
        answer: &CallAnswer,
    ) -> Result<(), CommandFailure> {
        let mut out = io::stdout().lock();
        if self.arguments.json {
            let shown = CallJson::Answer {
                topic: topic.to_string(),
                name: &described.name,
                status: answer.status.0,
                fields: &answer.fields,
            };
            writeln!(out, "{}", json(&shown)?)?;
        } else {
            out.write_all(answer.fields.yaml().as_bytes())?;
        }
        out.flush()?;
        Ok(())
    }

    /// Prints a JSON object, or the lines for people.
    fn tell(&self, what: &impl Serialize, lines: &str) -> Result<(), CommandFailure> {
        let mut out = io::stdout().lock();
        if self.arguments.json {
            writeln!(out, "{}", json(what)?)?
        } else {
            for line in lines.lines() {
                writeln!(out, "  {}", harmless(line))?;
            }
        }
        out.flush()?;
        Ok(())
    }

    /// Follows a run to its end.
    async fn follow(&mut self, places: &RunTopics, number: u64) -> Result<(), CommandFailure> {
        let mut run = FollowedRun::new(number, self.live.now());
        let mut halted = false;
        let limit = until(self.live.now(), self.arguments.run_timeout);
        let end = loop {
            if let Some(end) = run.end(self.live.now()) {
                break end;
            }
            let mut steps = Vec::new();
            let ended = self.hear_run(places, &mut run, &mut steps).await?;
            for step in &steps {
                self.tell(step, &step.told())?;
            }
            let is_over = !halted && self.live.now() >= limit;
            if is_over {
                warn("the time for the run is over");
            }
            if ended == ListenEnd::Interrupted || is_over {
                if halted {
                    return Err(CommandFailure::Interrupted);
                }
                halted = true;
                self.halt(places)?;
            }
        };
        self.acknowledge().await?;
        let unknown = |why| {
            Err(CommandFailure::Unavailable(format!(
                "run {number}: {why}; how it ended is not known"
            )))
        };
        match end {
            RunEnd::Succeeded => Ok(()),
            RunEnd::Failed => Err(CommandFailure::Failed(format!(
                "run {number} did not succeed"
            ))),
            RunEnd::Overtaken => unknown("another one began"),
            RunEnd::NoResult => unknown("it ended and no result came"),
            RunEnd::Silent => unknown("nothing was heard of the component"),
            RunEnd::NoSuchRun => unknown("the component publishes the state of other runs only"),
        }
    }

    /// Listens for a moment to the values of the run.
    async fn hear_run(
        &mut self,
        places: &RunTopics,
        run: &mut FollowedRun,
        steps: &mut Vec<RunEvent>,
    ) -> Result<ListenEnd, CommandFailure> {
        self.transmit()?;
        let Self {
            live,
            requestor,
            executor,
            ..
        } = self;
        let next = requestor.poll_timeout().unwrap_or(Duration::MAX);
        let next = next.min(live.now() + LOOK);
        let mut undescribed = None;
        let mut each = |news: DatagramContent<'_>, now| {
            match &news {
                DatagramContent::Response(response, from) => {
                    // Acknowledgements, and the response of Halt.
                    if executor.answers(requestor, (response, *from)) {
                        let _heard = requestor.handle_response(response, now).is_ok();
                    }
                }
                DatagramContent::Sample(sample)
                    if places.has(sample.topic) && executor.publishes(sample.from) =>
                {
                    let described = sample.described.as_deref();
                    if described.is_none() {
                        undescribed = Some(sample.topic);
                    } else if let Ok(value) = plain::message(&sample.message, described)
                        && !value.0.is_empty()
                    {
                        steps.extend(run.handle(places, (sample.topic, &value), now));
                    }
                }
                DatagramContent::Sample(_) | DatagramContent::Announced { .. } => {}
            }
            if steps.is_empty() { Go::On } else { Go::Enough }
        };
        let ended = live.listen(next, &mut each).await?;
        // The announcement may be lost several times, and nothing can be read without it.
        if let Some(topic) = undescribed {
            live.insist(topic);
        }
        requestor.handle_timeout(live.now());
        while requestor.poll_given_up().is_some() {}
        Ok(ended)
    }

    /// Lets the Responder release the request, within a short time limit.
    async fn acknowledge(&mut self) -> Result<(), CommandFailure> {
        let end = self.live.now() + ACKNOWLEDGE;
        while self.requestor.open_calls() > 0 && self.live.now() < end {
            let mut came = None;
            let none = AnnouncedDescription {
                name: String::new(),
                description: String::new(),
                ros_topics: Vec::new(),
                command: false,
                what: described::DescribedKind::Value(Vec::new()),
            };
            if self.turn(&none, end, &mut came).await? == ListenEnd::Interrupted {
                break;
            }
        }
        Ok(())
    }
}

/// Returns the outcome of the call, if the response completes it.
fn hear(
    requestor: &mut Requestor,
    response: &ActionMessage<'_>,
    (described, now): (&AnnouncedDescription, Duration),
) -> Option<Came> {
    let Ok(ResponseMeaning::Done(_, outcome)) = requestor.handle_response(response, now) else {
        return None;
    };
    Some(match outcome {
        ActionOutcome::Answered { status, fields } => {
            match plain::response(fields, described.fields()) {
                Ok(fields) => Came::Answer(CallAnswer { status, fields }),
                Err(error) => Came::Lost(format!("an answer that cannot be read: {error}")),
            }
        }
        ActionOutcome::Refused(why) => Came::Refused(format!("refused: {why}")),
        ActionOutcome::Unknown(why) => Came::Lost(why.to_string()),
    })
}

/// Returns an error if the response reports a failure.
fn refused(
    (topic, described): (TopicId, &AnnouncedDescription),
    answer: &CallAnswer,
) -> Result<(), CommandFailure> {
    let bad = answer.status.0 & BAD != 0;
    let no = answer
        .fields
        .get("success")
        .and_then(serde_json::Value::as_bool)
        == Some(false);
    if !bad && !no {
        return Ok(());
    }
    let mut why = match answer.fields.text("message") {
        Some(message) if !message.is_empty() => message.to_owned(),
        Some(_) | None => "it did not succeed".to_owned(),
    };
    if bad {
        let code = answer.status;
        let symbol =
            status::symbol(code).map_or_else(|| format!("{:#010x}", code.0), str::to_owned);
        why = format!("{symbol}: {why}");
    }
    let help = remedy(described, &why).map(|help| format!("\n  = help: {help}"));
    let help = help.unwrap_or_default();
    let name = called(topic, described);
    Err(CommandFailure::Failed(format!(
        "{name}: {}{}",
        harmless(&why),
        harmless(&help).replace("\\u{a}", "\n")
    )))
}

/// Returns the next step after a refused call.
fn remedy(described: &AnnouncedDescription, why: &str) -> Option<String> {
    let takes = described.call().map_or(&[][..], |call| &call.request);
    if why.contains("BadInvalidArgument") && !takes.is_empty() {
        return Some(format!("this call takes {}", described::list(takes)));
    }
    let skill = described.name.strip_suffix(".Start")?;
    if why.contains("is unknown; Reset makes the skill ready") {
        return Some(look_first(skill));
    }
    why.contains("in the state Halted").then(|| {
        format!("reset it first, `ua-space call {skill}.Reset`; `ua-space skills start` does both")
    })
}

/// Returns the next step after an unknown outcome.
pub(super) fn look_first(skill: &str) -> String {
    format!(
        "the machine may move: look at it, then `ua-space call {skill}.Reset`, or \
         `ua-space skills start {skill} --reset`"
    )
}

/// The bit of a StatusCode that marks the severity Bad.
const BAD: u32 = 0x8000_0000;
/// Maximum number of calls listed if the call is not found.
const SHOWN: usize = 20;
/// The interval at which a run is checked for its end.
const LOOK: Duration = Duration::from_millis(100);
/// Time limit of an acknowledgement.
const ACKNOWLEDGE: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_start_of_a_halted_skill_names_its_reset() {
        let described = |name: &str| AnnouncedDescription {
            name: name.to_owned(),
            description: String::new(),
            ros_topics: Vec::new(),
            command: false,
            what: described::DescribedKind::Value(Vec::new()),
        };
        let why = "BadInvalidState: Start is not possible in the state Halted";
        let help = remedy(&described("handling.Place.Start"), why);
        let help = help.expect("there is a next step");
        assert!(
            help.contains("`ua-space call handling.Place.Reset`"),
            "{help}"
        );
        assert_eq!(remedy(&described("handling.Place.Halt"), why), None);
        let unknown =
            "BadInvalidState: the outcome of run 5 is unknown; Reset makes the skill ready";
        let help = remedy(&described("handling.Place.Start"), unknown);
        let help = help.expect("there is a next step");
        assert!(
            help.contains("look at it, then `ua-space call handling.Place.Reset`"),
            "{help}"
        );
        let running = "BadInvalidState: Start is not possible in the state Running";
        assert_eq!(remedy(&described("handling.Place.Start"), running), None);
    }
}
