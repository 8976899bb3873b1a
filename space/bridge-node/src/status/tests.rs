//! Unit tests of `status`.

use std::net::SocketAddr;

use bridge_core::{
    AskId, CallDescription, CallRole, Local, Now, OfferedCall, Output, Owned, RouterSettings,
    ValueDescription,
};
use mappings::Overflow;
use uadp::{DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};

use super::names::MOST_NAMES;
use super::*;

/// Returns a datagram with a Boolean of the topic with these parts of its name.
fn datagram((space, namespace, identifier): (u16, u16, u16)) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(namespace),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut datagram, &network, Some(&[identifier])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(Scalar::Boolean(true)).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    datagram
}

#[test]
fn a_topic_that_changes_hands_stands_in_both_pages() {
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Fields,
        source: None,
    };
    let mut router = Router::new(settings, std::sync::Arc::default());
    let datagram = datagram((2, 5, 10));
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

/// Returns the announcements of a component with a value and a call.
fn announced() -> Vec<Vec<u8>> {
    let settings = RouterSettings {
        own: SpaceId::UA,
        local: Local::Fields,
        source: Some(SocketAddr::from(([127, 0, 0, 1], 50_001))),
    };
    let mut component = Router::new(settings, std::sync::Arc::default());
    component.set_owned(Owned::Only([7].into()), crate::clock::now());
    let described = ValueDescription {
        name: "gripper \"left\"\n.State".to_owned(),
        message_type: None,
        about: String::new(),
        fields: vec![messages::Leaf {
            path: "data".to_owned(),
            builtin: uadp::BuiltinType::String,
            rank: messages::ArrayRank::Scalar,
        }],
        overflow: Overflow::KeepLatest,
    };
    let value = "ua_0_7_101".parse().unwrap();
    component.describe_value(value, described, crate::clock::now());
    let offered = OfferedCall {
        description: CallDescription {
            name: "gripper.Start".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: Vec::new(),
            response: Vec::new(),
        },
        open: false,
    };
    let call = "ua_0_7_105".parse().unwrap();
    component.offer(call, offered, crate::clock::now());
    assert_eq!(component.name_of(call), Some("gripper.Start"));
    let start = crate::clock::now();
    let mut sent = Vec::new();
    for step in 0..2_000 {
        let at = Now {
            monotonic: start.monotonic + Duration::from_millis(step),
            ..start
        };
        component.handle_timeout(at);
        while let Some(output) = component.poll_output(at) {
            if let Output::Discovery { bytes } = output {
                sent.push(bytes);
            }
        }
    }
    sent
}

#[test]
fn the_names_that_another_program_announces_are_in_both_pages() {
    let settings = RouterSettings {
        own: SpaceId::ROS1,
        local: Local::Fields,
        source: None,
    };
    let mut router = Router::new(settings, std::sync::Arc::default());
    let from = SocketAddr::from(([127, 0, 0, 1], 50_001));
    for datagram in announced() {
        router.handle_datagram(&datagram, from, crate::clock::now());
    }
    let status = |router: &Router| {
        let ready = Readiness {
            not_ready: Vec::new(),
            waiting_for: Vec::new(),
            interfaces: Interfaces {
                pubsub: 1,
                local: None,
            },
        };
        let about = About::default();
        StatusSnapshot::of(("bridge", SpaceId::ROS1), router, (&about, &[]), ready)
    };
    let json = |router: &Router| -> serde_json::Value {
        serde_json::from_str(&status(router).json()).unwrap()
    };
    let (name, before) = ("gripper \"left\"\n.State", json(&router));
    assert_eq!(before["topics"].get("ua_0_7_101"), None);
    assert_eq!(before["topics_without_values"]["ua_0_7_101"]["name"], name);
    assert_eq!(before["calls"]["ua_0_7_105"]["name"], "gripper.Start");

    router.handle_datagram(&datagram((0, 7, 101)), from, crate::clock::now());
    let after = json(&router);
    assert_eq!(after["topics"]["ua_0_7_101"]["name"], name);
    assert_eq!(after.get("topics_without_values"), None);
    let text = status(&router).prometheus();
    let own = "program=\"bridge\",space=\"1\"";
    for line in [
        format!(
            "ua_topic_info{{{own},topic=\"ua_0_7_101\",name=\"gripper \\\"left\\\"\\n.State\",\
             ros_topics=\"\"}} 1\n"
        ),
        format!("ua_call_info{{{own},call=\"ua_0_7_105\",name=\"gripper.Start\"}} 1\n"),
    ] {
        assert!(text.contains(&line), "{text}");
    }

    // The names of a program that changed its names too often have no series.
    let mut names = AnnouncedNames::default();
    let call = "ua_0_7_105".parse().unwrap();
    for number in 0..MOST_NAMES {
        let name = format!("gripper {number}");
        names.admit([(call, name.as_str())].into_iter());
    }
    let limited = status(&router).with_names(&router, &mut names);
    let text = limited.prometheus();
    assert!(!text.contains("_info{"), "{text}");
    let line = format!("ua_names_left_out_total{{{own}}} 2\n");
    assert!(text.contains(&line), "{text}");
    let json: serde_json::Value = serde_json::from_str(&limited.json()).unwrap();
    assert_eq!(json["topics"]["ua_0_7_101"]["name"], name);
}
