//! The handling of samples, datagrams and time by a bridge, tested through its public API.

use std::net::SocketAddr;
use std::num::NonZeroU16;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    Crossing, Delivery, DropNotice, Hop, Local, LocalMessage, Now, Output, PublisherKey, Reason,
    Router, RouterSettings, Verdict,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::discovery::{Probe, WireArray};
use uadp::{
    BuiltinType, DataSetHeader, Extras, Fields, GroupHeader, MessageKind, NetworkHeader,
    NetworkMessage, NetworkMessageEncoder, PublisherId, Scalar, SecurityHeader, StatusCode,
    Timestamp, Variant,
};

/// A bridge under test with a manual clock.
struct Bench {
    router: Router,
    now: Now,
}

impl Bench {
    fn new(own: u16, local: Local) -> Self {
        Self::with(own, local, Mapping::default())
    }

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn with(own: u16, local: Local, mapping: Mapping) -> Self {
        let own = SpaceId::new(own).unwrap();
        let settings = RouterSettings {
            own,
            local,
            source: Some(OUR_ADDRESS),
        };
        let utc = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
        Self {
            router: Router::new(settings, Arc::new(mapping)),
            now: Now {
                monotonic: Instant::now(),
                utc,
            },
        }
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        let nanos = self.now.utc.unix_nanos() + i128::try_from(time.as_nanos()).unwrap();
        self.now.utc = Timestamp::from_unix_nanos(nanos);
    }

    fn outputs(&mut self) -> Vec<Output> {
        std::iter::from_fn(|| self.router.poll_output(self.now)).collect()
    }

    fn datagrams(&mut self) -> Vec<Vec<u8>> {
        let outputs = self.outputs().into_iter();
        outputs
            .filter_map(|output| match output {
                Output::Datagram { bytes, .. } => Some(bytes),
                _ => None,
            })
            .collect()
    }

    /// Accepts the deliveries on the local side.
    fn take(&mut self, outputs: &[Output]) {
        for output in outputs {
            if let Output::Delivery(delivery) = output {
                self.router
                    .published(delivery.topic, delivery.arrived, self.now);
            }
        }
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

    fn dropped(&self, reason: Reason) -> u64 {
        let topics: u64 = self
            .router
            .topics()
            .map(|(_, counters)| counters.dropped(reason))
            .sum();
        topics + self.router.others().dropped(reason)
    }

    fn bind(&mut self, topic: TopicId, type_name: &str) {
        let registry = TypeRegistry::bundle(Dialect::Ros1);
        let message_type = registry.get(&type_name.parse().unwrap()).unwrap();
        self.router
            .bind(topic, &message_type, &Selection::Whole, self.now)
            .unwrap();
    }

    fn hear(&mut self, datagram: &[u8]) {
        self.router.handle_datagram(datagram, PEER, self.now);
    }

    fn say(&mut self, topic: TopicId, payload: &[u8]) -> Verdict {
        self.router
            .handle_local(heard(topic, payload, self.now.utc), self.now)
    }
}

/// A key frame of a foreign writer with a single UInt32.
struct Frame {
    publisher: PublisherId<'static>,
    group: u16,
    writer: u16,
    header: DataSetHeader,
    value: u32,
}

impl Frame {
    fn new(writer: u16, sequence: u16, value: u32) -> Self {
        Self {
            publisher: PublisherId::UInt16(2),
            group: 5,
            writer,
            header: DataSetHeader {
                sequence_number: Some(sequence),
                ..DataSetHeader::default()
            },
            value,
        }
    }

    fn bytes(&self) -> Vec<u8> {
        self.bytes_with(&Variant::Scalar(Scalar::UInt32(self.value)))
    }

    fn bytes_with(&self, value: &Variant<'_>) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut bytes, &self.network(), Some(&[self.writer])).unwrap();
        let mut frame = message.key_frame(&self.header).unwrap();
        frame.variant(value).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        bytes
    }

    fn keep_alive(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut bytes, &self.network(), Some(&[self.writer])).unwrap();
        message.keep_alive(&self.header).unwrap();
        message.finish().unwrap();
        bytes
    }

    fn network(&self) -> NetworkHeader<'static> {
        NetworkHeader {
            publisher_id: Some(self.publisher),
            group: Some(GroupHeader {
                writer_group_id: Some(self.group),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        }
    }
}

const fn heard(topic: TopicId, payload: &[u8], received: Timestamp) -> LocalMessage<'_> {
    LocalMessage {
        topic,
        payload,
        received,
        latched_by: None,
    }
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn value_of(delivery: &Delivery) -> u32 {
    u32::from_le_bytes(delivery.payload[..].try_into().unwrap())
}

const OUR_ADDRESS: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_000);
const PEER: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_001);
const SECOND: Duration = Duration::from_secs(1);

#[test]
fn a_ros_message_becomes_a_key_frame_of_its_triple() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    assert_eq!(
        bench.say(topic("ua_1_5_10"), &[7, 0, 0, 0]),
        Verdict::Forward
    );
    let [datagram] = &bench.datagrams()[..] else {
        panic!("one datagram")
    };
    let message = NetworkMessage::decode(datagram).unwrap();
    let header = message.header();
    assert_eq!(header.publisher_id, Some(PublisherId::UInt16(1)));
    assert_eq!(header.group.unwrap().writer_group_id, Some(5));
    assert_eq!(header.timestamp, Some(bench.now.utc.time));
    let message = message.messages().next().unwrap().unwrap();
    assert_eq!(
        (message.writer_id, message.kind),
        (Some(10), MessageKind::KeyFrame)
    );
    assert_eq!(message.header().timestamp, Some(bench.now.utc.time));
    let fields: Vec<_> = message.fields().unwrap().collect();
    assert_eq!(fields, [Ok(Variant::Scalar(Scalar::UInt32(7)))]);
}

#[test]
fn what_is_heard_on_ros_of_another_space_is_looped() {
    let mut bench = Bench::new(1, Local::Ros1);
    let verdict = bench.say(topic("ua_2_5_10"), &[7, 0, 0, 0]);
    assert_eq!(verdict, Verdict::Drop(Reason::Looped));
    assert!(bench.outputs().is_empty());
}

#[test]
fn a_broken_ros_message_is_counted_and_told_and_the_next_one_crosses() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    let verdict = bench.say(topic("ua_1_5_10"), &[7, 0]);
    assert_eq!(verdict, Verdict::Drop(Reason::Malformed));
    let notices = bench.notices();
    assert_eq!(notices.len(), 1);
    assert_eq!(notices[0].topic, Some(topic("ua_1_5_10")));
    assert_eq!(
        bench.say(topic("ua_1_5_10"), &[7, 0, 0, 0]),
        Verdict::Forward
    );
    let datagrams = bench.datagrams();
    let message = NetworkMessage::decode(&datagrams[0])
        .unwrap()
        .messages()
        .next()
        .unwrap()
        .unwrap();
    assert_eq!(
        message.header().sequence_number,
        Some(0),
        "a dropped sample uses up no number"
    );
}

#[test]
fn a_value_of_another_space_is_published_with_its_source_time() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_2_5_10"), "std_msgs/UInt32");
    let taken = Timestamp::from_unix_nanos(1_699_999_999_123_456_789);
    let mut frame = Frame::new(10, 1, 42);
    frame.header.timestamp = Some(taken.time);
    frame.header.picoseconds = Some(taken.picoseconds);
    frame.header.status = Some(0x8000);
    bench.hear(&frame.bytes());
    let deliveries = bench.deliveries();
    assert_eq!(deliveries.len(), 1);
    assert_eq!(value_of(&deliveries[0]), 42);
    assert_eq!(
        (deliveries[0].source, deliveries[0].status),
        (Some(taken), 0x8000)
    );
}

#[test]
fn a_value_waits_for_its_type_and_then_goes_out() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.hear(&Frame::new(10, 1, 41).bytes());
    bench.hear(&Frame::new(10, 2, 42).bytes());
    let outputs = bench.outputs();
    let [
        Output::Unbound {
            topic: asked,
            shape,
            ..
        },
    ] = &outputs[..]
    else {
        panic!("{outputs:?}")
    };
    assert_eq!(
        (*asked, &shape[..]),
        (topic("ua_2_5_10"), &[(BuiltinType::UInt32, false)][..])
    );
    bench.bind(topic("ua_2_5_10"), "std_msgs/UInt32");
    let deliveries = bench.deliveries();
    assert_eq!(
        deliveries.iter().map(value_of).collect::<Vec<_>>(),
        [42],
        "the newest one"
    );
}

#[test]
fn a_topic_whose_first_value_is_null_gets_the_type_of_the_first_that_is_not() {
    let mut bench = Bench::new(1, Local::Ros1);
    let double = Variant::Scalar(Scalar::Double(1.5));
    let mut asked = Vec::new();
    for (sequence, value) in [(1, Variant::Null), (2, double)] {
        bench.wait(SECOND);
        bench.hear(&Frame::new(10, sequence, 0).bytes_with(&value));
        for output in bench.outputs() {
            if let Output::Unbound { shape, .. } = output {
                asked.push(shape);
            }
        }
    }
    assert_eq!(
        asked,
        [
            [(BuiltinType::Variant, false)],
            [(BuiltinType::Double, false)]
        ]
    );
    bench.bind(topic("ua_2_5_10"), "std_msgs/Float64");
    let deliveries = bench.deliveries();
    assert_eq!(deliveries[0].payload[..], 1.5_f64.to_le_bytes());
}

#[test]
fn what_waits_in_the_type_that_was_is_not_delivered_and_is_counted() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_2_5_10"), "std_msgs/UInt32");
    bench.hear(&Frame::new(10, 1, 42).bytes());
    bench.bind(topic("ua_2_5_10"), "std_msgs/String");
    assert!(bench.deliveries().is_empty());
    assert_eq!(bench.dropped(Reason::NotPublished), 1);
}

#[test]
fn a_value_of_another_type_than_the_topic_has_is_a_mismatch() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_2_5_10"), "std_msgs/String");
    bench.hear(&Frame::new(10, 1, 42).bytes());
    let notices = bench.notices();
    assert_eq!(notices[0].reason, Reason::Mismatch);
    assert!(
        notices[0].detail.contains("UInt32"),
        "{}",
        notices[0].detail
    );
}

#[test]
fn a_value_whose_source_is_lost_is_not_a_mismatch() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_2_5_10"), "std_msgs/Float64");
    let lost = |sequence, status| Frame {
        header: DataSetHeader {
            status,
            ..Frame::new(10, sequence, 0).header
        },
        ..Frame::new(10, sequence, 0)
    };
    // BadNoCommunication in the place of the value, and in the header of a null value.
    let status = Variant::Scalar(Scalar::StatusCode(StatusCode(0x8031_0000)));
    bench.hear(&lost(1, None).bytes_with(&status));
    bench.hear(&lost(2, Some(0x8031)).bytes_with(&Variant::Null));
    let notices = bench.notices();
    assert_eq!(notices[0].reason, Reason::NoValue);
    assert!(
        notices[0].detail.contains("0x80310000"),
        "{}",
        notices[0].detail
    );
    assert_eq!(bench.dropped(Reason::NoValue), 2);
    // A status that is not Bad, and a null value that is not, do not fit the type.
    let good = Variant::Scalar(Scalar::StatusCode(StatusCode(0)));
    bench.hear(&lost(3, None).bytes_with(&good));
    bench.hear(&lost(4, None).bytes_with(&Variant::Null));
    assert_eq!(bench.dropped(Reason::Mismatch), 2);
    assert_eq!(bench.dropped(Reason::NoValue), 2);
}

#[test]
fn our_own_datagram_is_looped_and_a_rival_is_named_once() {
    let mut bench = Bench::new(1, Local::Ros1);
    let frame = Frame {
        publisher: PublisherId::UInt16(1),
        ..Frame::new(10, 1, 42)
    };
    bench
        .router
        .handle_datagram(&frame.bytes(), OUR_ADDRESS, bench.now);
    assert!(bench.outputs().is_empty());
    assert_eq!(bench.dropped(Reason::Looped), 1);
    for _ in 0..5 {
        bench.hear(&frame.bytes());
    }
    let notices = bench.notices();
    assert_eq!(notices.len(), 1);
    assert_eq!(
        (notices[0].reason, notices[0].from),
        (Reason::SpaceTaken, Some(PEER))
    );
    assert_eq!(bench.dropped(Reason::SpaceTaken), 5);
}

#[test]
fn our_number_in_another_width_is_named_unless_the_mapping_takes_any() {
    let frame = Frame {
        publisher: PublisherId::Byte(2),
        ..Frame::new(10, 1, 42)
    };
    let mut exact = Bench::new(1, Local::Fields);
    exact.hear(&frame.bytes());
    let notices = exact.notices();
    assert_eq!(notices[0].reason, Reason::PublisherWidth);
    assert!(notices[0].detail.contains("any_width"));
    let checked = Mapping::from_yaml("pubsub: {publisher_id: any_width}\n", "test.yaml");
    let mut relaxed = Bench::with(1, Local::Fields, checked.mapping.unwrap());
    relaxed.hear(&frame.bytes());
    assert_eq!(relaxed.deliveries().len(), 1);
}

#[test]
fn every_message_of_a_datagram_is_handled_and_a_bad_one_hides_none() {
    let mut bench = Bench::new(1, Local::Fields);
    let frame = Frame::new(0, 0, 0);
    let mut bytes = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut bytes, &frame.network(), Some(&[1, 2, 3])).unwrap();
    for value in 1..=3 {
        let mut fields = message.key_frame(&DataSetHeader::default()).unwrap();
        fields.scalar(Scalar::UInt32(value)).unwrap();
        fields.finish().unwrap();
    }
    message.finish().unwrap();
    bench.hear(&bytes);
    assert_eq!(bench.deliveries().len(), 3);
    // The type byte of the second message's field: not a builtin type.
    let second = bytes.len() - 8 - 5;
    assert_eq!(bytes[second], BuiltinType::UInt32.id());
    bytes[second] = 0x3f;
    bench.hear(&bytes);
    assert_eq!(bench.deliveries().len(), 2);
    assert_eq!(bench.dropped(Reason::Malformed), 1);
}

#[test]
fn what_the_codec_reads_and_the_space_does_not_carry_is_counted_as_unsupported() {
    let mut bench = Bench::new(1, Local::Fields);
    let frame = Frame::new(10, 1, 42);
    let written = |extras: &Extras<'_>, write: &dyn Fn(&mut NetworkMessageEncoder<'_>)| {
        let mut bytes = Vec::new();
        let mut message =
            NetworkMessageEncoder::with(&mut bytes, &frame.network(), Some(&[10]), extras).unwrap();
        write(&mut message);
        message.finish().unwrap();
        bytes
    };
    // A key frame with a SecurityHeader that marks it as signed.
    let unsecured = Extras {
        security: Some(SecurityHeader::NONE),
        ..Extras::default()
    };
    let mut signed = written(&unsecured, &|message| {
        message.key_frame(&frame.header).unwrap().finish().unwrap();
    });
    // Flags, token and an empty nonce precede the payload.
    let security_flags = NetworkMessage::decode(&signed).unwrap().payload_offset() - 6;
    signed[security_flags] |= 1;
    let probes = [
        Probe::DataSetWriterConfiguration(WireArray::new(&[10])),
        Probe::WriterGroupConfiguration {
            writer_group_id: 1,
            include_data_set_writers: true,
        },
    ];
    let probes = probes.map(|probe| {
        let mut bytes = Vec::new();
        probe
            .encode(Some(frame.publisher), SecurityHeader::NONE, &mut bytes)
            .unwrap();
        bytes
    });
    let all = std::iter::once(&signed).chain(&probes);
    for (count, datagram) in (1..).zip(all) {
        bench.hear(datagram);
        assert_eq!(bench.dropped(Reason::Unsupported), count, "{datagram:02x?}");
    }
    assert_eq!(bench.deliveries().len(), 0);
    bench.hear(&Frame::new(10, 3, 42).bytes());
    assert_eq!(bench.deliveries().len(), 1, "what is carried goes on");
}

#[test]
fn a_message_without_a_writer_group_is_counted() {
    let mut bench = Bench::new(1, Local::Fields);
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        ..NetworkHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &header, Some(&[10])).unwrap();
    message.keep_alive(&DataSetHeader::default()).unwrap();
    message.finish().unwrap();
    bench.hear(&bytes);
    assert_eq!(bench.dropped(Reason::NotInSpace), 1);
}

#[test]
fn garbage_is_counted_and_told_once_per_decade() {
    let mut bench = Bench::new(1, Local::Fields);
    for _ in 0..100 {
        bench.hear(b"GET / HTTP/1.1\r\n");
    }
    bench.hear(&[]);
    assert_eq!(
        bench.dropped(Reason::Malformed) + bench.dropped(Reason::Unsupported),
        101
    );
    let told = bench.notices().len();
    assert!((1..=4).contains(&told), "{told}");
    bench.hear(&Frame::new(10, 1, 42).bytes());
    assert_eq!(bench.deliveries().len(), 1, "traffic of others goes on");
}

#[test]
fn a_lost_message_is_counted_as_missing() {
    let mut bench = Bench::new(1, Local::Fields);
    for sequence in [1, 2, 5] {
        bench.hear(&Frame::new(10, sequence, 0).bytes());
    }
    let (_, counters) = bench.router.topics().next().unwrap();
    assert_eq!(counters.missing, 2);
}

#[test]
fn a_state_is_repeated_with_its_time_and_its_readers_deliver_it_once() {
    let mut sender = Bench::new(1, Local::Ros1);
    let mut reader = Bench::new(2, Local::Fields);
    sender.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    // The metadata is announced in the meantime.
    sender.wait(SECOND);
    sender.router.handle_timeout(sender.now);
    let state = LocalMessage {
        latched_by: Some(PublisherKey(1)),
        ..heard(topic("ua_1_5_10"), &[7, 0, 0, 0], sender.now.utc)
    };
    let now = sender.now;
    assert_eq!(sender.router.handle_local(state, now), Verdict::Forward);
    let first = sender.datagrams().remove(0);
    assert_eq!(
        sender.router.poll_timeout(),
        Some(sender.now.monotonic + SECOND)
    );
    sender.wait(SECOND);
    sender.router.handle_timeout(sender.now);
    let again = sender.datagrams().remove(0);
    let stamps = |datagram: &[u8]| {
        let message = NetworkMessage::decode(datagram).unwrap();
        let sent = message.header().timestamp.unwrap();
        let message = message.messages().next().unwrap().unwrap();
        (
            sent,
            message.header().timestamp.unwrap(),
            message.header().sequence_number.unwrap(),
        )
    };
    let ((sent, taken, number), (sent_again, taken_again, next)) = (stamps(&first), stamps(&again));
    assert_eq!((taken, number + 1), (taken_again, next));
    assert_eq!(sent_again.0 - sent.0, 10_000_000, "sent a second later");

    reader.hear(&first);
    reader.hear(&again);
    assert_eq!(reader.deliveries().len(), 1);
    assert_eq!(reader.dropped(Reason::Repeat), 1);
    let mut late = Bench::new(3, Local::Fields);
    late.hear(&again);
    assert_eq!(
        late.deliveries().len(),
        1,
        "a late reader gets it from the repetition"
    );
}

#[test]
fn a_topic_without_a_producer_is_not_repeated() {
    let mut bench = Bench::new(1, Local::Ros1);
    bench.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    assert_eq!(
        bench.say(topic("ua_1_5_10"), &[7, 0, 0, 0]),
        Verdict::Forward
    );
    bench.router.set_live(topic("ua_1_5_10"), false, bench.now);
    bench.outputs();
    bench.wait(SECOND * 2);
    bench.router.handle_timeout(bench.now);
    assert!(bench.datagrams().is_empty());
}

#[test]
fn events_keep_their_order_and_are_kept_alive_instead_of_repeated() {
    let yaml = "namespaces: {5: 'urn:test'}\nspaces: [{id: 1, ros: 1}]\nvariables:\n  - {node: ns=5;i=10, name: Part, type: UInt32, origin: 1, queue: {drop_oldest: 3}}\n";
    let checked = Mapping::from_yaml(yaml, "test.yaml");
    let mut bench = Bench::with(1, Local::Ros1, checked.mapping.expect("a valid mapping"));
    let overflow = bench.now;
    bench.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    for value in 1..=4_u32 {
        let bytes = value.to_le_bytes();
        let verdict = bench
            .router
            .handle_local(heard(topic("ua_1_5_10"), &bytes, overflow.utc), overflow);
        let full = value > 3;
        assert_eq!(
            verdict == Verdict::ForwardAfterDroppingOldest,
            full,
            "{value}"
        );
    }
    let values: Vec<_> = bench
        .datagrams()
        .iter()
        .map(|datagram| only_value(datagram))
        .collect();
    assert_eq!(values, [2, 3, 4]);
    assert_eq!(bench.dropped(Reason::Overflow), 1);
    bench.wait(SECOND);
    bench.router.handle_timeout(bench.now);
    let datagram = bench.datagrams().remove(0);
    let message = NetworkMessage::decode(&datagram)
        .unwrap()
        .messages()
        .next()
        .unwrap()
        .unwrap();
    assert_eq!(message.kind, MessageKind::KeepAlive);
    assert_eq!(
        message.header().sequence_number,
        Some(4),
        "the number to expect next"
    );
    assert_eq!(NonZeroU16::new(10).map(NonZeroU16::get), message.writer_id);
}

#[test]
fn topics_are_served_in_turn() {
    let mut bench = Bench::new(2, Local::Fields);
    let frame = Frame::new(0, 0, 0);
    let mut bytes = Vec::new();
    let ids = [1, 1, 1, 9];
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        ..frame.network()
    };
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&ids)).unwrap();
    for value in 0..4 {
        let mut fields = message.key_frame(&DataSetHeader::default()).unwrap();
        fields.scalar(Scalar::UInt32(value)).unwrap();
        fields.finish().unwrap();
    }
    message.finish().unwrap();
    let yaml = "namespaces: {5: 'urn:test'}\nspaces: [{id: 1, ros: 1}]\nvariables:\n  - {node: ns=5;i=1, name: Camera, type: UInt32, origin: 1, queue: {drop_oldest: 8}}\n";
    let mut mapped = Bench::with(
        2,
        Local::Fields,
        Mapping::from_yaml(yaml, "test.yaml").mapping.unwrap(),
    );
    mapped.hear(&bytes);
    let order: Vec<_> = mapped
        .deliveries()
        .iter()
        .map(|delivery| delivery.topic.triple().2)
        .collect();
    assert_eq!(
        order,
        [1, 9, 1, 1],
        "the button waits for one picture, not for three"
    );
    bench.hear(&bytes);
    assert_eq!(
        bench.deliveries().len(),
        2,
        "a state keeps its latest value only"
    );
}

#[test]
fn a_silent_writer_is_told_once_and_keep_alives_prevent_it() {
    let mut bench = Bench::new(1, Local::Fields);
    let frame = Frame::new(10, 1, 42);
    bench.hear(&frame.bytes());
    bench.outputs();
    bench.wait(SECOND * 2);
    bench.hear(&Frame::new(10, 2, 0).keep_alive());
    bench.wait(SECOND * 2);
    bench.router.handle_timeout(bench.now);
    assert!(bench.outputs().is_empty(), "it spoke two seconds ago");
    bench.wait(SECOND);
    bench.router.handle_timeout(bench.now);
    let outputs = bench.outputs();
    assert!(
        matches!(outputs[..], [Output::Silent { silent: true, .. }]),
        "{outputs:?}"
    );
    bench.wait(SECOND * 10);
    bench.router.handle_timeout(bench.now);
    assert!(bench.outputs().is_empty());
    bench.hear(&Frame::new(10, 2, 43).bytes());
    let outputs = bench.outputs();
    assert!(matches!(outputs[..], [Output::Delivery(_)]), "{outputs:?}");
    bench.take(&outputs);
    let outputs = bench.outputs();
    assert!(
        matches!(outputs[..], [Output::Silent { silent: false, .. }]),
        "{outputs:?}"
    );
}

#[test]
fn a_value_that_keeps_being_dropped_falls_silent_though_its_writer_is_heard() {
    let mut bench = Bench::new(1, Local::Fields);
    bench.hear(&Frame::new(10, 1, 42).bytes());
    let outputs = bench.outputs();
    bench.take(&outputs);
    let mut sequence = 1;
    for _ in 0..3 {
        bench.wait(SECOND);
        sequence += 1;
        let mut cut_off = Frame::new(10, sequence, 43).bytes();
        cut_off.truncate(cut_off.len() - 2);
        bench.hear(&cut_off);
        bench.hear(&Frame::new(10, sequence + 1, 0).keep_alive());
    }
    bench.router.handle_timeout(bench.now);
    let outputs = bench.outputs();
    assert!(
        matches!(
            outputs[..],
            [
                Output::Notice(_),
                Output::Silent {
                    silent: true,
                    dropped: Some(Reason::Malformed),
                    ..
                }
            ]
        ),
        "{outputs:?}"
    );
    bench.hear(&Frame::new(10, sequence + 1, 0).keep_alive());
    assert!(
        bench.outputs().is_empty(),
        "that it lives says nothing of a value that was not understood"
    );
    bench.hear(&Frame::new(10, sequence + 1, 44).bytes());
    let outputs = bench.outputs();
    assert!(matches!(outputs[..], [Output::Delivery(_)]), "{outputs:?}");
    bench.take(&outputs);
    let outputs = bench.outputs();
    assert!(
        matches!(outputs[..], [Output::Silent { silent: false, .. }]),
        "{outputs:?}"
    );
}

#[test]
fn a_value_that_the_local_side_does_not_take_falls_silent_too() {
    let mut bench = Bench::new(1, Local::Fields);
    bench.hear(&Frame::new(10, 1, 42).bytes());
    let outputs = bench.outputs();
    bench.take(&outputs);
    for sequence in 2..5 {
        bench.wait(SECOND);
        bench.hear(&Frame::new(10, sequence, 43).bytes());
        for delivery in bench.deliveries() {
            let Delivery {
                topic, instance, ..
            } = delivery;
            bench.router.not_published(topic, instance, "another type");
        }
    }
    bench.outputs();
    bench.router.handle_timeout(bench.now);
    let outputs = bench.outputs();
    assert!(
        matches!(
            outputs[..],
            [Output::Silent {
                silent: true,
                dropped: Some(Reason::NotPublished),
                ..
            }]
        ),
        "{outputs:?}"
    );
}

#[test]
fn an_opc_ua_side_hands_over_fields_and_gets_fields() {
    let mut server = Bench::new(0, Local::Fields);
    let mut block = 1_u16.to_le_bytes().to_vec();
    block.extend_from_slice(&[BuiltinType::Boolean.id(), 1]);
    assert_eq!(server.say(topic("ua_0_5_1"), &block), Verdict::Forward);
    let datagram = server.datagrams().remove(0);
    let mut other = Bench::new(7, Local::Fields);
    other.hear(&datagram);
    let delivery = other.deliveries().remove(0);
    let fields: Vec<_> = Fields::parse(&delivery.payload).unwrap().collect();
    assert_eq!(fields, [Ok(Variant::Scalar(Scalar::Boolean(true)))]);
    assert_eq!(
        server.say(topic("ua_0_5_1"), &[9, 0, 1]),
        Verdict::Drop(Reason::Malformed)
    );
}

#[test]
fn the_delays_of_a_sample_are_read_off_its_stamps() {
    let mut sender = Bench::new(1, Local::Ros1);
    sender.bind(topic("ua_1_5_10"), "std_msgs/UInt32");
    let received = sender.now.utc;
    sender.wait(Duration::from_micros(30));
    let _verdict = sender.router.handle_local(
        heard(topic("ua_1_5_10"), &[1, 0, 0, 0], received),
        sender.now,
    );
    let datagram = sender.datagrams().remove(0);
    let mut reader = Bench::new(2, Local::Fields);
    reader.now = sender.now;
    reader.wait(Duration::from_micros(200));
    reader.hear(&datagram);
    let delivery = reader.deliveries().remove(0);
    reader.wait(Duration::from_micros(50));
    reader
        .router
        .published(delivery.topic, delivery.arrived, reader.now);
    let max = |bench: &Bench, hop| bench.router.hops().of(hop).max_us().round();
    assert_eq!(max(&sender, Hop::Out), 30.0);
    assert_eq!(max(&reader, Hop::Origin), 30.0);
    assert!((199.0..=202.0).contains(&max(&reader, Hop::Network)));
    assert!((50.0..=51.0).contains(&max(&reader, Hop::In)));
}

fn only_value(datagram: &[u8]) -> u32 {
    let message = NetworkMessage::decode(datagram).unwrap();
    let message = message.messages().next().unwrap().unwrap();
    match message.fields().unwrap().next() {
        Some(Ok(Variant::Scalar(Scalar::UInt32(value)))) => value,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_tapped_topic_shows_each_step_of_its_samples_and_others_none() {
    let mut bench = Bench::new(1, Local::Ros1);
    let (theirs, ours, other) = (topic("ua_2_5_10"), topic("ua_1_5_10"), topic("ua_1_5_11"));
    for topic in [theirs, ours, other] {
        bench.bind(topic, "std_msgs/UInt32");
    }
    let steps = |bench: &mut Bench| -> Vec<Crossing> {
        let events = std::iter::from_fn(|| bench.router.next_tapped());
        events.map(|event| event.crossing).collect()
    };
    let cross = |bench: &mut Bench| {
        bench.hear(&Frame::new(10, 1, 7).bytes());
        let outputs = bench.outputs();
        bench.take(&outputs);
        for topic in [ours, other] {
            assert_eq!(bench.say(topic, &[7, 0, 0, 0]), Verdict::Forward);
        }
        bench.outputs();
    };
    cross(&mut bench);
    assert!(!bench.router.is_tapped());
    assert_eq!(steps(&mut bench), []);
    bench.router.tap(&[ours, theirs]);
    // The second sample of the same number.
    cross(&mut bench);
    let seen = steps(&mut bench);
    let [
        Crossing::Received {
            sequence: Some(1),
            keep_alive: false,
            ..
        },
        Crossing::Dropped {
            reason: Reason::Duplicate | Reason::Repeat,
            from: Some(_),
            count: 1,
            ..
        },
        Crossing::Taken { bytes: 4 },
        Crossing::Measured { hop: Hop::Out, .. },
        Crossing::Sent { .. },
    ] = &seen[..]
    else {
        panic!("{seen:?}");
    };
    bench.hear(&Frame::new(10, 2, 8).bytes());
    let outputs = bench.outputs();
    bench.take(&outputs);
    let seen = steps(&mut bench);
    assert!(
        matches!(
            seen[..],
            [Crossing::Received { .. }, Crossing::Published { after: 0 }]
        ),
        "{seen:?}"
    );
    // Events that are not taken are bounded.
    for sequence in 3..1_100 {
        bench.hear(&Frame::new(10, sequence, 8).keep_alive());
    }
    assert!(bench.router.take_lost_taps() > 0);
    assert!(steps(&mut bench).len() <= 1_024);
    bench.router.tap(&[]);
    cross(&mut bench);
    assert_eq!(steps(&mut bench), []);
}
