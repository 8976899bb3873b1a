//! Delivery of messages from writers of other vendors: captured datagrams of open62541 and asyncua,
//! and generated datagrams of other valid forms.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{Delivery, Local, Now, Output, Reason, Router, RouterSettings, ValueRelation};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, FieldMetaData, WireArray,
};
use uadp::{
    BuiltinType, ConfigurationVersion, DataSetHeader, DataSetMessage, DataValue, DateTime, Fields,
    GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId, Scalar,
    SecurityHeader, StatusCode, Timestamp, Variant,
};

/// A Router that receives messages of foreign writers, and a clock.
struct Bench {
    router: Router,
    now: Now,
}

impl Bench {
    /// Creates the OPC UA side. `variable` is the rest of the definition of the mapped variable
    /// under `topic`.
    fn mapped(topic: &str, variable: &str) -> Self {
        let topic: TopicId = topic.parse().unwrap();
        let (space, namespace, id) = topic.triple();
        let text = format!(
            "spaces: [{{id: {space}}}]\nnamespaces: {{{namespace}: 'urn:test'}}\nvariables:\n  \
             - {{node: ns={namespace};i={id}, name: Speed, origin: {space}, {variable}}}\n"
        );
        let checked = Mapping::from_yaml(&text, "test.yaml");
        assert!(checked.findings.is_empty(), "{:?}", checked.findings);
        Self::new(0, Local::Fields, checked.mapping.unwrap())
    }

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn new(own: u16, local: Local, mapping: Mapping) -> Self {
        let settings = RouterSettings {
            own: SpaceId::new(own).unwrap(),
            local,
            source: None,
        };
        Self {
            router: Router::new(settings, Arc::new(mapping)),
            now: Now {
                monotonic: Instant::now(),
                utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
            },
        }
    }

    fn zero_configuration() -> Self {
        Self::new(0, Local::Fields, Mapping::default())
    }

    fn wait(&mut self, time: Duration) {
        self.now.monotonic += time;
        self.router.handle_timeout(self.now);
    }

    /// Returns the deliveries of a datagram.
    fn hear(&mut self, datagram: &[u8]) -> Vec<Delivery> {
        self.router.handle_datagram(datagram, PEER, self.now);
        self.deliveries()
    }

    fn outputs(&mut self) -> Vec<Output> {
        std::iter::from_fn(|| self.router.poll_output(self.now)).collect()
    }

    fn deliveries(&mut self) -> Vec<Delivery> {
        let outputs = self.outputs().into_iter();
        let deliveries: Vec<Delivery> = outputs
            .filter_map(|output| match output {
                Output::Delivery(delivery) => Some(delivery),
                _ => None,
            })
            .collect();
        for delivery in &deliveries {
            let (topic, arrived) = (delivery.topic, delivery.arrived);
            self.router.published(topic, arrived, self.now);
        }
        deliveries
    }

    fn dropped(&self, reason: Reason) -> u64 {
        let topics = self.router.topics();
        topics.map(|(_, counters)| counters.dropped(reason)).sum()
    }

    /// Announces the fields of a writer at the address.
    fn announce(&mut self, topic: &str, (major, from): (u32, SocketAddr), fields: &[(&str, u8)]) {
        let id: TopicId = topic.parse().unwrap();
        let (space, _, writer_id) = id.triple();
        let fields: Vec<FieldMetaData<'_>> = fields
            .iter()
            .map(|(name, built_in_type)| FieldMetaData {
                name: Some(name),
                built_in_type: *built_in_type,
                value_rank: -1,
                ..FieldMetaData::default()
            })
            .collect();
        let meta_data = DataSetMetaDataType {
            name: Some(topic),
            fields: WireArray::new(&fields),
            configuration_version: ConfigurationVersion { major, minor: 0 },
            ..DataSetMetaDataType::default()
        };
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data,
                status: StatusCode::GOOD,
            },
        };
        let mut datagram = Vec::new();
        let publisher = PublisherId::UInt16(space);
        announcement
            .encode(publisher, SecurityHeader::NONE, &mut datagram)
            .unwrap();
        self.router.handle_datagram(&datagram, from, self.now);
    }
}

/// Returns the directory of the datagrams of other vendors.
fn vectors() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../uadp/tests/vectors")
}

/// Returns a captured datagram. PublisherId 2234, which is not a space, is replaced by 2.
fn vector(name: &str) -> Vec<u8> {
    let text = std::fs::read_to_string(vectors().join(format!("{name}.hex"))).unwrap();
    let digits = text.trim().as_bytes().chunks(2);
    let mut datagram: Vec<u8> = digits
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap())
        .collect();
    let publisher = NetworkMessage::decode(&datagram).map(|message| message.header().publisher_id);
    if publisher == Ok(Some(PublisherId::UInt16(2234))) {
        datagram[2..4].copy_from_slice(&2_u16.to_le_bytes());
    }
    datagram
}

fn messages_of(datagram: &[u8]) -> Vec<DataSetMessage<'_>> {
    let network = NetworkMessage::decode(datagram).unwrap();
    network.messages().map(Result::unwrap).collect()
}

/// Returns a DataSetMessage of the writer 2/5/10.
fn message(
    header: &DataSetHeader,
    write: impl FnOnce(&mut NetworkMessageEncoder<'_>, &DataSetHeader),
) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[10])).unwrap();
    write(&mut message, header);
    message.finish().unwrap();
    bytes
}

fn key_frame(header: &DataSetHeader, values: &[u32]) -> Vec<u8> {
    message(header, |message, header| {
        let mut frame = message.key_frame(header).unwrap();
        for value in values {
            frame.scalar(Scalar::UInt32(*value)).unwrap();
        }
        frame.finish().unwrap();
    })
}

fn delta(header: &DataSetHeader, entries: &[(u16, u32)]) -> Vec<u8> {
    message(header, |message, header| {
        let mut frame = message.delta_frame(header).unwrap();
        for (index, value) in entries {
            let field = frame.field(*index).unwrap();
            field.scalar(Scalar::UInt32(*value)).unwrap();
        }
        frame.finish().unwrap();
    })
}

fn raw(header: &DataSetHeader, payload: &[u8]) -> Vec<u8> {
    message(header, |message, header| {
        let write = |buf: &mut Vec<u8>| {
            buf.extend_from_slice(payload);
            Ok(())
        };
        message.raw_key_frame(header, write).unwrap();
    })
}

fn numbered(sequence: u16) -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(sequence),
        ..DataSetHeader::default()
    }
}

/// Returns the fields of a delivery as text.
fn told(delivery: &Delivery) -> String {
    let fields = Fields::parse(&delivery.payload).unwrap();
    let fields = fields.map(|field| match field.unwrap() {
        Variant::Null => "null".to_owned(),
        Variant::Scalar(scalar) => format!("{scalar:?}"),
        Variant::Array(array) => format!("{:?}", array.iter().collect::<Vec<_>>()),
        Variant::Matrix(matrix) => format!("{matrix:?}"),
    });
    fields.collect::<Vec<_>>().join(", ")
}

fn all_told(deliveries: &[Delivery]) -> Vec<String> {
    deliveries.iter().map(told).collect()
}

const PEER: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_001);
const STRANGER: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 50_002);
const DOUBLE: u8 = 11;
const INT32: u8 = 6;
const UINT32: u8 = 7;

#[test]
fn the_delta_frames_of_open62541_are_put_over_its_key_frames() {
    let mut bench = Bench::zero_configuration();
    let heard: Vec<String> = (0..=5)
        .flat_map(|round| all_told(&bench.hear(&vector(&format!("wire_delta_r{round}")))))
        .collect();
    let expected = [
        (2.5, 17),
        (2.5, 18),
        (2.5, 19),
        (5.0, 20),
        (5.0, 21),
        (5.0, 22),
    ];
    let expected = expected.map(|(double, number)| {
        // The delta frames end with nulls for field 0, which are not values.
        format!("Boolean(true), String(Some(\"cell\")), Double({double:?}), Int32(202605{number})")
    });
    assert_eq!(heard, expected);
    assert_eq!(bench.router.topics().next().unwrap().1.drops().count(), 0);
}

#[test]
fn a_delta_frame_without_its_key_frame_is_dropped_and_counted() {
    let mut bench = Bench::zero_configuration();
    assert_eq!(bench.hear(&vector("wire_delta_r1")).len(), 0);
    assert_eq!(bench.dropped(Reason::NoKeyFrame), 1);
    assert_eq!(bench.hear(&vector("wire_delta_r4")).len(), 1);
    assert_eq!(bench.hear(&vector("wire_delta_r5")).len(), 1);

    let version = |major, sequence| DataSetHeader {
        major_version: Some(major),
        ..numbered(sequence)
    };
    let mut bench = Bench::zero_configuration();
    assert_eq!(bench.hear(&key_frame(&version(1, 1), &[1, 2])).len(), 1);
    let other_version = delta(&version(2, 2), &[(0, 3)]);
    assert_eq!(bench.hear(&other_version).len(), 0);
    let next = delta(&version(1, 2), &[(0, 3)]);
    bench.router.handle_datagram(&next, STRANGER, bench.now);
    assert_eq!(bench.deliveries().len(), 0, "of another sender");
    assert_eq!(bench.dropped(Reason::NoKeyFrame), 2);
}

#[test]
fn behind_a_lost_message_only_what_a_delta_frame_says_itself_is_believed() {
    let mut bench = Bench::zero_configuration();
    bench.hear(&key_frame(&numbered(1), &[1, 2]));
    // Number 2 is lost.
    assert_eq!(bench.hear(&delta(&numbered(3), &[(1, 20)])).len(), 0);
    assert_eq!(bench.dropped(Reason::NoKeyFrame), 1);
    let heard = bench.hear(&delta(&numbered(4), &[(0, 10)]));
    assert_eq!(
        all_told(&heard),
        ["UInt32(10), UInt32(20)"],
        "both were said since"
    );
    bench.hear(&delta(&numbered(6), &[(1, 21)]));
    let heard = bench.hear(&key_frame(&numbered(7), &[11, 22]));
    assert_eq!(all_told(&heard), ["UInt32(11), UInt32(22)"]);
    let heard = bench.hear(&delta(&numbered(8), &[(0, 12)]));
    assert_eq!(all_told(&heard), ["UInt32(12), UInt32(22)"]);

    let mut one = Bench::mapped("ua_2_5_10", "type: UInt32, ua_field: 1");
    one.hear(&key_frame(&numbered(1), &[1, 2]));
    let heard = one.hear(&delta(&numbered(3), &[(1, 20)]));
    assert_eq!(all_told(&heard), ["UInt32(20)"], "it is all that is taken");
    assert_eq!(one.hear(&delta(&numbered(5), &[(0, 10)])).len(), 0);
    assert_eq!(one.dropped(Reason::NoKeyFrame), 1);
}

#[test]
fn a_delta_frame_that_says_nothing_of_a_value_keeps_it_alive_and_is_no_sample() {
    let mut bench = Bench::mapped("ua_2_5_10", "type: UInt32, ua_field: 1");
    assert_eq!(bench.hear(&key_frame(&numbered(1), &[1, 2])).len(), 1);
    for sequence in 2..8 {
        bench.wait(Duration::from_secs(1));
        let heard = bench.hear(&delta(&numbered(sequence), &[(0, sequence.into())]));
        assert_eq!(heard.len(), 0);
    }
    assert_eq!(bench.dropped(Reason::Repeat), 6);
    bench.wait(Duration::from_secs(1));
    assert!(bench.outputs().is_empty(), "it is not silent");
}

#[test]
fn a_delta_frame_that_is_malformed_casts_doubt_on_all_fields() {
    let mut bench = Bench::zero_configuration();
    let unnumbered = DataSetHeader::default();
    bench.hear(&key_frame(&unnumbered, &[1, 2]));
    assert_eq!(bench.hear(&delta(&unnumbered, &[(2, 0)])).len(), 0);
    assert_eq!(bench.dropped(Reason::Malformed), 1, "there is no field 2");
    assert_eq!(bench.hear(&delta(&unnumbered, &[(0, 10)])).len(), 0);
    let heard = bench.hear(&delta(&unnumbered, &[(1, 20)]));
    assert_eq!(all_told(&heard), ["UInt32(10), UInt32(20)"]);
}

#[test]
fn the_data_values_of_open62541_and_asyncua_are_values() {
    let mut bench = Bench::zero_configuration();
    let heard = bench.hear(&vector("wire_datavalue_all"));
    let all = "Boolean(true), String(Some(\"cell\")), Double(2.5), Int32(20260517)";
    assert_eq!(all_told(&heard), [all]);

    let mut one = Bench::mapped("ua_2_1_1", "type: Double, ua_field: 2");
    let heard = one.hear(&vector("wire_datavalue_all"));
    assert_eq!(all_told(&heard), ["Double(2.5)"]);
    let source = heard[0].source.unwrap().time;
    assert_eq!(source, DateTime(0x01DD_7955_AA20_AD5A), "its own");

    let mut one = Bench::mapped("ua_1_100_1", "type: Double, ua_field: 0");
    let heard = one.hear(&vector("asyncua_datavalue"));
    assert_eq!(all_told(&heard), ["Double(2.5)"]);
    assert_eq!(heard[0].status, 0x4000, "Uncertain");
    let seconds = heard[0].source.unwrap().unix_nanos() / 1_000_000_000;
    assert_eq!(seconds, 1_779_019_200);
}

#[test]
fn a_data_value_without_a_value_is_its_status() {
    let bad = StatusCode(0x8034_0000);
    let frame = |values: &[DataValue<'_>]| {
        message(&DataSetHeader::default(), |message, header| {
            let mut frame = message.data_values(header).unwrap();
            for value in values {
                frame.value(value).unwrap();
            }
            frame.finish().unwrap();
        })
    };
    let away = DataValue {
        status: Some(bad),
        ..DataValue::default()
    };
    let doubtful = DataValue {
        value: Some(Scalar::UInt32(7).into()),
        ..away
    };
    let mut bench = Bench::zero_configuration();
    let heard = bench.hear(&frame(&[away]));
    assert_eq!(told(&heard[0]), format!("{:?}", Scalar::StatusCode(bad)));
    assert_eq!(heard[0].status, 0x8034);
    let heard = bench.hear(&frame(&[doubtful]));
    assert_eq!((&*told(&heard[0]), heard[0].status), ("UInt32(7)", 0x8034));
    let heard = bench.hear(&frame(&[doubtful, DataValue::default()]));
    let expected = format!("{:?}, null", Scalar::StatusCode(bad));
    assert_eq!((told(&heard[0]), heard[0].status), (expected, 0));
}

#[test]
fn raw_data_is_read_with_the_metadata_of_its_writer_and_no_other() {
    let topic = "ua_2_1_1";
    let fields = [("Speed", DOUBLE), ("Count", INT32)];
    let datagram = |sequence: u8| {
        let mut datagram = vector("wire_raw_numeric");
        let header = messages_of(&datagram)[0].header();
        assert_eq!(
            header,
            DataSetHeader {
                status: Some(0),
                ..numbered(0)
            }
        );
        datagram[11] = sequence;
        datagram
    };
    let mut bench = Bench::zero_configuration();
    assert_eq!(bench.hear(&datagram(1)).len(), 0);
    assert_eq!(bench.dropped(Reason::Undescribed), 1);
    bench.wait(Duration::from_secs(1));
    let asked = bench.outputs().into_iter();
    let asked: Vec<Output> = asked
        .filter(|output| matches!(output, Output::Discovery { .. }))
        .collect();
    assert_eq!(asked.len(), 1, "its writer is asked");
    bench.announce(topic, (1, STRANGER), &fields);
    assert_eq!(bench.hear(&datagram(2)).len(), 0, "a stranger said it");
    bench.announce(topic, (1, PEER), &fields);
    let heard = bench.hear(&datagram(3));
    assert_eq!(all_told(&heard), ["Double(2.5), Int32(20260517)"]);

    // An announcement of a stranger before the first message of the writer does not count for the
    // writer either.
    let mut bench = Bench::zero_configuration();
    bench.announce(topic, (1, STRANGER), &fields);
    assert_eq!(bench.hear(&datagram(4)).len(), 0);
    assert_eq!(bench.dropped(Reason::Undescribed), 1);

    let mut one = Bench::mapped(topic, "type: Int32, ua_field: Count");
    assert_eq!(one.hear(&datagram(5)).len(), 0, "a name says nothing yet");
    one.announce(topic, (1, PEER), &fields);
    assert_eq!(all_told(&one.hear(&datagram(6))), ["Int32(20260517)"]);
}

#[test]
fn raw_data_of_another_major_version_than_its_metadata_is_not_read() {
    let version = |major, sequence| DataSetHeader {
        major_version: Some(major),
        ..numbered(sequence)
    };
    let mut bench = Bench::zero_configuration();
    bench.announce("ua_2_5_10", (1, PEER), &[("Count", UINT32)]);
    assert_eq!(
        all_told(&bench.hear(&raw(&version(1, 1), &[7, 0, 0, 0]))),
        ["UInt32(7)"]
    );
    assert_eq!(bench.hear(&raw(&version(2, 2), &[7, 0, 0, 0])).len(), 0);
    assert_eq!(bench.dropped(Reason::Undescribed), 1);
    bench.announce("ua_2_5_10", (2, PEER), &[("Count", INT32)]);
    assert_eq!(
        all_told(&bench.hear(&raw(&version(2, 3), &[7, 0, 0, 0]))),
        ["Int32(7)"]
    );
    assert_eq!(bench.hear(&raw(&version(2, 4), &[7, 0])).len(), 0);
    assert_eq!(bench.dropped(Reason::Malformed), 1);
}

#[test]
fn raw_data_is_read_by_the_types_of_the_mapping_where_it_is_exactly_those() {
    let mut bench = Bench::mapped("ua_2_5_10", "type: Double");
    let heard = bench.hear(&raw(&numbered(1), &2.5_f64.to_le_bytes()));
    assert_eq!(all_told(&heard), ["Double(2.5)"]);
    // A second field of zeros would pass for padding.
    let two = [&2.5_f64.to_le_bytes()[..], &[0; 4]].concat();
    assert_eq!(bench.hear(&raw(&numbered(2), &two)).len(), 0);
    assert_eq!(bench.dropped(Reason::Mismatch), 1);

    let mut texts = Bench::mapped("ua_2_5_10", "type: 'String[]'");
    let heard = texts.hear(&raw(&numbered(1), b"\x02\0\0\0\x01\0\0\0a\x01\0\0\0b"));
    assert_eq!(
        all_told(&heard),
        ["[String(Some(\"a\")), String(Some(\"b\"))]"]
    );
}

#[test]
fn events_are_samples_each_and_never_repetitions() {
    let mut bench = Bench::zero_configuration();
    let heard = bench.hear(&vector("composite_event"));
    assert_eq!(all_told(&heard), ["Int32(900), String(Some(\"alarm\"))"]);
    let stamped = |sequence| DataSetHeader {
        timestamp: Some(DateTime(134_396_972_769_987_189)),
        picoseconds: Some(0),
        ..numbered(sequence)
    };
    let event = |sequence| {
        message(&stamped(sequence), |message, header| {
            let mut frame = message.event(header).unwrap();
            frame.scalar(Scalar::Boolean(true)).unwrap();
            frame.finish().unwrap();
        })
    };
    for sequence in 1..4 {
        let heard = bench.hear(&event(sequence));
        assert_eq!(all_told(&heard), ["Boolean(true)"]);
        assert_eq!(
            (heard[0].kept, heard[0].instance),
            (ValueRelation::Alone, None)
        );
    }
    assert_eq!(bench.hear(&event(3)).len(), 0, "the same datagram");
    assert_eq!(bench.dropped(Reason::Duplicate), 1);
}

#[test]
fn of_several_fields_a_ros_topic_gets_the_one_the_mapping_names() {
    let text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {5: 'urn:test'}\nvariables:\n  \
                - {node: ns=5;i=10, name: Speed, origin: 2, ua_field: 1,\n     \
                ros: {space: 1, topic: /speed, type: std_msgs/UInt32, field: data}}\n";
    let mapping = Mapping::from_yaml(text, "test.yaml").mapping.unwrap();
    let mut bench = Bench::new(1, Local::Ros1, mapping);
    let topic = "ua_2_5_10".parse().unwrap();
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let message_type = registry.get(&"std_msgs/UInt32".parse().unwrap()).unwrap();
    bench
        .router
        .bind(topic, &message_type, &Selection::Whole, bench.now)
        .unwrap();
    let heard = bench.hear(&key_frame(&numbered(1), &[1, 2, 3]));
    assert_eq!(heard[0].payload, [2, 0, 0, 0]);
    assert_eq!(bench.hear(&key_frame(&numbered(2), &[1])).len(), 0);
    assert_eq!(bench.dropped(Reason::Mismatch), 1, "there is no field 1");
    let heard = bench.hear(&delta(&numbered(3), &[(0, 9)]));
    assert_eq!(heard.len(), 0, "nor is there now");
}

#[test]
fn of_several_fields_the_one_that_bears_the_name_of_the_variable_is_taken() {
    let mut bench = Bench::mapped("ua_2_5_10", "type: UInt32");
    assert_eq!(
        all_told(&bench.hear(&key_frame(&numbered(1), &[1]))),
        ["UInt32(1)"]
    );
    bench
        .router
        .handle_datagram(&key_frame(&numbered(2), &[1, 2]), PEER, bench.now);
    let said = bench.outputs().into_iter().find_map(|output| match output {
        Output::Notice(notice) => Some(notice),
        _ => None,
    });
    let said = said.unwrap();
    assert_eq!(said.reason, Reason::Mismatch);
    assert!(said.detail.contains("`ua_field`"), "{}", said.detail);
    bench.announce(
        "ua_2_5_10",
        (1, PEER),
        &[("Count", UINT32), ("Speed", UINT32)],
    );
    let heard = bench.hear(&key_frame(&numbered(3), &[1, 2]));
    assert_eq!(all_told(&heard), ["UInt32(2)"]);
}

#[test]
fn a_key_frame_is_kept_for_delta_frames_up_to_its_size_and_that_of_all() {
    let text = vec![b'x'; 60_000];
    let text = std::str::from_utf8(&text).unwrap();
    let frame = |writer: u16, copies: usize| {
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            group: Some(GroupHeader {
                writer_group_id: Some(5),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let mut bytes = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut bytes, &network, Some(&[writer])).unwrap();
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        for _ in 0..copies {
            frame.scalar(Scalar::String(Some(text))).unwrap();
        }
        frame.finish().unwrap();
        message.finish().unwrap();
        let mut change = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut change, &network, Some(&[writer])).unwrap();
        let mut frame = message.delta_frame(&DataSetHeader::default()).unwrap();
        let field = frame.field(0).unwrap();
        field.scalar(Scalar::Boolean(true)).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        (bytes, change)
    };
    let mut bench = Bench::zero_configuration();
    let (large, change) = frame(1, 2);
    bench.hear(&large);
    assert_eq!(bench.hear(&change).len(), 0, "larger than is kept");
    assert_eq!(bench.dropped(Reason::NoKeyFrame), 1);
    let mut changes = Vec::new();
    for writer in 2..302 {
        let (whole, change) = frame(writer, 1);
        assert_eq!(bench.hear(&whole).len(), 1);
        changes.push(change);
    }
    assert_eq!(
        bench.hear(&changes[299]).len(),
        0,
        "there is no room for all"
    );
    assert_eq!(bench.hear(&changes[0]).len(), 1);
    // Writers that have never sent a delta frame make room when they become silent.
    bench.wait(Duration::from_secs(3));
    let (whole, change) = frame(301, 1);
    bench.hear(&whole);
    assert_eq!(bench.hear(&change).len(), 1);
}

#[test]
fn a_stamp_of_the_message_stands_where_its_value_has_none() {
    let stamp = DateTime(134_396_972_769_987_189);
    let header = DataSetHeader {
        timestamp: Some(stamp),
        ..numbered(1)
    };
    let mut bench = Bench::zero_configuration();
    let datagram = message(&header, |message, header| {
        let mut frame = message.data_values(header).unwrap();
        let value = Variant::from(Scalar::Double(1.5));
        frame.value(&value.into()).unwrap();
        frame.finish().unwrap();
    });
    let heard = bench.hear(&datagram);
    assert_eq!(heard[0].source.unwrap().time, stamp);
    let kind = Fields::parse(&heard[0].payload).unwrap().next().unwrap();
    assert_eq!(kind.unwrap().builtin_type(), Some(BuiltinType::Double));
}

#[test]
fn of_all_that_other_makers_send_only_some_is_not_supported() {
    let mut unsupported = Vec::new();
    let mut delivered = 0;
    let entries = std::fs::read_dir(vectors()).unwrap();
    let mut names: Vec<String> = entries
        .filter_map(|entry| {
            let name = entry.unwrap().file_name().into_string().unwrap();
            Some(name.strip_suffix(".hex")?.to_owned())
        })
        .collect();
    names.sort();
    for name in names {
        let mut bench = Bench::zero_configuration();
        let heard = bench.hear(&vector(&name)).len();
        let topics = bench.router.topics().map(|(_, counters)| counters);
        let drops = topics.chain([bench.router.others()]);
        let drops: Vec<(Reason, u64)> = drops.flat_map(|counters| counters.drops()).collect();
        let of_reason = |reason| drops.iter().any(|(each, _)| *each == reason);
        if of_reason(Reason::Unsupported) {
            unsupported.push(name);
        } else {
            delivered += usize::from(heard > 0);
        }
    }
    assert_eq!(unsupported, NOT_READ);
    assert!(delivered > 100, "{delivered}");
}

#[test]
fn another_field_may_be_taken_while_the_program_runs() {
    let mut bench = Bench::mapped("ua_2_5_10", "type: UInt32, ua_field: 0");
    let heard = bench.hear(&key_frame(&numbered(1), &[1, 2]));
    assert_eq!(all_told(&heard), ["UInt32(1)"]);
    let other = Bench::mapped("ua_2_5_10", "type: UInt32, ua_field: 1");
    let mapping = Arc::clone(other.router.mapping());
    bench.router.replace_mapping(mapping, bench.now);
    let heard = bench.hear(&delta(&numbered(2), &[]));
    assert_eq!(all_told(&heard), ["UInt32(2)"], "nothing was sent of it");
    let heard = bench.hear(&key_frame(&numbered(3), &[3, 4]));
    assert_eq!(all_told(&heard), ["UInt32(4)"]);
}

/// The vectors that are counted as unsupported: the secured messages.
const NOT_READ: [&str; 6] = [
    "wire_encrypt_aes128_r0",
    "wire_encrypt_aes128_r1",
    "wire_encrypt_aes128_r2",
    "wire_encrypt_aes256",
    "wire_encrypt_raw_aes128",
    "wire_sign_aes128",
];
