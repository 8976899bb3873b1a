//! The bridge as a node of the ROS 2 graph in the view of Cyclone DDS: its name, its readers and
//! writers, and their announcements.

use std::collections::BTreeSet;
use std::time::Duration;

use ros2_node::clock::Ros2Time;
use ros2_node::discovery_info::{GidLength, NodeEntities};
use ros2_node::domain::{Domain, DomainOptions, can_announce_type_hashes};
use ros2_node::node::NodeOptions;
use ros2_node::qos::{Offered, Requested};
use serde_json::Value;
use system_tests::{Cell, Child, METRICS_ROS2, Peer, UaSide, eventually, metrics};
use uadp::Scalar;

const DOMAIN: u16 = 2;
const SOON: Duration = Duration::from_secs(20);
const STRING: &str = "std_msgs::msg::dds_::String_";

fn join(node: NodeOptions) -> Domain {
    Domain::join(&DomainOptions {
        domain: DOMAIN,
        enclave: None,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node,
    })
    .unwrap()
}

/// Starts a participant that reads node lists with Gids of `gid` bytes and announces the nodes
/// `names`.
fn sees(cell: &Cell, gid: &str, names: &[&str]) -> Child {
    let mut args = vec!["--domain", "2", "--gid", gid];
    for name in names {
        args.extend(["--node", name]);
    }
    cell.cyclone("ros2_graph.py", &args)
}

/// Returns the graph as last printed by a peer.
fn graph(peer: &Child) -> Value {
    let lines = peer.json_lines();
    let last = lines
        .iter()
        .filter_map(|line| line.get("graph"))
        .next_back();
    last.cloned().unwrap_or_default()
}

/// Returns the node with this name in the view of a peer.
fn node(peer: &Child, name: &str) -> Option<Value> {
    let graph = graph(peer);
    let mut nodes = graph["nodes"]
        .as_object()?
        .values()
        .flat_map(|nodes| nodes.as_array().unwrap());
    nodes.find(|node| node["name"] == name).cloned()
}

fn hex(guid: [u8; 16]) -> String {
    guid.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn texts(list: &Value) -> BTreeSet<String> {
    list.as_array()
        .unwrap()
        .iter()
        .map(|text| text.as_str().unwrap().to_owned())
        .collect()
}

/// Returns the topics that the participant of `domain` writes or reads according to a peer's
/// built-in topics.
fn announced(peer: &Child, domain: &Domain, kind: &str) -> BTreeSet<(String, String)> {
    let participant = hex(domain.guid().to_bytes());
    graph(peer)[kind]
        .as_object()
        .into_iter()
        .flatten()
        .filter(|(_, endpoint)| endpoint["participant"] == participant)
        .map(|(guid, endpoint)| (guid.clone(), endpoint["topic"].as_str().unwrap().to_owned()))
        .collect()
}

/// Waits until the peer sees exactly the endpoints of the domain at the node.
fn has_exactly(peer: &Child, name: &str, domain: &Domain, what: &str) {
    eventually(what, SOON, || {
        let node = node(peer, name)?;
        let listed = |kind: &str| texts(&node[kind]);
        let (writers, readers) = (
            announced(peer, domain, "publications"),
            announced(peer, domain, "subscriptions"),
        );
        // The topic of the node lists itself belongs to no node.
        let of_node = |endpoints: BTreeSet<(String, String)>| -> BTreeSet<String> {
            let endpoints = endpoints.into_iter();
            let of_node = endpoints.filter(|(_, topic)| topic != "ros_discovery_info");
            of_node.map(|(guid, _)| guid).collect()
        };
        (listed("writers") == of_node(writers) && listed("readers") == of_node(readers))
            .then_some(())
    });
}

fn topics(endpoints: BTreeSet<(String, String)>) -> Vec<String> {
    let mut topics: Vec<String> = endpoints.into_iter().map(|(_, topic)| topic).collect();
    topics.sort();
    topics
}

#[test]
fn a_node_lists_the_readers_and_writers_the_domain_knows_and_no_odd_topics() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let peer = sees(&cell, "16", &[]);
    let domain = join(NodeOptions {
        namespace: "/cell".into(),
        use_sim_time: true,
        ..NodeOptions::from("bridge")
    });
    let name = "/cell/bridge";
    domain.learn_type_hash(STRING, STRING_HASH);
    let writer = domain
        .writer("rt/ua_1_1_1", STRING, Offered::KeepLatest)
        .unwrap();
    let reader = domain
        .reader("rt/ua_2_1_1", STRING, Requested::from_writers(&[]))
        .unwrap();
    let guids = [writer.guid(), reader.guid()].map(|guid| hex(guid.to_bytes()));
    eventually("the node lists both", SOON, || {
        let node = node(&peer, name)?;
        (texts(&node["writers"]).contains(&guids[0]) && texts(&node["readers"]).contains(&guids[1]))
            .then_some(())
    });
    has_exactly(&peer, name, &domain, "the node lists what was announced");
    assert_eq!(
        topics(announced(&peer, &domain, "publications")),
        ["ros_discovery_info", "rt/rosout", "rt/ua_1_1_1"]
    );
    assert_eq!(
        topics(announced(&peer, &domain, "subscriptions")),
        ["ros_discovery_info", "rt/clock", "rt/ua_2_1_1"]
    );
    let seen = graph(&peer);
    let types: BTreeSet<&str> = ["publications", "subscriptions"]
        .iter()
        .flat_map(|kind| seen[kind].as_object().unwrap().values())
        .filter(|endpoint| endpoint["topic"] == "rt/clock")
        .map(|endpoint| endpoint["type"].as_str().unwrap())
        .collect();
    assert_eq!(types, BTreeSet::from(["rosgraph_msgs::msg::dds_::Clock_"]));
    let (hash, enclave) = if can_announce_type_hashes() {
        (format!("typehash={STRING_HASH};"), "enclave=/;")
    } else {
        (String::new(), "")
    };
    assert_eq!(seen["publications"][&guids[0]]["user_data"], hash);
    assert_eq!(seen["subscriptions"][&guids[1]]["user_data"], hash);
    assert_eq!(seen["participants"][hex(domain.guid().to_bytes())], enclave);

    drop(writer);
    eventually("the writer is off the list", SOON, || {
        let node = node(&peer, name)?;
        (!texts(&node["writers"]).contains(&guids[0])).then_some(())
    });
    has_exactly(&peer, name, &domain, "the list is still what was announced");
    drop((reader, domain));
    eventually("the node is gone", SOON, || {
        node(&peer, name).is_none().then_some(())
    });
}

/// A node of rmw_cyclonedds logs a warning for each endpoint without a type hash.
#[test]
fn each_reader_and_writer_of_the_bridge_says_the_hash_of_its_type() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[]);
    let judge = join("judge".into());
    let own = judge.guid().prefix;
    let said = eventually("the bridge has told of itself", SOON, || {
        let writers = judge.participant().discovered_writers().into_iter();
        let writers = writers.map(|one| {
            let guid = one.writer_proxy.remote_writer_guid;
            (guid, one.publication_topic_data.topic_name, one.user_data)
        });
        let readers = judge.participant().discovered_readers().into_iter();
        let readers = readers.map(|one| {
            let guid = one.reader_proxy.remote_reader_guid;
            let topic = one.subscription_topic_data.topic_name().clone();
            (guid, topic, one.user_data)
        });
        let all: Vec<_> = writers
            .chain(readers)
            .filter(|(guid, ..)| guid.prefix != own)
            .collect();
        let is_there = |name: &str| all.iter().any(|(_, topic, _)| topic == name);
        let described = "rr/ua_bridge_ros2/get_type_descriptionReply";
        (is_there("ua_bridge_2") && is_there(described)).then_some(all)
    });
    let mute: Vec<_> = said
        .iter()
        .filter(|(.., user_data)| !String::from_utf8_lossy(user_data).contains("typehash=RIHS01_"))
        .map(|(_, topic, _)| topic)
        .collect();
    assert_eq!(mute, [""; 0]);
}

fn names(domain: &Domain) -> BTreeSet<String> {
    domain.nodes().iter().map(NodeEntities::full_name).collect()
}

fn set(names: &[&str]) -> BTreeSet<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[test]
fn nodes_with_either_length_of_gid_are_known_and_most_of_them_know_us() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join("bridge".into());
    let mut newer = sees(&cell, "16", &["iron"]);
    eventually("the newer one knows us", SOON, || node(&newer, "/bridge"));
    let older = sees(&cell, "24", &["foxy", "humble"]);
    eventually("all three are known", SOON, || {
        (names(&domain) == set(&["/foxy", "/humble", "/iron"])).then_some(())
    });
    eventually("the older nodes, which are more, know us", SOON, || {
        node(&older, "/bridge")
    });
    newer.end();
    eventually("a node that left is forgotten", SOON, || {
        domain.graph();
        (names(&domain) == set(&["/foxy", "/humble"])).then_some(())
    });
    drop(older);
    let newer = sees(&cell, "16", &["jazzy"]);
    eventually("the newer ones alone know us again", SOON, || {
        domain.graph();
        node(&newer, "/bridge")
    });
}

#[test]
fn a_length_of_gid_that_was_asked_for_stays() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let older = sees(&cell, "24", &[]);
    let _newer = sees(&cell, "16", &["iron"]);
    let domain = join(NodeOptions {
        gid: Some(GidLength::Bytes24),
        ..NodeOptions::from("bridge")
    });
    eventually("the newer one is known", SOON, || {
        names(&domain).contains("/iron").then_some(())
    });
    eventually("the older one knows us", SOON, || node(&older, "/bridge"));
}

#[test]
fn thirteen_nodes_that_join_at_once_are_all_known() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let theirs: Vec<String> = (0..6).map(|number| format!("theirs_{number}")).collect();
    let theirs: Vec<&str> = theirs.iter().map(String::as_str).collect();
    let ours: Vec<Domain> = (0..7)
        .map(|number| join(format!("ours_{number}").as_str().into()))
        .collect();
    let peer = sees(&cell, "16", &theirs);
    for (number, domain) in ours.iter().enumerate() {
        eventually("each of ours knows the twelve others", SOON, || {
            (names(domain).len() == 12).then_some(())
        });
        let own = format!("/ours_{number}");
        assert!(!names(domain).contains(&own), "{own} is not another");
        has_exactly(&peer, &own, domain, "the peer knows each of ours");
    }
}

#[test]
fn warnings_of_the_bridge_are_on_rosout_under_its_name() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let node = "-r __node:=left -r __ns:=/cell --";
    let args = [
        vec!["--ros-interface", "lo", "--ros-args"],
        node.split(' ').collect(),
    ]
    .concat();
    let _bridge = cell.bridge_ros2(&args);
    let _odd = cell.cyclone(
        "ros2_pub.py",
        &[
            "/ua_2_9_9",
            "nobody_msgs/Unheard",
            "--domain",
            "2",
            "--value",
            "1",
            "--rate",
            "2",
        ],
    );
    // Late joiners get the line, too.
    let mut rosout = cell.cyclone(
        "ros2_sub.py",
        &[
            "/rosout",
            "rcl_interfaces/Log",
            "--domain",
            "2",
            "--durability",
            "transient_local",
        ],
    );
    let log = rosout.wait_for_json("the warning", SOON, |line| {
        line.get("value")
            .filter(|log| log["msg"].as_str().unwrap().contains("nobody_msgs/Unheard"))
            .cloned()
    });
    assert_eq!(log["name"], "cell.left");
    assert_eq!(log["level"], 30);
    assert!(
        log["msg"].as_str().unwrap().contains("topic=rt/ua_2_9_9"),
        "{log}"
    );
    assert!(
        log["stamp"]["sec"].as_i64().unwrap() > 1_700_000_000,
        "{log}"
    );
    assert!(log["file"].as_str().unwrap().ends_with("told.rs"), "{log}");
}

#[test]
fn simulated_time_is_what_clock_says() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join(NodeOptions {
        use_sim_time: true,
        ..NodeOptions::from("bridge")
    });
    assert_eq!(domain.clock().now(), Ros2Time::default());
    let _clock = cell.cyclone(
        "ros2_pub.py",
        &[
            "/clock",
            "rosgraph_msgs/Clock",
            "--domain",
            "2",
            "--reliability",
            "best_effort",
            "--repeat",
            "0",
            "--value",
            r#"{"clock": {"sec": 7, "nanosec": 9}}"#,
        ],
    );
    eventually("the clock shows it", SOON, || {
        (domain.clock().now() == Ros2Time { sec: 7, nanosec: 9 }).then_some(())
    });
}

const EVENTS: &str = "
spaces:
  - {id: 1}
  - {id: 2}
namespaces:
  1: urn:test
variables:
  - node: ns=1;i=1
    name: Event
    origin: 1
    queue: {drop_oldest: 50}
    ros: {space: 2, topic: /event, type: std_msgs/String}
";

#[test]
fn a_subscriber_that_asks_for_more_than_is_offered_is_named_and_counted() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", EVENTS);
    let mut bridge = cell.bridge_ros2(&["--ros-interface", "lo", mapping.to_str().unwrap()]);
    let _late = cell.cyclone(
        "ros2_sub.py",
        &[
            "/event",
            "std_msgs/String",
            "--domain",
            "2",
            "--durability",
            "transient_local",
        ],
    );
    let told = bridge.wait_for_line("is not connected: for the QoS", SOON);
    assert!(
        told.contains(
            "for the QoS policy durability, volatile is offered and transient local requested"
        ),
        "{told}"
    );
    eventually("it is counted", SOON, || {
        let status = metrics(METRICS_ROS2)?;
        let dropped = &status["topics"]["ua_1_1_1"]["dropped"];
        (dropped["incompatible_qos"] == 1).then_some(())
    });
}

#[test]
fn a_subscriber_that_asks_for_a_deadline_is_offered_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", EVENTS);
    let _bridge = cell.bridge_ros2(&["--ros-interface", "lo", mapping.to_str().unwrap()]);
    let peer = sees(&cell, "16", &[]);
    let writer = |peer: &Child| {
        let graph = graph(peer);
        let mut writers = graph["publications"].as_object()?.values();
        writers
            .find(|writer| writer["topic"] == "rt/event")
            .map(|writer| writer["deadline"].clone())
    };
    eventually("the bridge offers no deadline", SOON, || {
        writer(&peer).filter(|deadline| deadline.is_null())
    });
    let _hasty = cell.cyclone(
        "ros2_sub.py",
        &[
            "/event",
            "std_msgs/String",
            "--domain",
            "2",
            "--deadline",
            "400",
        ],
    );
    eventually("the bridge offers the one asked for", SOON, || {
        writer(&peer).filter(|deadline| deadline.as_u64().is_some_and(|ms| ms <= 400))
    });
}

#[test]
fn each_of_a_burst_of_endpoints_is_announced_or_known_not_to_be() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _cell = cell;
    let domain = join("bridge".into());
    // Three times as many as RustDDS' queue holds, without time to process them.
    let writers: Vec<_> = (1..=1500)
        .map(|number| {
            let topic = format!("rt/ua_1_1_{number}");
            domain.writer(&topic, STRING, Offered::KeepLatest).unwrap()
        })
        .collect();
    eventually("each is announced, or known not to be", SOON, || {
        let graph = domain.graph();
        let missing = domain.unannounced(&graph);
        let announced = writers
            .iter()
            .filter(|writer| graph.own().contains(&writer.guid()))
            .count();
        println!("{announced} announced, {} known not to be", missing.len());
        (announced + missing.len() == writers.len()).then_some(())
    });
    let graph = domain.graph();
    let missing = domain.unannounced(&graph);
    drop(writers);
    assert!(domain.unannounced(&graph).is_empty(), "{}", missing.len());
}

/// The type hash of `std_msgs/msg/String`, as ROS 2 publishes it.
const STRING_HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

#[test]
fn topics_of_a_pattern_become_values_as_they_appear() {
    const PATTERNS: &str = r#"
spaces: [{id: 2}]
namespaces: {2: "urn:cell"}
patterns:
  - {topics: "/robot*/status", exclude: ["/robot9/**"], origin: 2, node: "ns=2;i=10{1}", name: "Robot{1}Status", type: std_msgs/String, field: data}
"#;
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let side = UaSide::join();
    let mapping = cell.file("patterns.yaml", PATTERNS);
    let bridge = cell.bridge_ros2(&[&mapping.to_string_lossy()]);
    let says = |topic: &str, text: &str| {
        let args = ["pub", topic, "std_msgs/String", "--text", text];
        cell.cyclone_c(&[&args[..], &["--count", "0", "--rate", "10"]].concat())
    };
    let _excluded = says("/robot9/status", "not this");
    let _first = says("/robot1/status", "one");
    side.hear_scalar((2, 2, 101), Scalar::String(Some("one")));
    let _second = says("/robot2/status", "two");
    side.hear_scalar((2, 2, 102), Scalar::String(Some("two")));
    // A name from which the pattern gets no number is logged, and does not affect other names.
    let _odd = says("/robot_b/status", "odd");
    let odd = || {
        let lines = bridge.lines();
        let told = lines.iter().filter(|line| line.contains("/robot_b/status"));
        told.count()
    };
    eventually("the odd name is told of", SOON, || {
        (odd() > 0).then_some(())
    });
    let heard = side.triples_for(Duration::from_secs(1));
    assert!(heard.contains(&(2, 2, 101)) && heard.contains(&(2, 2, 102)));
    assert!(
        heard.iter().all(|(_, _, id)| [101, 102].contains(id)),
        "{heard:?}"
    );
    assert_eq!(odd(), 1, "told once");
}
