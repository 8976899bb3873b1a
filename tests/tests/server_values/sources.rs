//! Third-party servers, which know nothing of the space, as sources and as destinations of values.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, METRICS_SERVER, Peer, SERVER_ENDPOINT, UadpSocket, eventually, http_get, metrics,
    program,
};
use uadp::{NetworkMessage, Scalar, Variant};

use super::key_frame;

/// The time that asyncua and node-opcua need to start on a busy machine.
const SOON: Duration = Duration::from_secs(40);
const PLC: &str = "opc.tcp://127.0.0.1:4841";
const URI: &str = "urn:ua-bridge:system-tests:plc";

fn mapping(more: &str) -> String {
    let node = |name: &str| format!("{{server: plc, node: 'nsu={URI};s=Line.{name}'");
    format!(
        "
spaces: [{{id: 2}}]
namespaces: {{2: 'urn:ua-bridge:system-tests'}}
servers:
  - {{name: plc, endpoint: '{PLC}', security: None}}
variables:
  - {{node: ns=2;i=1, name: speed, type: Double, origin: 0, from: {speed}, sampling: 20ms}}}}
  - {{node: ns=2;i=3, name: missing, type: Double, origin: 0, from: {missing}}}}}
  - {{node: ns=2;i=4, name: setpoint, type: Double, origin: 2, to: {setpoint}}}}}
{more}",
        speed = node("Speed"),
        missing = node("Sped"),
        setpoint = node("Setpoint"),
    )
}

/// Waits for a notification of that node with that status and value, and returns it.
fn shows(watch: &mut Child, node: &str, status: &str, value: &Value) -> Value {
    let what = format!("{node} shows {value} as {status}");
    watch.wait_for_json(&what, SOON, |line| {
        let is = line["node"] == node && line["status"] == status && line["value"] == *value;
        is.then(|| line.clone())
    })
}

/// Returns how often the client received a value of the node with that status.
fn times(watch: &Child, node: &str, status: &str) -> usize {
    let lines = watch.json_lines();
    let shown = lines.iter();
    shown
        .filter(|line| line["node"] == node && line["status"] == status)
        .count()
}

fn becomes(watch: &Child, node: &str, status: &str, before: usize) {
    eventually(&format!("{node} becomes {status} again"), SOON, || {
        (times(watch, node, status) > before).then_some(())
    });
}

/// Waits until the status of the PLC satisfies `pick`, and returns it.
fn link(pick: impl Fn(&Value) -> bool) -> Value {
    eventually("the link is told as it is", SOON, || {
        let told = metrics(METRICS_SERVER)?["servers"][0].clone();
        pick(&told).then_some(told)
    })
}

/// Waits until the server sends that value. Returns its Status and its age in seconds.
fn sent(group: &UadpSocket, id: u16, value: f64) -> (u16, i128) {
    eventually("the value is sent", SOON, || {
        let datagram = group.receive(Duration::from_secs(1))?;
        let network = NetworkMessage::decode(&datagram).ok()?;
        let message = network.messages().next()?.ok()?;
        let header = message.header();
        let only = message.fields().ok()?.next()?.ok()?;
        let is = message.writer_id == Some(id) && only == Variant::Scalar(Scalar::Double(value));
        let (taken, sent) = (header.timestamp?, network.header().timestamp?);
        let age = i128::from(sent.0 - taken.0) / 10_000_000;
        is.then(|| (header.status.unwrap_or_default(), age))
    })
}

fn asyncua_plc(cell: &Cell, more: &[&str]) -> Child {
    let plc = cell.asyncua_started("opcua_plc.py", &[&[PLC], more].concat());
    plc.told().start().ready(SOON)
}

fn node_opcua_plc(cell: &Cell) -> Child {
    let plc = cell.node_opcua_started("plc.js", &["4841"]);
    plc.told().start().ready(SOON)
}

fn written(plc: &mut Child, value: f64) {
    plc.wait_for_json(&format!("{value} is written"), SOON, |line| {
        (line.get("written")? == value).then_some(())
    });
}

fn save(file: &Path, text: &str) {
    let beside = file.with_extension("new");
    fs::write(&beside, text).unwrap();
    fs::rename(beside, file).unwrap();
}

#[test]
fn a_plc_that_boots_second_is_heard_with_its_times_and_qualities_and_is_bad_while_it_is_away() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.file("plc.yaml", &mapping(""));
    let _server = cell.ua_server(&[file.to_str().unwrap()]);
    let group = UadpSocket::join();
    let nodes = [SERVER_ENDPOINT, "ns=2;i=1", "ns=2;i=3", "ns=2;i=4"];
    let mut watch = cell.asyncua("opcua_subscribe.py", &nodes);
    let speed = "ns=2;i=1";
    shows(&mut watch, speed, "BadNoCommunication", &Value::Null);
    assert_eq!(link(|told| told["why"].is_string())["up"], false);

    let mut plc = asyncua_plc(&cell, &[]);
    shows(&mut watch, speed, "Good", &json!(0.5));
    // A node that the server does not have is bad by itself, and reported by its name.
    shows(&mut watch, "ns=2;i=3", "BadNodeIdUnknown", &Value::Null);
    let told = link(|told| told["up"] == true && told["faults"]["missing (from)"].is_string());
    assert_eq!((&told["name"], &told["url"]), (&json!("plc"), &json!(PLC)));
    assert_eq!(told["faults"].as_object().unwrap().len(), 1, "{told}");
    let page = http_get(METRICS_SERVER, "/metrics").unwrap();
    let up = r#"ua_server_up{program="ua-server",space="0",server="plc"} 1"#;
    assert!(page.contains(up), "{page}");

    // The value keeps its own timestamp and quality, for clients and for the space.
    let uncertain =
        r#"{"set": "Speed", "value": 7.5, "age": 600, "status": "UncertainLastUsableValue"}"#;
    plc.ask(uncertain, SOON);
    let told = shows(&mut watch, speed, "UncertainLastUsableValue", &json!(7.5));
    let (source, server) = (&told["source_timestamp"], &told["server_timestamp"]);
    assert!(source.as_str() < server.as_str(), "{told}");
    let (status, age) = sent(&group, 1, 7.5);
    assert_eq!(status, 0x4090);
    assert!((600..660).contains(&age), "{age} s");
    plc.ask(
        r#"{"set": "Speed", "value": 8.5, "status": "BadSensorFailure"}"#,
        SOON,
    );
    shows(&mut watch, speed, "BadSensorFailure", &Value::Null);
    plc.ask(r#"{"set": "Speed", "value": 9.5}"#, SOON);
    shows(&mut watch, speed, "Good", &json!(9.5));

    // Only the PLC writes this value.
    let write = [SERVER_ENDPOINT, speed, "Double", "1.0"];
    let refused = cell.asyncua_once("opcua_write.py", &write).remove(0);
    assert!(
        refused["status"].as_str().unwrap().starts_with("Bad"),
        "{refused}"
    );

    // A value of another space is written to the PLC, and again when the PLC returns.
    group.send(&key_frame(4, 1, |fields| {
        fields.scalar(Scalar::Double(42.0)).unwrap();
    }));
    written(&mut plc, 42.0);
    let before = times(&watch, speed, "BadNoCommunication");
    plc.signal(Signal::SIGKILL);
    becomes(&watch, speed, "BadNoCommunication", before);
    drop(plc);
    let good = times(&watch, speed, "Good");
    // The restarted PLC has other namespace indices.
    let mut plc = asyncua_plc(&cell, &["--before", "2"]);
    becomes(&watch, speed, "Good", good);
    plc.ask(r#"{"set": "Speed", "value": 10.5}"#, SOON);
    shows(&mut watch, speed, "Good", &json!(10.5));

    // Another mapping keeps the session.
    let connects = link(|told| told["up"] == true)["connects"].clone();
    let load = format!(
        "  - {{node: ns=2;i=5, name: load, type: Double, origin: 0, from: {{server: plc, node: 'nsu={URI};s=Line.Load'}}}}\n"
    );
    save(&file, &mapping(&load));
    let mut loads = eventually("the new node is there", SOON, || {
        let read = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=2;i=5"])?;
        (read.first()?["value"] == 0.5).then_some(())?;
        Some(cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, "ns=2;i=5"]))
    });
    plc.ask(r#"{"set": "Load", "value": 3.5}"#, SOON);
    shows(&mut loads, "ns=2;i=5", "Good", &json!(3.5));
    plc.ask(r#"{"set": "Speed", "value": 11.5}"#, SOON);
    shows(&mut watch, speed, "Good", &json!(11.5));
    assert_eq!(link(|told| told["up"] == true)["connects"], connects);
}

#[test]
fn a_server_of_node_opcua_is_heard_and_told_before_and_after_it_was_killed() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let more = format!(
        "  - {{node: ns=2;i=6, name: wish, type: Double, origin: 0, queue: keep_latest, to: {{server: plc, node: 'nsu={URI};s=Line.Setpoint'}}}}\n"
    );
    let file = cell.file("plc.yaml", &mapping(&more));
    let mut plc = node_opcua_plc(&cell);
    let _server = cell.ua_server(&[file.to_str().unwrap()]);
    let mut watch = cell.asyncua(
        "opcua_subscribe.py",
        &[SERVER_ENDPOINT, "ns=2;i=1", "ns=2;i=3"],
    );
    let speed = "ns=2;i=1";
    plc.ask(r#"{"set": 1.5}"#, SOON);
    shows(&mut watch, speed, "Good", &json!(1.5));
    shows(&mut watch, "ns=2;i=3", "BadNodeIdUnknown", &Value::Null);
    // A value written by a client of our server is forwarded to the PLC.
    let write = [SERVER_ENDPOINT, "ns=2;i=6", "Double", "21.5"];
    let wrote = cell.asyncua_once("opcua_write.py", &write).remove(0);
    assert_eq!(wrote["status"], "Good");
    written(&mut plc, 21.5);
    let before = times(&watch, speed, "BadNoCommunication");
    plc.signal(Signal::SIGKILL);
    becomes(&watch, speed, "BadNoCommunication", before);
    drop(plc);
    let mut plc = node_opcua_plc(&cell);
    // In the mapping, the value is a state, so it is written again.
    written(&mut plc, 21.5);
    plc.ask(r#"{"set": 2.5}"#, SOON);
    shows(&mut watch, speed, "Good", &json!(2.5));
    let told = link(|told| told["up"] == true);
    assert!(told["written"].as_u64() >= Some(2), "{told}");
}

#[test]
fn a_password_goes_over_no_session_without_security_unless_told() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let text = |security: &str, password: &str| {
        let user = format!("{security}user: cell, password: '{password}'");
        mapping("").replace("security: None", &user)
    };
    let file = cell.file("plc.yaml", &text("", "right"));
    let _server = cell.ua_server(&[file.to_str().unwrap()]);
    let _plc = asyncua_plc(&cell, &["--user", "cell", "right"]);
    let mut watch = cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, "ns=2;i=1"]);
    let speed = "ns=2;i=1";
    let told = link(|told| {
        let why = told["why"].as_str().unwrap_or_default();
        why.contains("no usable security")
    });
    assert_eq!(told["up"], false, "{told}");
    save(&file, &text("security: None, ", "wrong"));
    link(|told| {
        let why = told["why"].as_str().unwrap_or_default();
        !why.is_empty() && !why.contains("no usable security") && !why.contains("wrong")
    });
    assert_eq!(times(&watch, speed, "Good"), 0);
    save(&file, &text("security: None, ", "right"));
    shows(&mut watch, speed, "Good", &json!(0.5));
}

/// The three security policies, each at a server that accepts no other, so every connection proves
/// its policy.
const POLICIES: [&str; 3] = [
    "Basic256Sha256",
    "Aes128_Sha256_RsaOaep",
    "Aes256_Sha256_RsaPss",
];

#[test]
fn each_security_policy_is_spoken_with_servers_of_two_makers_once_they_are_trusted() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let folder = cell.folder().join("pairs");
    let pairs = folder.to_str().unwrap();
    let made = cell.asyncua_once("opcua_access.py", &["pairs", pairs]);
    assert_eq!(made.len(), 1);
    let (mut plcs, mut servers, mut variables) = (Vec::new(), String::new(), String::new());
    for (number, policy) in POLICIES.into_iter().cycle().take(6).enumerate() {
        let port = format!("{}", 4841 + number);
        let url = format!("opc.tcp://127.0.0.1:{port}");
        let plc = if number < POLICIES.len() {
            cell.asyncua_started("opcua_plc.py", &[&url, "--only", policy, "--pairs", pairs])
        } else {
            cell.node_opcua_started("plc.js", &[&port, policy, pairs])
        };
        plcs.push(plc.told().start());
        servers += &format!("  - {{name: plc{number}, endpoint: '{url}', security: {policy}}}\n");
        let node = |name: &str| format!("{{server: plc{number}, node: 'nsu={URI};s=Line.{name}'}}");
        variables += &format!(
            "  - {{node: ns=2;i={}, name: speed{number}, type: Double, origin: 0, from: {}}}\n\
             \x20 - {{node: ns=2;i={}, name: wish{number}, type: Double, origin: 0, to: {}}}\n",
            10 + number,
            node("Speed"),
            20 + number,
            node("Setpoint"),
        );
    }
    let mut plcs: Vec<Child> = plcs.into_iter().map(|plc| plc.ready(SOON)).collect();
    let mapping = format!(
        "namespaces: {{2: 'urn:ua-bridge:system-tests'}}\nservers:\n{servers}variables:\n{variables}"
    );
    let file = cell.file("policies.yaml", &mapping);
    let _server = cell.ua_server(&[file.to_str().unwrap()]);
    let links = |pick: &dyn Fn(&Value) -> bool| {
        eventually("the links are told as they are", SOON, || {
            let told = metrics(METRICS_SERVER)?["servers"].clone();
            let all = told.as_array()?;
            (all.len() == 6 && all.iter().all(pick)).then_some(())
        });
    };
    // No server is trusted only because it has a certificate.
    links(&|told| told["up"] == false && told["why"].is_string());
    let trusted = Command::new(program("ua-server"))
        .arg("trust")
        .arg(folder.join("server_certificate.der"))
        .arg("--pki")
        .arg(cell.folder().join("pki"))
        .output()
        .unwrap();
    assert!(trusted.status.success(), "{trusted:?}");
    links(&|told| told["up"] == true && told["secured"] == true);
    for (number, plc) in plcs.iter_mut().enumerate() {
        let value = 1.5 + f64::from(u8::try_from(number).unwrap());
        let (speed, wish) = (
            format!("ns=2;i={}", 10 + number),
            format!("ns=2;i={}", 20 + number),
        );
        let set = if number < POLICIES.len() {
            json!({"set": "Speed", "value": value})
        } else {
            json!({"set": value})
        };
        plc.ask(&set.to_string(), SOON);
        let mut watch = cell.asyncua("opcua_subscribe.py", &[SERVER_ENDPOINT, &speed]);
        shows(&mut watch, &speed, "Good", &json!(value));
        let write = [SERVER_ENDPOINT, &wish, "Double", &value.to_string()];
        let wrote = cell.asyncua_once("opcua_write.py", &write).remove(0);
        assert_eq!(wrote["status"], "Good");
        written(plc, value);
    }
}
