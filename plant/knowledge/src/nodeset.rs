//! NodeSets (OPC 10000-6, annex F) as statements: types, their supertypes, and the nodes that types
//! declare.
//!
//! HasSubtype references become direct `rdfs:subClassOf` statements; the rule of the store derives
//! the indirect statements.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use mtp::{Object, Triple, escaped};
use quick_xml::XmlVersion;
use quick_xml::escape::resolve_predefined_entity;
use quick_xml::events::attributes::AttrError;
use quick_xml::events::{BytesStart, Event};
use quick_xml::reader::Reader;
use thiserror::Error;

use crate::component::{NodeName, OPC_UA};
use crate::vocabulary as v;

/// The contents of a NodeSet.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeSetContents {
    /// Its model.
    pub model: NodeSetModel,
    /// Its statements.
    pub triples: Vec<Triple>,
}

/// The model of a NodeSet.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetModel {
    /// Its URI, which is that of its namespace.
    pub namespace: String,
    /// Its version.
    pub version: ModelVersion,
    /// The models that it requires, with the oldest versions that suffice.
    pub required: Vec<(String, ModelVersion)>,
}

/// The version of a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModelVersion {
    /// The version for people; empty if unknown.
    pub version: String,
    /// The date as in the file; empty if unknown.
    pub publication_date: String,
}

impl ModelVersion {
    /// Returns whether this version is older than another version: by the dates if both are known,
    /// otherwise by the numbers of the versions. `false` if that cannot be decided.
    #[must_use]
    pub fn is_older_than(&self, other: &Self) -> bool {
        match (self.day(), other.day()) {
            (Some(own), Some(other)) => own < other,
            _ => match (self.numbers(), other.numbers()) {
                (Some(own), Some(other)) => own < other,
                _ => false,
            },
        }
    }

    /// Returns the date without the time, as `2022-11-03`.
    fn day(&self) -> Option<&str> {
        let day = self.publication_date.trim().get(..10)?;
        let is_date = day.bytes().enumerate().all(|(at, byte)| match at {
            4 | 7 => byte == b'-',
            _ => byte.is_ascii_digit(),
        });
        is_date.then_some(day)
    }

    fn numbers(&self) -> Option<Vec<u32>> {
        let parts = self.version.trim().split('.');
        let mut numbers: Vec<u32> = parts.map(|part| part.parse().ok()).collect::<Option<_>>()?;
        while numbers.last() == Some(&0) {
            numbers.pop();
        }
        Some(numbers)
    }
}

impl fmt::Display for ModelVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.version.trim(), self.day()) {
            ("", None) => f.write_str("unknown version"),
            ("", Some(day)) => write!(f, "version of {day}"),
            (version, None) => write!(f, "version {version}"),
            (version, Some(day)) => write!(f, "version {version} of {day}"),
        }
    }
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

/// Reads the text of a NodeSet2 file.
///
/// # Errors
/// [`NodeSetReadFault`].
pub fn read(xml: &str) -> Result<NodeSetContents, NodeSetReadFault> {
    let reading = parsed(xml, NodeSetExtent::Whole)?;
    reading.finish().ok_or(NodeSetReadFault::NoModel)
}

/// Reads the model of a NodeSet2 file, from a text that may end behind its models.
///
/// # Errors
/// [`NodeSetReadFault`].
pub fn read_model(xml: &str) -> Result<NodeSetModel, NodeSetReadFault> {
    let reading = parsed(xml, NodeSetExtent::Models)?;
    let model = reading.model.filter(|model| !model.namespace.is_empty());
    model.ok_or(NodeSetReadFault::NoModel)
}

/// The part of a file that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NodeSetExtent {
    Whole,
    /// All until the end of the models.
    Models,
}

fn parsed(xml: &str, extent: NodeSetExtent) -> Result<Reading, NodeSetReadFault> {
    if xml.len() > MAX_FILE {
        return Err(NodeSetReadFault::TooLarge {
            length: xml.len(),
            most: MAX_FILE,
        });
    }
    let xml = xml.trim_start_matches('\u{feff}');
    let mut reader = Reader::from_str(xml);
    reader.config_mut().expand_empty_elements = true;
    let mut reading = Reading::default();
    loop {
        let event = reader.read_event();
        let fault = |what: String| NodeSetReadFault::Xml {
            line: line(xml, reader.buffer_position()),
            what,
        };
        match event.map_err(|error| fault(error.to_string()))? {
            Event::Start(start) => reading
                .open(&start)
                .map_err(|error| fault(error.to_string()))?,
            Event::End(_) => {
                reading.close();
                let is_behind = reading.open.len() == 1 && reading.closed == "Models";
                if is_behind && extent == NodeSetExtent::Models {
                    break;
                }
            }
            Event::Text(text) => reading.text.push_str(&text.xml10_content()),
            Event::CData(text) => reading.text.push_str(&text.xml10_content()),
            Event::GeneralRef(reference) => {
                let name = reference.xml10_content();
                match (
                    reference.resolve_char_ref().ok().flatten(),
                    resolve_predefined_entity(&name),
                ) {
                    (Some(character), _) => reading.text.push(character),
                    (None, Some(text)) => reading.text.push_str(text),
                    (None, None) => return Err(fault(format!("XML has no entity &{name};"))),
                }
            }
            Event::DocType(_) => {
                return Err(fault(
                    "a NodeSet has no document type; remove the <!DOCTYPE ..>".to_owned(),
                ));
            }
            Event::Eof if reading.open.is_empty() => break,
            Event::Eof => return Err(fault("the file ends in the middle".to_owned())),
            Event::Empty(_) | Event::Comment(_) | Event::Decl(_) | Event::PI(_) => {}
        }
    }
    Ok(reading)
}

#[derive(Debug, Default)]
struct Reading {
    /// The names of the open elements.
    open: Vec<String>,
    /// The name of the element that was closed last.
    closed: String,
    text: String,
    namespaces: Vec<String>,
    aliases: BTreeMap<String, String>,
    model: Option<NodeSetModel>,
    /// Whether the first model, which is that of the file, is open.
    is_first_model: bool,
    nodes: Vec<UaNode>,
    alias: String,
    reference: (String, bool),
}

#[derive(Debug, Default)]
struct UaNode {
    class: String,
    id: String,
    browse_name: String,
    is_abstract: bool,
    label: String,
    comment: String,
    /// Reference type, whether forward, target; as written.
    references: Vec<(String, bool, String)>,
}

/// Reason for which an element of a NodeSet cannot be read.
#[derive(Debug, Error)]
enum NodeFault {
    #[error("elements nest more than {0} deep")]
    Depth(usize),
    #[error("there are more than {0} nodes")]
    Number(usize),
    #[error("the model requires more than {0} models")]
    Required(usize),
    #[error(transparent)]
    Attribute(#[from] AttrError),
    #[error(transparent)]
    Value(#[from] quick_xml::Error),
}

impl Reading {
    fn open(&mut self, start: &BytesStart<'_>) -> Result<(), NodeFault> {
        if self.open.len() >= MAX_DEPTH {
            return Err(NodeFault::Depth(MAX_DEPTH));
        }
        let text = |name: &str| -> Result<String, NodeFault> {
            let Some(attribute) = start.try_get_attribute(name)? else {
                return Ok(String::new());
            };
            let value = attribute.normalized_value(XmlVersion::Implicit1_0)?;
            Ok(value.into_owned())
        };
        let version = || -> Result<ModelVersion, NodeFault> {
            Ok(ModelVersion {
                version: text("Version")?,
                publication_date: text("PublicationDate")?,
            })
        };
        let name = start.local_name().into_inner().to_owned();
        match (self.open.len(), name.as_str()) {
            (1, class) if CLASSES.contains(&class) => {
                if self.nodes.len() >= MAX_NODES {
                    return Err(NodeFault::Number(MAX_NODES));
                }
                self.nodes.push(UaNode {
                    class: class.trim_start_matches("UA").to_owned(),
                    id: text("NodeId")?,
                    browse_name: text("BrowseName")?,
                    is_abstract: text("IsAbstract")? == "true",
                    ..UaNode::default()
                });
            }
            (2, "Model") => self.model(text("ModelUri")?, version()?),
            (3, "RequiredModel") => self.required(text("ModelUri")?, version()?)?,
            (2, "Alias") => self.alias = text("Alias")?,
            (3, "Reference") => {
                self.reference = (text("ReferenceType")?, text("IsForward")? != "false")
            }
            _ => {}
        }
        self.text.clear();
        self.open.push(name);
        Ok(())
    }

    /// Adds a model. The first model of a file describes the file.
    fn model(&mut self, namespace: String, version: ModelVersion) {
        self.is_first_model = self.model.is_none();
        if self.is_first_model {
            self.model = Some(NodeSetModel {
                namespace,
                version,
                required: Vec::new(),
            });
        }
    }

    fn required(&mut self, namespace: String, version: ModelVersion) -> Result<(), NodeFault> {
        let is_read = self.is_first_model && !namespace.is_empty();
        let Some(model) = self.model.as_mut().filter(|_| is_read) else {
            return Ok(());
        };
        if model.required.len() >= MAX_REQUIRED {
            return Err(NodeFault::Required(MAX_REQUIRED));
        }
        model.required.push((namespace, version));
        Ok(())
    }

    fn close(&mut self) {
        let path: Vec<&str> = self.open.iter().map(String::as_str).collect();
        let text = self.text.trim();
        match path.as_slice() {
            ["UANodeSet", "NamespaceUris", "Uri"] => self.namespaces.push(text.to_owned()),
            ["UANodeSet", "Aliases", "Alias"] => {
                drop(self.aliases.insert(self.alias.clone(), text.to_owned()))
            }
            ["UANodeSet", _, "References", "Reference"] => {
                let (reference, is_forward) = self.reference.clone();
                if let Some(node) = self.nodes.last_mut() {
                    node.references
                        .push((reference, is_forward, text.to_owned()));
                }
            }
            ["UANodeSet", class, "DisplayName"] if CLASSES.contains(class) => {
                if let Some(node) = self.nodes.last_mut().filter(|node| node.label.is_empty()) {
                    text.clone_into(&mut node.label);
                }
            }
            ["UANodeSet", class, "Description"] if CLASSES.contains(class) => {
                if let Some(node) = self.nodes.last_mut().filter(|node| node.comment.is_empty()) {
                    text.clone_into(&mut node.comment);
                }
            }
            _ => {}
        }
        self.text.clear();
        self.closed = self.open.pop().unwrap_or_default();
    }

    /// Resolves a node from its notation in the file, with an alias or an index of the namespace
    /// table.
    fn node(&self, written: &str) -> Option<NodeName> {
        let written = self.aliases.get(written).map_or(written, String::as_str);
        let (namespace, identifier) = match written.strip_prefix("ns=") {
            Some(rest) => {
                let (index, identifier) = rest.split_once(';')?;
                (self.namespace(index.parse().ok()?)?, identifier)
            }
            None => (OPC_UA, written),
        };
        identifier.contains('=').then(|| NodeName {
            namespace: namespace.to_owned(),
            identifier: identifier.to_owned(),
        })
    }

    fn namespace(&self, index: usize) -> Option<&str> {
        match index.checked_sub(1) {
            None => Some(OPC_UA),
            Some(index) => self.namespaces.get(index).map(String::as_str),
        }
    }

    fn finish(self) -> Option<NodeSetContents> {
        let model = self.model.clone();
        let model = model.filter(|model| !model.namespace.is_empty())?;
        let mut graph = Graph {
            reading: &self,
            all: Vec::new(),
        };
        let iri = model_iri(&model.namespace);
        graph.link(&iri, v::RDF_TYPE, v::NODE_SET);
        graph.text(&iri, v::RDFS_LABEL, &model.namespace);
        if !model.version.version.is_empty() {
            graph.text(&iri, v::MODEL_VERSION, &model.version.version);
        }
        let date = model.version.publication_date.trim();
        if !date.is_empty() {
            let date = match date.contains('T') {
                true => Object::Time(date.to_owned()),
                false => Object::Text(date.to_owned()),
            };
            graph.say(&iri, v::PUBLICATION_DATE, date);
        }
        graph.nodes();
        let triples = graph.all;
        Some(NodeSetContents { model, triples })
    }
}

struct Graph<'a> {
    reading: &'a Reading,
    all: Vec<Triple>,
}

impl Graph<'_> {
    fn nodes(&mut self) {
        let reading = self.reading;
        let mut below: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        let mut by_iri = BTreeMap::new();
        for node in &reading.nodes {
            let Some(name) = reading.node(&node.id) else {
                continue;
            };
            let iri = name.iri();
            for (reference, is_forward, target) in &node.references {
                let (Some(reference), Some(target)) =
                    (reading.node(reference), reading.node(target))
                else {
                    continue;
                };
                let target = target.iri();
                let (from, to) = if *is_forward {
                    (iri.clone(), target)
                } else {
                    (target, iri.clone())
                };
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
            if node.is_type() {
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
                if node.is_type() {
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
    }

    fn about(&mut self, iri: &str, name: &NodeName, node: &UaNode) {
        let browse_name = match node.browse_name.split_once(':') {
            Some((index, rest)) if index.bytes().all(|byte| byte.is_ascii_digit()) => rest,
            _ => &node.browse_name,
        };
        self.text(iri, v::NODE_CLASS, &node.class);
        self.text(iri, v::BROWSE_NAME, browse_name);
        self.text(iri, v::NODE_NAMESPACE, &name.namespace);
        self.text(iri, v::NODE_IDENTIFIER, &name.identifier);
        self.text(iri, v::NODE_ID, &name.id());
        self.text(
            iri,
            v::RDFS_LABEL,
            if node.label.is_empty() {
                browse_name
            } else {
                &node.label
            },
        );
        if !node.comment.is_empty() {
            self.text(iri, v::RDFS_COMMENT, &node.comment);
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

/// Returns the IRI of the model of a namespace.
pub(crate) fn model_iri(namespace: &str) -> String {
    format!("urn:ua-bridge:nodeset:{}", escaped(namespace))
}

impl UaNode {
    fn is_type(&self) -> bool {
        self.class.ends_with("Type")
    }
}

fn line(file: &str, position: u64) -> usize {
    let position = usize::try_from(position)
        .unwrap_or(usize::MAX)
        .min(file.len());
    let before = file.as_bytes().get(..position).unwrap_or_default();
    before.iter().filter(|byte| **byte == b'\n').count() + 1
}

const CLASSES: &[&str] = &[
    "UAObjectType",
    "UAVariableType",
    "UADataType",
    "UAReferenceType",
    "UAObject",
    "UAVariable",
    "UAMethod",
];
const HAS_SUBTYPE: &str = "i=45";
const HAS_PROPERTY: &str = "i=46";
const HAS_COMPONENT: &str = "i=47";
const HAS_ORDERED_COMPONENT: &str = "i=49";

/// The largest published file has 13 MB.
pub(crate) const MAX_FILE: usize = 64 << 20;
const MAX_DEPTH: usize = 64;
const MAX_REQUIRED: usize = 256;
pub(crate) const MAX_NODES: usize = 200_000;

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
    fn versions_are_compared_by_their_dates_and_then_by_their_numbers() {
        let of_2021 = version("2.0", "2021-05-20T00:00:00Z");
        let of_2022 = version("1.04.0", "2022-11-03T00:00:00.000Z");
        assert!(of_2021.is_older_than(&of_2022));
        assert!(!of_2022.is_older_than(&of_2021));
        assert!(
            !of_2022.is_older_than(&version("", "2022-11-03")),
            "the same day"
        );
        assert!(version("1.9", "").is_older_than(&version("1.10.0", "2022-11-03")));
        assert!(!version("1.4", "").is_older_than(&version("1.04.0", "")));
        for unknown in [version("", ""), version("beta", "soon")] {
            assert!(!unknown.is_older_than(&of_2022) && !of_2022.is_older_than(&unknown));
        }
        assert_eq!(of_2022.to_string(), "version 1.04.0 of 2022-11-03");
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
