//! Samples as traces of OpenTelemetry: a trace for each sample, a span for each hop.
//!
//! The request is a protobuf message `ExportTraceServiceRequest`.

use std::collections::BTreeMap;

use mappings::TopicId;

use super::protobuf::ProtobufMessage;
use super::{NETWORK, ORIGIN, Times};
use crate::cell::StatusPage;

/// The samples of a period.
#[derive(Debug)]
pub(super) struct SampledPeriod {
    /// The largest number of samples of a topic.
    most: usize,
    samples: BTreeMap<TopicId, Vec<Times>>,
    count: usize,
}

/// A sample with the name of its topic.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SampledValue {
    pub(super) times: Times,
    pub(super) name: Option<String>,
}

impl SampledPeriod {
    pub(super) const fn new(most: usize) -> Self {
        Self {
            most,
            samples: BTreeMap::new(),
            count: 0,
        }
    }

    /// Adds a sample if its topic has few in this period. Repetitions, and samples with negative
    /// delays, have no spans.
    pub(super) fn add(&mut self, times: Times) {
        let is_whole = times.stamp.is_some()
            && times.origin().is_some_and(|delay| delay >= 0)
            && times.network().is_some_and(|delay| delay >= 0);
        if !is_whole || self.count >= MOST_SAMPLES {
            return;
        }
        let of_topic = self.samples.entry(times.topic).or_default();
        if of_topic.len() < self.most {
            of_topic.push(times);
            self.count += 1;
        }
    }

    /// Takes the samples of the period.
    pub(super) fn take(
        &mut self,
        name_of: &dyn Fn(TopicId) -> Option<String>,
    ) -> Vec<SampledValue> {
        self.count = 0;
        let samples = std::mem::take(&mut self.samples).into_iter();
        let named = samples.flat_map(|(topic, all)| {
            let name = name_of(topic);
            all.into_iter().map(move |times| SampledValue {
                times,
                name: name.clone(),
            })
        });
        named.collect()
    }
}

/// Returns the spans of samples. `pages` name the programs that sent them. The same sample has the
/// same trace at all observers, whose spans differ by `observer`.
pub(super) fn request(samples: &[SampledValue], pages: &[StatusPage], observer: u64) -> Vec<u8> {
    let mut of_writers: BTreeMap<String, Vec<&SampledValue>> = BTreeMap::new();
    for sample in samples {
        let writer = writer(sample.times.topic, pages);
        of_writers.entry(writer).or_default().push(sample);
    }
    let mut request = ProtobufMessage::default();
    for (writer, samples) in &of_writers {
        resource(&mut request, writer, |scoped| {
            for sample in samples {
                let Times { taken, sent, .. } = sample.times;
                let ids = (origin_id(sample.times.topic), None);
                span(scoped, sample, (ORIGIN, PRODUCER), (taken, sent), ids);
            }
        });
    }
    resource(&mut request, "ua-space", |scoped| {
        for sample in samples {
            let Times { sent, arrived, .. } = sample.times;
            let ids = (observer | 1, Some(origin_id(sample.times.topic)));
            let times = (sent, Some(arrived));
            span(scoped, sample, (NETWORK, CONSUMER), times, ids);
        }
    });
    request.into_bytes()
}

/// Returns the program that sends a topic, or its space.
fn writer(topic: TopicId, pages: &[StatusPage]) -> String {
    let name = topic.to_string();
    let sends = |page: &&StatusPage| page.topics.get(&name).is_some_and(|topic| topic.sent > 0);
    let own = |page: &&StatusPage| u16::from(page.space) == u16::from(topic.space) && sends(page);
    let program = pages.iter().find(own).map(|page| page.program.clone());
    program.unwrap_or_else(|| format!("space {}", topic.space))
}

fn resource(request: &mut ProtobufMessage, service: &str, fill: impl FnOnce(&mut ProtobufMessage)) {
    request.message(RESOURCE_SPANS, |spans| {
        spans.message(RESOURCE, |resource| {
            resource.attribute(RESOURCE_ATTRIBUTES, "service.name", service);
        });
        spans.message(SCOPE_SPANS, |scoped| {
            scoped.message(SCOPE, |scope| scope.text(SCOPE_NAME, "ua-space"));
            fill(scoped);
        });
    });
}

/// Adds a span with its id and the id of its parent.
fn span(
    scoped: &mut ProtobufMessage,
    SampledValue { times, name }: &SampledValue,
    (hop, kind): (&str, u64),
    (from, to): (Option<i128>, Option<i128>),
    (id, parent): (u64, Option<u64>),
) {
    let nanos = |time: Option<i128>| time.and_then(|time| u64::try_from(time).ok());
    let (Some(from), Some(to)) = (nanos(from), nanos(to)) else {
        return;
    };
    let topic = times.topic.to_string();
    let shown = name.as_deref().unwrap_or(&topic);
    scoped.message(SPANS, |span| {
        span.bytes(TRACE_ID, &trace_id(times));
        span.bytes(SPAN_ID, &id.to_be_bytes());
        if let Some(parent) = parent {
            span.bytes(PARENT_SPAN_ID, &parent.to_be_bytes());
        }
        span.text(SPAN_NAME, &format!("{shown} {hop}"));
        span.number(KIND, kind);
        span.fixed(START_TIME, from);
        span.fixed(END_TIME, to);
        span.attribute(SPAN_ATTRIBUTES, "topic", &topic);
        span.attribute(SPAN_ATTRIBUTES, "hop", hop);
        if let Some(name) = name {
            span.attribute(SPAN_ATTRIBUTES, "name", name);
        }
        if let Some(number) = times.sequence {
            span.attribute(SPAN_ATTRIBUTES, "sequence", &number.to_string());
        }
    });
}

/// Returns the id of the trace of a sample: the topic, the sequence number, and the time at which
/// its writer took the value, by the clock of the writer.
fn trace_id(times: &Times) -> [u8; 16] {
    let (space, namespace, identifier) = times.topic.triple();
    let sequence = times.sequence.unwrap_or_default();
    let stamp = u64::try_from(times.stamp.unwrap_or_default()).unwrap_or_default();
    let mut id = [0; 16];
    let parts = [space, namespace, identifier, sequence].map(u16::to_be_bytes);
    let bytes = parts.into_iter().flatten().chain(stamp.to_be_bytes());
    for (to, byte) in id.iter_mut().zip(bytes) {
        *to = byte;
    }
    id
}

/// Returns the id of the span at the writer.
fn origin_id(topic: TopicId) -> u64 {
    let (space, namespace, identifier) = topic.triple();
    let parts = [space, namespace, identifier, 2];
    let add = |all: u64, part: &u16| (all << 16) | u64::from(*part);
    parts.iter().fold(0, add)
}

/// The largest number of samples of a period.
const MOST_SAMPLES: usize = 20_000;

/// Fields of ExportTraceServiceRequest, ResourceSpans and ScopeSpans.
const RESOURCE_SPANS: u32 = 1;
const RESOURCE: u32 = 1;
const SCOPE_SPANS: u32 = 2;
const RESOURCE_ATTRIBUTES: u32 = 1;
const SCOPE: u32 = 1;
const SCOPE_NAME: u32 = 1;
const SPANS: u32 = 2;
/// Fields of Span.
const TRACE_ID: u32 = 1;
const SPAN_ID: u32 = 2;
const PARENT_SPAN_ID: u32 = 4;
const SPAN_NAME: u32 = 5;
const KIND: u32 = 6;
const START_TIME: u32 = 7;
const END_TIME: u32 = 8;
const SPAN_ATTRIBUTES: u32 = 9;
/// Kinds of spans.
const PRODUCER: u64 = 4;
const CONSUMER: u64 = 5;

#[cfg(test)]
mod tests {
    use super::super::protobuf::tests::{Value, fields};
    use super::*;

    fn times(topic: &str, sequence: u16, delays: (i128, i128)) -> Times {
        let taken = 1_700_000_000_000_000_000 + i128::from(sequence) * 1_000_000;
        Times {
            topic: topic.parse().unwrap(),
            sequence: Some(sequence),
            stamp: Some(taken),
            taken: Some(taken),
            sent: Some(taken + delays.0),
            arrived: taken + delays.0 + delays.1,
        }
    }

    /// Returns the fields of each message with this number in a message.
    fn inner(bytes: &[u8], number: u32) -> Vec<&[u8]> {
        let all = fields(bytes).into_iter();
        let inner = all.filter_map(|(field, value)| match value {
            Value::Bytes(bytes) if field == u64::from(number) => Some(bytes),
            Value::Number(_) | Value::Bytes(_) => None,
        });
        inner.collect()
    }

    #[test]
    fn a_sample_is_a_trace_with_a_span_for_each_hop() {
        let mut sampled = SampledPeriod::new(2);
        for sequence in 0..5 {
            sampled.add(times("ua_1_2_10", sequence, (20_000, 300_000)));
        }
        // Negative delays, and repetitions, are no samples.
        sampled.add(times("ua_1_2_11", 1, (20_000, -300_000)));
        let repeated = Times {
            taken: None,
            ..times("ua_1_2_12", 1, (1, 1))
        };
        sampled.add(repeated);
        let samples = sampled.take(&|_| Some("Arm.Joints".to_owned()));
        assert_eq!(samples.len(), 2);
        assert!(sampled.take(&|_| None).is_empty());
        let status = r#"{"program":"bridge-ros1","space":1,"topics":{"ua_1_2_10":{"sent":5}}}"#;
        let page: StatusPage = serde_json::from_str(status).unwrap();
        let body = request(&samples, &[page], 77);
        let resources = inner(&body, RESOURCE_SPANS);
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        assert!(text(resources[0]).contains("bridge-ros1"));
        assert!(text(resources[1]).contains("ua-space"));
        let spans = |resource: &[u8]| {
            let scoped = inner(resource, SCOPE_SPANS)[0].to_vec();
            let spans = inner(&scoped, SPANS);
            spans.into_iter().map(<[u8]>::to_vec).collect::<Vec<_>>()
        };
        let (origin, network) = (spans(resources[0]), spans(resources[1]));
        assert_eq!((origin.len(), network.len()), (2, 2));
        let parts = |span: &[u8]| {
            let ids = [TRACE_ID, SPAN_ID, PARENT_SPAN_ID];
            ids.map(|id| inner(span, id).first().map(|bytes| bytes.to_vec()))
        };
        for (origin, network) in origin.iter().zip(&network) {
            let ([trace, id, none], [same, other, parent]) = (parts(origin), parts(network));
            assert_eq!((&trace, &parent, none), (&same, &id, None));
            assert_ne!(id, other);
            assert_eq!(trace.unwrap().len(), 16);
            let end = |span: &[u8]| {
                let all = fields(span);
                let found = all
                    .into_iter()
                    .find(|(field, _)| *field == u64::from(END_TIME));
                found.map(|(_, value)| match value {
                    Value::Number(time) => time,
                    Value::Bytes(_) => 0,
                })
            };
            assert_eq!(end(network).unwrap() - end(origin).unwrap(), 300_000);
        }
        assert_ne!(parts(&origin[0])[0], parts(&origin[1])[0]);
        assert!(text(&origin[0]).contains("Arm.Joints origin"));
    }
}
