//! `ua-space trace TOPIC`: the delays of one topic, hop by hop, at each program of this host.
//!
//! The programs report the delay of each hop of each sample (`/tap`). The time from the stamp of a
//! message to the bridge that took it is measured here, from the messages in the group.

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, Write as _};

use mappings::TopicId;
use serde::Serialize;
use serde_json::Value;
use uadp::{MessageKind, Timestamp};

use super::super::book::{DatagramContent, ReceivedSample};
use super::super::text::{harmless, is_coloured, json};
use super::super::{Go, ListenEnd, in_group, plain, until};
use super::{DelayWindow, USUAL, figures, head};
use crate::arguments::{NamedTarget, Trace};
use crate::cell::{
    DROPPED, HopPage, MEASURED, TapEvent, TappedProgram, tapped_name, tapped_pages, tapped_topic,
};
use crate::exit::CommandFailure;
use crate::iso_time;
use crate::report::warn;

/// Shows the hops of a topic.
pub(super) fn trace(arguments: &Trace, target: &NamedTarget) -> Result<(), CommandFailure> {
    let seconds = arguments.seconds.unwrap_or(USUAL);
    let (topic, name, path) = in_group(&arguments.group, async |mut live| {
        let pages = tapped_pages(&arguments.metrics).await?;
        let topic = tapped_topic(target, &pages)?;
        let mut programs = TappedProgram::of(&pages)?;
        let (mut path, mut stamps) = (TopicPath::default(), StampedMessages::default());
        // The first request starts the records of a program, and older steps are not wanted.
        for program in &mut programs {
            program.events(topic).await;
        }
        live.want(topic);
        let end = until(live.now(), Some(seconds));
        loop {
            let next = (live.now() + PERIOD).min(end);
            let ended = live
                .listen(next, &mut |news, _| {
                    if let DatagramContent::Sample(sample) = &news
                        && sample.topic == topic
                    {
                        stamps.take(sample);
                    }
                    Go::On
                })
                .await?;
            for program in &mut programs {
                for (name, event) in program.events(topic).await {
                    path.take(&name, &event);
                }
            }
            if ended != ListenEnd::Time || live.now() >= end {
                break;
            }
        }
        path.application = stamps.delays;
        for program in programs.iter().filter(|program| program.lost() > 0) {
            warn(&format!(
                "{}: {} steps were lost, because there were too many",
                program.name,
                program.lost()
            ));
        }
        let name = live.name_of(topic).or_else(|| tapped_name(topic, &pages));
        Ok((topic, name, path))
    })?;
    let rows = path.rows();
    if rows.is_empty() {
        let shown = titled(topic, name.as_deref());
        return Err(CommandFailure::Unavailable(format!(
            "no new sample of {shown} crossed for {seconds} s\n  = help: `ua-space tap {topic}` shows \
             where it is dropped, `ua-space status` what the programs wait for"
        )));
    }
    print(arguments, (topic, name.as_deref()), &rows)
}

/// The delays of a topic at the programs.
#[derive(Default)]
struct TopicPath {
    /// From the stamp of the message to the bridge.
    application: DelayWindow,
    programs: BTreeMap<(String, u8), PassedProgram>,
}

/// The delays of a topic at a program in a space.
#[derive(Default)]
struct PassedProgram {
    out: DelayWindow,
    origin: DelayWindow,
    network: DelayWindow,
    inward: DelayWindow,
    /// From the message in the ROS graph or OPC UA of the writer to the publication here.
    sum: DelayWindow,
    /// The samples that arrived and were not published yet: the time until the arrival, in
    /// microseconds.
    arrived: VecDeque<ArrivedSample>,
}

/// The delays of a sample until it arrived, in microseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct ArrivedSample {
    origin: Option<f64>,
    network: f64,
}

/// A hop of the topic.
#[derive(Debug, Serialize)]
struct PathRow {
    hop: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    program: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    space: Option<u8>,
    #[serde(flatten)]
    delays: HopPage,
}

impl TopicPath {
    /// Takes a step of a sample at a program.
    fn take(&mut self, program: &str, event: &TapEvent) {
        let key = (program.to_owned(), event.space);
        if !self.programs.contains_key(&key) && self.programs.len() >= MOST_PROGRAMS {
            return;
        }
        self.programs.entry(key).or_default().take(event);
    }

    fn rows(&self) -> Vec<PathRow> {
        let row = |hop, of: Option<&(String, u8)>, window: &DelayWindow| {
            Some(PathRow {
                hop,
                program: of.map(|(program, _)| program.clone()),
                space: of.map(|(_, space)| *space),
                delays: HopPage::of(window)?,
            })
        };
        let mut rows: Vec<PathRow> = row(APPLICATION, None, &self.application)
            .into_iter()
            .collect();
        for (key, passed) in &self.programs {
            rows.extend(row("out", Some(key), &passed.out));
        }
        let is_here = rows.iter().any(|row| row.hop == "out");
        for (key, passed) in &self.programs {
            // The bridge of the writer is another host's: its times are in its messages.
            let origin = row("origin", Some(key), &passed.origin).filter(|_| !is_here);
            rows.extend(origin);
            for (hop, window) in [
                ("network", &passed.network),
                ("in", &passed.inward),
                ("sum", &passed.sum),
            ] {
                rows.extend(row(hop, Some(key), window));
            }
        }
        rows
    }
}

impl PassedProgram {
    fn take(&mut self, event: &TapEvent) {
        match event.step.as_str() {
            MEASURED => {
                let delay = event.micros("delay_us").unwrap_or_default();
                match event.text_of("hop") {
                    "out" => self.out.record(nanos(delay)),
                    "network" => {
                        self.network.record(nanos(delay));
                        if self.arrived.len() >= MOST_ARRIVED {
                            self.arrived.pop_front();
                        }
                        self.arrived.push_back(ArrivedSample {
                            origin: None,
                            network: delay,
                        });
                    }
                    "origin" => {
                        self.origin.record(nanos(delay));
                        if let Some(last) = self.arrived.back_mut() {
                            last.origin = Some(delay);
                        }
                    }
                    _ => {}
                }
            }
            "published" => {
                let after = event.micros("after_us").unwrap_or_default();
                self.inward.record(nanos(after));
                if let Some(ArrivedSample {
                    origin: Some(origin),
                    network,
                }) = self.arrived.pop_front()
                {
                    self.sum.record(nanos(origin + network + after));
                }
            }
            // A repetition was not counted among the samples that arrived. Which of these another
            // drop concerns is not known.
            DROPPED if event.text_of("reason") != "repeat" => self.arrived.clear(),
            _ => {}
        }
    }
}

/// The delays from the stamp of messages to their bridge.
#[derive(Default)]
struct StampedMessages {
    delays: DelayWindow,
    /// The time at which the value of the previous message was taken; a repetition keeps it.
    taken: Option<i128>,
}

impl StampedMessages {
    fn take(&mut self, sample: &ReceivedSample<'_>) {
        let Some(taken) = sample.taken() else { return };
        let before = self.taken.replace(taken);
        // The first received message may be a repetition.
        if sample.message.kind == MessageKind::KeepAlive || before.is_none_or(|one| one == taken) {
            return;
        }
        let read = plain::message(&sample.message, sample.described.as_deref()).ok();
        let stamp = read.as_ref().and_then(|values| values.get(STAMP));
        let stamp = stamp.and_then(Value::as_str).and_then(iso_time::parse);
        let stamp = stamp.map(|time| Timestamp {
            time,
            picoseconds: 0,
        });
        // Publishers that do not fill the stamp leave it 0.
        if let Some(stamp) = stamp.map(Timestamp::unix_nanos).filter(|stamp| *stamp > 0) {
            self.delays.record(taken - stamp);
        }
    }
}

#[derive(Serialize)]
struct PathJson<'a> {
    topic: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    hops: &'a [PathRow],
}

/// Returns the name of a topic, if it has one, and the topic.
fn titled(topic: TopicId, name: Option<&str>) -> String {
    match name {
        Some(name) => format!("{} ({topic})", harmless(name)),
        None => topic.to_string(),
    }
}

fn print(
    arguments: &Trace,
    (topic, name): (TopicId, Option<&str>),
    rows: &[PathRow],
) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    if arguments.json {
        let shown = PathJson {
            topic: topic.to_string(),
            name,
            hops: rows,
        };
        writeln!(out, "{}", json(&shown)?)?;
        return Ok(());
    }
    writeln!(out, "{}", titled(topic, name))?;
    let mut table = head(&["HOP"]).yielding([0]);
    for row in rows {
        table.row(std::iter::once(row.label(rows)).chain(figures(&row.delays)));
    }
    table
        .without_empty_columns()
        .write(&mut out, is_coloured())?;
    Ok(())
}

impl PathRow {
    /// Returns the hop for people.
    fn label(&self, all: &[Self]) -> String {
        let name = self.program.as_deref().unwrap_or_default();
        let has_other = all
            .iter()
            .any(|one| one.program == self.program && one.space != self.space);
        let name = match self.space {
            Some(space) if has_other => format!("{name} {space}"),
            Some(_) | None => name.to_owned(),
        };
        match self.hop {
            APPLICATION => "stamp to bridge".to_owned(),
            "out" => format!("in {name}"),
            "origin" => "in the writer".to_owned(),
            "network" => format!("to {name}"),
            "sum" => format!("sum at {name}"),
            _ => format!("in {name}"),
        }
    }
}

/// Returns nanoseconds of a time in microseconds.
#[expect(
    clippy::cast_possible_truncation,
    reason = "larger numbers saturate, and fractions of a nanosecond do not matter"
)]
fn nanos(micros: f64) -> i128 {
    (micros * 1_000.0) as i128
}

/// The hop from the stamp of the message to the bridge.
const APPLICATION: &str = "application";
/// The field with the stamp of a message with a `std_msgs/Header`.
const STAMP: &str = "header.stamp";
/// The period of requests to the programs.
const PERIOD: std::time::Duration = std::time::Duration::from_millis(200);
/// The largest number of programs in a table.
const MOST_PROGRAMS: usize = 64;
/// The largest number of samples that wait for their publication.
const MOST_ARRIVED: usize = 1024;

#[cfg(test)]
mod tests {
    use super::*;

    fn event(text: &str) -> TapEvent {
        serde_json::from_str(&format!(r#"{{"at_us":0,{text}}}"#)).unwrap()
    }

    fn arrives(path: &mut TopicPath, (origin, network): (f64, f64)) {
        for (hop, delay) in [("network", network), ("origin", origin)] {
            let measured =
                format!(r#""space":2,"step":"measured","hop":"{hop}","delay_us":{delay}"#);
            path.take("bridge-ros2", &event(&measured));
        }
    }

    fn published(path: &mut TopicPath, after: f64) {
        let published = format!(r#""space":2,"step":"published","after_us":{after}"#);
        path.take("bridge-ros2", &event(&published));
    }

    fn of<'r>(rows: &'r [PathRow], hop: &str) -> Option<&'r HopPage> {
        let found = rows.iter().find(|row| row.hop == hop);
        found.map(|row| &row.delays)
    }

    #[test]
    fn the_sum_of_a_sample_is_that_of_its_own_hops() {
        let mut path = TopicPath::default();
        // Two samples arrive before the first is published.
        arrives(&mut path, (10.0, 100.0));
        arrives(&mut path, (20.0, 200.0));
        published(&mut path, 1.0);
        published(&mut path, 2.0);
        let rows = path.rows();
        let sum = of(&rows, "sum").unwrap();
        assert_eq!((sum.count, sum.p50_us, sum.max_us), (2, 111.0, 222.0));
        assert_eq!(of(&rows, "in").unwrap().max_us, 2.0);
        assert_eq!(of(&rows, "origin").unwrap().count, 2);
    }

    #[test]
    fn a_drop_ends_the_sums_and_a_repetition_does_not() {
        let mut path = TopicPath::default();
        let dropped = |reason: &str| {
            event(&format!(
                r#""space":2,"step":"dropped","reason":"{reason}","count":1"#
            ))
        };
        arrives(&mut path, (10.0, 100.0));
        path.take("bridge-ros2", &dropped("repeat"));
        published(&mut path, 1.0);
        arrives(&mut path, (10.0, 100.0));
        path.take("bridge-ros2", &dropped("queue_full"));
        published(&mut path, 1.0);
        let rows = path.rows();
        assert_eq!(of(&rows, "sum").unwrap().count, 1);
        assert_eq!(of(&rows, "in").unwrap().count, 2);
    }

    #[test]
    fn delays_at_the_writer_are_shown_once() {
        let mut path = TopicPath::default();
        arrives(&mut path, (10.0, -100.0));
        let out = r#""space":1,"step":"measured","hop":"out","delay_us":9.5"#;
        path.take("bridge-ros1", &event(out));
        let rows = path.rows();
        let labels: Vec<String> = rows.iter().map(|row| row.label(&rows)).collect();
        assert_eq!(labels, ["in bridge-ros1", "to bridge-ros2"]);
        let network = of(&rows, "network").unwrap();
        assert_eq!((network.count, network.negative), (0, 1));
    }
}
