//! Documents without faults, and robustness against arbitrary texts.
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::num::NonZeroU16;
use std::time::Duration;

use mappings::{
    CarrierMedium, Checked, Code, EthernetGroup, KeySource, Mapping, Overflow, PubSub,
    PublisherIdRule, ServerSecurityPolicy, ServiceRole, SpaceId, TopicId, Trigger, UaField,
};
use messages::{ArrayPart, ArrayRank, Conversion, Leaf, Literal, Selected, Selection};
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
fn an_empty_document_is_refused() {
    for text in ["", "# nothing yet\n", "---\n"] {
        let checked = Mapping::from_yaml(text, "cell.yaml");
        assert!(checked.mapping.is_none(), "{text:?}");
        assert!(checked.findings[0].message.contains("is empty"));
    }
}

#[test]
fn redundant_servers_have_two_or_three_different_uris() {
    let text = |uris: &str| format!("spaces: [{{id: 1}}]\nserver: {{redundant: {uris}}}\n");
    let mapping = sound(&text("[\"urn:cell:a\", \"urn:cell:b\"]"));
    let uri = |rank| {
        let ranked = mapping.for_rank(rank)?;
        Some(ranked.server().application_uri.clone())
    };
    assert_eq!(uri(2).as_deref(), Some("urn:cell:b"));
    assert_eq!((uri(0), uri(3)), (None, None));
    for faulty in [
        "[\"urn:cell:a\"]",
        "[\"urn:cell:a\", \"urn:cell:a\"]",
        "[\"urn:cell:a\", \"my server\"]",
    ] {
        let checked = Mapping::from_yaml(&text(faulty), "cell.yaml");
        assert_eq!(codes(&checked), [Code::ApplicationUri], "{faulty}");
    }
}

#[test]
fn redundant_servers_have_an_endpoint_each() {
    let text = |endpoints: &str| {
        format!(
            "spaces: [{{id: 1}}]\nserver: {{redundant: [\"urn:cell:a\", \"urn:cell:b\"], \
             redundant_endpoints: {endpoints}}}\n"
        )
    };
    let mapping = sound(&text("[\"opc.tcp://host-a\", \"opc.tcp://host-b:4841\"]"));
    let endpoint = |rank| {
        let ranked = mapping.for_rank(rank).unwrap();
        ranked.server().endpoint.to_string()
    };
    assert_eq!(endpoint(1), "opc.tcp://host-a:4840");
    assert_eq!(endpoint(2), "opc.tcp://host-b:4841");
    for faulty in [
        "[\"opc.tcp://host-a\"]",
        "[\"opc.tcp://host-a\", \"opc.tcp://host-a\"]",
        "[\"opc.tcp://host-a\", \"host-b\"]",
    ] {
        let checked = Mapping::from_yaml(&text(faulty), "cell.yaml");
        assert_eq!(codes(&checked), [Code::Endpoint], "{faulty}");
    }
}

#[test]
fn the_first_server_of_a_redundant_set_creates_the_keys_and_all_belong_to_the_cell() {
    const SET: &str = ", redundant_endpoints: [\"opc.tcp://host-a\", \"opc.tcp://host-b\"]";
    const KEYS: &str = "security: [{group: cell, keys: {sks: {members: [\"urn:x\"]}}}]\n";
    let text = |set: &str, more: &str| {
        format!(
            "spaces: [{{id: 1}}]\nserver: {{security: [Basic256Sha256], \
             redundant: [\"urn:cell:a\", \"urn:cell:b\"]{set}}}\n{more}"
        )
    };
    let mapping = sound(&text(SET, KEYS));
    let Some(KeySource::Own(served)) = &mapping.security()[0].keys else {
        panic!("the keys are not those of the cell");
    };
    assert_eq!(served.endpoint.to_string(), "opc.tcp://host-a:4840");
    let creates = |rank| mapping.for_rank(rank).unwrap().server().creates_keys();
    assert_eq!([creates(1), creates(2)], [true, false]);
    assert!(mapping.server().creates_keys(), "a server without a rank");
    let second = "security: [{group: cell, keys: {sks: {endpoint: \"opc.tcp://host-b:4840\"}}}]\n";
    let server = "servers: [{name: plc, endpoint: \"opc.tcp://host-b:4840\"}]\n";
    for (set, more, code) in [
        ("", KEYS, Code::KeyService),
        (SET, second, Code::KeyService),
        (SET, server, Code::Servers),
    ] {
        let text = text(set, more);
        let checked = Mapping::from_yaml(&text, "cell.yaml");
        assert!(codes(&checked).contains(&code), "{}", checked.render(&text));
    }
}

#[test]
fn a_document_whose_keys_have_no_values_is_zero_configuration() {
    for text in ["{}", "spaces:\nvariables:\n", "pubsub: {}\nserver: ~\n"] {
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
    assert_eq!(
        mapping.server().policies(true),
        [ServerSecurityPolicy::Basic256Sha256]
    );
    let v6 = sound("pubsub: {address: \"opc.udp://[ff05::40]\"}");
    assert_eq!(
        v6.pubsub().address,
        "[ff05::40]:4840".parse::<SocketAddr>().unwrap()
    );
}

#[test]
fn ethernet_is_the_only_carrier_or_one_of_several() {
    let group = |text: &str, at: usize| {
        let mapping = sound(text);
        match &mapping.pubsub().carriers[at].medium {
            CarrierMedium::Ethernet(group) => group.clone(),
            other => panic!("{other:?}"),
        }
    };
    let alone = group("pubsub: {eth: {interface: eth0}}", 0);
    assert_eq!(
        (alone.interface.as_str(), alone.address),
        ("eth0", EthernetGroup::ADDRESS)
    );
    assert_eq!((alone.vlan, alone.priority), (None, None));
    let keys = "address: 01-00-5E-7F-00-01, vlan: 5, priority: 6";
    let url = "address: \"opc.eth://01-00-5E-7F-00-01:5.6\"";
    let [keys, url] = [keys, url].map(|address| {
        let text = format!("pubsub: [{{udp: {{}}}}, {{eth: {{interface: eth1, {address}}}}}]");
        group(&text, 1)
    });
    assert_eq!(keys, url);
    assert_eq!(keys.address.to_string(), "01-00-5E-7F-00-01");
    assert_eq!((keys.vlan, keys.priority), (Some(5), Some(6)));
    let one = group(
        "pubsub: [{eth: {interface: eth0}}, {settings: {key_frame_period: 2s}}]",
        0,
    );
    assert_eq!(one, alone);
}

#[test]
fn shared_memory_is_the_only_carrier_or_one_of_several_and_its_group_has_a_name() {
    for (text, expected) in [
        ("pubsub: {shm: {}}", "cell"),
        ("pubsub: {shm: {group: cell-4}}", "cell-4"),
        ("pubsub: [{udp: {}}, {shm: {group: a_1}}]", "a_1"),
    ] {
        let mapping = sound(text);
        let carriers = mapping.pubsub().carriers.iter();
        let groups: Vec<&str> = carriers
            .filter_map(|carrier| match &carrier.medium {
                CarrierMedium::SharedMemory(group) => Some(group.name()),
                _ => None,
            })
            .collect();
        assert_eq!(groups, [expected], "{text}");
    }
    for (text, code) in [
        ("pubsub: {shm: {group: a b}}", Code::Address),
        ("pubsub: {shm: {group: \"\"}}", Code::Address),
        ("pubsub: {shm: {}, ttl: 3}", Code::Carriers),
        ("pubsub: {shm: {}, eth: {interface: eth0}}", Code::Carriers),
        ("pubsub: [{shm: {}}, {shm: {group: cell}}]", Code::Carriers),
    ] {
        let checked = Mapping::from_yaml(text, "cell.yaml");
        assert_eq!(codes(&checked), [code], "{}", checked.render(text));
    }
}

#[test]
fn a_list_names_several_carriers_with_their_names_and_common_settings() {
    let mapping = sound(
        "pubsub:\n  - udp: {address: opc.udp://239.192.0.41, interface: eth1, ttl: 3}\n    forward: [ua_1_2, \
         ua_2_5_10]\n  - mqtt: {address: mqtt://broker.local, prefix: plant, within: 2s}\n    forward: [ua_3]\n  - \
         settings: {key_frame_period: 500ms}\n",
    );
    let pubsub = mapping.pubsub();
    let names = |at: usize| -> Vec<String> {
        let names = pubsub.carriers[at].forward.iter();
        names.map(ToString::to_string).collect()
    };
    assert_eq!(pubsub.carriers.len(), 2);
    assert_eq!(names(0), ["ua_1_2", "ua_2_5_10"]);
    assert_eq!(names(1), ["ua_3"]);
    let (CarrierMedium::Udp(udp), CarrierMedium::Mqtt(broker)) =
        (&pubsub.carriers[0].medium, &pubsub.carriers[1].medium)
    else {
        panic!("{pubsub:?}");
    };
    assert_eq!(udp.address, "239.192.0.41:4840".parse().unwrap());
    assert_eq!((udp.interface.as_deref(), udp.ttl), (Some("eth1"), 3));
    assert_eq!(broker.address.to_string(), "mqtt://broker.local:1883");
    assert_eq!(broker.within, Duration::from_secs(2));
    assert_eq!(pubsub.key_frame_period, Duration::from_millis(500));
    assert_eq!(pubsub.address, udp.address);
    assert_eq!(pubsub.broker.as_ref(), Some(broker));

    let one = sound("pubsub: [{udp: {address: opc.udp://239.192.0.41}}]");
    let map = sound("pubsub: {address: opc.udp://239.192.0.41}");
    assert_eq!(one.pubsub(), map.pubsub());
    let one = sound("pubsub: [{mqtt: {address: mqtt://broker, qos: 1}}]");
    let map = sound("pubsub: {address: mqtt://broker, mqtt: {qos: 1}}");
    assert_eq!(one.pubsub(), map.pubsub());
}

#[test]
fn a_server_without_security_is_one_of_its_own_host_unless_the_mapping_says_so() {
    let silent = sound("server: {endpoint: opc.tcp://gateway:4840}");
    assert!(
        silent
            .server()
            .policies(true)
            .contains(&ServerSecurityPolicy::None)
    );
    let elsewhere = silent.server().policies(false);
    assert_eq!(elsewhere.len(), 3);
    assert!(!elsewhere.contains(&ServerSecurityPolicy::None));
    let told = sound("server: {security: [None, Aes128_Sha256_RsaOaep, Aes256_Sha256_RsaPss]}");
    assert_eq!(
        told.server().policies(false),
        [
            ServerSecurityPolicy::None,
            ServerSecurityPolicy::Aes128Sha256RsaOaep,
            ServerSecurityPolicy::Aes256Sha256RsaPss
        ]
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
    assert_eq!(variable.fields[0].rank, ArrayRank::Array { fixed: None });
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
fn a_part_of_an_array_and_a_converted_value_have_the_type_they_have_in_opc_ua() {
    let mapping = sound(&format!(
        "{HEAD}\
         - {{node: ns=2;i=10, name: A, origin: 1, ros: {{topic: /j, type: sensor_msgs/JointState, field: 'position[name=a b]'}}}}\n\
         - {{node: ns=2;i=11, name: B, origin: 1, ros: {{topic: /s, type: sensor_msgs/LaserScan, field: 'ranges[0:90]'}}}}\n\
         - {{node: ns=2;i=12, name: C, origin: 1, type: Double, ros: {{topic: /c, type: std_msgs/Int16, scale: 0.1}}}}\n\
         - {{node: ns=2;i=13, name: D, origin: 1, type: Double, ros: {{topic: /d, type: std_msgs/Float32}}}}\n\
         - {{node: ns=2;i=14, name: E, origin: 0, type: Double, ros: {{space: 2, topic: /e, type: std_msgs/UInt8, out_of_range: clamp}}}}\n"
    ));
    let types: Vec<_> = mapping
        .variables()
        .iter()
        .map(|variable| variable.value_type.unwrap())
        .collect();
    let (double, float) = (BuiltinType::Double, BuiltinType::Float);
    let expected = [
        (double, false),
        (float, true),
        (double, false),
        (double, false),
        (double, false),
    ];
    assert_eq!(types, expected);
    let selections: Vec<&Selection> = mapping
        .variables()
        .iter()
        .map(|variable| &variable.bindings.first().unwrap().selection)
        .collect();
    let value = |field: &str, part, conversion| Selection::Value {
        field: field.to_owned(),
        part,
        conversion,
    };
    let none = Conversion::default();
    let name = ArrayPart::Named {
        by: "name".to_owned(),
        name: "a b".to_owned(),
    };
    let slice = ArrayPart::Slice { from: 0, to: 90 };
    assert_eq!(*selections[0], value("position", Some(name), none));
    assert_eq!(*selections[1], value("ranges", Some(slice), none));
    let tenth = none.scaled(0.1, 0.0).to(double);
    assert_eq!(*selections[2], value("data", None, tenth));
    assert_eq!(*selections[3], value("data", None, none.to(double)));
    assert_eq!(
        *selections[4],
        value("data", None, none.clamped().to(double))
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
fn a_value_calls_a_service_and_its_answer_is_a_value() {
    let text = format!(
        "{HEAD}  - node: ns=2;i=20\n    name: Run\n    origin: 0\n    ros: {{space: 1, call: /pump, type: std_srvs/srv/SetBool, \
         field: data, timeout: 2s}}\n  \
         - {{node: ns=2;i=21, name: Message, origin: 1, ros: {{answer: ns=2;i=20, field: message}}}}\n  \
         - {{node: ns=2;i=22, name: Answer, origin: 1, ros: {{answer: ns=2;i=20}}}}\n"
    );
    let mapping = sound(&text);
    let services: Vec<_> = mapping.services(SpaceId::ROS1).collect();
    let (run, binding) = services[0];
    assert_eq!(run.value_type, Some((BuiltinType::Boolean, false)));
    assert!(run.bindings.is_empty());
    let call = ServiceRole::Call {
        service: "/pump".to_owned(),
        service_type: "std_srvs/SetBool".parse().unwrap(),
        request: Selection::Template {
            fields: vec![Selected::whole("data")],
            rest: BTreeMap::new(),
        },
        when: Trigger::Any,
        timeout: Duration::from_secs(2),
    };
    assert_eq!(binding.role, call);
    let (message, binding) = services[1];
    assert_eq!(message.value_type, Some((BuiltinType::String, false)));
    let answer = ServiceRole::Answer {
        of: run.topic,
        selection: Selection::Field("message".to_owned()),
    };
    assert_eq!(binding.role, answer);
    assert_eq!(services[2].0.fields.len(), 2, "success and message");
    let two = SpaceId::new(2).unwrap();
    assert_eq!((services.len(), mapping.services(two).count()), (3, 0));
}

#[test]
fn a_request_without_the_value_is_sent_when_the_value_is_the_one_said() {
    let when = |variable: &str, binding: &str| {
        let mapping = sound(&format!(
            "{HEAD}  - {{node: ns=2;i=20, name: Go, origin: 0, {variable} ros: {{space: 1, call: /go, \
             type: std_srvs/Trigger{binding}}}}}\n"
        ));
        match mapping.variables()[0].service.clone().unwrap().role {
            ServiceRole::Call { when, .. } => when,
            other => panic!("{other:?}"),
        }
    };
    let boolean = when("type: Boolean,", "");
    assert_eq!(boolean, Trigger::Equals("true".to_owned()));
    assert_eq!(when("type: Int32,", ""), Trigger::Any);
    assert_eq!(when("", ""), Trigger::Any);
    let seven = when("type: Int32,", ", when: 7");
    assert_eq!(seven, Trigger::Equals("7".to_owned()));
}

#[test]
fn a_topic_of_the_space_is_fed_by_polling_a_service() {
    let text = format!(
        "{HEAD}  - node: ns=2;i=22\n    name: Plan\n    origin: 1\n    ros:\n      poll: /plan\n      type: nav_msgs/GetPlan\n      \
         request: {{start: {{pose: {{position: {{x: 1.5}}}}}}, goal.header.frame_id: map}}\n      \
         every: 2s\n      field: plan.header.frame_id\n"
    );
    let mapping = sound(&text);
    let variable = &mapping.variables()[0];
    assert_eq!(variable.value_type, Some((BuiltinType::String, false)));
    let one = |path: &str, text: &str| (path.to_owned(), Literal::One(text.to_owned()));
    let poll = ServiceRole::Poll {
        service: "/plan".to_owned(),
        service_type: "nav_msgs/GetPlan".parse().unwrap(),
        request: Selection::Template {
            fields: Vec::new(),
            rest: BTreeMap::from([
                one("goal.header.frame_id", "map"),
                one("start.pose.position.x", "1.5"),
            ]),
        },
        selection: Selection::Field("plan.header.frame_id".to_owned()),
        every: Duration::from_secs(2),
        timeout: Duration::from_secs(5),
    };
    assert_eq!(variable.service.as_ref().unwrap().role, poll);
}

#[test]
fn services_of_a_ros_2_space_are_bound_by_their_own_definitions() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=20, name: Run, origin: 0, ros: {{space: 2, call: /run, type: std_srvs/SetBool, \
         field: data}}}}\n  - {{node: ns=2;i=21, name: Sim, origin: 2, ros: {{poll: /arm/get_parameters, \
         type: rcl_interfaces/srv/ListParameters, field: result.names}}}}\n"
    );
    let mapping = sound(&text);
    let space = SpaceId::new(2).unwrap();
    assert_eq!(mapping.services(space).count(), 2);
    let shape = |at: usize| mapping.variables()[at].value_type;
    assert_eq!(shape(0), Some((BuiltinType::Boolean, false)));
    assert_eq!(shape(1), Some((BuiltinType::String, true)));
}

#[test]
fn a_service_type_that_is_not_built_in_is_a_warning_and_runs() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=20, name: Run, type: Boolean, origin: 0, ros: {{space: 1, call: /c, \
         type: conveyor_interface/ControlConveyor, request: {{id: 12, speed: 50}}, field: control_on}}}}\n"
    );
    let checked = Mapping::from_yaml(&text, "cell.yaml");
    assert_eq!(codes(&checked), [Code::UnknownServiceType]);
    let variable = checked.mapping.unwrap().variables()[0].clone();
    assert_eq!(variable.value_type, Some((BuiltinType::Boolean, false)));
}

#[test]
fn topics_become_variables_by_the_first_pattern_about_them() {
    let text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:my-plant:line}\nvariables:\n  \
         - {node: ns=2;i=101, name: First, origin: 1, ros: {topic: /robot1/joint_states, type: sensor_msgs/JointState}}\n\
         patterns:\n  \
         - topics: /robot*/joint_states\n    exclude: [/robot9/**]\n    origin: 1\n    node: \"ns=2;i=10{1}\"\n    \
         name: Robot{1}Joints\n    type: sensor_msgs/JointState\n    field: position\n  \
         - {topics: /robot*/**, origin: 1, node: \"ns=2;s={1}/{2}\", alias: \"2{1}\", name: \"{2} of {1}\", as: bytes}\n";
    let mapping = sound(text);
    assert_eq!(mapping.patterns().len(), 2);
    let matching = |topic: &str| mapping.matching(SpaceId::ROS1, topic, None);
    let made = matching("/robot2/joint_states").unwrap().unwrap();
    assert_eq!(made.topic, topic("ua_1_2_102"));
    assert_eq!(
        (made.node.to_string(), made.name.as_str()),
        ("ns=2;i=102".to_owned(), "Robot2Joints")
    );
    assert_eq!(
        made.message_type,
        Some("sensor_msgs/JointState".parse().unwrap())
    );
    assert_eq!(made.selection, Selection::Field("position".to_owned()));
    let made = matching("/robot9/joint_states").unwrap().unwrap();
    assert_eq!(
        (made.topic, made.selection),
        (topic("ua_1_2_29"), Selection::Bytes)
    );
    assert_eq!(made.name, "joint_states of 9");
    assert_eq!(matching("/robot1/joint_states"), None, "a variable has it");
    let string = "std_msgs/String".parse().unwrap();
    let of_another_type = mapping.matching(SpaceId::ROS1, "/robot2/joint_states", Some(&string));
    let name = of_another_type.unwrap().unwrap().name;
    assert_eq!(name, "joint_states of 2", "the first pattern is not for it");
    assert_eq!(matching("/rosout"), None);
    assert_eq!(matching("/ua_1_2_102"), None);
    assert_eq!(
        mapping.matching(SpaceId::new(2).unwrap(), "/robot2/joint_states", None),
        None
    );
    let told = |topic: &str| matching(topic).unwrap().unwrap_err().to_string();
    assert_eq!(
        told("/robotX/joint_states"),
        "`/robotX/joint_states` matches the pattern `/robot*/joint_states`, but `ns=2;i=10X` is not a node id"
    );
    assert!(
        told("/robot99999/joint_states")
            .ends_with("`ns=2;i=1099999` is not a number from 1 to 65535")
    );
}

#[test]
fn a_pattern_chooses_fields_as_a_binding_does() {
    let of = |keys: &str| {
        let text = format!(
            "spaces: [{{id: 1}}]\nnamespaces: {{2: urn:my-plant:line}}\npatterns:\n  \
             - {{topics: \"/robot*\", origin: 1, node: \"ns=2;i=10{{1}}\", name: R, {keys}}}\n"
        );
        let made = sound(&text).matching(SpaceId::ROS1, "/robot1", None);
        made.unwrap().unwrap().selection
    };
    let thousandths = Conversion::default().scaled(1000.0, 0.0);
    let fields = "fields: [linear.x, {field: angular.z, scale: 1000}]";
    let wanted = Selection::Fields(vec![
        Selected::whole("linear.x"),
        Selected {
            conversion: thousandths,
            ..Selected::whole("angular.z")
        },
    ]);
    assert_eq!(of(&format!("type: geometry_msgs/Twist, {fields}")), wanted);
    assert_eq!(of(fields), wanted, "also of any type");
    assert_eq!(of("as: structure"), Selection::Structure(None));
    let pose = of("type: geometry_msgs/PoseStamped, field: pose, as: structure");
    assert_eq!(pose, Selection::Structure(Some("pose".to_owned())));
    let converted = Selection::Value {
        field: "data".to_owned(),
        part: None,
        conversion: thousandths.clamped(),
    };
    let keys = "scale: 1000, out_of_range: clamp";
    assert_eq!(of(&format!("field: data, {keys}")), converted);
    let of_one_field = of(&format!("type: std_msgs/Float64, {keys}"));
    assert_eq!(of_one_field, converted, "the one field is meant");
    let inverted = of("type: std_msgs/Bool, invert: true");
    let Selection::Value { conversion, .. } = inverted else {
        panic!("{inverted:?}")
    };
    assert_eq!(conversion, Conversion::default().inverted());
}

#[test]
fn values_of_services_convert_as_those_of_topics() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=20, name: Open, origin: 0, ros: {{space: 1, call: /close, type: std_srvs/SetBool, field: data, \
         invert: true}}}}\n  \
         - {{node: ns=2;i=21, name: Shut, origin: 1, ros: {{answer: ns=2;i=20, field: success, invert: true}}}}\n  \
         - {{node: ns=2;i=22, name: Millimetres, origin: 0, ros: {{space: 1, call: /plan, type: nav_msgs/GetPlan, \
         fields: [start.header.frame_id, {{field: tolerance, scale: 1000, out_of_range: clamp}}], \
         request: {{goal.header.frame_id: map}}}}}}\n  \
         - {{node: ns=2;i=23, name: Resolution, type: Int32, origin: 1, ros: {{poll: /map, type: nav_msgs/GetMap, \
         field: map.info.resolution, scale: 1000, offset: -5, out_of_range: refuse}}}}\n"
    );
    let mapping = sound(&text);
    let role = |at: usize| mapping.variables()[at].service.clone().unwrap().role;
    let inverted = Conversion::default().inverted();
    let ServiceRole::Call { request, .. } = role(0) else {
        panic!("{:?}", role(0))
    };
    let wanted = Selection::Template {
        fields: vec![Selected {
            conversion: inverted,
            ..Selected::whole("data")
        }],
        rest: BTreeMap::new(),
    };
    assert_eq!(request, wanted);
    let ServiceRole::Answer { selection, .. } = role(1) else {
        panic!("{:?}", role(1))
    };
    let wanted = Selection::Value {
        field: "success".to_owned(),
        part: None,
        conversion: inverted,
    };
    assert_eq!(selection, wanted);
    let ServiceRole::Call { request, when, .. } = role(2) else {
        panic!("{:?}", role(2))
    };
    let Selection::Template { fields, rest } = request else {
        panic!("{request:?}")
    };
    assert_eq!((fields.len(), rest.len(), when), (2, 1, Trigger::Any));
    let scaled = Conversion::default().scaled(1000.0, 0.0).clamped();
    assert_eq!(fields[1].conversion, scaled);
    assert_eq!(mapping.variables()[2].fields.len(), 2);
    let ServiceRole::Poll { selection, .. } = role(3) else {
        panic!("{:?}", role(3))
    };
    let wanted = Selection::Value {
        field: "map.info.resolution".to_owned(),
        part: None,
        conversion: Conversion::default()
            .scaled(1000.0, -5.0)
            .to(BuiltinType::Int32),
    };
    assert_eq!(selection, wanted);
    let declared = Some((BuiltinType::Int32, false));
    assert_eq!(mapping.variables()[3].value_type, declared);
}

#[test]
fn a_pattern_does_not_take_the_node_of_a_variable() {
    let text = "spaces: [{id: 1}]\nnamespaces: {2: urn:my-plant:line}\nvariables:\n  \
         - {node: ns=2;i=101, name: First, type: Boolean, origin: 1}\n\
         patterns:\n  - {topics: /robot*, origin: 1, node: \"ns=2;i=10{1}\", name: R}\n";
    let mapping = sound(text);
    let fault = mapping
        .matching(SpaceId::ROS1, "/robot1", None)
        .unwrap()
        .unwrap_err();
    assert!(
        fault
            .to_string()
            .ends_with("`ua_1_2_101` is already `First` of the mapping"),
        "{fault}"
    );
    assert!(
        mapping
            .matching(SpaceId::ROS1, "/robot2", None)
            .unwrap()
            .is_ok()
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
            .map(|n| {
                // A namespace has topics for 65535 variables.
                let (namespace, id) = (2 + n / 50_000, 1 + n % 50_000);
                format!("  - {{node: ns={namespace};i={id}, name: A{n}, origin: 1}}\n")
            })
            .collect();
        let namespaces = "namespaces: {2: 'urn:two', 3: 'urn:three', 4: 'urn:four'}";
        let text = format!("{namespaces}\nspaces: [{{id: 1}}]\nvariables:\n{entries}");
        Mapping::from_yaml(&text, "cell.yaml")
    };
    assert_eq!(
        document(100_000).mapping.unwrap().variables().len(),
        100_000
    );
    assert_eq!(codes(&document(100_001)), [Code::TooLarge]);
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

#[test]
fn the_sizes_of_datagrams_and_messages_are_held_to_what_udp_and_chunks_carry() {
    let checked = |text: &str| Mapping::from_yaml(text, "cell.yaml").mapping;
    let sizes = |text: &str| {
        let pubsub = checked(text).unwrap().pubsub().clone();
        let together = pubsub.messages_per_datagram;
        (pubsub.max_datagram, pubsub.max_message, together)
    };
    assert_eq!(sizes("pubsub: {}\n"), (65_507, 64 << 20, 1));
    assert_eq!(
        sizes("pubsub: {max_datagram: 1472, max_message: 8, messages_per_datagram: 255}\n"),
        (1472, 8 << 20, 255)
    );
    for text in [
        "pubsub: {max_datagram: 511}\n",
        "pubsub: {max_datagram: 65508}\n",
        "pubsub: {max_message: 0}\n",
        "pubsub: {max_message: 1025}\n",
        "pubsub: {messages_per_datagram: 0}\n",
        "pubsub: {messages_per_datagram: 256}\n",
    ] {
        assert!(checked(text).is_none(), "{text}");
    }
}

#[test]
fn a_binding_has_a_thousand_fields_at_most() {
    let with = |count: usize| {
        let fields = "linear.x, ".repeat(count);
        let text = format!(
            "{HEAD}  - {{node: ns=2;i=1, name: A, origin: 1, ros: {{topic: /a, type: geometry_msgs/Twist, fields: [{fields}]}}}}\n"
        );
        let checked = Mapping::from_yaml(&text, "cell.yaml");
        let found = checked.findings.iter();
        found
            .map(|one| (one.code, one.message.clone()))
            .collect::<Vec<_>>()
    };
    let told = |message: &str| vec![(Code::Fields, message.to_owned())];
    assert_eq!(with(1001), told("`fields` has 1001 fields"));
    assert_eq!(with(1000), told("`linear.x` is listed twice"));
}

#[test]
fn one_field_of_a_foreign_publisher_is_named_by_its_place_or_its_name() {
    let field = |said: &str| {
        let entry =
            "{node: ns=2;i=10, name: A, origin: 0, type: Double, ros: {space: 2, topic: /a}";
        let mapping = sound(&format!("{HEAD}  - {entry}{said}}}\n"));
        mapping.variables()[0].ua_field.clone()
    };
    assert_eq!(field(""), None);
    assert_eq!(field(", ua_field: 2"), Some(UaField::Place(2)));
    let name = UaField::Name("Speed".to_owned());
    assert_eq!(field(", ua_field: Speed"), Some(name));
}

#[test]
fn values_come_from_nodes_of_other_servers_and_go_to_some() {
    let text = "
namespaces: {2: 'urn:line'}
spaces: [{id: 1}]
servers:
  - {name: plc, endpoint: 'opc.tcp://192.168.0.10', security: Basic256Sha256, user: cell, password: secret}
  - {name: oven, endpoint: 'opc.tcp://192.168.0.11:4841'}
variables:
  - {node: ns=2;i=1, name: Speed, type: Float, origin: 0, from: {server: plc, node: 'nsu=urn:plc;s=Speed', sampling: 20ms, queue: 50, deadband: 0.5}}
  - {node: ns=2;i=2, name: Setpoint, type: Float, origin: 1, to: {server: oven, node: ns=3;i=7}}
  - {node: ns=2;i=3, name: State, origin: 0, from: {server: oven, node: ns=3;i=8}}
calls:
  - {node: ns=2;i=61, name: Reset, origin: 0, opcua: {server: plc, object: 'nsu=urn:plc;s=Line', method: 'nsu=urn:plc;s=Line.Reset'}}
";
    let checked = Mapping::from_yaml(text, "cell.yaml");
    // The file contains the password in clear.
    let codes: Vec<_> = checked.findings.iter().map(|found| found.code).collect();
    assert_eq!(codes, [Code::Secret], "{}", checked.render(text));
    assert!(
        !checked.render(text).contains("secret,"),
        "{}",
        checked.render(text)
    );
    let mapping = checked.mapping.unwrap();
    let [plc, oven] = mapping.servers() else {
        panic!("{:?}", mapping.servers());
    };
    assert_eq!(
        plc.access.endpoint.to_string(),
        "opc.tcp://192.168.0.10:4840"
    );
    let user = plc.access.user.as_ref().unwrap();
    assert_eq!(
        (user.name.as_str(), user.password.reveal()),
        ("cell", "secret")
    );
    assert!(!format!("{mapping:?}").contains("\"secret\""));
    assert_eq!((oven.name.as_str(), oven.access.security), ("oven", None));
    let [speed, setpoint, state] = mapping.variables() else {
        panic!("{:?}", mapping.variables());
    };
    let from = speed.from.as_deref().unwrap();
    assert_eq!(from.node.to_string(), "nsu=urn:plc;s=Speed");
    let asked = (from.sampling.as_millis(), from.queue.get(), from.deadband());
    assert_eq!(asked, (20, 50, 0.5));
    assert_eq!(setpoint.to.as_deref().unwrap().server, "oven");
    assert_eq!((state.value_type, state.to.is_none()), (None, true));
    let from = state.from.as_deref().unwrap();
    assert_eq!((from.sampling.as_millis(), from.queue.get()), (100, 10));
    let mappings::ExecutedBy::OpcUa(method) = &mapping.calls()[0].executed else {
        panic!("{:?}", mapping.calls());
    };
    assert_eq!(method.access, plc.access);
}
