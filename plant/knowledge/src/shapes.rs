//! Checks the knowledge against shapes (SHACL): the shapes of this crate, and those in the sources.
//!
//! Each constraint becomes a query, which runs within the limits of all queries. Constraints that
//! are not supported are named in the report.

mod compile;
mod report;

use std::collections::{HashMap, HashSet};

use oxigraph::io::{RdfFormat, RdfParser};
use oxigraph::model::{GraphNameRef, NamedNodeRef, NamedOrBlankNode, Term, Triple};

use crate::store::{Knowledge, KnowledgeFault};

pub(crate) use compile::Check;
pub(crate) use report::{ShapeReport, Violation};

/// The statements of shapes.
#[derive(Debug, Default)]
pub(crate) struct Shapes {
    by_subject: HashMap<NamedOrBlankNode, Vec<(String, Term)>>,
    /// The subjects in the order of their statements.
    subjects: Vec<NamedOrBlankNode>,
    /// All statements, each once.
    known: HashSet<Triple>,
}

impl Shapes {
    /// Returns the shapes of this crate and of the knowledge.
    pub(crate) fn of(knowledge: &Knowledge) -> Result<Self, KnowledgeFault> {
        let mut shapes = Self::default();
        let own = RdfParser::from_format(RdfFormat::Turtle).for_slice(OWN);
        for quad in own {
            let quad = quad.map_err(|error| KnowledgeFault::Turtle(error.to_string()))?;
            shapes.add(quad.into());
        }
        let store = knowledge.store();
        let terms = compile::TERMS.iter().map(|term| format!("{SHACL}{term}"));
        let lists = ["first", "rest"].map(|term| format!("{RDF}{term}"));
        for predicate in terms.chain(lists) {
            let predicate = NamedNodeRef::new_unchecked(&predicate);
            let graph = Some(GraphNameRef::DefaultGraph);
            for quad in store.quads_for_pattern(None, Some(predicate), None, graph) {
                shapes.add(quad?.into());
            }
        }
        Ok(shapes)
    }

    fn add(&mut self, triple: Triple) {
        if !self.known.insert(triple.clone()) {
            return;
        }
        let about = self.by_subject.entry(triple.subject.clone()).or_default();
        if about.is_empty() {
            self.subjects.push(triple.subject);
        }
        about.push((triple.predicate.into_string(), triple.object));
    }

    fn about(&self, subject: &NamedOrBlankNode) -> &[(String, Term)] {
        self.by_subject.get(subject).map_or(&[], Vec::as_slice)
    }

    /// Returns the values of a property of SHACL.
    fn all<'a>(&'a self, subject: &NamedOrBlankNode, term: &str) -> Vec<&'a Term> {
        let statements = self.about(subject).iter();
        let found = statements.filter(|(predicate, _)| predicate.strip_prefix(SHACL) == Some(term));
        found.map(|(_, object)| object).collect()
    }

    fn one<'a>(&'a self, subject: &NamedOrBlankNode, term: &str) -> Option<&'a Term> {
        self.all(subject, term).first().copied()
    }

    /// Returns the members of a list.
    fn list<'a>(&'a self, head: &'a Term) -> Option<Vec<&'a Term>> {
        let mut all = Vec::new();
        let mut at = head;
        loop {
            if matches!(at, Term::NamedNode(node) if node.as_str() == NIL) {
                return Some(all);
            }
            let about = self.about(&resource(at)?);
            let value = |name: &str| {
                let mut found = about.iter();
                let found = found.find(|(it, _)| it.strip_prefix(RDF) == Some(name));
                found.map(|(_, object)| object)
            };
            all.push(value("first")?);
            at = value("rest")?;
            if all.len() > MAX_LIST {
                return None;
            }
        }
    }
}

fn resource(term: &Term) -> Option<NamedOrBlankNode> {
    match term {
        Term::NamedNode(node) => Some(node.clone().into()),
        Term::BlankNode(node) => Some(node.clone().into()),
        Term::Literal(_) => None,
    }
}

const OWN: &str = include_str!("../shapes/plant.ttl");
const SHACL: &str = "http://www.w3.org/ns/shacl#";
const RDF: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#";
const NIL: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#nil";
/// Maximum length of a list, also of one that leads to itself.
const MAX_LIST: usize = 1000;
