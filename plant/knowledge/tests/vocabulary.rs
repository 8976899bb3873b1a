//! Checks the used terms against the ontologies.
use std::collections::BTreeSet;

use knowledge::vocabulary::{self, IriKind};
use knowledge::{Knowledge, KnowledgeSource, QUESTIONS, SourceKind};
use test_data::read_foreign;

#[test]
fn every_foreign_term_is_in_its_ontology_as_what_it_is_used_as() {
    let knowledge = Knowledge::new().unwrap();
    for file in ["CSS-Ontology-2.0.1.ttl", "cask-3.0.1.ttl"] {
        let Some(turtle) = read_foreign(&format!("ontologies/{file}")) else {
            return;
        };
        knowledge
            .replace_turtle(&KnowledgeSource::new(SourceKind::File, file), &turtle, 0)
            .unwrap();
    }
    let mut quads = Vec::new();
    knowledge.write_quads(None, &mut quads).unwrap();
    let quads = String::from_utf8(quads).unwrap();
    let mut missing = Vec::new();
    for term in vocabulary::foreign() {
        let kind = match term.kind {
            IriKind::Class => "Class",
            IriKind::ObjectProperty => "ObjectProperty",
            IriKind::DataProperty => "DatatypeProperty",
        };
        let said = format!(
            "<{}> <{}> <http://www.w3.org/2002/07/owl#{kind}> ",
            term.iri,
            vocabulary::RDF_TYPE
        );
        if !quads.lines().any(|line| line.starts_with(&said)) {
            missing.push(said);
        }
    }
    assert_eq!(missing, Vec::<String>::new());
}

#[test]
fn questions_ask_for_terms_of_the_table_only() {
    let known: BTreeSet<&str> = vocabulary::all().map(|term| term.iri).collect();
    for question in QUESTIONS {
        let names = question
            .sparql
            .lines()
            .filter(|line| !line.starts_with('#') && !line.starts_with("PREFIX"));
        for word in names.flat_map(|line| {
            line.split(|letter: char| {
                !letter.is_ascii_alphanumeric() && letter != ':' && letter != '?'
            })
        }) {
            let Some((prefix, local)) = word.split_once(':') else {
                continue;
            };
            let Some((_, base)) = vocabulary::PREFIXES
                .iter()
                .find(|(name, _)| *name == prefix)
            else {
                continue;
            };
            // The datatypes to which queries convert are no terms of the plant.
            if prefix == "xsd" {
                continue;
            }
            let iri = format!("{base}{local}");
            assert!(known.contains(&*iri), "{}: {word}", question.name);
        }
        for (prefix, base) in vocabulary::PREFIXES {
            let bound = format!("PREFIX {prefix}: <{base}>");
            assert!(
                !question.sparql.contains(&format!("PREFIX {prefix}:"))
                    || question.sparql.contains(&bound),
                "{} {prefix}",
                question.name
            );
        }
    }
}
