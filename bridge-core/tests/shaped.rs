//! Parts of arrays and converted values, from a mapping through the bridges of two spaces.
#![expect(
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bridge_core::{Heard, Local, Now, Output, Reason, Router, Settings, Verdict};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, NoFields, Plan, Registry, Selection, Wire};
use uadp::Timestamp;

const CELL: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:my-plant:line}
variables:
  - node: ns=2;i=10
    name: Elbow
    origin: 1
    type: Int32
    ros:
      - {topic: /joint_states, type: sensor_msgs/JointState, field: "position[name=elbow]", scale: 1000, out_of_range: refuse}
      - {space: 2, topic: /elbow, type: std_msgs/Float64, scale: 1000}
  - node: ns=2;i=11
    name: Closed
    origin: 1
    ros:
      - {topic: /gate_open, type: std_msgs/Bool, invert: true}
      - {space: 2, topic: /gate_closed, type: std_msgs/Bool}
"#;

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn now() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

/// The bridge of a space, its topics bound as the cell says.
fn bridge(space: u16, now: Now) -> Router {
    let checked = Mapping::from_yaml(CELL, "cell.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(CELL));
    let mapping = Arc::new(checked.mapping.unwrap());
    let own = SpaceId::new(space).unwrap();
    let (local, dialect) = match space {
        1 => (Local::Ros1, Dialect::Ros1),
        _ => (Local::Cdr, Dialect::Ros2),
    };
    let settings = Settings {
        own,
        local,
        source: None,
    };
    let mut router = Router::new(settings, Arc::clone(&mapping));
    let registry = Registry::bundle(dialect);
    for (variable, binding) in mapping.bindings(own) {
        let message_type = registry.get(&binding.message_type).unwrap();
        router
            .bind(variable.topic, &message_type, &binding.selection, now)
            .unwrap();
    }
    router
}

/// What is published in space 2 when space 1 hears `payload`.
fn cross(topic: &str, payload: &[u8]) -> Result<Vec<u8>, String> {
    let now = now();
    let topic: TopicId = topic.parse().unwrap();
    let (mut sender, mut reader) = (bridge(1, now), bridge(2, now));
    let heard = Heard {
        topic,
        payload,
        received: now.utc,
        latched_by: None,
    };
    let verdict = sender.handle_local(heard, now);
    let mut told = String::new();
    while let Some(output) = sender.poll_output(now) {
        match output {
            Output::Datagram { bytes, .. } => reader.handle_datagram(&bytes, PEER, now),
            Output::Notice(notice) => told = notice.detail,
            _ => {}
        }
    }
    if verdict != Verdict::Forward {
        assert_eq!(verdict, Verdict::Drop(Reason::Mismatch));
        return Err(told);
    }
    let delivered =
        std::iter::from_fn(|| reader.poll_output(now)).find_map(|output| match output {
            Output::Delivery(delivery) => Some(delivery.payload),
            _ => None,
        });
    Ok(delivered.unwrap())
}

fn joint_state(names: &[&str], positions: &[f64]) -> Vec<u8> {
    let mut bytes = vec![0; 16];
    bytes.extend(u32::try_from(names.len()).unwrap().to_le_bytes());
    for name in names {
        bytes.extend(u32::try_from(name.len()).unwrap().to_le_bytes());
        bytes.extend(name.as_bytes());
    }
    bytes.extend(u32::try_from(positions.len()).unwrap().to_le_bytes());
    bytes.extend(positions.iter().flat_map(|at| at.to_le_bytes()));
    bytes.extend([0; 8]);
    bytes
}

#[test]
fn a_joint_by_its_name_crosses_in_thousandths_and_comes_out_in_radians() {
    let state = joint_state(&["shoulder", "elbow"], &[1.0, 0.2504]);
    let delivered = cross("ua_1_2_10", &state).unwrap();
    let mut expected = vec![0, 1, 0, 0];
    expected.extend(0.25f64.to_le_bytes());
    assert_eq!(delivered, expected, "250 thousandths");
}

#[test]
fn a_message_without_the_joint_or_with_too_big_a_value_is_dropped_and_told() {
    let state = joint_state(&["shoulder"], &[1.0]);
    let why = cross("ua_1_2_10", &state).unwrap_err();
    assert_eq!(why, "field `position`: no element is named `elbow`");
    let state = joint_state(&["elbow"], &[1e9]);
    let why = cross("ua_1_2_10", &state).unwrap_err();
    assert_eq!(why, "field `position`: 1000000000000 does not fit Int32");
}

#[test]
fn an_inverted_boolean_crosses_as_the_other() {
    assert_eq!(cross("ua_1_2_11", &[1]).unwrap(), [0, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(cross("ua_1_2_11", &[0]).unwrap(), [0, 1, 0, 0, 1, 0, 0, 0]);
}

#[test]
fn a_message_of_zeros_is_what_the_test_takes_it_for() {
    let registry = Registry::bundle(Dialect::Ros1);
    let message = registry
        .get(&"sensor_msgs/JointState".parse().unwrap())
        .unwrap();
    let nothing = Selection::Template {
        field: None,
        rest: [].into(),
    };
    let plan = Plan::compile(&message, &nothing, Wire::Ros1).unwrap();
    let mut out = Vec::new();
    plan.write(&mut NoFields, &mut out).unwrap();
    assert_eq!(out, joint_state(&[], &[]));
}

const PEER: SocketAddr = SocketAddr::new(
    std::net::IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 9)),
    4840,
);
