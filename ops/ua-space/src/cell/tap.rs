//! `ua-space tap`: shows each sample of a topic at the programs that pass it on, and the reason why
//! it does not cross.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, IsTerminal as _, Write as _};
use std::time::Duration;

use mappings::TopicId;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::pages::{self, StatusPage};
use super::pages_of_this_host;
use crate::arguments::{NamedTarget, TapArguments};
use crate::exit::CommandFailure;
use crate::http::HttpServer;
use crate::interrupt::SignalGuard;
use crate::iso_time;
use crate::live::{fitting, harmless, json, wrapped};
use crate::report::warn;
use crate::survey::look;

/// Runs `ua-space tap`.
pub(crate) fn tap(arguments: &TapArguments) -> Result<(), CommandFailure> {
    look(run(arguments))
}

async fn run(arguments: &TapArguments) -> Result<(), CommandFailure> {
    let pages = pages(&arguments.metrics).await?;
    let topic = topic(&arguments.target, &pages)?;
    let mut programs = TappedProgram::of(&pages)?;
    let mut interrupt = SignalGuard::catch()?;
    let limit = arguments.seconds.map(Duration::try_from_secs_f64);
    let end = limit
        .and_then(Result::ok)
        .map(|limit| Instant::now() + limit);
    let mut ticks = interval(PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut told = PrintedEvents::new(arguments, topic);
    told.name = name(topic, &pages);
    loop {
        let asked = async {
            ticks.tick().await;
            let mut events = Vec::new();
            for program in &mut programs {
                events.extend(program.events(topic).await);
            }
            events
        };
        // A program may take long to answer.
        let mut events = tokio::select! {
            biased;
            () = interrupt.received() => break,
            events = asked => events,
        };
        events.sort_by_key(|(_, event)| event.at_us);
        if programs.iter().all(|program| program.fault.is_some()) {
            let faults = programs.iter().filter_map(|program| program.fault.clone());
            let faults: Vec<String> = faults.collect();
            return Err(CommandFailure::Unavailable(faults.join("\n")));
        }
        let is_enough = told.tell(events)?;
        if is_enough || end.is_some_and(|end| Instant::now() >= end) {
            break;
        }
    }
    for program in &programs {
        if program.lost > 0 {
            warn(&format!(
                "{}: {} lines were lost, because there were too many",
                program.name, program.lost
            ));
        }
    }
    told.sum()
}

/// Returns the status pages of the programs to ask.
pub(crate) async fn pages(metrics: &[String]) -> Result<Vec<StatusPage>, CommandFailure> {
    let mut found = Vec::new();
    if metrics.is_empty() {
        found = pages_of_this_host().await;
        // The MES passes on no values.
        found.retain(|page| !page.topics.is_empty() || !page.hops.is_empty());
    }
    for url in metrics {
        found.extend(pages::of_url(url).await?);
    }
    if found.is_empty() {
        Err(CommandFailure::Unavailable(
            "no program of this host has --metrics\n  = help: start the bridge with `--metrics \
             127.0.0.1:9101`, or name its address here with --metrics"
                .to_owned(),
        ))
    } else {
        Ok(found)
    }
}

/// Returns the topic of the target, by the names that the programs know.
pub(crate) fn topic(target: &NamedTarget, pages: &[StatusPage]) -> Result<TopicId, CommandFailure> {
    let name = match target {
        NamedTarget::Topic(topic) => return Ok(*topic),
        NamedTarget::Name(name) => name,
    };
    let known: Vec<(&str, Vec<&str>)> = pages
        .iter()
        .flat_map(StatusPage::known_topics)
        .map(|(topic, one)| (topic.as_str(), one.names().collect()))
        .collect();
    let found: BTreeSet<&str> = fitting(&known, name).into_iter().collect();
    let found: Vec<&str> = found.into_iter().collect();
    let shown = harmless(name);
    match found.as_slice() {
        [only] => only
            .parse()
            .map_err(|_| CommandFailure::Data(format!("{only} is not a topic"))),
        [] => {
            let names = known.iter().flat_map(|(_, names)| names.iter().copied());
            let help = match mappings::nearest(name, names) {
                Some(near) => format!("did you mean `{}`?", harmless(near)),
                None => {
                    "`ua-space status` shows the programs, `ua-space list` the names".to_owned()
                }
            };
            Err(CommandFailure::Unavailable(format!(
                "no program knows a topic named {shown}\n  = help: {help}"
            )))
        }
        several => Err(CommandFailure::Usage(format!(
            "{shown} is the name of {}: give the topic",
            several.join(", ")
        ))),
    }
}

/// Returns the name of a topic that a program knows.
pub(crate) fn name(topic: TopicId, pages: &[StatusPage]) -> Option<String> {
    let mut pages = pages.iter();
    pages.find_map(|page| page.known_topic(topic)?.name.clone())
}

/// A program that is asked.
pub(crate) struct TappedProgram {
    pub(crate) name: String,
    url: String,
    server: HttpServer,
    /// The number of the next event.
    from: u64,
    lost: u64,
    /// The reason why it is not asked any more.
    fault: Option<String>,
}

#[derive(Debug, Deserialize)]
struct TapReply {
    next: u64,
    lost: u64,
    events: Vec<TapEvent>,
}

/// A step of a sample at a program.
#[derive(Debug, Clone, Deserialize, Serialize)]
pub(crate) struct TapEvent {
    pub(crate) space: u8,
    at_us: i64,
    pub(crate) step: String,
    #[serde(flatten)]
    more: BTreeMap<String, Value>,
}

impl TappedProgram {
    /// Returns the programs with these pages; a program may have a page for each of its spaces.
    ///
    /// # Errors
    /// The address of a page is no URL.
    pub(crate) fn of(pages: &[StatusPage]) -> Result<Vec<Self>, CommandFailure> {
        let mut programs: Vec<Self> = Vec::new();
        for page in pages {
            match programs.iter_mut().find(|one| one.url == page.url) {
                Some(known) => known.name = page.program.clone(),
                None => programs.push(Self {
                    name: page.program.clone(),
                    url: page.url.clone(),
                    server: HttpServer::parse(&page.url)?,
                    from: 0,
                    lost: 0,
                    fault: None,
                }),
            }
        }
        Ok(programs)
    }

    /// Returns the number of events that the program has lost.
    pub(crate) const fn lost(&self) -> u64 {
        self.lost
    }

    /// Returns the new events of the topic.
    pub(crate) async fn events(&mut self, topic: TopicId) -> Vec<(String, TapEvent)> {
        if self.fault.is_some() {
            return Vec::new();
        }
        let path = format!("/tap?topic={topic}&from={}", self.from);
        let answer = match self.server.get(&path).await {
            Ok(answer) if answer.status == 200 => answer,
            Ok(answer) => {
                let why = harmless(answer.body.trim());
                let why = format!(
                    "{} at {}: HTTP status {}: {why}",
                    self.name, self.url, answer.status
                );
                warn(&why);
                self.fault = Some(why);
                return Vec::new();
            }
            Err(failure) => {
                warn(&failure.to_string());
                self.fault = Some(failure.to_string());
                return Vec::new();
            }
        };
        let Ok(answer) = serde_json::from_str::<TapReply>(&answer.body) else {
            let why = format!("{} at {}: not the events of a topic", self.name, self.url);
            warn(&why);
            self.fault = Some(why);
            return Vec::new();
        };
        (self.from, self.lost) = (answer.next, answer.lost);
        let events = answer.events.into_iter();
        events.map(|event| (self.name.clone(), event)).collect()
    }
}

/// The printed events.
struct PrintedEvents<'a> {
    arguments: &'a TapArguments,
    topic: TopicId,
    /// The name of the topic, if it has one.
    name: Option<String>,
    lines: u64,
    /// The number of samples for each program and step.
    sums: BTreeMap<(String, String), u64>,
}

#[derive(Serialize)]
struct SampleJson<'a> {
    topic: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    program: &'a str,
    #[serde(flatten)]
    event: &'a TapEvent,
}

impl<'a> PrintedEvents<'a> {
    fn new(arguments: &'a TapArguments, topic: TopicId) -> Self {
        Self {
            arguments,
            topic,
            name: None,
            lines: 0,
            sums: BTreeMap::new(),
        }
    }

    /// Prints events. Returns true if enough lines are printed.
    fn tell(&mut self, events: Vec<(String, TapEvent)>) -> Result<bool, CommandFailure> {
        let mut out = io::stdout().lock();
        for (program, event) in events {
            if event.step == MEASURED || (self.arguments.drops && event.step != DROPPED) {
                continue;
            }
            let program = harmless(&program);
            if self.arguments.json {
                let shown = SampleJson {
                    topic: self.topic.to_string(),
                    name: self.name.as_deref(),
                    program: &program,
                    event: &event,
                };
                writeln!(out, "{}", json(&shown)?)?;
            } else {
                let time = iso_time::of_unix_nanos(i128::from(event.at_us) * 1_000);
                let time = time.get(11..26).unwrap_or_default();
                let space = event.space;
                let head = format!("{time}  {program} (space {space})  ");
                match io::stdout().is_terminal() {
                    true => write!(out, "{}", wrapped(&head, &event.text()))?,
                    false => writeln!(out, "{head}{}", event.text())?,
                }
            }
            let count = event.number("count").unwrap_or(1);
            let sum = self.sums.entry((program, event.kind())).or_default();
            *sum = sum.saturating_add(count);
            self.lines += 1;
            if self.arguments.count.is_some_and(|most| self.lines >= most) {
                out.flush()?;
                return Ok(true);
            }
        }
        out.flush()?;
        Ok(false)
    }

    /// Prints the sums.
    fn sum(&self) -> Result<(), CommandFailure> {
        if self.arguments.json {
            return Ok(());
        }
        let mut out = io::stdout().lock();
        if self.sums.is_empty() {
            let name = self.name.as_deref().map(harmless);
            let name = name.map_or_else(String::new, |name| format!("{name}, "));
            writeln!(out, "{name}{}: no sample was seen", self.topic)?;
        }
        let mut last = "";
        for ((program, kind), count) in &self.sums {
            if last != program {
                writeln!(out, "{program}:")?;
                last = program;
            }
            writeln!(out, "  {count} {kind}")?;
        }
        out.flush()?;
        Ok(())
    }
}

impl TapEvent {
    pub(crate) fn text_of(&self, name: &str) -> &str {
        self.more
            .get(name)
            .and_then(Value::as_str)
            .unwrap_or_default()
    }

    fn number(&self, name: &str) -> Option<u64> {
        self.more.get(name)?.as_u64()
    }

    /// Returns a time in microseconds.
    pub(crate) fn micros(&self, name: &str) -> Option<f64> {
        self.more.get(name)?.as_f64()
    }

    fn is(&self, name: &str) -> bool {
        self.more.get(name) == Some(&Value::Bool(true))
    }

    /// Returns the step, with the reason of a drop.
    fn kind(&self) -> String {
        match self.step.as_str() {
            DROPPED => format!("dropped: {}", harmless(self.text_of("reason"))),
            "sent" if self.is("repeated") => "repeated".to_owned(),
            "received" if self.is("keep_alive") => "keep-alive received".to_owned(),
            step => harmless(step),
        }
    }

    /// Returns the event for people.
    fn text(&self) -> String {
        let kind = self.kind();
        match self.step.as_str() {
            "taken" => format!(
                "taken from the local side, {} bytes",
                self.number("bytes").unwrap_or_default()
            ),
            "received" => {
                let from = harmless(self.text_of("from"));
                match self.number("sequence") {
                    Some(sequence) => format!("{kind}, number {sequence} from {from}"),
                    None => format!("{kind} from {from}"),
                }
            }
            "forwarded" => match self.text_of("refused") {
                "" => "forwarded to another carrier".to_owned(),
                reason => harmless(reason),
            },
            "published" => {
                let after = self.micros("after_us").unwrap_or_default();
                format!("published {after:.0} us after its arrival")
            }
            DROPPED => {
                let parts = [
                    self.text_of("meaning"),
                    self.text_of("case"),
                    self.text_of("detail"),
                ];
                let mut text = kind;
                for (at, part) in parts.into_iter().enumerate() {
                    // The detail often repeats the case.
                    let is_new = !part.is_empty() && !parts.iter().take(at).any(|one| *one == part);
                    if is_new {
                        text.push_str(if at == 0 { ", " } else { "; " });
                        text.push_str(&harmless(part));
                    }
                }
                match self.number("count") {
                    Some(count) if count != 1 => format!("{text} ({count} samples)"),
                    Some(_) | None => text,
                }
            }
            _ => kind,
        }
    }
}

/// The step of a drop.
pub(crate) const DROPPED: &str = "dropped";
/// The step of a measured delay, which `ua-space trace` shows.
pub(crate) const MEASURED: &str = "measured";
/// The period of requests; a program records for longer without them.
const PERIOD: Duration = Duration::from_millis(200);

#[cfg(test)]
mod tests {
    use super::*;

    fn event(text: &str) -> TapEvent {
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn each_step_is_a_line_and_a_drop_has_its_reason() {
        for (given, wanted) in [
            (
                r#"{"space":1,"at_us":0,"step":"taken","bytes":48}"#,
                "taken from the local side, 48 bytes",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"sent","repeated":true}"#,
                "repeated",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"forwarded"}"#,
                "forwarded to another carrier",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"forwarded","refused":"not_forwarded_late"}"#,
                "not_forwarded_late",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"received","from":"10.0.0.5:4840","sequence":17,"keep_alive":false}"#,
                "received, number 17 from 10.0.0.5:4840",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"published","after_us":85.4}"#,
                "published 85 us after its arrival",
            ),
            (
                r#"{"space":1,"at_us":0,"step":"dropped","reason":"no_subscriber","meaning":"an event without a subscriber","case":"nobody","detail":"nobody","count":2}"#,
                "dropped: no_subscriber, an event without a subscriber; nobody (2 samples)",
            ),
        ] {
            assert_eq!(event(given).text(), wanted);
        }
    }

    #[test]
    fn a_topic_is_found_by_the_names_of_the_programs() {
        let status = r#"{"program":"bridge-ros1","topics":{
            "ua_1_2_10":{"name":"Left.Speed","ros_topics":[{"space":1,"topic":"/left/speed"}]},
            "ua_1_2_11":{"name":"Right.Speed"}},
            "topics_without_values":{"ua_0_7_101":{"name":"gripper.Grasp.State"}}}"#;
        let pages = pages::parse(status).unwrap();
        let of = |name: &str| {
            let found = topic(&name.parse().unwrap(), &pages);
            found
                .map(|topic| topic.to_string())
                .map_err(|error| error.to_string())
        };
        for name in ["Left.Speed", "/left/speed", "left/speed", "ua_1_2_10"] {
            assert_eq!(of(name).unwrap(), "ua_1_2_10", "{name}");
        }
        assert_eq!(of("grasp.state").unwrap(), "ua_0_7_101");
        let wrong = of("Speed").unwrap_err();
        assert_eq!(
            wrong,
            "Speed is the name of ua_1_2_10, ua_1_2_11: give the topic"
        );
        assert!(
            of("Left.Sped")
                .unwrap_err()
                .contains("did you mean `Left.Speed`?")
        );
    }
}
