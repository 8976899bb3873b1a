//! The nodes of NodeSet2 files together with the nodes of the mapping.

use std::collections::BTreeSet;

use super::*;

/// Returns a NodeSet of the OPC Foundation, which is a peer.
fn node_set(name: &str) -> Option<String> {
    let path = test_data::foreign(&format!("nodesets/Opc.Ua.{name}.NodeSet2.xml"))?;
    Some(path.to_str().unwrap().to_owned())
}

const LINE: &str = include_str!("data/line.xml");

/// A line of the cell among the devices of DI. The files are listed in an order in which they
/// cannot be loaded.
fn mapping(variables: &str) -> String {
    let of = |name: &str| format!("'{}'", node_set(name).unwrap());
    format!(
        "
namespaces:
  2: urn:ua-bridge:system-tests
  3: urn:ua-bridge:system-tests:line
spaces:
  - id: 2
pubsub: {{receive_timeout: 10min}}
server:
  security: [None]
  nodesets: [line.xml, {}, {}, {}]
variables:
  - {{node: ns=2;i=10, name: temperature, type: Double, origin: 2}}
{variables}",
        of("Robotics"),
        of("Machinery"),
        of("Di")
    )
}

const LIVE: &str =
    "  - {node: ns=3;i=6000, name: speed, type: Double, origin: 2, range: [0, 1.5], unit: m/s}
  - {node: ns=3;s=Line.Target, alias: 61, name: target, type: Double, origin: 0}
  - {node: ns=3;i=6030, name: mode, type: Int32, origin: 2, enum: {0: idle, 1: moving}}
";
const SPEED: (u16, u16, u16) = (2, 3, 6000);

/// Returns whether the NodeSets are available.
fn has_nodesets() -> bool {
    node_set("Di").is_some()
}

fn started(cell: &Cell, variables: &str) -> Child {
    drop(cell.file("line.xml", LINE));
    serving(cell, &mapping(variables))
}

#[test]
fn nodes_of_nodesets_are_browsed_and_those_of_the_mapping_live() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    if !has_nodesets() {
        return;
    }
    let mut server = started(&cell, LIVE);
    server.wait_for_line("M170", SOON);
    let group = UadpSocket::join();
    let mut speed = watch(&cell, "ns=3;i=6000");
    shows(&mut speed, "BadWaitingForInitialData", &Value::Null);
    group.send(&key_frame(SPEED, 1, 1.25, DataSetHeader::default()));
    shows(&mut speed, "Good", &json!(1.25));

    // A value written by a client is sent to the space, while no Value of the file was sent.
    assert_eq!(write(&cell, "ns=3;s=Line.Target", "Double", "2.5"), "Good");
    eventually("the written value is sent", SOON, || {
        let datagram = group.receive(Duration::from_millis(100))?;
        let mut parts = datagram.windows(8);
        parts
            .any(|part| part == 2.5_f64.to_le_bytes())
            .then_some(())
    });
    assert_eq!(read(&cell, "ns=3;s=Line.Target")["value"], json!(2.5));

    // A node without a source has the value of the file and can be neither written nor called.
    let count = read(&cell, "ns=3;i=6020");
    assert_eq!(count["value"], json!(7));
    let time = |key: &str| {
        count[key]
            .as_str()
            .is_some_and(|time| time.starts_with("20"))
    };
    assert!(
        time("source_timestamp") && time("server_timestamp"),
        "{count}"
    );
    assert_eq!(write(&cell, "ns=3;i=6020", "Int32", "8"), "BadNotWritable");
    let range = read(&cell, "ns=3;i=6001")["value"].to_string();
    assert!(range.contains("1.5"), "the mapping's range: {range}");

    let about = cell.asyncua_once("opcua_tree.py", &[SERVER_ENDPOINT, "--server"]);
    let uris = about[0]["namespaces"].as_array().unwrap();
    let of_di = uris
        .iter()
        .filter(|uri| **uri == "http://opcfoundation.org/UA/DI/");
    assert_eq!(of_di.count(), 1, "the NodeSet describes it: {about:?}");

    are_walked_by_asyncua_and_node_opcua(&cell);

    let [di, robotics] = ["Di", "Robotics"].map(|name| node_set(name).unwrap());
    let arguments = [
        SERVER_ENDPOINT,
        "urn:ua-bridge:system-tests:line",
        "--nodeset",
        &di,
        "--nodeset",
        &robotics,
    ];
    let told = cell.asyncua_once("opcua_round_trip.py", &arguments);
    let export = &told[0];
    assert_eq!(export["differ"], json!([]), "{export}");
    assert_eq!(export["exported"], json!(13), "{export}");
}

/// Checks that both clients read every node and attribute and find the same bad results, and that
/// asyncua imports its own export of the nodes.
fn are_walked_by_asyncua_and_node_opcua(cell: &Cell) {
    let tree = cell.asyncua_started("opcua_tree.py", &[SERVER_ENDPOINT, "--export"]);
    let mut tree = tree.start();
    assert!(tree.wait_for_end(SOON * 3).success());
    let mut told = tree.json_lines();
    let trip = told.pop().unwrap();
    assert_eq!(trip["differ"], json!([]), "{trip}");
    assert_eq!(trip["exported"], trip["imported"], "{trip}");
    assert!(trip["exported"].as_u64() > Some(800), "{trip}");
    let bad = told.iter().filter(|line| line.get("status").is_some());
    let mut bad: Vec<&str> = bad.map(|line| line["node"].as_str().unwrap()).collect();
    bad.sort_unstable();
    let waiting = ["ns=2;i=10", "ns=3;i=6030", "ns=3;i=6040"];
    assert_eq!(
        bad, waiting,
        "only those that no value came for, and a structure without an id for its encoding"
    );
    assert_eq!(read(cell, "ns=3;i=6040")["status"], "BadDecodingError");
    let sum = told.last().unwrap();
    assert!(sum["nodes"].as_u64() > Some(5_000), "{sum}");

    // node-opcua reads the same tree and finds the same bad results.
    let walked = cell.node_opcua_once("tree.js", &[SERVER_ENDPOINT]);
    let theirs = walked.last().unwrap();
    assert_eq!(theirs["nodes"], sum["nodes"], "{theirs} {sum}");
    assert!(theirs["read"].as_u64() > Some(40_000), "{theirs}");
    let bad = walked.iter().filter(|line| line.get("status").is_some());
    let bad: BTreeSet<&str> = bad.map(|line| line["node"].as_str().unwrap()).collect();
    assert_eq!(bad, BTreeSet::from([waiting[0], waiting[1], waiting[2]]));
}

#[test]
fn values_of_structures_that_a_nodeset_defines_are_read_by_their_definitions() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    drop(cell.file("cells.xml", include_str!("data/cells.xml")));
    drop(cell.file("walls.xml", include_str!("data/walls.xml")));
    let mapping = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
server:
  security: [None]
  nodesets: [cells.xml, walls.xml]
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
";
    let mut server = serving(&cell, mapping);
    // A Value that does not match its definition is logged, and the node has no value.
    let told = server.wait_for_line("M170", SOON);
    assert!(
        told.contains("the value cannot be read") && told.contains("ns=1;i=6002"),
        "{told}"
    );
    assert_eq!(read(&cell, "ns=3;i=6002")["status"], "BadDecodingError");

    let nodes = [SERVER_ENDPOINT, "ns=3;i=6000", "ns=3;i=6001", "ns=4;i=6000"];
    let told = cell.asyncua_once("opcua_structures.py", &nodes);
    assert_eq!(told[0]["type"], "Corner", "{told:?}");
    assert_eq!(told[0]["value"], json!({"X": 1.5, "Y": -2.0}));
    assert_eq!(told[1]["type"], "Area", "{told:?}");
    let corner = |x: f64, y: f64| json!({"X": x, "Y": y});
    let areas = told[1]["value"].as_array().unwrap();
    assert_eq!(areas.len(), 2);
    let (left, right) = (&areas[0], &areas[1]);
    assert_eq!(
        (&left["Name"], &left["Number"]),
        (&json!("left"), &json!(7))
    );
    assert_eq!(left["Limits"], json!({"Low": 0.0, "High": 10.0}));
    assert_eq!(left["Corners"], json!([corner(0.0, 0.0), corner(3.0, 4.5)]));
    assert_eq!(
        (&right["Name"], &right["Number"]),
        (&json!("right"), &Value::Null)
    );
    assert_eq!(right["Corners"], json!([]));
    // The structure has the fields inherited from a structure of the other file before its own
    // fields.
    assert_eq!(told[2]["type"], "Post", "{told:?}");
    let post = json!({"X": 1.0, "Y": 2.0, "Height": 2.5});
    assert_eq!(told[2]["value"], post, "{told:?}");
}

#[test]
fn a_node_that_the_mapping_leaves_is_that_of_its_file_again_and_other_files_need_a_restart() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    if !has_nodesets() {
        return;
    }
    let mut server = started(&cell, "");
    // No source updates the node.
    assert_eq!(read(&cell, "ns=3;i=6000")["value"], json!(0.5));
    drop(cell.file("server.yaml", &mapping(LIVE)));
    let group = UadpSocket::join();
    let speed = watch(&cell, "ns=3;i=6000");
    let mut sequence = 0;
    shows_last(&speed, 1.25, || {
        sequence += 1;
        group.send(&key_frame(SPEED, sequence, 1.25, DataSetHeader::default()));
    });
    let range = read(&cell, "ns=3;i=6001")["value"].to_string();
    assert!(range.contains("1.5"), "the mapping's range: {range}");

    drop(cell.file("server.yaml", &mapping("")));
    shows_last(&speed, 0.5, || {});
    let range = read(&cell, "ns=3;i=6001")["value"].to_string();
    assert!(range.contains("10"), "the file's range: {range}");

    drop(cell.file("line.xml", &LINE.replace(">0.5<", ">0.75<")));
    let told = server.wait_for_line("restart needed for changes of: server.nodesets", SOON);
    assert!(told.contains("another one"), "{told}");
    assert_eq!(read(&cell, "ns=3;i=6000")["value"], json!(0.5));

    // A file that cannot be loaded leaves the running configuration unchanged.
    drop(cell.file("line.xml", "<UANodeSet>"));
    server.wait_for_line("error[M170]", SOON);
    assert_eq!(read(&cell, "ns=3;i=6000")["value"], json!(0.5));
}

/// Repeats `done` until the last value that the client received is this value.
fn shows_last(watch: &Child, value: f64, mut done: impl FnMut()) {
    eventually(&format!("the node shows {value}"), SOON, || {
        done();
        let last = watch.json_lines().pop()?;
        (last.get("status")? == "Good" && last["value"] == json!(value)).then_some(())
    });
}

#[test]
fn a_method_of_a_nodeset_is_called_while_the_call_of_its_node_is_there() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    if !has_nodesets() {
        return;
    }
    drop(cell.file("line.xml", LINE));
    let calls = "calls:\n  - {node: ns=3;i=7000, name: Line.Halt, origin: 1, ros: {service: /halt, type: std_srvs/Trigger}}\n";
    let text = mapping(calls).replace("  - id: 2\n", "  - id: 1\n  - id: 2\n");
    let file = cell.file("server.yaml", &text);
    let path = file.to_str().unwrap();
    let _core = cell.roscore();
    let mut server = cell.ua_server(&[path]);
    server.wait_for_line("serving at", SOON);
    let arguments = [SERVER_ENDPOINT, "DeviceSet/Line/Halt", "--value", "[]"];
    let status = || {
        let told = cell.asyncua_once("opcua_call.py", &arguments);
        told.last().unwrap()["status"].clone()
    };
    assert_eq!(status(), "BadUserAccessDenied");
    let _executor = cell.rospy_executor(&["empty=/halt"]);
    let bridge = cell.bridge_ros1(&[path]);
    server.wait_for_line("shown as a Method", SOON);
    assert_eq!(status(), "Good");
    drop(bridge);
    eventually("it is not called any more", SOON, || {
        (status() == "BadUserAccessDenied").then_some(())
    });
}
