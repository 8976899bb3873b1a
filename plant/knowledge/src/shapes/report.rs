//! The report of a check, as JSON and in the vocabulary of SHACL.

use std::collections::HashSet;
use std::io;

use oxigraph::io::{RdfFormat, RdfSerializer};
use oxigraph::model::{
    BlankNode, Literal, NamedNode, NamedNodeRef, NamedOrBlankNode, Term, Triple,
};
use serde_json::{Value, json};

use super::{RDF, SHACL, Shapes, resource};

/// The result of a check of the knowledge.
#[derive(Debug, Default)]
pub(crate) struct ShapeReport {
    pub(crate) violations: Vec<Violation>,
    /// Parts of shapes that were not checked, with the reason.
    pub(crate) unchecked: Vec<String>,
}

/// A violation of a constraint.
#[derive(Debug)]
pub(crate) struct Violation {
    pub(crate) focus: Term,
    pub(crate) value: Option<Term>,
    /// The path of the property shape, as in the shapes and as in SPARQL.
    pub(crate) path: Option<(Term, String)>,
    pub(crate) shape: Term,
    pub(crate) component: String,
    pub(crate) severity: NamedNode,
    pub(crate) message: String,
}

impl ShapeReport {
    pub(crate) fn json(&self) -> Value {
        let one = |violation: &Violation| {
            json!({
                "focus": shown(&violation.focus),
                "path": violation.path.as_ref().map(|(_, path)| path),
                "value": violation.value.as_ref().map(shown),
                "message": violation.message,
                "severity": violation.severity.as_str().strip_prefix(SHACL),
                "component": violation.component,
                "shape": shown(&violation.shape),
            })
        };
        json!({
            "conforms": self.violations.is_empty(),
            "results": self.violations.iter().map(one).collect::<Vec<_>>(),
            "unchecked": self.unchecked,
        })
    }

    /// Returns the report as Turtle.
    pub(crate) fn turtle(&self, shapes: &Shapes) -> io::Result<Vec<u8>> {
        let mut graph = Graph::default();
        let report = BlankNode::default();
        graph.is_a(&report, "ValidationReport");
        let conforms = Literal::from(self.violations.is_empty());
        graph.say(&report, "conforms", conforms.into());
        for violation in &self.violations {
            let result = BlankNode::default();
            graph.say(&report, "result", result.clone().into());
            graph.is_a(&result, "ValidationResult");
            graph.say(&result, "focusNode", violation.focus.clone());
            if let Some((path, _)) = &violation.path {
                graph.say(&result, "resultPath", path.clone());
                graph.copy(path, shapes);
            }
            if let Some(value) = &violation.value {
                graph.say(&result, "value", value.clone());
            }
            graph.say(&result, "sourceShape", violation.shape.clone());
            let component = NamedNode::new_unchecked(format!("{SHACL}{}", violation.component));
            graph.say(&result, "sourceConstraintComponent", component.into());
            graph.say(&result, "resultSeverity", violation.severity.clone().into());
            let message = Literal::new_simple_literal(&violation.message);
            graph.say(&result, "resultMessage", message.into());
        }
        let serializer = RdfSerializer::from_format(RdfFormat::Turtle);
        let serializer = serializer
            .with_prefix("sh", SHACL)
            .map_err(io::Error::other)?;
        let mut writer = serializer.for_writer(Vec::new());
        for triple in &graph.triples {
            writer.serialize_triple(triple)?;
        }
        writer.finish()
    }
}

#[derive(Default)]
struct Graph {
    triples: Vec<Triple>,
    /// Nodes of paths that were copied.
    copied: HashSet<NamedOrBlankNode>,
}

impl Graph {
    fn say(&mut self, subject: &BlankNode, term: &str, object: Term) {
        let predicate = NamedNode::new_unchecked(format!("{SHACL}{term}"));
        let triple = Triple::new(subject.clone(), predicate, object);
        self.triples.push(triple);
    }

    fn is_a(&mut self, subject: &BlankNode, class: &str) {
        let class = NamedNode::new_unchecked(format!("{SHACL}{class}"));
        let is_a = NamedNode::new_unchecked(format!("{RDF}type"));
        self.triples.push(Triple::new(subject.clone(), is_a, class));
    }

    /// Copies the statements of a path.
    fn copy(&mut self, path: &Term, shapes: &Shapes) {
        let mut waiting: Vec<NamedOrBlankNode> = resource(path).into_iter().collect();
        while let Some(node) = waiting.pop() {
            let is_named = matches!(node, NamedOrBlankNode::NamedNode(_));
            if is_named || !self.copied.insert(node.clone()) {
                continue;
            }
            for (predicate, object) in shapes.about(&node) {
                let predicate = NamedNodeRef::new_unchecked(predicate);
                let triple = Triple::new(node.clone(), predicate, object.clone());
                self.triples.push(triple);
                waiting.extend(resource(object));
            }
        }
    }
}

/// Returns the text of a term for people.
fn shown(term: &Term) -> String {
    match term {
        Term::NamedNode(node) => node.as_str().to_owned(),
        Term::Literal(literal) => literal.value().to_owned(),
        Term::BlankNode(node) => node.to_string(),
    }
}
