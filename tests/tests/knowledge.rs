//! The knowledge graph of the plant, compared with rdflib: the same queries on the same statements
//! have the same answers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use knowledge::{
    ComponentFacts, Knowledge, KnowledgeSource, NamedQuestion, NodeName, ParameterFacts, QUESTIONS,
    QuestionAnswer, SkillFacts, SourceKind, TypeFacts, nodeset,
};
use serde_json::{Value, json};
use system_tests::{Cell, Peer};
use test_data::{read_foreign, read_own};

fn node(namespace: &str, identifier: &str) -> NodeName {
    NodeName {
        namespace: namespace.into(),
        identifier: identifier.into(),
    }
}

fn of_type(namespace: &str, identifier: &str, browse_name: &str) -> TypeFacts {
    TypeFacts {
        node: node(namespace, identifier),
        browse_name: browse_name.into(),
    }
}

/// Returns a component with a skill; its names contain all characters that need escapes.
fn component(uri: &str, own: Option<TypeFacts>, capabilities: &[&str]) -> ComponentFacts {
    let ours = "urn:ua-bridge:skills";
    let common = [
        of_type(ours, "i=1200", "GraspSkillType"),
        of_type(ours, "i=1000", "SkillType"),
    ];
    let force = ParameterFacts {
        name: "Force \"max\"\n{N}".into(),
        data_type: "Double".into(),
        default: Some("20.5".into()),
        min: Some(-0.25),
        max: Some(85.0),
        unit: Some("°N".into()),
        node: Some(node(uri, "i=10001")),
        ..ParameterFacts::default()
    };
    let gripped = ParameterFacts {
        name: "Gripped".into(),
        is_output: true,
        data_type: "Boolean".into(),
        ..ParameterFacts::default()
    };
    ComponentFacts {
        application_uri: uri.into(),
        name: format!("{uri} «ü»"),
        endpoint: "opc.tcp://127.0.0.1:4855".into(),
        namespace: own.is_none().then_some(7),
        skills: vec![SkillFacts {
            name: "Grasp".into(),
            number: Some(1),
            node: node(uri, "i=100"),
            types: own.into_iter().chain(common).collect(),
            capabilities: capabilities
                .iter()
                .map(|class| (*class).to_owned())
                .collect(),
            parameters: vec![force, gripped],
        }],
    }
}

const GRASP: &str = "urn:example:capability:grasp";

/// Fills a store with components, manifests with the names of their modules, NodeSets and a file.
fn plant(manifests: &[(&str, String)], node_sets: &[String]) -> Knowledge {
    let knowledge = Knowledge::new().unwrap();
    let vendor = of_type("urn:example:vendor", "s=Vacuum Grasp", "VacuumGraspType");
    let components = [
        component("urn:example:gripper", None, &[GRASP]),
        component(
            "urn:example:vacuum",
            Some(vendor),
            &["urn:example:capability:hold", "urn:example:capability:blow"],
        ),
        component("not an iri", None, &[]),
    ];
    for facts in components {
        let (triples, _) = facts.triples();
        knowledge
            .replace(
                &KnowledgeSource::new(SourceKind::Component, &facts.application_uri),
                &triples,
                1,
            )
            .unwrap();
    }
    for (name, text) in manifests {
        let module = mtp::Module::read(text).unwrap();
        let triples = module.triples(&format!("urn:ua-bridge:mtp:{name}"), &BTreeMap::new());
        knowledge
            .replace(&KnowledgeSource::new(SourceKind::Mtp, name), &triples, 1)
            .unwrap();
    }
    for text in node_sets {
        let read = nodeset::read(text).unwrap();
        knowledge
            .replace(
                &KnowledgeSource::new(SourceKind::NodeSet, &read.model.namespace),
                &read.triples,
                1,
            )
            .unwrap();
    }
    let units = KnowledgeSource::new(SourceKind::File, "units");
    knowledge
        .replace(&units, &knowledge::units::triples(), 1)
        .unwrap();
    let classes = format!(
        "@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> . <urn:example:capability:hold> rdfs:subClassOf <{GRASP}> .
        <urn:example:gripper> <urn:ua-bridge:plant#hasLimit> [ <http://www.w3id.org/hsu-aut/cask#hasVariableName> \"Payload\" ;
            <urn:ua-bridge:plant#max> 5 ; <urn:ua-bridge:plant#unit> \"kg\" ] ."
    );
    knowledge
        .replace_turtle(
            &KnowledgeSource::new(SourceKind::File, "capabilities.ttl"),
            &classes,
            1,
        )
        .unwrap();
    knowledge
}

/// Returns sorted rows, with numbers as floats and lists sorted.
fn comparable(question: NamedQuestion, columns: &[String], rows: Vec<Vec<Value>>) -> Vec<String> {
    let lists: Vec<&str> = question.lists().collect();
    let value = |(column, value): (&String, Value)| {
        let parts = match &value {
            Value::String(text) if lists.contains(&column.as_str()) => text
                .split('\n')
                .filter(|part| !part.is_empty())
                .map(Value::from)
                .collect(),
            Value::Array(parts) => parts.clone(),
            Value::Null if lists.contains(&column.as_str()) => Vec::new(),
            Value::Number(number) => return json!(number.as_f64()),
            _ => return value,
        };
        let mut parts: Vec<String> = parts.iter().map(Value::to_string).collect();
        parts.sort();
        json!(parts)
    };
    let row = |row: Vec<Value>| {
        columns
            .iter()
            .zip(row)
            .map(value)
            .collect::<Value>()
            .to_string()
    };
    let mut rows: Vec<String> = rows.into_iter().map(row).collect();
    rows.sort();
    rows
}

fn of_store(question: NamedQuestion, answer: QuestionAnswer) -> Vec<String> {
    let rows = answer.rows.into_iter().map(|mut row| {
        answer
            .columns
            .iter()
            .map(|column| row.remove(column).unwrap())
            .collect()
    });
    comparable(question, &answer.columns, rows.collect())
}

#[test]
fn rdflib_answers_every_question_alike() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let stage = read_own("mtp/stage.aml");
    let manifests = [
        ("one", stage.clone()),
        ("two", stage),
        ("mixer", read_own("mtp/mixer.aml")),
    ];
    let node_sets =
        ["devices", "machines", "grippers"].map(|name| read_own(&format!("nodesets/{name}.xml")));
    let knowledge = plant(&manifests, &node_sets);
    are_answered_alike(&cell, &knowledge, "urn:ua-bridge:test:devices#i=1002");
}

#[test]
fn rdflib_answers_every_question_alike_about_data_of_other_makers() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let files = [
        "mtp/pimad-core/PiMAd-core.0-0-1.aml",
        "mtp/huber-v14.1/Manifest.aml",
        "nodesets/Opc.Ua.Di.NodeSet2.xml",
        "nodesets/Opc.Ua.Robotics.NodeSet2.xml",
    ];
    let [Some(pimad), Some(huber), Some(di), Some(robotics)] = files.map(read_foreign) else {
        return;
    };
    let manifests = [("one", pimad.clone()), ("two", pimad), ("huber", huber)];
    let knowledge = plant(&manifests, &[di, robotics]);
    are_answered_alike(&cell, &knowledge, "http://opcfoundation.org/UA/DI/#i=15063");
}

/// The queries with a parameter, and its value.
fn narrowed(device: &str) -> [(&'static str, &'static str, &str); 14] {
    [
        ("what-can-run", "capability", GRASP),
        ("who-provides", "capability", GRASP),
        ("skills", "type", "urn:ua-bridge:skills#i=1200"),
        ("types", "type", device),
        ("parameters", "skill", "urn:example:gripper#i=100"),
        ("where-is", "name", "Grasp"),
        ("components", "component", "urn:ua-bridge:mtp:two"),
        ("components-of", "module", "urn:ua-bridge:mtp:two"),
        ("services-of", "module", "urn:ua-bridge:mtp:one"),
        ("skills-for", "capability", GRASP),
        ("transitions-now", "state", "Idle"),
        ("access-of", "name", "Grasp"),
        ("modules-with", "what", "AnaServParam"),
        ("what-can-hold", "quantity", "300 g"),
    ]
}

/// Compares the answers of all queries, some of them with parameters; `device` is a type with
/// subtypes.
fn are_answered_alike(cell: &Cell, knowledge: &Knowledge, device: &str) {
    let asked: Vec<(NamedQuestion, Vec<(String, String)>)> = QUESTIONS
        .iter()
        .map(|question| (*question, Vec::new()))
        .chain(narrowed(device).map(|(question, parameter, value)| {
            (
                NamedQuestion::of(question).unwrap(),
                vec![(parameter.to_owned(), value.to_owned())],
            )
        }))
        .collect();
    let mut quads = Vec::new();
    knowledge.write_quads(None, &mut quads).unwrap();
    let quads = cell.file("plant.nq", std::str::from_utf8(&quads).unwrap());
    let texts = asked
        .iter()
        .zip(0..)
        .map(|((question, parameters), number)| {
            cell.file(
                &format!("{number}-{}.rq", question.name),
                &question.with(parameters).unwrap(),
            )
        });
    let files: Vec<_> = std::iter::once(quads).chain(texts).collect();
    let args: Vec<_> = files.iter().map(|file| file.to_str().unwrap()).collect();
    let mut judge = cell.asyncua_started("knowledge_judge.py", &args).start();
    let status = judge.wait_for_end(JUDGED);
    assert!(status.success(), "the judge ended with {status}: {judge}");
    let told = judge.json_lines();
    assert_eq!(told.len(), asked.len());
    let mut empty = Vec::new();
    for ((question, parameters), told) in asked.iter().zip(told) {
        let ours = knowledge.ask(question.name, parameters).unwrap();
        let columns: Vec<String> = serde_json::from_value(told["columns"].clone()).unwrap();
        assert_eq!(ours.columns, columns, "{}", question.name);
        if ours.rows.is_empty() {
            empty.push(question.name);
        }
        let rows: Vec<Vec<Value>> = serde_json::from_value(told["rows"].clone()).unwrap();
        let theirs = comparable(*question, &columns, rows);
        assert_eq!(
            of_store(*question, ours),
            theirs,
            "{} {parameters:?}",
            question.name
        );
    }
    // No process has run, and neither processes nor operations are known.
    let expected = [
        "action-parameters",
        "actions",
        "goals",
        "objects",
        "operations",
        "process-conditions",
        "process-loops",
        "process-parameters",
        "process-steps",
        "processes",
        "run-steps",
        "run-values",
        "runs",
        "transitions-now",
    ];
    assert_eq!(empty, expected);
}

#[test]
fn owlrl_derives_the_same_statements_before_and_after_a_source_is_removed() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let node_sets =
        ["devices", "machines", "grippers"].map(|name| read_own(&format!("nodesets/{name}.xml")));
    let stage = read_own("mtp/stage.aml");
    let knowledge = plant(&[("one", stage.clone()), ("two", stage)], &node_sets);
    knowledge.set_rules(true).unwrap();
    let ontology = KnowledgeSource::new(SourceKind::File, "ontology.ttl");
    knowledge.replace_turtle(&ontology, ONTOLOGY, 1).unwrap();
    let cell_file = KnowledgeSource::new(SourceKind::File, "cell.ttl");
    knowledge.replace_turtle(&cell_file, CELL, 1).unwrap();
    let all = are_derived_alike(&cell, &knowledge);
    assert!(all > 80, "{all} statements are derived");
    knowledge.remove(&cell_file).unwrap();
    let fewer = are_derived_alike(&cell, &knowledge);
    knowledge.remove(&ontology).unwrap();
    let least = are_derived_alike(&cell, &knowledge);
    assert!(all > fewer && fewer > least, "{all}, {fewer}, {least}");
}

/// Compares the derived statements between named nodes. Returns their number.
fn are_derived_alike(cell: &Cell, knowledge: &Knowledge) -> usize {
    let mut quads = Vec::new();
    knowledge.write_quads(None, &mut quads).unwrap();
    let quads = String::from_utf8(quads).unwrap();
    let file = cell.file("rules.nq", &quads);
    let arguments = [file.to_str().unwrap()];
    let mut judge = cell.asyncua_started("rules_judge.py", &arguments).start();
    let status = judge.wait_for_end(JUDGED);
    assert!(status.success(), "the judge ended with {status}: {judge}");
    let told = judge.json_lines();
    let theirs: BTreeSet<String> = serde_json::from_value(told[0]["derived"].clone()).unwrap();
    let split = |line: &str| -> Option<(String, bool)> {
        let line = line.strip_suffix(" .")?;
        let (statement, graph) = line.rsplit_once(' ')?;
        let is_derived = graph == "<urn:ua-bridge:graph:derived>";
        Some((statement.to_owned(), is_derived))
    };
    let (derived, stated): (Vec<_>, Vec<_>) =
        quads.lines().filter_map(split).partition(|(_, is)| *is);
    let stated: BTreeSet<String> = stated.into_iter().map(|(line, _)| line).collect();
    let is_reserved = |term: &str| term.starts_with("<http://www.w3.org/");
    let is_compared = |line: &String| {
        let terms: Vec<&str> = line.split(' ').collect();
        let [subject, predicate, object] = terms.as_slice() else {
            return false;
        };
        let is_named = |term: &str| term.starts_with('<') && !is_reserved(term);
        let is_hierarchy =
            predicate.ends_with("#subClassOf>") || predicate.ends_with("#subPropertyOf>");
        is_named(subject) && is_named(object) && !(is_hierarchy && subject == object)
    };
    let ours: BTreeSet<String> = derived
        .into_iter()
        .map(|(line, _)| line)
        .filter(|line| is_compared(line) && !stated.contains(line))
        .collect();
    let missing: Vec<_> = theirs.difference(&ours).take(20).collect();
    let surplus: Vec<_> = ours.difference(&theirs).take(20).collect();
    assert!(
        missing.is_empty() && surplus.is_empty(),
        "missing {missing:#?}, surplus {surplus:#?}"
    );
    ours.len()
}

/// Terms with all rules.
const ONTOLOGY: &str = "@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
    @prefix owl: <http://www.w3.org/2002/07/owl#> . @prefix : <urn:example:cell#> .
    @prefix css: <http://www.w3id.org/hsu-aut/css#> .
    css:isRealizedBySkill rdfs:domain css:Capability ; rdfs:range css:Skill ; owl:inverseOf css:realizes .
    css:providesSkill rdfs:subPropertyOf css:offers . css:offers rdfs:domain css:Resource .
    css:Resource owl:equivalentClass :Device .
    :Gripper rdfs:subClassOf :Tool . :Tool rdfs:subClassOf :Device . :Werkzeug owl:equivalentClass :Tool .
    :hasPart a owl:TransitiveProperty ; owl:inverseOf :isPartOf ; rdfs:domain :Assembly ;
        rdfs:subPropertyOf :relatesTo .
    :hasScrew rdfs:subPropertyOf :hasPart . :mounts owl:equivalentProperty :hasPart .
    :touches a owl:SymmetricProperty ; rdfs:subPropertyOf :near . :near a owl:TransitiveProperty .
    :relatesTo rdfs:range :Thing .";
const CELL: &str = "@prefix : <urn:example:cell#> .
    :cell :hasPart :robot . :robot :hasPart :hand . :hand :mounts :gripper . :gripper :hasScrew :screw .
    :screw :isPartOf :box . :robot :touches :table . :table :touches :floor . :floor :near :robot .
    :gripper a :Gripper . :table a :Werkzeug . :screw :relatesTo :cell .";

/// Time limit of rdflib for all queries. It takes about 6 s of processor time.
const JUDGED: Duration = Duration::from_secs(180);
