//! Ten thousand topics: memory of the start, and repetitions that are spread over their
//! period.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use allocation_counter::measure;
use bridge_core::{Local, LocalMessage, Now, Output, Router, RouterSettings};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::Timestamp;

const TOPICS: u16 = 10_000;

struct Many {
    router: Router,
    now: Now,
}

impl Many {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new() -> Self {
        let settings = RouterSettings {
            own: SpaceId::new(1).unwrap(),
            local: Local::Ros1,
            source: None,
        };
        Self {
            router: Router::new(settings, Arc::new(Mapping::default())),
            now: Now {
                monotonic: Instant::now(),
                utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
            },
        }
    }

    /// Binds this number of topics, and gives each a value.
    fn start(&mut self, topics: u16) {
        let message = TypeRegistry::bundle(Dialect::Ros1)
            .get(&"geometry_msgs/Twist".parse().unwrap())
            .unwrap();
        for topic in (1..=topics).map(|id| TopicId::new(1, 5, id).unwrap()) {
            self.router
                .bind(topic, &message, &Selection::Whole, self.now)
                .unwrap();
            let heard = LocalMessage {
                topic,
                payload: &[0; 48],
                received: self.now.utc,
                latched_by: None,
            };
            let _verdict = self.router.handle_local(heard, self.now);
            self.drain();
        }
    }

    /// Returns the number of datagrams with values.
    fn drain(&mut self) -> usize {
        let mut sent = 0;
        while let Some(output) = self.router.poll_output(self.now) {
            if let Output::Datagram { bytes, .. } = output {
                sent += 1;
                self.router.recycle(bytes);
            }
        }
        sent
    }

    /// Lets time pass, and returns the number of datagrams in each step.
    fn run(&mut self, steps: usize, step: Duration) -> Vec<usize> {
        let mut sent = Vec::new();
        for _ in 0..steps {
            self.now.monotonic += step;
            self.router.handle_timeout(self.now);
            sent.push(self.drain());
        }
        sent
    }
}

#[test]
fn ten_thousand_topics_take_less_than_6_kb_each() {
    let mut many = None;
    let counted = measure(|| {
        let mut made = Many::new();
        made.start(TOPICS);
        many = Some(made);
    });
    let each = counted.bytes_current / i64::from(TOPICS);
    assert!(each < 6000, "{each} bytes");
    assert_eq!(many.unwrap().router.topics().count(), usize::from(TOPICS));
}

#[test]
fn repetitions_of_ten_thousand_topics_are_spread_over_their_period() {
    let mut many = Many::new();
    many.start(TOPICS);
    let pubsub = Mapping::default().pubsub().clone();
    let period = pubsub.key_frame_period;
    let step = period / 100;
    // All values were sent at the same time, so the first repetitions come together.
    many.run(100, step);
    let sent = many.run(200, step);
    let total: usize = sent.iter().sum();
    let most = sent.iter().max().copied().unwrap_or_default();
    assert!(
        (2 * usize::from(TOPICS)..=3 * usize::from(TOPICS)).contains(&total),
        "{total}"
    );
    // A hundredth of them in a hundredth of the period.
    assert!(most <= 3 * usize::from(TOPICS) / 100, "{sent:?}");
}

#[test]
fn a_program_of_eighty_topics_wakes_for_several_repetitions_at_once() {
    let mut many = Many::new();
    many.start(80);
    let period = Mapping::default().pubsub().key_frame_period;
    let start = many.now.monotonic;
    let seconds = 10;
    let (mut wakes, mut sent) = (0, 0);
    let mut last = BTreeMap::new();
    while let Some(due) = many.router.poll_timeout() {
        let since = due.saturating_duration_since(start);
        if since > period * seconds {
            break;
        }
        many.now.monotonic = due.max(many.now.monotonic);
        many.router.handle_timeout(many.now);
        let before = sent;
        while let Some(output) = many.router.poll_output(many.now) {
            if let Output::Datagram { topic, .. } = output {
                sent += 1;
                if let Some(before) = last.insert(topic, since) {
                    assert!(since - before <= period, "{topic} is repeated in time");
                }
            }
        }
        wakes += u32::from(sent > before);
    }
    // Each topic once a period, apart from the repetitions that spread them.
    assert!((80 * seconds..=100 * seconds).contains(&sent), "{sent}");
    assert!(
        wakes <= 25 * seconds,
        "{wakes} times for {sent} repetitions"
    );
}
