//! The PubSub configuration in the address space, checked with asyncua.

use std::time::{Duration, Instant};

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, UadpSocket, eventually};

use super::{
    DataSetHeader, SOON, TEMPERATURE, TEMPERATURE_NODE, key_frame, server, shows, watch, write,
    written,
};

const WRITER: &str = "space/writers 2/ua_0_2_30";
const READER: &str = "space/readers 2 2/ua_2_2_10";
const SETPOINT: &str = "ns=2;i=30";

/// PubSubState, OPC 10000-14, 6.2.1.
const DISABLED: i32 = 0;
const PAUSED: i32 = 1;
const OPERATIONAL: i32 = 2;
const PRE_OPERATIONAL: i32 = 4;

/// A client of the configuration.
struct Client {
    asyncua: Child,
    orders: u64,
}

impl Client {
    fn of(cell: &Cell) -> Self {
        let started = cell.asyncua_started("opcua_pubsub.py", &[SERVER_ENDPOINT]);
        Self {
            asyncua: started.told().start().ready(SOON),
            orders: 0,
        }
    }

    /// Sends an order and returns its result.
    fn told(&mut self, order: &str) -> Value {
        self.asyncua.tell(order);
        self.orders += 1;
        self.asyncua.wait_for_json(order, SOON, |line| {
            (line["order"] == self.orders).then(|| line.clone())
        })
    }

    fn read(&mut self, path: &str) -> Value {
        let mut read = self.told(&format!("read {path}"));
        assert_eq!(read["status"], "Good", "{path}: {read}");
        read["value"].take()
    }

    /// Calls a method and returns its status.
    fn call(&mut self, path: &str) -> Value {
        self.told(&format!("call {path}"))["called"].take()
    }

    fn state(&mut self, path: &str) -> Value {
        self.read(&format!("{path}/Status/State"))
    }

    fn becomes(&mut self, path: &str, value: &Value) {
        eventually(&format!("{value} at {path}"), SOON, || {
            (self.read(path) == *value).then_some(())
        });
    }

    fn is_in(&mut self, path: &str, state: i32) {
        self.becomes(&format!("{path}/Status/State"), &json!(state));
    }
}

#[test]
fn a_client_finds_what_is_sent_and_heard_with_its_metadata_below_publish_subscribe() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    // The nodes of readers are added when a client looks at them.
    let state = "ns=1;s=PubSub.space.readers 2 2.ua_2_2_10.Status.State";
    let read = cell.asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, state]);
    assert_eq!(read[0]["value"], PRE_OPERATIONAL, "{read:?}");
    let mut client = Client::of(&cell);
    let walked = client.told("walk");
    assert_eq!(walked["bad"], json!([]), "{walked}");
    assert!(
        walked["walked"]["Variable"].as_u64().unwrap() > 100,
        "{walked}"
    );

    assert_eq!(client.read("space/PublisherId"), 0);
    let url = client.read("space/Address/Url");
    assert!(url.as_str().unwrap().starts_with("opc.udp://"), "{url}");
    let resolved = client.read("space/Diagnostics/LiveValues/ResolvedAddress");
    assert_eq!(resolved, url);
    // Part 14, 9.1.11: the live values of the root, of the groups, and their levels.
    for counted in [
        "Diagnostics/LiveValues/ConfiguredDataSetReaders",
        "space/readers 2 2/Diagnostics/LiveValues/ConfiguredDataSetReaders",
        "Diagnostics/LiveValues/ConfiguredDataSetWriters",
        "space/writers 2/Diagnostics/LiveValues/OperationalDataSetWriters",
    ] {
        client.becomes(counted, &json!(1));
        assert_eq!(client.read(&format!("{counted}/DiagnosticsLevel")), 0);
    }
    let profile = client.read("space/TransportProfileUri");
    assert_eq!(
        profile,
        "http://opcfoundation.org/UA-Profile/Transport/pubsub-udp-uadp"
    );
    assert_eq!(client.read("space/writers 2/WriterGroupId"), 2);
    assert_eq!(client.read("space/writers 2/SecurityMode"), 1);
    assert_eq!(client.read(&format!("{WRITER}/DataSetWriterId")), 30);
    assert_eq!(client.read(&format!("{READER}/PublisherId")), 2);
    assert_eq!(client.read(&format!("{READER}/WriterGroupId")), 2);
    assert_eq!(client.read(&format!("{READER}/DataSetWriterId")), 10);
    for (place, name) in [
        ("PublishedDataSets/ua_0_2_30", "setpoint"),
        (READER, "temperature"),
    ] {
        let data = client.read(&format!("{place}/DataSetMetaData"));
        assert_eq!(data["Name"], name, "{data}");
        let fields = data["Fields"].as_array().unwrap();
        assert_eq!(fields.len(), 1);
        assert_eq!(
            (&fields[0]["BuiltInType"], &fields[0]["DataType"]),
            (&json!(11), &json!("i=11")),
            "a Double"
        );
    }
    let published = client.read("PublishedDataSets/ua_0_2_30/PublishedData");
    assert_eq!(published[0]["PublishedVariable"], SETPOINT);
    let targets = client.read(&format!("{READER}/SubscribedDataSet/TargetVariables"));
    assert_eq!(targets[0]["TargetNodeId"], TEMPERATURE_NODE);
}

#[test]
fn a_reader_that_is_disabled_takes_nothing_and_goes_on_when_it_is_enabled() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut client = Client::of(&cell);
    let group = UadpSocket::join();
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let mut sequence = 0;
    let mut send = |value: f64| {
        sequence += 1;
        group.send(&key_frame(
            TEMPERATURE,
            sequence,
            value,
            DataSetHeader::default(),
        ));
    };
    assert_eq!(
        client.state(READER),
        PRE_OPERATIONAL,
        "nothing was heard yet"
    );
    send(1.5);
    shows(&mut watch, "Good", &json!(1.5));
    client.is_in(READER, OPERATIONAL);
    let received = "space/readers 2 2/Diagnostics/Counters/ReceivedNetworkMessages";
    client.becomes(received, &json!(1));
    client.becomes(
        "space/readers 2 2/Diagnostics/LiveValues/OperationalDataSetReaders",
        &json!(1),
    );

    assert_eq!(client.call(&format!("{READER}/Status/Disable")), "Good");
    assert_eq!(client.state(READER), DISABLED);
    let again = client.call(&format!("{READER}/Status/Disable"));
    assert_eq!(again, "BadInvalidState");
    shows(&mut watch, "UncertainLastUsableValue", &json!(1.5));
    send(2.5);
    assert_eq!(client.call(&format!("{READER}/Status/Enable")), "Good");
    client.is_in(READER, OPERATIONAL);
    send(3.5);
    shows(&mut watch, "Good", &json!(3.5));
    let told: Vec<Value> = watch.json_lines();
    assert!(
        !told.iter().any(|line| line["value"] == 2.5),
        "what came meanwhile was not taken: {told:?}"
    );
    let by_method = format!("{READER}/Diagnostics/Counters/StateDisabledByMethod");
    client.becomes(&by_method, &json!(1));
    assert_eq!(client.call(&format!("{READER}/Diagnostics/Reset")), "Good");
    assert_eq!(client.read(&by_method), 0);
}

#[test]
fn what_is_below_a_group_that_is_disabled_sends_nothing() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut client = Client::of(&cell);
    let group = UadpSocket::join();
    assert_eq!(write(&cell, SETPOINT, "Double", "1.5"), "Good");
    let sent = |value: f64| {
        eventually("a key frame", SOON, || {
            let frame = written(&group.receive(Duration::from_millis(100))?)?;
            (frame == ((0, 2, 30), vec![value])).then_some(())
        });
    };
    sent(1.5);
    let counter = "space/writers 2/Diagnostics/Counters/SentNetworkMessages";
    eventually("the message is counted", SOON, || {
        (client.read(counter).as_u64()? >= 1).then_some(())
    });

    for (above, state) in [
        ("space", PAUSED),
        ("space/writers 2", PAUSED),
        (WRITER, DISABLED),
    ] {
        assert_eq!(client.call(&format!("{above}/Status/Disable")), "Good");
        assert_eq!(client.state(above), DISABLED, "{above}");
        assert_eq!(client.state(WRITER), state, "{above}");
        assert_eq!(write(&cell, SETPOINT, "Double", "9"), "BadInvalidState");
        // Datagrams sent before are still in this socket's buffer.
        while group.receive(Duration::from_millis(100)).is_some() {}
        // A datagram in transit may still arrive. Then nothing is received for as long as the
        // repetition period of a value.
        let quiet = Instant::now();
        let mut late = 0;
        while quiet.elapsed() < Duration::from_millis(2_500) {
            let frame = group.receive(Duration::from_millis(100));
            let frame = frame.and_then(|frame| written(&frame));
            late += usize::from(frame.is_some_and(|(topic, _)| topic == (0, 2, 30)));
        }
        assert!(late <= 1, "{late} messages with {above} disabled");
        assert_eq!(client.call(&format!("{above}/Status/Enable")), "Good");
        assert_eq!(client.state(WRITER), OPERATIONAL);
        eventually("clients can write again", SOON, || {
            (write(&cell, SETPOINT, "Double", "2.5") == "Good").then_some(())
        });
        sent(2.5);
    }
    assert_eq!(client.call("Status/Disable"), "Good");
    assert_eq!(client.state(WRITER), PAUSED);
    client.becomes("Status/State", &json!(DISABLED));
    assert_eq!(client.call("Status/Enable"), "Good");
    assert_eq!(client.state(WRITER), OPERATIONAL);
}

const FILE: &str = "PubSubConfiguration";

#[test]
#[expect(clippy::too_many_lines, reason = "one walk through the configuration")]
fn the_configuration_is_a_file_that_says_what_the_nodes_say() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut client = Client::of(&cell);
    let file = client.told(&format!("file {FILE}"));
    assert_eq!(file["type"], "UABinaryFileDataType", "{file}");
    assert_eq!(file["body"], "PubSubConfiguration2DataType", "{file}");
    assert_eq!(file["mime"], "application/opcua+uabinary");
    assert_eq!(file["complete"], true, "its Size is that of what was read");
    // Index 1 of the NamespaceArray is the first namespace of the file.
    assert_eq!(file["namespaces"][1], "urn:ua-bridge:system-tests");
    let content = &file["content"];
    assert_eq!(content["Enabled"], true);
    let connection = &content["Connections"][0];
    let of_node = |client: &mut Client, path: &str, said: &Value, names: &[&str]| {
        for name in names {
            assert_eq!(
                client.read(&format!("{path}/{name}")),
                said[name],
                "{name} of {path}"
            );
        }
    };
    assert_eq!(connection["Name"], "space");
    of_node(&mut client, "space", connection, &["TransportProfileUri"]);
    of_node(
        &mut client,
        "space/Address",
        &connection["Address"],
        &["Url"],
    );
    let names = [
        "WriterGroupId",
        "SecurityMode",
        "PublishingInterval",
        "KeepAliveTime",
    ];
    let writers = &connection["WriterGroups"][0];
    of_node(&mut client, "space/writers 2", writers, &names);
    let mask = ["NetworkMessageContentMask"];
    let settings = &writers["MessageSettings"];
    of_node(
        &mut client,
        "space/writers 2/MessageSettings",
        settings,
        &mask,
    );
    let writer = &writers["DataSetWriters"][0];
    assert_eq!(writer["DataSetName"], "ua_0_2_30");
    of_node(
        &mut client,
        WRITER,
        writer,
        &["DataSetWriterId", "KeyFrameCount"],
    );
    let set = &content["PublishedDataSets"][0];
    assert_eq!(set["Name"], writer["DataSetName"]);
    let published = "PublishedDataSets/ua_0_2_30";
    let source = &set["DataSetSource"];
    of_node(&mut client, published, source, &["PublishedData"]);
    of_node(&mut client, published, set, &["DataSetMetaData"]);
    let readers = &connection["ReaderGroups"][0];
    assert_eq!(readers["Name"], "readers 2 2");
    let reader = &readers["DataSetReaders"][0];
    let names = [
        "WriterGroupId",
        "DataSetWriterId",
        "MessageReceiveTimeout",
        "DataSetMetaData",
    ];
    of_node(&mut client, READER, reader, &names);
    let targets = &reader["SubscribedDataSet"];
    let target_node = format!("{READER}/SubscribedDataSet");
    of_node(&mut client, &target_node, targets, &["TargetVariables"]);

    // In the file, only the disabled element is disabled.
    assert_eq!(client.call(&format!("{WRITER}/Status/Disable")), "Good");
    let file = client.told(&format!("file {FILE}"));
    let connection = &file["content"]["Connections"][0];
    let writers = &connection["WriterGroups"][0];
    let readers = &connection["ReaderGroups"][0];
    let enabled = [connection, writers, &writers["DataSetWriters"][0], readers];
    let enabled = enabled.map(|part| part["Enabled"].as_bool().unwrap());
    assert_eq!(enabled, [true, true, false, true]);
}

#[test]
fn the_file_of_the_configuration_is_not_written_and_what_a_session_left_open_is_closed() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let (mut first, mut second) = (Client::of(&cell), Client::of(&cell));
    let mut opened = |mode: u8| first.told(&format!("open {FILE} {mode}"))["opened"].take();
    // The modes erase and write, read and write, and write alone, which is no mode of this file.
    let modes = [6, 3, 2].map(&mut opened);
    assert_eq!(
        modes,
        ["BadNotWritable", "BadNotWritable", "BadInvalidArgument"]
    );
    let read = [1; 6].map(&mut opened);
    assert_eq!(read[..5], ["Good"; 5]);
    assert_eq!(read[5], "BadTooManyOperations");
    let count = format!("{FILE}/OpenCount");
    second.becomes(&count, &json!(5));
    assert_eq!(second.told(&format!("file {FILE}"))["complete"], true);
    first.asyncua.tell("leave");
    second.becomes(&count, &json!(0));
    for name in ["Writable", "UserWritable"] {
        assert_eq!(second.read(&format!("{FILE}/{name}")), false);
    }
}
