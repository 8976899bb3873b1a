use std::collections::{BTreeMap, BTreeSet};

use mappings::LiveTopic;

use super::*;

const WISHES: Wishes<'static> = Wishes {
    namespace: "urn:cell",
    transforms: false,
};

/// Returns a graph; the topics are (name, type, published).
fn graph(space: u16, topics: &[(&str, &str, bool)]) -> SurveyedGraph {
    let topic = |(name, kind, published): &(&str, &str, bool)| {
        let live = LiveTopic {
            types: BTreeSet::from([(*kind).to_owned()]),
            published: *published,
            subscribed: !published,
        };
        ((*name).to_owned(), live)
    };
    SurveyedGraph {
        space: SpaceId::new(space).unwrap(),
        domain: (space > 1).then_some(space),
        live: LiveSpace {
            topics: topics.iter().map(topic).collect::<BTreeMap<_, _>>(),
            services: None,
        },
    }
}

fn fresh(graphs: &[SurveyedGraph]) -> String {
    let mut plan = Proposal::new(&[], graphs, &[], &WISHES, &mut OldMapping::default());
    written("", &[], &mut plan).unwrap()
}

fn merged(text: &str, graphs: &[SurveyedGraph]) -> String {
    let mapping = mapping(text);
    let mut known = OldMapping::of(mapping.clone(), text);
    let mut plan = Proposal::new(&[], graphs, &[], &WISHES, &mut known);
    added("", (text, &mapping), &mut plan).unwrap()
}

fn mapping(text: &str) -> Mapping {
    let checked = Mapping::from_yaml(text, "cell.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(text));
    checked.mapping.unwrap()
}

fn origins(text: &str) -> Vec<(String, String, usize)> {
    let mapping = mapping(text);
    let variables = mapping.variables().iter();
    variables
        .map(|one| (one.name.clone(), one.topic.to_string(), one.bindings.len()))
        .collect()
}

#[test]
fn a_side_that_joins_later_is_proposed_once_and_changes_nothing() {
    let ros1 = graph(1, &[("/a/b", "std_msgs/Bool", true)]);
    let ros2 = graph(
        2,
        &[
            ("/a/b", "std_msgs/Bool", false),
            ("/c", "std_msgs/Int32", true),
        ],
    );
    let first = fresh(std::slice::from_ref(&ros1));
    let both = [ros1, ros2];
    let second = merged(&first, &both);
    assert!(
        second.contains("#   /a/b is in space 2 too, as std_msgs/Bool: AB could be bound to it"),
        "{second}"
    );
    assert_eq!(
        origins(&second),
        [
            ("AB".to_owned(), "ua_1_2_1".to_owned(), 1),
            ("C".to_owned(), "ua_2_2_2".to_owned(), 1)
        ]
    );
    assert_eq!(merged(&second, &both), second);
    // Surveyed together, both topics become the same variable.
    assert_eq!(
        origins(&fresh(&both))[0],
        ("AB".to_owned(), "ua_1_2_1".to_owned(), 2)
    );
}

#[test]
fn a_block_is_indented_as_the_entries_before_it() {
    let text = "spaces:\n- {id: 1}\nnamespaces:\n    2: urn:line\nvariables:\n- {node: ns=2;i=5, name: v, origin: 1, \
                type: Double}\n";
    let more = merged(text, &[graph(2, &[("/a", "std_msgs/Bool", true)])]);
    assert!(more.contains("\n- {id: 2, domain: 2}\n"), "{more}");
    assert!(more.contains("\n    3: urn:cell\n"), "{more}");
    assert_eq!(origins(&more).len(), 2);
}

#[test]
fn a_file_that_was_saved_meanwhile_stays_as_it_is() {
    let file = std::env::temp_dir().join(format!("ua-space-init-{}.yaml", std::process::id()));
    let name = file.to_str().unwrap();
    std::fs::write(&file, "theirs\n").unwrap();
    let refused = replace(name, "before\n", "mine\n").unwrap_err();
    assert!(refused.to_string().contains("was changed"), "{refused}");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "theirs\n");
    replace(name, "theirs\n", "mine\n").unwrap();
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine\n");
    assert!(!beside(&file.canonicalize().unwrap()).exists());
    std::fs::remove_file(&file).unwrap();
}

#[test]
fn what_both_sides_publish_is_two_values_and_what_differs_in_type_too() {
    let text = fresh(&[
        graph(
            1,
            &[("/x", "std_msgs/Bool", true), ("/y", "std_msgs/Bool", true)],
        ),
        graph(
            2,
            &[
                ("/x", "std_msgs/Bool", true),
                ("/y", "std_msgs/Int32", false),
            ],
        ),
    ]);
    let all = origins(&text);
    let topics: Vec<&str> = all.iter().map(|(_, topic, _)| topic.as_str()).collect();
    assert_eq!(topics, ["ua_1_2_1", "ua_2_2_2", "ua_1_2_3", "ua_0_2_4"]);
    assert!(all.iter().all(|(.., bindings)| *bindings == 1) && !text.contains("guess:"));
}

#[test]
fn a_topic_that_a_comment_names_or_a_pattern_takes_stays_out() {
    let text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:line\nvariables:\n  # not /a\n  - {node: ns=2;i=5, name: v, \
                origin: 1, ros: {topic: /v, type: std_msgs/Bool}}\npatterns:\n  - {topics: \"/r*/p\", origin: 1, node: \
                \"ns=2;i=10{1}\", name: \"P{1}\"}\n";
    let seen = graph(
        1,
        &[
            ("/a", "std_msgs/Bool", true),
            ("/r1/p", "std_msgs/Bool", true),
            ("/v", "std_msgs/Bool", true),
        ],
    );
    assert_eq!(merged(text, &[seen]), text);
    let more = merged(text, &[graph(1, &[("/next", "std_msgs/Bool", true)])]);
    // The entry has the namespace of the others and the next number, and precedes the next key.
    assert_eq!(origins(&more)[1].1, "ua_1_2_6");
    assert!(more.find("name: Next").unwrap() < more.find("patterns:").unwrap());
}

#[test]
fn what_was_left_out_for_want_of_a_definition_is_proposed_once_it_is_there() {
    let mut seen = graph(1, &[("/a", "other_msgs/Thing", true), ("/u", "*", true)]);
    let service =
        |kind: &str| BTreeMap::from([("/s".to_owned(), BTreeSet::from([kind.to_owned()]))]);
    seen.live.services = Some(service("other_msgs/Do"));
    let without = fresh(std::slice::from_ref(&seen));
    assert!(
        origins(&without).is_empty() && without.contains("#   ros: {topic: /a,"),
        "{without}"
    );
    assert_eq!(merged(&without, std::slice::from_ref(&seen)), without);
    // The same names, with known types.
    let mut typed = graph(
        1,
        &[("/a", "std_msgs/Bool", true), ("/u", "std_msgs/Bool", true)],
    );
    typed.live.services = Some(service("std_srvs/SetBool"));
    let with = merged(&without, std::slice::from_ref(&typed));
    let names: Vec<String> = origins(&with).into_iter().map(|(name, ..)| name).collect();
    assert_eq!(names, ["A", "U"], "{with}");
    assert_eq!(mapping(&with).calls().len(), 1, "{with}");
    assert_eq!(merged(&with, &[typed]), with);
}

#[test]
fn what_calls_have_is_not_given_away_and_their_services_are_not_told_of() {
    let text = "spaces:\n  - {id: 1}\n  - {id: 2}\nnamespaces:\n  2: urn:cell\ncalls:\n  - {node: ns=2;i=61, name: A, origin: \
                1, ros: [{service: /a, type: std_srvs/SetBool}, {space: 2, service: /b, type: std_srvs/SetBool}]}\n";
    let mut seen = graph(2, &[("/a", "std_msgs/Bool", true)]);
    let service = |name: &str| {
        let kind = BTreeSet::from(["std_srvs/SetBool".to_owned()]);
        (name.to_owned(), kind)
    };
    seen.live.services = Some(
        ["/b", "/c", "/n/get_parameters", "/ua_1_2_61"]
            .map(service)
            .into(),
    );
    let more = merged(text, std::slice::from_ref(&seen));
    // The entry follows the number of the call and has another name than the call.
    assert_eq!(
        origins(&more),
        [("A2".to_owned(), "ua_2_2_62".to_owned(), 1)]
    );
    let calls = mapping(&more).calls().to_vec();
    let calls: Vec<(String, String)> = calls
        .iter()
        .map(|call| (call.topic.to_string(), call.name.clone()))
        .collect();
    let one = |topic: &str, name: &str| (topic.to_owned(), name.to_owned());
    assert_eq!(calls, [one("ua_1_2_61", "A"), one("ua_2_2_63", "C")]);
    assert_eq!(merged(&more, &[seen]), more);
}

#[test]
fn what_is_executed_anywhere_becomes_calls_once() {
    let mut ros1 = graph(
        1,
        &[(
            "/count/feedback",
            "actionlib_tutorials/FibonacciActionFeedback",
            true,
        )],
    );
    let kinds = |kinds: &[&str]| kinds.iter().map(|kind| (*kind).to_owned()).collect();
    ros1.live.services = Some(
        [
            ("/belt/switch", kinds(&["std_srvs/SetBool"])),
            ("/belt/odd", kinds(&["odd_msgs/Odd"])),
            ("/belt/mute", kinds(&[])),
            (
                "/belt/set_parameters",
                kinds(&["dynamic_reconfigure/Reconfigure"]),
            ),
            ("/ua_1_2_9", kinds(&["std_srvs/SetBool"])),
        ]
        .map(|(name, kinds)| (name.to_owned(), kinds))
        .into(),
    );
    let feedback = "/nav/count/_action/feedback";
    let kind = "example_interfaces/Fibonacci_FeedbackMessage";
    let ros2 = graph(2, &[(feedback, kind, true)]);
    let server = |url: &str| SurveyedNodes {
        place: url.to_owned(),
        server: Some(survey::UaServer {
            endpoint: url.to_owned(),
            name: "Press 7 (left)".to_owned(),
            is_cell: false,
        }),
        namespaces: ["http://opcfoundation.org/UA/", "urn:s", "urn:plc"]
            .map(str::to_owned)
            .to_vec(),
        variables: Vec::new(),
        methods: vec![survey::UaMethod {
            object: "ns=2;s=Line".parse().unwrap(),
            method: format!("ns=2;s=Reset of {url}").parse().unwrap(),
            name: "Reset".to_owned(),
            within: "Line".to_owned(),
        }],
    };
    let graphs = [ros1, ros2];
    let servers = ["opc.tcp://127.0.0.1:4840", "opc.tcp://plc:4840"].map(server);
    let mut plan = Proposal::new(&[], &graphs, &servers, &WISHES, &mut OldMapping::default());
    let text = written("", &[], &mut plan).unwrap();
    let found = mapping(&text);
    let calls: Vec<(String, &str)> = found
        .calls()
        .iter()
        .map(|call| (call.topic.to_string(), call.name.as_str()))
        .collect();
    let one = |topic: &str, name: &'static str| (topic.to_owned(), name);
    // An action uses five numbers, a comment the number it names.
    assert_eq!(
        calls,
        [
            one("ua_1_2_2", "Belt.Switch"),
            one("ua_1_2_3", "Count"),
            one("ua_2_2_8", "Nav.Count"),
            one("ua_0_2_13", "Line.Reset"),
            one("ua_0_2_14", "Line.Reset2"),
        ],
        "{text}"
    );
    for told in [
        "  # M075: no definition of the service type `odd_msgs/Odd` is built in",
        "  #   ros: {service: /belt/odd, type: odd_msgs/Odd}",
        "  #   /belt/mute",
        "    opcua: {server: press-7-left-2, object: nsu=urn:plc;s=Line, ",
        // The server of the cell has an endpoint of its own.
        "server:\n  endpoint: opc.tcp://127.0.0.1:4841\n",
    ] {
        assert!(text.contains(told), "{told}\n{text}");
    }
    let sum = Sum::of("x", &plan, true).counts();
    assert!(sum.contains("5 calls, 1 other as comments"), "{sum}");
    let mut known = OldMapping::of(found.clone(), &text);
    let mut plan = Proposal::new(&[], &graphs, &servers, &WISHES, &mut known);
    assert_eq!(added("", (&text, &found), &mut plan).unwrap(), text);
}

#[test]
fn calls_that_stand_before_the_variables_keep_both_apart() {
    let text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:cell\ncalls:\n  - {node: ns=2;i=61, name: A, origin: 1, ros: \
                {service: /a, type: std_srvs/SetBool}}\nvariables:\n  - {node: ns=2;i=5, name: v, origin: 1, type: Double}\n";
    let mut seen = graph(
        1,
        &[
            ("/odd", "odd_msgs/Odd", true),
            ("/b", "std_msgs/Bool", true),
        ],
    );
    let service = |name: &str, kind: &str| (name.to_owned(), BTreeSet::from([kind.to_owned()]));
    seen.live.services = Some(
        [
            service("/c", "odd_msgs/Odd"),
            service("/d", "std_srvs/Trigger"),
        ]
        .into(),
    );
    let more = merged(text, &[seen]);
    let found = mapping(&more);
    assert_eq!(
        (found.calls().len(), found.variables().len()),
        (2, 2),
        "{more}"
    );
    assert!(
        more.contains("\n  # M075: ") && more.contains("\n  # M063: "),
        "{more}"
    );
}

/// Returns a server with a numeric node id, a string node id, and a node named like a topic.
fn plc(url: &str, is_cell: bool) -> SurveyedNodes {
    let variable = |node: &str, name: &str| survey::UaVariable {
        node: node.parse().unwrap(),
        name: name.to_owned(),
        within: "Line".to_owned(),
        source: None,
        value: Some((uadp::BuiltinType::Boolean, false)),
    };
    SurveyedNodes {
        place: url.to_owned(),
        server: Some(survey::UaServer {
            endpoint: url.to_owned(),
            name: "PLC".to_owned(),
            is_cell,
        }),
        namespaces: ["http://opcfoundation.org/UA/", "urn:own", "urn:plc"]
            .map(str::to_owned)
            .to_vec(),
        variables: vec![
            variable("ns=1;i=5", "Door"),
            variable("ns=2;s=Line.Lamp", "Lamp"),
            variable("ns=2;i=7", "Belt"),
        ],
        methods: Vec::new(),
    }
}

fn of_servers(
    servers: &[SurveyedNodes],
    graphs: &[SurveyedGraph],
    known: &mut OldMapping,
) -> Proposal {
    Proposal::new(&[], graphs, servers, &WISHES, known)
}

#[test]
fn a_server_of_another_is_a_source_and_not_the_cells_own() {
    let graphs = [graph(1, &[("/line/lamp", "std_msgs/Bool", true)])];
    let servers = [plc("opc.tcp://192.168.0.5:4840", false)];
    let mut plan = of_servers(&servers, &graphs, &mut OldMapping::default());
    let text = written("", &[], &mut plan).unwrap();
    let found = mapping(&text);
    assert!(!text.contains("\nserver:"), "{text}");
    let only = &found.servers()[0];
    assert_eq!(only.name, "plc");
    assert_eq!(
        only.access.endpoint.to_string(),
        "opc.tcp://192.168.0.5:4840"
    );
    let ends = |name: &str| {
        let one = found.variables().iter().find(|one| one.name == name);
        let one = one.unwrap();
        let from = one.from.as_ref().map(|from| from.node.to_string());
        (
            one.node.to_string(),
            from,
            one.to.as_ref().map(|to| to.node.to_string()),
        )
    };
    let text_of = |text: &str| Some(text.to_owned());
    // Index 1 is the own namespace of each server.
    assert_eq!(
        ends("Door"),
        ("ns=2;i=5".to_owned(), text_of("nsu=urn:own;i=5"), None)
    );
    assert_eq!(
        ends("Belt"),
        ("ns=3;i=7".to_owned(), text_of("nsu=urn:plc;i=7"), None)
    );
    // A value that ROS produces is written to the server.
    assert_eq!(
        ends("Lamp"),
        (
            "ns=3;s=Line.Lamp".to_owned(),
            None,
            text_of("nsu=urn:plc;s=Line.Lamp")
        )
    );
    let mut known = OldMapping::of(found.clone(), &text);
    let mut plan = of_servers(&servers, &graphs, &mut known);
    assert_eq!(added("", (&text, &found), &mut plan).unwrap(), text);
}

#[test]
fn servers_of_one_make_are_told_apart_also_when_one_is_added_later() {
    let url = |last: u8| format!("opc.tcp://192.168.0.{last}:4840");
    let all = [plc(&url(5), false), plc(&url(6), false)];
    let sources = |text: &str| -> BTreeSet<(String, String)> {
        let found = mapping(text);
        let from = found.variables().iter().filter_map(|one| one.from.clone());
        from.map(|from| (from.server, from.node.to_string()))
            .collect()
    };
    let mut plan = of_servers(&all, &[], &mut OldMapping::default());
    let both = written("", &[], &mut plan).unwrap();
    assert_eq!(sources(&both).len(), 6, "{both}");
    let mut plan = of_servers(&all[..1], &[], &mut OldMapping::default());
    let first = written("", &[], &mut plan).unwrap();
    let found = mapping(&first);
    let mut known = OldMapping::of(found.clone(), &first);
    let mut plan = of_servers(&all, &[], &mut known);
    let later = added("", (&first, &found), &mut plan).unwrap();
    assert_eq!(sources(&later), sources(&both), "{later}");
    // A third run adds nothing.
    let found = mapping(&later);
    let mut known = OldMapping::of(found.clone(), &later);
    let mut plan = of_servers(&all, &[], &mut known);
    assert_eq!(added("", (&later, &found), &mut plan).unwrap(), later);
}

#[test]
fn the_cells_own_server_stays_the_cells_own() {
    let servers = [plc("opc.tcp://192.168.0.5:4842", true)];
    let mut plan = of_servers(&servers, &[], &mut OldMapping::default());
    let text = written("", &[], &mut plan).unwrap();
    assert!(
        text.contains("server:\n  endpoint: opc.tcp://192.168.0.5:4842\n"),
        "{text}"
    );
    assert!(
        mapping(&text).servers().is_empty() && !text.contains("from:"),
        "{text}"
    );
}

#[test]
fn a_command_of_motion_is_proposed_with_what_ends_it() {
    let robot = graph(
        2,
        &[
            ("/cmd_vel", "geometry_msgs/Twist", false),
            ("/arm", "trajectory_msgs/JointTrajectory", false),
            ("/speed", "geometry_msgs/Twist", true),
        ],
    );
    let mut plan = Proposal::new(&[], &[robot], &[], &WISHES, &mut OldMapping::default());
    let text = written("", &[], &mut plan).unwrap();
    assert_eq!(text.matches("  on_loss: zero\n").count(), 1, "{text}");
    let of_arm = text.split("name: Arm").nth(1).unwrap();
    assert!(of_arm.contains("# on_loss: zero is a movement of this type"));
    let checked = Mapping::from_yaml(&text, "cell.yaml");
    let codes: Vec<_> = checked.findings.iter().map(|found| found.code).collect();
    assert_eq!(codes, [Code::EndlessMotion], "{}", checked.render(&text));
}

fn of_model(text: &str, model: &NodeModel, graphs: &[SurveyedGraph]) -> String {
    let models = std::slice::from_ref(model);
    if text.is_empty() {
        let mut plan = Proposal::new(models, graphs, &[], &WISHES, &mut OldMapping::default());
        return written("", &[], &mut plan).unwrap();
    }
    let mapping = mapping(text);
    let mut known = OldMapping::of(mapping.clone(), text);
    let mut plan = Proposal::new(models, graphs, &[], &WISHES, &mut known);
    added("", (text, &mapping), &mut plan).unwrap()
}

#[test]
fn a_model_becomes_a_mapping_that_runs_and_is_merged_once() {
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/data/sysml/line.uml"
    );
    let model = survey::model::survey(file).unwrap();
    // The topic of the model is live too, with another topic.
    let live = [graph(
        1,
        &[
            ("/conveyor/running", "std_msgs/Bool", true),
            ("/other", "std_msgs/Bool", true),
        ],
    )];
    let text = of_model("", &model, &live);
    let mut all = origins(&text);
    all.sort();
    let expected = [
        ("Conveyor.running", "ua_1_2_10", 2),
        ("Other", "ua_1_3_3", 1),
        ("Storage.covers", "ua_0_2_12", 0),
        ("Storage.heights", "ua_0_2_13", 0),
        ("TurtleBot.speed", "ua_2_3_1", 1),
        ("TurtleBot.velocity", "ua_0_3_2", 1),
    ];
    let expected = expected.map(|(name, topic, count)| (name.to_owned(), topic.to_owned(), count));
    assert_eq!(all, expected, "{text}");
    let mapping = mapping(&text);
    assert_eq!(mapping.calls().len(), 1, "{text}");
    let domain = mapping.domain_of(SpaceId::new(2).unwrap());
    assert_eq!(domain, Some(7), "{text}");
    assert!(text.contains("field: twist.twist.linear.x"), "{text}");
    assert!(text.contains("on_loss: zero"), "{text}");
    assert!(!text.contains("guess:"), "{text}");
    assert_eq!(of_model(&text, &model, &live), text);
}

#[test]
fn a_topic_of_a_model_that_the_mapping_lacks_is_proposed_and_not_bound() {
    let text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:example:line\nvariables:\n  - {node: ns=2;i=10, name: running, \
                origin: 1, ros: {topic: /conveyor/running, type: std_msgs/Bool}}\n";
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/data/sysml/line.uml"
    );
    let model = survey::model::survey(file).unwrap();
    let more = of_model(text, &model, &[]);
    assert!(
        more.contains("/line/conveyor_running is a topic of Conveyor.running in the model"),
        "{more}"
    );
    assert_eq!(origins(&more).len(), 5, "{more}");
}
