//! Facts about a component, a server with skills, as statements.

use mtp::{Object, Triple, escaped};

use crate::vocabulary as v;

/// A component as described by its server. Plain data, independent of the way it was read.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ComponentFacts {
    /// Its ApplicationUri, which is also its IRI.
    pub application_uri: String,
    /// Its name.
    pub name: String,
    /// Endpoint of its server.
    pub endpoint: String,
    /// Its number in the space.
    pub namespace: Option<u16>,
    /// Its skills.
    pub skills: Vec<SkillFacts>,
}

/// A skill.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SkillFacts {
    /// Its name.
    pub name: String,
    /// Its number within the component: 1, 2, ...
    pub number: Option<u32>,
    /// Its node.
    pub node: NodeName,
    /// Its type, followed by the supertypes in order.
    pub types: Vec<TypeFacts>,
    /// The classes of capability that it realises, as IRIs.
    pub capabilities: Vec<String>,
    /// Its input and output parameters.
    pub parameters: Vec<ParameterFacts>,
}

/// A type of nodes.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TypeFacts {
    /// Its node.
    pub node: NodeName,
    /// Its BrowseName.
    pub browse_name: String,
}

/// A parameter of a skill.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParameterFacts {
    /// Its name.
    pub name: String,
    /// Whether it is an output of the skill.
    pub is_output: bool,
    /// The name of its DataType, with `[]` for an array.
    pub data_type: String,
    /// Whether it is required.
    pub is_required: bool,
    /// Its default value, as JSON.
    pub default: Option<String>,
    /// Minimum value.
    pub min: Option<f64>,
    /// Maximum value.
    pub max: Option<f64>,
    /// The symbol of its unit.
    pub unit: Option<String>,
    /// Its node.
    pub node: Option<NodeName>,
}

/// A node, by the URI of its namespace.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct NodeName {
    /// The URI of its namespace.
    pub namespace: String,
    /// Its identifier in the namespace, such as `i=100` or `s=Grasp`.
    pub identifier: String,
}

impl NodeName {
    /// Parses a text such as `nsu=urn:example:gripper;i=100`. The default namespace is that of OPC
    /// UA itself.
    #[must_use]
    pub fn parse(node_id: &str) -> Option<Self> {
        let (namespace, identifier) = match node_id.strip_prefix("nsu=") {
            Some(rest) => rest.split_once(';')?,
            None => (OPC_UA, node_id),
        };
        let is_identifier = ["i=", "s=", "g=", "b="]
            .iter()
            .any(|kind| identifier.starts_with(kind));
        is_identifier.then(|| Self {
            namespace: namespace.replace("%3B", ";").replace("%25", "%"),
            identifier: identifier.to_owned(),
        })
    }

    /// Returns its NodeId in the notation of OPC 10000-6, 5.1.12.
    #[must_use]
    pub fn id(&self) -> String {
        let namespace = self.namespace.replace('%', "%25").replace(';', "%3B");
        format!("nsu={namespace};{}", self.identifier)
    }

    /// Returns the IRI of a node that is the same in every server, such as a type: the namespace
    /// URI with the identifier as its fragment.
    #[must_use]
    pub fn iri(&self) -> String {
        let fragment = fragment(&self.identifier);
        let is_plain = !self.namespace.contains('#') && is_iri(&self.namespace);
        if is_plain {
            format!("{}#{fragment}", self.namespace)
        } else {
            format!("urn:ua-bridge:node:{}#{fragment}", escaped(&self.namespace))
        }
    }
}

impl ComponentFacts {
    /// Returns its IRI: the ApplicationUri, if that is an IRI.
    #[must_use]
    pub fn iri(&self) -> String {
        if is_iri(&self.application_uri) && !self.application_uri.contains('#') {
            self.application_uri.clone()
        } else {
            format!("urn:ua-bridge:component:{}", escaped(&self.application_uri))
        }
    }

    /// Returns the IRI of one of its skills. Two components of one manufacturer may have nodes with
    /// equal names in one namespace; the component distinguishes their skills.
    #[must_use]
    pub fn skill_iri(&self, node: &NodeName) -> String {
        let iri = self.iri();
        if node.namespace == self.application_uri {
            format!("{iri}#{}", fragment(&node.identifier))
        } else {
            format!(
                "{iri}#{};{}",
                escaped(&node.namespace),
                fragment(&node.identifier)
            )
        }
    }

    /// Returns all facts as statements. Capabilities that are not IRIs are omitted and returned
    /// separately.
    #[must_use]
    pub fn triples(&self) -> (Vec<Triple>, Vec<String>) {
        let mut graph = Graph::default();
        let iri = self.iri();
        graph.link(&iri, v::RDF_TYPE, v::RESOURCE);
        graph.link(&iri, v::RDF_TYPE, v::COMPONENT);
        graph.text(&iri, v::RDFS_LABEL, &self.name);
        graph.text(&iri, v::APPLICATION_URI, &self.application_uri);
        graph.text(&iri, v::ENDPOINT, &self.endpoint);
        if let Some(number) = self.namespace {
            graph.say(&iri, v::NAMESPACE_NUMBER, Object::Integer(number.into()));
        }
        for skill in &self.skills {
            graph.skill(self, skill);
        }
        (graph.all, graph.left_out)
    }
}

#[derive(Debug, Default)]
struct Graph {
    all: Vec<Triple>,
    left_out: Vec<String>,
}

impl Graph {
    fn skill(&mut self, component: &ComponentFacts, skill: &SkillFacts) {
        let iri = component.skill_iri(&skill.node);
        let of = component.iri();
        self.link(&of, v::PROVIDES_SKILL, &iri);
        self.link(&iri, v::RDF_TYPE, v::SKILL);
        self.text(&iri, v::RDFS_LABEL, &skill.name);
        if let Some(number) = skill.number {
            self.say(&iri, v::NUMBER, Object::Integer(number.into()));
        }
        self.node(&iri, &component.endpoint, &skill.node);
        if let Some(own) = skill.types.first() {
            self.link(&iri, v::RDF_TYPE, &own.node.iri());
        }
        for pair in skill.types.windows(2) {
            if let [below, above] = pair {
                self.link(&below.node.iri(), v::RDFS_SUB_CLASS_OF, &above.node.iri());
            }
        }
        for of_nodes in &skill.types {
            let iri = of_nodes.node.iri();
            self.link(&iri, v::RDF_TYPE, v::RDFS_CLASS);
            // Even without a supertype: each class is a subclass of itself.
            self.link(&iri, v::RDFS_SUB_CLASS_OF, &iri);
            self.text(&iri, v::BROWSE_NAME, &of_nodes.browse_name);
            self.text(&iri, v::NODE_NAMESPACE, &of_nodes.node.namespace);
            self.text(&iri, v::NODE_IDENTIFIER, &of_nodes.node.identifier);
        }
        for (class, number) in skill.capabilities.iter().zip(1..) {
            if !is_iri(class) {
                self.left_out.push(class.chars().take(200).collect());
                continue;
            }
            let capability = format!("{iri}/capability/{number}");
            self.link(&of, v::PROVIDES_CAPABILITY, &capability);
            self.link(&capability, v::RDF_TYPE, v::PROVIDED_CAPABILITY);
            self.link(&capability, v::RDF_TYPE, class);
            self.link(&capability, v::IS_REALIZED_BY_SKILL, &iri);
            self.link(class, v::RDFS_SUB_CLASS_OF, v::CAPABILITY);
        }
        for parameter in &skill.parameters {
            self.parameter(component, (&iri, &skill.name), parameter);
        }
    }

    fn parameter(
        &mut self,
        component: &ComponentFacts,
        (skill, skill_name): (&str, &str),
        parameter: &ParameterFacts,
    ) {
        let (has, class, kind) = if parameter.is_output {
            (v::HAS_OUTPUT_PARAMETER, v::OUTPUT_PARAMETER, "result")
        } else {
            (v::HAS_INPUT_PARAMETER, v::INPUT_PARAMETER, "parameter")
        };
        let iri = format!("{skill}/{kind}/{}", escaped(&parameter.name));
        self.link(skill, has, &iri);
        self.link(&iri, v::RDF_TYPE, class);
        self.text(
            &iri,
            v::RDFS_LABEL,
            &format!("{skill_name}.{}", parameter.name),
        );
        self.text(&iri, v::HAS_VARIABLE_NAME, &parameter.name);
        self.text(&iri, v::HAS_VARIABLE_TYPE, &parameter.data_type);
        if !parameter.is_output {
            self.say(&iri, v::IS_REQUIRED, Object::Boolean(parameter.is_required));
        }
        if let Some(default) = &parameter.default {
            self.text(&iri, v::HAS_DEFAULT_VALUE, default);
        }
        for (limit, predicate) in [(parameter.min, v::MIN), (parameter.max, v::MAX)] {
            if let Some(limit) = limit.filter(|limit| limit.is_finite()) {
                self.say(&iri, predicate, Object::Number(limit));
            }
        }
        if let Some(unit) = &parameter.unit {
            self.text(&iri, v::UNIT, unit);
        }
        if let Some(node) = &parameter.node {
            self.node(&iri, &component.endpoint, node);
        }
    }

    fn node(&mut self, of: &str, endpoint: &str, node: &NodeName) {
        self.text(of, v::ENDPOINT, endpoint);
        self.text(of, v::NODE_NAMESPACE, &node.namespace);
        self.text(of, v::NODE_IDENTIFIER, &node.identifier);
        self.text(of, v::NODE_ID, &node.id());
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

/// Returns whether the whole text is an IRI with an authority (`://`) or a known scheme. A name
/// with a colon, such as `Dosing:Fill`, has the syntax of an IRI, and is none.
#[must_use]
pub fn is_iri(text: &str) -> bool {
    let (scheme, rest) = text.split_once(':').unwrap_or_default();
    let is_known = |known: &&str| scheme.eq_ignore_ascii_case(known);
    let is_absolute = rest.starts_with("//") || SCHEMES.iter().any(is_known);
    is_absolute && oxigraph::model::NamedNode::new(text).is_ok()
}

/// Escapes an identifier for the fragment of an IRI, and keeps the `=` of identifiers.
fn fragment(identifier: &str) -> String {
    match identifier.split_once('=') {
        Some((kind, rest)) => format!("{}={}", escaped(kind), escaped(rest)),
        None => escaped(identifier),
    }
}

/// Schemes of IRIs without an authority.
const SCHEMES: [&str; 4] = ["urn", "tag", "did", "mailto"];
/// The namespace of OPC UA itself.
pub const OPC_UA: &str = "http://opcfoundation.org/UA/";
