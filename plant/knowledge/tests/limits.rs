//! Limits that the nodes of a NodeSet declare, as answers of a question.
#![expect(clippy::unwrap_used, reason = "a test may")]

use knowledge::{
    ComponentFacts, Knowledge, KnowledgeSource, ParameterFacts, QuestionAnswer, SourceKind, nodeset,
};
use test_data::read_own;

use super::store::{GRASP, ask, column, grasp_type, gripper, node, of_type};

/// The IRI and the namespace of the NodeSet of grippers.
const GRIPPERS: &str = "urn:ua-bridge:test:grippers";

#[test]
fn a_quantity_is_held_by_what_a_node_set_declares() {
    let knowledge = Knowledge::new().unwrap();
    let put = |kind, name: &str, triples: &[mtp::Triple]| {
        let source = KnowledgeSource::new(kind, name);
        knowledge.replace(&source, triples, 1).unwrap();
        source.graph()
    };
    put(SourceKind::File, "units", &knowledge::units::triples());
    let read = nodeset::read(&read_own("nodesets/grippers.xml")).unwrap();
    let graph = put(SourceKind::NodeSet, GRIPPERS, &read.triples);
    let held = |quantity: &str| {
        let found = ask(&knowledge, "what-can-hold", &[("quantity", quantity)]);
        let names = found.rows.iter().map(|row| {
            let text = |column| QuestionAnswer::text(row, column).to_owned();
            let value = row["value"].as_f64().unwrap();
            (
                text("component"),
                text("skill_name"),
                format!("{value:.4} {}", text("unit")),
            )
        });
        names.collect::<Vec<_>>()
    };
    let row = |component: &str, skill: &str, value: &str| {
        (component.to_owned(), skill.to_owned(), value.to_owned())
    };
    let clamp = |value: &str| row("Clamp", "", value);
    let hold = |value: &str| row("HoldSkillType", "", value);
    assert_eq!(held("3 kg"), [clamp("6.6139 lb"), hold("3000.0000 g")]);
    assert_eq!(
        held("4 lb"),
        [
            clamp("4.0000 lb"),
            row("GentleHoldSkillType", "", "1.8144 kg"),
            hold("1814.3695 g"),
        ]
    );
    let lift = row("Clamp", "Lift", "-1.0000 kg");
    assert_eq!(held("-1000 g"), [lift], "the range has no lower bound");
    assert_eq!(held("6 kg"), []);
    assert_eq!(held("0 m"), [], "a range of 0 to 0 is not known");

    // The proof: the source, and the node with the limit.
    let found = ask(&knowledge, "what-can-hold", &[("quantity", "3 kg")]);
    let proof = serde_json::to_value(&found.rows[1]).unwrap();
    let expected = serde_json::json!({
        "component": "HoldSkillType", "skill_name": null, "limit": "Payload", "value": 3000.0,
        "min": 0.0, "max": 5000.0, "unit": "g", "state": null, "source": graph,
        "node": format!("nsu={GRIPPERS};i=6001"), "skill": format!("{GRIPPERS}#i=1001"),
    });
    assert_eq!(proof, expected);

    // Running skills: each has the limit of its nearest type, or that of its own.
    let hold_type = of_type(GRIPPERS, "i=1001", "HoldSkillType");
    let gentle_type = of_type(GRIPPERS, "i=1002", "GentleHoldSkillType");
    let mut strong = gripper("urn:example:strong", vec![hold_type.clone()], GRASP);
    let gentle = gripper("urn:example:gentle", vec![gentle_type, hold_type], GRASP);
    let put = |facts: &ComponentFacts| put(SourceKind::Component, &facts.name, &facts.triples().0);
    put(&strong);
    put(&gentle);
    // The limit of its node comes before that of its type.
    let hold_type = of_type(GRIPPERS, "i=1001", "HoldSkillType");
    let mut lifting = gripper("urn:example:lifting", vec![grasp_type(), hold_type], GRASP);
    lifting.skills[0].node = node(GRIPPERS, "i=5022");
    put(&lifting);
    let strong_row = row("strong", "Grasp", "3000.0000 g");
    assert_eq!(held("3 kg"), [clamp("6.6139 lb"), strong_row]);
    assert_eq!(held("-1 kg"), [row("lifting", "Grasp", "-1.0000 kg")]);
    let parameters = [("quantity", "3 kg"), ("capability", GRASP)];
    let found = ask(&knowledge, "what-can-hold", &parameters);
    assert_eq!(column(&found, "component"), ["strong"]);
    assert_eq!(column(&found, "source"), [graph]);
    strong.skills[0].parameters.push(ParameterFacts {
        name: "Payload".into(),
        max: Some(1.0),
        unit: Some("kg".into()),
        ..ParameterFacts::default()
    });
    put(&strong);
    assert_eq!(held("3 kg"), [clamp("6.6139 lb")], "its own limit is lower");
}

/// Returns the knowledge of units and of a source in Turtle about a gripper.
fn data_sheets(sheets: &[(&str, &str)]) -> Knowledge {
    let knowledge = Knowledge::new().unwrap();
    let units = KnowledgeSource::new(SourceKind::File, "units");
    knowledge
        .replace(&units, &knowledge::units::triples(), 1)
        .unwrap();
    let source = KnowledgeSource::new(SourceKind::Component, "gripper");
    let facts = gripper("urn:example:gripper", vec![grasp_type()], GRASP);
    knowledge.replace(&source, &facts.triples().0, 1).unwrap();
    for (name, turtle) in sheets {
        let source = KnowledgeSource::new(SourceKind::File, name);
        let turtle = format!(
            "@prefix ua: <urn:ua-bridge:plant#> . @prefix cask: <http://www.w3id.org/hsu-aut/cask#> .
            <urn:example:gripper> ua:hasLimit <urn:example:limit> . <urn:example:limit> {turtle} ."
        );
        knowledge.replace_turtle(&source, &turtle, 1).unwrap();
    }
    knowledge
}

#[test]
fn a_quantity_at_a_bound_is_held_in_each_unit() {
    let held = |range: &str, unit: &str, quantity: &str| {
        let limit = format!("cask:hasVariableName \"Limit\" ; {range} ; ua:unit \"{unit}\"");
        let knowledge = data_sheets(&[("sheet.ttl", &limit)]);
        let found = ask(&knowledge, "what-can-hold", &[("quantity", quantity)]);
        !found.rows.is_empty()
    };
    let width = "ua:min 57 ; ua:max 100";
    for (quantity, is_held) in [
        ("0.57 m", true),
        ("0.56999999 m", false),
        ("1 m", true),
        ("1.00000001 m", false),
        ("570 mm", true),
    ] {
        assert_eq!(held(width, "cm", quantity), is_held, "{quantity}");
    }
    for (celsius, kelvin) in [("0", "273.15"), ("0.1", "273.25")] {
        let only = format!("ua:min {celsius} ; ua:max {celsius}");
        assert!(held(&only, "\u{b0}C", &format!("{kelvin} K")), "{kelvin}");
    }
}

#[test]
fn the_proof_of_a_limit_has_the_values_of_its_source() {
    let knowledge = data_sheets(&[
        (
            "one.ttl",
            "cask:hasVariableName \"Payload\" ; ua:max 5 ; ua:unit \"kg\"",
        ),
        (
            "other.ttl",
            "cask:hasVariableName \"Payload\" ; ua:min 4000 ; ua:unit \"g\"",
        ),
    ]);
    let proofs = |quantity: &str| {
        let found = ask(&knowledge, "what-can-hold", &[("quantity", quantity)]);
        let proofs = found.rows.iter().map(|row| {
            let source = QuestionAnswer::text(row, "source").to_owned();
            let unit = QuestionAnswer::text(row, "unit").to_owned();
            (source, row["min"].as_f64(), row["max"].as_f64(), unit)
        });
        proofs.collect::<Vec<_>>()
    };
    let graph = |name: &str| KnowledgeSource::new(SourceKind::File, name).graph();
    let one = (graph("one.ttl"), None, Some(5.0), "kg".to_owned());
    let other = (graph("other.ttl"), Some(4000.0), None, "g".to_owned());
    assert_eq!(proofs("3 kg"), [one]);
    assert_eq!(proofs("6 kg"), [other]);
}
