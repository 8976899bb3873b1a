//! Messages larger than a datagram: split, paced, reassembled, and sent through an unreliable
//! network.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Delivery, DropNotice, Local, LocalMessage, Now, Output, PublisherKey, Reason, Router,
    RouterSettings, Verdict,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use proptest::prelude::*;
use uadp::Timestamp;

const CAMERA: &str = "ua_1_5_10";
const OTHER_CAMERA: &str = "ua_1_5_11";
const BUTTON: &str = "ua_1_5_12";
/// Small, so that a message of some kilobytes has several chunks.
const SMALL_DATAGRAMS: &str = "pubsub: {max_datagram: 512, max_message: 1}\n";

/// A ROS 1 bridge and a bridge of another space with a manual clock.
struct Pair {
    sender: Router,
    reader: Router,
    now: Now,
}

impl Pair {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(yaml: &str) -> Self {
        let mapping = Arc::new(Mapping::from_yaml(yaml, "test.yaml").mapping.unwrap());
        let router = |own, local| {
            let settings = RouterSettings {
                own: SpaceId::new(own).unwrap(),
                local,
                source: None,
            };
            Router::new(settings, Arc::clone(&mapping))
        };
        let utc = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
        let mut pair = Self {
            sender: router(1, Local::Ros1),
            reader: router(7, Local::Ros1),
            now: Now {
                monotonic: Instant::now(),
                utc,
            },
        };
        for name in [CAMERA, OTHER_CAMERA, BUTTON] {
            bind(&mut pair.sender, name, pair.now);
            bind(&mut pair.reader, name, pair.now);
        }
        pair
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
    }

    fn say(&mut self, name: &str, message: &[u8]) -> Verdict {
        let heard = LocalMessage {
            topic: topic(name),
            payload: message,
            received: self.now.utc,
            latched_by: None,
        };
        self.sender.handle_local(heard, self.now)
    }

    /// Returns the datagrams that the sender may send at this moment.
    fn burst(&mut self) -> Vec<(TopicId, Vec<u8>)> {
        std::iter::from_fn(|| self.sender.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Datagram { topic, bytes, .. } => Some((topic, bytes)),
                _ => None,
            })
            .collect()
    }

    /// Returns all datagrams until no chunk waits any more, and the time that this took.
    fn all(&mut self) -> (Vec<(TopicId, Vec<u8>)>, Duration) {
        let start = self.now.monotonic;
        let mut all = self.burst();
        while let Some(due) = self.sender.poll_timeout()
            && due < self.now.monotonic + Duration::from_millis(100)
        {
            self.wait(due.saturating_duration_since(self.now.monotonic));
            self.sender.handle_timeout(self.now);
            all.extend(self.burst());
        }
        (all, self.now.monotonic - start)
    }

    fn hear(&mut self, datagram: &[u8]) -> Vec<Delivery> {
        self.reader.handle_datagram(datagram, PEER, self.now);
        self.deliveries()
    }

    fn deliveries(&mut self) -> Vec<Delivery> {
        std::iter::from_fn(|| self.reader.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Delivery(delivery) => Some(delivery),
                _ => None,
            })
            .collect()
    }

    fn notices(&mut self) -> Vec<DropNotice> {
        std::iter::from_fn(|| self.reader.poll_output(self.now))
            .filter_map(|output| match output {
                Output::Notice(notice) => Some(notice),
                _ => None,
            })
            .collect()
    }

    fn dropped(&self, reason: Reason) -> u64 {
        let topics = self.reader.topics();
        topics.map(|(_, counters)| counters.dropped(reason)).sum()
    }
}

fn topic(name: &str) -> TopicId {
    name.parse().unwrap()
}

fn bind(router: &mut Router, name: &str, now: Now) {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let message_type = registry.get(&"std_msgs/String".parse().unwrap()).unwrap();
    router
        .bind(topic(name), &message_type, &Selection::Whole, now)
        .unwrap();
}

/// Returns a ROS 1 std_msgs/String of `size` characters that differ with `seed` and position.
fn text(size: usize, seed: u8) -> Vec<u8> {
    let mut message = (size as u32).to_le_bytes().to_vec();
    message.extend((0..size).map(|at| b'a' + ((at + usize::from(seed)) % 23) as u8));
    message
}

const PEER: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_001);

#[test]
fn ten_megabytes_arrive_as_they_were_and_not_faster_than_a_link_carries() {
    let mut pair = Pair::new("pubsub: {}\n");
    let image = text(10_000_000, 3);
    assert_eq!(pair.say(CAMERA, &image), Verdict::Forward);
    let (datagrams, took) = pair.all();
    assert_eq!(datagrams.len(), 153);
    assert!(datagrams.iter().all(|(_, bytes)| bytes.len() <= 65_507));
    assert!(
        (Duration::from_millis(90)..Duration::from_millis(110)).contains(&took),
        "{took:?}"
    );
    let delivered: Vec<_> = datagrams
        .iter()
        .flat_map(|(_, bytes)| pair.hear(bytes))
        .collect();
    assert_eq!(delivered.len(), 1);
    assert!(delivered[0].payload == image, "other bytes");
}

#[test]
fn a_message_beyond_the_limit_is_refused_with_its_size_and_the_key() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let verdict = pair.say(CAMERA, &text(1_100_000, 0));
    assert_eq!(verdict, Verdict::Drop(Reason::TooBig));
    let told = std::iter::from_fn(|| pair.sender.poll_output(pair.now)).find_map(|o| match o {
        Output::Notice(notice) => Some(notice.detail),
        _ => None,
    });
    let told = told.unwrap();
    assert!(
        told.contains("1100") && told.contains("`pubsub.max_message` allows 1 MiB"),
        "{told}"
    );
    assert_eq!(pair.say(CAMERA, &text(100, 0)), Verdict::Forward);
}

#[test]
fn a_button_goes_out_between_the_chunks_of_cameras_which_take_turns() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let _verdict = pair.say(CAMERA, &text(4_000, 0));
    let _verdict = pair.say(OTHER_CAMERA, &text(4_000, 1));
    let _verdict = pair.say(BUTTON, &text(1, 2));
    let order: Vec<_> = pair.burst().into_iter().map(|(topic, _)| topic).collect();
    assert_eq!(
        order[..5],
        [CAMERA, OTHER_CAMERA, BUTTON, CAMERA, OTHER_CAMERA].map(topic)
    );
}

#[test]
fn a_button_is_not_paced_while_a_camera_is() {
    let mut pair = Pair::new("pubsub: {}\n");
    let _verdict = pair.say(CAMERA, &text(2_000_000, 0));
    let first = pair.burst();
    assert!(first.len() < 10, "{} at once", first.len());
    let _verdict = pair.say(BUTTON, &text(1, 2));
    let [(sent, _)] = &pair.burst()[..] else {
        unreachable!("one small datagram")
    };
    assert_eq!(*sent, topic(BUTTON));
}

#[test]
fn a_started_image_is_finished_and_of_those_that_wait_the_newest_goes() {
    let mut pair = Pair::new("pubsub: {}\n");
    let images = [0, 1, 2].map(|seed| text(1_000_000, seed));
    let _verdict = pair.say(CAMERA, &images[0]);
    let mut datagrams = pair.burst();
    assert_eq!(pair.say(CAMERA, &images[1]), Verdict::Forward);
    assert_eq!(
        pair.say(CAMERA, &images[2]),
        Verdict::ForwardAfterDroppingOldest
    );
    datagrams.extend(pair.all().0);
    let delivered: Vec<_> = datagrams
        .iter()
        .flat_map(|(_, bytes)| pair.hear(bytes))
        .map(|delivery| delivery.payload)
        .collect();
    assert!(
        delivered == [&images[0][..], &images[2]],
        "{}",
        delivered.len()
    );
}

#[test]
fn a_lost_chunk_costs_its_message_which_is_counted_and_named() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let _verdict = pair.say(CAMERA, &text(4_000, 0));
    let (mut datagrams, _) = pair.all();
    datagrams.remove(3);
    for (_, bytes) in &datagrams {
        assert_eq!(pair.hear(bytes), []);
    }
    let due = pair.reader.poll_timeout().unwrap();
    assert_eq!(due, pair.now.monotonic + Duration::from_secs(3));
    pair.wait(Duration::from_secs(3));
    pair.reader.handle_timeout(pair.now);
    let notices = pair.notices();
    let incomplete: Vec<_> = notices
        .iter()
        .filter(|notice| notice.reason == Reason::Incomplete)
        .collect();
    assert_eq!(incomplete.len(), 1, "{notices:?}");
    assert_eq!(incomplete[0].topic, Some(topic(CAMERA)));
    assert!(incomplete[0].detail.contains("rmem_max"));
    assert_eq!(pair.dropped(Reason::Incomplete), 1);
}

#[test]
fn a_value_whose_chunk_was_lost_comes_with_its_repetition() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let image = text(4_000, 0);
    let state = LocalMessage {
        topic: topic(CAMERA),
        payload: &image,
        received: pair.now.utc,
        latched_by: Some(PublisherKey(1)),
    };
    let _verdict = pair.sender.handle_local(state, pair.now);
    let (mut datagrams, _) = pair.all();
    datagrams.remove(3);
    for (_, bytes) in &datagrams {
        assert_eq!(pair.hear(bytes), []);
    }
    // The first repetition may belong to an event, the second shows that it is a state.
    pair.wait(Duration::from_secs(1));
    pair.sender.handle_timeout(pair.now);
    for (_, bytes) in pair.all().0 {
        assert_eq!(pair.hear(&bytes), []);
    }
    pair.wait(Duration::from_secs(1));
    pair.sender.handle_timeout(pair.now);
    let (again, _) = pair.all();
    let delivered: Vec<_> = again
        .iter()
        .flat_map(|(_, bytes)| pair.hear(bytes))
        .collect();
    assert_eq!(delivered.len(), 1);
    assert!(delivered[0].payload == image, "other bytes");
    pair.wait(Duration::from_secs(1));
    pair.sender.handle_timeout(pair.now);
    let (once_more, _) = pair.all();
    assert!(
        once_more
            .iter()
            .all(|(_, bytes)| pair.hear(bytes).is_empty())
    );
    assert_eq!(pair.dropped(Reason::Repeat), 2, "it is known by its stamp");
}

#[test]
fn a_writer_that_starts_over_in_the_midst_of_a_message_mixes_nothing() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let _verdict = pair.say(CAMERA, &text(4_000, 0));
    let (datagrams, _) = pair.all();
    for (_, bytes) in &datagrams[..4] {
        assert_eq!(pair.hear(bytes), []);
    }
    let mut restarted = Pair::new(SMALL_DATAGRAMS);
    restarted.now = pair.now;
    restarted.wait(Duration::from_millis(10));
    let image = text(4_000, 9);
    let _verdict = restarted.say(CAMERA, &image);
    let delivered: Vec<_> = restarted
        .all()
        .0
        .iter()
        .flat_map(|(_, bytes)| pair.hear(bytes))
        .collect();
    assert_eq!(delivered.len(), 1);
    assert!(delivered[0].payload == image, "other bytes");
    assert_eq!(pair.dropped(Reason::Incomplete), 1);
}

#[test]
fn a_chunk_that_a_stranger_makes_up_costs_nobody_a_message() {
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    let image = text(4_000, 0);
    let _verdict = pair.say(CAMERA, &image);
    let (datagrams, _) = pair.all();
    let stranger = SocketAddr::new(PEER.ip(), 40_000);
    let mut delivered = Vec::new();
    for (_, bytes) in &datagrams {
        delivered.extend(pair.hear(bytes));
        let mut forged = bytes.clone();
        *forged.last_mut().unwrap() ^= 1;
        pair.reader.handle_datagram(&forged, stranger, pair.now);
        forged.pop();
        pair.reader.handle_datagram(&forged, stranger, pair.now);
    }
    assert_eq!(delivered.len(), 1);
    assert!(delivered[0].payload == image);
}

#[test]
fn a_message_that_would_be_too_big_is_refused_at_its_first_chunk() {
    let mut large = Pair::new("pubsub: {}\n");
    let _verdict = large.say(CAMERA, &text(2_000_000, 0));
    let (_, chunk) = large.burst().remove(0);
    let mut pair = Pair::new(SMALL_DATAGRAMS);
    assert_eq!(pair.hear(&chunk), []);
    assert_eq!(pair.dropped(Reason::TooBig), 1);
    pair.reader.handle_datagram(&chunk, PEER, pair.now);
    assert_eq!(pair.dropped(Reason::TooBig), 2);
}

proptest! {
    /// Two cameras and a button, with reordered and duplicated datagrams: each message is delivered
    /// once and unchanged.
    #[test]
    fn chunks_in_any_order_and_doubled_make_each_message_once(
        sizes in (600..6_000_usize, 600..6_000_usize),
        order in proptest::collection::vec(any::<prop::sample::Index>(), 40),
        twice in proptest::collection::vec(any::<bool>(), 40),
    ) {
        let mut pair = Pair::new(SMALL_DATAGRAMS);
        let sent = [
            (CAMERA, text(sizes.0, 1)),
            (OTHER_CAMERA, text(sizes.1, 2)),
            (BUTTON, text(1, 3)),
        ];
        for (name, message) in &sent {
            prop_assert_eq!(pair.say(name, message), Verdict::Forward);
        }
        let (mut datagrams, _) = pair.all();
        for (from, to) in order.iter().zip(order.iter().skip(1)) {
            let (from, to) = (from.index(datagrams.len()), to.index(datagrams.len()));
            datagrams.swap(from, to);
        }
        let mut delivered = Vec::new();
        for ((_, bytes), twice) in datagrams.iter().zip(twice.iter().cycle()) {
            for _ in 0..=usize::from(*twice) {
                delivered.extend(pair.hear(bytes));
            }
        }
        prop_assert_eq!(delivered.len(), 3);
        for (name, message) in &sent {
            let found = delivered.iter().find(|delivery| delivery.topic == topic(name));
            prop_assert!(found.unwrap().payload == *message);
        }
    }
}
