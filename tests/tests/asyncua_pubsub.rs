//! asyncua's PubSub and our codec in a single multicast group, in both directions.

use std::future::Future;
use std::time::{Duration, SystemTime};

use serde_json::{Value, json};
use system_tests::{Cell, Child, GROUP, Peer, SERVER_ENDPOINT, eventually};
use transport::{Udp, UdpOptions};
use uadp::{
    Array, BuiltinType, DataSetHeader, DataSetMessage, DataValue, DateTime, EncodeError,
    FieldEncoder, FieldEncoding, GroupHeader, Guid, LocalizedText, Matrix, MessageKind,
    NetworkHeader, NetworkMessage, NetworkMessageEncoder, NodeId, PublisherId, QualifiedName,
    Scalar, StatusCode, Timestamp, Variant,
};

const SOON: Duration = Duration::from_secs(20);
const PUBLISHER: u16 = 2;

/// 2026-05-17 12:34:56.789012 UTC, the timestamp of the values of `uadp_publish.py`.
const TIME: DateTime = DateTime(134_234_948_967_890_120);
/// A microsecond after `TIME`.
const LATER: DateTime = DateTime(TIME.0 + 10);
const GUID: Guid = Guid::from_fields(
    0x7296_2B91,
    0xFA75,
    0x4AE6,
    [0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D, 0xAF, 0x63],
);
const UNCERTAIN_SUB_NORMAL: StatusCode = StatusCode(0x4095_0000);

fn group() -> Udp {
    Udp::open(&UdpOptions {
        interface: Some("lo".to_owned()),
        ..UdpOptions::new(GROUP.into())
    })
    .unwrap()
}

fn run<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async { tokio::time::timeout(SOON, future).await.unwrap() })
}

/// Returns the next `count` datagrams of a WriterGroup of the publisher.
fn published(cell: &Cell, writer_group: u16, count: usize) -> Vec<Vec<u8>> {
    run(async {
        let mut group = group();
        let url = format!("opc.udp://{GROUP}");
        let publisher = cell.asyncua_started("uadp_publish.py", &[&url]);
        let _publisher = publisher.start();
        let mut taken = Vec::new();
        let mut buffer = vec![0; 65_536];
        while taken.len() < count {
            let (len, _) = group.recv(&mut buffer).await.unwrap();
            let datagram = &buffer[..len];
            let header = NetworkMessage::decode(datagram).unwrap().header();
            assert_eq!(header.publisher_id, Some(PublisherId::UInt16(PUBLISHER)));
            if header.group.unwrap().writer_group_id == Some(writer_group) {
                taken.push(datagram.to_vec());
            }
        }
        taken
    })
}

fn messages<'a>(message: &NetworkMessage<'a>) -> Vec<DataSetMessage<'a>> {
    message.messages().map(Result::unwrap).collect()
}

/// A value, with the elements of arrays read one by one.
#[derive(Debug, PartialEq)]
enum Read<'a> {
    Scalar(Scalar<'a>),
    Array(BuiltinType, Vec<Scalar<'a>>),
    Matrix(Vec<u32>, Vec<Scalar<'a>>),
}

impl<'a> From<Variant<'a>> for Read<'a> {
    fn from(variant: Variant<'a>) -> Self {
        match variant {
            Variant::Null => panic!("a null Variant"),
            Variant::Scalar(scalar) => Self::Scalar(scalar),
            Variant::Array(array) => Self::Array(array.element(), array.iter().collect()),
            Variant::Matrix(matrix) => Self::Matrix(
                matrix.dimensions().collect(),
                matrix.elements().iter().collect(),
            ),
        }
    }
}

fn read<'a>(message: &DataSetMessage<'a>) -> Vec<Read<'a>> {
    let fields = message.fields().unwrap();
    fields.map(|field| field.unwrap().into()).collect()
}

#[test]
fn several_data_set_messages_of_every_type_are_read_from_one_message_of_asyncua() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let datagrams = published(&cell, 5, 1);
    let message = NetworkMessage::decode(&datagrams[0]).unwrap();
    let header = message.group().unwrap();
    assert_eq!(
        (header.group_version, header.network_message_number),
        (Some(77), Some(1))
    );
    let ids: Vec<u16> = message.writer_ids().unwrap().collect();
    assert_eq!(ids, [10, 11]);

    let [scalars, arrays] = &messages(&message)[..] else {
        panic!("{message:?}");
    };
    assert_eq!((scalars.writer_id, arrays.writer_id), (Some(10), Some(11)));
    for one in [scalars, arrays] {
        assert_eq!(
            (one.kind, one.encoding()),
            (MessageKind::KeyFrame, FieldEncoding::Variant)
        );
        assert_eq!((one.header().valid, one.header().status), (true, Some(0)));
        assert_is_now(one.header().timestamp.unwrap());
    }
    assert_eq!(read(scalars), every_scalar().map(Read::Scalar));
    assert_eq!(read(arrays), every_array());
}

fn every_scalar() -> [Scalar<'static>; 21] {
    [
        Scalar::Boolean(true),
        Scalar::SByte(-8),
        Scalar::Byte(200),
        Scalar::Int16(-16_000),
        Scalar::UInt16(60_000),
        Scalar::Int32(-2_000_000_000),
        Scalar::UInt32(4_000_000_000),
        Scalar::Int64(i64::MIN),
        Scalar::UInt64(u64::MAX),
        Scalar::Float(-1.5),
        Scalar::Double(0.1),
        Scalar::String(Some("Grüße")),
        Scalar::String(None),
        Scalar::DateTime(TIME),
        Scalar::Guid(GUID),
        Scalar::ByteString(Some(&[0, 1, 0xFF])),
        Scalar::NodeId(NodeId::string(2, "Motor")),
        Scalar::NodeId(NodeId::numeric(300, 70_000)),
        Scalar::StatusCode(StatusCode(0x8034_0000)),
        Scalar::QualifiedName(QualifiedName {
            namespace: 2,
            name: Some("speed"),
        }),
        Scalar::LocalizedText(LocalizedText {
            locale: Some("de"),
            text: Some("Drehzahl"),
        }),
    ]
}

fn every_array() -> [Read<'static>; 9] {
    let texts = ["a", "", "ü"].map(|text| Scalar::String(Some(text)));
    let bytes: [&[u8]; 2] = [&[], &[1]];
    [
        Read::Array(
            BuiltinType::Boolean,
            [true, false, true].map(Scalar::Boolean).to_vec(),
        ),
        Read::Array(BuiltinType::Int32, [1, -2, 3].map(Scalar::Int32).to_vec()),
        Read::Array(
            BuiltinType::Double,
            [0.5, -0.5].map(Scalar::Double).to_vec(),
        ),
        Read::Array(BuiltinType::String, texts.to_vec()),
        Read::Array(
            BuiltinType::ByteString,
            bytes.map(|bytes| Scalar::ByteString(Some(bytes))).to_vec(),
        ),
        Read::Array(
            BuiltinType::DateTime,
            [TIME, LATER].map(Scalar::DateTime).to_vec(),
        ),
        Read::Array(BuiltinType::Guid, vec![Scalar::Guid(GUID)]),
        Read::Array(BuiltinType::UInt16, Vec::new()),
        Read::Matrix(vec![2, 3], [1, 2, 3, 4, 5, 6].map(Scalar::Int16).to_vec()),
    ]
}

fn assert_is_now(time: DateTime) {
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos();
    let age = i128::try_from(now).unwrap() - Timestamp::from(time).unix_nanos();
    assert!(
        (0..SOON.as_nanos().cast_signed()).contains(&age),
        "{age} ns"
    );
}

#[test]
fn the_sequence_numbers_of_asyncua_rise_by_one() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let numbers: Vec<[u16; 3]> = published(&cell, 5, 4)
        .iter()
        .map(|datagram| {
            let message = NetworkMessage::decode(datagram).unwrap();
            let of = |one: &DataSetMessage<'_>| one.header().sequence_number.unwrap();
            let [scalars, arrays] = &messages(&message)[..] else {
                panic!("{message:?}");
            };
            let network = message.group().unwrap().sequence_number.unwrap();
            [network, of(scalars), of(arrays)]
        })
        .collect();
    for pair in numbers.windows(2) {
        assert_eq!(pair[1], pair[0].map(|number| number + 1), "{numbers:?}");
    }
}

#[test]
fn data_values_of_asyncua_are_read_with_quality_and_times() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let datagrams = published(&cell, 6, 1);
    let message = NetworkMessage::decode(&datagrams[0]).unwrap();
    let [values] = &messages(&message)[..] else {
        panic!("{message:?}");
    };
    assert_eq!(values.encoding(), FieldEncoding::DataValue);
    assert_eq!(values.writer_id, Some(20));
    let numbers = [1, 0, 0, 0, 2, 0, 0, 0];
    let expected = [
        DataValue {
            status: Some(UNCERTAIN_SUB_NORMAL),
            source_timestamp: Some(TIME),
            server_timestamp: Some(LATER),
            ..Variant::Scalar(Scalar::Double(21.5)).into()
        },
        DataValue {
            source_timestamp: Some(TIME),
            ..Variant::Array(Array::new(BuiltinType::UInt32, 2, &numbers).unwrap()).into()
        },
        DataValue {
            status: Some(StatusCode::GOOD),
            ..Variant::Scalar(Scalar::String(Some("good"))).into()
        },
    ];
    let fields = values.values().unwrap().map(Result::unwrap);
    let (indexes, fields): (Vec<u16>, Vec<DataValue<'_>>) =
        fields.map(|field| (field.index, field.value)).unzip();
    assert_eq!(indexes, [0, 1, 2]);
    assert_eq!(fields, expected);
}

#[test]
fn raw_data_of_asyncua_is_left_as_its_bytes() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let datagrams = published(&cell, 7, 1);
    let message = NetworkMessage::decode(&datagrams[0]).unwrap();
    let [raw] = &messages(&message)[..] else {
        panic!("{message:?}");
    };
    assert_eq!(raw.encoding(), FieldEncoding::RawData);
    assert_eq!(raw.writer_id, Some(30));
    let bytes = [&7_i32.to_le_bytes()[..], &1.5_f64.to_le_bytes(), &GUID.0];
    assert_eq!(raw.payload(), bytes.concat());
    assert!(raw.values().is_err());
}

/// Starts asyncua's DataSetReaders of the writers 10 and 11 of our publisher's group 5.
fn subscriber(cell: &Cell) -> Child {
    let url = format!("opc.udp://{GROUP}");
    let publisher = PUBLISHER.to_string();
    let of = ["--publisher", &publisher, "--group", "5"];
    let writers = ["--writer", "10", "--writer", "11"];
    cell.asyncua("uadp_subscribe.py", &[&[&*url], &of[..], &writers].concat())
}

/// Writes a NetworkMessage for the DataSetWriters and sends it to the group.
fn publish(
    header: &NetworkHeader<'_>,
    writers: &[u16],
    write: impl FnOnce(&mut NetworkMessageEncoder<'_>) -> Result<(), EncodeError>,
) {
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, header, Some(writers)).unwrap();
    write(&mut message).unwrap();
    message.finish().unwrap();
    run(async { group().try_send(&datagram).unwrap() });
}

fn header() -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(PUBLISHER)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            sequence_number: Some(1),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    }
}

/// A header with a timestamp, which asyncua uses as the server timestamp of the fields.
fn data_set_header() -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(1),
        timestamp: Some(LATER),
        ..DataSetHeader::default()
    }
}

/// Returns the fields of the first DataSetMessage that the reader of the writer received, without
/// the fields named `left_out`.
fn taken(subscriber: &mut Child, writer: u16, left_out: &[&str]) -> Value {
    let what = format!("a DataSetMessage of {writer}");
    let mut fields = subscriber.wait_for_json(&what, SOON, |line| {
        (line.get("writer")? == writer).then(|| line["fields"].clone())
    });
    for field in fields.as_array_mut().unwrap() {
        let field = field.as_object_mut().unwrap();
        field.retain(|name, value| !value.is_null() || name == "value");
        left_out.iter().for_each(|name| drop(field.remove(*name)));
    }
    fields
}

#[test]
fn asyncua_reads_every_type_from_several_data_set_messages_of_ours() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut subscriber = subscriber(&cell);
    publish(&header(), &[10, 11], |message| {
        let mut scalars = message.key_frame(&data_set_header())?;
        for scalar in &every_scalar()[..16] {
            scalars.scalar(*scalar)?;
        }
        // asyncua truncates the time to microseconds.
        scalars.scalar(Scalar::DateTime(DateTime(TIME.0 + 9)))?;
        scalars.finish()?;
        let mut arrays = message.key_frame(&data_set_header())?;
        write_arrays(&mut arrays)?;
        arrays.finish()
    });
    let quality = ["name", "status", "server"];
    let scalars = taken(&mut subscriber, 10, &quality);
    let time = "2026-05-17T12:34:56.789012+00:00";
    let guid = "72962b91-fa75-4ae6-8d28-b404dc7daf63";
    let expected = [
        ("Boolean", json!(true)),
        ("SByte", json!(-8)),
        ("Byte", json!(200)),
        ("Int16", json!(-16_000)),
        ("UInt16", json!(60_000)),
        ("Int32", json!(-2_000_000_000)),
        ("UInt32", json!(4_000_000_000_u32)),
        ("Int64", json!(i64::MIN)),
        ("UInt64", json!(u64::MAX)),
        ("Float", json!(-1.5)),
        ("Double", json!(0.1)),
        ("String", json!("Grüße")),
        ("String", Value::Null),
        ("DateTime", json!(time)),
        ("Guid", json!(guid)),
        ("ByteString", json!("AAH/")),
        ("DateTime", json!(time)),
    ];
    assert_eq!(scalars, described(expected));
    let expected = [
        ("Boolean", json!([true, false])),
        ("Int32", json!([1, -2, 3])),
        ("Double", json!([0.5, -0.5])),
        ("String", json!(["a", "", "ü"])),
        ("ByteString", json!(["", "AQ=="])),
        ("DateTime", json!([time])),
        ("Guid", json!([guid])),
        ("UInt16", json!([])),
    ];
    let mut arrays = taken(&mut subscriber, 11, &quality);
    let matrix = arrays.as_array_mut().unwrap().pop().unwrap();
    assert_eq!(arrays, described(expected));
    let expected = json!({"type": "Int16", "dimensions": [2, 3], "value": [[1, 2, 3], [4, 5, 6]]});
    assert_eq!(matrix, expected);
}

fn described<const N: usize>(fields: [(&str, Value); N]) -> Value {
    fields
        .map(|(kind, value)| json!({"type": kind, "value": value}))
        .into_iter()
        .collect()
}

fn write_arrays(fields: &mut FieldEncoder<'_>) -> Result<(), EncodeError> {
    fields.packed_array(BuiltinType::Boolean, 2, &[1, 0])?;
    fields.array(BuiltinType::Int32, 3)?;
    for value in [1, -2, 3] {
        fields.element(Scalar::Int32(value))?;
    }
    let doubles = [0.5_f64, -0.5].map(f64::to_le_bytes);
    fields.packed_array(BuiltinType::Double, 2, doubles.as_flattened())?;
    fields.array(BuiltinType::String, 3)?;
    for value in ["a", "", "ü"] {
        fields.element(Scalar::String(Some(value)))?;
    }
    fields.array(BuiltinType::ByteString, 2)?;
    fields.element(Scalar::ByteString(Some(&[])))?;
    fields.element(Scalar::ByteString(Some(&[1])))?;
    fields.packed_array(BuiltinType::DateTime, 1, &TIME.0.to_le_bytes())?;
    fields.packed_array(BuiltinType::Guid, 1, &GUID.0)?;
    fields.packed_array(BuiltinType::UInt16, 0, &[])?;
    let numbers = [1_i16, 2, 3, 4, 5, 6].map(i16::to_le_bytes);
    let dimensions = [2_i32, 3].map(i32::to_le_bytes);
    let elements = Array::new(BuiltinType::Int16, 6, numbers.as_flattened()).unwrap();
    fields.variant(&Matrix::new(elements, &dimensions).unwrap().into())
}

#[test]
fn asyncua_reads_the_status_and_time_of_our_data_set_messages() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut subscriber = subscriber(&cell);
    publish(&header(), &[10], |message| {
        let mut fields = message.key_frame(&DataSetHeader {
            status: Some(UNCERTAIN_SUB_NORMAL.status()),
            major_version: Some(3),
            minor_version: Some(4),
            ..data_set_header()
        })?;
        fields.scalar(Scalar::Double(21.5))?;
        fields.finish()
    });
    assert_eq!(
        taken(&mut subscriber, 10, &[]),
        json!([{"name": "field 0", "type": "Double", "value": 21.5, "status": UNCERTAIN_SUB_NORMAL.0,
                "server": "2026-05-17T12:34:56.789013+00:00"}])
    );
}

#[test]
fn asyncua_reads_our_data_values_and_delta_frames() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut subscriber = subscriber(&cell);
    let value = DataValue {
        status: Some(UNCERTAIN_SUB_NORMAL),
        source_timestamp: Some(TIME),
        server_timestamp: Some(LATER),
        ..Variant::Scalar(Scalar::Double(21.5)).into()
    };
    let described = json!({"type": "Double", "value": 21.5, "status": UNCERTAIN_SUB_NORMAL.0,
                           "source": "2026-05-17T12:34:56.789012+00:00",
                           "server": "2026-05-17T12:34:56.789013+00:00"});
    let named = |name: &str| {
        let mut named = described.clone();
        named["name"] = json!(name);
        named
    };
    publish(&header(), &[10, 11], |message| {
        let mut fields = message.data_values(&data_set_header())?;
        fields.value(&value)?;
        fields.finish()?;
        let mut fields = message.delta_data_values(&data_set_header())?;
        fields.changed(7, &value)?;
        fields.finish()
    });
    assert_eq!(taken(&mut subscriber, 10, &[]), json!([named("field 0")]));
    assert_eq!(taken(&mut subscriber, 11, &[]), json!([named("field 7")]));
}

#[test]
fn asyncua_reads_the_changed_fields_of_our_delta_frames() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut subscriber = subscriber(&cell);
    publish(&header(), &[11], |message| {
        let mut fields = message.delta_frame(&data_set_header())?;
        fields.field(3)?.scalar(Scalar::Boolean(true))?;
        fields.field(1)?.scalar(Scalar::String(Some("changed")))?;
        fields.finish()
    });
    assert_eq!(
        taken(&mut subscriber, 11, &["status", "server"]),
        json!([{"name": "field 3", "type": "Boolean", "value": true},
               {"name": "field 1", "type": "String", "value": "changed"}])
    );
}

#[test]
fn asyncua_takes_our_messages_by_publisher_group_and_writer() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut subscriber = subscriber(&cell);
    let byte = |publisher_id, writer_group_id, writer, value| {
        let header = NetworkHeader {
            publisher_id: Some(publisher_id),
            group: Some(GroupHeader {
                writer_group_id: Some(writer_group_id),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        publish(&header, &[writer], |message| {
            let mut fields = message.key_frame(&DataSetHeader::default())?;
            fields.scalar(Scalar::Byte(value))?;
            fields.finish()
        });
    };
    let ours = PublisherId::UInt16(PUBLISHER);
    byte(PublisherId::UInt16(3), 5, 10, 1);
    byte(PublisherId::UInt32(PUBLISHER.into()), 5, 10, 2);
    byte(PublisherId::String("2"), 5, 10, 3);
    byte(ours, 6, 10, 4);
    byte(ours, 5, 12, 5);
    byte(ours, 5, 10, 6);
    // The last sent message is received last, so no message before it was accepted.
    let fields = taken(&mut subscriber, 10, &["name", "status", "server"]);
    assert_eq!(fields, json!([{"type": "Byte", "value": 6}]));
    let lines = subscriber.json_lines();
    assert_eq!(lines.len(), 2, "ready and one DataSetMessage: {lines:?}");
}

#[test]
fn one_of_several_data_values_of_asyncua_is_shown_by_the_server_with_its_quality() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file(
        "values.yaml",
        "spaces: [{id: 2}]\nnamespaces: {6: 'urn:ua-bridge:system-tests'}\nvariables:\n  \
         - {node: ns=6;i=20, name: Temperature, type: Double, origin: 2, ua_field: 0}\n",
    );
    let url = format!("opc.udp://{GROUP}");
    let publisher = cell.asyncua_started("uadp_publish.py", &[&url]);
    let _publisher = publisher.start();
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let mut watch = cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, "ns=6;i=20"]);
    watch.wait_for_json("the value of asyncua", SOON, |line| {
        let shown = line.get("status")? == "UncertainSubNormal" && line["value"] == json!(21.5);
        shown.then_some(())
    });
}
