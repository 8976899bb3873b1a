//! Bridges describe themselves in the group and by mDNS, and `ua-space list` shows the whole space
//! without configuration.

use std::net::UdpSocket;
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{
    CaptureFile, Cell, Child, Peer, StartedChild, UadpSocket, eventually, group_member, program,
};

use super::{MDNS, SOON};

const GRIPPER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../examples/plant/parallel-gripper.yaml"
);
const ENDPOINT: &str = "opc.tcp://127.0.0.1:4841/";
const TWIST: &str = "geometry_msgs/Twist";
const OTHER_GROUP: &str = "239.192.0.41:4840";

fn list(words: &[&str]) -> Vec<String> {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(["list", "--seconds", "1.5", "--interface", "lo"])
        .args(words)
        .start();
    let code = child.wait_for_end(Duration::from_secs(30)).code();
    let lines = child.lines();
    assert_eq!(code, Some(0), "{lines:?}");
    lines
}

fn listed() -> Value {
    let lines = list(&["--json"]);
    let object = lines.iter().find(|line| line.starts_with('{'));
    serde_json::from_str(object.unwrap_or_else(|| panic!("{lines:?}"))).unwrap()
}

/// Returns the first list element with this value of `key`.
fn one<'v>(all: &'v Value, key: &str, value: &Value) -> Option<&'v Value> {
    all.as_array()?.iter().find(|one| one[key] == *value)
}

fn publishing(cell: &Cell) -> Child {
    let value = json!({"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}});
    let value = value.to_string();
    cell.rospy(
        "ros1_pub.py",
        &["/ua_1_2_10", TWIST, "--repeat", "0", "--value", &value],
    )
}

fn packets(socket: &UdpSocket) -> Vec<Vec<u8>> {
    let limit = Some(Duration::from_millis(100));
    socket.set_read_timeout(limit).unwrap();
    let mut packets = Vec::new();
    let mut buffer = [0; 9000];
    while let Ok(length) = socket.recv(&mut buffer) {
        packets.push(buffer[..length].to_vec());
    }
    packets
}

#[test]
fn the_whole_space_is_listed_without_configuration_and_tshark_reads_what_was_said() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Tshark]) else {
        return;
    };
    let (group, mdns) = (UadpSocket::join(), group_member(MDNS));
    let _core = cell.roscore();
    let mut bridge = cell.bridge_ros1(&[]);
    let _server = cell.ua_server(&["--endpoint", ENDPOINT, "--announce"]);
    let _gripper = StartedChild::new("ua-component", &program("ua-component"))
        .args([GRIPPER, "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("gripper-pki")])
        .start();
    let _node = publishing(&cell);
    let all = eventually("all are listed", Duration::from_secs(40), || {
        let all = listed();
        let ways = json!(["mdns", "group"]);
        let bridge = one(&all["bridges"], "foundBy", &ways);
        let component = one(&all["components"], "uri", &json!("urn:example:gripper"));
        let topic = one(&all["topics"], "topic", &json!("ua_1_2_10"));
        let is_all = [
            bridge.is_some_and(|bridge| bridge["topics"] == 1),
            component.is_some_and(|component| component["foundBy"] == ways),
            topic.is_some_and(|topic| topic["type"] == TWIST),
            one(&all["servers"], "kind", &json!("cell server")).is_some(),
            // A component sends after it has looked for other writers of its namespace.
            all["spaces"][0]["calls"].as_u64() >= Some(5),
        ] == [true; 5];
        if !is_all {
            eprintln!("{all:#}");
        }
        is_all.then_some(all)
    });
    let told = &all["bridges"][0];
    assert_eq!(
        (&told["space"], &told["group"]),
        (&json!(1), &json!("239.192.0.40:4840"))
    );
    let uri = told["uri"].as_str().unwrap();
    assert!(uri.ends_with(":ua-bridge:bridge-ros1"), "{told}");
    assert_eq!(all["bridges"].as_array().unwrap().len(), 1, "{all:#}");
    let spaces: Vec<&Value> = all["spaces"].as_array().unwrap().iter().collect();
    let ids: Vec<&Value> = spaces.iter().map(|space| &space["space"]).collect();
    assert_eq!(ids, [&json!(0), &json!(1)]);
    assert_eq!(spaces[1]["topics"], 1, "{all:#}");
    assert!(spaces[0]["calls"].as_u64() >= Some(5), "{all:#}");

    let table = list(&[]);
    let heads = ["SPACE  ORIGIN", "KIND", "TOPIC"];
    let places = heads.map(|head| table.iter().position(|line| line.starts_with(head)));
    assert!(places.is_sorted() && places[0].is_some(), "{table:#?}");
    let only = list(&["--topics"]);
    assert!(only[0].starts_with("TOPIC") && !only.iter().any(|line| line.starts_with("KIND")));

    let said = group.receive_for(Duration::from_millis(200));
    let words = cell.columns(&CaptureFile::of(said), &[]);
    for part in [
        "FindApplications",
        "Application information: Application description",
    ] {
        assert!(
            words.iter().any(|line| line.contains(part)),
            "{part} in {words:#?}"
        );
    }
    let problem = |line: &&String| line.contains("alformed") || line.contains("roblem");
    assert_eq!(words.iter().find(problem), None);

    packets_until(&cell, &mdns, |line| {
        [
            "_uadp._udp.local",
            "program=bridge-ros1",
            "space=1",
            "group=239.192.0.40:4840",
        ]
        .iter()
        .all(|part| line.contains(part))
    });
    bridge.end();
    packets_until(&cell, &mdns, |line| {
        let is_bye = line
            .split('\t')
            .nth(1)
            .is_some_and(|ttl| ttl.starts_with('0'));
        is_bye && line.contains("bridge-ros1 space 1")
    });
}

/// Waits for an mDNS packet that satisfies `is_it`, as tshark prints it.
fn packets_until(cell: &Cell, socket: &UdpSocket, is_it: impl Fn(&str) -> bool) {
    let fields = [
        "dns.resp.name",
        "dns.resp.ttl",
        "dns.txt",
        "dns.ptr.domain_name",
    ];
    let mut seen = Vec::new();
    eventually("an mDNS packet", SOON, || {
        let packets = packets(socket);
        if packets.is_empty() {
            return None;
        }
        let lines = cell.fields(&CaptureFile::of(packets).to_port(MDNS.port()), &fields);
        seen.extend(lines);
        if !seen.iter().any(|line| is_it(line)) {
            eprintln!("{seen:#?}");
        }
        seen.iter().any(|line| is_it(line)).then_some(())
    });
}

#[test]
fn a_bridge_in_another_group_is_found_by_mdns_unless_it_is_to_tell_nobody() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let other = format!("opc.udp://{OTHER_GROUP}");
    let mut bridge = cell.bridge_ros1(&["--address", &other]);
    let _node = publishing(&cell);
    let topic = eventually("its topic is listed", Duration::from_secs(40), || {
        let all = listed();
        one(&all["topics"], "topic", &json!("ua_1_2_10")).cloned()
    });
    assert_eq!(topic["group"], OTHER_GROUP);
    bridge.end();
    let _silent = cell.bridge_ros1(&["--address", &other, "--mdns", "none"]);
    let all = listed();
    assert_eq!(
        (&all["bridges"], &all["topics"]),
        (&json!([]), &json!([])),
        "{all:#}"
    );
}
