//! Unit tests of `status`.

use std::net::SocketAddr;

use bridge_core::{AskId, Local, RouterSettings};
use uadp::{DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};

use super::*;

#[test]
fn a_topic_that_changes_hands_stands_in_both_pages() {
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Fields,
        source: None,
    };
    let mut router = Router::new(settings, std::sync::Arc::default());
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(Scalar::Boolean(true)).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    for port in [50_001, 50_002, 50_002] {
        let from = SocketAddr::from(([127, 0, 0, 1], port));
        router.handle_datagram(&datagram, from, crate::clock::now());
    }
    let ready = Readiness {
        not_ready: Vec::new(),
        waiting_for: Vec::new(),
        interfaces: Interfaces {
            pubsub: 1,
            local: None,
        },
    };
    let about = About::default();
    let status = StatusSnapshot::of(("bridge", SpaceId::ROS1), &router, (&about, &[]), ready);
    let line = "ua_sender_changed_total{program=\"bridge\",space=\"1\",topic=\"ua_2_5_10\"} 1\n";
    assert!(
        status.prometheus().contains(line),
        "{}",
        status.prometheus()
    );
    let json: serde_json::Value = serde_json::from_str(&status.json()).unwrap();
    assert_eq!(json["topics"]["ua_2_5_10"]["sender_changed"], 1);
}

#[test]
fn the_names_of_a_mapped_topic_are_in_both_pages() {
    let text = "spaces: [{id: 1}]\nnamespaces: {2: urn:test}\nvariables:\n  - {node: ns=2;i=10, name: Arm \"left\", origin: 1, \
                ros: {space: 1, topic: /joint_states, type: std_msgs/Int32}}\n";
    let mapping = mappings::Mapping::from_yaml(text, "cell.yaml")
        .mapping
        .unwrap();
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Fields,
        source: None,
    };
    let mut router = Router::new(settings, std::sync::Arc::new(mapping));
    let topic = "ua_1_2_10".parse().unwrap();
    router.set_live(topic, true, crate::clock::now());
    router.lost(Some(topic), 3, (Reason::NoSubscriber, "no subscriber"));
    router.lost(Some(topic), 2, (Reason::Overflow, "too slow"));
    let ready = Readiness {
        not_ready: Vec::new(),
        waiting_for: Vec::new(),
        interfaces: Interfaces {
            pubsub: 1,
            local: None,
        },
    };
    let about = About::default();
    let status = StatusSnapshot::of(("bridge", SpaceId::ROS1), &router, (&about, &[]), ready);
    let line = "ua_topic_info{program=\"bridge\",space=\"1\",topic=\"ua_1_2_10\",\
                name=\"Arm \\\"left\\\"\",ros_topics=\"1 /joint_states\"} 1\n";
    let text = status.prometheus();
    assert!(text.contains(line), "{text}");
    let json: serde_json::Value = serde_json::from_str(&status.json()).unwrap();
    let topic = &json["topics"]["ua_1_2_10"];
    assert_eq!(topic["name"], "Arm \"left\"");
    let ros = serde_json::json!([{"space": 1, "topic": "/joint_states"}]);
    assert_eq!(topic["ros_topics"], ros);
    // The summary of the log leaves out drops of normal traffic.
    assert_eq!(topic["dropped"]["no_subscriber"], 3);
    assert_eq!(status.summary(), [1, 0, 0, 2]);
}

#[test]
fn what_became_of_calls_stands_in_both_pages() {
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Fields,
        source: None,
    };
    let mut router = Router::new(settings, std::sync::Arc::default());
    let call = "ua_0_7_105".parse().unwrap();
    let timeout = Duration::from_secs(1);
    router.ask(AskId(1), (call, &[0, 0]), timeout, crate::clock::now());
    let ready = Readiness {
        not_ready: Vec::new(),
        waiting_for: Vec::new(),
        interfaces: Interfaces {
            pubsub: 1,
            local: None,
        },
    };
    let about = About::default();
    let status = StatusSnapshot::of(("bridge", SpaceId::ROS1), &router, (&about, &[]), ready);
    let own = "program=\"bridge\",space=\"1\",call=\"ua_0_7_105\"";
    let text = status.prometheus();
    for line in [
        format!("ua_calls_asked_total{{{own}}} 1\n"),
        format!("ua_calls_refused_total{{{own}}} 1\n"),
        format!("ua_calls_dropped_total{{{own},reason=\"call_refused\"}} 1\n"),
    ] {
        assert!(text.contains(&line), "{text}");
    }
    let json: serde_json::Value = serde_json::from_str(&status.json()).unwrap();
    assert_eq!(json["calls"]["ua_0_7_105"]["refused"], 1);
    assert_eq!(json["calls"]["ua_0_7_105"]["known"], false);
    assert_eq!(json["version"], build_info::version());
}
