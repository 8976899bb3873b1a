//! Tests the port in a graph of its own: a master in this process, with nodes besides the bridge.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

mod calls;
mod reload;
mod services;
mod strays;

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{LocalDelivery, Port, PortEvent, TypePaths, ValueRelation};
use bridge_ros1::{Ros1Port, Ros1PortOptions};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use tcpros::{
    Core, Inbox, InboxEvent, InboxMessage, Node, NodeOptions, Publisher, PublisherOptions,
    RequestedType, SubscriberOptions, TopicType,
};
use tokio::time::timeout;
use uadp::BuiltinType;

const DEADLINE: Duration = Duration::from_secs(20);

struct Cell {
    _core: Core,
    node: Node,
    port: Ros1Port,
}

fn cell(mapping: &str) -> Cell {
    let core = Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
    let options = |name: &str| {
        let mut options = NodeOptions::from_env(name);
        core.uri().clone_into(&mut options.master_uri);
        "/".clone_into(&mut options.namespace);
        options.advertise_as("127.0.0.1");
        options
    };
    let mapping = parsed(mapping);
    let port = Ros1Port::start(Ros1PortOptions {
        node: options("bridge"),
        own: SpaceId::ROS1,
        types: types(&mapping),
        mapping,
        packages: Vec::new(),
    })
    .unwrap();
    let node = Node::start(options("robot")).unwrap();
    Cell {
        _core: core,
        node,
        port,
    }
}

fn types(mapping: &Mapping) -> Arc<TypePaths> {
    Arc::new(TypePaths::read(mapping.type_paths(), &mut |_| {}))
}

fn parsed(mapping: &str) -> Arc<Mapping> {
    let checked = Mapping::from_yaml(mapping, "test.yaml");
    let mapping = checked
        .mapping
        .unwrap_or_else(|| panic!("{:?}", checked.findings));
    Arc::new(mapping)
}

const NOTHING: &str = "spaces:\n  - {id: 1}\n";

const TWO_FIELDS: &str = "
spaces:
  - {id: 1}
  - {id: 2, domain: 2}
namespaces:
  2: urn:test
variables:
  - node: ns=2;i=1
    name: X
    origin: 1
    ros:
      - {space: 1, topic: /target, type: geometry_msgs/Point, field: x}
  - node: ns=2;i=2
    name: Y
    origin: 1
    ros:
      - {space: 1, topic: /target, type: geometry_msgs/Point, field: y}
  - node: ns=2;i=3
    name: Park
    type: Boolean
    origin: 2
    ros:
      - {space: 1, topic: /park, type: std_msgs/Bool, field: data}
";

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(DEADLINE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {DEADLINE:?} for {what}"),
    }
}

fn id(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn advertise(node: &Node, topic: &str, name: &str, latch: bool) -> Publisher {
    let found = TypeRegistry::bundle(Dialect::Ros1)
        .get(&name.parse().unwrap())
        .unwrap();
    let topic_type = TopicType {
        name: name.to_owned(),
        md5sum: found.md5().to_owned(),
        definition: found.definition().to_owned(),
    };
    node.advertise(
        topic,
        topic_type,
        PublisherOptions {
            latch,
            ..Default::default()
        },
    )
    .unwrap()
}

fn delivery(topic: &str, payload: &'static [u8]) -> LocalDelivery {
    let payload = Bytes::from_static(payload);
    LocalDelivery {
        topic: id(topic),
        payload,
        source: None,
        status: 0,
        instance: None,
        kept: ValueRelation::Alone,
        lasting: true,
    }
}

/// Returns a line for an event, which the tests compare.
fn line(event: &PortEvent) -> String {
    match event {
        PortEvent::Bound {
            topic,
            message_type,
            selection,
        } => {
            let field = match selection {
                Selection::Whole => "whole",
                Selection::Field(field) => field,
                Selection::Value { field, .. } => field,
                Selection::Bytes => "bytes",
                Selection::Fields(_) | Selection::Structure(_) | Selection::Template { .. } => {
                    "template"
                }
            };
            format!("{topic} is {} {field}", message_type.name())
        }
        PortEvent::Sample { topic, payload, .. } => format!("{topic} = {payload:?}"),
        PortEvent::Live { topic, live } => format!("{topic} live {live}"),
        PortEvent::Unbound { topic } => format!("{topic} unbound"),
        PortEvent::Qualified { topic, status, .. } => format!("{topic} of quality {status:#06x}"),
        PortEvent::Left { topic, .. } => format!("{topic} left"),
        PortEvent::Unmatched { topic } => format!("{topic} unmatched"),
        PortEvent::Dropped { reason, why, count } => format!("{count} {} {why}", reason.label()),
        PortEvent::CallFailed { topic, detail } => format!("{topic} call failed: {detail}"),
        PortEvent::Lost {
            topic, why, count, ..
        } => {
            format!(
                "{} lost {count}: {why}",
                topic.map_or_else(String::new, |t| t.to_string())
            )
        }
        PortEvent::CallBound { topic, .. } => format!("{topic} call bound"),
        PortEvent::Ask { topic, .. } => format!("{topic} asked"),
        PortEvent::Described { .. }
        | PortEvent::CallUnbound { .. }
        | PortEvent::CallWanted { .. }
        | PortEvent::AskGivenUp { .. }
        | PortEvent::Offer { .. }
        | PortEvent::OfferTyped { .. }
        | PortEvent::Withdrawn { .. }
        | PortEvent::BoundAs { .. }
        | PortEvent::Executed { .. } => format!("{event:?}"),
        PortEvent::Ended(why) => format!("ended: {why}"),
    }
}

async fn events(port: &mut Ros1Port, count: usize) -> Vec<String> {
    let mut lines = Vec::new();
    while lines.len() < count {
        lines.push(line(&within("an event", port.recv()).await));
    }
    lines
}

/// Runs the port until the condition holds.
async fn run_until(port: &mut Ros1Port, what: &str, condition: impl Fn() -> bool) {
    within(what, async {
        while !condition() {
            tokio::select! {
                _ = port.recv() => {}
                () = tokio::time::sleep(Duration::from_millis(5)) => {}
            }
        }
    })
    .await;
}

async fn message(port: &mut Ros1Port, inbox: &mut Inbox<()>) -> InboxMessage {
    within("a message", async {
        loop {
            tokio::select! {
                ((), event) = inbox.recv() => if let InboxEvent::Message(message) = event {
                    return message;
                },
                _ = port.recv() => {}
            }
        }
    })
    .await
}

#[tokio::test]
async fn a_topic_named_in_the_space_crosses_whatever_its_type() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(NOTHING);
    let publisher = advertise(&node, "/ua_1_2_7", "sensor_msgs/JointState", true);
    let _sent = publisher.publish(Bytes::from_static(b"latched"));
    let expected = [
        "ua_1_2_7 is sensor_msgs/JointState whole",
        "ua_1_2_7 live true",
        "ua_1_2_7 = b\"latched\"",
    ];
    assert_eq!(events(&mut port, 3).await, expected);
    drop(publisher);
    assert_eq!(events(&mut port, 1).await, ["ua_1_2_7 live false"]);
    let again = advertise(&node, "/ua_1_2_7", "std_msgs/Bool", true);
    let _sent = again.publish(Bytes::from_static(b"\x01"));
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_1_2_7 is std_msgs/Bool whole"]
    );
}

#[tokio::test]
async fn one_message_gives_a_sample_to_each_variable_that_reads_it() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(TWO_FIELDS);
    let publisher = advertise(&node, "/target", "geometry_msgs/Point", true);
    let _sent = publisher.publish(Bytes::from_static(b"p"));
    let mut lines = events(&mut port, 7).await;
    // A published topic is bound from the start.
    assert_eq!(lines.remove(0), "ua_2_2_3 is std_msgs/Bool data");
    let expected = [
        "ua_1_2_1 is geometry_msgs/Point x",
        "ua_1_2_2 is geometry_msgs/Point y",
        "ua_1_2_1 live true",
        "ua_1_2_2 live true",
        "ua_1_2_1 = b\"p\"",
        "ua_1_2_2 = b\"p\"",
    ];
    assert_eq!(lines, expected);
}

#[tokio::test]
async fn a_publisher_of_another_type_than_the_mapping_says_is_counted_and_not_read() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(TWO_FIELDS);
    let wrong = advertise(&node, "/target", "std_msgs/Bool", true);
    let _sent = wrong.publish(Bytes::from_static(b"\x01"));
    let lines = events(&mut port, 3).await;
    let expected = [
        "ua_2_2_3 is std_msgs/Bool data",
        "ua_1_2_1 lost 1: publisher of another type",
        "ua_1_2_2 lost 1: publisher of another type",
    ];
    assert_eq!(lines, expected);
}

#[tokio::test]
async fn a_value_of_another_space_appears_under_its_mapped_topic_and_is_latched() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(TWO_FIELDS);
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_2_3 is std_msgs/Bool data"]
    );
    assert_eq!(port.publish(delivery("ua_2_2_3", b"\x01")), Ok(()));
    let mut inbox = Inbox::new();
    let wanted = RequestedType {
        type_name: Some("std_msgs/Bool".to_owned()),
        md5sum: None,
    };
    let _late = node
        .subscribe("/park", wanted, SubscriberOptions::default(), (), &inbox)
        .unwrap();
    let got = message(&mut port, &mut inbox).await;
    assert_eq!(got.bytes, b"\x01".as_slice());
    assert_eq!(got.peer.caller_id, "/bridge");
    let bad = LocalDelivery {
        status: 0x8000,
        instance: None,
        kept: ValueRelation::Alone,
        ..delivery("ua_2_2_3", b"\x00")
    };
    assert_eq!(port.publish(bad), Err("bad status"));
}

#[tokio::test]
async fn a_value_nobody_mapped_gets_the_standard_type_or_the_one_a_subscriber_asks_for() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(NOTHING);
    assert_eq!(
        port.publish(delivery("ua_2_1_1", b"\x01")),
        Err("no publisher yet")
    );
    port.wanted(id("ua_2_1_1"), &[(BuiltinType::Boolean, false)], None);
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_1_1 is std_msgs/Bool whole"]
    );

    let mut inbox = Inbox::new();
    let pose = RequestedType {
        type_name: Some("geometry_msgs/Point".to_owned()),
        md5sum: None,
    };
    let options = SubscriberOptions::default();
    let _first = node
        .subscribe("/ua_2_1_2", pose, options, (), &inbox)
        .unwrap();
    let graph = node.graph_reader();
    within("the subscriber", async {
        while !graph
            .read()
            .await
            .is_ok_and(|g| g.subscribers.contains_key("/ua_2_1_2"))
        {}
    })
    .await;
    // Three values have no standard type, so the topic waits for a subscriber with a type.
    let shape = [(BuiltinType::Double, false); 3];
    port.wanted(id("ua_2_1_2"), &shape, None);
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_1_2 is geometry_msgs/Point whole"]
    );
    assert_eq!(port.publish(delivery("ua_2_1_2", &[0; 24])), Ok(()));
    assert_eq!(message(&mut port, &mut inbox).await.bytes.len(), 24);
}

#[tokio::test]
async fn a_subscriber_of_another_type_gets_its_way_while_nobody_else_listens() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(NOTHING);
    port.wanted(id("ua_2_1_1"), &[(BuiltinType::Double, false)], None);
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_1_1 is std_msgs/Float64 whole"]
    );
    let float = TypeRegistry::bundle(Dialect::Ros1)
        .get(&"std_msgs/Float32".parse().unwrap())
        .unwrap();
    let wanted = RequestedType {
        type_name: Some("std_msgs/Float32".to_owned()),
        md5sum: Some(float.md5().to_owned()),
    };
    let inbox = Inbox::new();
    let options = SubscriberOptions::default();
    let listener = node
        .subscribe("/ua_2_1_1", wanted, options, (), &inbox)
        .unwrap();
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_1_1 is std_msgs/Float32 whole"]
    );
    run_until(&mut port, "the subscriber", || listener.publishers() == 1).await;
}

#[tokio::test]
async fn shutdown_leaves_nothing_of_the_bridge_in_the_master() {
    let Cell {
        node,
        mut port,
        _core,
    } = cell(TWO_FIELDS);
    assert_eq!(
        events(&mut port, 1).await,
        ["ua_2_2_3 is std_msgs/Bool data"]
    );
    let graph = node.graph_reader();
    within("the registrations", async {
        loop {
            let seen = graph.read().await.unwrap();
            if seen.publishers.contains_key("/park") && seen.subscribers.contains_key("/target") {
                return;
            }
        }
    })
    .await;
    within("the shutdown", port.shutdown()).await;
    let left = graph.read().await.unwrap();
    assert_eq!((left.publishers.len(), left.subscribers.len()), (0, 0));
}

#[tokio::test]
async fn the_port_ends_when_another_node_takes_its_name() {
    let Cell {
        _core,
        mut port,
        node,
    } = cell(NOTHING);
    port.wanted(id("ua_2_1_1"), &[(BuiltinType::Boolean, false)], None);
    let graph = node.graph_reader();
    within("the registration", async {
        while !graph
            .read()
            .await
            .is_ok_and(|g| g.publishers.contains_key("/ua_2_1_1"))
        {
            tokio::select! {
                _ = port.recv() => {}
                () = tokio::time::sleep(Duration::from_millis(5)) => {}
            }
        }
    })
    .await;
    let mut twin = NodeOptions::from_env("bridge");
    _core.uri().clone_into(&mut twin.master_uri);
    "/".clone_into(&mut twin.namespace);
    twin.advertise_as("127.0.0.1");
    let twin = Node::start(twin).unwrap();
    let _publisher = advertise(&twin, "/other", "std_msgs/Bool", false);
    let why = within("the end", async {
        loop {
            if let PortEvent::Ended(why) = port.recv().await {
                return why;
            }
        }
    })
    .await;
    assert!(why.contains("/bridge"), "{why}");
}
