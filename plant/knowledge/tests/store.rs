//! Storage of the statements of sources, and the results of questions on them.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::collections::BTreeMap;

use knowledge::{
    ComponentFacts, Knowledge, KnowledgeFault, KnowledgeSource, NodeName, OPC_UA, ParameterFacts,
    QUESTIONS, QuestionAnswer, SkillFacts, SourceKind, TypeFacts, nodeset,
};
use test_data::{read_foreign, read_own};

pub(super) fn node(namespace: &str, identifier: &str) -> NodeName {
    NodeName {
        namespace: namespace.into(),
        identifier: identifier.into(),
    }
}

pub(super) fn of_type(namespace: &str, identifier: &str, browse_name: &str) -> TypeFacts {
    TypeFacts {
        node: node(namespace, identifier),
        browse_name: browse_name.into(),
    }
}

const OURS: &str = "urn:ua-bridge:skills";

pub(super) fn skill_type() -> TypeFacts {
    of_type(OURS, "i=1000", "SkillType")
}

pub(super) fn grasp_type() -> TypeFacts {
    of_type(OURS, "i=1200", "GraspSkillType")
}

/// Returns a gripper whose Grasp is of these types, most special first.
pub(super) fn gripper(uri: &str, types: Vec<TypeFacts>, capability: &str) -> ComponentFacts {
    ComponentFacts {
        application_uri: uri.into(),
        name: uri.rsplit(':').next().unwrap().into(),
        endpoint: "opc.tcp://127.0.0.1:4855".into(),
        namespace: Some(7),
        skills: vec![SkillFacts {
            name: "Grasp".into(),
            number: Some(1),
            node: node(uri, "i=100"),
            types,
            capabilities: vec![capability.into()],
            parameters: vec![
                ParameterFacts {
                    name: "Force".into(),
                    data_type: "Double".into(),
                    default: Some("20.0".into()),
                    min: Some(0.0),
                    max: Some(85.0),
                    unit: Some("N".into()),
                    node: Some(node(uri, "i=10001")),
                    ..ParameterFacts::default()
                },
                ParameterFacts {
                    name: "Gripped".into(),
                    is_output: true,
                    data_type: "Boolean".into(),
                    ..ParameterFacts::default()
                },
            ],
        }],
    }
}

fn put(knowledge: &Knowledge, facts: &ComponentFacts, at: u64) -> KnowledgeSource {
    let source = KnowledgeSource::new(SourceKind::Component, &facts.application_uri);
    let (triples, left_out) = facts.triples();
    assert_eq!(left_out, Vec::<String>::new());
    knowledge.replace(&source, &triples, at).unwrap();
    source
}

pub(super) fn ask(
    knowledge: &Knowledge,
    question: &str,
    parameters: &[(&str, &str)],
) -> QuestionAnswer {
    let parameters: Vec<_> = parameters
        .iter()
        .map(|(key, value)| ((*key).to_owned(), (*value).to_owned()))
        .collect();
    knowledge.ask(question, &parameters).unwrap()
}

pub(super) fn column(answer: &QuestionAnswer, column: &str) -> Vec<String> {
    answer
        .rows
        .iter()
        .map(|row| {
            row[column]
                .as_str()
                .map_or_else(|| row[column].to_string(), str::to_owned)
        })
        .collect()
}

pub(super) const GRASP: &str = "urn:example:capability:grasp";
const HOLD: &str = "urn:example:capability:hold-by-vacuum";

#[test]
fn a_component_is_found_by_what_it_can_do_until_it_is_gone() {
    let knowledge = Knowledge::new().unwrap();
    let facts = gripper(
        "urn:example:gripper",
        vec![grasp_type(), skill_type()],
        GRASP,
    );
    let source = put(&knowledge, &facts, 5);
    let found = ask(&knowledge, "what-can-run", &[("capability", GRASP)]);
    assert_eq!(found.rows.len(), 1, "{found:?}");
    let row = serde_json::to_value(&found.rows[0]).unwrap();
    let expected = serde_json::json!({
        "kind": "skill", "component": "gripper", "name": "Grasp", "type": "GraspSkillType", "capabilities": [GRASP],
        "parameters": ["Force: Double [0..85] N"], "endpoint": "opc.tcp://127.0.0.1:4855",
        "node": "nsu=urn:example:gripper;i=100", "iri": "urn:example:gripper#i=100",
    });
    assert_eq!(row, expected);
    assert!(
        ask(
            &knowledge,
            "what-can-run",
            &[("capability", "urn:example:capability:fly")]
        )
        .rows
        .is_empty()
    );
    assert!(knowledge.remove(&source).unwrap());
    assert!(!knowledge.remove(&source).unwrap());
    for question in QUESTIONS {
        assert_eq!(
            ask(&knowledge, question.name, &[]).rows,
            Vec::new(),
            "{}",
            question.name
        );
    }
}

#[test]
fn a_quantity_is_held_by_skills_whose_limits_contain_it_in_any_unit() {
    let knowledge = Knowledge::new().unwrap();
    let units = KnowledgeSource::new(SourceKind::File, "units");
    knowledge
        .replace(&units, &knowledge::units::triples(), 1)
        .unwrap();
    let facts = gripper(
        "urn:example:gripper",
        vec![grasp_type(), skill_type()],
        GRASP,
    );
    put(&knowledge, &facts, 5);
    let held = |quantity: &str, capability: &str| {
        let parameters = match capability {
            "" => vec![("quantity", quantity)],
            _ => vec![("quantity", quantity), ("capability", capability)],
        };
        let found = ask(&knowledge, "what-can-hold", &parameters);
        let limit = |row: &BTreeMap<String, serde_json::Value>| {
            (
                QuestionAnswer::text(row, "limit").to_owned(),
                row["value"].as_f64(),
            )
        };
        found.rows.iter().map(limit).collect::<Vec<_>>()
    };
    let force = ("Force".to_owned(), Some(50.0));
    assert_eq!(held("0.05 kN", ""), std::slice::from_ref(&force));
    assert_eq!(held("50 N", GRASP), [force]);
    for (quantity, capability) in [
        ("86 N", ""),
        ("3 kg", ""),
        ("50", ""),
        ("x N", ""),
        ("50 N", "urn:fly"),
    ] {
        assert_eq!(held(quantity, capability), [], "{quantity}");
    }
    // The data sheet of the component as Turtle.
    let sheet = KnowledgeSource::new(SourceKind::File, "sheet.ttl");
    let turtle = r#"<urn:example:gripper> <urn:ua-bridge:plant#hasLimit> [
        <http://www.w3id.org/hsu-aut/cask#hasVariableName> "Payload" ;
        <urn:ua-bridge:plant#max> 5000 ; <urn:ua-bridge:plant#unit> "g" ] ."#;
    knowledge.replace_turtle(&sheet, turtle, 1).unwrap();
    assert_eq!(held("3 kg", GRASP), [("Payload".to_owned(), Some(3000.0))]);
    assert_eq!(held("6 kg", GRASP), []);
    let found = ask(&knowledge, "what-can-hold", &[("quantity", "3 kg")]);
    assert_eq!(found.rows[0]["source"], sheet.graph());
    assert_eq!(ask(&knowledge, "what-can-hold", &[]).rows.len(), 2);
    // A limit that is no number holds nothing.
    let text = turtle.replace("5000", "\"5000\"");
    knowledge.replace_turtle(&sheet, &text, 1).unwrap();
    assert_eq!(held("3 kg", GRASP), []);
}

#[test]
fn every_question_parses_and_tells_its_parameters() {
    let knowledge = Knowledge::new().unwrap();
    for question in QUESTIONS {
        assert!(!question.about().is_empty(), "{}", question.name);
        assert!(
            question.sparql.starts_with("#: about "),
            "{}",
            question.name
        );
        for parameter in question.parameters() {
            assert!(
                question
                    .sparql
                    .contains(&format!("VALUES ?for_{parameter} {{ UNDEF }}")),
                "{} {parameter}",
                question.name
            );
            ask(&knowledge, question.name, &[(parameter, "urn:x")]);
        }
        let answer = ask(&knowledge, question.name, &[]);
        for list in question.lists() {
            assert!(
                answer.columns.iter().any(|column| column == list),
                "{} {list}",
                question.name
            );
        }
    }
}

#[test]
fn a_parameter_cannot_say_more_than_a_value() {
    let knowledge = Knowledge::new().unwrap();
    let with = |name: &str, question: &str, value: &str| {
        knowledge.ask(question, &[(name.to_owned(), value.to_owned())])
    };
    let no_iri = with(
        "capability",
        "what-can-run",
        "urn:x> } ?a ?b ?c . VALUES ?d { <urn:y",
    )
    .unwrap_err()
    .to_string();
    assert!(no_iri.contains("`capability` is to be an IRI"), "{no_iri}");
    assert!(
        with("name", "where-is", "\" } ?a ?b ?c \\")
            .unwrap()
            .rows
            .is_empty()
    );
    let unknown = with("colour", "where-is", "red").unwrap_err().to_string();
    assert_eq!(unknown, "`where-is` has no parameter `colour`; it has name");
    assert!(
        knowledge
            .ask("what-is-love", &[])
            .unwrap_err()
            .to_string()
            .contains("what-can-run")
    );
}

#[test]
fn a_skill_of_a_type_never_seen_is_found_by_its_supertype() {
    let knowledge = Knowledge::new().unwrap();
    let vendor = of_type("urn:example:vendor", "i=3001", "VacuumGraspType");
    put(
        &knowledge,
        &gripper(
            "urn:example:vacuum",
            vec![vendor, grasp_type(), skill_type()],
            HOLD,
        ),
        5,
    );
    put(
        &knowledge,
        &gripper("urn:example:other", vec![skill_type()], HOLD),
        5,
    );
    let found = ask(
        &knowledge,
        "skills",
        &[("type", "urn:ua-bridge:skills#i=1200")],
    );
    assert_eq!(column(&found, "component"), ["vacuum"]);
    assert_eq!(
        found.rows[0]["supertypes"],
        serde_json::json!(["GraspSkillType", "SkillType"])
    );
    assert_eq!(
        ask(
            &knowledge,
            "skills",
            &[("type", "urn:ua-bridge:skills#i=1000")]
        )
        .rows
        .len(),
        2
    );
}

#[test]
fn a_capability_is_provided_by_who_has_a_subclass_of_it() {
    let knowledge = Knowledge::new().unwrap();
    put(
        &knowledge,
        &gripper("urn:example:vacuum", vec![grasp_type()], HOLD),
        5,
    );
    assert!(
        ask(&knowledge, "who-provides", &[("capability", GRASP)])
            .rows
            .is_empty()
    );
    let ontology = KnowledgeSource::new(SourceKind::File, "capabilities.ttl");
    let turtle = format!(
        "@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> . <{HOLD}> rdfs:subClassOf <urn:example:capability:hold> . <urn:example:capability:hold> rdfs:subClassOf <{GRASP}> ."
    );
    knowledge.replace_turtle(&ontology, &turtle, 6).unwrap();
    let found = ask(&knowledge, "who-provides", &[("capability", GRASP)]);
    assert!(
        found.rows.is_empty(),
        "a class is a capability when it is said to be: {found:?}"
    );
    let turtle = format!(
        "{turtle} <{GRASP}> rdfs:subClassOf <http://www.w3id.org/hsu-aut/css#Capability> ."
    );
    knowledge.replace_turtle(&ontology, &turtle, 7).unwrap();
    let found = ask(&knowledge, "who-provides", &[("capability", GRASP)]);
    assert_eq!(column(&found, "component_name"), ["vacuum"]);
    assert_eq!(column(&found, "by"), ["subclass"]);
    knowledge.remove(&ontology).unwrap();
    assert!(
        ask(&knowledge, "who-provides", &[("capability", GRASP)])
            .rows
            .is_empty()
    );
}

#[test]
fn what_two_sources_say_is_there_once_and_stays_when_one_goes() {
    let knowledge = Knowledge::new().unwrap();
    let one = put(
        &knowledge,
        &gripper("urn:example:one", vec![grasp_type(), skill_type()], GRASP),
        5,
    );
    put(
        &knowledge,
        &gripper("urn:example:two", vec![grasp_type(), skill_type()], GRASP),
        5,
    );
    let subtypes = || {
        ask(
            &knowledge,
            "types",
            &[("type", "urn:ua-bridge:skills#i=1000")],
        )
    };
    assert_eq!(column(&subtypes(), "name"), ["GraspSkillType"]);
    knowledge.remove(&one).unwrap();
    assert_eq!(column(&subtypes(), "name"), ["GraspSkillType"]);
    assert_eq!(column(&ask(&knowledge, "components", &[]), "name"), ["two"]);
}

#[test]
fn replacing_leaves_nothing_of_before_and_keeps_since_when() {
    let knowledge = Knowledge::new().unwrap();
    let mut facts = gripper("urn:example:gripper", vec![grasp_type()], GRASP);
    let source = put(&knowledge, &facts, 5);
    facts.skills[0].name = "Grab".into();
    facts.skills[0].parameters.clear();
    put(&knowledge, &facts, 9);
    assert_eq!(column(&ask(&knowledge, "skills", &[]), "name"), ["Grab"]);
    assert!(ask(&knowledge, "parameters", &[]).rows.is_empty());
    let status = knowledge
        .sources()
        .into_iter()
        .find(|status| status.kind == SourceKind::Component)
        .unwrap();
    assert_eq!(
        (status.since_ms, status.graph),
        (
            5,
            "urn:ua-bridge:graph:component:urn%3Aexample%3Agripper".to_owned()
        )
    );
    knowledge.remove(&source).unwrap();
    put(&knowledge, &facts, 12);
    assert!(
        knowledge
            .sources()
            .iter()
            .any(|status| status.since_ms == 12)
    );
}

#[test]
fn what_cannot_be_taken_leaves_what_was() {
    let knowledge = Knowledge::new().unwrap();
    put(
        &knowledge,
        &gripper("urn:example:gripper", vec![grasp_type()], GRASP),
        5,
    );
    let before = knowledge.sources();
    let source = KnowledgeSource::new(SourceKind::Component, "urn:example:gripper");
    let bad = mtp::Triple {
        subject: "no iri".into(),
        predicate: "urn:p".into(),
        object: mtp::Object::Boolean(true),
    };
    let fault = knowledge.replace(&source, &[bad], 6).unwrap_err();
    assert!(
        matches!(&fault, KnowledgeFault::Iri { text, .. } if text == "no iri"),
        "{fault}"
    );
    let fault = knowledge
        .replace_turtle(&source, "<urn:a> <urn:b> .", 6)
        .unwrap_err();
    assert!(matches!(fault, KnowledgeFault::Turtle(_)), "{fault}");
    let derived = KnowledgeSource::new(SourceKind::Derived, "");
    assert!(matches!(
        knowledge.replace(&derived, &[], 6),
        Err(KnowledgeFault::Derived)
    ));
    assert_eq!(knowledge.sources(), before);
}

#[test]
fn names_from_the_network_cannot_say_more_than_a_name() {
    let knowledge = Knowledge::new().unwrap();
    let mut facts = gripper(
        "no iri <at> \"all\"",
        vec![of_type("a#b", "s=x y#z", "Ty\"pe")],
        GRASP,
    );
    facts.skills[0].capabilities.push("not an iri".into());
    facts.skills[0].name = "Gr\"asp\n> .".into();
    let (triples, left_out) = facts.triples();
    assert_eq!(left_out, ["not an iri"]);
    knowledge
        .replace(
            &KnowledgeSource::new(SourceKind::Component, &facts.application_uri),
            &triples,
            5,
        )
        .unwrap();
    let found = ask(&knowledge, "skills", &[]);
    assert_eq!(column(&found, "name"), ["Gr\"asp\n> ."]);
    let type_iri = &ask(&knowledge, "types", &[]);
    assert!(type_iri.rows.is_empty());
    assert_eq!(
        node("a#b", "s=x y#z").iri(),
        "urn:ua-bridge:node:a%23b#s=x%20y%23z"
    );
}

#[test]
fn node_ids_are_read_back_as_they_were_written() {
    for name in [node("urn:a;b%", "s=x;y"), node(OPC_UA, "i=2391")] {
        assert_eq!(NodeName::parse(&name.id()), Some(name));
    }
    assert_eq!(NodeName::parse("i=2391"), Some(node(OPC_UA, "i=2391")));
    assert_eq!(NodeName::parse("nsu=urn:a"), None);
    assert_eq!(NodeName::parse("Objects"), None);
}

#[test]
fn a_manifest_stands_beside_skills_in_one_question() {
    let knowledge = Knowledge::new().unwrap();
    put(
        &knowledge,
        &gripper("urn:example:gripper", vec![grasp_type()], GRASP),
        5,
    );
    let module = mtp::Module::read(&read_own("mtp/stage.aml")).unwrap();
    for name in ["one", "two"] {
        let triples = module.triples(&format!("urn:ua-bridge:mtp:{name}"), &BTreeMap::new());
        knowledge
            .replace(&KnowledgeSource::new(SourceKind::Mtp, name), &triples, 5)
            .unwrap();
    }
    let found = ask(&knowledge, "what-can-run", &[]);
    let kinds = column(&found, "kind");
    assert_eq!(
        kinds.iter().filter(|kind| *kind == "service").count(),
        12,
        "six procedures of each module: {found:?}"
    );
    assert_eq!(kinds.iter().filter(|kind| *kind == "skill").count(), 1);
    let commands = ask(&knowledge, "commands", &[]);
    assert_eq!(commands.rows.len(), 120);
    assert_eq!(ask(&knowledge, "components", &[]).rows.len(), 3);
}

#[test]
fn types_below_a_type_are_found_over_two_node_sets_in_any_order() {
    let knowledge = Knowledge::new().unwrap();
    for file in ["machines.xml", "devices.xml"] {
        let read = nodeset::read(&read_own(&format!("nodesets/{file}"))).unwrap();
        let source = KnowledgeSource::new(SourceKind::NodeSet, &read.model.namespace);
        knowledge.replace(&source, &read.triples, 5).unwrap();
    }
    let below = |id: &str| {
        let found = ask(&knowledge, "types", &[("type", id)]);
        column(&found, "name")
    };
    let devices = below("urn:ua-bridge:test:devices#i=1001");
    for name in ["TestDeviceType", "TestPressType", "TestServoPressType"] {
        assert!(devices.contains(&name.to_owned()), "{name}: {devices:?}");
    }
    assert!(!devices.contains(&"DeviceFaultEventType".to_owned()));
    let presses = below("urn:ua-bridge:test:machines#i=1001");
    assert!(presses.contains(&"TestServoPressType".to_owned()));
    assert!(!presses.contains(&"TestDeviceType".to_owned()));
}

#[test]
fn the_node_sets_of_the_domains_are_sources_of_their_own() {
    let knowledge = Knowledge::new().unwrap();
    let domains = [
        include_str!("../../../examples/plant/nodesets/UaBridge.Device.NodeSet2.xml"),
        include_str!("../../../examples/plant/nodesets/UaBridge.Gripper.NodeSet2.xml"),
        include_str!("../../../examples/plant/nodesets/UaBridge.ToolChanger.NodeSet2.xml"),
    ];
    for text in domains {
        let read = nodeset::read(text).unwrap();
        let source = KnowledgeSource::new(SourceKind::NodeSet, &read.model.namespace);
        knowledge.replace(&source, &read.triples, 5).unwrap();
    }
    let found = ask(
        &knowledge,
        "types",
        &[("type", "urn:ua-bridge:skills#i=1000")],
    );
    let names = column(&found, "name");
    for name in ["GraspSkillType", "ChangeToolSkillType"] {
        assert!(names.contains(&name.to_owned()), "{name}: {names:?}");
    }
}

#[test]
fn a_node_set_tells_types_below_a_type_and_what_they_declare() {
    let knowledge = Knowledge::new().unwrap();
    let load = |file: &str| {
        let text = read_foreign(&format!("nodesets/{file}"))?;
        let read = nodeset::read(&text).unwrap();
        knowledge
            .replace(
                &KnowledgeSource::new(SourceKind::NodeSet, &read.model.namespace),
                &read.triples,
                5,
            )
            .unwrap();
        Some(())
    };
    if load("Opc.Ua.NodeSet2.xml").is_none() {
        return;
    }
    // BaseEventType, with the number of subtypes as counted by another library.
    let events = ask(
        &knowledge,
        "types",
        &[("type", "http://opcfoundation.org/UA/#i=2041")],
    );
    assert_eq!(events.rows.len(), 96);
    assert!(column(&events, "name").contains(&"ProgramTransitionEventType".to_owned()));
    load("Opc.Ua.Di.NodeSet2.xml").unwrap();
    load("Opc.Ua.Robotics.NodeSet2.xml").unwrap();
    let devices = ask(
        &knowledge,
        "types",
        &[("type", "http://opcfoundation.org/UA/DI/#i=15063")],
    );
    assert!(
        column(&devices, "name").contains(&"MotionDeviceType".to_owned()),
        "{devices:?}"
    );
}

#[test]
fn half_a_node_set_is_refused_with_its_line() {
    let text =
        "<UANodeSet>\n<Models><Model ModelUri=\"urn:x\"/></Models>\n<UAObjectType NodeId=\"i=1\"";
    let fault = nodeset::read(text).unwrap_err();
    assert!(
        matches!(fault, nodeset::NodeSetReadFault::Xml { line: 3, .. }),
        "{fault}"
    );
    let fault = nodeset::read("<UANodeSet>\n<Models>").unwrap_err();
    assert_eq!(fault.to_string(), "line 2: the file ends in the middle");
    assert_eq!(
        nodeset::read("<UANodeSet/>"),
        Err(nodeset::NodeSetReadFault::NoModel)
    );
}

#[test]
fn names_with_a_colon_are_no_iris() {
    for iri in [
        "urn:example:a",
        "URN:example:a",
        "http://example.org/a#b",
        "tag:example.org,2026:a",
    ] {
        assert!(knowledge::is_iri(iri), "{iri}");
    }
    for name in [
        "Dosing:Fill",
        "001:Dosing",
        "a",
        "",
        "urn:a b",
        "http://a b",
    ] {
        assert!(!knowledge::is_iri(name), "{name}");
    }
}
