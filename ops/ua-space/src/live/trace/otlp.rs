//! `ua-space trace --otlp`: sends the counters and delays of programs as metrics of OpenTelemetry
//! (OTLP 1.5 over HTTP). The request is a protobuf message `ExportMetricsServiceRequest`.

use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval, sleep};

use super::super::text::harmless;
use super::super::unix_nanos;
use super::protobuf::Message;
use crate::arguments::Trace;
use crate::cell::{HopPage, Page, TopicPage, page_of_url, pages_of_this_host};
use crate::exit::Failure;
use crate::http::{Change, PROTOBUF, Server};
use crate::interrupt::Interrupt;
use crate::report::warn;

/// Exports until the user interrupts the command.
pub(super) async fn export(arguments: &Trace, url: &str) -> Result<(), Failure> {
    let collector = Server::parse(url)?;
    let seconds = arguments.seconds.unwrap_or(USUAL).max(SHORTEST);
    let period = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let mut interrupt = Interrupt::catch()?;
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut is_sent = false;
    let mut last = String::new();
    loop {
        let round = async {
            ticks.tick().await;
            send(&collector, &pages(arguments).await).await
        };
        let sent = tokio::select! {
            biased;
            () = interrupt.received() => break,
            sent = round => sent,
        };
        match sent {
            Ok(()) => {
                is_sent = true;
                last.clear();
            }
            Err(why) => {
                // The same fault is reported once.
                if why != last {
                    warn(&format!("metrics were not sent: {why}"));
                    last = why;
                }
            }
        }
    }
    match is_sent {
        true => Ok(()),
        false => Err(Failure::NotThere),
    }
}

async fn pages(arguments: &Trace) -> Vec<Page> {
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

/// Sends the metrics, once more after a pause if the collector does not take them. Counters are
/// totals, so the next export makes up for a lost one.
async fn send(collector: &Server, pages: &[Page]) -> Result<(), String> {
    if pages.is_empty() {
        return Err("no program of this host has --metrics".to_owned());
    }
    let body = request(pages, unix_nanos());
    let mut why = String::new();
    for pause in [Duration::ZERO, RETRY] {
        sleep(pause).await;
        let change = Change {
            method: "POST",
            content_type: PROTOBUF,
            body: body.clone(),
            user: None,
        };
        match collector.change("/v1/metrics", change).await {
            Ok(answer) if (200..300).contains(&answer.status) => return Ok(()),
            Ok(answer) => {
                why = format!("HTTP status {}: {}", answer.status, harmless(&answer.body));
                let may_help = [429, 502, 503, 504].contains(&answer.status);
                if !may_help {
                    return Err(why);
                }
            }
            Err(failure) => why = failure.to_string(),
        }
    }
    Err(why)
}

/// Returns the metrics of programs at a time in nanoseconds since 1970.
fn request(pages: &[Page], now: i128) -> Vec<u8> {
    let mut request = Message::default();
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

fn resource(metrics: &mut Message, page: &Page, times: Times) {
    metrics.message(RESOURCE, |resource| {
        attribute(resource, RESOURCE_ATTRIBUTES, "service.name", &page.program);
        let version = page.version.as_deref().unwrap_or_default();
        attribute(resource, RESOURCE_ATTRIBUTES, "service.version", version);
        attribute(
            resource,
            RESOURCE_ATTRIBUTES,
            "service.instance.id",
            &page.url,
        );
        let space = page.space.to_string();
        attribute(resource, RESOURCE_ATTRIBUTES, "ua.space", &space);
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
    scoped: &mut Message,
    (name, about, unit): (&str, &str, &str),
    kind: u32,
    fill: impl FnOnce(&mut Message),
) {
    scoped.message(METRICS, |metric| {
        metric.text(METRIC_NAME, name);
        metric.text(METRIC_DESCRIPTION, about);
        metric.text(METRIC_UNIT, unit);
        metric.message(kind, fill);
    });
}

fn counter(scoped: &mut Message, (name, about): (&str, &str), fill: impl FnOnce(&mut Message)) {
    metric(scoped, (name, about, "{sample}"), SUM, |sum| {
        fill(sum);
        sum.number(SUM_TEMPORALITY, CUMULATIVE);
        sum.number(SUM_MONOTONIC, 1);
    });
}

fn point(sum: &mut Message, (start, now): Times, attributes: &[(&str, &str)], value: u64) {
    sum.message(POINTS, |point| {
        for (name, value) in attributes {
            attribute(point, POINT_ATTRIBUTES, name, value);
        }
        point.fixed(POINT_START, start);
        point.fixed(POINT_TIME, now);
        point.fixed(POINT_INT, value);
    });
}

fn quantiles(summary: &mut Message, (start, now): Times, name: &str, hop: &HopPage) {
    summary.message(POINTS, |point| {
        attribute(point, POINT_ATTRIBUTES, "hop", name);
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

fn attribute(of: &mut Message, field: u32, name: &str, value: &str) {
    of.message(field, |attribute| {
        attribute.text(KEY, name);
        attribute.message(VALUE, |any| any.text(STRING_VALUE, value));
    });
}

/// The usual and the shortest period, in seconds.
const USUAL: f64 = 10.0;
const SHORTEST: f64 = 0.1;
const RETRY: Duration = Duration::from_secs(1);

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
/// Fields of KeyValue and AnyValue.
const KEY: u32 = 1;
const VALUE: u32 = 2;
const STRING_VALUE: u32 = 1;

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
        let page: Page = serde_json::from_str(status).unwrap();
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
