//! The OPC UA server with values that are large, structured, or missing: datagrams of the tests on
//! one side, asyncua on the other.

mod certificates;
mod sources;

use std::time::{Duration, Instant, SystemTime};

use serde_json::{Value, json};
use system_tests::{
    Cell, Child, METRICS_SERVER, Peer, SERVER_ENDPOINT, UadpSocket, eventually, metrics, number,
    peak, resident,
};
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, Extras, FieldEncoder, GroupHeader, NetworkHeader,
    NetworkMessage, NetworkMessageEncoder, NetworkMessageType, NodeId, PublisherId, Reassembler,
    ReassemblyLimits, Scalar, Timestamp, Variant, Whole,
};

const SOON: Duration = Duration::from_secs(20);

/// Ordered neither by number nor by name.
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=40, name: map, type: 'SByte[]', origin: 2}
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
  - {node: ns=2;i=51, name: goal, origin: 2, ros: {topic: /goal, type: geometry_msgs/Pose, as: structure}}
  - {node: ns=2;i=50, name: poses, origin: 2, ros: {topic: /poses, type: geometry_msgs/PoseArray}}
  - {node: ns=2;i=30, name: program, type: ByteString, origin: 0}
";

fn server(cell: &Cell) -> Child {
    let mapping = cell.file("values.yaml", MAPPING);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    server
}

/// Returns the result of a Read of the node's value.
fn read(cell: &Cell, arguments: &[&str]) -> Value {
    let arguments = [&[SERVER_ENDPOINT], arguments].concat();
    cell.asyncua_once("opcua_read.py", &arguments).remove(0)
}

/// Waits for a notification with that status and value.
fn shows(watch: &mut Child, status: &str, value: &Value) {
    watch.wait_for_json(&format!("{value} as {status}"), SOON, |line| {
        (line.get("status")? == status && line["value"] == *value).then_some(())
    });
}

fn header() -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    }
}

fn data_set_header(sequence: u16) -> DataSetHeader {
    let since = SystemTime::UNIX_EPOCH.elapsed().unwrap();
    let now = Timestamp::from_unix_nanos(i128::try_from(since.as_nanos()).unwrap());
    DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(now.time),
        ..DataSetHeader::default()
    }
}

/// Encodes a key frame of space 2 with the fields that `write` writes.
fn key_frame(writer: u16, sequence: u16, write: impl FnOnce(&mut FieldEncoder<'_>)) -> Vec<u8> {
    let mut datagram = Vec::new();
    let header = header();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[writer])).unwrap();
    let mut fields = message.key_frame(&data_set_header(sequence)).unwrap();
    write(&mut fields);
    fields.finish().unwrap();
    message.finish().unwrap();
    datagram
}

/// Sends an array of space 2 in the chunks that a writer makes of it.
fn send_array(group: &UadpSocket, writer: u16, sequence: u16, elements: &[u8]) {
    let mut encoded = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut encoded, &NetworkHeader::default(), None).unwrap();
    let mut fields = message.key_frame(&data_set_header(sequence)).unwrap();
    let count = elements.len();
    fields
        .packed_array(uadp::BuiltinType::SByte, count, elements)
        .unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(writer),
        message_sequence_number: sequence,
        bytes: &encoded[1..],
    };
    let budget = ChunkBudget {
        network_message: 65_507,
        trailer: 0,
    };
    let (header, extras) = (header(), Extras::default());
    let mut chunks = ChunkEncoder::new(&header, &extras, whole, budget).unwrap();
    let mut datagram = Vec::new();
    while let Some(written) = chunks.append(&mut datagram, &extras) {
        written.unwrap();
        group.send(&datagram);
        datagram.clear();
        // Paced like a sender, because a socket buffer is smaller than the array.
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_large_array_takes_up_no_more_than_three_times_its_size_and_can_be_read_by_parts() {
    const SIZE: usize = 8 << 20;
    /// Memory for the connections of clients.
    const CLIENTS: u64 = 4 << 20;
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let server = server(&cell);
    let group = UadpSocket::join();
    let before = resident(server.id());
    let mut elements = vec![0; SIZE];
    elements[SIZE - 3..].copy_from_slice(&[7, 8, 9]);
    let last = format!("{}:{}", SIZE - 3, SIZE - 1);
    // The second value replaces the first. A busy machine may lose a chunk: the received chunks of
    // such a value use memory until the value is discarded.
    let (mut sequence, mut lost, mut came) = (0, 0, 0);
    while came < 2 {
        sequence += 1;
        send_array(&group, 40, sequence, &elements);
        (came, lost) = eventually("it comes, or is given up", SOON, || {
            let status = metrics(METRICS_SERVER)?;
            let now = (number(&status, "delivered"), number(&status, "incomplete"));
            (now != (came, lost)).then_some(now)
        });
        assert!(sequence < 10, "{lost} were given up");
    }
    let shown = read(&cell, &["--range", &last, "ns=2;i=40"]);
    assert_eq!(shown["value"], json!([7, 8, 9]));
    let held = resident(server.id()) - before;
    let most = peak(server.id()) - before;
    println!("an array of {SIZE} bytes: {held} more bytes, {most} at the most, {lost} lost");
    let bound = (3 + lost) * SIZE as u64 + CLIENTS;
    assert!(most < bound, "{most} bytes");
    let whole = read(&cell, &["ns=2;i=40"]);
    assert_eq!(whole["status"], "BadResponseTooLarge");
    let most = peak(server.id()) - before;
    assert!(most < bound, "{most} bytes for reading it");
}

#[test]
fn thirty_thousand_variables_are_served_and_the_last_of_them_gets_its_value() {
    const MANY: u32 = 30_000;
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let entries: String = (1..=MANY)
        .map(|n| format!("  - {{node: ns=2;i={n}, name: v{n}, type: Double, origin: 2}}\n"))
        .collect();
    let text = format!(
        "namespaces: {{2: 'urn:ua-bridge:system-tests'}}\nspaces: [{{id: 2}}]\nvariables:\n{entries}"
    );
    let mapping = cell.file("many.yaml", &text);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let last = format!("ns=2;i={MANY}");
    let wait = Duration::from_secs(60);
    let status = |wanted: &str| {
        let shown = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, &last])?;
        (shown.first()?["status"] == wanted).then(|| shown[0]["value"].clone())
    };
    eventually("the last one waits for its value", wait, || {
        status("BadWaitingForInitialData")
    });
    let group = UadpSocket::join();
    let writer = u16::try_from(MANY).unwrap();
    let mut sequence = 0;
    let value = eventually("the last one has its value", wait, || {
        sequence += 1;
        group.send(&key_frame(writer, sequence, |fields| {
            fields.scalar(Scalar::Double(30.5)).unwrap();
        }));
        status("Good")
    });
    assert_eq!(value, json!(30.5));
    let below = ["--children", "--nameless", "ns=1;s=UaSpace.2"];
    let below = read(&cell, &below)["children"].clone();
    let below = below.as_array().unwrap();
    assert_eq!(below.len(), usize::try_from(MANY).unwrap());
    assert_eq!(below[0], "ns=2;i=1");
    assert_eq!(below[below.len() - 1], json!(last));
    let held = resident(server.id());
    assert!(held < 700 << 20, "{held} bytes");
}

#[test]
fn a_value_whose_messages_are_all_dropped_is_not_good_until_a_value_comes() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let mut watch = cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, "ns=2;i=10"]);
    let sequence = std::cell::Cell::new(0);
    let next = || {
        sequence.set(sequence.get() + 1);
        sequence.get()
    };
    let frame = |values: &[Scalar<'_>]| {
        key_frame(10, next(), |fields| {
            for value in values {
                fields.scalar(*value).unwrap();
            }
        })
    };
    let double = Scalar::Double;
    group.send(&frame(&[Scalar::Boolean(true)]));
    shows(&mut watch, "BadTypeMismatch", &Value::Null);
    for (value, misfit) in [
        // A value of another type, and a value with an additional field.
        (21.5, &[Scalar::String(Some("warm"))][..]),
        (22.5, &[double(1.0), double(2.0)][..]),
    ] {
        group.send(&frame(&[double(value)]));
        shows(&mut watch, "Good", &json!(value));
        group.send(&frame(misfit));
        shows(&mut watch, "BadTypeMismatch", &Value::Null);
    }
    group.send(&frame(&[double(23.5)]));
    shows(&mut watch, "Good", &json!(23.5));
    // Undecodable values arrive all the time.
    let start = Instant::now();
    let fell = eventually("the value falls", SOON, || {
        let mut cut_off = frame(&[double(4.0)]);
        cut_off.truncate(cut_off.len() - 2);
        group.send(&cut_off);
        let last = watch.json_lines().pop()?;
        (last["status"] == "UncertainLastUsableValue").then_some(last["value"].clone())
    });
    assert_eq!(fell, json!(23.5));
    assert!(start.elapsed() > Duration::from_secs(2));
    group.send(&frame(&[double(24.5)]));
    shows(&mut watch, "Good", &json!(24.5));
    let good: Vec<Value> = watch
        .json_lines()
        .into_iter()
        .filter(|line| line.get("status").is_some_and(|status| status == "Good"))
        .map(|line| line["value"].clone())
        .collect();
    assert_eq!(good, [21.5, 22.5, 23.5, 24.5], "none of them twice");
}

#[test]
fn a_client_writes_a_megabyte_and_it_leaves_in_chunks() {
    const SIZE: usize = 1 << 20;
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let size = SIZE.to_string();
    let arguments = [SERVER_ENDPOINT, "ns=2;i=30", "ByteString", "--zeros", &size];
    let answer = cell.asyncua_once("opcua_write.py", &arguments);
    assert_eq!(answer[0]["status"], "Good");
    let mut reassembler = Reassembler::new(ReassemblyLimits::default());
    let start = Instant::now();
    let length = eventually("all chunks", SOON, || {
        let datagram = group.receive(Duration::from_millis(100))?;
        let message = NetworkMessage::decode(&datagram).unwrap();
        if !message.is_chunk() {
            return None;
        }
        let whole = reassembler.receive(&message, start.elapsed()).unwrap()?;
        let message = whole.data_set_message().unwrap();
        match message.fields().unwrap().next() {
            Some(Ok(Variant::Scalar(Scalar::ByteString(Some(bytes))))) => Some(bytes.len()),
            other => panic!("{other:?}"),
        }
    });
    assert_eq!(length, SIZE);
    let read = read(&cell, &["--range", "1048570:2000000", "ns=2;i=30"]);
    assert_eq!(read["value"], "AAAAAAAA", "its last six bytes");
}

/// Encodes a geometry_msgs/Pose at `x` as a structure.
fn pose(fields: &mut FieldEncoder<'_>, x: f64) {
    fields
        .begin_structure(NodeId::string(2, "geometry_msgs/Pose"))
        .unwrap();
    for value in [x, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0] {
        fields.scalar(Scalar::Double(value)).unwrap();
    }
    fields.end_structure().unwrap();
}

#[test]
fn a_client_reads_structures_by_the_definitions_the_server_has() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let poses = key_frame(50, 1, |fields| {
        fields.scalar(Scalar::DateTime(uadp::DateTime(0))).unwrap();
        fields.scalar(Scalar::String(Some("map"))).unwrap();
        fields.structures(2).unwrap();
        pose(fields, 1.5);
        pose(fields, -2.0);
    });
    let nodes = ["ns=2;i=51", "ns=2;s=50.poses"];
    eventually("both are there", SOON, || {
        group.send(&poses);
        group.send(&key_frame(51, 1, |fields| pose(fields, 4.0)));
        let shown = cell.asyncua_once("opcua_read.py", &[&[SERVER_ENDPOINT], &nodes[..]].concat());
        shown
            .iter()
            .all(|one| one["status"] == "Good")
            .then_some(())
    });
    let arguments = [&[SERVER_ENDPOINT], &nodes[..]].concat();
    let found = cell.asyncua_once("opcua_structures.py", &arguments);
    let orientation = json!({"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0});
    let pose =
        |x: f64| json!({"position": {"x": x, "y": 0.0, "z": 0.5}, "orientation": orientation});
    assert_eq!(found[0]["value"], pose(4.0));
    assert_eq!(found[1]["value"], json!([pose(1.5), pose(-2.0)]));
    for one in &found {
        assert_eq!(one["type"], "geometry_msgs_Pose");
        assert_eq!(one["data_type"], "ns=2;s=DataType.geometry_msgs/Pose");
        let encodings = json!({"Default Binary": "ns=2;s=geometry_msgs/Pose"});
        assert_eq!(one["encodings"], encodings);
    }
    // The variables in the order of the mapping, the fields in the order of the message.
    let below = |node| read(&cell, &["--children", node])["children"].clone();
    assert_eq!(
        below("ns=1;s=UaSpace.2"),
        json!(["ns=2;i=40", "ns=2;i=10", "ns=2;i=51", "ns=2;i=50"])
    );
    assert_eq!(
        below("ns=2;i=50"),
        json!([
            "ns=2;s=50.header.stamp",
            "ns=2;s=50.header.frame_id",
            "ns=2;s=50.poses"
        ])
    );
}
