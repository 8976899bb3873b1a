//! Several brokers: a NATS cluster of three nodes and two mosquittos with a bridge. Nodes are
//! stopped and killed while commands and states are sent.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{
    BROKER, Bridged, Cell, Child, METRICS_ROS1, METRICS_ROS2, NatsCluster, Peer, SERVER_ENDPOINT,
    StartedChild, eventually, http_answer, metrics,
};

use super::commanded::{COMMAND, Commanded};
use super::{SOON, space};

/// Texts of a run, and their rate per second.
const TEXTS: u32 = 1500;
const RATE: &str = "100";

/// The most states that NATS 2.9 does not deliver to one of several readers with QoS 1.
const NATS_LOSES: u64 = 15;

/// The topic of the state in ROS 1, where it originates.
const NUMBER: [&str; 2] = ["/number", "std_msgs/String"];
/// Its topic in ROS 2, and the domain.
const NUMBER_ROS2: [&str; 4] = ["/ua_1_5_10", "std_msgs/String", "--domain", "2"];

/// Returns a mapping of a program at a broker. A state may wait longer than the election of a new
/// leader takes, and with QoS 1 also longer than the broker needs for the states that wait.
fn states(cell: &Cell, name: &str, (address, qos): (&str, u8)) -> String {
    let within = if qos == 0 { 15 } else { 30 };
    let text = format!(
        "pubsub: {{address: \"{address}\", mqtt: {{qos: {qos}, within: {within}s}}}}\n\
         spaces: [{{id: 1}}, {{id: 2}}]\n\
         namespaces: {{5: urn:ua-bridge:system-tests}}\n\
         variables:\n\
         \x20 - {{node: ns=5;i=10, name: Number, origin: 1, queue: keep_latest, \
         ros: {{topic: /number, type: std_msgs/String}}}}\n"
    );
    cell.file(name, &text).to_str().unwrap().to_owned()
}

/// Starts the publisher of numbered texts in ROS 1 and the subscriber in ROS 2. The publisher sends
/// `warm` until it is told to begin.
fn numbered(cell: &Cell) -> (Child, Child) {
    let mut receives = cell.cyclone("ros2_sub.py", &NUMBER_ROS2);
    let count = TEXTS.to_string();
    let numbered = ["--numbered", &count, "--rate", RATE];
    let warm_up = ["--warm-up", "\"warm\""];
    let sends = cell
        .rospy_started("ros1_pub.py", &[&NUMBER[..], &numbered, &warm_up].concat())
        .told()
        .start()
        .ready(SOON);
    receives.wait_for_json("the first text", SOON * 2, |line| {
        line.get("value").map(drop)
    });
    (sends, receives)
}

/// Returns the numbers that arrived, in their order.
fn arrived(receives: &Child) -> Vec<u32> {
    let values = receives.values().into_iter();
    values
        .filter_map(|value| value["data"].as_str()?.parse().ok())
        .collect()
}

/// Returns the number of states that a newer state replaced while they waited for the broker.
fn replaced() -> u64 {
    let status = metrics(METRICS_ROS1).unwrap_or_default();
    status["broker"]["dropped"]["queue_replaced"]
        .as_u64()
        .unwrap_or_default()
}

/// Returns a counter of the state in a program.
fn counter(program: &str, name: &str) -> u64 {
    let status = metrics(program).unwrap_or_default();
    let counters = &status["topics"]["ua_1_5_10"];
    counters[name].as_u64().unwrap_or_default()
}

/// Waits for the last text.
fn ends(receives: &Child, within: Duration) {
    eventually("the last text arrives", within, || {
        arrived(receives).contains(&(TEXTS - 1)).then_some(())
    });
}

/// The loss of states when a node is killed.
#[derive(Debug)]
struct Loss {
    /// States that bridge-ros2 counted as missing by their sequence numbers.
    missing: u64,
    /// States that a newer state replaced before they were sent.
    replaced: u64,
    /// States that waited too long for the broker.
    expired: u64,
    /// Messages that bridge-ros2 did not take from the broker in time.
    overflow: u64,
}

/// Kills the third node while states cross from the first to the second, and checks that each
/// state arrives at most once, in order. Each state that bridge-ros2 had not delivered when the
/// last arrived is counted. A subscriber sees the newest of several states that arrive at once.
fn crosses_beside_a_dying_node(cell: &Cell, qos: u8, within: Duration) -> Loss {
    let mut cluster = cell.nats("", &[]);
    let _master = cell.roscore();
    let [ros1, ros2] = [(0, "ros1.yaml"), (1, "ros2.yaml")]
        .map(|(node, name)| states(cell, name, (&NatsCluster::address(node), qos)));
    let _bridges = (cell.bridge_ros1(&[&ros1]), cell.bridge_ros2(&[&ros2]));
    for program in [METRICS_ROS1, METRICS_ROS2] {
        eventually("the program is connected", SOON * 2, || {
            let (code, _) = http_answer(program, "/readyz")?;
            (code == 200).then_some(())
        });
    }
    let (mut sends, receives) = numbered(cell);
    let start = counter(METRICS_ROS2, "missing");
    sends.tell("begin");
    eventually("a part of the texts arrives", SOON, || {
        (arrived(&receives).len() > 200).then_some(())
    });
    cluster.kill(2);
    ends(&receives, within);
    let got = arrived(&receives);
    assert!(got.windows(2).all(|pair| pair[0] < pair[1]), "{got:?}");
    let (sent, delivered) = (
        counter(METRICS_ROS1, "sent"),
        counter(METRICS_ROS2, "delivered"),
    );
    assert!(sent >= u64::from(TEXTS), "{sent} sent");
    let (lost, missing) = (sent - delivered, counter(METRICS_ROS2, "missing"));
    let (replaced, seen) = (replaced(), got.len());
    eprintln!(
        "QoS {qos}: {sent} sent, {delivered} delivered, {replaced} replaced, {missing} missing, {seen} seen"
    );
    let at_brokers = [METRICS_ROS1, METRICS_ROS2].map(|program| {
        let status = metrics(program).unwrap_or_default();
        status["broker"]["dropped"].clone()
    });
    eprintln!("{at_brokers:?}");
    // Values before the first text may precede the discovery of the topic.
    let before = sent - u64::from(TEXTS);
    assert!(
        lost <= missing + before,
        "{lost} lost, {missing} counted, {before} before the texts"
    );
    let [of_sender, of_receiver] = at_brokers;
    let counted = |of: &Value, reason: &str| of[reason].as_u64().unwrap();
    Loss {
        missing: missing - start,
        replaced,
        expired: counted(&of_sender, "queue_expired"),
        overflow: counted(&of_receiver, "received_overflow"),
    }
}

#[test]
fn states_of_qos_0_go_on_and_their_loss_is_counted_when_a_node_of_three_is_killed_under_load() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Nats]) else {
        return;
    };
    let _counted = crosses_beside_a_dying_node(&cell, 0, SOON);
}

#[test]
fn states_of_qos_1_are_lost_by_nats_alone_when_a_node_of_three_is_killed_under_load() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Nats]) else {
        return;
    };
    let loss = crosses_beside_a_dying_node(&cell, 1, SOON * 2);
    let Loss {
        missing,
        replaced,
        expired,
        overflow,
    } = loss;
    assert_eq!((replaced, expired, overflow), (0, 0, 0), "{loss:?}");
    assert!(missing <= NATS_LOSES, "{loss:?}");
}

/// Starts a server and a bridge at different brokers.
fn commanded(cell: &Cell, addresses: [&str; 2]) -> (Child, Child) {
    let [server, bridge] =
        [("server.yaml", addresses[0]), ("bridge.yaml", addresses[1])].map(|(name, address)| {
            let file = cell.file(name, &COMMAND.replace(BROKER, address));
            file.to_str().unwrap().to_owned()
        });
    let server = cell.ua_server(&[&server]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    (server, cell.bridge_ros1(&[&bridge]))
}

#[test]
fn a_command_over_a_cluster_is_never_late_when_nodes_stop_and_die() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Nats]) else {
        return;
    };
    let mut cluster = cell.nats("", &[]);
    let _master = cell.roscore();
    let [first, second] = [0, 1].map(NatsCluster::address);
    let _programs = commanded(&cell, [&first, &second]);
    let mut commanded = Commanded::robot(&cell);
    commanded.arrives();

    // The node of the bridge is stopped.
    cluster.signal(1, Signal::SIGSTOP);
    assert_eq!(commanded.write(1002.0), "BadTimeout");
    cluster.signal(1, Signal::SIGCONT);
    commanded.never_arrives(1002.0);
    commanded.arrives();

    // The third node dies: commands need no stored messages.
    cluster.kill(2);
    commanded.arrives();

    // The node of the bridge dies.
    cluster.kill(1);
    assert_eq!(commanded.write(1005.0), "BadTimeout");
    cluster.start(&[]);
    commanded.never_arrives(1005.0);
    commanded.arrives();
}

#[test]
fn a_command_over_two_bridged_brokers_is_never_late() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let mut brokers = cell.bridged();
    let _master = cell.roscore();
    let _programs = commanded(&cell, [BROKER, Bridged::FAR]);
    let mut commanded = Commanded::robot(&cell);
    commanded.arrives();

    brokers.signal_far(Signal::SIGSTOP);
    assert_eq!(commanded.write(1002.0), "BadTimeout");
    brokers.signal_far(Signal::SIGCONT);
    commanded.never_arrives(1002.0);
    commanded.arrives();

    brokers.kill_far();
    assert_eq!(commanded.write(1005.0), "BadTimeout");
    brokers.start();
    commanded.never_arrives(1005.0);
    commanded.arrives();
}

#[test]
fn values_cross_two_bridged_brokers_once() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Mosquitto]) else {
        return;
    };
    let _brokers = cell.bridged();
    let _master = cell.roscore();
    let [ros1, ros2] = [("ros1.yaml", BROKER), ("ros2.yaml", Bridged::FAR)]
        .map(|(name, address)| states(&cell, name, (address, 1)));
    let _bridges = (cell.bridge_ros1(&[&ros1]), cell.bridge_ros2(&[&ros2]));
    let (mut sends, receives) = numbered(&cell);
    sends.tell("begin");
    ends(&receives, SOON * 3);
    let got = arrived(&receives);
    assert!(got.windows(2).all(|pair| pair[0] < pair[1]), "{got:?}");
    let missing = u64::from(TEXTS) - u64::try_from(got.len()).unwrap();
    assert!(missing <= replaced(), "{missing} missing");
    let status = metrics(METRICS_ROS2).unwrap();
    assert_eq!(status["topics"]["ua_1_5_10"]["sender_changed"], 0);
}

#[test]
fn generated_permissions_of_nats_keep_a_space_from_sending_in_the_name_of_another() {
    let Some(cell) = Cell::with(&[Peer::Nats, Peer::Mosquitto]) else {
        return;
    };
    let address = NatsCluster::address(0);
    let mapping = format!("pubsub: {{address: \"{address}\"}}\nspaces: [{{id: 1}}, {{id: 2}}]\n");
    let mapping = cell.file("cell.yaml", &mapping);
    let rules = space(&["acl", mapping.to_str().unwrap(), "--nats"]);
    let users = ["space-0", "space-1", "space-2", "tools"];
    let _cluster = cell.nats(&rules, &users);
    // A message may cross to another node.
    let at = |node: u16| ["-p".to_owned(), NatsCluster::port(node).to_string()];
    let mut seen = StartedChild::new("mosquitto_sub", "/usr/bin/mosquitto_sub".as_ref())
        .args([
            "-h",
            "127.0.0.1",
            "-u",
            "tools",
            "-P",
            "word",
            "-t",
            "opcua/#",
        ])
        .args(at(1))
        .args(["-F", r#"{"topic":"%t"}"#])
        .ends_on(Signal::SIGINT)
        .start();
    let publish = |topic: &str| {
        let sent = std::process::Command::new("mosquitto_pub")
            .args(["-h", "127.0.0.1", "-u", "space-2", "-P", "word"])
            .args(at(0))
            .args(["-t", topic, "-m", topic])
            .status();
        sent.unwrap().success()
    };
    let has = |lines: &[Value], topic: &str| lines.iter().any(|line| line["topic"] == topic);
    eventually("the own topic is allowed", SOON, || {
        // The cluster may not be ready yet.
        let _sent = publish("opcua/uadp/data/1/5/10") && publish("opcua/uadp/data/2/5/10");
        has(&seen.json_lines(), "opcua/uadp/data/2/5/10").then_some(())
    });
    assert!(publish("opcua/uadp/data/1/5/11") && publish("opcua/uadp/data/2/5/11"));
    seen.wait_for_json("the last message", SOON, |line| {
        (line["topic"] == "opcua/uadp/data/2/5/11").then_some(())
    });
    let lines = seen.json_lines();
    let forged = ["opcua/uadp/data/1/5/10", "opcua/uadp/data/1/5/11"];
    assert!(!forged.iter().any(|topic| has(&lines, topic)), "{lines:?}");
}
