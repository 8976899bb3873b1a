//! Exchange of topic metadata between bridges.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Local, LocalMessage, Now, Output, Reason, Router, RouterSettings, TopicMetaData,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeName, TypeRegistry};
use uadp::discovery::{AnnouncedContent, Announcement, DataSetMetaDataType, Probe, WireArray};
use uadp::{BuiltinType, NetworkMessage, PublisherId, SecurityHeader, StatusCode, Timestamp};

/// A bridge without a ROS graph: the Router of a space.
struct Bridge {
    router: Router,
    address: SocketAddr,
    registry: TypeRegistry,
}

impl Bridge {
    fn new(space: u16, mapping: &str) -> Self {
        let mapping = if mapping.is_empty() {
            Mapping::default()
        } else {
            Mapping::from_yaml(mapping, "cell.yaml").mapping.unwrap()
        };
        let address = SocketAddr::from(([127, 0, 0, 1], 50_000 + space));
        let dialect = match space {
            1 => Dialect::Ros1,
            _ => Dialect::Ros2,
        };
        let settings = RouterSettings {
            own: SpaceId::new(space).unwrap(),
            local: match (space, dialect) {
                (0, _) => Local::Fields,
                (_, Dialect::Ros1) => Local::Ros1,
                (_, Dialect::Ros2) => Local::Cdr,
            },
            source: Some(address),
        };
        Self {
            router: Router::new(settings, Arc::new(mapping)),
            address,
            registry: TypeRegistry::bundle(dialect),
        }
    }

    fn bind(&mut self, topic: &str, name: &str, selection: &Selection, now: Now) {
        let message_type = self.registry.get(&name.parse().unwrap()).unwrap();
        let topic = topic.parse().unwrap();
        self.router
            .bind(topic, &message_type, selection, now)
            .unwrap();
    }

    fn say(&mut self, topic: &str, payload: &[u8], now: Now) {
        let heard = LocalMessage {
            topic: topic.parse().unwrap(),
            payload,
            received: now.utc,
            latched_by: None,
        };
        let verdict = self.router.handle_local(heard, now);
        assert_eq!(verdict, bridge_core::Verdict::Forward);
    }

    fn outputs(&mut self, now: Now) -> Vec<Output> {
        std::iter::from_fn(|| self.router.poll_output(now)).collect()
    }

    /// Returns all datagrams that are sent within the time, in their order.
    fn sent_within(&mut self, time: Duration, clock: &mut Now) -> Vec<Vec<u8>> {
        let end = clock.monotonic + time;
        let mut sent = Vec::new();
        loop {
            for output in self.outputs(*clock) {
                match output {
                    Output::Datagram { bytes, .. } | Output::Discovery { bytes } => {
                        sent.push(bytes);
                    }
                    _ => {}
                }
            }
            let due = self.router.poll_timeout().filter(|due| *due <= end);
            advance(clock, due.unwrap_or(end));
            if due.is_none() {
                return sent;
            }
            self.router.handle_timeout(*clock);
        }
    }

    fn hear(&mut self, from: &Self, datagrams: &[Vec<u8>], now: Now) {
        for datagram in datagrams {
            self.router.handle_datagram(datagram, from.address, now);
        }
    }

    /// Returns the requests to the port for local types.
    fn told(&mut self, now: Now) -> Vec<(TopicId, Option<TopicMetaData>)> {
        let told = self.outputs(now).into_iter();
        told.filter_map(|output| match output {
            Output::Unbound {
                topic, described, ..
            } => Some((topic, described.as_deref().cloned())),
            _ => None,
        })
        .collect()
    }

    fn refused(&self) -> u64 {
        let topics = self.router.topics();
        let topics: u64 = topics
            .map(|(_, counters)| counters.dropped(Reason::MetaData))
            .sum();
        topics + self.router.others().dropped(Reason::MetaData)
    }
}

fn advance(clock: &mut Now, to: Instant) {
    let time = to.saturating_duration_since(clock.monotonic);
    clock.monotonic += time;
    let nanos = clock.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
    clock.utc = Timestamp::from_unix_nanos(nanos);
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn clock() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

/// Calls `with` for each DataSetMetaData in the datagrams.
fn each_meta_data(datagrams: &[Vec<u8>], mut with: impl FnMut(u16, &DataSetMetaDataType<'_>)) {
    for datagram in datagrams {
        let message = NetworkMessage::decode(datagram).unwrap();
        if let Ok(announcement) = Announcement::decode(&message)
            && let AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data,
                ..
            } = &announcement.announced
        {
            with(*writer_id, meta_data);
        }
    }
}

fn announced(datagrams: &[Vec<u8>]) -> usize {
    let mut count = 0;
    each_meta_data(datagrams, |_, _| count += 1);
    count
}

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

const SECOND: Duration = Duration::from_secs(1);
const TWIST: [u8; 48] = [0; 48];

#[test]
fn a_topic_is_announced_with_its_fields_and_the_version_its_messages_have() {
    let (mut bridge, mut now) = (Bridge::new(1, ""), clock());
    bridge.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    bridge.say("ua_1_5_10", &TWIST, now);
    let sent = bridge.sent_within(SECOND / 2, &mut now);
    let mut seen = Vec::new();
    each_meta_data(&sent, |writer_id, meta_data| {
        assert_eq!((writer_id, meta_data.name), (10, Some("ua_1_5_10")));
        assert_eq!(meta_data.description.text, Some("geometry_msgs/Twist"));
        let fields: Vec<_> = meta_data.fields.iter().collect();
        assert_eq!(fields.len(), 6);
        assert_eq!(fields[5].name, Some("angular.z"));
        assert_eq!(fields[5].builtin_type(), Some(BuiltinType::Double));
        assert_eq!(fields[5].data_type, uadp::NodeId::numeric(0, 11));
        assert_eq!(fields[5].value_rank, -1);
        assert_ne!(fields[4].data_set_field_id, fields[5].data_set_field_id);
        seen.push(meta_data.configuration_version.major);
    });
    let [version] = seen[..] else {
        panic!("one announcement: {seen:?}")
    };
    // 2023-11-14 22:13:20 UTC, seconds since 2000.
    assert_eq!(version, 753_315_200);
    let data = NetworkMessage::decode(&sent[0]).unwrap();
    let data = data.messages().next().unwrap().unwrap();
    assert_eq!(data.header().major_version, Some(version));
}

#[test]
fn it_is_announced_again_now_and_then_and_when_somebody_asks() {
    let (mut bridge, mut now) = (Bridge::new(1, ""), clock());
    bridge.bind("ua_1_5_10", "std_msgs/UInt32", &Selection::Whole, now);
    bridge.say("ua_1_5_10", &[7, 0, 0, 0], now);
    assert_eq!(announced(&bridge.sent_within(SECOND * 29, &mut now)), 1);
    assert_eq!(announced(&bridge.sent_within(SECOND * 2, &mut now)), 1);
    let mut probe = Vec::new();
    Probe::DataSetMetaData(WireArray::new(&[10, 11]))
        .encode(
            Some(PublisherId::UInt16(1)),
            SecurityHeader::NONE,
            &mut probe,
        )
        .unwrap();
    let other = Bridge::new(2, "");
    bridge.hear(&other, &[probe], now);
    let answers = bridge.sent_within(SECOND, &mut now);
    let mut statuses = Vec::new();
    for answer in &answers {
        let message = NetworkMessage::decode(answer).unwrap();
        if let Ok(Announcement {
            announced:
                AnnouncedContent::DataSetMetaData {
                    writer_id, status, ..
                },
            ..
        }) = Announcement::decode(&message)
        {
            statuses.push((writer_id, status == StatusCode::GOOD));
        }
    }
    assert_eq!(statuses, [(10, true), (11, false)]);
}

#[test]
fn a_thousand_topics_are_announced_over_seconds_and_each_once() {
    let (mut bridge, mut now) = (Bridge::new(1, ""), clock());
    for id in 1..=1000 {
        let topic = format!("ua_1_5_{id}");
        bridge.bind(&topic, "std_msgs/UInt32", &Selection::Whole, now);
    }
    let mut most = 0;
    let mut all = 0;
    for _ in 0..30 {
        let sent = announced(&bridge.sent_within(SECOND / 2, &mut now));
        most = most.max(sent);
        all += sent;
    }
    assert_eq!(all, 1000);
    assert!(most <= 100, "{most} within half a second");
}

#[test]
fn a_value_is_known_by_what_its_writer_says_and_the_port_is_told_at_once() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    reader.hear(&writer, &sent, now);
    let told = reader.told(now);
    let [(topic, Some(described))] = &told[..] else {
        panic!("{told:?}")
    };
    assert_eq!(*topic, "ua_1_5_10".parse().unwrap());
    assert_eq!(described.message_type, name("geometry_msgs/Twist"));
    let local = TypeRegistry::bundle(Dialect::Ros2);
    let twist = local.get(&described.message_type).unwrap();
    assert_eq!(described.selection(&twist), Some(Selection::Whole));
    let accel = local.get(&name("geometry_msgs/Vector3")).unwrap();
    assert_eq!(described.selection(&accel), None, "other fields");
}

#[test]
fn a_reader_that_came_late_asks_and_stops_when_it_is_answered() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    let _missed = writer.sent_within(SECOND, &mut now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(Duration::ZERO, &mut now);
    reader.hear(&writer, &sent, now);
    assert!(matches!(reader.told(now)[..], [(_, None)]));
    let probes = reader.sent_within(SECOND / 2, &mut now);
    assert_eq!(probes.len(), 1);
    writer.hear(&reader, &probes, now);
    let answer = writer.sent_within(SECOND / 5, &mut now);
    reader.hear(&writer, &answer, now);
    assert!(matches!(reader.told(now)[..], [(_, Some(_))]));
    assert!(reader.sent_within(SECOND * 60, &mut now).is_empty());
}

#[test]
fn nobody_but_the_writer_says_that_there_is_no_such_writer() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(Duration::ZERO, &mut now);
    reader.hear(&writer, &sent, now);
    assert!(matches!(reader.told(now)[..], [(_, None)]));
    let mut denial = Vec::new();
    let announcement = Announcement {
        sequence_number: 0,
        announced: AnnouncedContent::DataSetMetaData {
            writer_id: 10,
            meta_data: DataSetMetaDataType::default(),
            status: StatusCode(0x803E_0000),
        },
    };
    announcement
        .encode(PublisherId::UInt16(1), SecurityHeader::NONE, &mut denial)
        .unwrap();
    let stranger = SocketAddr::from(([127, 0, 0, 1], 40_000));
    reader.router.handle_datagram(&denial, stranger, now);
    assert_eq!(reader.refused(), 1);
    let asked = reader.sent_within(SECOND / 2, &mut now);
    assert_eq!(asked.len(), 1, "it asks all the same");
    reader.router.handle_datagram(&denial, writer.address, now);
    assert_eq!(reader.sent_within(SECOND * 3600, &mut now).len(), 0);
    assert_eq!(reader.refused(), 1);
}

#[test]
fn an_unanswered_reader_gives_up() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(Duration::ZERO, &mut now);
    reader.hear(&writer, &sent, now);
    let probes = reader.sent_within(SECOND * 3600, &mut now);
    assert_eq!(probes.len(), 8);
}

/// Measures the processing time of a probe with as many DataSetWriterIds as fit into a datagram,
/// for `missing` missing topics.
#[expect(clippy::disallowed_methods, reason = "what is tested is a cost")]
fn cost_of_a_long_probe(missing: u16) -> Duration {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    for id in 1..=missing {
        let topic = format!("ua_1_5_{id}");
        writer.bind(&topic, "std_msgs/UInt32", &Selection::Whole, now);
        writer.say(&topic, &[7, 0, 0, 0], now);
    }
    let sent = writer.sent_within(Duration::ZERO, &mut now);
    let values = sent.iter().filter(|bytes| {
        NetworkMessage::decode(bytes).is_ok_and(|message| message.messages().next().is_some())
    });
    let values: Vec<Vec<u8>> = values.cloned().collect();
    reader.hear(&writer, &values, now);
    assert_eq!(reader.told(now).len(), usize::from(missing));
    // The missing topics come last.
    let ids: Vec<u16> = (1..=32_000).rev().collect();
    let mut probe = Vec::new();
    let publisher = Some(PublisherId::UInt16(1));
    Probe::DataSetMetaData(WireArray::new(&ids))
        .encode(publisher, SecurityHeader::NONE, &mut probe)
        .unwrap();
    let other = Bridge::new(3, "");
    let costs = (0..5).map(|_| {
        let start = Instant::now();
        reader.hear(&other, std::slice::from_ref(&probe), now);
        start.elapsed()
    });
    costs.min().unwrap()
}

#[test]
fn a_long_probe_costs_as_much_as_it_is_long_however_many_topics_are_missing() {
    let (one, many) = (cost_of_a_long_probe(1), cost_of_a_long_probe(200));
    assert!(
        many < one * 20,
        "{one:?} with one missing, {many:?} with 200"
    );
}

const MAPPED: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:a:b}
variables:
  - {node: ns=5;i=10, name: Speed, origin: 1, ros: [{topic: /speed, type: geometry_msgs/Twist}, {space: 2, topic: /speed, type: geometry_msgs/Twist}]}
";

#[test]
fn what_the_mapping_says_is_neither_asked_for_nor_changed() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, MAPPED), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Accel", &Selection::Whole, now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    reader.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    reader.hear(&writer, &sent, now);
    assert_eq!(reader.told(now), []);
    assert!(reader.sent_within(SECOND * 60, &mut now).is_empty());
}

#[test]
fn who_does_not_send_the_values_does_not_say_what_they_are() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "geometry_msgs/Twist", &Selection::Whole, now);
    writer.say("ua_1_5_10", &TWIST, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    reader.hear(&writer, &sent, now);
    assert_eq!(reader.told(now).len(), 1);

    let mut liar = Bridge::new(1, "");
    liar.address.set_port(40_000);
    liar.bind("ua_1_5_10", "geometry_msgs/Accel", &Selection::Whole, now);
    let lie = liar.sent_within(SECOND / 2, &mut now);
    assert_eq!(announced(&lie), 1);
    reader.hear(&liar, &lie, now);
    assert_eq!(reader.told(now), []);
    assert_eq!(reader.refused(), 1);
}

#[test]
fn a_topic_that_is_said_to_be_now_this_and_now_that_is_told_of_ever_more_rarely() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    let [vector, point] = ["geometry_msgs/Vector3", "geometry_msgs/Point"];
    writer.bind("ua_1_5_10", vector, &Selection::Whole, now);
    writer.say("ua_1_5_10", &[0; 24], now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    reader.hear(&writer, &sent, now);
    let mut is_told = |kind: &str, now: &mut Now| {
        // Any sender with the address of the writer.
        let mut spoofed = Bridge::new(1, "");
        spoofed.bind("ua_1_5_10", kind, &Selection::Whole, *now);
        let said = spoofed.sent_within(SECOND / 2, now);
        assert_eq!(announced(&said), 1);
        let refused = reader.refused();
        reader.hear(&spoofed, &said, *now);
        let told = reader.told(*now).into_iter();
        let told: Vec<_> = told.filter_map(|(_, what)| what).collect();
        let names: Vec<String> = told.iter().map(|d| d.message_type.to_string()).collect();
        (names, reader.refused() - refused)
    };
    let taken = |kind: &str| (vec![kind.to_owned()], 0);
    let nothing = Vec::<String>::new();
    // The first description came with the value, and the next description is accepted at once.
    let first = is_told(vector, &mut now);
    assert_eq!(first, taken(vector));
    assert_eq!(is_told(point, &mut now), taken(point));
    assert_eq!(is_told(vector, &mut now), (nothing.clone(), 1));
    assert_eq!(is_told(point, &mut now), (nothing.clone(), 0), "as it is");
    let later = now.monotonic + SECOND * 10;
    advance(&mut now, later);
    assert_eq!(is_told(vector, &mut now), taken(vector));
    let later = now.monotonic + SECOND * 10;
    advance(&mut now, later);
    assert_eq!(is_told(point, &mut now), (nothing, 1), "twice as long");
    let later = now.monotonic + SECOND * 10;
    advance(&mut now, later);
    assert_eq!(is_told(point, &mut now), taken(point));
}

#[test]
fn what_does_not_fit_the_values_is_not_believed() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "std_msgs/UInt32", &Selection::Whole, now);
    writer.say("ua_1_5_10", &[7, 0, 0, 0], now);
    let value = writer.sent_within(Duration::ZERO, &mut now);
    let mut liar = Bridge::new(1, "");
    liar.address = writer.address;
    liar.bind("ua_1_5_10", "geometry_msgs/Accel", &Selection::Whole, now);
    let lie = liar.sent_within(SECOND / 2, &mut now);
    reader.hear(&liar, &lie, now);
    reader.hear(&writer, &value, now);
    assert_eq!(reader.told(now), [("ua_1_5_10".parse().unwrap(), None)]);
    assert_eq!(reader.refused(), 1);
}

#[test]
fn an_announcement_larger_than_a_datagram_goes_in_chunks() {
    let small = "pubsub: {max_datagram: 512}";
    let (mut writer, mut reader, mut now) = (Bridge::new(1, small), Bridge::new(2, ""), clock());
    writer.bind("ua_1_5_10", "nav_msgs/Odometry", &Selection::Whole, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    assert!(sent.len() > 2 && sent.iter().all(|bytes| bytes.len() <= 512));
    reader.hear(&writer, &sent, now);
    assert_eq!(reader.router.others().described, 1);
}

#[test]
fn two_topics_with_one_number_in_two_namespaces_are_told_apart() {
    let (mut writer, mut now) = (Bridge::new(1, ""), clock());
    writer.bind("ua_1_5_10", "std_msgs/UInt32", &Selection::Whole, now);
    writer.bind("ua_1_6_10", "std_msgs/Bool", &Selection::Whole, now);
    let sent = writer.sent_within(SECOND, &mut now);
    let mut seen = Vec::new();
    each_meta_data(&sent, |_, meta_data| {
        let text = |text: Option<&str>| text.unwrap().to_owned();
        seen.push((text(meta_data.name), text(meta_data.description.text)));
    });
    let pair = |a: &str, b: &str| (a.to_owned(), b.to_owned());
    assert_eq!(
        seen,
        [
            pair("ua_1_5_10", "std_msgs/UInt32"),
            pair("ua_1_6_10", "std_msgs/Bool")
        ]
    );
}

#[test]
fn a_mapped_topic_is_announced_with_its_name_and_its_ros_topics() {
    let text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:test}\nvariables:\n  - {node: ns=2;i=10, name: Arm.Joint States, \
                origin: 1, ros: [{space: 1, topic: /joint_states, type: geometry_msgs/Twist}, \
                {space: 2, topic: /arm/joint_states, type: geometry_msgs/Twist}]}\n";
    let (mut bridge, mut now) = (Bridge::new(1, text), clock());
    bridge.bind("ua_1_2_10", "geometry_msgs/Twist", &Selection::Whole, now);
    let sent = bridge.sent_within(SECOND, &mut now);
    let mut seen = 0;
    each_meta_data(&sent, |_, meta_data| {
        assert_eq!(meta_data.name, Some("ua_1_2_10 Arm.Joint States"));
        let fields: Vec<_> = meta_data.fields.iter().collect();
        let keys = |index: usize| -> Vec<Option<&str>> {
            let properties = fields[index].properties.iter();
            properties.map(|property| property.key.name).collect()
        };
        // A Twist commands a movement where it arrives.
        assert_eq!(keys(0), [Some(bridge_core::ROS_TOPICS), Some("Command")]);
        assert!(keys(1).is_empty());
        let uadp::Variant::Array(topics) = fields[0].properties.get(0).unwrap().value else {
            panic!("an array")
        };
        let topics: Vec<_> = topics.iter().collect();
        let text = |text| uadp::Scalar::String(Some(text));
        assert_eq!(
            topics,
            [text("1 /joint_states"), text("2 /arm/joint_states")]
        );
        seen += 1;
    });
    assert_eq!(seen, 1);
    // A reader without a mapping knows the name.
    let mut reader = Bridge::new(2, "");
    bridge.say("ua_1_2_10", &TWIST, now);
    let values = bridge.sent_within(SECOND / 2, &mut now);
    let topic = "ua_1_2_10".parse().unwrap();
    assert_eq!(reader.router.name_of(topic), None);
    reader.hear(&bridge, &sent, now);
    let without_values = |at| -> Vec<_> { reader.router.names_without_values(at).collect() };
    assert_eq!(without_values(now.monotonic), [(topic, "Arm.Joint States")]);
    // The program has left, and no program announces the topic.
    assert_eq!(without_values(now.monotonic + SECOND * 400), []);
    reader.hear(&bridge, &values, now);
    assert_eq!(reader.refused(), 0);
    let told = reader.told(now);
    let described = told.iter().find_map(|(_, described)| described.as_ref());
    assert_eq!(described.unwrap().name, "Arm.Joint States");
    assert_eq!(reader.router.name_of(topic), Some("Arm.Joint States"));
    assert_eq!(reader.router.names_without_values(now.monotonic).count(), 0);
}

#[test]
fn a_probe_for_connections_finds_topics_that_have_not_sent_a_value() {
    let (mut bridge, mut now) = (Bridge::new(1, ""), clock());
    for topic in ["ua_1_5_10", "ua_1_5_11", "ua_1_5_12"] {
        bridge.bind(topic, "std_msgs/UInt32", &Selection::Whole, now);
    }
    let lost = "ua_1_5_12".parse().unwrap();
    bridge.router.set_live(lost, false, now);
    bridge.say("ua_1_5_11", &[7, 0, 0, 0], now);
    assert_eq!(announced(&bridge.sent_within(SECOND, &mut now)), 3);
    let mut asked = |publisher: u16, bridge: &mut Bridge| {
        let mut probe = Vec::new();
        let connections = Probe::PubSubConnections {
            transport_profile_uris: WireArray::null(),
            include_writer_groups: false,
            include_data_set_writers: false,
        };
        let publisher = Some(PublisherId::UInt16(publisher));
        connections
            .encode(publisher, SecurityHeader::NONE, &mut probe)
            .unwrap();
        bridge.hear(&Bridge::new(2, ""), &[probe], now);
        let mut writers = Vec::new();
        each_meta_data(&bridge.sent_within(SECOND, &mut now), |writer, _| {
            writers.push(writer);
        });
        writers
    };
    // 11 is known by its value, and 12 has no producer.
    assert_eq!(asked(1, &mut bridge), [10]);
    assert_eq!(asked(0, &mut bridge), [0; 0]);
}

#[test]
fn the_fields_of_a_promoted_value_are_marked_in_its_metadata() {
    let promoted = |promoted: bool| {
        let text = format!(
            "spaces: [{{id: 1}}]\nnamespaces: {{2: urn:test}}\nvariables:\n  - {{node: ns=2;i=10, \
             name: Speed, origin: 1, promoted: {promoted}, \
             ros: {{space: 1, topic: /speed, type: geometry_msgs/Twist}}}}\n"
        );
        let (mut bridge, mut now) = (Bridge::new(1, &text), clock());
        bridge.bind("ua_1_2_10", "geometry_msgs/Twist", &Selection::Whole, now);
        let mut flags = Vec::new();
        each_meta_data(&bridge.sent_within(SECOND, &mut now), |_, meta_data| {
            flags.extend(meta_data.fields.iter().map(|field| field.is_promoted()));
        });
        flags
    };
    assert_eq!(promoted(true), [true; 6]);
    assert_eq!(promoted(false), [false; 6]);
}

#[test]
fn what_is_written_in_opc_ua_is_announced_as_the_mapping_says_it() {
    let mut now = clock();
    let text = |unit: &str| {
        format!(
            "spaces: [{{id: 2}}]\nnamespaces: {{2: urn:test}}\nvariables:\n  - {{node: ns=2;i=1, name: Command, origin: 0, \
             ros: {{space: 2, topic: /cmd_vel, type: geometry_msgs/Twist}}}}\n  - {{node: ns=2;i=2, name: Level, type: Double, \
             origin: 0, unit: {unit}, ros: {{space: 2, topic: /level, type: std_msgs/Int32, scale: 0.5, out_of_range: clamp}}}}\n  \
             - {{node: ns=2;i=3, name: Names, type: \"String[]\", origin: 0}}\n"
        )
    };
    let mut server = Bridge::new(0, &text("m"));
    let topics = ["ua_0_2_1", "ua_0_2_2", "ua_0_2_3"].map(|name| name.parse::<TopicId>().unwrap());
    for topic in topics {
        server.router.set_live(topic, true, now);
    }
    let sent = server.sent_within(Duration::from_secs(1), &mut now);
    let mut said = Vec::new();
    each_meta_data(&sent, |writer, meta| {
        let fields = meta.fields.iter();
        let fields: Vec<_> = fields
            .map(|field| {
                let name = field.name.unwrap().to_owned();
                let properties = field.properties.iter().count();
                (name, field.built_in_type, field.value_rank, properties)
            })
            .collect();
        said.push((writer, meta.description.text.map(str::to_owned), fields));
    });
    assert_eq!(said.len(), 3, "each once: {said:?}");
    assert_eq!(said[0].1.as_deref(), Some("geometry_msgs/Twist"));
    assert_eq!(said[0].2.len(), 6);
    assert_eq!(said[0].2[5], ("angular.z".to_owned(), 11, -1, 0));
    assert_eq!(said[1], (2, None, vec![("Level".to_owned(), 11, -1, 2)]));
    assert_eq!(said[2], (3, None, vec![("Names".to_owned(), 12, 1, 0)]));

    // A bridge without a mapping knows the type before the first value.
    let mut bridge = Bridge::new(2, "");
    bridge.hear(&server, &sent, now);
    assert_eq!(bridge.refused(), 0);

    // Announced again in each period, and at once after a change in the mapping.
    let period = Mapping::default().pubsub().metadata_period;
    let again = server.sent_within(period + Duration::from_secs(1), &mut now);
    assert_eq!(announced(&again), 3);
    let mapping = Mapping::from_yaml(&text("mm"), "cell.yaml")
        .mapping
        .unwrap();
    server.router.replace_mapping(Arc::new(mapping), now);
    let changed = server.sent_within(Duration::from_secs(1), &mut now);
    let mut writers = Vec::new();
    each_meta_data(&changed, |writer, _| writers.push(writer));
    assert_eq!(writers, [2]);
}

#[test]
fn one_value_out_of_a_message_makes_no_type_and_a_message_in_it_does() {
    let (mut bridge, mut now) = (Bridge::new(1, ""), clock());
    let stamped = "geometry_msgs/TwistStamped";
    let field = |path: &str| Selection::Field(path.to_owned());
    bridge.bind("ua_1_5_1", stamped, &field("twist.linear.x"), now);
    bridge.bind("ua_1_5_2", stamped, &field("twist"), now);
    bridge.bind("ua_1_5_3", stamped, &Selection::Bytes, now);
    let sent = bridge.sent_within(SECOND, &mut now);
    let mut seen = Vec::new();
    each_meta_data(&sent, |id, meta_data| {
        let first = meta_data.field(0).unwrap();
        let texts = [
            meta_data.description.text,
            first.name,
            first.description.text,
        ];
        seen.push((id, texts.map(|text| text.unwrap_or("-").to_owned())));
    });
    let texts = |texts: [&str; 3]| texts.map(str::to_owned);
    assert_eq!(
        seen,
        [
            (
                1,
                texts([
                    "-",
                    "twist.linear.x",
                    "twist.linear.x of geometry_msgs/TwistStamped"
                ])
            ),
            (2, texts(["geometry_msgs/Twist", "linear.x", "-"])),
            (
                3,
                texts(["geometry_msgs/TwistStamped as bytes", "message", "-"])
            ),
        ]
    );
}

#[test]
fn a_structure_crosses_with_its_definition_and_comes_back_as_the_message_it_was() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    let name_of = "geometry_msgs/Polygon";
    let mut polygon = vec![2, 0, 0, 0];
    for value in [1.0_f32, 2.0, 3.0, 4.0, 5.0, 6.0] {
        polygon.extend(value.to_le_bytes());
    }
    writer.bind("ua_1_5_10", name_of, &Selection::Structure(None), now);
    writer.say("ua_1_5_10", &polygon, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    let mut names = Vec::new();
    each_meta_data(&sent, |_, meta_data| {
        assert_eq!(meta_data.fields.len(), 1);
        let field = meta_data.field(0).unwrap();
        assert_eq!(field.builtin_type(), Some(BuiltinType::ExtensionObject));
        assert_eq!(field.data_type, uadp::NodeId::string(5, name_of));
        assert_eq!(meta_data.schema.namespaces.len(), 5);
        let structure = meta_data.schema.structure(field.data_type).unwrap();
        let points = structure.structure_definition.fields.get(0).unwrap();
        assert_eq!((points.name, points.value_rank), (Some("points"), 1));
        let all = meta_data.schema.structure_data_types.iter();
        names.extend(all.map(|one| one.name.name.unwrap().to_owned()));
    });
    assert_eq!(names, ["geometry_msgs/Polygon", "geometry_msgs/Point32"]);

    reader.hear(&writer, &sent, now);
    let told = reader.told(now);
    let Some((_, Some(described))) = told.last() else {
        panic!("{told:?}")
    };
    let polygon_type = reader.registry.get(&described.message_type).unwrap();
    let selection = described.selection(&polygon_type).unwrap();
    assert_eq!(selection, Selection::Structure(None));
    reader.bind("ua_1_5_10", name_of, &selection, now);
    let delivered = reader
        .outputs(now)
        .into_iter()
        .find_map(|output| match output {
            Output::Delivery(delivery) => Some(delivery.payload),
            _ => None,
        });
    let cdr = [&[0, 1, 0, 0][..], &polygon].concat();
    assert_eq!(delivered, Some(cdr));
}

#[test]
fn several_fields_make_their_message_again_on_the_other_side() {
    let (mut writer, mut reader, mut now) = (Bridge::new(1, ""), Bridge::new(2, ""), clock());
    let twist = "geometry_msgs/Twist";
    let fields = ["linear.x", "angular.z"].map(messages::Selected::whole);
    writer.bind("ua_1_5_10", twist, &Selection::Fields(fields.to_vec()), now);
    let mut speed = TWIST;
    speed[..8].copy_from_slice(&1.5_f64.to_le_bytes());
    speed[8..16].copy_from_slice(&9.0_f64.to_le_bytes());
    speed[40..].copy_from_slice(&0.25_f64.to_le_bytes());
    writer.say("ua_1_5_10", &speed, now);
    let sent = writer.sent_within(SECOND / 2, &mut now);
    reader.hear(&writer, &sent, now);
    let told = reader.told(now);
    let Some((_, Some(described))) = told.last() else {
        panic!("{told:?}")
    };
    let twist_type = reader.registry.get(&described.message_type).unwrap();
    let selection = described.selection(&twist_type).unwrap();
    assert_eq!(selection, Selection::Fields(fields.to_vec()));
    reader.bind("ua_1_5_10", twist, &selection, now);
    let delivered = reader
        .outputs(now)
        .into_iter()
        .find_map(|output| match output {
            Output::Delivery(delivery) => Some(delivery.payload),
            _ => None,
        });
    // Fields that were not selected are zero.
    speed[8..16].fill(0);
    let cdr = [&[0, 1, 0, 0][..], &speed].concat();
    assert_eq!(delivered, Some(cdr));
}
