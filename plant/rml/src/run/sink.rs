//! The statements of a run, and the limits of their number and size.

use std::collections::HashSet;

use oxrdf::{GraphName, NamedOrBlankNode, Quad, Term};

use super::RunFault;

/// The statements, each once.
#[derive(Default)]
pub(super) struct StatementSink {
    pub(super) quads: Vec<Quad>,
    known: HashSet<Quad>,
    /// The bytes of the terms of all statements.
    bytes: usize,
}

impl StatementSink {
    pub(super) fn add(&mut self, quad: Quad) -> Result<(), RunFault> {
        if self.quads.len() >= MAX_STATEMENTS {
            return Err(RunFault::Statements(MAX_STATEMENTS));
        }
        if self.known.insert(quad.clone()) {
            self.bytes = self.bytes.saturating_add(bytes_of(&quad));
            if self.bytes > MAX_BYTES {
                return Err(RunFault::Bytes(MAX_BYTES));
            }
            self.quads.push(quad);
        }
        Ok(())
    }
}

/// Returns the bytes of the terms of a statement.
fn bytes_of(quad: &Quad) -> usize {
    let subject = match &quad.subject {
        NamedOrBlankNode::NamedNode(node) => node.as_str().len(),
        NamedOrBlankNode::BlankNode(node) => node.as_str().len(),
    };
    let object = match &quad.object {
        Term::NamedNode(node) => node.as_str().len(),
        Term::BlankNode(node) => node.as_str().len(),
        Term::Literal(literal) => {
            let of_type = match literal.language() {
                Some(language) => language.len(),
                None => literal.datatype().as_str().len(),
            };
            literal.value().len() + of_type
        }
    };
    let graph = match &quad.graph_name {
        GraphName::NamedNode(node) => node.as_str().len(),
        GraphName::BlankNode(node) => node.as_str().len(),
        GraphName::DefaultGraph => 0,
    };
    subject + quad.predicate.as_str().len() + object + graph
}

const MAX_STATEMENTS: usize = 2_000_000;
/// Maximum number of bytes of the terms of all statements.
const MAX_BYTES: usize = 512 << 20;

#[cfg(test)]
mod tests {
    use oxrdf::{Literal, NamedNode};

    use super::*;

    #[test]
    fn the_bytes_of_a_statement_are_those_of_its_terms() {
        let node = |iri: &str| NamedNode::new(iri).unwrap();
        let graph = GraphName::DefaultGraph;
        let named = Quad::new(node("urn:s"), node("urn:pp"), node("urn:ooo"), graph);
        assert_eq!(bytes_of(&named), 5 + 6 + 7);
        let text = Literal::new_language_tagged_literal("four", "de").unwrap();
        let literal = Quad::new(node("urn:s"), node("urn:pp"), text, node("urn:g"));
        assert_eq!(bytes_of(&literal), 5 + 6 + 4 + 2 + 5);
    }
}
