//! The OPC UA server alone: datagrams of the tests on one side, asyncua on the other.

mod access;
mod alarms;
mod authorities;
mod configuration;
pub(crate) mod confirm;
mod crowd;
mod events;
mod folders;
mod history;
mod identity;
mod malformed;
mod nodesets;
mod pubsub;
mod quality;
mod redundant;
mod reverse;
mod services;
mod strangers;

use std::{
    fs,
    time::{Duration, Instant, SystemTime},
};

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, UadpSocket, eventually};
use uadp::{
    DataSetHeader, GroupHeader, MessageKind, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    NetworkMessageType, PublisherId, Scalar, Timestamp, Variant,
};

const SOON: Duration = Duration::from_secs(20);

/// Values of a robot in space 2, and two values of the server itself.
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
server:
  security: [None, Basic256Sha256]
";

fn server(cell: &Cell) -> Child {
    serving(cell, MAPPING)
}

fn serving(cell: &Cell, mapping: &str) -> Child {
    let mapping = cell.file("server.yaml", mapping);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    server
}

/// Returns the result of a Read of the node's value.
fn read(cell: &Cell, node: &str) -> Value {
    cell.asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, node])
        .remove(0)
}

fn write(cell: &Cell, node: &str, kind: &str, value: &str) -> Value {
    cell.asyncua_once("opcua_write.py", &[SERVER_ENDPOINT, node, kind, value])[0]["status"].clone()
}

/// Starts a client that subscribes to the node.
fn watch(cell: &Cell, node: &str) -> Child {
    cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, node])
}

/// Waits for a notification with that status and value.
fn shows(watch: &mut Child, status: &str, value: &Value) {
    watch.wait_for_json(&format!("{value} as {status}"), SOON, |line| {
        (line.get("status")? == status && line["value"] == *value).then_some(())
    });
}

fn now() -> Timestamp {
    let since = SystemTime::UNIX_EPOCH.elapsed().unwrap();
    Timestamp::from_unix_nanos(i128::try_from(since.as_nanos()).unwrap())
}

/// Encodes a key frame with a single Double, as a publisher sends it.
fn key_frame(triple: (u16, u16, u16), sequence: u16, value: f64, more: DataSetHeader) -> Vec<u8> {
    let mut datagram = Vec::new();
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(triple.0)),
        group: Some(GroupHeader {
            writer_group_id: Some(triple.1),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut message =
        NetworkMessageEncoder::new(&mut datagram, &header, Some(&[triple.2])).unwrap();
    let header = DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: more.timestamp.or_else(|| Some(now().time)),
        ..more
    };
    let mut fields = message.key_frame(&header).unwrap();
    fields.scalar(Scalar::Double(value)).unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    datagram
}

const TEMPERATURE: (u16, u16, u16) = (2, 2, 10);
const TEMPERATURE_NODE: &str = "ns=2;i=10";

#[test]
fn a_client_that_is_not_trusted_is_refused_and_the_log_says_which_file_to_move() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut server = server(&cell);
    let certificates = cell.folder().join("client");
    let arguments = [
        SERVER_ENDPOINT,
        "--security",
        "Basic256Sha256",
        "--certificates",
        certificates.to_str().unwrap(),
        TEMPERATURE_NODE,
    ];
    let refused = cell.asyncua_started("opcua_read.py", &arguments).start();
    let refused = ended(refused);
    assert!(refused.contains("BadCertificateUntrusted"), "{refused}");

    let told = server.wait_for_line("certificate is not trusted", SOON);
    let rejected = only_file(&cell.folder().join("pki/rejected"));
    let trusted = cell.folder().join("pki/trusted");
    assert!(told.contains(rejected.to_str().unwrap()), "{told}");
    assert!(told.contains(trusted.to_str().unwrap()), "{told}");

    fs::rename(&rejected, trusted.join(rejected.file_name().unwrap())).unwrap();
    let answer = cell.asyncua_once("opcua_read.py", &arguments);
    assert_eq!(answer[0]["status"], "BadWaitingForInitialData");
}

/// Returns the output of a client that was refused.
fn ended(mut client: Child) -> String {
    let status = client.wait_for_end(SOON);
    assert!(!status.success(), "{status}");
    client.lines().join("\n")
}

fn only_file(folder: &std::path::Path) -> std::path::PathBuf {
    let mut files = fs::read_dir(folder).unwrap();
    let file = files.next().unwrap().unwrap().path();
    assert!(files.next().is_none(), "more than {file:?}");
    file
}

#[test]
fn a_value_waits_for_its_first_sample_and_then_has_the_time_of_its_source() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let before = read(&cell, TEMPERATURE_NODE);
    assert_eq!(before["status"], "BadWaitingForInitialData");
    assert_eq!(before["value"], Value::Null);

    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let taken = Timestamp::from_unix_nanos(1_700_000_000_123_456_000);
    let header = DataSetHeader {
        timestamp: Some(taken.time),
        ..DataSetHeader::default()
    };
    UadpSocket::join().send(&key_frame(TEMPERATURE, 1, 21.5, header));
    shows(&mut watch, "Good", &json!(21.5));
    let after = read(&cell, TEMPERATURE_NODE);
    assert_eq!(after["type"], "Double");
    let source = after["source_timestamp"].as_str().unwrap();
    assert!(source.starts_with("2023-11-14T22:13:20.123456"), "{source}");
    assert_ne!(after["server_timestamp"], after["source_timestamp"]);
}

#[test]
fn a_silent_writer_leaves_an_uncertain_value_that_is_good_again_when_it_speaks() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let group = UadpSocket::join();
    group.send(&key_frame(TEMPERATURE, 1, 21.5, DataSetHeader::default()));
    shows(&mut watch, "Good", &json!(21.5));
    let spoke = Instant::now();
    shows(&mut watch, "UncertainLastUsableValue", &json!(21.5));
    assert!(
        spoke.elapsed() > Duration::from_secs(2),
        "{:?}",
        spoke.elapsed()
    );
    group.send(&key_frame(TEMPERATURE, 2, 22.5, DataSetHeader::default()));
    shows(&mut watch, "Good", &json!(22.5));
}

#[test]
fn a_subscriber_is_told_what_comes_after_the_clock_of_a_publisher_was_set_back() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let group = UadpSocket::join();
    let hour = 36_000_000_000;
    let at = |shift: i64| DataSetHeader {
        timestamp: Some(uadp::DateTime(now().time.0 + shift)),
        ..DataSetHeader::default()
    };
    // With the present time, an hour ahead, with the present time again, and an hour behind.
    for (sequence, shift, value) in [
        (1, 0, 20.0),
        (2, hour, 21.0),
        (3, 0, 22.0),
        (4, -hour, 23.0),
        (5, -hour, 24.0),
    ] {
        let header = at(shift);
        let of_day = header.timestamp.map(|sent| (sent.0 / hour) % 24);
        group.send(&key_frame(TEMPERATURE, sequence, value, header));
        watch.wait_for_json(&format!("{value} of hour {of_day:?}"), SOON, |line| {
            let told = line["source_timestamp"].as_str()?.get(11..13)?;
            let is_it = line["status"] == "Good" && line["value"] == value;
            (is_it && told.parse().ok() == of_day).then_some(())
        });
    }
}

#[test]
fn the_status_of_a_data_set_message_is_that_of_the_value() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    // UncertainSubNormal, 0x40950000: a DataSetMessage has the upper half.
    let header = DataSetHeader {
        status: Some(0x4095),
        ..DataSetHeader::default()
    };
    UadpSocket::join().send(&key_frame(TEMPERATURE, 1, 21.5, header));
    shows(&mut watch, "UncertainSubNormal", &json!(21.5));
}

#[test]
fn a_clients_write_leaves_as_a_key_frame_of_the_nodes_topic() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "3.25"), "Good");
    let written = eventually("a key frame", SOON, || {
        written(&group.receive(Duration::from_millis(100))?)
    });
    assert_eq!(written, ((0, 2, 30), vec![3.25]));
    assert_eq!(read(&cell, "ns=2;i=30")["value"], 3.25);
}

/// Returns the triple and the Doubles of a key frame; `None` for another message.
fn written(datagram: &[u8]) -> Option<((u16, u16, u16), Vec<f64>)> {
    let message = NetworkMessage::decode(datagram).unwrap();
    if message.message_type() != NetworkMessageType::DataSet {
        return None;
    }
    let header = message.header();
    let Some(PublisherId::UInt16(publisher)) = header.publisher_id else {
        panic!("{header:?}");
    };
    let group = header.group.unwrap().writer_group_id.unwrap();
    let data_set = message.messages().next().unwrap().unwrap();
    if data_set.kind != MessageKind::KeyFrame {
        return None;
    }
    let values = data_set
        .fields()
        .unwrap()
        .map(|field| match field.unwrap() {
            Variant::Scalar(Scalar::Double(value)) => value,
            other => panic!("{other:?}"),
        })
        .collect();
    Some(((publisher, group, data_set.writer_id.unwrap()), values))
}

#[test]
fn what_may_not_be_written_is_refused_and_changes_nothing() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    assert_eq!(
        write(&cell, TEMPERATURE_NODE, "Double", "1.0"),
        "BadNotWritable"
    );
    assert_eq!(
        write(&cell, "ns=2;i=30", "String", "\"warm\""),
        "BadTypeMismatch"
    );
    assert_eq!(
        write(&cell, "ns=2;i=31", "Double", "1.0"),
        "BadNodeIdUnknown"
    );
    for node in [TEMPERATURE_NODE, "ns=2;i=30"] {
        assert_eq!(read(&cell, node)["status"], "BadWaitingForInitialData");
    }
    let sent = group.receive_for(Duration::from_millis(100));
    assert!(
        sent.iter().all(|datagram| written(datagram).is_none()),
        "{sent:?}"
    );
}

#[test]
fn a_topic_the_mapping_does_not_name_appears_under_unmapped() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let folder = [SERVER_ENDPOINT, "--children", "ns=1;s=UaSpace.Unmapped"];
    let children = || cell.asyncua_once("opcua_read.py", &folder)[0]["children"].clone();
    assert_eq!(children(), json!([]));
    // A topic of another space, and a topic of a component in the server's own space.
    for triple in [(2, 7, 77), (0, 7, 101)] {
        group.send(&key_frame(triple, 1, 4.5, DataSetHeader::default()));
    }
    let wanted = json!(["ns=1;s=ua_0_7_101", "ns=1;s=ua_2_7_77"]);
    let mut found = eventually("the topics are shown", SOON, || {
        Some(children()).filter(|found| found.as_array().map(Vec::len) == Some(2))
    });
    if let Value::Array(found) = &mut found {
        found.sort_by_key(Value::to_string);
    }
    assert_eq!(found, wanted);
    for node in ["ns=1;s=ua_0_7_101", "ns=1;s=ua_2_7_77"] {
        let value = read(&cell, node);
        assert_eq!(
            (&value["type"], &value["value"]),
            (&json!("Double"), &json!(4.5))
        );
    }
    let component = write(&cell, "ns=1;s=ua_0_7_101", "Double", "5.5");
    assert_eq!(component, "BadNotWritable");
}

#[test]
fn made_up_topics_under_unmapped_give_way_when_they_fall_silent() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let folder = [SERVER_ENDPOINT, "--children", "ns=1;s=UaSpace.Unmapped"];
    let children = || cell.asyncua_once("opcua_read.py", &folder)[0]["children"].clone();
    let count = || children().as_array().map_or(0, Vec::len);
    for id in 1..=1000 {
        group.send(&key_frame((9, 1, id), 1, 4.5, DataSetHeader::default()));
    }
    eventually("all that are made up are shown", SOON, || {
        (count() == 1000).then_some(())
    });
    let mut sequence = 0;
    eventually("one that speaks is shown", SOON, || {
        sequence += 1;
        group.send(&key_frame(
            (2, 7, 77),
            sequence,
            4.5,
            DataSetHeader::default(),
        ));
        let shown = children();
        let shown = shown.as_array()?;
        shown.contains(&json!("ns=1;s=ua_2_7_77")).then_some(())
    });
    assert!(count() < 1000);
}
