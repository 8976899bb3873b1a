//! Type descriptions that nodes exchange.

use std::time::Duration;

use bridge_node::{LocalDelivery, Port, PortEvent, ValueRelation};
use mappings::Mapping;
use messages::{Dialect, TypeRegistry};
use ros2_node::domain::{Domain, DomainOptions, can_announce_type_hashes};
use ros2_node::qos::{Offered, Requested};
use ros2_node::raw::Payload;
use serde_json::json;
use system_tests::{Cell, Peer, eventually};
use uadp::BuiltinType;

use crate::ros2_endpoints::peer::{SOON, options, writes};
use crate::ros2_endpoints::port::{bound, event, port, port_of, run_until, topic, types};

const UNKNOWN: &str = "type_description_interfaces/FieldType";

/// Returns the hash of another type with the same name that has only its first two fields.
fn short() -> String {
    let name = UNKNOWN.parse().unwrap();
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    registry
        .add(&name, "uint8 type_id\nuint64 capacity\n")
        .unwrap();
    registry.type_hash(&name).unwrap().to_string()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_type_that_is_not_known_here_is_told_by_the_node_that_publishes_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let peer = cell.cyclone("ros2_describe.py", &["serve"]);
    assert_eq!(bound(&mut port, topic("ua_2_2_9")).await, UNKNOWN);
    let payload = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!((payload[4], payload[12], payload[20]), (7, 8, 9));
    let asked = peer.json_lines();
    let asked: Vec<_> = asked
        .iter()
        .filter(|line| line.get("asked").is_some())
        .collect();
    assert_eq!(asked.len(), 1, "{asked:?}");
    assert_eq!(
        asked[0]["asked"],
        "type_description_interfaces/msg/FieldType"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_description_that_is_not_of_the_announced_hash_is_not_believed() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _peer = cell.cyclone("ros2_describe.py", &["serve", "--lie"]);
    let why = event(&mut port, |event| match event {
        PortEvent::Bound { .. } => Some("bound"),
        PortEvent::Lost { why, .. } => Some(why),
        _ => None,
    })
    .await;
    assert_eq!(why, "type without a definition");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_node_tells_what_the_types_are_it_reads() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _writer = writes(
        &cell,
        "/ua_2_2_3",
        "sensor_msgs/JointState",
        &["--value", "{}"],
    );
    bound(&mut port, topic("ua_2_2_3")).await;
    let ask = ["ask", "--type", "sensor_msgs/msg/JointState"];
    let peer = cell.cyclone("ros2_describe.py", &ask);
    run_until(&mut port, "an answer", || !peer.values().is_empty()).await;
    assert_eq!(
        peer.values(),
        [json!({
            "successful": true,
            "reason": "",
            "type": "sensor_msgs/msg/JointState",
            "fields": [
                ["header", 1, "std_msgs/msg/Header"],
                ["name", 161, ""],
                ["position", 155, ""],
                ["velocity", 155, ""],
                ["effort", 155, ""],
            ],
            "referenced": ["builtin_interfaces/msg/Time", "std_msgs/msg/Header"],
        })],
        "{SOON:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn two_definitions_of_one_name_are_each_read_as_their_publisher_has_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let (mut port, short) = (port(), short());
    let _long = cell.cyclone("ros2_describe.py", &["serve"]);
    let other = ["serve", "--topic", "/ua_2_2_8", "--name", "other"];
    let _short = cell.cyclone(
        "ros2_describe.py",
        &[&other[..], &["--short", &short]].concat(),
    );
    let mut fields = std::collections::BTreeMap::new();
    while fields.len() < 2 {
        let (topic, leaves) = event(&mut port, |event| match event {
            PortEvent::Bound {
                topic,
                message_type,
                ..
            } => Some((topic, message_type.leaves().len())),
            _ => None,
        })
        .await;
        fields.insert(topic, leaves);
    }
    assert_eq!(
        fields.into_iter().collect::<Vec<_>>(),
        [(topic("ua_2_2_8"), 2), (topic("ua_2_2_9"), 4)]
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_publisher_with_another_definition_than_the_topics_is_dropped_and_counted_until_it_is_alone()
 {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let (mut port, short) = (port(), short());
    let mut long = cell
        .cyclone_started("ros2_describe.py", &["serve"])
        .told()
        .start()
        .ready(SOON);
    let of = topic("ua_2_2_9");
    let first = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!(first[20], 9);
    let other = ["serve", "--name", "other", "--short", &short];
    let _short = cell.cyclone("ros2_describe.py", &other);
    let lost = event(&mut port, |event| match event {
        PortEvent::Lost { topic, why, .. } => Some((topic, why)),
        PortEvent::Sample { .. } | PortEvent::Bound { .. } => Some((None, "it is read")),
        _ => None,
    })
    .await;
    assert_eq!(lost, (Some(of), "publisher of another definition"));
    long.tell("leave");
    let bound = event(&mut port, |event| match event {
        PortEvent::Bound {
            topic,
            message_type,
            ..
        } => Some((topic, message_type.leaves().len())),
        PortEvent::Sample { .. } => Some((of, 0)),
        _ => None,
    })
    .await;
    assert_eq!(bound, (of, 2));
    let payload = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!((payload.len(), payload[4], payload[12]), (20, 7, 8));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn what_came_before_the_publisher_of_another_definition_is_read_as_it_was_written() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    if !can_announce_type_hashes() {
        Cell::skip("RustDDS as published announces no type hashes");
        return;
    }
    const FIELD_TYPE: &str = "type_description_interfaces::msg::dds_::FieldType_";
    // The hash that ROS 2 publishes.
    const LONG: &str = "RIHS01_a70b6dd919645a03a3586f7f821defbc886ea3e531a1d95cc0f380a3973ccaa6";
    let (mut port, short, of) = (port(), short(), topic("ua_2_2_7"));
    // Nodes that serve both definitions.
    let _long = cell.cyclone("ros2_describe.py", &["serve"]);
    let other_topic = ["serve", "--topic", "/ua_2_2_8", "--name", "other"];
    let _short = cell.cyclone(
        "ros2_describe.py",
        &[&other_topic[..], &["--short", &short]].concat(),
    );
    for _ in 0..2 {
        event(&mut port, |event| {
            matches!(event, PortEvent::Bound { .. }).then_some(())
        })
        .await;
    }
    let publishes = |node: &str, hash: &str| {
        let domain = other(node);
        domain.learn_type_hash(FIELD_TYPE, hash);
        // RustDDS as published delivers nothing of a reliable writer that has left.
        let mut best_effort = eventually("any writer is known", SOON, || {
            domain.graph().writers("rt/ua_2_2_9").first().cloned()
        });
        (best_effort.reliable, best_effort.transient_local) = (false, false);
        let offered = Requested::from_writers(&[best_effort]).policies();
        let writer = domain.open_writer("rt/ua_2_2_7", FIELD_TYPE, &offered);
        (domain, writer.unwrap())
    };
    let (old, writer) = publishes("old", LONG);
    assert_eq!(bound(&mut port, of).await, UNKNOWN);
    event(&mut port, |event| {
        matches!(event, PortEvent::Live { topic, live: true } if topic == of).then_some(())
    })
    .await;
    run_until(&mut port, "the reader is known", || {
        let graph = old.graph();
        let mut readers = graph.readers("rt/ua_2_2_7").iter();
        readers.any(|reader| !reader.reliable)
    })
    .await;
    // From here on, the samples are not read.
    let message = |number| {
        let payload = [&[0, 1, 0, 0, number][..], &[0; 31]].concat();
        Payload::to_write(payload.into()).unwrap()
    };
    let (new, _writer) = publishes("new", &short);
    // Created after the other writer, so a reader that acknowledges its samples knows both.
    let last = new.writer("rt/ua_2_2_8", FIELD_TYPE, Offered::KeepLatest);
    let last = last.unwrap();
    eventually("the readers are known", SOON, || {
        let graph = new.graph();
        let known = |topic| !graph.readers(topic).is_empty();
        (known("rt/ua_2_2_7") && known("rt/ua_2_2_8")).then_some(())
    });
    last.write(message(0), None).unwrap();
    assert!(last.wait_for_acknowledgments(SOON).unwrap());
    for number in 0..50 {
        writer.write(message(number), None).unwrap();
    }
    assert!(old.leave(writer).await);
    eventually("the new publisher is alone", SOON, || {
        let graph = new.graph();
        graph.writers("rt/ua_2_2_7").is_empty().then_some(())
    });
    let mut read = Vec::new();
    event(&mut port, |event| match event {
        PortEvent::Sample { topic, payload, .. } if topic == of => {
            read.push(payload[4]);
            None
        }
        PortEvent::Unbound { topic } if topic == of => Some(()),
        _ => None,
    })
    .await;
    assert_eq!(read, (0..50).collect::<Vec<u8>>());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_value_is_written_to_a_subscriber_whose_type_only_its_node_knows() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let (mut port, short) = (port(), short());
    let of = topic("ua_1_2_9");
    let reads = ["read", "--topic", "/ua_1_2_9"];
    let reader = cell.cyclone("ros2_describe.py", &reads);
    let shape = [
        BuiltinType::Byte,
        BuiltinType::UInt64,
        BuiltinType::UInt64,
        BuiltinType::String,
    ];
    port.wanted(of, &shape.map(|builtin| (builtin, false)), None);
    assert_eq!(bound(&mut port, of).await, UNKNOWN);
    let mut payload = vec![0, 1, 0, 0];
    payload.extend_from_slice(&7_u64.to_le_bytes());
    payload.extend_from_slice(&8_u64.to_le_bytes());
    payload.extend_from_slice(&9_u64.to_le_bytes());
    payload.extend_from_slice(b"\x04\0\0\0ten\0");
    let delivery = LocalDelivery {
        topic: of,
        payload: payload.into(),
        source: None,
        status: 0,
        instance: None,
        kept: ValueRelation::Alone,
        lasting: true,
    };
    port.publish(delivery).unwrap();
    run_until(&mut port, "the value is read", || {
        !reader.values().is_empty()
    })
    .await;
    let value =
        json!({"type_id": 7, "capacity": 8, "string_capacity": 9, "nested_type_name": "ten"});
    assert_eq!(reader.values(), [value]);

    // Another subscriber that reads the same bytes as another type.
    let other = [&reads[..], &["--name", "other", "--short", &short]].concat();
    let _other = cell.cyclone("ros2_describe.py", &other);
    let lost = event(&mut port, |event| match event {
        PortEvent::Lost { topic, why, .. } => Some((topic, why)),
        PortEvent::Bound { .. } => Some((None, "it is written anew")),
        _ => None,
    })
    .await;
    assert_eq!(lost, (Some(of), "subscriber of another definition"));
}

const STRING: &str = "std_msgs::msg::dds_::String_";

/// Joins as another node of the domain, which does not describe its types.
fn other(name: &str) -> Domain {
    Domain::join(&DomainOptions {
        node: name.into(),
        ..options()
    })
    .unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_type_that_a_node_is_asked_for_keeps_no_topic_of_a_known_type_waiting() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // The vendor id of this peer sorts first, so its endpoints come first, too.
    let asked = ["--silent", "--name", "asked"];
    let reads = [&["read", "--topic", "/ua_1_2_9"], &asked[..]].concat();
    let _reader = cell.cyclone("ros2_describe.py", &reads);
    let serves = [&["serve", "--topic", "/ua_2_2_9"], &asked[..]].concat();
    let _writer = cell.cyclone("ros2_describe.py", &serves);
    let known = other("known");
    let volatile = Requested::from_writers(&[]);
    let _read = known.reader("rt/ua_1_2_9", STRING, volatile).unwrap();
    let _written = known
        .writer("rt/ua_2_2_9", STRING, Offered::KeepLatest)
        .unwrap();

    let mut port = port();
    let shape = [(BuiltinType::Double, false); 2];
    port.wanted(topic("ua_1_2_9"), &shape, None);
    let mut types = std::collections::BTreeMap::new();
    // The calls time out after 12 s in total.
    while types.len() < 2 {
        let (topic, name) = event(&mut port, |event| match event {
            PortEvent::Bound {
                topic,
                message_type,
                ..
            } => Some((topic, message_type.name().to_string())),
            _ => None,
        })
        .await;
        types.insert(topic, name);
    }
    let string = |name| (topic(name), "std_msgs/String".to_owned());
    assert_eq!(
        types.into_iter().collect::<Vec<_>>(),
        [string("ua_1_2_9"), string("ua_2_2_9")]
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_type_that_nobody_told_is_asked_of_a_node_that_comes_later() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _mute = cell.cyclone("ros2_describe.py", &["serve", "--no-service"]);
    let why = event(&mut port, |event| match event {
        PortEvent::Bound { .. } => Some("bound"),
        PortEvent::Lost { why, .. } => Some(why),
        _ => None,
    })
    .await;
    assert_eq!(why, "type without a definition");
    let _tells = cell.cyclone("ros2_describe.py", &["serve", "--name", "later"]);
    assert_eq!(bound(&mut port, topic("ua_2_2_9")).await, UNKNOWN);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_topic_does_not_wait_for_ever_for_nodes_that_leave_before_they_could_tell_its_type() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    if !can_announce_type_hashes() {
        Cell::skip("RustDDS as published announces no type hashes");
        return;
    }
    const NOBODYS: &str = "nobody_msgs::msg::dds_::Unheard_";
    let mut port = port();
    let mut found = std::collections::BTreeSet::new();
    for number in 0..8 {
        let leaves = other(&format!("leaves{number}"));
        let write = |name, kind| {
            leaves.learn_type_hash(kind, format!("RIHS01_{}", "5".repeat(64)));
            leaves.writer(name, kind, Offered::KeepLatest).unwrap()
        };
        let writers = (write("rt/ua_2_2_8", STRING), write("rt/ua_2_2_9", NOBODYS));
        // Shorter than the 3 s that a node has to announce its services.
        let until = tokio::time::Instant::now() + Duration::from_secs(1);
        while let Ok(event) = tokio::time::timeout_at(until, port.recv()).await {
            match event {
                PortEvent::Bound {
                    topic,
                    message_type,
                    ..
                } => found.insert((topic, message_type.name().to_string())),
                PortEvent::Lost {
                    topic: Some(topic),
                    why,
                    ..
                } => found.insert((topic, why.to_owned())),
                _ => false,
            };
        }
        assert!(leaves.leave(writers).await);
        // Too early to know that the types are not described.
        assert!(number > 0 || found.is_empty(), "{found:?}");
    }
    let expected = [
        (topic("ua_2_2_8"), "std_msgs/String".to_owned()),
        (topic("ua_2_2_9"), "type without a definition".to_owned()),
    ];
    assert_eq!(found.into_iter().collect::<Vec<_>>(), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn of_subscribers_of_two_definitions_the_one_that_is_not_written_is_told() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    if !can_announce_type_hashes() {
        Cell::skip("RustDDS as published announces no type hashes");
        return;
    }
    let (mut port, of) = (port(), topic("ua_1_2_3"));
    port.wanted(of, &[(BuiltinType::String, false)], None);
    assert_eq!(bound(&mut port, of).await, "std_msgs/String");
    let lost = |event| match event {
        PortEvent::Lost { topic, why, .. } => Some((topic, why)),
        _ => None,
    };
    let misreads = (Some(of), "subscriber of another definition");
    let volatile = Requested::from_writers(&[]);

    // No node serves the definition of this type, so our own definition is written.
    let untold = other("untold");
    untold.learn_type_hash(STRING, format!("RIHS01_{}", "5".repeat(64)));
    let _untold = untold.reader("rt/ua_1_2_3", STRING, volatile).unwrap();
    assert_eq!(event(&mut port, lost).await, misreads);

    let ours = other("ours");
    let name = "std_msgs/String".parse().unwrap();
    let hash = TypeRegistry::bundle(Dialect::Ros2)
        .type_hash(&name)
        .unwrap();
    ours.learn_type_hash(STRING, hash.to_string());
    let _ours = ours.reader("rt/ua_1_2_3", STRING, volatile).unwrap();
    // Discovered after the reader.
    let after = topic("ua_1_2_4");
    let bool = "std_msgs::msg::dds_::Bool_";
    let _after = ours.reader("rt/ua_1_2_4", bool, volatile).unwrap();
    port.wanted(after, &[(BuiltinType::Double, false); 2], None);
    let mut told = Vec::new();
    event(&mut port, |event| match event {
        PortEvent::Bound { topic, .. } if topic == after => Some(()),
        event => {
            told.extend(lost(event));
            None
        }
    })
    .await;
    while let Ok(event) = tokio::time::timeout(Duration::ZERO, port.recv()).await {
        told.extend(lost(event));
    }
    assert_eq!(told, []);
}

/// Returns the next topic that is bound or unbound, and for a bound topic the number of fields of
/// its type.
async fn next_bound(port: &mut bridge_ros2::Ros2Port) -> (mappings::TopicId, Option<usize>) {
    event(port, |event| match event {
        PortEvent::Bound {
            topic,
            message_type,
            ..
        } => Some((topic, Some(message_type.leaves().len()))),
        PortEvent::Unbound { topic } => Some((topic, None)),
        _ => None,
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_saved_definition_file_counts_from_the_next_reload_on() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let file = cell.folder().join("types/geometry_msgs/msg/Point.msg");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, "float64 x\nfloat64 y\nfloat64 z\n").unwrap();
    let text = format!(
        "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:test}}\ntype_paths: [{}]\nvariables:\n  - {{node: ns=2;i=1, \
         name: Read, origin: 2, ros: {{topic: /arm, type: geometry_msgs/Point}}}}\n  - {{node: ns=2;i=2, name: Written, \
         origin: 1, ros: {{space: 2, topic: /to_arm, type: geometry_msgs/Point}}}}\n",
        cell.folder().join("types").display()
    );
    let mapping = std::sync::Arc::new(Mapping::from_yaml(&text, "cell.yaml").mapping.unwrap());
    let mut port = port_of(std::sync::Arc::clone(&mapping));
    let (read, written) = (topic("ua_2_2_1"), topic("ua_1_2_2"));
    let mut first = [next_bound(&mut port).await, next_bound(&mut port).await];
    first.sort_unstable();
    assert_eq!(first, [(written, Some(3)), (read, Some(3))]);
    std::fs::write(&file, "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n").unwrap();
    port.reload(&mapping, &types(&mapping));
    let mut changed = Vec::new();
    for _ in 0..4 {
        changed.push(next_bound(&mut port).await);
    }
    let expected = [
        (read, None),
        (written, None),
        (read, Some(4)),
        (written, Some(4)),
    ];
    assert_eq!(changed, expected);
}
