//! Wall clocks that jump.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, group_member, metrics, program};

use super::{LDS, MDNS, SOON, STATUS, list, now, on_network, registered, told, who};

const GRIPPER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../examples/plant/parallel-gripper.yaml"
);
/// The ApplicationUri that the script for skills uses.
const GRIPPER_URI: &str = "urn:ua-bridge:system-tests:component";
const ENDPOINT: &str = "opc.tcp://127.0.0.1:4842/";
const SERVER: &str = "opc.tcp://127.0.0.1:4841/";
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
server:
  security: [None]
";
const SETPOINT: &str = "ns=2;i=30";
/// NodeId of CurrentState of the gripper's first skill.
const GRASP: &str = "ns=1;i=101";
const START_TIME: &str = "ns=0;i=2257";
const CURRENT_TIME: &str = "ns=0;i=2258";

fn read(cell: &Cell, server: &str, node: &str) -> String {
    let read = cell
        .asyncua_once("opcua_read.py", &[server, node])
        .remove(0);
    read["value"].as_str().unwrap().to_owned()
}

/// Returns the hour of the day of a time as printed by asyncua.
fn hour(time: &str) -> i64 {
    time[11..13].parse().unwrap()
}

/// Waits until all of these servers are announced again.
fn announced_again(names: &[&str]) {
    let socket = group_member(MDNS);
    let wait = Duration::from_millis(100);
    socket.set_read_timeout(Some(wait)).unwrap();
    for name in names {
        let mut packet = [0; 9000];
        eventually(
            &format!("{name} is announced"),
            Duration::from_secs(30),
            || {
                let length = socket.recv(&mut packet).ok()?;
                let text = packet[..length].windows(name.len());
                let is_response = packet[2] & 0x80 != 0;
                (is_response && text.into_iter().any(|part| part == name.as_bytes())).then_some(())
            },
        );
    }
}

/// Checks that the server's clock shows the hour `ahead` seconds after the present.
fn tells_a_time(cell: &Cell, server: &str, ahead: i64) {
    let of_day = i64::try_from(now().as_secs()).unwrap() + ahead;
    let told = hour(&read(cell, server, CURRENT_TIME));
    let is = |at: i64| at / 3600 % 24 == told;
    assert!(
        is(of_day) || is(of_day + 30),
        "{server} {told}, {ahead} s ahead"
    );
}

fn setpoint_is_told(cell: &Cell, subscriber: &mut Child, value: f64) {
    let text = value.to_string();
    let write = [SERVER, SETPOINT, "Double", &text];
    let wrote = cell.asyncua_once("opcua_write.py", &write).remove(0);
    assert_eq!(wrote["status"], "Good");
    subscriber.wait_for_json(&format!("{value} is told"), SOON, |line| {
        (line["value"] == value && line["status"] == "Good").then_some(())
    });
}

/// Runs the skill and checks that the watcher sees it start in this hour, and sees it end.
fn run_is_told(cell: &Cell, watching: &mut Child) {
    let begun = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "begin"]);
    assert_eq!(begun[0]["status"], "Good");
    let of_day = hour(&read(cell, ENDPOINT, CURRENT_TIME));
    watching.wait_for_json("the skill runs", SOON, |line| {
        let at = hour(line["source_timestamp"].as_str()?);
        let runs = line["value"].as_str()?.contains("Running");
        (runs && (at == of_day || (at + 1) % 24 == of_day)).then_some(())
    });
    watching.wait_for_json("the skill has ended", SOON, |line| {
        (!line["value"].as_str()?.contains("Running")).then_some(())
    });
}

#[test]
fn a_clock_that_jumps_loses_nobody_restarts_nobody_and_ends_no_subscription() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Clock]) else {
        return;
    };
    let clock = cell.wall_clock();
    let lds = StartedChild::new("ua-lds", &program("ua-lds"))
        .args(["--metrics", STATUS])
        .by(&clock)
        .start();
    eventually("ua-lds answers", SOON, || metrics(STATUS));
    let text = std::fs::read_to_string(GRIPPER).unwrap();
    let yaml = cell.file(
        "gripper.yaml",
        &text.replace("urn:example:gripper", GRIPPER_URI),
    );
    let gripper = StartedChild::new("ua-component", &program("ua-component"))
        .args([&yaml])
        .args(["--interface", "lo", "--endpoint", ENDPOINT])
        .by(&clock)
        .start();
    let mapping = cell.file("server.yaml", MAPPING);
    let server = [
        mapping.to_str().unwrap(),
        "--endpoint",
        SERVER,
        "--announce",
    ];
    let server = [&server[..], &["--lds", LDS]].concat();
    let server = cell.ua_server_started(&server).by(&clock).start();
    let mut watch = who(&["watch"]);
    for name in ["parallel-gripper", "ua-server"] {
        told(&mut watch, "seen", name);
        eventually(&format!("{name} is heard"), SOON, || on_network(name));
    }
    eventually("both are registered", SOON, || {
        (metrics(STATUS)?["servers"].as_array()?.len() == 2).then_some(())
    });
    let servers = [ENDPOINT, SERVER];
    let started = servers.map(|server| read(&cell, server, START_TIME));
    let mut subscriber = cell.asyncua("opcua_subscribe.py", &["--limit", "240", SERVER, SETPOINT]);
    let mut watching = cell.asyncua("opcua_subscribe.py", &["--limit", "240", ENDPOINT, GRASP]);
    for (value, ahead) in [(1.0, 0), (2.0, 3600), (3.0, 0), (4.0, -3600)] {
        clock.set(ahead);
        for server in servers {
            tells_a_time(&cell, server, ahead);
        }
        setpoint_is_told(&cell, &mut subscriber, value);
        run_is_told(&cell, &mut watching);
        announced_again(&["parallel-gripper", "ua-server"]);
        let lines = cell.asyncua_once("opcua_discovery.py", &["find", LDS]);
        let uris: Vec<&Value> = list(&lines, "registered")
            .iter()
            .map(|server| &server["uri"])
            .collect();
        assert!(
            uris.contains(&&json!(GRIPPER_URI)) && uris.len() == 3,
            "{uris:?}"
        );
        assert_eq!(
            metrics(STATUS).unwrap()["losses"],
            json!([]),
            "{ahead} s ahead"
        );
        assert_eq!(
            servers.map(|server| read(&cell, server, START_TIME)),
            started
        );
    }
    let lost = |line: &&Value| line["found"] == "gone" || line["found"] == "restarted";
    let lines = watch.json_lines();
    assert_eq!(lines.iter().find(lost), None);
    for child in [&lds, &gripper, &server] {
        let lines = child.lines();
        let restarted = lines.iter().find(|line| line.contains("restarted"));
        assert_eq!(restarted, None, "{child}");
    }
    assert!(registered(GRIPPER_URI).is_some());
    assert!(subscriber.runs() && watching.runs());
}
