//! The delays of the topics that browsers show, hop by hop, from `/tap` of the programs.

use std::collections::BTreeMap;

use bridge_core::RecentDelays;
use mappings::{SpaceId, TopicId};
use serde_json::{Map, Value, json};

/// The delays of a topic at programs, by the location of their status and by their space. A program
/// that had no sample of the topic has no spaces.
pub(crate) type ShownHops = BTreeMap<String, BTreeMap<u64, Value>>;

/// Reads the steps of samples of the shown topics from programs.
#[derive(Debug, Default)]
pub(crate) struct TapFollower {
    tapped: BTreeMap<(TopicId, String), TappedHops>,
}

/// The steps of a topic at a program.
#[derive(Debug, Default)]
struct TappedHops {
    /// The number of the next step.
    from: u64,
    hops: BTreeMap<(u64, String), RecentDelays<MOST_DELAYS>>,
}

impl TapFollower {
    /// Forgets the steps of all topics except the shown ones.
    pub(crate) fn keep(&mut self, shown: &[TopicId]) {
        self.tapped.retain(|(topic, _), _| shown.contains(topic));
    }

    /// Returns the path and query of the request for the new steps of a topic at a program.
    pub(crate) fn request(&self, topic: TopicId, source: &str) -> String {
        let tapped = self.tapped.get(&(topic, source.to_owned()));
        let from = tapped.map_or(0, |tapped| tapped.from);
        format!("/tap?topic={topic}&from={from}")
    }

    /// Takes the response to a request. A response that is not as expected has no steps.
    pub(crate) fn take(&mut self, topic: TopicId, source: &str, response: &Value) {
        let Some(next) = response.get("next").and_then(Value::as_u64) else {
            return;
        };
        let tapped = self.tapped.entry((topic, source.to_owned())).or_default();
        tapped.from = next;
        let events = response.get("events").and_then(Value::as_array);
        for event in events.into_iter().flatten() {
            tapped.take(event);
        }
    }

    /// Returns the delays of a topic.
    pub(crate) fn shown(&self, topic: TopicId) -> ShownHops {
        let of_topic = self.tapped.iter().filter(|((of, _), _)| *of == topic);
        let shown = of_topic.map(|((_, source), tapped)| (source.clone(), tapped.shown()));
        shown.collect()
    }
}

impl TappedHops {
    fn shown(&self) -> BTreeMap<u64, Value> {
        let mut spaces: BTreeMap<u64, Map<String, Value>> = BTreeMap::new();
        for ((space, hop), delays) in &self.hops {
            let hops = spaces.entry(*space).or_default();
            hops.insert(hop.clone(), figures(delays));
        }
        let spaces = spaces.into_iter();
        spaces.map(|(space, hops)| (space, hops.into())).collect()
    }

    fn take(&mut self, event: &Value) {
        let text = |key: &str| event.get(key).and_then(Value::as_str).unwrap_or_default();
        let number = |key: &str| event.get(key).and_then(Value::as_f64);
        let (hop, delay) = match text("step") {
            "measured" => (text("hop"), number("delay_us")),
            "published" => ("in", number("after_us")),
            _ => return,
        };
        let space = event.get("space").and_then(Value::as_u64);
        let (Some(space), Some(delay)) = (space, delay) else {
            return;
        };
        if HOPS.contains(&hop) && space <= u64::from(SpaceId::MAX.get()) {
            let delays = self.hops.entry((space, hop.to_owned())).or_default();
            delays.record_us(delay);
        }
    }
}

fn figures(delays: &RecentDelays<MOST_DELAYS>) -> Value {
    let [p50, p99, max] = delays.quantiles_us([500, 990, 1000]);
    json!({
        "count": delays.last().len(), "negative": delays.negative(),
        "p50_us": p50, "p99_us": p99, "max_us": max,
    })
}

const HOPS: [&str; 4] = ["out", "origin", "network", "in"];
/// The number of delays of a hop from which its figures are computed.
const MOST_DELAYS: usize = 1_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::tests::topic;

    fn measured(space: u64, hop: &str, delay: f64) -> Value {
        json!({ "space": space, "step": "measured", "hop": hop, "delay_us": delay })
    }

    #[test]
    fn the_hops_of_a_topic_are_those_of_its_own_samples() {
        let (one, other) = (topic("ua_1_2_10"), topic("ua_1_2_11"));
        let mut follower = TapFollower::default();
        let source = "http://127.0.0.1:9102";
        assert_eq!(follower.request(one, source), "/tap?topic=ua_1_2_10&from=0");
        let mut events: Vec<Value> = (1..=100)
            .map(|delay| measured(2, "network", f64::from(delay)))
            .collect();
        events.push(measured(2, "network", -4.0));
        events.push(json!({ "space": 2, "step": "published", "after_us": 7.5 }));
        events.push(json!({ "space": 2, "step": "sent", "repeated": true }));
        events.push(measured(2, "unknown", 1.0));
        follower.take(
            one,
            source,
            &json!({ "next": 105, "lost": 0, "events": events }),
        );
        follower.take(
            other,
            source,
            &json!({ "next": 2, "events": [measured(2, "in", 3.0)] }),
        );
        follower.take(other, source, &json!("no steps"));
        assert_eq!(
            follower.request(one, source),
            "/tap?topic=ua_1_2_10&from=105"
        );
        let shown = follower.shown(one);
        let hops = &shown[source][&2];
        assert_eq!(hops["network"]["count"], 100);
        assert_eq!(hops["network"]["negative"], 1);
        assert_eq!(
            (&hops["network"]["p50_us"], &hops["network"]["p99_us"]),
            (&json!(50.0), &json!(99.0))
        );
        assert_eq!(hops["in"]["max_us"], 7.5);
        assert_eq!(hops.as_object().unwrap().len(), 2);
        follower.keep(&[other]);
        assert!(follower.shown(one).is_empty());
        assert_eq!(follower.shown(other)[source].len(), 1);
        // A program without a sample of the topic reports no delays of it.
        let (third, nothing) = (topic("ua_1_2_12"), json!({ "next": 1, "events": [] }));
        follower.take(third, source, &nothing);
        assert!(follower.shown(third)[source].is_empty());
    }

    #[test]
    fn the_number_of_delays_is_bounded() {
        let mut delays = RecentDelays::default();
        for delay in 0..5_000_u32 {
            delays.record_us(delay.into());
        }
        let shown = figures(&delays);
        assert_eq!(
            (&shown["count"], &shown["max_us"]),
            (&json!(1_000), &json!(4_999.0))
        );
        assert_eq!(shown["p50_us"], 4_499.0);
    }
}
