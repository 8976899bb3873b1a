//! `ua-space trace --otlp`: sends the counters and delays of programs as metrics of OpenTelemetry,
//! and samples as traces (OTLP 1.5 over HTTP). The request is a protobuf message
//! `ExportMetricsServiceRequest`; `spans` has the traces.

use std::collections::BTreeMap;
use std::hash::{BuildHasher as _, RandomState};
use std::pin::pin;
use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval, sleep};

use super::super::book::DatagramContent;
use super::super::text::harmless;
use super::super::{Go, ListenEnd, Live, in_group, unix_nanos, utc};
use super::Delays;
use super::offsets::ClockOffsets;
use super::protobuf::ProtobufMessage;
use super::spans::{self, SampledPeriod, SampledValue};
use crate::arguments::Trace;
use crate::cell::{HopPage, StatusPage, TopicPage, page_of_url, pages_of_this_host};
use crate::exit::CommandFailure;
use crate::http::{ChangeRequest, HttpServer, PROTOBUF};
use crate::interrupt::SignalGuard;
use crate::report::warn;
use crate::survey::look;

/// Exports until the user interrupts the command.
pub(super) fn export(arguments: &Trace, url: &str) -> Result<(), CommandFailure> {
    let seconds = arguments.seconds.unwrap_or(USUAL).max(SHORTEST);
    let period = Duration::try_from_secs_f64(seconds).unwrap_or(LONGEST);
    let mut exporter = Exporter {
        arguments,
        collector: HttpServer::parse(url)?,
        period: period.min(LONGEST),
        observer: RandomState::new().hash_one(0_u8),
        is_sent: false,
        last: BTreeMap::new(),
        lost: 0,
    };
    match usize::from(arguments.traces) {
        0 => look(exporter.run_alone())?,
        most => in_group(&arguments.group, async |live| {
            exporter.run(live, most).await
        })?,
    }
    if exporter.lost > 0 {
        warn(&format!("{} traces were not sent", exporter.lost));
    }
    if exporter.is_sent {
        Ok(())
    } else {
        Err(CommandFailure::NotThere)
    }
}

/// The export to a collector.
struct Exporter<'a> {
    arguments: &'a Trace,
    collector: HttpServer,
    period: Duration,
    /// A random number of this process.
    observer: u64,
    /// Whether the collector took something.
    is_sent: bool,
    /// The last fault of each path.
    last: BTreeMap<&'static str, String>,
    /// The number of traces that the collector did not take.
    lost: usize,
}

impl Exporter<'_> {
    /// Exports metrics until the user interrupts the command.
    async fn run_alone(&mut self) -> Result<(), CommandFailure> {
        let mut interrupt = SignalGuard::catch()?;
        let mut ticks = interval(self.period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let round = async {
                ticks.tick().await;
                self.round(Vec::new()).await;
            };
            tokio::select! {
                biased;
                () = interrupt.received() => return Ok(()),
                () = round => {}
            }
        }
    }

    /// Exports metrics and samples until the user interrupts the command. The group is received
    /// while a request is sent.
    async fn run(&mut self, mut live: Live, most: usize) -> Result<(), CommandFailure> {
        let mut delays = Delays::by(ClockOffsets::watch(&self.arguments.metrics).await);
        let (start, period) = (live.start_utc(), self.period);
        let mut sampled = SampledPeriod::new(most);
        loop {
            let batch = sampled.take(&|topic| live.name_of(topic));
            let mut round = pin!(self.round(batch));
            let mut is_over = false;
            let mut each = |news: DatagramContent<'_>, now| {
                if let DatagramContent::Sample(sample) = &news
                    && let Some(times) = delays.take(sample, utc(start, now))
                {
                    sampled.add(times);
                }
                Go::On
            };
            // A request that takes longer than a period takes another one.
            while !is_over {
                let end = live.now() + period;
                let mut listening = pin!(live.listen(end, &mut each));
                let ended = loop {
                    tokio::select! {
                        biased;
                        ended = &mut listening => break ended?,
                        () = &mut round, if !is_over => is_over = true,
                    }
                };
                if ended == ListenEnd::Interrupted {
                    return Ok(());
                }
            }
        }
    }

    /// Sends the metrics of all programs, and the spans of samples.
    async fn round(&mut self, samples: Vec<SampledValue>) {
        let pages = pages(self.arguments).await;
        let sent = if pages.is_empty() {
            Err(ExportFault::NoProgram)
        } else {
            send(&self.collector, METRICS_PATH, request(&pages, unix_nanos())).await
        };
        self.note(METRICS_PATH, sent);
        if samples.is_empty() {
            return;
        }
        let body = spans::request(&samples, &pages, self.observer);
        let sent = send(&self.collector, TRACES_PATH, body).await;
        if sent.is_err() {
            self.lost += samples.len();
        }
        self.note(TRACES_PATH, sent);
    }

    /// Reports a fault; the same fault is reported once.
    fn note(&mut self, path: &'static str, sent: Result<(), ExportFault>) {
        let last = self.last.entry(path).or_default();
        match sent {
            Ok(()) => {
                self.is_sent = true;
                last.clear();
            }
            Err(fault) => {
                let why = fault.to_string();
                if why != *last {
                    let what = path.trim_start_matches("/v1/");
                    warn(&format!("{what} were not sent: {why}"));
                    *last = why;
                }
            }
        }
    }
}

async fn pages(arguments: &Trace) -> Vec<StatusPage> {
    if arguments.metrics.is_empty() {
        return pages_of_this_host().await;
    }
    let mut pages = Vec::new();
    for url in &arguments.metrics {
        match page_of_url(url).await {
            Ok(found) => pages.extend(found),
            Err(failure) => warn(&failure.to_string()),
        }
    }
    pages
}

/// The reason why metrics or spans were not sent.
#[derive(Debug, thiserror::Error)]
enum ExportFault {
    #[error("no program of this host has --metrics")]
    NoProgram,
    #[error("HTTP status {status}: {body}")]
    Status { status: u16, body: String },
    #[error(transparent)]
    Request(#[from] CommandFailure),
}

/// Sends a request, once more after a pause if the collector does not take it. Counters are totals,
/// so the next export makes up for a lost one.
async fn send(collector: &HttpServer, path: &str, body: Vec<u8>) -> Result<(), ExportFault> {
    let mut last = Ok(());
    for pause in [Duration::ZERO, RETRY] {
        sleep(pause).await;
        let change = ChangeRequest {
            method: "POST",
            content_type: PROTOBUF,
            body: body.clone(),
            user: None,
        };
        match collector.change(path, change).await {
            Ok(answer) if (200..300).contains(&answer.status) => return Ok(()),
            Ok(answer) => {
                let may_help = [429, 502, 503, 504].contains(&answer.status);
                last = Err(ExportFault::Status {
                    status: answer.status,
                    body: harmless(&answer.body),
                });
                if !may_help {
                    return last;
                }
            }
            Err(failure) => last = Err(ExportFault::Request(failure)),
        }
    }
    last
}

/// Returns the metrics of programs at a time in nanoseconds since 1970.
fn request(pages: &[StatusPage], now: i128) -> Vec<u8> {
    let mut request = ProtobufMessage::default();
    let now = u64::try_from(now).unwrap_or_default();
    for page in pages {
        let uptime = Duration::from_secs(page.uptime_s.unwrap_or_default());
        let uptime = u64::try_from(uptime.as_nanos()).unwrap_or_default();
        let times = (now.saturating_sub(uptime), now);
        request.message(RESOURCE_METRICS, |metrics| resource(metrics, page, times));
    }
    request.into_bytes()
}

/// The start of the program and the present time.
type Times = (u64, u64);

fn resource(metrics: &mut ProtobufMessage, page: &StatusPage, times: Times) {
    metrics.message(RESOURCE, |resource| {
        resource.attribute(RESOURCE_ATTRIBUTES, "service.name", &page.program);
        let version = page.version.as_deref().unwrap_or_default();
        resource.attribute(RESOURCE_ATTRIBUTES, "service.version", version);
        resource.attribute(RESOURCE_ATTRIBUTES, "service.instance.id", &page.url);
        let space = page.space.to_string();
        resource.attribute(RESOURCE_ATTRIBUTES, "ua.space", &space);
    });
    metrics.message(SCOPE_METRICS, |scoped| {
        scoped.message(SCOPE, |scope| scope.text(SCOPE_NAME, "ua-space"));
        metric(
            scoped,
            ("ua.ready", "1 while the program is ready", "1"),
            GAUGE,
            |gauge| {
                gauge.message(POINTS, |point| {
                    point.fixed(POINT_TIME, times.1);
                    point.fixed(POINT_INT, u64::from(page.not_ready.is_empty()));
                });
            },
        );
        for (name, about, count) in COUNTERS {
            counter(scoped, (name, about), |sum| {
                for (topic, counts) in &page.topics {
                    point(sum, times, &topic_attributes(topic, counts), count(counts));
                }
            });
        }
        counter(
            scoped,
            ("ua.samples.dropped", "Dropped samples by reason"),
            |sum| {
                for (topic, counts) in &page.topics {
                    for (reason, count) in &counts.dropped {
                        let mut attributes = topic_attributes(topic, counts);
                        attributes.push(("reason", reason));
                        point(sum, times, &attributes, *count);
                    }
                }
                for (reason, count) in &page.others.dropped {
                    point(sum, times, &[("reason", reason)], *count);
                }
            },
        );
        let about = "Delays of samples by hop since the start of the program";
        metric(scoped, ("ua.hop.delay", about, "us"), SUMMARY, |summary| {
            for (name, hop) in &page.hops {
                quantiles(summary, times, name, hop);
            }
        });
    });
}

/// The counters of a topic: name, description and value.
type Counter = (&'static str, &'static str, fn(&TopicPage) -> u64);

const COUNTERS: [Counter; 4] = [
    ("ua.samples.sent", "Samples sent to the space", |counts| {
        counts.sent
    }),
    (
        "ua.samples.delivered",
        "Samples delivered to the local side",
        |counts| counts.delivered,
    ),
    (
        "ua.samples.repeated",
        "Repetitions sent for late joiners",
        |counts| counts.repeated,
    ),
    (
        "ua.samples.missing",
        "Samples of other spaces that did not arrive",
        |counts| counts.missing,
    ),
];

fn topic_attributes<'p>(topic: &'p str, counts: &'p TopicPage) -> Vec<(&'static str, &'p str)> {
    let name = counts.name.as_deref().map(|name| ("name", name));
    [("topic", topic)].into_iter().chain(name).collect()
}

fn metric(
    scoped: &mut ProtobufMessage,
    (name, about, unit): (&str, &str, &str),
    kind: u32,
    fill: impl FnOnce(&mut ProtobufMessage),
) {
    scoped.message(METRICS, |metric| {
        metric.text(METRIC_NAME, name);
        metric.text(METRIC_DESCRIPTION, about);
        metric.text(METRIC_UNIT, unit);
        metric.message(kind, fill);
    });
}

fn counter(
    scoped: &mut ProtobufMessage,
    (name, about): (&str, &str),
    fill: impl FnOnce(&mut ProtobufMessage),
) {
    metric(scoped, (name, about, "{sample}"), SUM, |sum| {
        fill(sum);
        sum.number(SUM_TEMPORALITY, CUMULATIVE);
        sum.number(SUM_MONOTONIC, 1);
    });
}

fn point(sum: &mut ProtobufMessage, (start, now): Times, attributes: &[(&str, &str)], value: u64) {
    sum.message(POINTS, |point| {
        for (name, value) in attributes {
            point.attribute(POINT_ATTRIBUTES, name, value);
        }
        point.fixed(POINT_START, start);
        point.fixed(POINT_TIME, now);
        point.fixed(POINT_INT, value);
    });
}

fn quantiles(summary: &mut ProtobufMessage, (start, now): Times, name: &str, hop: &HopPage) {
    summary.message(POINTS, |point| {
        point.attribute(POINT_ATTRIBUTES, "hop", name);
        point.fixed(POINT_START, start);
        point.fixed(POINT_TIME, now);
        point.fixed(SUMMARY_COUNT, hop.count);
        for (quantile, value) in [(0.5, hop.p50_us), (0.99, hop.p99_us), (1.0, hop.max_us)] {
            point.message(SUMMARY_QUANTILES, |one| {
                one.double(QUANTILE, quantile);
                one.double(QUANTILE_VALUE, value);
            });
        }
    });
}

/// The usual and the shortest period, in seconds.
const USUAL: f64 = 10.0;
const SHORTEST: f64 = 0.1;
const LONGEST: Duration = Duration::from_secs(86_400);
const RETRY: Duration = Duration::from_secs(1);
const METRICS_PATH: &str = "/v1/metrics";
const TRACES_PATH: &str = "/v1/traces";

/// Fields of ExportMetricsServiceRequest, ResourceMetrics and ScopeMetrics.
const RESOURCE_METRICS: u32 = 1;
const RESOURCE: u32 = 1;
const SCOPE_METRICS: u32 = 2;
const RESOURCE_ATTRIBUTES: u32 = 1;
const SCOPE: u32 = 1;
const SCOPE_NAME: u32 = 1;
const METRICS: u32 = 2;
/// Fields of Metric, Gauge, Sum and Summary.
const METRIC_NAME: u32 = 1;
const METRIC_DESCRIPTION: u32 = 2;
const METRIC_UNIT: u32 = 3;
const GAUGE: u32 = 5;
const SUM: u32 = 7;
const SUMMARY: u32 = 11;
const POINTS: u32 = 1;
const SUM_TEMPORALITY: u32 = 2;
const SUM_MONOTONIC: u32 = 3;
const CUMULATIVE: u64 = 2;
/// Fields of NumberDataPoint, SummaryDataPoint and ValueAtQuantile.
const POINT_START: u32 = 2;
const POINT_TIME: u32 = 3;
const POINT_INT: u32 = 6;
const POINT_ATTRIBUTES: u32 = 7;
const SUMMARY_COUNT: u32 = 4;
const SUMMARY_QUANTILES: u32 = 6;
const QUANTILE: u32 = 1;
const QUANTILE_VALUE: u32 = 2;

#[cfg(test)]
mod tests {
    use super::super::protobuf::tests::{Value, fields};
    use super::*;

    /// Returns the texts in a message and its parts.
    fn texts(bytes: &[u8], all: &mut Vec<String>) {
        let printable = |bytes: &[u8]| {
            let text = std::str::from_utf8(bytes).ok()?;
            let is_text = !text.is_empty() && text.chars().all(|c| !c.is_control());
            is_text.then(|| text.to_owned())
        };
        for (_, value) in fields(bytes) {
            if let Value::Bytes(inner) = value {
                match printable(inner) {
                    Some(text) => all.push(text),
                    None => texts(inner, all),
                }
            }
        }
    }

    #[test]
    fn a_program_is_a_resource_with_its_counters_and_delays() {
        let status = r#"{"program":"bridge-ros1","version":"1.0","uptime_s":60,"space":1,
            "topics":{"ua_1_2_10":{"name":"Left.Speed","sent":5,"dropped":{"too_big":2}}},
            "hops":{"out":{"count":5,"p50_us":10.0,"p99_us":20.0,"max_us":30.0}}}"#;
        let page: StatusPage = serde_json::from_str(status).unwrap();
        let body = request(&[page.clone(), page], 1_700_000_000_000_000_000);
        let resources = fields(&body);
        assert_eq!(resources.len(), 2);
        let Value::Bytes(first) = &resources[0].1 else {
            panic!("a resource is a message");
        };
        let mut all = Vec::new();
        texts(first, &mut all);
        for text in [
            "service.name",
            "bridge-ros1",
            "ua.samples.sent",
            "ua.samples.dropped",
            "too_big",
            "Left.Speed",
            "ua.hop.delay",
            "out",
        ] {
            assert!(all.iter().any(|one| one == text), "{text} in {all:?}");
        }
    }
}
