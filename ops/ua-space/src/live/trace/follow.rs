//! `ua-space trace --follow`: the delays of each sample of a topic.

use std::io::{self, Write as _};

use serde::Serialize;

use super::super::book::{DatagramContent, NameKind};
use super::super::text::{json, micros};
use super::super::{Go, ListenEnd, in_group, names, until, utc};
use super::{Delays, Samples, Times};
use crate::arguments::{NamedTarget, Trace};
use crate::exit::CommandFailure;
use crate::iso_time;

/// Shows the delays of a topic until the time is over or the user interrupts.
pub(super) fn follow(arguments: &Trace, target: &NamedTarget) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let wait = arguments.seconds.unwrap_or(WAIT).max(WAIT);
        let found = until(live.now(), Some(wait));
        let mut ignored = |_: DatagramContent<'_>, _| Go::On;
        let resolved = live.resolve((target, Some(NameKind::Value)), found, &mut ignored);
        let Some(topic) = resolved.await? else {
            return Err(names::unknown(&live, target, wait));
        };
        let end = until(live.now(), arguments.seconds);
        let start = live.start_utc();
        let (mut delays, mut samples) = (Delays::default(), Samples::of(arguments));
        let mut failed = None;
        let mut shown: u64 = 0;
        let ended = live
            .listen(end, &mut |news, now| {
                let DatagramContent::Sample(sample) = &news else {
                    return Go::On;
                };
                if sample.topic != topic {
                    return Go::On;
                }
                let times = delays.take(sample, utc(start, now));
                samples.take(times);
                if let Some(times) = times {
                    shown += 1;
                    failed = show(&times, shown == 1, arguments.json).err();
                }
                if failed.is_some() { Go::Enough } else { Go::On }
            })
            .await?;
        if let Some(failure) = failed {
            return Err(failure);
        }
        let name_of = |topic| live.name_of(topic);
        samples.write(arguments, &delays, &name_of)?;
        if shown == 0 && ended != ListenEnd::Interrupted {
            let group = live.group();
            return Err(CommandFailure::Unavailable(format!(
                "no sample of {topic} came in {group}\n  = help: `ua-space tap {topic}` shows where it \
                 is dropped"
            )));
        }
        if !arguments.json {
            print(&delays)?;
        }
        Ok(())
    })
}

#[derive(Serialize)]
struct TraceJson {
    topic: String,
    sequence: Option<u16>,
    /// The time of the arrival here.
    arrived: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    origin_us: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    network_us: Option<f64>,
    /// Whether the message repeats a value.
    repeated: bool,
}

/// Prints a sample, after the names of the columns for the first sample.
fn show(times: &Times, is_first: bool, is_json: bool) -> Result<(), CommandFailure> {
    let in_micros = |nanos: i128| {
        // Delays of days are faults of clocks, and may be inexact.
        let nanos = i64::try_from(nanos).unwrap_or(i64::MAX);
        #[expect(clippy::cast_precision_loss, reason = "a delay shown to people")]
        let micros = nanos as f64 / 1_000.0;
        micros
    };
    let (origin, network) = (
        times.origin().map(in_micros),
        times.network().map(in_micros),
    );
    let arrived = iso_time::of_unix_nanos(times.arrived);
    let mut out = io::stdout().lock();
    if is_json {
        let shown = TraceJson {
            topic: times.topic.to_string(),
            sequence: times.sequence,
            arrived,
            origin_us: origin,
            network_us: network,
            repeated: times.taken.is_none(),
        };
        writeln!(out, "{}", json(&shown)?)?;
    } else {
        if is_first {
            writeln!(
                out,
                "{:<15}  {:>6}  {:>12}  {:>12}",
                "ARRIVED", "NUMBER", "ORIGIN", "NETWORK"
            )?;
        }
        let text = |delay: Option<f64>| delay.map_or_else(|| "-".to_owned(), micros);
        let sequence = times
            .sequence
            .map_or_else(|| "-".to_owned(), |number| number.to_string());
        let origin = match times.taken {
            Some(_) => text(origin),
            None => "repeated".to_owned(),
        };
        let time = arrived.get(11..26).unwrap_or_default();
        writeln!(
            out,
            "{time:<15}  {sequence:>6}  {origin:>12}  {:>12}",
            text(network)
        )?;
    }
    out.flush()?;
    Ok(())
}

/// Prints the statistics of all shown samples.
fn print(delays: &Delays) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    for row in delays.rows() {
        let hop = row.delays;
        let [p50, p99, max] = [hop.p50_us, hop.p99_us, hop.max_us].map(micros);
        writeln!(
            out,
            "{}: p50 {p50}, p99 {p99}, max {max}, {} samples, {} negative",
            row.hop, hop.count, hop.negative
        )?;
    }
    out.flush()?;
    Ok(())
}

/// The least time to wait for the name of a topic, in seconds.
const WAIT: f64 = 3.0;
