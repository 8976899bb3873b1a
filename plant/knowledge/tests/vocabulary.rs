//! The terms that are used are those that the ontologies have.
#![expect(
    clippy::panic,
    clippy::print_stderr,
    reason = "a test may, and reads files that stand beside the checkout"
)]

use std::collections::BTreeSet;
use std::path::Path;

use knowledge::vocabulary::{self, TermKind};
use knowledge::{Knowledge, QUESTIONS, Source, SourceKind};

/// A file of the data beside the checkout, or `None` where it is not at hand.
fn shared(file: &str) -> Option<String> {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")).join(file);
    match std::fs::read_to_string(&path) {
        Ok(text) => Some(text),
        Err(error) if std::env::var_os("CI").is_some_and(|ci| ci == "true") => {
            panic!("{}: {error}", path.display())
        }
        Err(error) => {
            eprintln!("skipped: {}: {error}", path.display());
            None
        }
    }
}

#[test]
fn every_foreign_term_is_in_its_ontology_as_what_it_is_used_as() {
    let knowledge = Knowledge::new().unwrap();
    for file in ["CSS-Ontology-2.0.1.ttl", "cask-3.0.1.ttl"] {
        let Some(turtle) = shared(&format!("ontologies/{file}")) else {
            return;
        };
        knowledge
            .replace_turtle(&Source::new(SourceKind::File, file), &turtle, 0)
            .unwrap();
    }
    let mut quads = Vec::new();
    knowledge.write_quads(None, &mut quads).unwrap();
    let quads = String::from_utf8(quads).unwrap();
    let mut missing = Vec::new();
    for term in vocabulary::foreign() {
        let kind = match term.kind {
            TermKind::Class => "Class",
            TermKind::ObjectProperty => "ObjectProperty",
            TermKind::DataProperty => "DatatypeProperty",
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
