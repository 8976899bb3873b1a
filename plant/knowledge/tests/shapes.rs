//! The report of shapes (SHACL). The system tests compare it with
//! that of pySHACL.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::collections::BTreeMap;
use std::sync::Arc;

use knowledge::{HttpEndpoint, Knowledge, KnowledgeSource, QueryLimits, SourceKind};
use serde_json::Value;

use super::http::get;

async fn report(files: &[(&str, &str)]) -> (Value, String) {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    for (name, turtle) in files {
        let source = KnowledgeSource::new(SourceKind::File, name);
        knowledge.replace_turtle(&source, turtle, 1).unwrap();
    }
    let page = Arc::new(|_: &str| None);
    let address = "127.0.0.1:0".parse().unwrap();
    let endpoint = HttpEndpoint::bind(address, knowledge, QueryLimits::default(), page);
    let endpoint = endpoint.await.unwrap();
    let json = get(endpoint.address(), "/report", "application/json").await;
    let turtle = get(endpoint.address(), "/report", "text/turtle").await;
    (serde_json::from_str(&json.body).unwrap(), turtle.body)
}

#[tokio::test]
async fn violations_of_all_supported_constraints_are_reported() {
    let data = include_str!("shapes/data.ttl");
    let shapes = include_str!("shapes/shapes.ttl");
    let (json, turtle) = report(&[("data", data), ("shapes", shapes)]).await;
    assert_eq!(json["conforms"], false);
    assert_eq!(json["unchecked"], Value::Array(vec![]));
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for result in json["results"].as_array().unwrap() {
        let text = |key: &str| result[key].as_str().unwrap_or("-").to_owned();
        let focus = text("focus").replace("http://example.org/", "");
        let component = text("component").replace("ConstraintComponent", "");
        let value = text("value").replace("http://example.org/", "");
        let entry = found.entry(format!("{focus} {component}")).or_default();
        entry.push(value);
        entry.sort();
    }
    let expected = [
        ("bad Class", vec!["stone"]),
        ("bad Datatype", vec!["old"]),
        ("bad HasValue", vec!["-"]),
        ("bad In", vec!["blue", "green"]),
        ("bad LessThan", vec!["3"]),
        ("bad MaxCount", vec!["-", "-"]),
        ("bad MaxExclusive", vec!["150", "old"]),
        ("bad MaxLength", vec!["Much too long"]),
        ("bad MinCount", vec!["-"]),
        ("bad MinInclusive", vec!["-1", "old"]),
        ("bad MinLength", vec!["A"]),
        ("bad NodeKind", vec!["someone"]),
        ("bad Pattern", vec!["1x"]),
        ("box Class", vec!["box"]),
        ("box Closed", vec!["red"]),
        ("box MaxInclusive", vec!["11"]),
        ("box MinExclusive", vec!["0"]),
        ("owner MaxCount", vec!["-"]),
        ("self Disjoint", vec!["bad"]),
    ];
    let expected: BTreeMap<String, Vec<String>> = expected
        .into_iter()
        .map(|(key, values)| {
            let values = values.into_iter().map(str::to_owned);
            (key.to_owned(), values.collect())
        })
        .collect();
    assert_eq!(found, expected);
    let results = turtle.matches("sh:ValidationResult ").count();
    assert_eq!(
        results,
        json["results"].as_array().unwrap().len(),
        "{turtle}"
    );
    assert!(turtle.contains("too well known"), "{turtle}");
}

#[tokio::test]
async fn a_process_without_steps_violates_the_shapes_of_the_plant() {
    let empty = "<urn:p> a <http://www.w3id.org/hsu-aut/css#Process> .";
    let (json, _) = report(&[("empty", empty)]).await;
    let results = json["results"].as_array().unwrap();
    assert_eq!(results.len(), 1, "{json}");
    assert_eq!(
        results.first().unwrap()["message"],
        "a process has at least one step; state it by ua:hasStep"
    );
    let (json, _) = report(&[]).await;
    assert_eq!(json["conforms"], true);
}

#[tokio::test]
async fn constraints_that_are_not_supported_are_named() {
    let shapes = "@prefix sh: <http://www.w3.org/ns/shacl#> .
        <urn:s> a sh:NodeShape ; sh:targetNode <urn:x> ; sh:not <urn:t> ;
            sh:property [ sh:path <urn:p> ; sh:uniqueLang true ] .";
    let (json, _) = report(&[("shapes", shapes)]).await;
    let unchecked = json["unchecked"].to_string();
    assert!(unchecked.contains("<urn:s>: sh:not"), "{unchecked}");
    assert!(unchecked.contains("sh:uniqueLang"), "{unchecked}");
}
