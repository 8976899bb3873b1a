//! Parts of arrays and converted values, from a mapping through the bridges of two spaces.
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use bridge_core::{Local, LocalMessage, Now, Output, Reason, Router, RouterSettings, Verdict};
use mappings::{Mapping, ServiceRole, SpaceId, TopicId};
use messages::{Dialect, MessagePlan, NoFields, Selected, Selection, TypeRegistry, Wire};
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

fn mapping(text: &str) -> Arc<Mapping> {
    let checked = Mapping::from_yaml(text, "cell.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(text));
    Arc::new(checked.mapping.unwrap())
}

fn router(space: u16, mapping: &Arc<Mapping>) -> Router {
    let settings = RouterSettings {
        own: SpaceId::new(space).unwrap(),
        local: match space {
            1 => Local::Ros1,
            _ => Local::Cdr,
        },
        source: None,
    };
    Router::new(settings, Arc::clone(mapping))
}

fn registry(space: u16) -> TypeRegistry {
    TypeRegistry::bundle(match space {
        1 => Dialect::Ros1,
        _ => Dialect::Ros2,
    })
}

/// Creates the bridge of a space, which binds its topics according to the mapping.
fn bridge(space: u16, now: Now) -> Router {
    let mapping = mapping(CELL);
    let mut router = router(space, &mapping);
    let registry = registry(space);
    for (variable, binding) in mapping.bindings(SpaceId::new(space).unwrap()) {
        let message_type = registry.get(&binding.message_type).unwrap();
        router
            .bind(variable.topic, &message_type, &binding.selection, now)
            .unwrap();
    }
    router
}

/// Returns the message that is published in space 2 when space 1 receives `payload`.
fn cross(topic: &str, payload: &[u8]) -> Result<Vec<u8>, String> {
    let now = now();
    carried(
        &mut bridge(1, now),
        &mut bridge(2, now),
        topic,
        payload,
        now,
    )
}

/// Returns the message that `reader` publishes when `sender` receives `payload`, or the reason why
/// the sender drops it.
fn carried(
    sender: &mut Router,
    reader: &mut Router,
    topic: &str,
    payload: &[u8],
    now: Now,
) -> Result<Vec<u8>, String> {
    let topic: TopicId = topic.parse().unwrap();
    let heard = LocalMessage {
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
    assert_eq!(why, "field `position`: no element has the name `elbow`");
    let state = joint_state(&["elbow"], &[1e9]);
    let why = cross("ua_1_2_10", &state).unwrap_err();
    assert_eq!(why, "field `position`: 1000000000000 does not fit Int32");
}

#[test]
fn an_inverted_boolean_crosses_as_the_other() {
    assert_eq!(cross("ua_1_2_11", &[1]).unwrap(), [0, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(cross("ua_1_2_11", &[0]).unwrap(), [0, 1, 0, 0, 1, 0, 0, 0]);
}

/// Returns the Twist that space 2 publishes for a topic with a value from a pattern. The pattern
/// selects `chosen`, and space 2 reads the values as `taken`.
fn by_pattern(chosen: &str, taken: &Selection) -> Vec<u8> {
    let mapping = mapping(&format!(
        "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:my-plant:line}}\npatterns:\n  \
         - {{topics: \"/robot*/cmd_vel\", origin: 1, node: \"ns=2;i=10{{1}}\", name: \"Robot{{1}}\", {chosen}}}\n"
    ));
    let now = now();
    let name = "geometry_msgs/Twist".parse().unwrap();
    let made = mapping.matching(SpaceId::ROS1, "/robot2/cmd_vel", Some(&name));
    let made = made.unwrap().unwrap();
    assert_eq!(made.topic.to_string(), "ua_1_2_102");
    let (mut sender, mut reader) = (router(1, &mapping), router(2, &mapping));
    let twist = |space| registry(space).get(&name).unwrap();
    let bound = sender.bind(made.topic, &twist(1), &made.selection, now);
    bound.unwrap();
    reader.bind(made.topic, &twist(2), taken, now).unwrap();
    let payload: Vec<u8> = TWIST.iter().flat_map(|value| value.to_le_bytes()).collect();
    carried(&mut sender, &mut reader, "ua_1_2_102", &payload, now).unwrap()
}

const TWIST: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 0.25];

fn cdr(values: [f64; 6]) -> Vec<u8> {
    let values = values.iter().flat_map(|value| value.to_le_bytes());
    [0, 1, 0, 0].into_iter().chain(values).collect()
}

#[test]
fn fields_of_topics_of_a_pattern_cross_each_converted_by_its_own() {
    let chosen = "type: geometry_msgs/Twist, fields: [linear.x, {field: angular.z, scale: 1000}]";
    let fields = ["linear.x", "angular.z"].map(Selected::whole).to_vec();
    let delivered = by_pattern(chosen, &Selection::Fields(fields));
    assert_eq!(delivered, cdr([1.0, 0.0, 0.0, 0.0, 0.0, 250.0]));
}

#[test]
fn topics_of_a_pattern_cross_as_structures() {
    let whole = by_pattern("as: structure", &Selection::Structure(None));
    assert_eq!(whole, cdr(TWIST));
    let within = Selection::Structure(Some("linear".to_owned()));
    let linear = by_pattern(
        "type: geometry_msgs/Twist, field: linear, as: structure",
        &within,
    );
    assert_eq!(linear, cdr([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]));
}

#[test]
fn requests_and_answers_of_services_are_converted() {
    let mapping = mapping(
        r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:my-plant:line}
variables:
  - node: ns=2;i=20
    name: Tolerance
    origin: 2
    ros:
      - {topic: /millimetres, type: std_msgs/Float64}
      - {space: 1, call: /plan, type: nav_msgs/GetPlan, field: tolerance, scale: 1000, out_of_range: refuse, request: {start.header.frame_id: map}}
    type: Double
  - node: ns=2;i=21
    name: Failed
    origin: 1
    ros:
      - {poll: /ready, type: std_srvs/Trigger, field: success, invert: true}
      - {space: 2, topic: /failed, type: std_msgs/Bool}
"#,
    );
    let now = now();
    let (mut ros1, mut ros2) = (router(1, &mapping), router(2, &mapping));
    for (variable, binding) in mapping.bindings(SpaceId::new(2).unwrap()) {
        let message_type = registry(2).get(&binding.message_type).unwrap();
        let bound = ros2.bind(variable.topic, &message_type, &binding.selection, now);
        bound.unwrap();
    }
    for (variable, service) in mapping.services(SpaceId::ROS1) {
        let (message_type, selection) = match &service.role {
            ServiceRole::Call {
                service_type,
                request,
                ..
            } => {
                let service_type = registry(1).service(service_type).unwrap();
                (Arc::clone(service_type.request()), request)
            }
            ServiceRole::Poll {
                service_type,
                selection,
                ..
            } => {
                let service_type = registry(1).service(service_type).unwrap();
                (Arc::clone(service_type.response()), selection)
            }
            ServiceRole::Answer { .. } => panic!("the mapping has none"),
        };
        let bound = ros1.bind(variable.topic, &message_type, selection, now);
        bound.unwrap();
    }
    let value = [&[0, 1, 0, 0][..], &250f64.to_le_bytes()].concat();
    let request = carried(&mut ros2, &mut ros1, "ua_2_2_20", &value, now).unwrap();
    assert!(
        request.ends_with(&0.25f32.to_le_bytes()),
        "250 mm are {request:?}"
    );
    let map = request.windows(3).position(|bytes| bytes == b"map");
    assert_eq!(map, Some(16), "behind sequence number, time and length");
    let ready = [1, 0, 0, 0, 0];
    let delivered = carried(&mut ros1, &mut ros2, "ua_1_2_21", &ready, now).unwrap();
    assert_eq!(delivered, [0, 1, 0, 0, 0, 0, 0, 0]);
    let failed = [0, 0, 0, 0, 0];
    let delivered = carried(&mut ros1, &mut ros2, "ua_1_2_21", &failed, now).unwrap();
    assert_eq!(delivered, [0, 1, 0, 0, 1, 0, 0, 0]);
}

#[test]
fn a_message_of_zeros_is_what_the_test_takes_it_for() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let message = registry
        .get(&"sensor_msgs/JointState".parse().unwrap())
        .unwrap();
    let nothing = Selection::Template {
        fields: Vec::new(),
        rest: [].into(),
    };
    let plan = MessagePlan::compile(&message, &nothing, Wire::Ros1).unwrap();
    let mut out = Vec::new();
    plan.write(&mut NoFields, &mut out).unwrap();
    assert_eq!(out, joint_state(&[], &[]));
}

const PEER: SocketAddr = SocketAddr::new(
    std::net::IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 9)),
    4840,
);
