//! Values that are held back: publish on change, deadband, and maximum rate.
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Local, LocalMessage, Now, Output, PublisherKey, Reason, Router, RouterSettings, Verdict,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::{NetworkMessage, Scalar, Timestamp, Variant};

/// A bridge with a single variable of type Double and the given publishing rules.
struct Bench {
    router: Router,
    now: Now,
    topic: TopicId,
}

impl Bench {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(rules: &str) -> Self {
        let text = format!(
            "spaces: [{{id: 1}}]\nnamespaces: {{2: urn:my-plant:line}}\npubsub: {{key_frame_period: 10s, keep_alive_period: 10s, \
             receive_timeout: 30s}}\nvariables:\n  - {{node: ns=2;i=10, name: A, origin: 1, type: Double, {rules}, \
             ros: {{topic: /a, type: std_msgs/Float64}}}}\n"
        );
        let checked = Mapping::from_yaml(&text, "cell.yaml");
        assert!(checked.findings.is_empty(), "{}", checked.render(&text));
        let settings = RouterSettings {
            own: SpaceId::new(1).unwrap(),
            local: Local::Ros1,
            source: None,
        };
        let now = Now {
            monotonic: Instant::now(),
            utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
        };
        let mut router = Router::new(settings, Arc::new(checked.mapping.unwrap()));
        let topic = "ua_1_2_10".parse().unwrap();
        let double = TypeRegistry::bundle(Dialect::Ros1)
            .get(&"std_msgs/Float64".parse().unwrap())
            .unwrap();
        router.bind(topic, &double, &Selection::Whole, now).unwrap();
        let mut bench = Self { router, now, topic };
        // The metadata is announced before.
        bench.wait(Duration::from_secs(1));
        assert_eq!(bench.sent(), []);
        bench
    }

    fn say(&mut self, value: f64) -> Verdict {
        self.say_by(None, value)
    }

    fn say_by(&mut self, latched_by: Option<PublisherKey>, value: f64) -> Verdict {
        let heard = LocalMessage {
            topic: self.topic,
            payload: &value.to_le_bytes(),
            received: self.now.utc,
            latched_by,
        };
        self.router.handle_local(heard, self.now)
    }

    /// Advances the clock without handling timeouts.
    fn pass(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
    }

    fn wait(&mut self, time: Duration) {
        self.pass(time);
        self.router.handle_timeout(self.now);
    }

    /// Returns the sequence number and value of each datagram.
    fn sent(&mut self) -> Vec<(u16, f64)> {
        std::iter::from_fn(|| self.router.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Datagram { bytes, .. } => Some(value(&bytes)),
                Output::Discovery { .. } => None,
                other => panic!("{other:?}"),
            })
            .collect()
    }

    fn dropped(&self, reason: Reason) -> u64 {
        let counters = self.router.topics().map(|(_, counters)| counters);
        counters.map(|counters| counters.dropped(reason)).sum()
    }
}

fn value(datagram: &[u8]) -> (u16, f64) {
    let network = NetworkMessage::decode(datagram).unwrap();
    let message = network.messages().next().unwrap().unwrap();
    match message.fields().unwrap().next() {
        Some(Ok(Variant::Scalar(Scalar::Double(value)))) => {
            (message.sequence_number().unwrap(), value)
        }
        other => panic!("{other:?}"),
    }
}

const UNCHANGED: Verdict = Verdict::Drop(Reason::Unchanged);
const MS: Duration = Duration::from_millis(1);

#[test]
fn on_change_a_value_is_sent_when_it_differs_and_still_repeated_for_late_joiners() {
    let mut bench = Bench::new("publish: on_change");
    let mut sent = Vec::new();
    for value in [1.0, 1.0, 2.0, 1.0, 1.0] {
        sent.push((bench.say(value), bench.sent()));
    }
    let expected = [
        (Verdict::Forward, vec![(0, 1.0)]),
        (UNCHANGED, vec![]),
        (Verdict::Forward, vec![(1, 2.0)]),
        (Verdict::Forward, vec![(2, 1.0)]),
        (UNCHANGED, vec![]),
    ];
    assert_eq!(sent, expected);
    assert_eq!(bench.dropped(Reason::Unchanged), 2);
    bench.wait(10_000 * MS);
    assert_eq!(bench.sent(), [(2, 1.0)], "under its own number");
}

#[test]
fn within_the_deadband_of_what_was_sent_last_nothing_is_sent() {
    let mut bench = Bench::new("deadband: 0.5, queue: {drop_oldest: 9}");
    for value in [20.0, 20.5, 19.5, 20.6, 20.2, f64::NAN, f64::NAN, 20.6] {
        let _verdict = bench.say(value);
    }
    let sent: Vec<f64> = bench.sent().into_iter().map(|(_, value)| value).collect();
    assert!(
        matches!(sent[..], [20.0, 20.6, nan, 20.6] if nan.is_nan()),
        "{sent:?}"
    );
    assert_eq!(bench.dropped(Reason::Unchanged), 4);
}

#[test]
fn a_slow_drift_is_measured_from_what_was_sent_and_so_is_seen() {
    let mut bench = Bench::new("deadband: 1, queue: {drop_oldest: 9}");
    for step in 0..=10 {
        let _verdict = bench.say(f64::from(step) * 0.4);
    }
    let sent: Vec<f64> = bench.sent().into_iter().map(|(_, value)| value).collect();
    assert_eq!(sent.len(), 4, "{sent:?}");
}

#[test]
fn of_values_faster_than_the_rate_the_newest_follows_when_the_time_is_over() {
    let mut bench = Bench::new("at_most: 10 Hz, queue: keep_latest");
    assert_eq!(bench.say(1.0), Verdict::Forward);
    assert_eq!(bench.sent(), [(0, 1.0)]);
    for value in [2.0, 3.0, 4.0] {
        bench.wait(10 * MS);
        assert_eq!(bench.say(value), Verdict::Forward);
        assert_eq!(bench.sent(), []);
    }
    assert_eq!(bench.dropped(Reason::Outpaced), 2);
    let due = bench.router.poll_timeout().unwrap();
    assert_eq!(due, bench.now.monotonic + 70 * MS);
    bench.wait(69 * MS);
    assert_eq!(bench.sent(), []);
    bench.wait(MS);
    assert_eq!(bench.sent(), [(1, 4.0)]);
    bench.wait(50 * MS);
    assert_eq!(bench.say(5.0), Verdict::Forward);
    assert_eq!(bench.sent(), [], "the time counts from the last one sent");
    bench.wait(50 * MS);
    assert_eq!(bench.sent(), [(2, 5.0)]);
}

#[test]
fn a_value_that_returns_before_its_time_is_not_sent() {
    let mut bench = Bench::new("publish: on_change, at_most: 10 Hz");
    assert_eq!(bench.say(1.0), Verdict::Forward);
    assert_eq!(bench.say(2.0), Verdict::Forward);
    assert_eq!(bench.say(1.0), UNCHANGED);
    assert_eq!(bench.sent(), [(0, 1.0)]);
    bench.wait(200 * MS);
    assert_eq!(bench.sent(), []);
}

#[test]
fn a_value_that_waits_gives_way_to_one_that_comes_when_its_time_is_over() {
    let mut bench = Bench::new("at_most: 10 Hz");
    for value in [1.0, 2.0] {
        assert_eq!(bench.say(value), Verdict::Forward);
    }
    assert_eq!(bench.sent(), [(0, 1.0)]);
    // The timeout has not been handled yet.
    bench.pass(100 * MS);
    assert_eq!(bench.say(3.0), Verdict::Forward);
    bench.wait(500 * MS);
    assert_eq!(bench.sent(), [(1, 3.0)], "2.0 is old");
    assert_eq!(bench.dropped(Reason::Outpaced), 1);
}

#[test]
fn what_waits_goes_out_when_the_last_publisher_stops_and_the_topic_stays_dead() {
    let mut bench = Bench::new("at_most: 2 Hz");
    assert_eq!(bench.say(1.0), Verdict::Forward);
    assert_eq!(bench.sent(), [(0, 1.0)]);
    assert_eq!(bench.say(2.0), Verdict::Forward);
    assert!(bench.sent().is_empty(), "too early");
    bench.router.set_live(bench.topic, false, bench.now);
    assert_eq!(bench.sent(), [(1, 2.0)]);
    bench.wait(60_000 * MS);
    assert!(bench.sent().is_empty(), "nothing is repeated for the dead");
}

#[test]
fn late_joiners_get_the_last_value_of_each_latched_publisher_but_of_none_that_left() {
    let key = PublisherKey;
    for rules in ["publish: on_change", "at_most: 2 Hz"] {
        let mut bench = Bench::new(rules);
        // The same value from two publishers and another value from a third publisher at the same
        // time.
        for (publisher, value) in [(1, 5.0), (2, 5.0), (3, 6.0)] {
            let verdict = bench.say_by(Some(key(publisher)), value);
            assert_eq!(verdict, Verdict::Forward, "{rules}");
            assert_eq!(bench.sent().len(), 1, "{rules}");
        }
        assert_eq!(bench.say_by(Some(key(1)), 7.0), Verdict::Forward, "{rules}");
        bench.router.left(bench.topic, key(1), bench.now);
        assert_eq!(bench.sent(), [(3, 7.0)], "{rules}");
        bench.wait(10_000 * MS);
        let mut repeated: Vec<f64> = bench.sent().into_iter().map(|(_, value)| value).collect();
        repeated.sort_by(f64::total_cmp);
        repeated.dedup();
        assert_eq!(repeated, [5.0, 6.0], "{rules}");
        // The publisher restarts under another key and latches the same value.
        assert_eq!(bench.say_by(Some(key(9)), 7.0), Verdict::Forward, "{rules}");
        let sent: Vec<f64> = bench.sent().into_iter().map(|(_, value)| value).collect();
        assert!(sent.contains(&7.0), "{rules}: {sent:?}");
    }
}

#[test]
fn an_infinity_is_no_change_of_an_infinity() {
    let mut bench = Bench::new("deadband: 0.5");
    let verdicts = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY].map(|value| {
        let verdict = bench.say(value);
        (verdict, bench.sent().len())
    });
    assert_eq!(
        verdicts,
        [(Verdict::Forward, 1), (UNCHANGED, 0), (Verdict::Forward, 1)]
    );
}
