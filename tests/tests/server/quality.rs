//! The status of a value as a function of its age and of the state of its publisher.

use super::*;

/// A value that has to arrive regularly, a value of any age, and a value that a rule of the server
/// makes bad.
const AGES: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2, quality: {uncertain_after: 1s, bad_after: 1500ms}}
  - {node: ns=2;i=11, name: setting, type: Double, origin: 2}
pubsub: {receive_timeout: 3s}
server:
  security: [None]
  bad_after: 8s
";

fn served(cell: &Cell) -> Child {
    let mapping = cell.file("ages.yaml", AGES);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    server
}

const SETTING: (u16, u16, u16) = (2, 2, 11);
const SETTING_NODE: &str = "ns=2;i=11";

/// Encodes a keep-alive message of the writer.
fn keep_alive(triple: (u16, u16, u16), next: u16) -> Vec<u8> {
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
        sequence_number: Some(next),
        timestamp: Some(now().time),
        ..DataSetHeader::default()
    };
    message.keep_alive(&header).unwrap();
    message.finish().unwrap();
    datagram
}

/// Repeats `send` until the client has received that status and value.
fn shows_while(watch: &Child, (status, value): (&str, &Value), mut send: impl FnMut()) {
    let mut sent = Instant::now() - Duration::from_secs(1);
    eventually(&format!("{value} as {status}"), SOON, || {
        if sent.elapsed() > Duration::from_millis(200) {
            send();
            sent = Instant::now();
        }
        let last = watch.json_lines().pop()?;
        (last.get("status")? == status && last["value"] == *value).then_some(())
    });
}

#[test]
fn a_value_that_has_to_come_regularly_is_uncertain_and_then_bad_though_its_writer_lives() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = served(&cell);
    let mut regular = watch(&cell, TEMPERATURE_NODE);
    let mut setting = watch(&cell, SETTING_NODE);
    let group = UadpSocket::join();
    group.send(&key_frame(SETTING, 1, 3.5, DataSetHeader::default()));
    shows(&mut setting, "Good", &json!(3.5));
    group.send(&key_frame(TEMPERATURE, 1, 21.5, DataSetHeader::default()));
    shows(&mut regular, "Good", &json!(21.5));
    let alive = || {
        group.send(&keep_alive(TEMPERATURE, 2));
        group.send(&keep_alive(SETTING, 2));
    };
    let uncertain = ("UncertainLastUsableValue", &json!(21.5));
    shows_while(&regular, uncertain, alive);
    shows_while(&regular, ("BadNoCommunication", &Value::Null), alive);
    // True while the writer is received; from here on it is silent.
    let told: Vec<Value> = setting.json_lines();
    let others: Vec<&Value> = told
        .iter()
        .filter(|line| line.get("status").is_some_and(|status| status != "Good"))
        .filter(|line| line["status"] != "BadWaitingForInitialData")
        .collect();
    assert!(others.is_empty(), "its age says nothing: {others:?}");
    let read_now = read(&cell, TEMPERATURE_NODE);
    assert_eq!(read_now["status"], "BadNoCommunication");
    assert_eq!(read_now["value"], Value::Null);
    group.send(&key_frame(TEMPERATURE, 2, 22.5, DataSetHeader::default()));
    shows(&mut regular, "Good", &json!(22.5));
}

#[test]
fn a_writer_that_ended_is_told_from_a_publisher_that_is_not_heard_at_all_and_both_are_bad_in_the_end()
 {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = served(&cell);
    let mut setting = watch(&cell, SETTING_NODE);
    let group = UadpSocket::join();
    group.send(&key_frame(SETTING, 1, 3.5, DataSetHeader::default()));
    shows(&mut setting, "Good", &json!(3.5));
    // Another value of the same publisher continues to arrive.
    let mut sequence = 0;
    let uncertain = ("UncertainLastUsableValue", &json!(3.5));
    shows_while(&setting, uncertain, || {
        sequence += 1;
        group.send(&key_frame(
            TEMPERATURE,
            sequence,
            1.0,
            DataSetHeader::default(),
        ));
    });
    let away = "UncertainNoCommunicationLastUsableValue";
    shows(&mut setting, away, &json!(3.5));
    shows(&mut setting, "BadNoCommunication", &Value::Null);
    // The writer is alive after all, and its last value is valid again.
    group.send(&keep_alive(SETTING, 2));
    shows(&mut setting, "Good", &json!(3.5));
}
