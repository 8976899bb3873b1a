//! Questions with the value of a parameter: the part of the whole answer with this value.

use std::collections::BTreeMap;

use knowledge::{Knowledge, KnowledgeSource, QuestionAnswer, SourceKind};
use test_data::read_own;

use crate::store::{GRASP, ask, grasp_type, gripper, skill_type};

/// A parameter of a question narrows by its value to the nodes of the answer at once; the result is
/// the rows of the whole answer that have the value in one of these columns.
const NARROWED: [(&str, &str, &[&str]); 15] = [
    ("access-of", "name", &["name", "of"]),
    ("commands", "skill", &["skill"]),
    ("components-of", "module", &["module"]),
    ("modules-with", "what", &["what", "component"]),
    ("operations", "operation", &["operation"]),
    ("outputs-of", "skill", &["of_name", "of"]),
    ("parameters", "skill", &["skill"]),
    ("parameters-of", "skill", &["skill_name", "skill"]),
    ("services-of", "module", &["module"]),
    (
        "skills-for",
        "capability",
        &["capability", "capability_name"],
    ),
    ("state-of", "skill", &["skill_name", "skill"]),
    ("transitions-now", "skill", &["skill_name", "skill"]),
    ("types", "type", &["supertype"]),
    ("where-is", "name", &["name"]),
    ("who-provides", "capability", &["capability"]),
];

/// A node whose label is its own IRI, so that a value names it in two ways.
const LABELLED: &str = r#"
    @prefix ua: <urn:ua-bridge:plant#> .
    @prefix css: <http://www.w3id.org/hsu-aut/css#> .
    @prefix cask: <http://www.w3id.org/hsu-aut/cask#> .
    @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
    <urn:own> a ua:Module ; rdfs:label "urn:own" ; ua:hasServer <urn:own> ;
        ua:nodeIdentifier "i=1" ; ua:nodeNamespace "urn:n" ; ua:nodeId "ns=1;i=1" ;
        ua:endpoint "opc.tcp://127.0.0.1" ; css:providesSkill <urn:own> ;
        cask:hasInputParameter <urn:own:p> ; cask:hasOutputParameter <urn:own:p> .
    <urn:own:p> cask:hasVariableName "p" ; cask:hasVariableType "Double" .
"#;

#[test]
fn a_narrowed_answer_is_the_part_of_the_whole_with_this_value() {
    let knowledge = Knowledge::new().unwrap();
    let put = |name: &str, triples: &[mtp::Triple]| {
        let source = KnowledgeSource::new(SourceKind::Mtp, name);
        knowledge.replace(&source, triples, 1).unwrap();
    };
    for name in ["column", "stage"] {
        let module = mtp::Module::read(&read_own(&format!("mtp/{name}.aml"))).unwrap();
        let capability = vec!["urn:example:capability:fill".to_owned()];
        let capabilities = module
            .services
            .iter()
            .map(|one| (one.name.clone(), capability.clone()));
        put(
            name,
            &module.triples(&format!("urn:m:{name}"), &capabilities.collect()),
        );
    }
    let facts = gripper("urn:g", vec![grasp_type(), skill_type()], GRASP);
    put("gripper", &facts.triples().0);
    put("operations", &knowledge::operations::triples());
    let own = KnowledgeSource::new(SourceKind::File, "own");
    knowledge.replace_turtle(&own, LABELLED, 1).unwrap();
    let mut without_rows = Vec::new();
    for (question, parameter, columns) in NARROWED {
        let whole = ask(&knowledge, question, &[]);
        if whole.rows.is_empty() {
            without_rows.push(question);
        }
        let values = whole.rows.iter().flat_map(|row| {
            columns
                .iter()
                .map(|column| QuestionAnswer::text(row, column))
        });
        let values: std::collections::BTreeSet<&str> =
            values.filter(|value| !value.is_empty()).collect();
        for value in values {
            let has_value = |row: &&BTreeMap<String, serde_json::Value>| {
                columns
                    .iter()
                    .any(|column| QuestionAnswer::text(row, column) == value)
            };
            let expected: Vec<_> = whole.rows.iter().filter(has_value).collect();
            let narrowed = ask(&knowledge, question, &[(parameter, value)]);
            assert_eq!(
                narrowed.rows.iter().collect::<Vec<_>>(),
                expected,
                "{question} {value}"
            );
        }
        let none = ask(&knowledge, question, &[(parameter, "urn:example:nothing")]);
        assert_eq!(none.rows, [], "{question}");
    }
    assert_eq!(
        without_rows,
        ["transitions-now"],
        "the states are not known"
    );
}
