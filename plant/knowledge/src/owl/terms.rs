//! The statements about nodes.

use std::collections::HashMap;

use mtp::escaped;
use oxigraph::model::{Literal, NamedNode, Term, Triple};

use super::facts::{
    OntologyDefinition, OntologyField, OntologyNode, OntologyReference, OntologyText,
    OntologyTextKind, OntologyValue, OwlNodeClass,
};
use crate::component::NodeName;
use crate::vocabulary as v;

/// Writes nodes as statements.
pub(crate) struct OntologyWriter<'a> {
    pub(crate) triples: Vec<Triple>,
    /// Returns the IRI of a node.
    iri_of: &'a dyn Fn(&NodeName) -> String,
    /// The predicates of ReferenceTypes.
    properties: HashMap<NodeName, Option<NamedNode>>,
}

impl<'a> OntologyWriter<'a> {
    pub(crate) fn new(iri_of: &'a dyn Fn(&NodeName) -> String) -> Self {
        Self {
            triples: Vec::new(),
            iri_of,
            properties: HashMap::new(),
        }
    }

    /// Writes a node. Returns whether its IRI is valid; nothing is written otherwise.
    pub(crate) fn node(&mut self, node: &OntologyNode) -> bool {
        let Some(subject) = self.iri(&node.name) else {
            return false;
        };
        self.is_a(
            &subject,
            &match (node.class, node.class.is_type()) {
                (OwlNodeClass::ReferenceType, _) => format!("{OWL}ObjectProperty"),
                (_, true) => format!("{OWL}Class"),
                _ => format!("{OWL}NamedIndividual"),
            },
        );
        if let Some(ontology) = iri(&node.name.namespace) {
            self.say(&subject, &format!("{RDFS}isDefinedBy"), ontology.into());
        }
        self.text(&subject, v::NODE_CLASS, node.class.name());
        self.text(&subject, v::NODE_ID, &node.name.id());
        self.text(&subject, v::BROWSE_NAME, &node.browse_name);
        self.texts(&subject, &node.texts);
        self.data_type(&subject, node.data_type.as_ref());
        self.attributes(&subject, &node.attributes);
        for reference in &node.references {
            self.reference(&subject, node.class, reference);
        }
        if let Some(definition) = &node.definition {
            self.definition(&subject, definition);
        }
        if let Some(value) = &node.value {
            self.value(&subject, value);
        }
        true
    }

    fn texts(&mut self, subject: &NamedNode, texts: &[OntologyText]) {
        for text in texts {
            let predicate = match text.kind {
                OntologyTextKind::Label => v::RDFS_LABEL,
                OntologyTextKind::Comment => v::RDFS_COMMENT,
                OntologyTextKind::Inverse => INVERSE_NAME,
            };
            self.localized(subject, predicate, (&text.text, &text.locale));
        }
    }

    fn data_type(&mut self, subject: &NamedNode, data_type: Option<&NodeName>) {
        if let Some(data_type) = data_type.and_then(|name| iri(&name.iri())) {
            self.say(subject, &format!("{PLANT}dataType"), data_type.into());
        }
    }

    fn attributes(&mut self, subject: &NamedNode, attributes: &[(&'static str, String)]) {
        for (name, value) in attributes {
            match *name {
                "IsAbstract" => self.say(subject, v::IS_ABSTRACT, typed(value, "boolean")),
                "Symmetric" if value == "true" => {
                    self.is_a(subject, &format!("{OWL}SymmetricProperty"));
                }
                name => {
                    let known = ATTRIBUTES.iter().find(|(known, ..)| *known == name);
                    if let Some((_, term, datatype)) = known {
                        self.say(subject, &format!("{PLANT}{term}"), typed(value, datatype));
                    }
                }
            }
        }
    }

    fn reference(
        &mut self,
        subject: &NamedNode,
        class: OwlNodeClass,
        reference: &OntologyReference,
    ) {
        let target = self.iri(&reference.target);
        let (Some(predicate), Some(target)) = (self.property(&reference.of_type), target) else {
            return;
        };
        let (from, to) = if reference.is_forward {
            (subject.clone(), target)
        } else {
            (target, subject.clone())
        };
        let is_property = class == OwlNodeClass::ReferenceType;
        let predicate = match predicate.as_str() {
            HAS_SUBTYPE => {
                let sub = match is_property {
                    true => SUB_PROPERTY,
                    false => v::RDFS_SUB_CLASS_OF,
                };
                // The reference leads from the supertype to the subtype.
                self.say(&to, sub, from.into());
                return;
            }
            HAS_INTERFACE if class.is_type() && !is_property => v::RDFS_SUB_CLASS_OF,
            HAS_TYPE_DEFINITION | HAS_INTERFACE => v::RDF_TYPE,
            other => other,
        };
        self.say(&from, predicate, to.into());
    }

    /// Writes the fields of a structure, or the values of an enumeration.
    fn definition(&mut self, subject: &NamedNode, definition: &OntologyDefinition) {
        for (holds, term) in [
            (definition.is_union, "isUnion"),
            (definition.is_option_set, "isOptionSet"),
        ] {
            if holds {
                self.say(subject, &format!("{PLANT}{term}"), typed("true", "boolean"));
            }
        }
        for (position, field) in (1..).zip(&definition.fields) {
            self.field(subject, position, field);
        }
    }

    fn field(&mut self, subject: &NamedNode, position: i64, field: &OntologyField) {
        let node = format!("{};{}", subject.as_str(), escaped(&field.name));
        let Some(node) = iri(&node) else {
            return;
        };
        self.say(subject, &format!("{PLANT}hasField"), node.clone().into());
        self.is_a(&node, &format!("{PLANT}Field"));
        self.text(&node, v::BROWSE_NAME, &field.name);
        self.say(&node, v::POSITION, Literal::from(position).into());
        if let Some(value) = &field.value {
            self.say(&node, v::VALUE, typed(value, "integer"));
        }
        self.data_type(&node, field.data_type.as_ref());
        self.attributes(&node, &field.attributes);
        self.texts(&node, &field.texts);
    }

    fn value(&mut self, subject: &NamedNode, value: &OntologyValue) {
        match value {
            OntologyValue::Text(text) => self.text(subject, v::VALUE, text),
            OntologyValue::Localized { text, locale } => {
                self.localized(subject, v::VALUE, (text, locale));
            }
            OntologyValue::Typed(text, datatype) => {
                self.say(subject, v::VALUE, typed(text, datatype));
            }
            OntologyValue::Node(name) => match self.iri(name) {
                Some(node) => self.say(subject, v::VALUE, node.into()),
                None => self.text(subject, v::VALUE, &name.id()),
            },
            OntologyValue::Json(json) => self.text(subject, v::VALUE_JSON, &json.to_string()),
        }
    }

    fn iri(&self, name: &NodeName) -> Option<NamedNode> {
        iri(&(self.iri_of)(name))
    }

    fn property(&mut self, name: &NodeName) -> Option<NamedNode> {
        if let Some(known) = self.properties.get(name) {
            return known.clone();
        }
        let property = iri(&name.iri());
        self.properties.insert(name.clone(), property.clone());
        property
    }

    pub(crate) fn is_a(&mut self, subject: &NamedNode, class: &str) {
        let class = NamedNode::new_unchecked(class);
        self.say(subject, v::RDF_TYPE, class.into());
    }

    pub(crate) fn text(&mut self, subject: &NamedNode, predicate: &str, text: &str) {
        let text = Literal::new_simple_literal(text);
        self.say(subject, predicate, text.into());
    }

    fn localized(&mut self, subject: &NamedNode, predicate: &str, (text, locale): (&str, &str)) {
        let tagged = Literal::new_language_tagged_literal(text, locale);
        let literal = tagged.unwrap_or_else(|_| Literal::new_simple_literal(text));
        self.say(subject, predicate, literal.into());
    }

    pub(crate) fn say(&mut self, subject: &NamedNode, predicate: &str, object: Term) {
        let predicate = NamedNode::new_unchecked(predicate);
        self.triples
            .push(Triple::new(subject.clone(), predicate, object));
    }
}

pub(crate) fn iri(text: &str) -> Option<NamedNode> {
    NamedNode::new(text).ok()
}

pub(crate) fn typed(value: &str, datatype: &str) -> Term {
    let datatype = NamedNode::new_unchecked(format!("{XSD}{datatype}"));
    Literal::new_typed_literal(value, datatype).into()
}

pub(super) const OWL: &str = "http://www.w3.org/2002/07/owl#";
pub(super) const RDFS: &str = "http://www.w3.org/2000/01/rdf-schema#";
pub(super) const XSD: &str = "http://www.w3.org/2001/XMLSchema#";
pub(super) const PLANT: &str = "urn:ua-bridge:plant#";
const INVERSE_NAME: &str = "urn:ua-bridge:plant#inverseName";
const SUB_PROPERTY: &str = "http://www.w3.org/2000/01/rdf-schema#subPropertyOf";
const HAS_SUBTYPE: &str = "http://opcfoundation.org/UA/#i=45";
const HAS_TYPE_DEFINITION: &str = "http://opcfoundation.org/UA/#i=40";
const HAS_INTERFACE: &str = "http://opcfoundation.org/UA/#i=17603";

/// Attributes of nodes and fields, their terms, and their datatypes.
pub(super) const ATTRIBUTES: [(&str, &str, &str); 16] = [
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
