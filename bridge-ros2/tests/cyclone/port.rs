//! What the port reports and what its peers receive.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{Delivery, Port, PortEvent};
use bridge_ros2::domain::DomainOptions;
use bridge_ros2::{PortOptions, Ros2Port};
use mappings::{Mapping, SpaceId, TopicId};
use uadp::BuiltinType;

use crate::peer::{Peer, string};

fn port(domain: u16, mapping: Mapping) -> Ros2Port {
    Ros2Port::start(PortOptions {
        domain: DomainOptions {
            domain,
            networks: vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
            node: "ua_bridge_ros2".into(),
        },
        own: SpaceId::new(domain).unwrap(),
        mapping: Arc::new(mapping),
        prefixes: Vec::new(),
    })
    .unwrap()
}

/// The first event that `wanted` takes; others are let go. Fails after 10 s.
async fn event<T>(port: &mut Ros2Port, mut wanted: impl FnMut(PortEvent) -> Option<T>) -> T {
    let deadline = tokio::time::Instant::now() + Duration::from_secs(10);
    loop {
        let event = tokio::time::timeout_at(deadline, port.recv())
            .await
            .unwrap();
        if let Some(found) = wanted(event) {
            return found;
        }
    }
}

async fn bound(port: &mut Ros2Port, topic: TopicId) -> String {
    event(port, |event| match event {
        PortEvent::Bound {
            topic: bound,
            message_type,
            ..
        } if bound == topic => Some(message_type.name().to_string()),
        _ => None,
    })
    .await
}

async fn live(port: &mut Ros2Port, topic: TopicId) -> bool {
    event(port, |event| match event {
        PortEvent::Live { topic: of, live } if of == topic => Some(live),
        _ => None,
    })
    .await
}

/// Runs the port for a while without wanting anything of it.
async fn idle(port: &mut Ros2Port, time: Duration) {
    let until = tokio::time::Instant::now() + time;
    while tokio::time::timeout_at(until, port.recv()).await.is_ok() {}
}

fn delivery(topic: TopicId, text: &str) -> Delivery {
    Delivery {
        topic,
        payload: string(text).into(),
        source: None,
        status: 0,
    }
}

/// What the peer prints next, with the port at work meanwhile.
async fn line(port: &mut Ros2Port, peer: &mut Peer) -> serde_json::Value {
    loop {
        if let Some(line) = peer.try_line() {
            return line;
        }
        idle(port, Duration::from_millis(5)).await;
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_topic_of_the_space_crosses_without_configuration_whatever_its_type() {
    let mut port = port(21, Mapping::default());
    let topic: TopicId = "ua_21_2_3".parse().unwrap();
    let peer = Peer::start(
        "pub --topic ua_21_2_3 --type sensor_msgs/JointState --domain 21 --linger 20 --value {\"header\":{\"stamp\":{\"sec\":1,\"nanosec\":2},\"frame_id\":\"base\"},\"name\":[\"a\",\"b\"],\"position\":[1.0,2.0],\"velocity\":[],\"effort\":[]}",
    );
    assert_eq!(bound(&mut port, topic).await, "sensor_msgs/JointState");
    assert!(live(&mut port, topic).await);
    let payload = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!(payload[..12], [0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    drop(peer);
    // Killed without a word, so that only the end of its lease tells: not waited for here.
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_topic_whose_publisher_leaves_is_reported_dead() {
    let mut port = port(22, Mapping::default());
    let topic: TopicId = "ua_22_1_1".parse().unwrap();
    let _peer = Peer::start(
        "pub --topic ua_22_1_1 --type std_msgs/Bool --domain 22 --value true --linger 0.3",
    );
    assert!(live(&mut port, topic).await);
    assert!(!live(&mut port, topic).await);
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_value_nobody_asks_for_gets_the_standard_type_and_waits_for_late_joiners() {
    let mut port = port(23, Mapping::default());
    let topic: TopicId = "ua_1_2_3".parse().unwrap();
    port.wanted(topic, &[(BuiltinType::String, false)]);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/String");
    port.publish(delivery(topic, "earlier")).unwrap();
    port.publish(delivery(topic, "latched")).unwrap();
    for _ in 0..2 {
        let mut peer = Peer::start(
            "sub --topic ua_1_2_3 --type std_msgs/String --domain 23 --transient-local",
        );
        let begin = Instant::now();
        let matched = line(&mut port, &mut peer).await;
        assert_eq!(line(&mut port, &mut peer).await["value"], "latched");
        eprintln!(
            "{matched}, value {:?} after the start of the peer",
            begin.elapsed()
        );
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_subscriber_decides_the_type() {
    let mut port = port(24, Mapping::default());
    let _peer = Peer::start("sub --topic ua_0_2_3 --type std_msgs/UInt32 --domain 24");
    idle(&mut port, Duration::from_secs(1)).await;
    let topic: TopicId = "ua_0_2_3".parse().unwrap();
    port.wanted(topic, &[(BuiltinType::Double, false)]);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/UInt32");
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_subscriber_that_comes_later_changes_the_standard_type() {
    let mut port = port(25, Mapping::default());
    let topic: TopicId = "ua_0_2_3".parse().unwrap();
    port.wanted(topic, &[(BuiltinType::Double, false)]);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/Float64");
    let _peer = Peer::start("sub --topic ua_0_2_3 --type std_msgs/UInt32 --domain 25");
    assert_eq!(bound(&mut port, topic).await, "std_msgs/UInt32");
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_type_without_a_definition_is_counted_and_keeps_nobody_out() {
    let mut port = port(26, Mapping::default());
    let unheard: TopicId = "ua_26_1_1".parse().unwrap();
    let heard: TopicId = "ua_26_1_2".parse().unwrap();
    let _unheard = Peer::start(
        "pub --topic ua_26_1_1 --type nobody_msgs/Unheard --domain 26 --value 1 --no-wait --linger 20",
    );
    let why = event(&mut port, |event| match event {
        PortEvent::Lost { topic, why, .. } if topic == Some(unheard) => Some(why),
        _ => None,
    })
    .await;
    assert_eq!(why, "type without a definition");
    let _heard = Peer::start(
        "pub --topic ua_26_1_2 --type std_msgs/Bool --domain 26 --value true --linger 20",
    );
    assert_eq!(bound(&mut port, heard).await, "std_msgs/Bool");
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn samples_of_another_type_than_the_topics_are_counted_and_not_handed_up() {
    let mut port = port(27, Mapping::default());
    let topic: TopicId = "ua_27_1_1".parse().unwrap();
    let _first = Peer::start(
        "pub --topic ua_27_1_1 --type std_msgs/Bool --domain 27 --value true --linger 20",
    );
    assert_eq!(bound(&mut port, topic).await, "std_msgs/Bool");
    event(&mut port, |event| match event {
        PortEvent::Sample { .. } => Some(()),
        _ => None,
    })
    .await;
    let mut other = Peer::start(
        "pub --topic ua_27_1_1 --type std_msgs/String --domain 27 --value \"no\" --no-wait --count 50 --rate 25 --linger 1",
    );
    loop {
        if other.try_line().is_some() {
            break;
        }
        let until = tokio::time::Instant::now() + Duration::from_millis(10);
        if let Ok(PortEvent::Sample { payload, .. }) =
            tokio::time::timeout_at(until, port.recv()).await
        {
            panic!("handed up: {payload:?}");
        }
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_bad_value_is_not_published() {
    let mut port = port(28, Mapping::default());
    let topic: TopicId = "ua_1_2_3".parse().unwrap();
    port.wanted(topic, &[(BuiltinType::String, false)]);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/String");
    let bad = Delivery {
        status: 0x8032,
        ..delivery(topic, "stale")
    };
    assert_eq!(port.publish(bad), Err("bad status"));
}

#[tokio::test]
#[ignore = "needs a network"]
async fn a_thousand_topics_are_advertised_in_batches_and_disposed_within_two_seconds() {
    let mut port = port(29, Mapping::default());
    for n in 1..=1000 {
        let topic = TopicId::new(1, 1, n).unwrap();
        port.wanted(topic, &[(BuiltinType::Boolean, false)]);
    }
    let begin = Instant::now();
    for _ in 0..1000 {
        event(&mut port, |event| match event {
            PortEvent::Bound { .. } => Some(()),
            _ => None,
        })
        .await;
    }
    eprintln!("advertised in {:?}", begin.elapsed());
    let begin = Instant::now();
    port.shutdown().await;
    eprintln!("disposed in {:?}", begin.elapsed());
    assert!(begin.elapsed() < Duration::from_millis(2100));
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_subscriber_that_is_killed_does_not_keep_the_newest_value_from_the_others() {
    let mut port = port(30, Mapping::default());
    let topic: TopicId = "ua_1_2_3".parse().unwrap();
    let subscribe = "sub --topic ua_1_2_3 --type std_msgs/String --domain 30 --count 100000 --timeout 60 --depth 5000";
    let mut killed = Peer::start(subscribe);
    let mut other = Peer::start(subscribe);
    port.wanted(topic, &[(BuiltinType::String, false)]);
    line(&mut port, &mut killed).await;
    line(&mut port, &mut other).await;
    idle(&mut port, Duration::from_millis(500)).await;
    drop(killed);
    // More than the send window holds, so that an unacknowledging reader stops the writer.
    let mut refused = 0;
    for number in 0..1000 {
        refused += u32::from(port.publish(delivery(topic, &number.to_string())).is_err());
        idle(&mut port, Duration::from_millis(1)).await;
    }
    assert!(refused > 0, "the writer never stopped");
    let deadline = Instant::now() + Duration::from_secs(3);
    while line(&mut port, &mut other).await["value"] != "999" {
        assert!(Instant::now() < deadline, "the newest value is late");
    }
}
