//! The space over an MQTT broker: values, discovery, secured groups and TLS, commands that a broker
//! could deliver late, and programs that forward between UDP and a broker.

mod clusters;
pub(crate) mod commanded;
mod foreign_json;
mod judges;
mod late_joiner;

use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    BROKER, Cell, Child, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, Peer, SERVER_ENDPOINT,
    eventually, holds_for, http_answer, metrics, program,
};
use uadp::NetworkMessage;
use uadp::discovery::{AnnouncedContent, Announcement, ConnectionState};

use commanded::{COMMAND, Commanded};

const SOON: Duration = Duration::from_secs(30);
const TOPIC: [&str; 2] = ["/ua_1_5_10", "std_msgs/String"];
const OVER_MQTT: [&str; 2] = ["--address", BROKER];

/// Runs `ua-space` and returns its output.
pub(crate) fn space(args: &[&str]) -> String {
    let output = Command::new(program("ua-space"))
        .args(args)
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {told}");
    String::from_utf8(output.stdout).unwrap()
}

/// Starts a node of ROS 1 that publishes a text ten times a second, and a subscriber in ROS 2.
fn ends(cell: &Cell, text: &str) -> (Child, Child) {
    let value = json!(text).to_string();
    let repeat = ["--repeat", "0", "--value", &value];
    let sends = cell.rospy("ros1_pub.py", &[&TOPIC[..], &repeat[..]].concat());
    let receives = cell.cyclone("ros2_sub.py", &[&TOPIC[..], &["--domain", "2"]].concat());
    (sends, receives)
}

fn arrives(receives: &mut Child, text: &str) {
    let value = |line: &Value| line.get("value").cloned();
    let got = receives.wait_for_json("the text in ROS 2", SOON, value);
    assert_eq!(got, json!({ "data": text }));
}

#[test]
fn values_cross_a_broker_that_is_late_and_restarts_and_its_topics_are_those_of_the_standard() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let _master = cell.roscore();
    let ros1 = cell.bridge_ros1(&OVER_MQTT);
    let _ros2 = cell.bridge_ros2(&OVER_MQTT);
    eventually(
        "the bridge reports that it waits for the broker",
        SOON,
        || {
            let (code, why) = http_answer(METRICS_ROS1, "/readyz")?;
            (code == 503 && why.contains("waiting for broker mqtt://127.0.0.1:1883")).then_some(())
        },
    );
    let broker = cell.mosquitto();
    let (_sends, mut receives) = ends(&cell, "over MQTT");
    arrives(&mut receives, "over MQTT");

    let mut seen = cell.mosquitto_sub(&["-t", "opcua/#"]);
    let data = seen.wait_for_json("a value at its topic", SOON, |line| {
        (line["topic"] == "opcua/uadp/data/1/5/10").then(|| line.clone())
    });
    assert_eq!(data["retain"], json!(0));
    let text = data.to_string();
    assert!(
        text.contains("ua-data") && text.contains("application/opcua+uadp"),
        "{text}"
    );
    let retained = eventually("metadata and status are retained", SOON, || {
        let topics = cell.retained("opcua/#");
        let wanted = ["opcua/uadp/metadata/1/5/10", "opcua/uadp/status/1"];
        wanted
            .iter()
            .all(|topic| topics.iter().any(|of| of == topic))
            .then_some(topics)
    });
    assert!(
        !retained.iter().any(|topic| topic.contains("/data/")),
        "{retained:?}"
    );

    is_listed_and_echoed();

    broker.signal(Signal::SIGKILL);
    drop(broker);
    eventually("the loss is reported", SOON, || {
        let (code, _) = http_answer(METRICS_ROS2, "/readyz")?;
        (code == 503).then_some(())
    });
    let _broker = cell.mosquitto();
    let before = delivered();
    eventually("values cross again", SOON, || {
        (delivered() > before).then_some(())
    });
    eventually("the broker has the metadata again", SOON, || {
        let topics = cell.retained("opcua/uadp/metadata/#");
        topics
            .contains(&"opcua/uadp/metadata/1/5/10".to_owned())
            .then_some(())
    });

    // A program that ends in order leaves nothing but its status.
    let mut ros1 = ros1;
    assert!(ros1.end().success());
    eventually("the discovery messages are cleared", SOON, || {
        let topics = cell.retained("opcua/uadp/+/1/#");
        (topics == ["opcua/uadp/status/1"]).then_some(())
    });
}

/// Checks that the tools show the topic and its value.
fn is_listed_and_echoed() {
    let listed = space(&[
        "list",
        "--topics",
        "--seconds",
        "3",
        "--json",
        "--address",
        BROKER,
    ]);
    let listed: Value = serde_json::from_str(&listed).unwrap();
    let topics = listed["topics"].as_array().unwrap();
    let listed = topics
        .iter()
        .find(|line| line["topic"] == "ua_1_5_10")
        .unwrap();
    assert_eq!(listed["type"], "std_msgs/String");
    let echoed = space(&[
        "echo",
        "ua_1_5_10",
        "-n",
        "1",
        "--seconds",
        "20",
        "--address",
        BROKER,
    ]);
    assert!(echoed.contains("over MQTT"), "{echoed}");
}

/// Returns the number of values that bridge-ros2 delivered.
fn delivered() -> u64 {
    let status = metrics(METRICS_ROS2).unwrap_or_default();
    status["topics"]["ua_1_5_10"]["delivered"]
        .as_u64()
        .unwrap_or_default()
}

#[test]
fn a_command_is_never_delivered_late_by_a_broker() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let folder = cell.folder().display();
    let stored = format!(
        "listener 1883 127.0.0.1\nallow_anonymous true\npersistence true\npersistence_location {folder}/\nautosave_interval 1\n"
    );
    let broker = cell.mosquitto_with(&stored);
    let _master = cell.roscore();
    let mapping = cell.file("command.yaml", COMMAND);
    let mapping = mapping.to_str().unwrap();
    let _server = cell.ua_server(&[mapping]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let bridge = cell.bridge_ros1(&[mapping]);
    let mut commanded = Commanded::robot(&cell);
    commanded.arrives();
    commanded.copy_is_dropped();

    // The broker is stopped for a time in which its clients may stay.
    broker.signal(Signal::SIGSTOP);
    assert_eq!(commanded.write(1002.0), "BadTimeout");
    broker.signal(Signal::SIGCONT);
    commanded.never_arrives(1002.0);
    commanded.arrives();

    // The broker is stopped for 5 s.
    broker.signal(Signal::SIGSTOP);
    assert_eq!(commanded.write(1005.0), "BadTimeout");
    eventually("the server leaves the broker", SOON, || {
        let (code, why) = http_answer(METRICS_SERVER, "/readyz")?;
        (code == 503 && why.contains("waiting for broker")).then_some(())
    });
    broker.signal(Signal::SIGCONT);
    commanded.never_arrives(1005.0);
    commanded.arrives();

    // The broker restarts with its stored messages.
    broker.signal(Signal::SIGSTOP);
    assert_eq!(commanded.write(1006.0), "BadTimeout");
    broker.signal(Signal::SIGTERM);
    broker.signal(Signal::SIGCONT);
    drop(broker);
    let _broker = cell.mosquitto_with(&stored);
    commanded.never_arrives(1006.0);
    commanded.arrives();

    // The reader is absent.
    drop(bridge);
    assert_eq!(commanded.write(1007.0), "BadTimeout");
    let _bridge = cell.bridge_ros1(&[mapping]);
    commanded.never_arrives(1007.0);
    commanded.arrives();
}

/// Returns the retained status of space 1.
fn status_of_ros1() -> Option<ConnectionState> {
    let output = Command::new("/usr/bin/mosquitto_sub")
        .args(["-h", "127.0.0.1", "-t", "opcua/uadp/status/1"])
        .args(["-C", "1", "-W", "2", "-F", "%x"])
        .output()
        .unwrap();
    let hex = String::from_utf8(output.stdout).unwrap();
    let bytes: Option<Vec<u8>> = (0..hex.trim().len())
        .step_by(2)
        .map(|at| u8::from_str_radix(hex.get(at..at + 2)?, 16).ok())
        .collect();
    let bytes = bytes?;
    let message = NetworkMessage::decode(&bytes).ok()?;
    let AnnouncedContent::ApplicationStatus { state, .. } =
        Announcement::decode(&message).ok()?.announced
    else {
        return None;
    };
    Some(state)
}

#[test]
fn a_broker_reports_a_killed_bridge_that_has_a_will() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Mosquitto]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let _master = cell.roscore();
    let text = format!("pubsub: {{address: \"{BROKER}\", mqtt: {{will: true}}}}\n");
    let mapping = cell.file("will.yaml", &text);
    let arguments = [mapping.to_str().unwrap()];
    let status = |wanted: ConnectionState| {
        eventually("the status", SOON, || {
            (status_of_ros1()? == wanted).then_some(())
        });
    };
    let killed = cell.bridge_ros1(&arguments);
    status(ConnectionState::OPERATIONAL);
    killed.signal(Signal::SIGKILL);
    status(ConnectionState::ERROR);
    drop(killed);

    let mut ended = cell.bridge_ros1(&arguments);
    status(ConnectionState::OPERATIONAL);
    assert!(ended.end().success());
    status(ConnectionState::DISABLED);
}

/// The carriers of the program between UDP and the broker.
const BETWEEN: &str = "
pubsub:
  - udp: {}
    forward: [ua_1_5_10, ua_0]
  - mqtt: {address: \"mqtt://127.0.0.1:1883\", encoding: json-verbose}
    forward: [ua_2_5, ua_1_2]
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:ua-bridge:system-tests}
server: {security: [None]}
";

/// Returns the number of forwarded messages and the drops of each carrier.
fn carriers(metrics_address: &str) -> Vec<(u64, Value)> {
    let status = metrics(metrics_address).unwrap_or_default();
    let all = status["carriers"].as_array().into_iter().flatten();
    all.map(|of| {
        (
            of["forwarded"].as_u64().unwrap_or_default(),
            of["dropped"].clone(),
        )
    })
    .collect()
}

#[test]
fn a_topic_is_forwarded_from_udp_to_a_broker_as_json_and_reloaded_routes_end_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let _master = cell.roscore();
    let mapping = cell.file("between.yaml", BETWEEN);
    let mut server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let _ros1 = cell.bridge_ros1(&[]);
    let _ros2 = cell.bridge_ros2(&OVER_MQTT);
    let (_sends, mut receives) = ends(&cell, "over both");
    arrives(&mut receives, "over both");
    let both: [(u64, Value); 2] = carriers(METRICS_SERVER).try_into().unwrap();
    let [(to_udp, _), (to_broker, _)] = both;
    assert!(to_broker > 0, "{to_udp} {to_broker}");
    // Values from UDP are JSON at the broker, as its encoding says.
    let mut seen = cell.mosquitto_sub(&["-t", "opcua/json/data/#"]);
    let topic = seen.wait_for_json("a value as JSON", SOON, |line| line.get("topic").cloned());
    assert_eq!(topic, "opcua/json/data/1/5/10");
    // Nothing goes round in a circle: each value is delivered once.
    let status = metrics(METRICS_ROS2).unwrap();
    let topic = &status["topics"]["ua_1_5_10"];
    assert!(topic["sender_changed"] == 0, "{topic}");
    let (ros1, other) = (metrics(METRICS_ROS1).unwrap(), "space_taken");
    assert!(ros1["others"]["dropped"].get(other).is_none(), "{ros1}");

    let _changed = cell.file("between.yaml", &BETWEEN.replace("ua_1_5_10, ", ""));
    server.signal(Signal::SIGHUP);
    eventually("the route ends", SOON, || {
        let before = delivered();
        let start = carriers(METRICS_SERVER).get(1)?.0;
        holds_for("values are sent", Duration::from_secs(1), || true);
        (delivered() == before && carriers(METRICS_SERVER).get(1)?.0 == start).then_some(())
    });
    let _changed = cell.file("between.yaml", BETWEEN);
    server.signal(Signal::SIGHUP);
    let before = delivered();
    eventually("the route begins again", SOON, || {
        (delivered() > before).then_some(())
    });
    assert!(server.end().success());
}

#[test]
fn a_command_crosses_from_udp_to_a_broker_and_is_never_late() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let broker = cell.mosquitto();
    let _master = cell.roscore();
    let over_mqtt = cell.file("command.yaml", COMMAND);
    let over_mqtt = over_mqtt.to_str().unwrap();
    let (_, common) = COMMAND.split_once("1883\"}\n").unwrap();
    let over_udp = cell.file("udp.yaml", common);
    let (_, variables) = common.split_once("variables:").unwrap();
    let between =
        format!("{BETWEEN}variables:{variables}").replacen("server: {security: [None]}\n", "", 1);
    let between = cell.file("between.yaml", &between);
    let _server = cell.ua_server(&[over_udp.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let bridge = cell.bridge_ros1(&[over_mqtt]);
    let _between = cell.bridge_ros2(&[between.to_str().unwrap()]);
    let mut commanded = Commanded::robot(&cell);
    commanded.arrives();

    // The broker is stopped for a time in which its clients may stay.
    broker.signal(Signal::SIGSTOP);
    assert_eq!(commanded.write(1002.0), "BadTimeout");
    broker.signal(Signal::SIGCONT);
    commanded.never_arrives(1002.0);
    commanded.arrives();

    // The reader is absent.
    drop(bridge);
    assert_eq!(commanded.write(1007.0), "BadTimeout");
    let _bridge = cell.bridge_ros1(&[over_mqtt]);
    commanded.never_arrives(1007.0);
    commanded.arrives();
}

/// A service of ROS 2 behind a broker, which everybody may call.
const GRIP: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:ua-bridge:system-tests}
calls:
  - node: ns=5;i=60
    name: grip
    origin: 2
    open: true
    ros: {service: /grip, type: std_srvs/Trigger}
";

/// Calls the service from ROS 1 and returns the response or the error.
fn grip(cell: &Cell) -> Value {
    let args = ["/ua_2_5_60", "std_srvs/Trigger", "--value", "{}"];
    let mut client = cell.rospy("ros1_call.py", &args);
    client.wait_for_json("an outcome", SOON, |line| {
        line.get("value").or_else(|| line.get("error")).cloned()
    })
}

#[test]
fn a_call_crosses_from_a_program_with_udp_alone_to_a_broker_and_is_never_late() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let broker = cell.mosquitto();
    let _master = cell.roscore();
    let between = cell.file("between.yaml", BETWEEN);
    let grips = cell.file("grip.yaml", GRIP);
    let _server = cell.ua_server(&[between.to_str().unwrap()]);
    let _ros1 = cell.bridge_ros1(&[]);
    let _ros2 = cell.bridge_ros2(&[&OVER_MQTT[..], &[grips.to_str().unwrap()]].concat());
    let serve = ["serve", "--domain", "2", "empty=/grip"];
    let mut executors = cell.executors([cell.cyclone_started("calls/cyclone.py", &serve)]);
    let executor = &mut executors[0];
    assert_eq!(grip(&cell)["success"], true);
    assert_eq!(executor.counts()["executed"], 1);

    // The broker is stopped until the caller has given up.
    broker.signal(Signal::SIGSTOP);
    let outcome = grip(&cell);
    assert!(
        outcome.as_str().is_some_and(|of| of.contains("unknown")),
        "{outcome}"
    );
    broker.signal(Signal::SIGCONT);
    eventually("both programs reach the broker", SOON, || {
        let ready = |of| http_answer(of, "/readyz").is_some_and(|(code, _)| code == 200);
        [METRICS_SERVER, METRICS_ROS2]
            .into_iter()
            .all(ready)
            .then_some(())
    });
    assert_eq!(grip(&cell)["success"], true);
    assert_eq!(executor.counts()["executed"], 2);
}

#[test]
fn a_secured_group_is_sealed_from_end_to_end_and_the_broker_cannot_read_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let keys = cell.folder().join("cell.keys");
    let keys = keys.to_str().unwrap();
    space(&["keys", keys]);
    let mapping = cell.file(
        "cell.yaml",
        "security: [{group: cell, keys: {file: cell.keys}}]\n",
    );
    let secured = [&OVER_MQTT[..], &["--security", mapping.to_str().unwrap()]].concat();
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&secured), cell.bridge_ros2(&secured));
    let (_sends, mut receives) = ends(&cell, "a recipe");
    let mut seen = Command::new("/usr/bin/mosquitto_sub");
    arrives(&mut receives, "a recipe");
    let seen = seen
        .args([
            "-h",
            "127.0.0.1",
            "-t",
            "opcua/uadp/data/#",
            "-C",
            "3",
            "-F",
            "%x",
        ])
        .output()
        .unwrap();
    let seen = String::from_utf8(seen.stdout).unwrap();
    let hidden: String = "a recipe"
        .bytes()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    assert!(
        seen.lines().count() == 3 && !seen.contains(&hidden),
        "{seen}"
    );
    let echo = [
        "echo",
        "ua_1_5_10",
        "-n",
        "1",
        "--seconds",
        "20",
        "--keys",
        keys,
    ];
    let echoed = space(&[&echo[..], &OVER_MQTT[..]].concat());
    assert!(echoed.contains("a recipe"), "{echoed}");
}

#[test]
fn a_broker_with_tls_takes_a_client_with_its_certificate_and_password_only() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    cell.broker_certificates();
    let folder = cell.folder();
    let passwords = folder.join("passwords");
    let made = Command::new("mosquitto_passwd")
        .args(["-b", "-c", passwords.to_str().unwrap(), "cell", "a word"])
        .status();
    assert!(made.unwrap().success());
    let at = folder.display();
    let _broker = cell.mosquitto_with(&format!(
        "listener 8883 127.0.0.1\ncafile {at}/ca.pem\ncertfile {at}/broker.pem\nkeyfile {at}/broker.key\n\
         require_certificate true\nallow_anonymous false\npassword_file {at}/passwords\n"
    ));
    let _credentials = cell.file("login.txt", "cell\na word\n");
    let mapping = |name: &str, more: &str| {
        let text = format!(
            "pubsub:\n  address: mqtts://127.0.0.1:8883\n  mqtt: {{ca: ca.pem, credentials: login.txt{more}}}\n"
        );
        cell.file(name, &text).to_str().unwrap().to_owned()
    };
    let whole = mapping("whole.yaml", ", certificate: client.pem, key: client.key");
    let bare = mapping("bare.yaml", "");
    let _master = cell.roscore();
    let _ros1 = cell.bridge_ros1(&[&whole]);
    {
        let _ros2 = cell.bridge_ros2(&[&bare]);
        eventually("the client without a certificate is refused", SOON, || {
            let (code, why) = http_answer(METRICS_ROS2, "/readyz")?;
            (code == 503 && why.contains("mqtts://127.0.0.1:8883")).then_some(())
        });
    }
    let _ros2 = cell.bridge_ros2(&[&whole]);
    let (_sends, mut receives) = ends(&cell, "over TLS");
    arrives(&mut receives, "over TLS");
    let echoed = space(&[
        "echo",
        "ua_1_5_10",
        "-n",
        "1",
        "--seconds",
        "20",
        "--broker",
        &whole,
    ]);
    assert!(echoed.contains("over TLS"), "{echoed}");
}

#[test]
fn values_cross_as_json_and_those_of_another_publisher_are_read() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let _broker = cell.mosquitto();
    let mapping = cell.file(
        "json.yaml",
        "pubsub: {address: \"mqtt://127.0.0.1:1883\", mqtt: {encoding: json-verbose, version: \"3.1.1\"}}\n",
    );
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[mapping]), cell.bridge_ros2(&[mapping]));
    let (_sends, mut receives) = ends(&cell, "as JSON");
    arrives(&mut receives, "as JSON");
    let mut seen = cell.mosquitto_sub_texts(&["-t", "opcua/json/#"]);
    for (topic, holds) in [
        ("opcua/json/metadata/1/5/10", "ua-metadata"),
        ("opcua/json/status/1", "NextReportTime"),
        ("opcua/json/data/1/5/10", "as JSON"),
    ] {
        let message = seen.wait_for_json(topic, SOON, |line| {
            (line["topic"] == topic).then(|| line["payload"].to_string())
        });
        assert!(message.contains(holds), "{message}");
    }

    let named = ["/ua_3_5_11", "std_msgs/String"];
    let mut receives = cell.rospy("ros1_sub.py", &named);
    let mut number = 0;
    let text = eventually("a value of another publisher arrives", SOON, || {
        number += 1;
        let output = Command::new("date")
            .args(["-u", "+%Y-%m-%dT%H:%M:%S.%3NZ"])
            .output()
            .unwrap();
        let time = String::from_utf8(output.stdout).unwrap();
        let message = json!({
            "MessageId": "1",
            "MessageType": "ua-data",
            "PublisherId": "3",
            "Messages": [{
                "DataSetWriterId": 11,
                "SequenceNumber": number,
                "Timestamp": time.trim(),
                "Payload": {"data": {"UaType": 12, "Value": "from elsewhere"}},
            }],
        });
        let sent = Command::new("mosquitto_pub")
            .args(["-h", "127.0.0.1", "-t", "opcua/json/data/3/5/11"])
            .args(["-m", &message.to_string()])
            .status();
        assert!(sent.unwrap().success());
        let mut lines = receives.json_lines().into_iter();
        lines.find_map(|line| line["value"]["data"].as_str().map(str::to_owned))
    });
    assert_eq!(text, "from elsewhere");
    assert!(receives.runs());
}

#[test]
fn generated_access_rules_keep_a_space_from_sending_in_the_name_of_another() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    let mapping = cell.file(
        "cell.yaml",
        "pubsub: {address: \"mqtt://127.0.0.1:1883\"}\nspaces: [{id: 1}, {id: 2}]\n",
    );
    let rules = space(&["acl", mapping.to_str().unwrap()]);
    let rules = cell.file("rules.acl", &rules);
    let passwords = cell.folder().join("passwords");
    let _empty = cell.file("passwords", "");
    for user in ["space-2", "tools"] {
        let made = Command::new("mosquitto_passwd")
            .args(["-b", passwords.to_str().unwrap(), user, "word"])
            .status();
        assert!(made.unwrap().success());
    }
    let _broker = cell.mosquitto_with(&format!(
        "listener 1883 127.0.0.1\nallow_anonymous false\npassword_file {}\nacl_file {}\n",
        passwords.display(),
        rules.display()
    ));
    let mut seen = cell.mosquitto_sub(&["-t", "opcua/#", "-u", "tools", "-P", "word"]);
    let publish = |topic: &str| {
        let sent = Command::new("mosquitto_pub")
            .args(["-h", "127.0.0.1", "-u", "space-2", "-P", "word"])
            .args(["-t", topic, "-m", topic])
            .status();
        assert!(sent.unwrap().success());
    };
    eventually("the own topic is allowed", SOON, || {
        publish("opcua/uadp/data/1/5/10");
        publish("opcua/uadp/data/2/5/10");
        let lines = seen.json_lines();
        let own = lines
            .iter()
            .any(|line| line["topic"] == "opcua/uadp/data/2/5/10");
        own.then_some(())
    });
    publish("opcua/uadp/data/1/5/11");
    publish("opcua/uadp/data/2/5/11");
    seen.wait_for_json("the last message", SOON, |line| {
        (line["topic"] == "opcua/uadp/data/2/5/11").then_some(())
    });
    let lines = seen.json_lines();
    let forged = lines.iter().filter(|line| {
        let topic = line["topic"].as_str().unwrap_or_default();
        topic.starts_with("opcua/uadp/data/1/")
    });
    assert_eq!(forged.count(), 0);
}
