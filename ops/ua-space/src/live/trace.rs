//! `ua-space trace`: shows the delays of values, hop by hop.
//!
//! Programs measure their own hops over all topics (`/status`). The delays of each topic on its way
//! to this program are computed from the times in its messages: the time at which its writer took
//! the value, the time of sending, and the time of arrival.

mod clocks;
mod drawing;
mod follow;
mod offsets;
mod otlp;
mod perfetto;
mod protobuf;
mod recordings;
mod spans;
mod topic;

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write as _};
use std::net::IpAddr;
use std::path::Path;

use bridge_core::RecentDelays;
use mappings::TopicId;
use serde::Serialize;
use uadp::MessageKind;

use self::clocks::Estimate;
use self::offsets::ClockOffsets;
use super::book::{DatagramContent, ReceivedSample};
use super::text::{TextTable, is_coloured, json, micros};
use super::{Go, in_group, until, utc};
use crate::arguments::Trace;
use crate::cell::{HopPage, StatusPage, page_of_url, pages_of_this_host};
use crate::exit::CommandFailure;
use crate::http::HttpServer;
use crate::report::warn;
use crate::survey::look;

/// Runs `ua-space trace`.
pub(crate) fn trace(arguments: &Trace) -> Result<(), CommandFailure> {
    if let Some(target) = &arguments.target {
        return topic::trace(arguments, target);
    }
    if let Some(target) = &arguments.follow {
        return follow::follow(arguments, target);
    }
    if !arguments.recording.is_empty() {
        return recordings::trace(arguments);
    }
    if let Some(url) = &arguments.otlp {
        return otlp::export(arguments, url);
    }
    let seconds = arguments.seconds.unwrap_or(USUAL);
    for url in &arguments.metrics {
        HttpServer::parse(url)?;
    }
    let (mut topics, mut clocks) = (Vec::new(), Vec::new());
    if seconds > 0.0 {
        (topics, clocks) = in_group(&arguments.group, async |mut live| {
            let mut delays = Delays::by(ClockOffsets::watch(&arguments.metrics).await);
            let end = until(live.now(), Some(seconds));
            let start = live.start_utc();
            let mut samples = Samples::of(arguments);
            live.listen(end, &mut |news, now| {
                if let DatagramContent::Sample(sample) = &news {
                    samples.take(delays.take(sample, utc(start, now)));
                }
                Go::On
            })
            .await?;
            live.tell_dropped();
            let name_of = |topic: TopicId| live.name_of(topic);
            samples.write(arguments, &delays, &name_of)?;
            let mut rows = delays.rows();
            for row in &mut rows {
                row.name = row.topic.parse().ok().and_then(name_of);
            }
            Ok((rows, delays.clocks.clocks()))
        })?;
    } else if arguments.perfetto.is_some() || arguments.svg.is_some() {
        return Err(CommandFailure::Usage(
            "--perfetto and --svg need samples: give another --seconds than 0".to_owned(),
        ));
    }
    let (mut programs, mut is_missing) = (Vec::new(), false);
    if arguments.metrics.is_empty() {
        let pages = look(async { Ok(pages_of_this_host().await) })?;
        programs.extend(with_hops(pages));
    }
    for url in &arguments.metrics {
        match look(measured(url)) {
            Ok(found) => programs.extend(found),
            Err(failure) => {
                warn(&failure.to_string());
                is_missing = true;
            }
        }
    }
    print(arguments, &programs, &topics, &clocks)?;
    if is_missing {
        Err(CommandFailure::NotThere)
    } else {
        Ok(())
    }
}

/// The times of a message, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Times {
    topic: TopicId,
    sequence: Option<u16>,
    /// The time at which its writer took the value, by the clock of the writer.
    stamp: Option<i128>,
    /// The same time by the clock of this host; `None` for a repeated value.
    taken: Option<i128>,
    sent: Option<i128>,
    arrived: i128,
}

impl Times {
    /// Returns the time in the program of the writer, in nanoseconds.
    fn origin(&self) -> Option<i128> {
        Some(self.sent? - self.taken?)
    }

    /// Returns the time from the writer to here, in nanoseconds.
    fn network(&self) -> Option<i128> {
        Some(self.arrived - self.sent?)
    }
}

/// The samples to write into a file.
#[derive(Debug)]
struct Samples {
    /// `None` if no file is wanted.
    kept: Option<Vec<Times>>,
    /// The number of samples for which there was no room.
    left_out: u64,
}

impl Samples {
    fn of(arguments: &Trace) -> Self {
        Self {
            kept: arguments.perfetto.is_some().then(Vec::new),
            left_out: 0,
        }
    }

    fn take(&mut self, times: Option<Times>) {
        if let (Some(kept), Some(times)) = (&mut self.kept, times) {
            if kept.len() < MOST_SAMPLES {
                kept.push(times)
            } else {
                self.left_out += 1
            }
        }
    }

    /// Writes the files of the command line.
    fn write(
        &self,
        arguments: &Trace,
        delays: &Delays,
        name_of: &dyn Fn(TopicId) -> Option<String>,
    ) -> Result<(), CommandFailure> {
        if let (Some(path), Some(kept)) = (&arguments.perfetto, &self.kept) {
            let (bytes, crowded) = perfetto::trace(kept, name_of);
            write_file(path, &bytes)?;
            for (count, why) in [
                (self.left_out, "beyond the largest number of samples"),
                (crowded, "in flight at the same time as too many others"),
            ] {
                if count > 0 {
                    warn(&format!(
                        "{}: {count} samples are left out: {why}",
                        path.display()
                    ));
                }
            }
        }
        match &arguments.svg {
            Some(path) => write_file(path, drawing::svg(delays, name_of).as_bytes()),
            None => Ok(()),
        }
    }
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), CommandFailure> {
    let name = path.display();
    fs::write(path, bytes)
        .map_err(|error| CommandFailure::Io(format!("cannot write {name}: {error}")))
}

/// The measurements of a program.
#[derive(Debug, Serialize)]
struct MeasuredProgram {
    program: String,
    space: u8,
    hops: BTreeMap<String, HopPage>,
}

/// Returns the measurements of a program in each space that it serves.
async fn measured(url: &str) -> Result<Vec<MeasuredProgram>, CommandFailure> {
    let pages = page_of_url(url).await?;
    if pages.iter().any(|page| page.hops.is_empty()) {
        return Err(CommandFailure::Data(format!("{url}/status has no hops")));
    }
    Ok(with_hops(pages).collect())
}

/// Returns the measurements of programs that measure hops.
fn with_hops(pages: Vec<StatusPage>) -> impl Iterator<Item = MeasuredProgram> {
    let measuring = pages.into_iter().filter(|page| !page.hops.is_empty());
    measuring.map(|page| MeasuredProgram {
        program: page.program,
        space: page.space,
        hops: page.hops,
    })
}

/// A hop of a topic.
#[derive(Debug, Serialize)]
struct HopRow {
    topic: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    hop: &'static str,
    #[serde(flatten)]
    delays: HopPage,
}

#[derive(Serialize)]
struct SpanJson<'a> {
    programs: &'a [MeasuredProgram],
    topics: &'a [HopRow],
    #[serde(skip_serializing_if = "Vec::is_empty")]
    clocks: Vec<ShownClock>,
}

/// The clock of a host, compared with the clock of this host.
#[derive(Debug, Serialize)]
struct ShownClock {
    host: IpAddr,
    offset_us: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    drift_ppm: Option<f64>,
    within_us: f64,
}

impl ShownClock {
    fn of((host, estimate): &(IpAddr, Estimate)) -> Self {
        Self {
            host: *host,
            offset_us: recordings::in_micros(estimate.offset),
            drift_ppm: estimate.drift_ppm,
            within_us: recordings::in_micros(estimate.within),
        }
    }
}

/// The latest delays of topics.
#[derive(Default)]
struct Delays {
    topics: BTreeMap<TopicId, Topic>,
    /// The clocks of other hosts.
    clocks: ClockOffsets,
}

#[derive(Default)]
struct Topic {
    /// The time at which the value of the previous message was taken; a repeated value keeps this
    /// time.
    taken: Option<i128>,
    origin: DelayWindow,
    network: DelayWindow,
}

/// The newest delays of a topic and hop.
type DelayWindow = RecentDelays<2048>;

impl Delays {
    /// Returns no delays yet, to be corrected by these clocks.
    fn by(clocks: ClockOffsets) -> Self {
        Self {
            clocks,
            ..Self::default()
        }
    }

    /// Records a message that arrived at the given time, in nanoseconds since 1970. Returns its
    /// times; `None` for a message without a value, and beyond the largest number of topics.
    fn take(&mut self, sample: &ReceivedSample<'_>, arrived: i128) -> Option<Times> {
        if sample.message.kind == MessageKind::KeepAlive
            || (self.topics.len() >= MOST_TOPICS && !self.topics.contains_key(&sample.topic))
        {
            return None;
        }
        let host = sample.from.ip();
        let here = |time: Option<i128>| time.map(|time| self.clocks.corrected(host, time));
        let (taken, sent) = (here(sample.taken()), here(sample.sent()));
        let topic = self.topics.entry(sample.topic).or_default();
        // A repetition has the same time by the clock of its host.
        let before = std::mem::replace(&mut topic.taken, sample.taken());
        // The first received message may be a repetition too.
        let is_new = before.is_some() && before != sample.taken();
        let times = Times {
            topic: sample.topic,
            sequence: sample.message.sequence_number(),
            stamp: sample.taken(),
            taken: taken.filter(|_| is_new),
            sent,
            arrived,
        };
        if let Some(delay) = times.origin() {
            topic.origin.record(delay);
        }
        if let Some(delay) = times.network() {
            topic.network.record(delay);
        }
        Some(times)
    }

    fn rows(&self) -> Vec<HopRow> {
        let hops = self.topics.iter().flat_map(|(topic, delays)| {
            [
                (*topic, ORIGIN, &delays.origin),
                (*topic, NETWORK, &delays.network),
            ]
        });
        hops.filter_map(|(topic, hop, window)| {
            Some(HopRow {
                topic: topic.to_string(),
                name: None,
                hop,
                delays: HopPage::of(window)?,
            })
        })
        .collect()
    }
}

fn print(
    arguments: &Trace,
    programs: &[MeasuredProgram],
    topics: &[HopRow],
    clocks: &[(IpAddr, Estimate)],
) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    if arguments.json {
        let shown = SpanJson {
            programs,
            topics,
            clocks: clocks.iter().map(ShownClock::of).collect(),
        };
        writeln!(out, "{}", json(&shown)?)?;
        return Ok(());
    }
    let bold = is_coloured();
    if !programs.is_empty() {
        let mut table = head(&["PROGRAM", "SPACE", "HOP"]).leaving_out([1]);
        for program in programs {
            for (hop, delays) in &program.hops {
                let first = [
                    program.label(programs),
                    program.space.to_string(),
                    called(hop),
                ];
                table.row(first.into_iter().chain(figures(delays)));
            }
        }
        table.without_empty_columns().write(&mut out, bold)?;
    }
    if !topics.is_empty() {
        if !programs.is_empty() {
            writeln!(out)?;
        }
        let mut table = head(&["TOPIC", "NAME", "HOP"])
            .leaving_out([0])
            .yielding([1]);
        for row in topics {
            let name = row.name.clone().unwrap_or_else(|| row.topic.clone());
            let first = [row.topic.clone(), name, row.hop.to_owned()];
            table.row(first.into_iter().chain(figures(&row.delays)));
        }
        table.without_empty_columns().write(&mut out, bold)?;
    } else if programs.is_empty() {
        writeln!(out, "no message with its times was received")?;
    }
    if !clocks.is_empty() {
        let columns = ["HOST", "OFFSET", "WITHIN", "DRIFT PPM"];
        let mut table = TextTable::new(columns.map(str::to_owned));
        for (host, estimate) in clocks {
            let drift = estimate.drift_ppm.map(|drift| format!("{drift:+.1}"));
            table.row([
                host.to_string(),
                recordings::signed(estimate.offset),
                micros(recordings::in_micros(estimate.within)),
                drift.unwrap_or_else(|| "-".to_owned()),
            ]);
        }
        writeln!(out)?;
        table.write(&mut out, bold)?;
    }
    Ok(())
}

impl MeasuredProgram {
    /// Returns the name of the program, with its space if it has several of these programs.
    fn label(&self, all: &[Self]) -> String {
        let (name, space) = (&self.program, self.space);
        match all.iter().filter(|one| one.program == *name).count() {
            0 | 1 => name.clone(),
            _ => format!("{name} {space}"),
        }
    }
}

/// Returns the cells of the delays of a hop.
fn figures(hop: &HopPage) -> [String; 6] {
    let negative = match hop.negative {
        0 => "-".to_owned(),
        count => count.to_string(),
    };
    let delays = [
        Some(hop.p50_us),
        Some(hop.p99_us),
        hop.p999_us,
        Some(hop.max_us),
    ];
    let [p50, p99, p999, max] = delays.map(|delay| {
        let delay = delay.filter(|_| hop.count > 0);
        delay.map_or_else(|| "-".to_owned(), micros)
    });
    [p50, p99, p999, max, hop.count.to_string(), negative]
}

/// Returns a table of delays with columns before the delays.
fn head(first: &[&str]) -> TextTable {
    let rest = ["P50", "P99", "P99.9", "MAX", "COUNT", "NEGATIVE"];
    let names = first.iter().chain(&rest);
    TextTable::new(names.map(|name| (*name).to_owned()))
}

/// Returns the description of a hop.
fn called(hop: &str) -> String {
    match hop {
        "out" => "out: into space".to_owned(),
        ORIGIN => "origin: at writer".to_owned(),
        NETWORK => "network: to here".to_owned(),
        "in" => "in: from space".to_owned(),
        other => other.to_owned(),
    }
}

const ORIGIN: &str = "origin";
const NETWORK: &str = "network";
/// The usual time to listen, in seconds.
const USUAL: f64 = 3.0;
const MOST_TOPICS: usize = 1024;
/// The largest number of samples in a file.
const MOST_SAMPLES: usize = 200_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_of_what_came_last_and_clocks_that_disagree_are_told() {
        let mut window = DelayWindow::default();
        assert_eq!(HopPage::of(&window), None);
        window.record(-5);
        for nanos in 1..=100 {
            window.record(nanos * 1000);
        }
        let hop = HopPage::of(&window).unwrap();
        assert_eq!((hop.p50_us, hop.p99_us, hop.max_us), (50.0, 99.0, 100.0));
        assert_eq!((hop.count, hop.negative), (100, 1));
        for _ in 0..2048 {
            window.record(1000);
        }
        assert_eq!(HopPage::of(&window).unwrap().max_us, 1.0);
    }
}
