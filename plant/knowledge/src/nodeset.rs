//! NodeSets (OPC 10000-6, annex F) as statements: types, their supertypes, the nodes that types
//! declare, and the limits of their variables.
//!
//! HasSubtype references become direct `rdfs:subClassOf` statements; the rule of the store derives
//! the indirect statements.

use std::collections::{BTreeMap, BTreeSet};

use mtp::{Object, Triple};
pub(crate) use nodeset_files::{MAX_FILE, MAX_NODES};
pub use nodeset_files::{ModelVersion, NodeSetModel};
use nodeset_files::{NodeSetDocument, NodeSetFileFault, NodeSetFileNode};
use thiserror::Error;

use crate::component::{NodeName, OPC_UA};
use crate::node_set_limits::{DeclaredLimits, NodesByIri};
use crate::node_set_models;
use crate::vocabulary as v;

/// The contents of a NodeSet.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeSetContents {
    /// Its model.
    pub model: NodeSetModel,
    /// Its statements.
    pub triples: Vec<Triple>,
}

/// Error of reading a NodeSet.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum NodeSetReadFault {
    /// The file exceeds the limit.
    #[error("the file has {length} bytes, more than the {most} that are read")]
    TooLarge {
        /// Size of the file.
        length: usize,
        /// The limit.
        most: usize,
    },
    /// The file is not XML, or incomplete.
    #[error("line {line}: {what}")]
    Xml {
        /// Line, from 1.
        line: usize,
        /// Description of the error.
        what: String,
    },
    /// The file is XML of another format.
    #[error("there is no <UANodeSet> with a <Model ModelUri=..>: this is no NodeSet2")]
    NoModel,
}

impl From<NodeSetFileFault> for NodeSetReadFault {
    fn from(fault: NodeSetFileFault) -> Self {
        match fault {
            other if other.is_other_format() => Self::NoModel,
            NodeSetFileFault::TooLarge { length, most } => Self::TooLarge { length, most },
            NodeSetFileFault::Document { line, fault } => Self::Xml {
                line,
                what: fault.to_string(),
            },
            NodeSetFileFault::Empty => Self::NoModel,
        }
    }
}

/// Reads the text of a NodeSet2 file.
///
/// # Errors
/// [`NodeSetReadFault`].
pub fn read(xml: &str) -> Result<NodeSetContents, NodeSetReadFault> {
    let mut document = NodeSetDocument::read(xml)?;
    let model = document.model.take();
    let model = model.filter(|model| !model.namespace.is_empty());
    let model = model.ok_or(NodeSetReadFault::NoModel)?;
    let triples = statements(&document, &model);
    Ok(NodeSetContents { model, triples })
}

/// Reads the model of a NodeSet2 file, from a text that may end behind its models.
///
/// # Errors
/// [`NodeSetReadFault`].
pub fn read_model(xml: &str) -> Result<NodeSetModel, NodeSetReadFault> {
    let model = NodeSetDocument::read_models(xml)?.model;
    let model = model.filter(|model| !model.namespace.is_empty());
    model.ok_or(NodeSetReadFault::NoModel)
}

/// Returns the statements of a NodeSet.
fn statements(document: &NodeSetDocument, model: &NodeSetModel) -> Vec<Triple> {
    let mut graph = Graph {
        document,
        all: node_set_models::statements(model),
    };
    graph.nodes();
    graph.all
}

/// Resolves a node from its notation in the file, with an alias or an index of the namespace
/// table.
fn node_name(document: &NodeSetDocument, written: &str) -> Option<NodeName> {
    let written = document.resolved(written);
    let (namespace, identifier) = match written.strip_prefix("ns=") {
        Some(rest) => {
            let (index, identifier) = rest.split_once(';')?;
            (namespace(document, index.parse().ok()?)?, identifier)
        }
        None => (OPC_UA, written),
    };
    identifier.contains('=').then(|| NodeName {
        namespace: namespace.to_owned(),
        identifier: identifier.to_owned(),
    })
}

fn namespace(document: &NodeSetDocument, index: usize) -> Option<&str> {
    match index.checked_sub(1) {
        None => Some(OPC_UA),
        Some(index) => document.namespaces.get(index).map(String::as_str),
    }
}

struct Graph<'a> {
    document: &'a NodeSetDocument,
    all: Vec<Triple>,
}

impl Graph<'_> {
    fn nodes(&mut self) {
        let document = self.document;
        let mut below: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        let mut by_iri = NodesByIri::new();
        let mut limits = DeclaredLimits::default();
        let nodes = document.nodes.iter();
        for node in nodes.filter(|node| CLASSES.contains(&node.class.as_str())) {
            let Some(name) = node_name(document, &node.id) else {
                continue;
            };
            let iri = name.iri();
            for one in &node.references {
                let reference = node_name(document, &one.reference_type);
                let target = node_name(document, &one.target);
                let (Some(reference), Some(target)) = (reference, target) else {
                    continue;
                };
                let (from, to, to_name) = if one.is_forward {
                    (iri.clone(), target.iri(), &target)
                } else {
                    (target.iri(), iri.clone(), &name)
                };
                limits.reference(&from, &reference, (&to, to_name));
                match (reference.namespace.as_str(), reference.identifier.as_str()) {
                    (OPC_UA, HAS_SUBTYPE) => self.link(&to, v::RDFS_SUB_CLASS_OF, &from),
                    (OPC_UA, HAS_PROPERTY | HAS_COMPONENT | HAS_ORDERED_COMPONENT) => {
                        below.entry(from).or_default().insert(to);
                    }
                    _ => {}
                }
            }
            by_iri.insert(iri, (name, node));
        }
        let mut waiting: Vec<&str> = Vec::new();
        for (iri, (name, node)) in &by_iri {
            if is_type(node) {
                self.link(iri, v::RDF_TYPE, v::RDFS_CLASS);
                self.link(iri, v::RDFS_SUB_CLASS_OF, iri);
                self.say(iri, v::IS_ABSTRACT, Object::Boolean(node.is_abstract));
                self.about(iri, name, node);
                waiting.push(iri);
            }
        }
        // The nodes that types declare, and their components.
        let mut told = BTreeSet::new();
        while let Some(iri) = waiting.pop() {
            for child in below.get(iri).into_iter().flatten() {
                let Some((child, (name, node))) = by_iri.get_key_value(child) else {
                    continue;
                };
                if is_type(node) {
                    continue;
                }
                self.link(iri, v::DECLARES, child);
                if told.insert(child) {
                    self.link(child, v::RDF_TYPE, v::NODE);
                    self.about(child, name, node);
                    waiting.push(child);
                }
            }
        }
        self.all.extend(limits.statements(&by_iri));
    }

    fn about(&mut self, iri: &str, name: &NodeName, node: &NodeSetFileNode) {
        let browse_name = node.plain_browse_name();
        self.text(iri, v::NODE_CLASS, &node.class);
        self.text(iri, v::BROWSE_NAME, browse_name);
        self.text(iri, v::NODE_NAMESPACE, &name.namespace);
        self.text(iri, v::NODE_IDENTIFIER, &name.identifier);
        self.text(iri, v::NODE_ID, &name.id());
        self.text(
            iri,
            v::RDFS_LABEL,
            if node.display_name.is_empty() {
                browse_name
            } else {
                &node.display_name
            },
        );
        if !node.description.is_empty() {
            self.text(iri, v::RDFS_COMMENT, &node.description);
        }
    }

    fn link(&mut self, subject: &str, predicate: &str, object: &str) {
        self.say(subject, predicate, Object::Iri(object.to_owned()));
    }

    fn text(&mut self, subject: &str, predicate: &str, text: &str) {
        self.say(subject, predicate, Object::Text(text.to_owned()));
    }

    fn say(&mut self, subject: &str, predicate: &str, object: Object) {
        self.all.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    }
}

fn is_type(node: &NodeSetFileNode) -> bool {
    node.class.ends_with("Type")
}

const CLASSES: &[&str] = &[
    "ObjectType",
    "VariableType",
    "DataType",
    "ReferenceType",
    "Object",
    "Variable",
    "Method",
];
const HAS_SUBTYPE: &str = "i=45";
const HAS_PROPERTY: &str = "i=46";
const HAS_COMPONENT: &str = "i=47";
const HAS_ORDERED_COMPONENT: &str = "i=49";

#[cfg(test)]
mod tests {
    use super::*;

    fn version(version: &str, date: &str) -> ModelVersion {
        ModelVersion {
            version: version.to_owned(),
            publication_date: date.to_owned(),
        }
    }

    #[test]
    fn the_model_is_read_from_the_beginning_of_a_file() {
        let text = "<UANodeSet><Models><Model ModelUri=\"urn:a\" Version=\"1\">\
            <RequiredModel ModelUri=\"urn:b\" PublicationDate=\"2022-11-03\"/></Model>\
            <Model ModelUri=\"urn:c\"><RequiredModel ModelUri=\"urn:d\"/></Model></Models><UAObj";
        let model = read_model(text).unwrap();
        assert_eq!(
            (model.namespace.as_str(), model.version),
            ("urn:a", version("1", ""))
        );
        assert_eq!(
            model.required,
            [("urn:b".to_owned(), version("", "2022-11-03"))]
        );
        assert_eq!(
            read_model("<UANodeSet><Models></Models>"),
            Err(NodeSetReadFault::NoModel)
        );
        assert!(read_model("<UANodeSet><Models>").is_err());
    }
}
