//! Replacement of the mapping of a running Router.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{Local, LocalMessage, Now, Output, Reason, Router, RouterSettings};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::discovery::{AnnouncedContent, Announcement};
use uadp::{NetworkMessage, Scalar, Timestamp, Variant};

struct Bench {
    router: Router,
    now: Now,
}

fn mapping(first: &str, pubsub: &str) -> Arc<Mapping> {
    let text = format!(
        "spaces: [{{id: 1}}]\nnamespaces: {{2: 'urn:test'}}\npubsub: {{{pubsub}}}\nvariables:\n  - {{node: ns=2;i=1, name: A, \
         type: UInt32, origin: 1{first}}}\n  - {{node: ns=2;i=2, name: B, type: UInt32, origin: 1}}\n"
    );
    let checked = Mapping::from_yaml(&text, "test.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(&text));
    Arc::new(checked.mapping.unwrap())
}

fn topic(id: u16) -> TopicId {
    TopicId::new(1, 2, id).unwrap()
}

impl Bench {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(mapping: Arc<Mapping>) -> Self {
        let settings = RouterSettings {
            own: SpaceId::ROS1,
            local: Local::Ros1,
            source: None,
        };
        let mut bench = Self {
            router: Router::new(settings, mapping),
            now: Now {
                monotonic: Instant::now(),
                utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
            },
        };
        bench.bind(1);
        bench.bind(2);
        bench
    }

    fn bind(&mut self, id: u16) {
        let registry = TypeRegistry::bundle(Dialect::Ros1);
        let uint = registry.get(&"std_msgs/UInt32".parse().unwrap()).unwrap();
        let bound = self
            .router
            .bind(topic(id), &uint, &Selection::Whole, self.now);
        bound.unwrap();
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
        self.router.handle_timeout(self.now);
    }

    fn say(&mut self, id: u16, value: u32) {
        let heard = LocalMessage {
            topic: topic(id),
            payload: &value.to_le_bytes(),
            received: self.now.utc,
            latched_by: None,
        };
        let _verdict = self.router.handle_local(heard, self.now);
    }

    /// Returns the writers with DataSetMetaData announced within two seconds.
    fn announced(&mut self) -> Vec<u16> {
        let mut announced = Vec::new();
        for _ in 0..20 {
            self.wait(Duration::from_millis(100));
            while let Some(output) = self.router.poll_output(self.now) {
                let Output::Discovery { bytes } = output else {
                    continue;
                };
                let message = NetworkMessage::decode(&bytes).unwrap();
                let announcement = Announcement::decode(&message).unwrap();
                if let AnnouncedContent::DataSetMetaData { writer_id, .. } = announcement.announced
                {
                    announced.push(writer_id);
                }
            }
        }
        announced.sort_unstable();
        announced
    }

    /// Returns the writer, sequence number and value of each sent message; a keep-alive has no
    /// value.
    fn sent(&mut self) -> Vec<(u16, u16, Option<u32>)> {
        let outputs = std::iter::from_fn(|| self.router.poll_output(self.now));
        let datagrams = outputs.filter_map(|output| match output {
            Output::Datagram { bytes, .. } => Some(bytes),
            _ => None,
        });
        let mut sent: Vec<_> = datagrams
            .map(|datagram| {
                let network = NetworkMessage::decode(&datagram).unwrap();
                let message = network.messages().next().unwrap().unwrap();
                let field = message.fields().ok().and_then(|mut fields| fields.next());
                let value = match field {
                    Some(Ok(Variant::Scalar(Scalar::UInt32(value)))) => Some(value),
                    _ => None,
                };
                let sequence = message.header().sequence_number.unwrap();
                (message.writer_id.unwrap(), sequence, value)
            })
            .collect();
        sent.sort_unstable();
        sent
    }
}

#[test]
fn sequence_numbers_and_values_outlive_a_mapping_and_a_changed_route_goes_on_with_its_own() {
    let mut bench = Bench::new(mapping("", ""));
    for value in [10, 11] {
        bench.say(1, value);
        bench.say(2, value);
        bench.sent();
    }
    bench.router.replace_mapping(mapping("", ""), bench.now);
    bench.router.unbind(topic(1), bench.now);
    assert_eq!(bench.sent(), []);
    bench.wait(Duration::from_secs(1));
    let repeated = [(2, 1, Some(11))];
    assert_eq!(
        bench.sent(),
        repeated,
        "the other is silent until it is bound"
    );
    bench.wait(Duration::from_secs(60));
    assert!(bench.sent().iter().all(|(writer, ..)| *writer == 2));
    bench.say(1, 12);
    let untyped = |bench: &Bench| {
        let mut topics = bench.router.topics();
        let (_, counters) = topics.find(|(id, _)| *id == topic(1)).unwrap();
        counters.dropped(Reason::Untyped)
    };
    assert_eq!((bench.sent(), untyped(&bench)), (vec![], 1));
    bench.bind(1);
    bench.say(1, 13);
    assert_eq!(bench.sent(), [(1, 2, Some(13))]);
}

#[test]
fn a_queue_a_rule_and_a_period_change_without_a_new_binding() {
    let mut bench = Bench::new(mapping("", ""));
    let events = ", queue: {drop_oldest: 4}";
    bench.router.replace_mapping(mapping(events, ""), bench.now);
    for value in 0..3 {
        bench.say(1, value);
    }
    let all = [(1, 0, Some(0)), (1, 1, Some(1)), (1, 2, Some(2))];
    assert_eq!(bench.sent(), all);
    let once = ", publish: on_change, queue: keep_latest";
    bench.router.replace_mapping(mapping(once, ""), bench.now);
    for value in [2, 2, 3, 3] {
        bench.say(1, value);
    }
    // Only the last sample of a state waits. The two samples with changed values each used a
    // sequence number.
    assert_eq!(bench.sent(), [(1, 4, Some(3))]);
    let quick = "key_frame_period: 100ms, keep_alive_period: 100ms";
    bench
        .router
        .replace_mapping(mapping(once, quick), bench.now);
    bench.wait(Duration::from_millis(100));
    assert_eq!(bench.sent(), [(1, 5, Some(3))]);
}

#[test]
fn what_is_said_of_a_value_is_announced_anew_where_the_mapping_says_something_else() {
    let unit = |unit: &str| mapping(&format!(", unit: {unit}"), "metadata_period: 30min");
    let mut bench = Bench::new(unit("m"));
    assert_eq!(bench.announced(), [1, 2]);
    bench.router.replace_mapping(unit("m"), bench.now);
    assert_eq!(bench.announced(), [0; 0]);
    bench.router.replace_mapping(unit("mm"), bench.now);
    assert_eq!(bench.announced(), [1]);
    bench.router.unbind(topic(1), bench.now);
    bench.router.replace_mapping(unit("m"), bench.now);
    assert_eq!(bench.announced(), [0; 0], "it is tied to nothing");
}

#[test]
fn what_a_rate_held_back_goes_out_when_the_rate_is_taken_away() {
    let mut bench = Bench::new(mapping(", at_most: 1 Hz", ""));
    bench.say(1, 1);
    bench.say(1, 2);
    assert_eq!(bench.sent(), [(1, 0, Some(1))]);
    bench.router.replace_mapping(mapping("", ""), bench.now);
    assert_eq!(bench.sent(), [(1, 1, Some(2))]);
    bench.say(1, 3);
    assert_eq!(bench.sent(), [(1, 2, Some(3))]);
}
