//! NodeSets (OPC 10000-6, annex F) as OWL ontologies: all nodes, references, DataTypes and values.
//!
//! Types are classes and ReferenceTypes are properties, with the IRIs that the other statements of
//! the plant have for them. A reference is a statement with its ReferenceType as the predicate;
//! HasSubtype, HasTypeDefinition and HasInterface are `rdfs:subClassOf`, `rdfs:subPropertyOf` and
//! `rdf:type`.

mod facts;
pub(crate) mod terms;
mod values;

use std::collections::HashMap;
use std::io;

use oxigraph::io::{RdfFormat, RdfSerializer};
use oxigraph::model::Triple;
use roxmltree::{Document, Node, ParsingOptions};

pub use self::facts::{
    OntologyDefinition, OntologyField, OntologyNode, OntologyReference, OntologyText,
    OntologyTextKind, OntologyValue, OwlNodeClass,
};
use self::terms::{ATTRIBUTES, OWL, OntologyWriter, PLANT, RDFS, XSD, iri, typed};
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
            findings: Vec::new(),
        };
        let mut writer = OntologyWriter::new(&NodeName::iri);
        for alias in children(root, "Aliases").flat_map(|all| children(all, "Alias")) {
            let name = alias.attribute("Alias").unwrap_or_default().to_owned();
            let id = alias.text().unwrap_or_default().trim().to_owned();
            reading.aliases.insert(name, id);
        }
        for model in models {
            write_model(&mut writer, model);
        }
        let nodes = root.children().filter_map(|node| {
            OwlNodeClass::of_element(node.tag_name().name()).map(|class| (class, node))
        });
        for (number, (class, node)) in nodes.enumerate() {
            if number >= MAX_NODES {
                let line = node.document().text_pos_at(node.range().start).row;
                return Err(NodeSetReadFault::Xml {
                    line: usize::try_from(line).unwrap_or_default(),
                    what: format!("there are more than {MAX_NODES} nodes"),
                });
            }
            if let Some(read) = reading.node_of(class, node)
                && !writer.node(&read)
            {
                let id = node.attribute("NodeId").unwrap_or_default();
                reading.find(node, format!("the namespace of `{id}` is no IRI"));
            }
        }
        Ok(Self {
            namespace: namespace.to_owned(),
            triples: writer.triples,
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
    findings: Vec<String>,
}

/// States the ontology of a model, which imports the models that it requires.
fn write_model(writer: &mut OntologyWriter<'_>, model: Node<'_, '_>) {
    let Some(uri) = model.attribute("ModelUri").and_then(iri) else {
        return;
    };
    writer.is_a(&uri, &format!("{OWL}Ontology"));
    writer.is_a(&uri, v::NODE_SET);
    if let Some(version) = model.attribute("Version") {
        writer.text(&uri, &format!("{OWL}versionInfo"), version);
        writer.text(&uri, v::MODEL_VERSION, version);
    }
    if let Some(date) = model.attribute("PublicationDate") {
        let date = typed(date, "dateTime");
        writer.say(&uri, v::PUBLICATION_DATE, date);
    }
    for required in children(model, "RequiredModel") {
        if let Some(required) = required.attribute("ModelUri").and_then(iri) {
            writer.say(&uri, &format!("{OWL}imports"), required.into());
        }
    }
}

impl Reading {
    fn node_of(&mut self, class: OwlNodeClass, node: Node<'_, '_>) -> Option<OntologyNode> {
        let id = node.attribute("NodeId").unwrap_or_default();
        let Some(name) = self.name(id) else {
            self.find(node, format!("the NodeId `{id}` is not understood"));
            return None;
        };
        let browse_name = node.attribute("BrowseName").unwrap_or_default();
        let plain = match browse_name.split_once(':') {
            Some((index, rest)) if index.bytes().all(|byte| byte.is_ascii_digit()) => rest,
            _ => browse_name,
        };
        let value = children(node, "Value").flat_map(|value| value.children());
        let value = value.into_iter().find(Node::is_element);
        Some(OntologyNode {
            class,
            name,
            browse_name: plain.to_owned(),
            texts: texts_of(node),
            data_type: node.attribute("DataType").and_then(|of| self.name(of)),
            attributes: attributes_of(node),
            references: self.references(node),
            definition: children(node, "Definition")
                .next()
                .map(|definition| self.definition(definition)),
            value: value.and_then(|value| self.value(value)),
        })
    }

    fn references(&mut self, node: Node<'_, '_>) -> Vec<OntologyReference> {
        let mut all = Vec::new();
        let references = children(node, "References");
        for reference in references.flat_map(|all| children(all, "Reference")) {
            let of = reference.attribute("ReferenceType").unwrap_or_default();
            let to = reference.text().unwrap_or_default().trim();
            let (Some(of_type), Some(target)) = (self.name(of), self.name(to)) else {
                self.find(
                    reference,
                    format!("the reference {of} to `{to}` is not understood"),
                );
                continue;
            };
            all.push(OntologyReference {
                of_type,
                is_forward: reference.attribute("IsForward") != Some("false"),
                target,
            });
        }
        all
    }

    /// Reads the fields of a structure, or the values of an enumeration.
    fn definition(&self, definition: Node<'_, '_>) -> OntologyDefinition {
        let fields = children(definition, "Field").map(|field| {
            let value = field.attribute("Value").map(str::to_owned);
            let data_type = match value {
                Some(_) => None,
                // The default of the schema is BaseDataType.
                None => self.name(field.attribute("DataType").unwrap_or("i=24")),
            };
            OntologyField {
                name: field.attribute("Name").unwrap_or_default().to_owned(),
                value,
                data_type,
                attributes: attributes_of(field),
                texts: texts_of(field),
            }
        });
        OntologyDefinition {
            is_union: definition.attribute("IsUnion") == Some("true"),
            is_option_set: definition.attribute("IsOptionSet") == Some("true"),
            fields: fields.collect(),
        }
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

    fn find(&mut self, node: Node<'_, '_>, what: String) {
        if self.findings.len() < MAX_FINDINGS {
            let line = node.document().text_pos_at(node.range().start).row;
            self.findings.push(format!("line {line}: {what}"));
        }
    }
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

/// Returns the attributes that have terms.
fn attributes_of(node: Node<'_, '_>) -> Vec<(&'static str, String)> {
    let known = ["IsAbstract", "Symmetric"].into_iter();
    let known = known.chain(ATTRIBUTES.iter().map(|(name, ..)| *name));
    let all = known.filter_map(|name| Some((name, node.attribute(name)?.to_owned())));
    all.collect()
}

fn texts_of(node: Node<'_, '_>) -> Vec<OntologyText> {
    let mut all = Vec::new();
    for (element, kind) in [
        ("DisplayName", OntologyTextKind::Label),
        ("Description", OntologyTextKind::Comment),
        ("InverseName", OntologyTextKind::Inverse),
    ] {
        all.extend(children(node, element).map(|text| OntologyText {
            kind,
            text: text.text().unwrap_or_default().to_owned(),
            locale: text.attribute("Locale").unwrap_or_default().to_owned(),
        }));
    }
    all
}

const RDF: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#";
/// Maximum number of XML elements and texts.
const MAX_ITEMS: u32 = 8_000_000;
const MAX_FINDINGS: usize = 100;
