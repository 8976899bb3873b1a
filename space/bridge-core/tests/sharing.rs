//! Samples that share a datagram if the mapping allows it.
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Delivery, Local, LocalMessage, Now, Output, PublisherKey, Reason, Router, RouterSettings,
    Verdict,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use proptest::prelude::*;
use uadp::{NetworkMessage, Scalar, Timestamp, Variant};

/// A bridge of texts in the namespaces 2 and 3 with a manual clock.
struct Bench {
    router: Router,
    now: Now,
}

/// A datagram with its topics as returned by the Router, and its content.
#[derive(Debug, PartialEq)]
struct Sent {
    topics: Vec<TopicId>,
    messages: Vec<Message>,
    len: usize,
}

#[derive(Debug, Clone, PartialEq)]
struct Message {
    topic: TopicId,
    sequence: u16,
    taken: Timestamp,
    /// `None` for a keep-alive.
    text: Option<String>,
}

impl Bench {
    fn of(space: u16, pubsub: &str) -> Self {
        Self::with(space, pubsub, TOPICS)
    }

    fn with(space: u16, pubsub: &str, topics: u16) -> Self {
        let mut text = format!(
            "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:plant:a, 3: urn:plant:b}}\n\
             pubsub: {{metadata_period: 1h, {pubsub}}}\nvariables:\n"
        );
        for namespace in [2, 3] {
            for id in FIRST..FIRST + topics {
                // Topics with odd ids are events.
                let queue = match id % 2 {
                    0 => "keep_latest",
                    _ => "{drop_oldest: 20}",
                };
                text += &format!(
                    "  - {{node: ns={namespace};i={id}, name: A{id}, origin: 1, type: String, queue: {queue}}}\n"
                );
            }
        }
        let checked = Mapping::from_yaml(&text, "cell.yaml");
        assert!(checked.findings.is_empty(), "{}", checked.render(&text));
        let settings = RouterSettings {
            own: SpaceId::new(space).unwrap(),
            local: Local::Ros1,
            source: None,
        };
        let mut bench = Self {
            router: Router::new(settings, Arc::new(checked.mapping.unwrap())),
            now: start(),
        };
        for namespace in [2, 3] {
            for id in FIRST..FIRST + topics {
                bench.bind(topic(namespace, id));
            }
        }
        bench
    }

    /// Creates a bridge with up to 32 messages per datagram.
    fn sharing() -> Self {
        Self::of(1, "messages_per_datagram: 32")
    }

    fn bind(&mut self, topic: TopicId) {
        let string = TypeRegistry::bundle(Dialect::Ros1)
            .get(&"std_msgs/String".parse().unwrap())
            .unwrap();
        self.router
            .bind(topic, &string, &Selection::Whole, self.now)
            .unwrap();
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
        self.router.handle_timeout(self.now);
    }

    /// Publishes a text that does not replace a waiting text.
    fn say(&mut self, topic: TopicId, text: &str) {
        assert_eq!(self.say_by(None, topic, text), Verdict::Forward);
    }

    fn say_by(&mut self, latched_by: Option<PublisherKey>, topic: TopicId, text: &str) -> Verdict {
        let mut payload = u32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
        payload.extend(text.as_bytes());
        let heard = LocalMessage {
            topic,
            payload: &payload,
            received: self.now.utc,
            latched_by,
        };
        self.router.handle_local(heard, self.now)
    }

    fn datagrams(&mut self) -> Vec<(Vec<TopicId>, Vec<u8>)> {
        std::iter::from_fn(|| self.router.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Datagram { topic, with, bytes } => {
                    Some((std::iter::once(topic).chain(with).collect(), bytes))
                }
                // Announcements of metadata, and notices of dropped samples.
                _ => None,
            })
            .collect()
    }

    fn sent(&mut self) -> Vec<Sent> {
        let now = self.now;
        self.datagrams()
            .into_iter()
            .map(|(topics, bytes)| {
                let message = NetworkMessage::decode(&bytes).unwrap();
                assert_eq!(message.header().timestamp, Some(now.utc.time));
                Sent {
                    topics,
                    messages: messages(&message),
                    len: bytes.len(),
                }
            })
            .collect()
    }

    fn deliveries(&mut self) -> Vec<Delivery> {
        std::iter::from_fn(|| self.router.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Delivery(delivery) => Some(delivery),
                _ => None,
            })
            .collect()
    }

    fn dropped(&self, reason: Reason) -> Vec<TopicId> {
        let all = self.router.topics();
        let mut dropped: Vec<TopicId> = all
            .filter(|(_, counters)| counters.dropped(reason) > 0)
            .map(|(topic, _)| topic)
            .collect();
        dropped.sort();
        dropped
    }
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn start() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

fn topic(namespace: u16, id: u16) -> TopicId {
    TopicId::new(1, namespace, id).unwrap()
}

fn messages(message: &NetworkMessage<'_>) -> Vec<Message> {
    let namespace = message.group().unwrap().writer_group_id.unwrap();
    message
        .messages()
        .map(|message| {
            let message = message.unwrap();
            let header = message.header();
            let text = match message.fields().unwrap().next() {
                Some(Ok(Variant::Scalar(Scalar::String(Some(text))))) => Some(text.to_owned()),
                None => None,
                other => panic!("{other:?}"),
            };
            Message {
                topic: topic(namespace, message.writer_id.unwrap()),
                sequence: header.sequence_number.unwrap(),
                taken: Timestamp {
                    time: header.timestamp.unwrap_or_default(),
                    picoseconds: header.picoseconds.unwrap_or_default(),
                },
                text,
            }
        })
        .collect()
}

/// Returns the texts of each datagram.
fn texts(sent: &[Sent]) -> Vec<Vec<&str>> {
    sent.iter()
        .map(|sent| {
            let texts = sent.messages.iter().map(|message| message.text.as_deref());
            texts.map(|text| text.unwrap_or("alive")).collect()
        })
        .collect()
}

const FIRST: u16 = 10;
const TOPICS: u16 = 40;
const FEW: u16 = 6;

#[test]
fn each_sample_has_a_datagram_of_its_own_unless_told() {
    let mut bench = Bench::of(1, "max_message: 1");
    for id in 10..13 {
        bench.say(topic(2, id), "x");
    }
    assert_eq!(texts(&bench.sent()), [["x"], ["x"], ["x"]]);
}

#[test]
fn what_waits_of_a_namespace_shares_a_datagram_and_keeps_its_numbers_and_times() {
    let mut bench = Bench::sharing();
    for (namespace, id, text) in [
        (2, 10, "a"),
        (3, 10, "p"),
        (2, 12, "b"),
        (3, 11, "q"),
        (2, 10, "c"),
    ] {
        bench.wait(Duration::from_millis(1));
        if text == "c" {
            // Queued samples are polled before newer samples replace them.
            assert_eq!(texts(&bench.sent()), [["a", "b"], ["p", "q"]]);
        }
        bench.say(topic(namespace, id), text);
    }
    bench.say(topic(2, 14), "d");
    let sent = bench.sent();
    assert_eq!(sent.len(), 1);
    let [c, d] = &sent[0].messages[..] else {
        panic!("{sent:?}")
    };
    assert_eq!(
        (c.topic, c.sequence, c.taken),
        (topic(2, 10), 1, bench.now.utc)
    );
    assert_eq!(
        (d.topic, d.sequence, d.taken),
        (topic(2, 14), 0, bench.now.utc)
    );
    assert_eq!(sent[0].topics, [topic(2, 10), topic(2, 14)]);
}

#[test]
fn no_more_share_a_datagram_than_the_mapping_and_an_ethernet_frame_allow() {
    let by_count = |pubsub: &str, text: &str| {
        let mut bench = Bench::of(1, pubsub);
        for id in FIRST..FIRST + TOPICS {
            bench.say(topic(2, id), text);
        }
        let sent = bench.sent();
        let counts: Vec<usize> = sent.iter().map(|sent| sent.messages.len()).collect();
        (counts, sent.iter().map(|sent| sent.len).max().unwrap())
    };
    assert_eq!(by_count("messages_per_datagram: 15", "x").0, [15, 15, 10]);

    let text = "x".repeat(100);
    let (counts, largest) = by_count("messages_per_datagram: 255", &text);
    let one = {
        let mut bench = Bench::sharing();
        bench.say(topic(2, 10), &text);
        bench.sent()[0].len
    };
    assert_eq!(counts.iter().sum::<usize>(), 40, "{counts:?}");
    assert!(largest <= 1472 && largest + one > 1472, "{largest}");

    let (counts, largest) = by_count("messages_per_datagram: 255, max_datagram: 512", &text);
    assert_eq!(counts.iter().sum::<usize>(), 40, "{counts:?}");
    assert!(largest <= 512 && largest + one > 512, "{largest}");
}

#[test]
fn a_sample_that_fills_a_frame_goes_alone_and_small_ones_go_around_it() {
    let mut bench = Bench::sharing();
    let (large, huge) = ("x".repeat(1450), "y".repeat(70_000));
    for (id, text) in [(10, "a"), (12, &*large), (14, &huge), (16, "b")] {
        bench.say(topic(2, id), text);
    }
    let datagrams = bench.datagrams();
    let whole = |bytes: &[u8]| !NetworkMessage::decode(bytes).unwrap().is_chunk();
    let (whole, chunks): (Vec<_>, Vec<_>) =
        datagrams.into_iter().partition(|(_, bytes)| whole(bytes));
    let topics: Vec<_> = whole.into_iter().map(|(topics, _)| topics).collect();
    assert_eq!(
        topics,
        [vec![topic(2, 10), topic(2, 16)], vec![topic(2, 12)]]
    );
    assert_eq!(chunks.len(), 2);
    assert!(chunks.iter().all(|(topics, _)| *topics == [topic(2, 14)]));
}

#[test]
fn events_of_a_topic_share_a_datagram_in_their_order_and_states_have_one_value_in_each() {
    let mut bench = Bench::sharing();
    for text in ["a", "b", "c"] {
        bench.say(topic(2, 11), text);
    }
    assert_eq!(texts(&bench.sent()), [["a", "b", "c"]]);

    // A state with two latched publishers and repeated values of both.
    let state = topic(2, 10);
    for (publisher, text) in [(1, "one"), (2, "two")] {
        let by = Some(PublisherKey(publisher));
        assert_eq!(bench.say_by(by, state, text), Verdict::Forward);
        assert_eq!(texts(&bench.sent()), [[text]]);
    }
    bench.wait(Duration::from_secs(1));
    assert_eq!(texts(&bench.sent()), [vec!["alive", "one"], vec!["two"]]);
}

#[test]
fn a_shared_datagram_that_cannot_be_sent_is_counted_for_each_of_its_topics() {
    let mut bench = Bench::sharing();
    for id in [10, 12, 13] {
        bench.say(topic(2, id), "x");
    }
    let Some(Output::Datagram {
        topic: first, with, ..
    }) = bench.router.poll_output(bench.now)
    else {
        panic!("nothing to send");
    };
    for topic in std::iter::once(first).chain(with) {
        bench.router.not_sent(topic, Reason::NotSent, "no route");
    }
    let all = [10, 12, 13].map(|id| topic(2, id));
    assert_eq!(bench.dropped(Reason::NotSent), all);
}

#[test]
fn a_topic_is_full_when_the_next_sample_takes_the_place_of_one_that_waits() {
    let mut bench = Bench::sharing();
    let (state, event) = (topic(2, 10), topic(2, 11));
    assert!(!bench.router.is_full(state));
    for topic in [state, event] {
        bench.say(topic, "x");
    }
    assert!(bench.router.is_full(state) && !bench.router.is_full(event));
    let verdict = bench.say_by(None, state, "y");
    assert_eq!(verdict, Verdict::ForwardAfterDroppingOldest);
    assert_eq!(bench.sent().len(), 1);
    assert!(!bench.router.is_full(state));
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(100) })]

    /// With any samples between two polls of the outputs, the other side receives each text once
    /// and in the order of its topic, as without sharing.
    #[test]
    fn what_shares_a_datagram_is_delivered_as_if_each_went_alone(
        said in proptest::collection::vec((2_u16..4, 0..FEW, 0_usize..900, any::<bool>()), 1..120),
        most in 1_u8..=255,
    ) {
        let delivered = |pubsub: &str| {
            let mut from = Bench::with(1, pubsub, FEW);
            let mut to = Bench::with(2, pubsub, FEW);
            let mut delivered: std::collections::BTreeMap<TopicId, Vec<Vec<u8>>> = Default::default();
            let mut carry = |from: &mut Bench| {
                for (_, bytes) in from.datagrams() {
                    to.router.handle_datagram(&bytes, PEER, to.now);
                    for delivery in to.deliveries() {
                        delivered.entry(delivery.topic).or_default().push(delivery.payload);
                    }
                }
            };
            for (number, (namespace, id, size, polls)) in said.iter().enumerate() {
                let topic = topic(*namespace, FIRST + id);
                if *polls || from.router.is_full(topic) {
                    carry(&mut from);
                }
                from.say(topic, &format!("{number} {:.<size$}", ""));
            }
            carry(&mut from);
            assert_eq!(from.dropped(Reason::Overflow), []);
            delivered
        };
        let alone = delivered("max_message: 1");
        prop_assert_eq!(alone.values().map(Vec::len).sum::<usize>(), said.len());
        prop_assert_eq!(delivered(&format!("messages_per_datagram: {most}")), alone);
    }
}

const PEER: std::net::SocketAddr =
    std::net::SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 5000);
