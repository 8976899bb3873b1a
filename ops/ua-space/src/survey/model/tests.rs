use proptest::prelude::*;

use super::*;

/// A model in the form of Papyrus, and the same model in SysML v2.
const PAPYRUS: &str = include_str!("../../../../../tests/data/sysml/line.uml");
const NOTATION: &str = include_str!("../../../../../tests/data/sysml/line.sysml");

/// Returns the findings as `line: message`.
fn findings(content: &str) -> Vec<String> {
    let findings = parse(content).expect_err("the model has findings");
    findings.iter().map(ToString::to_string).collect()
}

fn model(content: &str) -> NodeModel {
    parse(content).unwrap_or_else(|findings| panic!("{}", report("model", &findings)))
}

#[test]
fn the_same_model_is_read_from_xmi_and_from_textual_notation() {
    let (xmi, text) = (model(PAPYRUS), model(NOTATION));
    assert_eq!(xmi.values, text.values);
    assert_eq!(xmi.calls, text.calls);
    assert_eq!(xmi.spaces, text.spaces);
    assert_eq!(xmi.namespaces, text.namespaces);
}

#[test]
fn a_property_has_its_topics_node_type_and_origin() {
    let model = model(PAPYRUS);
    let named = |name: &str| {
        let found = model.values.iter().find(|value| value.name == name);
        found.unwrap_or_else(|| panic!("no {name} in {:?}", model.values))
    };
    let running = named("Conveyor.running");
    assert_eq!(running.origin, SpaceId::ROS1);
    assert_eq!(running.value, Some((BuiltinType::Boolean, false)));
    let node = running.node.as_ref().map(ToString::to_string);
    assert_eq!(node.as_deref(), Some("nsu=urn:example:line;i=10"));
    let topics = running.topics.iter();
    let topics: Vec<String> = topics
        .map(|one| format!("{} {} {}", one.space, one.topic, one.kind))
        .collect();
    assert_eq!(
        topics,
        [
            "1 /conveyor/running std_msgs/Bool",
            "2 /line/conveyor_running std_msgs/Bool"
        ]
    );
    let speed = named("TurtleBot.speed");
    assert_eq!(
        speed.topics[0].field.as_deref(),
        Some("twist.twist.linear.x")
    );
    assert_eq!(speed.value, Some((BuiltinType::Double, false)));
    assert_eq!(named("Storage.covers").origin, SpaceId::UA);
    assert_eq!(
        named("Storage.heights").value,
        Some((BuiltinType::Double, true))
    );
    assert_eq!(model.calls.len(), 1);
    assert_eq!(model.spaces[&SpaceId::new(2).unwrap()], Some(7));
}

#[test]
fn each_fault_of_a_papyrus_model_is_found_with_its_line() {
    let broken = PAPYRUS
        .replace(
            "type=\"std_msgs/Bool\" publishes",
            "type=\"Bool\" publishes",
        )
        .replace("topic=\"/line/conveyor_running\"", "topik=\"/line\"")
        .replace("twist.twist.linear.x", "twist.twist.linear.q")
        .replace("<UaBridge:Ros1Service", "<UaBridge:Ros1Servise")
        .replace("base_Property=\"_covers\"", "base_Property=\"_gone\"");
    let found = findings(&broken);
    let lines = |text: &str| {
        let at = broken.lines().position(|line| line.contains(text));
        at.map(|at| at + 1).unwrap()
    };
    for (text, message) in [
        ("type=\"Bool\"", "`Bool` is no message type"),
        ("topik=", "Ros2Topic has no `topik`; did you mean `topic`?"),
        ("topik=", "Ros2Topic needs `topic`"),
        (
            "linear.q",
            "has no field `twist.twist.linear.q`; did you mean `twist.twist.linear.",
        ),
        ("Ros1Servise", "did you mean `Ros1Service`?"),
        ("_gone", "the element `_gone` of UaNode is not in the model"),
    ] {
        let start = format!("{}: ", lines(text));
        let is_there = |one: &String| one.starts_with(&start) && one.contains(message);
        assert!(found.iter().any(is_there), "{start}{message} in {found:#?}");
    }
}

#[test]
fn each_fault_of_textual_notation_is_found_with_its_line() {
    for (text, wanted) in [
        ("package A {\n  part def B {\n}\n", "1: this `{` has no `}`"),
        ("package A { }\n}\n", "2: this `}` has no `{`"),
        ("package A {\n  doc /* never", "2: the comment has no end"),
        (
            "part a { @Ros1Topic {\n topic = \"/a; } }",
            "2: the text has no end",
        ),
        (
            "attribute a : Boolean {\n@Ros1Topic {\ntopic = \"/a\"; type = \"std_msgs/Int32\"; } }",
            "3: `a` is a Boolean in the model, and a Int32 in std_msgs/Int32",
        ),
        (
            "attribute a {\n@Ros1Topic { topic = \"/a\";\ntype = \"std_msgs/\" + b; } }",
            "3: the value of `type` is an expression",
        ),
        (
            "@Ros1Topic about a::b { }\n",
            "1: `a::b` is not declared here",
        ),
        (
            "part def A {\n@Ros1Topic { topic = \"/a\"; type = \"a/B\"; } }",
            "2: Ros1Topic applies to a property",
        ),
        (
            "attribute a { @UaNode { node = \"ns=2;i=5\"; } }",
            "1: namespace 2 has no URI",
        ),
        (
            "attribute a { @UaNode { node = \"nsu=urn:a;q=5\"; } }",
            "1: `nsu=urn:a;q=5` is no node id",
        ),
        (
            "attribute a { @Ros2Topic { topic = \"/a\"; type = \"a/B\"; space = 1; } }",
            "1: `space` is `1`; it is a number from 2 to 232",
        ),
        (
            "attribute a { @Ros1Topic { topic = \"/a\"; type = \"a/B\"; } }\nattribute b {\n@Ros1Topic { topic = \"/a\"; type = \"a/B\"; } }",
            "3: `/a` of space 1 is used in line 1 already",
        ),
        (
            "attribute a { @Ros1Topic { topic = \"/a\"; type = \"a/B\"; publishes = true; } @Ros2Topic { topic = \"/a\"; type = \"a/B\"; publishes = true; } }",
            "1: `a` is published by several spaces",
        ),
        ("part a;\n", "1: the model has no topic"),
    ] {
        let found = findings(text);
        assert!(
            found.iter().any(|one| one.starts_with(wanted)),
            "{wanted} in {found:?}"
        );
    }
}

#[test]
fn metadata_is_applied_in_each_notation() {
    let notations = [
        "attribute a : Real { @Ros1Topic { topic = \"/a\"; type = \"std_msgs/Float64\"; } }",
        "attribute a : Real { @UaBridge::Ros1Topic { :>> topic = \"/a\"; attribute redefines type = \"std_msgs/Float64\"; } }",
        "attribute a : Real; metadata Ros1Topic about a { topic = \"/a\"; type = \"std_msgs/Float64\"; }",
        "attribute a : Real; @m : UaBridge::Ros1Topic about a { topic = \"/a\"; type = \"std_msgs/Float64\"; }",
        "doc /* a; { */ out attribute <x> 'a' defined by ScalarValues::Real [1] { // no }\n private @Ros1Topic { topic = \"/a\"; type = \"std_msgs/Float64\"; } }",
    ];
    for text in notations {
        let model = model(text);
        assert_eq!(model.values.len(), 1, "{text}");
        assert_eq!(model.values[0].name, "a", "{text}");
        assert_eq!(model.values[0].value, Some((BuiltinType::Double, false)));
    }
}

#[test]
fn other_files_are_refused_with_the_reason() {
    let refused = |content: &str| findings(content).join("\n");
    assert!(refused("<notation:Diagram/>").contains("ends in `.uml`"));
    assert!(refused("<xmi:XMI></xmi:XMI>").contains("no `uml:Model`"));
    assert!(refused("<!DOCTYPE a [<!ENTITY b \"c\">]><a/>").contains("document type"));
    assert!(refused("<uml:Model xmi:id='a'>").contains("ends in the middle"));
    let deep = format!("<uml:Model xmi:id='a'>{}", "<a>".repeat(1000));
    assert!(refused(&deep).contains("nested deeper"));
    assert!(refused(&"{".repeat(1000)).contains("nested deeper"));
    assert!(refused("").contains("no topic"));
}

proptest! {
    #[test]
    fn no_text_ends_the_program(at in 0..PAPYRUS.len(), cut in 0..40_usize, put in "[<>&\"=a-z;/! ]{0,12}") {
        for content in [PAPYRUS, NOTATION] {
            let start = content.get(..at).unwrap_or(content);
            let end = content.get(at + cut..).unwrap_or("");
            parse(&format!("{start}{put}{end}")).ok();
        }
    }
}

#[test]
fn findings_send_no_commands_to_a_terminal() {
    let finding = Finding::new(1, "the element of Ros1\u{1b}[31m");
    assert_eq!(finding.to_string(), "1: the element of Ros1\\u{1b}[31m");
}
