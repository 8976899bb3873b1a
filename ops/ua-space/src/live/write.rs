//! `ua-space write`: writes a value of origin 0. A ua-server that has the value writes it, because
//! two programs must not send in one namespace of space 0. Without a server, this process is the
//! program that sends it.

mod server;
mod space;
mod value;

use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use serde::Serialize;

use super::application::AnnouncedProgram;
use super::book::{DatagramContent, NameKind};
use super::described::AnnouncedDescription;
use super::text::{harmless, json};
use super::{Go, ListenEnd, Live, in_group, until};
use crate::arguments::Write;
use crate::exit::CommandFailure;
use crate::survey::look;

/// Runs `ua-space write`.
pub(crate) fn write(arguments: &Write) -> Result<ExitCode, CommandFailure> {
    let found = in_group(&arguments.group, async |mut live| {
        find(&mut live, arguments).await
    })?;
    match (found, &arguments.mapping) {
        (Some(found), _) => {
            look(server::write(arguments, &found))?;
            Ok(ExitCode::SUCCESS)
        }
        (None, Some(mapping)) if arguments.server.is_none() => space::write(arguments, mapping),
        (None, _) => Err(no_writer(arguments)),
    }
}

/// A value that a ua-server has.
#[derive(Debug)]
struct ServedValue {
    topic: TopicId,
    described: Arc<AnnouncedDescription>,
    /// The URLs of the server, in the order in which they are tried.
    urls: Vec<String>,
}

impl ServedValue {
    /// Returns the topic and the name for output.
    fn label(&self) -> String {
        label(self.topic, &self.described.name)
    }
}

/// Returns the topic and the name of a value for output.
fn label(topic: TopicId, name: &str) -> String {
    match name {
        "" => topic.to_string(),
        name => format!("{topic} {}", harmless(name)),
    }
}

/// Returns the time between two values, and the number of values, which is `None` until the user
/// interrupts the command. Without a rate, there is one value.
fn pace(arguments: &Write) -> (Option<Duration>, Option<u64>) {
    match arguments.rate {
        Some(rate) => {
            let period = Duration::from_secs_f64(1.0 / rate);
            (Some(period), arguments.count)
        }
        None => (None, Some(1)),
    }
}

/// Returns the value at its ua-server; `None` if no server has it.
async fn find(live: &mut Live, arguments: &Write) -> Result<Option<ServedValue>, CommandFailure> {
    live.want_all();
    let end = until(live.now(), Some(arguments.wait));
    let mut ignored = |_: DatagramContent<'_>, _| Go::On;
    if arguments.mapping.is_some() && arguments.server.is_none() {
        // The mapping describes the value, so only a server is waited for.
        let first = end.min(live.now() + SERVERS_ANSWER);
        if live.listen(first, &mut ignored).await? == ListenEnd::Interrupted {
            return Err(CommandFailure::Interrupted);
        }
        if !has_server(live) {
            return Ok(None);
        }
    }
    let target = (&arguments.target, Some(NameKind::Value));
    let Some(topic) = live.resolve(target, end, &mut ignored).await? else {
        return Ok(None);
    };
    is_origin_0(topic, live.name_of(topic).as_deref())?;
    loop {
        if let Some(found) = served(live, topic, arguments.server.as_deref())? {
            return Ok(Some(found));
        }
        let now = live.now();
        if now >= end {
            return Ok(None);
        }
        if live.listen(end.min(now + STEP), &mut ignored).await? == ListenEnd::Interrupted {
            return Err(CommandFailure::Interrupted);
        }
    }
}

/// Refuses values of other origins.
fn is_origin_0(topic: TopicId, name: Option<&str>) -> Result<(), CommandFailure> {
    if topic.space == SpaceId::UA {
        return Ok(());
    }
    let (label, space) = (label(topic, name.unwrap_or_default()), topic.space);
    Err(CommandFailure::Usage(format!(
        "{label} is a value of ROS space {space}: its publisher writes it\n  = help: only values of \
         origin 0 are written here; publish this value in ROS"
    )))
}

fn has_server(live: &Live) -> bool {
    let mut all = live.book.applications();
    all.any(|((space, _), one)| *space == 0 && is_server(one))
}

fn is_server(application: &AnnouncedProgram) -> bool {
    application.product_uri == SERVER
}

/// Returns the value at the server that announces it, or at the server `at`; `None` while the
/// announcements are missing.
fn served(
    live: &Live,
    topic: TopicId,
    at: Option<&str>,
) -> Result<Option<ServedValue>, CommandFailure> {
    let all = live.book.all_announced();
    let announced = all.filter(|(of, kind, ..)| (*of, *kind) == (topic, NameKind::Value));
    let announced: Vec<(Arc<AnnouncedDescription>, SocketAddr)> = announced
        .map(|(_, _, described, from)| (Arc::clone(described), from))
        .collect();
    if let Some(url) = at {
        return Ok(announced
            .into_iter()
            .next()
            .map(|(described, _)| ServedValue {
                topic,
                described,
                urls: vec![url.to_owned()],
            }));
    }
    let application = |from: SocketAddr| {
        let mut all = live.book.applications();
        all.find(|((space, at), _)| (*space, *at) == (0, from))
            .map(|(_, one)| one)
    };
    let mut other = None;
    for (described, from) in announced {
        match application(from) {
            Some(one) if is_server(one) => {
                let urls = urls(one, from);
                return Ok(Some(ServedValue {
                    topic,
                    described,
                    urls,
                }));
            }
            Some(one) => other = Some((described, harmless(&one.name))),
            None => {}
        }
    }
    match other {
        None => Ok(None),
        Some((described, owner)) => Err(CommandFailure::Failed(format!(
            "{} is a value of {owner}, which alone writes it: nothing was sent\n  = help: a value of a \
             skill changes by a call: `ua-space skills`",
            label(topic, &described.name)
        ))),
    }
}

/// Returns the URLs of a server, and the URL at the address of its announcement, because a name in
/// a URL may not resolve on this host.
fn urls(application: &AnnouncedProgram, from: SocketAddr) -> Vec<String> {
    let given = application.urls.iter();
    let mut urls: Vec<String> = given
        .filter(|url| url.starts_with("opc.tcp://"))
        .take(MOST_URLS)
        .cloned()
        .collect();
    let ports = urls.iter().filter_map(|url| {
        let authority = url.strip_prefix("opc.tcp://")?.split('/').next()?;
        authority.rsplit_once(':')?.1.parse::<u16>().ok()
    });
    let here = ports.map(|port| format!("opc.tcp://{}", SocketAddr::new(from.ip(), port)));
    let here: Vec<String> = here.collect();
    for url in here {
        if !from.ip().is_unspecified() && !urls.contains(&url) {
            urls.push(url);
        }
    }
    urls
}

fn no_writer(arguments: &Write) -> CommandFailure {
    let (target, wait) = (&arguments.target, arguments.wait);
    let target = harmless(&target.to_string());
    CommandFailure::Unavailable(format!(
        "no ua-server announced the value {target} within {wait} s: nothing was sent\n  = help: is this \
         the group and the interface (--address, --interface)? Without a ua-server the mapping of the \
         cell is needed: `ua-space write --mapping cell.yaml {target} ..`"
    ))
}

/// The outcome of a written value.
#[derive(Debug, Clone, PartialEq, Eq)]
enum WriteOutcome {
    /// Confirmed, as far as the mapping asks for it.
    Arrived,
    /// The value was not sent, for this reason.
    Refused(String),
    /// The value may have been delivered.
    Unknown(String),
}

/// The values written so far.
#[derive(Debug, Default)]
struct Tally {
    written: u64,
    unknown: u64,
    /// The reason of the last unknown outcome.
    why: String,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct WriteJson<'a> {
    topic: String,
    name: &'a str,
    by: &'a str,
    outcome: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<&'a str>,
}

impl Tally {
    /// Records an outcome, and prints it as JSON if `shows` is set.
    fn take(
        &mut self,
        (topic, name, by): (TopicId, &str, &str),
        written: &WriteOutcome,
        shows: bool,
    ) -> Result<(), CommandFailure> {
        self.written += 1;
        let (outcome, reason) = match written {
            WriteOutcome::Arrived => ("written", None),
            WriteOutcome::Refused(why) => ("refused", Some(why.as_str())),
            WriteOutcome::Unknown(why) => ("unknown", Some(why.as_str())),
        };
        if let WriteOutcome::Unknown(why) = written {
            self.unknown += 1;
            self.why.clone_from(why);
        }
        if shows {
            let shown = WriteJson {
                topic: topic.to_string(),
                name,
                by,
                outcome,
                reason,
            };
            let mut out = io::stdout().lock();
            writeln!(out, "{}", json(&shown)?)?;
            out.flush()?;
        }
        match written {
            WriteOutcome::Refused(why) => {
                let (label, unknown) = (label(topic, name), self.unknown);
                // The earlier values may have arrived, so the command is more than refused.
                Err(match unknown {
                    0 => CommandFailure::Failed(format!("{label}: {why}")),
                    _ => CommandFailure::Unavailable(format!(
                        "{label}: {why}; whether {unknown} earlier values arrived is not known"
                    )),
                })
            }
            WriteOutcome::Arrived | WriteOutcome::Unknown(_) => Ok(()),
        }
    }

    /// Prints the end for people, and returns an error if an outcome is unknown.
    fn end(
        &self,
        (topic, name, by): (TopicId, &str, &str),
        is_json: bool,
    ) -> Result<(), CommandFailure> {
        let (label, written, unknown) = (label(topic, name), self.written, self.unknown);
        if unknown > 0 {
            let count = match written {
                1 => String::new(),
                _ => format!("{unknown} of {written} values: "),
            };
            return Err(CommandFailure::Unavailable(format!(
                "{label}: {count}{}; whether it arrived is not known",
                self.why
            )));
        }
        if !is_json && written > 0 {
            let times = match written {
                1 => String::new(),
                times => format!(" {times} times"),
            };
            let mut out = io::stdout().lock();
            writeln!(out, "{label}: written{times} by {by}")?;
            out.flush()?;
        }
        Ok(())
    }
}

/// The ProductUri of a ua-server.
const SERVER: &str = "urn:ua-bridge:server";
/// The time in which servers of the group answer a probe.
const SERVERS_ANSWER: Duration = Duration::from_millis(1500);
const STEP: Duration = Duration::from_millis(50);
const MOST_URLS: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;

    fn application(urls: &[&str]) -> AnnouncedProgram {
        AnnouncedProgram {
            uri: "urn:cell".to_owned(),
            product_uri: SERVER.to_owned(),
            name: "cell".to_owned(),
            urls: urls.iter().map(|url| (*url).to_owned()).collect(),
            capabilities: Vec::new(),
        }
    }

    #[test]
    fn a_server_is_tried_at_its_urls_and_at_the_address_of_its_announcement() {
        let from: SocketAddr = "192.168.0.5:4840".parse().unwrap();
        let found = urls(
            &application(&["opc.tcp://cell:4841/ua", "https://cell"]),
            from,
        );
        assert_eq!(
            found,
            ["opc.tcp://cell:4841/ua", "opc.tcp://192.168.0.5:4841"]
        );
        let found = urls(&application(&["opc.tcp://192.168.0.5:4841"]), from);
        assert_eq!(found, ["opc.tcp://192.168.0.5:4841"]);
    }

    #[test]
    fn values_of_ros_are_refused_before_anything_is_sent() {
        let topic: TopicId = "ua_1_2_10".parse().unwrap();
        let wrong = is_origin_0(topic, Some("Speed")).unwrap_err().to_string();
        assert!(
            wrong.starts_with("ua_1_2_10 Speed is a value of ROS space 1"),
            "{wrong}"
        );
        assert!(is_origin_0("ua_0_2_10".parse().unwrap(), None).is_ok());
    }

    #[test]
    fn an_unknown_outcome_is_an_error_and_a_refusal_ends_the_command() {
        let at = ("ua_0_2_30".parse().unwrap(), "Setpoint", "ua-server");
        let mut tally = Tally::default();
        tally.take(at, &WriteOutcome::Arrived, false).unwrap();
        tally.end(at, true).unwrap();
        let unknown = WriteOutcome::Unknown("BadTimeout".to_owned());
        tally.take(at, &unknown, false).unwrap();
        let wrong = tally.end(at, true).unwrap_err();
        assert!(matches!(wrong, CommandFailure::Unavailable(_)), "{wrong:?}");
        assert!(
            wrong
                .to_string()
                .contains("1 of 2 values: BadTimeout; whether"),
            "{wrong}"
        );
        let refused = WriteOutcome::Refused("BadUserAccessDenied".to_owned());
        let wrong = tally.take(at, &refused, false).unwrap_err();
        assert!(matches!(wrong, CommandFailure::Unavailable(_)), "{wrong:?}");
        assert!(
            wrong
                .to_string()
                .contains("BadUserAccessDenied; whether 1 earlier values"),
            "{wrong}"
        );
        let wrong = Tally::default().take(at, &refused, false).unwrap_err();
        assert!(matches!(wrong, CommandFailure::Failed(_)), "{wrong:?}");
    }
}
