//! The limited effects of senders in the group that do not belong to the cell.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Delivery, DropNotice, Local, LocalMessage, Now, Output, Reason, Router, RouterSettings,
    ValueRelation, Verdict,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar,
    Timestamp,
};

/// The bridge of space 1.
struct Bridge {
    router: Router,
    local: Local,
    now: Now,
}

impl Bridge {
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(local: Local) -> Self {
        let mapping = Mapping::from_yaml(CELL, "cell.yaml").mapping.unwrap();
        let settings = RouterSettings {
            own: SpaceId::new(1).unwrap(),
            local,
            source: None,
        };
        Self {
            router: Router::new(settings, Arc::new(mapping)),
            local,
            now: Now {
                monotonic: Instant::now(),
                utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
            },
        }
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
        self.router.handle_timeout(self.now);
    }

    fn bind(&mut self, topic: TopicId) {
        let registry = TypeRegistry::bundle(Dialect::Ros1);
        let message_type = registry.get(&"std_msgs/UInt32".parse().unwrap()).unwrap();
        self.router
            .bind(topic, &message_type, &Selection::Whole, self.now)
            .unwrap();
    }

    fn outputs(&mut self) -> Vec<Output> {
        std::iter::from_fn(|| self.router.poll_output(self.now)).collect()
    }

    fn deliveries(&mut self) -> Vec<Delivery> {
        let outputs = self.outputs().into_iter();
        outputs
            .filter_map(|output| match output {
                Output::Delivery(delivery) => Some(delivery),
                _ => None,
            })
            .collect()
    }

    fn notices(&mut self) -> Vec<DropNotice> {
        let outputs = self.outputs().into_iter();
        outputs
            .filter_map(|output| match output {
                Output::Notice(notice) => Some(notice),
                _ => None,
            })
            .collect()
    }

    fn hear(&mut self, topic: TopicId, from: SocketAddr) {
        let datagram = frame(topic, DataSetHeader::default(), None);
        self.router.handle_datagram(&datagram, from, self.now);
    }

    /// Sends values of invented topics of space 9, more than the bridge tracks.
    fn flood(&mut self) {
        for number in 0..17_000 {
            self.hear(made_up(number), STRANGER);
        }
    }

    fn says_own(&mut self, topic: TopicId) -> Verdict {
        let payload: &[u8] = match self.local {
            Local::Fields => &[1, 0, 7, 7, 0, 0, 0],
            Local::Ros1 | Local::Cdr => &[7, 0, 0, 0],
        };
        let heard = LocalMessage {
            topic,
            payload,
            received: self.now.utc,
            latched_by: None,
        };
        self.router.handle_local(heard, self.now)
    }

    fn follows(&self, topic: TopicId) -> bool {
        self.router.topics().any(|(followed, _)| followed == topic)
    }
}

/// Returns a key frame with a single UInt32.
fn frame(topic: TopicId, header: DataSetHeader, sent: Option<Timestamp>) -> Vec<u8> {
    let (space, group, writer) = topic.triple();
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(group),
            ..GroupHeader::default()
        }),
        timestamp: sent.map(|sent| sent.time),
        picoseconds: sent.map(|sent| sent.picoseconds),
        ..NetworkHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[writer])).unwrap();
    let mut fields = message.key_frame(&header).unwrap();
    fields.scalar(Scalar::UInt32(7)).unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    bytes
}

fn made_up(number: u16) -> TopicId {
    TopicId::new(9, 1, number + 1).unwrap()
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

const CELL: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:a:b}
variables:
  - {node: ns=5;i=10, name: Speed, origin: 2, type: UInt32}
";
const LOCALHOST: std::net::IpAddr = std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);
const WRITER: SocketAddr = SocketAddr::new(LOCALHOST, 50_001);
const STRANGER: SocketAddr = SocketAddr::new(LOCALHOST, 40_000);

#[test]
fn made_up_topics_keep_out_no_value_of_the_mapping_or_of_our_own_space() {
    for local in [Local::Fields, Local::Ros1] {
        let mut bridge = Bridge::new(local);
        bridge.flood();
        let others = bridge.router.others();
        assert_eq!(others.dropped(Reason::TooManyTopics), 17_000 - 16_384);
        let told = bridge.notices();
        let refused: Vec<_> = told
            .iter()
            .filter(|notice| notice.reason == Reason::TooManyTopics)
            .collect();
        assert_eq!(refused.len(), 3, "{refused:?}");
        assert_eq!(refused[0].from, Some(STRANGER));

        let own = topic("ua_1_5_10");
        bridge.bind(own);
        assert_eq!(bridge.says_own(own), Verdict::Forward);
        let mapped = topic("ua_2_5_10");
        bridge.hear(mapped, WRITER);
        bridge.bind(mapped);
        let delivered = bridge.deliveries();
        assert_eq!(delivered.len(), 1);
        assert_eq!(delivered[0].topic, mapped);
    }
}

#[test]
fn a_topic_the_port_has_a_type_for_is_followed_however_many_there_are() {
    let mut bridge = Bridge::new(Local::Ros1);
    bridge.flood();
    let subscribed = topic("ua_2_5_11");
    bridge.bind(subscribed);
    bridge.hear(subscribed, WRITER);
    let delivered = bridge.deliveries();
    assert_eq!(delivered.len(), 1);
    assert_eq!(delivered[0].topic, subscribed);
}

#[test]
fn made_up_topics_give_way_when_they_fell_silent() {
    for local in [Local::Fields, Local::Ros1] {
        let mut bridge = Bridge::new(local);
        let bound = topic("ua_2_5_12");
        bridge.bind(bound);
        bridge.hear(bound, WRITER);
        bridge.flood();
        let robot = topic("ua_2_5_11");
        bridge.hear(robot, WRITER);
        assert!(!bridge.follows(robot));
        let _told = bridge.outputs();
        bridge.wait(Duration::from_secs(60));
        let _told = bridge.outputs();
        let before = bridge.router.topics().count();
        bridge.hear(robot, WRITER);
        assert!(bridge.follows(robot), "{local:?}");
        assert!(bridge.router.topics().count() < before);
        assert!(local == Local::Fields || bridge.follows(bound));
        // A second flood is accepted only up to the freed room, and is removed in turn.
        bridge.flood();
        let _told = bridge.outputs();
        assert!(bridge.follows(robot));
        assert!(bridge.router.topics().count() <= 16_384 + 1);
    }
}

#[test]
fn many_topics_nobody_knows_do_not_keep_a_value_waiting() {
    let mut bridge = Bridge::new(Local::Ros1);
    let robot = topic("ua_2_5_11");
    bridge.bind(robot);
    for number in 0..400 {
        bridge.hear(made_up(number), STRANGER);
    }
    bridge.hear(robot, WRITER);
    let outputs = bridge.outputs();
    let at = |is: fn(&Output) -> bool| outputs.iter().position(is).unwrap();
    assert!(at(|output| matches!(output, Output::Delivery(_))) < 3);
    let asked = outputs
        .iter()
        .filter(|output| matches!(output, Output::Unbound { .. }));
    assert_eq!(asked.count(), 400);
}

#[test]
fn a_topic_is_asked_for_once_until_that_is_heard() {
    let mut bridge = Bridge::new(Local::Ros1);
    let robot = topic("ua_2_5_11");
    for version in 0..10_000 {
        let header = DataSetHeader {
            major_version: Some(version),
            ..DataSetHeader::default()
        };
        let datagram = frame(robot, header, None);
        bridge.router.handle_datagram(&datagram, WRITER, bridge.now);
        bridge.wait(Duration::from_secs(2));
    }
    let outputs = bridge.outputs();
    let asked = outputs
        .iter()
        .filter(|output| matches!(output, Output::Unbound { .. }));
    assert_eq!(asked.count(), 1);
}

#[test]
fn what_waits_to_be_told_is_bounded_and_the_rest_is_counted() {
    let mut bridge = Bridge::new(Local::Fields);
    for number in 0..16_000 {
        let mut broken = frame(made_up(number), DataSetHeader::default(), None);
        broken.pop();
        bridge.router.handle_datagram(&broken, STRANGER, bridge.now);
    }
    let notices = bridge.notices().len();
    let others = bridge.router.others();
    let untold = usize::try_from(others.dropped(Reason::Overflow)).unwrap();
    assert!(notices < 5_000, "{notices}");
    assert!(notices + untold >= 16_000, "{notices} and {untold}");
}

#[test]
fn a_frequent_drop_does_not_hide_a_rare_one() {
    let mut bridge = Bridge::new(Local::Fields);
    let robot = topic("ua_2_5_11");
    bridge.hear(robot, WRITER);
    bridge
        .router
        .lost(Some(robot), 55, (Reason::Overflow, "read too slowly"));
    bridge
        .router
        .lost(Some(robot), 1, (Reason::Overflow, "service too slow"));
    let good = frame(robot, DataSetHeader::default(), None);
    let mut no_variant = good.clone();
    let value = good.len() - 5;
    no_variant[value] = 0x3F;
    for datagram in [&no_variant[..], &no_variant, &good[..good.len() - 1]] {
        bridge.router.handle_datagram(datagram, WRITER, bridge.now);
    }
    let told: Vec<(Reason, String, u64)> = bridge
        .notices()
        .into_iter()
        .map(|notice| (notice.reason, notice.detail, notice.total))
        .collect();
    let details: Vec<&str> = told.iter().map(|(_, detail, _)| detail.as_str()).collect();
    assert!(details.contains(&"service too slow"), "{told:?}");
    let malformed = told
        .iter()
        .filter(|(reason, _, _)| *reason == Reason::Malformed);
    let all: Vec<_> = bridge.router.topics().collect();
    assert_eq!(malformed.count(), 2, "{told:?} {all:?}");
    let (_, counters) = bridge
        .router
        .topics()
        .find(|(topic, _)| *topic == robot)
        .unwrap();
    assert_eq!(counters.dropped(Reason::Overflow), 56);
    assert_eq!(counters.dropped(Reason::Malformed), 3);
}

#[test]
fn a_topic_that_changes_hands_is_counted() {
    let mut bridge = Bridge::new(Local::Fields);
    let robot = topic("ua_2_5_11");
    let mut changed = Vec::new();
    for from in [WRITER, WRITER, STRANGER, STRANGER, WRITER] {
        bridge.hear(robot, from);
        let mut topics = bridge.router.topics();
        changed.push(topics.next().unwrap().1.sender_changed);
    }
    assert_eq!(changed, [0, 0, 1, 1, 2]);
}

#[test]
fn a_value_taken_by_a_clock_that_was_set_back_takes_the_place_of_the_one_before() {
    let mut bridge = Bridge::new(Local::Fields);
    let robot = topic("ua_2_5_11");
    let second = 1_000_000_000_i128;
    for (sequence, at) in (1..).zip([1000, 1001, 990, 991]) {
        let taken = Timestamp::from_unix_nanos(1_700_000_000 * second + at * second);
        let sent = Timestamp::from_unix_nanos(taken.unix_nanos() + 40_000);
        let header = DataSetHeader {
            sequence_number: Some(sequence),
            timestamp: Some(taken.time),
            picoseconds: Some(taken.picoseconds),
            ..DataSetHeader::default()
        };
        let datagram = frame(robot, header, Some(sent));
        bridge.router.handle_datagram(&datagram, WRITER, bridge.now);
        let delivered = bridge.deliveries();
        let kept: Vec<ValueRelation> = delivered.iter().map(|delivery| delivery.kept).collect();
        assert_eq!(kept, [ValueRelation::Alone], "at {at} s");
    }
}
