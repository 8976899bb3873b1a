//! NodeSets (OPC 10000-6, annex F) as OWL ontologies: all nodes, references, DataTypes and values.
//!
//! Types are classes and ReferenceTypes are properties, with the IRIs that the other statements of
//! the plant have for them. A reference is a statement with its ReferenceType as the predicate;
//! HasSubtype, HasTypeDefinition and HasInterface are `rdfs:subClassOf`, `rdfs:subPropertyOf` and
//! `rdf:type`.

mod values;

use std::collections::HashMap;
use std::io;

use mtp::escaped;
use oxigraph::io::{RdfFormat, RdfSerializer};
use oxigraph::model::{Literal, NamedNode, Term, Triple};
use roxmltree::{Document, Node, ParsingOptions};

use crate::component::{NodeName, OPC_UA};
use crate::nodeset::{MAX_FILE, MAX_NODES, NodeSetReadFault};
use crate::vocabulary as v;

/// A NodeSet as an ontology.
#[derive(Debug, Clone)]
pub struct Ontology {
    /// The URI of its model, which is the IRI of the ontology.
    pub namespace: String,
    /// Its statements, in the order of the file.
    pub triples: Vec<Triple>,
    /// Nodes and references that cannot be read, with their lines.
    pub findings: Vec<String>,
}

impl Ontology {
    /// Reads the text of a NodeSet2 file.
    ///
    /// # Errors
    /// [`NodeSetReadFault`].
    pub fn read(xml: &str) -> Result<Self, NodeSetReadFault> {
        if xml.len() > MAX_FILE {
            return Err(NodeSetReadFault::TooLarge {
                length: xml.len(),
                most: MAX_FILE,
            });
        }
        let options = ParsingOptions {
            nodes_limit: MAX_ITEMS,
            ..ParsingOptions::default()
        };
        let document =
            Document::parse_with_options(xml, options).map_err(|fault| NodeSetReadFault::Xml {
                line: usize::try_from(fault.pos().row).unwrap_or_default(),
                what: fault.to_string(),
            })?;
        let root = document.root_element();
        let models = children(root, "Models").flat_map(|models| children(models, "Model"));
        let models: Vec<Node<'_, '_>> = models.collect();
        let model = models.first().and_then(|model| model.attribute("ModelUri"));
        let (true, Some(namespace)) = (root.tag_name().name() == "UANodeSet", model) else {
            return Err(NodeSetReadFault::NoModel);
        };
        let mut reading = Reading {
            namespaces: texts(root, "NamespaceUris", "Uri"),
            aliases: HashMap::new(),
            properties: HashMap::new(),
            triples: Vec::new(),
            findings: Vec::new(),
        };
        for alias in children(root, "Aliases").flat_map(|all| children(all, "Alias")) {
            let name = alias.attribute("Alias").unwrap_or_default().to_owned();
            let id = alias.text().unwrap_or_default().trim().to_owned();
            reading.aliases.insert(name, id);
        }
        for model in models {
            reading.model(model);
        }
        let nodes = root
            .children()
            .filter(|node| CLASSES.contains(&node.tag_name().name()));
        for (number, node) in nodes.enumerate() {
            if number >= MAX_NODES {
                let line = node.document().text_pos_at(node.range().start).row;
                return Err(NodeSetReadFault::Xml {
                    line: usize::try_from(line).unwrap_or_default(),
                    what: format!("there are more than {MAX_NODES} nodes"),
                });
            }
            reading.node_of(node);
        }
        Ok(Self {
            namespace: namespace.to_owned(),
            triples: reading.triples,
            findings: reading.findings,
        })
    }

    /// Writes the ontology as Turtle.
    ///
    /// # Errors
    /// The error of the output.
    pub fn write_turtle(&self, out: impl io::Write) -> io::Result<()> {
        let mut serializer = RdfSerializer::from_format(RdfFormat::Turtle);
        for (prefix, iri) in [
            ("owl", OWL),
            ("rdf", RDF),
            ("rdfs", RDFS),
            ("ua", PLANT),
            ("xsd", XSD),
            ("opc", "http://opcfoundation.org/UA/#"),
        ] {
            serializer = serializer
                .with_prefix(prefix, iri)
                .map_err(io::Error::other)?;
        }
        let mut writer = serializer.for_writer(out);
        for triple in &self.triples {
            writer.serialize_triple(triple)?;
        }
        writer.finish().map(drop)
    }
}

struct Reading {
    namespaces: Vec<String>,
    aliases: HashMap<String, String>,
    /// The predicates of ReferenceTypes, by their NodeId as written.
    properties: HashMap<String, Option<NamedNode>>,
    triples: Vec<Triple>,
    findings: Vec<String>,
}

impl Reading {
    /// States the ontology of a model, which imports the models that it requires.
    fn model(&mut self, model: Node<'_, '_>) {
        let Some(uri) = model.attribute("ModelUri").and_then(iri) else {
            return;
        };
        self.is_a(&uri, &format!("{OWL}Ontology"));
        self.is_a(&uri, v::NODE_SET);
        if let Some(version) = model.attribute("Version") {
            self.text(&uri, &format!("{OWL}versionInfo"), version);
            self.text(&uri, v::MODEL_VERSION, version);
        }
        if let Some(date) = model.attribute("PublicationDate") {
            let date = typed(date, "dateTime");
            self.say(&uri, v::PUBLICATION_DATE, date);
        }
        for required in children(model, "RequiredModel") {
            if let Some(required) = required.attribute("ModelUri").and_then(iri) {
                self.say(&uri, &format!("{OWL}imports"), required.into());
            }
        }
    }

    fn node_of(&mut self, node: Node<'_, '_>) {
        let class = node.tag_name().name().trim_start_matches("UA");
        let id = node.attribute("NodeId").unwrap_or_default();
        let Some(name) = self.name(id) else {
            self.find(node, format!("the NodeId `{id}` is not understood"));
            return;
        };
        let Ok(subject) = NamedNode::new(name.iri()) else {
            self.find(node, format!("the namespace of `{id}` is no IRI"));
            return;
        };
        let is_class = matches!(class, "ObjectType" | "VariableType" | "DataType");
        let is_property = class == "ReferenceType";
        self.is_a(
            &subject,
            &match (is_class, is_property) {
                (true, _) => format!("{OWL}Class"),
                (_, true) => format!("{OWL}ObjectProperty"),
                _ => format!("{OWL}NamedIndividual"),
            },
        );
        let ontology = iri(&name.namespace);
        if let Some(ontology) = ontology {
            self.say(&subject, &format!("{RDFS}isDefinedBy"), ontology.into());
        }
        self.text(&subject, v::NODE_CLASS, class);
        self.text(&subject, v::NODE_ID, &name.id());
        self.attributes(&subject, node);
        let kind = match (is_class, is_property) {
            (true, _) => Kind::Class,
            (_, true) => Kind::Property,
            _ => Kind::Individual,
        };
        self.references(&subject, kind, node);
        for definition in children(node, "Definition") {
            self.definition(&subject, definition);
        }
        for value in children(node, "Value").flat_map(|value| value.children()) {
            if value.is_element() {
                self.value(&subject, value);
            }
        }
    }

    fn attributes(&mut self, subject: &NamedNode, node: Node<'_, '_>) {
        let browse_name = node.attribute("BrowseName").unwrap_or_default();
        let plain = match browse_name.split_once(':') {
            Some((index, rest)) if index.bytes().all(|byte| byte.is_ascii_digit()) => rest,
            _ => browse_name,
        };
        self.text(subject, v::BROWSE_NAME, plain);
        for (element, predicate) in [
            ("DisplayName", v::RDFS_LABEL.to_owned()),
            ("Description", v::RDFS_COMMENT.to_owned()),
            ("InverseName", format!("{PLANT}inverseName")),
        ] {
            for text in children(node, element) {
                let locale = text.attribute("Locale").unwrap_or_default();
                self.localized(
                    subject,
                    &predicate,
                    (text.text().unwrap_or_default(), locale),
                );
            }
        }
        let mut symmetric = false;
        for attribute in node.attributes() {
            let value = attribute.value();
            match attribute.name() {
                "DataType" => {
                    if let Some(name) = self.name(value)
                        && let Ok(data_type) = NamedNode::new(name.iri())
                    {
                        self.say(subject, &format!("{PLANT}dataType"), data_type.into());
                    }
                }
                "IsAbstract" => self.say(subject, v::IS_ABSTRACT, typed(value, "boolean")),
                "Symmetric" => symmetric = value == "true",
                name => {
                    let known = ATTRIBUTES.iter().find(|(known, ..)| *known == name);
                    if let Some((_, term, datatype)) = known {
                        self.say(subject, &format!("{PLANT}{term}"), typed(value, datatype));
                    }
                }
            }
        }
        if symmetric {
            self.is_a(subject, &format!("{OWL}SymmetricProperty"));
        }
    }

    fn references(&mut self, subject: &NamedNode, kind: Kind, node: Node<'_, '_>) {
        let references = children(node, "References");
        for reference in references.flat_map(|all| children(all, "Reference")) {
            let of = reference.attribute("ReferenceType").unwrap_or_default();
            let to = reference.text().unwrap_or_default().trim();
            let is_forward = reference.attribute("IsForward") != Some("false");
            let target = self.name(to);
            let target = target.and_then(|name| NamedNode::new(name.iri()).ok());
            let (Some(predicate), Some(target)) = (self.property(of), target) else {
                self.find(
                    reference,
                    format!("the reference {of} to `{to}` is not understood"),
                );
                continue;
            };
            let (from, to) = if is_forward {
                (subject.clone(), target)
            } else {
                (target, subject.clone())
            };
            let predicate = match (predicate.as_str(), kind) {
                (HAS_SUBTYPE, _) => {
                    let sub = match kind {
                        Kind::Property => format!("{RDFS}subPropertyOf"),
                        Kind::Class | Kind::Individual => v::RDFS_SUB_CLASS_OF.to_owned(),
                    };
                    // The reference leads from the supertype to the subtype.
                    self.say(&to, &sub, from.into());
                    continue;
                }
                (HAS_INTERFACE, Kind::Class) => v::RDFS_SUB_CLASS_OF,
                (HAS_TYPE_DEFINITION, _) | (HAS_INTERFACE, _) => v::RDF_TYPE,
                (other, _) => other,
            };
            self.say(&from, predicate, to.into());
        }
    }

    /// States the fields of a structure, or the values of an enumeration.
    fn definition(&mut self, subject: &NamedNode, definition: Node<'_, '_>) {
        if definition.attribute("IsUnion") == Some("true") {
            self.say(
                subject,
                &format!("{PLANT}isUnion"),
                typed("true", "boolean"),
            );
        }
        if definition.attribute("IsOptionSet") == Some("true") {
            self.say(
                subject,
                &format!("{PLANT}isOptionSet"),
                typed("true", "boolean"),
            );
        }
        for (position, field) in (1..).zip(children(definition, "Field")) {
            let name = field.attribute("Name").unwrap_or_default();
            let node = NamedNode::new(format!("{};{}", subject.as_str(), escaped(name)));
            let Ok(node) = node else {
                continue;
            };
            self.say(subject, &format!("{PLANT}hasField"), node.clone().into());
            self.is_a(&node, &format!("{PLANT}Field"));
            self.text(&node, v::BROWSE_NAME, name);
            let position: i64 = position;
            self.say(&node, v::POSITION, Literal::from(position).into());
            if let Some(value) = field.attribute("Value") {
                self.say(&node, v::VALUE, typed(value, "integer"));
            } else {
                // The default of the schema is BaseDataType.
                let of = field.attribute("DataType").unwrap_or("i=24");
                if let Some(of) = self.name(of)
                    && let Ok(of) = NamedNode::new(of.iri())
                {
                    self.say(&node, &format!("{PLANT}dataType"), of.into());
                }
            }
            for (attribute, term, datatype) in ATTRIBUTES {
                if let Some(value) = field.attribute(attribute) {
                    self.say(&node, &format!("{PLANT}{term}"), typed(value, datatype));
                }
            }
            for (element, predicate) in [
                ("DisplayName", v::RDFS_LABEL),
                ("Description", v::RDFS_COMMENT),
            ] {
                for text in children(field, element) {
                    let locale = text.attribute("Locale").unwrap_or_default();
                    self.localized(&node, predicate, (text.text().unwrap_or_default(), locale));
                }
            }
        }
    }

    fn property(&mut self, written: &str) -> Option<NamedNode> {
        if let Some(known) = self.properties.get(written) {
            return known.clone();
        }
        let name = self.name(written);
        let property = name.and_then(|name| NamedNode::new(name.iri()).ok());
        self.properties.insert(written.to_owned(), property.clone());
        property
    }

    /// Returns the name of a node by its NodeId or alias.
    fn name(&self, written: &str) -> Option<NodeName> {
        let written = self.aliases.get(written).map_or(written, String::as_str);
        let (namespace, identifier) = match written.strip_prefix("ns=") {
            Some(rest) => {
                let (index, identifier) = rest.split_once(';')?;
                let index: usize = index.parse().ok()?;
                let namespace = match index.checked_sub(1) {
                    None => OPC_UA,
                    Some(index) => self.namespaces.get(index)?,
                };
                (namespace, identifier)
            }
            None => (OPC_UA, written),
        };
        identifier.contains('=').then(|| NodeName {
            namespace: namespace.to_owned(),
            identifier: identifier.to_owned(),
        })
    }

    fn is_a(&mut self, subject: &NamedNode, class: &str) {
        let class = NamedNode::new_unchecked(class);
        self.say(subject, v::RDF_TYPE, class.into());
    }

    fn text(&mut self, subject: &NamedNode, predicate: &str, text: &str) {
        let text = Literal::new_simple_literal(text);
        self.say(subject, predicate, text.into());
    }

    fn localized(&mut self, subject: &NamedNode, predicate: &str, (text, locale): (&str, &str)) {
        let tagged = Literal::new_language_tagged_literal(text, locale);
        let literal = tagged.unwrap_or_else(|_| Literal::new_simple_literal(text));
        self.say(subject, predicate, literal.into());
    }

    fn say(&mut self, subject: &NamedNode, predicate: &str, object: Term) {
        let predicate = NamedNode::new_unchecked(predicate);
        self.triples
            .push(Triple::new(subject.clone(), predicate, object));
    }

    fn find(&mut self, node: Node<'_, '_>, what: String) {
        if self.findings.len() < MAX_FINDINGS {
            let line = node.document().text_pos_at(node.range().start).row;
            self.findings.push(format!("line {line}: {what}"));
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Class,
    Property,
    Individual,
}

fn children<'a, 'i: 'a>(
    node: Node<'a, 'i>,
    name: &'a str,
) -> impl Iterator<Item = Node<'a, 'i>> + 'a {
    node.children()
        .filter(move |child| child.is_element() && child.tag_name().name() == name)
}

fn texts(root: Node<'_, '_>, list: &str, name: &str) -> Vec<String> {
    let mut all = Vec::new();
    for list in children(root, list) {
        let found = children(list, name);
        all.extend(found.map(|text| text.text().unwrap_or_default().trim().to_owned()));
    }
    all
}

fn iri(text: &str) -> Option<NamedNode> {
    NamedNode::new(text).ok()
}

fn typed(value: &str, datatype: &str) -> Term {
    let datatype = NamedNode::new_unchecked(format!("{XSD}{datatype}"));
    Literal::new_typed_literal(value, datatype).into()
}

const OWL: &str = "http://www.w3.org/2002/07/owl#";
const RDF: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#";
const RDFS: &str = "http://www.w3.org/2000/01/rdf-schema#";
const XSD: &str = "http://www.w3.org/2001/XMLSchema#";
const PLANT: &str = "urn:ua-bridge:plant#";
const HAS_SUBTYPE: &str = "http://opcfoundation.org/UA/#i=45";
const HAS_TYPE_DEFINITION: &str = "http://opcfoundation.org/UA/#i=40";
const HAS_INTERFACE: &str = "http://opcfoundation.org/UA/#i=17603";

const CLASSES: [&str; 8] = [
    "UADataType",
    "UAMethod",
    "UAObject",
    "UAObjectType",
    "UAReferenceType",
    "UAVariable",
    "UAVariableType",
    "UAView",
];

/// Attributes of nodes and fields, their terms, and their datatypes.
const ATTRIBUTES: [(&str, &str, &str); 16] = [
    ("AccessLevel", "accessLevel", "integer"),
    ("AllowSubTypes", "allowSubTypes", "boolean"),
    ("ArrayDimensions", "arrayDimensions", "string"),
    ("ContainsNoLoops", "containsNoLoops", "boolean"),
    ("EventNotifier", "eventNotifier", "integer"),
    ("Executable", "executable", "boolean"),
    ("Historizing", "historizing", "boolean"),
    ("IsOptional", "isOptional", "boolean"),
    ("MaxStringLength", "maxStringLength", "integer"),
    (
        "MinimumSamplingInterval",
        "minimumSamplingInterval",
        "double",
    ),
    ("ReleaseStatus", "releaseStatus", "string"),
    ("SymbolicName", "symbolicName", "string"),
    ("UserAccessLevel", "userAccessLevel", "integer"),
    ("UserExecutable", "userExecutable", "boolean"),
    ("ValueRank", "valueRank", "integer"),
    ("WriteMask", "writeMask", "integer"),
];
/// Maximum number of XML elements and texts.
const MAX_ITEMS: u32 = 8_000_000;
const MAX_FINDINGS: usize = 100;
