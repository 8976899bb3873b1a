//! What a document without faults comes to, and that no text is too strange.
#![expect(clippy::unwrap_used, reason = "test code")]

use std::net::SocketAddr;
use std::num::NonZeroU16;
use std::time::Duration;

use mappings::{
    Checked, Code, Mapping, Overflow, PubSub, PublisherIdRule, SecurityPolicy, SpaceId, TopicId,
};
use messages::{Leaf, Rank, Selection};
use proptest::prelude::*;
use uadp::BuiltinType;

const HEAD: &str = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:my-plant:line}\nvariables:\n";

fn sound(text: &str) -> Mapping {
    let checked = Mapping::from_yaml(text, "cell.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(text));
    checked.mapping.unwrap()
}

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn codes(checked: &Checked) -> Vec<Code> {
    checked.findings.iter().map(|found| found.code).collect()
}

#[test]
fn an_empty_document_is_zero_configuration() {
    for text in [
        "",
        "# nothing yet\n",
        "{}",
        "spaces:\nvariables:\n",
        "pubsub: {}\nserver: ~\n",
    ] {
        let mapping = sound(text);
        assert_eq!(*mapping.pubsub(), PubSub::default(), "{text:?}");
        assert!(mapping.variables().is_empty() && mapping.spaces().is_empty());
        assert_eq!(mapping.server(), Mapping::default().server());
    }
    let pubsub = PubSub::default();
    assert_eq!(
        pubsub.address,
        "239.192.0.40:4840".parse::<SocketAddr>().unwrap()
    );
    assert_eq!(
        (pubsub.ttl, pubsub.publisher_id),
        (1, PublisherIdRule::Exact)
    );
    assert_eq!(pubsub.receive_timeout, Duration::from_secs(3));
    assert_eq!(
        Mapping::default().server().endpoint.to_string(),
        "opc.tcp://127.0.0.1:4840"
    );
}

#[test]
fn everything_of_the_network_can_be_said() {
    let mapping = sound(
        "pubsub:\n  address: opc.udp://10.0.0.7:14840/\n  interface: 10.0.0.1\n  ttl: 0\n  publisher_id: any_width\n  \
         key_frame_period: 500ms\n  keep_alive_period: 2.5s\n  receive_timeout: 1min\nserver:\n  endpoint: \
         opc.tcp://gateway:4841/cell\n  application_uri: urn:x:y\n  security: [Basic256Sha256]\n",
    );
    let pubsub = mapping.pubsub();
    assert_eq!(
        pubsub.address,
        "10.0.0.7:14840".parse::<SocketAddr>().unwrap()
    );
    assert_eq!(pubsub.interface.as_deref(), Some("10.0.0.1"));
    assert_eq!(
        (pubsub.ttl, pubsub.publisher_id),
        (0, PublisherIdRule::AnyWidth)
    );
    assert_eq!(pubsub.key_frame_period, Duration::from_millis(500));
    assert_eq!(pubsub.keep_alive_period, Duration::from_millis(2500));
    assert_eq!(pubsub.receive_timeout, Duration::from_secs(60));
    assert_eq!(
        mapping.server().endpoint.to_string(),
        "opc.tcp://gateway:4841/cell"
    );
    assert_eq!(mapping.server().security, [SecurityPolicy::Basic256Sha256]);
    let v6 = sound("pubsub: {address: \"opc.udp://[ff05::40]\"}");
    assert_eq!(
        v6.pubsub().address,
        "[ff05::40]:4840".parse::<SocketAddr>().unwrap()
    );
}

#[test]
fn a_variable_without_a_binding_goes_by_its_name_in_the_space() {
    let text = format!("{HEAD}  - {{node: ns=2;i=10, name: Speed, type: 'Double[]', origin: 2}}\n");
    let mapping = sound(&text);
    let variable = mapping.variable(topic("ua_2_2_10")).unwrap();
    assert!(variable.bindings.is_empty());
    assert_eq!(variable.value_type, Some((BuiltinType::Double, true)));
    assert_eq!(variable.fields.len(), 1);
    assert_eq!(variable.fields[0].rank, Rank::Array { fixed: None });
    assert_eq!(
        mapping.variable(topic("ua_1_2_10")),
        None,
        "another origin is another topic"
    );
}

#[test]
fn a_variable_without_any_type_is_left_to_what_comes() {
    let mapping = sound(&format!(
        "{HEAD}  - {{node: ns=2;i=10, name: Speed, origin: 1}}\n"
    ));
    let variable = &mapping.variables()[0];
    assert_eq!((variable.value_type, variable.fields.len()), (None, 0));
}

#[test]
fn a_whole_message_is_a_field_per_leaf() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=10, name: Speed, origin: 1, ros: {{topic: /cmd_vel, type: geometry_msgs/msg/Twist}}}}\n"
    );
    let mapping = sound(&text);
    let variable = &mapping.variables()[0];
    let paths: Vec<&str> = variable
        .fields
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    assert_eq!(
        paths,
        [
            "linear.x",
            "linear.y",
            "linear.z",
            "angular.x",
            "angular.y",
            "angular.z"
        ]
    );
    assert_eq!(variable.value_type, None);
    assert_eq!(variable.bindings[0].selection, Selection::Whole);
    assert_eq!(
        variable.bindings[0].message_type.to_string(),
        "geometry_msgs/Twist"
    );
}

#[test]
fn a_binding_takes_the_std_msgs_type_of_the_variable() {
    let text = format!(
        "{HEAD}  - node: ns=2;i=10\n    name: T\n    type: DateTime\n    origin: 1\n    ros: [{{topic: /t}}, {{space: 2, topic: /t}}]\n"
    );
    let mapping = sound(&text);
    let bindings = &mapping.variables()[0].bindings;
    let types: Vec<String> = bindings
        .iter()
        .map(|binding| binding.message_type.to_string())
        .collect();
    assert_eq!(types, ["std_msgs/Time", "builtin_interfaces/Time"]);
    assert_eq!(
        bindings[0].space,
        SpaceId::ROS1,
        "the origin, where nothing else is said"
    );
}

#[test]
fn several_variables_read_fields_of_one_topic() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=10, name: X, origin: 1, ros: {{topic: /v, type: geometry_msgs/Twist, field: linear.x}}}}\n  \
         - {{node: ns=2;i=11, name: Y, origin: 1, ros: {{topic: /v, type: geometry_msgs/Twist, field: linear.y}}}}\n"
    );
    let mapping = sound(&text);
    let bound: Vec<(TopicId, &str)> = mapping
        .bindings(SpaceId::ROS1)
        .map(|(v, binding)| (v.topic, binding.ros_topic.as_str()))
        .collect();
    assert_eq!(
        bound,
        [(topic("ua_1_2_10"), "/v"), (topic("ua_1_2_11"), "/v")]
    );
}

#[test]
fn an_alias_stands_for_a_node_that_has_no_small_number() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;s=Line.Speed, name: Speed, origin: 1, alias: 7}}\n  \
         - {{node: i=2258, name: CurrentTime, origin: 0, alias: 8}}\n"
    );
    let mapping = sound(&text);
    assert_eq!(
        mapping
            .variable(topic("ua_1_2_7"))
            .unwrap()
            .node
            .to_string(),
        "ns=2;s=Line.Speed"
    );
    assert_eq!(
        mapping
            .variable(topic("ua_0_65535_8"))
            .unwrap()
            .node
            .to_string(),
        "i=2258"
    );
}

#[test]
fn a_queue_keeps_the_latest_unless_it_is_said_otherwise() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=1, name: A, origin: 1}}\n  - {{node: ns=2;i=2, name: B, origin: 1, queue: keep_latest}}\n  \
         - {{node: ns=2;i=3, name: C, origin: 1, queue: {{drop_oldest: 100}}}}\n"
    );
    let overflow: Vec<Overflow> = sound(&text)
        .variables()
        .iter()
        .map(|v| v.overflow)
        .collect();
    let hundred = NonZeroU16::new(100).unwrap();
    assert_eq!(
        overflow,
        [
            Overflow::KeepLatest,
            Overflow::KeepLatest,
            Overflow::DropOldest(hundred)
        ]
    );
}

#[test]
fn the_own_name_may_be_bound_to_say_its_type() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=10, name: A, origin: 1, ros: {{space: 2, topic: /ua_1_2_10, type: std_msgs/Bool}}}}\n"
    );
    assert_eq!(
        sound(&text).variables()[0].bindings[0].ros_topic,
        "/ua_1_2_10"
    );
}

#[test]
fn an_unknown_type_read_from_ros_1_is_a_warning_and_runs() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=10, name: A, origin: 1, ros: {{topic: /io, type: niryo_robot_rpi/DigitalIOState, field: x}}}}\n"
    );
    let checked = Mapping::from_yaml(&text, "cell.yaml");
    assert_eq!(codes(&checked), [Code::UnknownMessageType]);
    let variable = checked.mapping.unwrap().variables()[0].clone();
    assert_eq!((variable.value_type, variable.fields.len()), (None, 0));
    assert_eq!(
        variable.bindings[0].selection,
        Selection::Field("x".to_owned())
    );
}

#[test]
fn a_message_may_cross_as_bytes_whether_its_type_is_known_or_not() {
    let text = format!(
        "{HEAD}  - node: ns=2;i=10\n    name: Image\n    type: ByteString\n    origin: 1\n    ros:\n      \
         - {{topic: /camera, type: sensor_msgs/Image, as: bytes}}\n      \
         - {{space: 2, topic: /image, type: std_msgs/UInt8MultiArray, field: data, as: fields}}\n"
    );
    let mapping = sound(&text);
    let variable = &mapping.variables()[0];
    assert_eq!(variable.value_type, Some((BuiltinType::ByteString, false)));
    assert_eq!(variable.fields, [Leaf::bytes()]);
    assert_eq!(variable.bindings[0].selection, Selection::Bytes);
    let text = text.replace("sensor_msgs", "their_msgs");
    let checked = Mapping::from_yaml(&text, "cell.yaml");
    assert_eq!(codes(&checked), [Code::UnknownMessageType]);
    assert_eq!(
        checked.mapping.unwrap().variables()[0].fields,
        [Leaf::bytes()]
    );
}

#[test]
fn a_fault_behind_an_alias_of_yaml_is_told_once() {
    let text = "spaces: [{id: 1}]\nnamespaces: {2: urn:x:y}\nvariables:\n  \
                - {node: ns=2;i=1, name: A, origin: 1, queue: &q newest}\n  - {node: ns=2;i=2, name: B, origin: 1, queue: *q}\n";
    assert_eq!(
        codes(&Mapping::from_yaml(text, "cell.yaml")),
        [Code::WrongValue]
    );
}

#[test]
fn a_fault_does_not_bring_others_with_it() {
    // The space, the namespace and the type are faulty where they are declared, and used below.
    let text = "spaces: [{id: one}]\nnamespaces: {two: urn:x:y}\nvariables:\n  \
                - {node: ns=2;i=1, name: A, type: bool, origin: 1, ros: {topic: /a}}\n";
    let checked = Mapping::from_yaml(text, "cell.yaml");
    assert_eq!(
        codes(&checked),
        [Code::WrongValue, Code::WrongValue, Code::ValueType],
        "{}",
        checked.render(text)
    );
}

#[test]
fn a_flood_of_findings_ends_with_their_number() {
    let entries: String = (0..5000)
        .map(|n| format!("  - {{node: x{n}, name: A{n}, origin: 1}}\n"))
        .collect();
    let checked = Mapping::from_yaml(&format!("{HEAD}{entries}"), "cell.yaml");
    assert_eq!(checked.findings.len(), 201);
    let last = checked.findings.last().unwrap();
    assert_eq!(
        (last.code, last.message.as_str()),
        (Code::TooLarge, "4800 more findings are not shown")
    );
}

#[test]
fn too_many_variables_are_refused_and_the_most_allowed_are_not() {
    let document = |count: u32| {
        let entries: String = (0..count)
            .map(|n| format!("  - {{node: ns=2;i={}, name: A{n}, origin: 1}}\n", n + 1))
            .collect();
        Mapping::from_yaml(&format!("{HEAD}{entries}"), "cell.yaml")
    };
    assert_eq!(document(20_000).mapping.unwrap().variables().len(), 20_000);
    assert_eq!(codes(&document(20_001)), [Code::TooLarge]);
}

#[test]
fn aliases_of_yaml_cannot_make_a_small_text_take_long() {
    let bindings = "{topic: /a}, ".repeat(5000);
    let uses = "  - *v\n".repeat(19_000);
    let text =
        format!("{HEAD}  - &v {{node: ns=2;i=1, name: A, origin: 1, ros: [{bindings}]}}\n{uses}");
    let checked = Mapping::from_yaml(&text, "cell.yaml");
    assert!(
        codes(&checked).contains(&Code::TooLarge),
        "{:?}",
        checked.findings.first()
    );
}

/// A shipped or faulty document with pieces of it cut, doubled, or replaced.
fn mutated() -> impl Strategy<Value = String> {
    let base = prop_oneof![
        Just(include_str!("../assembly-line.yaml")),
        Just(include_str!("../minimal.yaml")),
        Just(include_str!("bad/ten-faults.yaml")),
        Just(include_str!("bad/M064.yaml")),
    ];
    let piece = prop_oneof![
        "[-:{}\\[\\],&*!|>'\"# \n\t~0-9a-z/_;=.]{0,6}",
        Just("&a ".to_owned()),
        Just("*a".to_owned()),
        Just("99999999999999999999".to_owned()),
        Just("\u{feff}\u{202e}ä\r\n".to_owned()),
    ];
    let edit = (any::<prop::sample::Index>(), 0..12_usize, piece);
    (base, prop::collection::vec(edit, 1..6)).prop_map(|(base, edits)| {
        let mut text: Vec<char> = base.chars().collect();
        for (at, cut, piece) in edits {
            let start = at.index(text.len() + 1);
            let end = (start + cut).min(text.len());
            text.splice(start..end, piece.chars());
        }
        text.into_iter().collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn any_text_gives_a_mapping_or_an_error_told_in_plain_lines(
        text in prop_oneof![3 => mutated(), 1 => "\\PC{0,80}", 1 => "[-a-c:{}\\[\\],&*!|>'\"# \n\t~?%@]{0,80}"],
    ) {
        let checked = Mapping::from_yaml(&text, "cell.yaml");
        let told = checked.render(&text);
        prop_assert_eq!(checked.mapping.is_none(), told.contains("error[M"), "{}", told);
        prop_assert!(!told.contains(|c: char| c.is_control() && c != '\n'));
        for found in &checked.findings {
            prop_assert!(found.at.line >= 1 && found.at.column >= 1 && found.at.len >= 1);
        }
    }
}
