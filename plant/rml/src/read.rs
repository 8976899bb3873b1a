//! Reads a mapping from Turtle, in the vocabulary of R2RML with RML, or in that of RML alone. Both
//! name the same things alike, so that a term counts by its local name.

mod fault;
mod terms;

pub(crate) use terms::{blank, is_default_graph, is_language};

use std::collections::{BTreeSet, HashMap};

use oxrdf::{NamedOrBlankNode, Term, Triple};
use oxttl::TurtleParser;

use self::fault::TriplesMapFault;
use crate::mapping::{
    LogicalSource, MappingFault, ObjectMap, PredicateObject, RmlMapping, TermKind, TriplesMap,
};
use crate::xpath::{XpathNamespaces, parse};

const R2RML: &str = "http://www.w3.org/ns/r2rml#";
const OLD: &str = "http://semweb.mmlab.be/ns/rml#";
const FORMULATIONS: &str = "http://semweb.mmlab.be/ns/ql#";
const NEW: &str = "http://w3id.org/rml/";
const TYPE: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type";

impl RmlMapping {
    /// Reads a mapping.
    ///
    /// # Errors
    /// [`MappingFault`].
    pub fn read(turtle: &str) -> Result<Self, MappingFault> {
        if turtle.len() > MAX_MAPPING {
            return Err(MappingFault::Whole(format!(
                "the mapping has {} bytes, more than the {MAX_MAPPING} that are read",
                turtle.len()
            )));
        }
        let mut parser = TurtleParser::new().for_slice(turtle);
        let mut statements = Vec::new();
        for triple in parser.by_ref() {
            let triple = triple.map_err(|fault| MappingFault::Turtle {
                line: fault.location().start.line + 1,
                problem: fault.message().to_owned(),
            })?;
            statements.push(triple);
        }
        let prefixes = parser
            .prefixes()
            .filter(|(_, iri)| ![R2RML, OLD, FORMULATIONS, NEW].contains(iri));
        let prefixes = prefixes
            .map(|(name, iri)| (name.to_owned(), iri.to_owned()))
            .collect();
        let base = parser.base_iri().unwrap_or_default().to_owned();
        let mut reading = Reading {
            graph: Graph::new(&statements),
            sources: Vec::new(),
            findings: BTreeSet::new(),
            names: Vec::new(),
        };
        let maps = reading.maps(&statements)?;
        Ok(Self {
            sources: reading.sources,
            maps,
            base,
            prefixes,
            findings: reading.findings.into_iter().collect(),
        })
    }
}

/// The statements of a mapping by their subject.
struct Graph<'a> {
    by_subject: HashMap<&'a NamedOrBlankNode, Vec<&'a Triple>>,
}

impl<'a> Graph<'a> {
    fn new(statements: &'a [Triple]) -> Self {
        let mut by_subject: HashMap<_, Vec<_>> = HashMap::new();
        for statement in statements {
            by_subject
                .entry(&statement.subject)
                .or_default()
                .push(statement);
        }
        Self { by_subject }
    }

    fn about(&self, subject: &NamedOrBlankNode) -> &[&'a Triple] {
        self.by_subject.get(subject).map_or(&[], Vec::as_slice)
    }

    /// Returns the values of a property of RML.
    fn all(&self, subject: &NamedOrBlankNode, property: &str) -> Vec<&'a Term> {
        let mut found: Vec<&Term> = Vec::new();
        for statement in self.about(subject) {
            let is_named = local(statement.predicate.as_str()) == Some(property);
            if is_named && !found.contains(&&statement.object) {
                found.push(&statement.object);
            }
        }
        found
    }

    /// Returns the only value of a property.
    fn one(
        &self,
        subject: &NamedOrBlankNode,
        property: &str,
    ) -> Result<Option<&'a Term>, TriplesMapFault> {
        match self.all(subject, property).as_slice() {
            [] => Ok(None),
            [one] => Ok(Some(one)),
            several => Err(TriplesMapFault::Several {
                count: several.len(),
                property: property.to_owned(),
            }),
        }
    }

    fn text(
        &self,
        subject: &NamedOrBlankNode,
        property: &str,
    ) -> Result<Option<&'a str>, TriplesMapFault> {
        match self.one(subject, property)? {
            None => Ok(None),
            Some(Term::Literal(literal)) => Ok(Some(literal.value())),
            Some(other) => Err(TriplesMapFault::NoText {
                property: property.to_owned(),
                found: other.to_string(),
            }),
        }
    }
}

struct Reading<'a> {
    graph: Graph<'a>,
    sources: Vec<LogicalSource>,
    findings: BTreeSet<String>,
    /// The triples maps in their order.
    names: Vec<&'a NamedOrBlankNode>,
}

impl<'a> Reading<'a> {
    fn maps(&mut self, statements: &'a [Triple]) -> Result<Vec<TriplesMap>, MappingFault> {
        let mut vocabularies = BTreeSet::new();
        for statement in statements {
            let predicate = statement.predicate.as_str();
            let known = [R2RML, OLD, NEW];
            vocabularies.extend(known.into_iter().filter(|it| predicate.starts_with(it)));
            let is_map = match local(predicate) {
                Some("logicalSource" | "subjectMap" | "subject" | "logicalTable") => true,
                _ => predicate == TYPE && named(&statement.object) == Some("TriplesMap"),
            };
            if is_map && !self.names.contains(&&statement.subject) {
                self.names.push(&statement.subject);
            }
            if self.names.len() > MAX_MAPS {
                return Err(MappingFault::Whole(format!(
                    "the mapping has more than {MAX_MAPS} triples maps"
                )));
            }
        }
        if vocabularies.contains(NEW) && vocabularies.len() > 1 {
            self.findings.insert(format!(
                "the mapping mixes the vocabularies {}; terms of all of them count",
                vocabularies.into_iter().collect::<Vec<_>>().join(" and ")
            ));
        }
        if self.names.is_empty() {
            return Err(MappingFault::Whole(format!(
                "there is no triples map in the vocabulary {OLD} or {NEW}"
            )));
        }
        let names = self.names.clone();
        let read = names.into_iter().map(|name| {
            self.map(name).map_err(|fault| MappingFault::Map {
                map: name.to_string(),
                problem: fault.to_string(),
            })
        });
        read.collect()
    }

    fn map(&mut self, node: &'a NamedOrBlankNode) -> Result<TriplesMap, TriplesMapFault> {
        self.known_only(node, node, "the triples map", &PROPERTIES_OF_MAP);
        if self.graph.one(node, "logicalTable")?.is_some() {
            return Err(TriplesMapFault::LogicalTable);
        }
        let source = self.graph.one(node, "logicalSource")?;
        let source = source.ok_or(TriplesMapFault::NoLogicalSource)?;
        let source = self.source(self.node(source, "logicalSource")?, node)?;
        let namespaces = self
            .sources
            .get(source)
            .map(|source| source.namespaces.clone())
            .unwrap_or_default();
        let subject = self.term_nodes(node, "subject")?;
        let [subject] = subject.as_slice() else {
            return Err(TriplesMapFault::Subjects(subject.len()));
        };
        let mut scope = Scope {
            map: node,
            namespaces: &namespaces,
        };
        let mut classes = Vec::new();
        let mut graphs = Vec::new();
        if let TermNode::Map(subject) = *subject {
            for class in self.graph.all(subject, "class") {
                match class {
                    Term::NamedNode(class) => classes.push(class.clone()),
                    other @ (Term::BlankNode(_) | Term::Literal(_)) => {
                        return Err(TriplesMapFault::Class(other.to_string()));
                    }
                }
            }
            graphs = self.graphs(subject, &mut scope)?;
        }
        let mut subject = self.term(*subject, "subject", TermKind::Iri, &scope)?;
        if subject.kind == TermKind::Literal {
            self.note(node, "a subject is no literal; its term type counts as IRI");
            subject.kind = TermKind::Iri;
        }
        let mut predicate_objects = Vec::new();
        for one in self.graph.all(node, "predicateObjectMap") {
            let one = self.node(one, "predicateObjectMap")?;
            predicate_objects.push(self.predicate_object(one, &mut scope)?);
        }
        Ok(TriplesMap {
            name: node.to_string(),
            source,
            subject,
            classes,
            graphs,
            predicate_objects,
            base: match self.graph.one(node, "baseIRI")? {
                Some(Term::NamedNode(base)) => Some(base.as_str().to_owned()),
                _ => None,
            },
        })
    }

    fn predicate_object(
        &mut self,
        node: &'a NamedOrBlankNode,
        scope: &mut Scope<'_>,
    ) -> Result<PredicateObject, TriplesMapFault> {
        self.known_only(
            scope.map,
            node,
            "a predicate-object map",
            &PROPERTIES_OF_PREDICATE_OBJECT,
        );
        let mut predicates = Vec::new();
        for predicate in self.term_nodes(node, "predicate")? {
            let predicate = self.term(predicate, "predicate", TermKind::Iri, scope)?;
            if !matches!(predicate.kind, TermKind::Iri | TermKind::UnsafeIri) {
                return Err(TriplesMapFault::Predicate);
            }
            predicates.push(predicate);
        }
        let mut objects = Vec::new();
        for object in self.term_nodes(node, "object")? {
            objects.push(match object {
                TermNode::Map(map) if !self.graph.all(map, "parentTriplesMap").is_empty() => {
                    self.parent(map, scope)?
                }
                TermNode::Map(_) | TermNode::Constant(_) => {
                    ObjectMap::Term(self.term(object, "object", TermKind::Iri, scope)?)
                }
            });
        }
        if predicates.is_empty() || objects.is_empty() {
            return Err(TriplesMapFault::PredicateObject);
        }
        Ok(PredicateObject {
            predicates,
            objects,
            graphs: self.graphs(node, scope)?,
        })
    }

    fn parent(
        &mut self,
        node: &'a NamedOrBlankNode,
        scope: &Scope<'_>,
    ) -> Result<ObjectMap, TriplesMapFault> {
        let parent = self.graph.one(node, "parentTriplesMap")?;
        let parent = parent.ok_or(TriplesMapFault::NoParentMap)?;
        let known = self.names.iter().position(|name| match (name, parent) {
            (NamedOrBlankNode::NamedNode(name), Term::NamedNode(parent)) => name == parent,
            (NamedOrBlankNode::BlankNode(name), Term::BlankNode(parent)) => name == parent,
            _ => false,
        });
        let map = known.ok_or_else(|| TriplesMapFault::UnknownParent(parent.to_string()))?;
        // Expressions of the parent are read with the namespaces of its own source.
        let parent = self.names.get(map).copied();
        let parent = parent.ok_or(TriplesMapFault::NoParent)?;
        let source = self.graph.one(parent, "logicalSource")?;
        let source = source.ok_or_else(|| TriplesMapFault::ParentSource(parent.to_string()))?;
        let namespaces = self.namespaces(self.node(source, "logicalSource")?)?;
        let parent_scope = Scope {
            map: parent,
            namespaces: &namespaces,
        };
        let mut joins = Vec::new();
        for join in self.graph.all(node, "joinCondition") {
            let join = self.node(join, "joinCondition")?;
            joins.push(crate::mapping::JoinCondition {
                child: self.side(join, "child", scope)?,
                parent: self.side(join, "parent", &parent_scope)?,
            });
        }
        Ok(ObjectMap::Parent { map, joins })
    }

    /// Returns the index of a logical source.
    fn source(
        &mut self,
        node: &'a NamedOrBlankNode,
        map: &NamedOrBlankNode,
    ) -> Result<usize, TriplesMapFault> {
        self.known_only(map, node, "the logical source", &PROPERTIES_OF_SOURCE);
        let namespaces = self.namespaces(node)?;
        let source = self.graph.one(node, "source")?;
        let file = self.file(source.ok_or(TriplesMapFault::NoSource)?)?;
        let written = self.graph.text(node, "iterator")?.unwrap_or("/");
        let iterator = parse(written, &namespaces).map_err(|fault| TriplesMapFault::Iterator {
            written: written.to_owned(),
            fault,
        })?;
        let source = LogicalSource {
            file,
            iterator,
            namespaces,
            written: written.to_owned(),
        };
        if let Some(known) = self.sources.iter().position(|known| *known == source) {
            return Ok(known);
        }
        self.sources.push(source);
        Ok(self.sources.len() - 1)
    }

    fn file(&self, source: &'a Term) -> Result<String, TriplesMapFault> {
        let node = match source {
            Term::Literal(path) => return Ok(path.value().to_owned()),
            // The IRI of a file was made absolute with the base of the mapping.
            Term::NamedNode(iri) if self.graph.about(&iri.clone().into()).is_empty() => {
                return Ok(iri.as_str().to_owned());
            }
            Term::NamedNode(_) | Term::BlankNode(_) => self.node(source, "source")?,
        };
        if let Some(root) = self.graph.one(node, "root")? {
            let is_known = matches!(
                named(root),
                Some("MappingDirectory" | "CurrentWorkingDirectory")
            );
            if !is_known {
                return Err(TriplesMapFault::Root(root.to_string()));
            }
        }
        if let Some(compression) = self.graph.one(node, "compression")?
            && named(compression) != Some("none")
        {
            return Err(TriplesMapFault::Compression);
        }
        let path = self.graph.text(node, "path")?;
        path.map(str::to_owned).ok_or(TriplesMapFault::NoFile)
    }

    /// Checks the reference formulation, and returns its namespaces.
    fn namespaces(
        &self,
        source: &'a NamedOrBlankNode,
    ) -> Result<Vec<(String, String)>, TriplesMapFault> {
        let formulation = self.graph.one(source, "referenceFormulation")?;
        let refused = |found: &Term| TriplesMapFault::Formulation(found.to_string());
        let node = match formulation {
            None => return Err(TriplesMapFault::NoFormulation),
            Some(found) if named(found) == Some("XPath") => return Ok(Vec::new()),
            Some(found) => self.node(found, "").map_err(|_| refused(found))?,
        };
        let mut types = self.graph.about(node).iter();
        let is_xpath = types.any(|statement| {
            statement.predicate.as_str() == TYPE
                && named(&statement.object) == Some("XPathReferenceFormulation")
        });
        if !is_xpath {
            return Err(formulation.map_or(TriplesMapFault::NoFormulation, refused));
        }
        let mut namespaces = Vec::new();
        for namespace in self.graph.all(node, "namespace") {
            let namespace = self.node(namespace, "namespace")?;
            let prefix = self.graph.text(namespace, "namespacePrefix")?;
            let url = match self.graph.one(namespace, "namespaceURL")? {
                Some(Term::Literal(url)) => Some(url.value()),
                Some(Term::NamedNode(url)) => Some(url.as_str()),
                _ => None,
            };
            let (Some(prefix), Some(url)) = (prefix, url) else {
                return Err(TriplesMapFault::Namespace);
            };
            namespaces.push((prefix.to_owned(), url.to_owned()));
        }
        Ok(namespaces)
    }

    /// Returns the resource that a term is.
    fn node(&self, term: &Term, property: &str) -> Result<&'a NamedOrBlankNode, TriplesMapFault> {
        let key = match term {
            Term::NamedNode(node) => NamedOrBlankNode::from(node.clone()),
            Term::BlankNode(node) => NamedOrBlankNode::from(node.clone()),
            Term::Literal(text) => {
                return Err(TriplesMapFault::NoResource {
                    property: property.to_owned(),
                    found: text.to_string(),
                });
            }
        };
        let known = self.graph.by_subject.get_key_value(&key);
        known
            .map(|(node, _)| *node)
            .ok_or_else(|| TriplesMapFault::Unstated {
                property: property.to_owned(),
                term: term.to_string(),
            })
    }

    fn note(&mut self, map: &NamedOrBlankNode, finding: &str) {
        self.findings
            .insert(format!("triples map {map}: {finding}"));
    }

    /// Notes the properties of RML that are ignored here.
    fn known_only(
        &mut self,
        map: &NamedOrBlankNode,
        node: &NamedOrBlankNode,
        subject: &str,
        known: &[&str],
    ) {
        let ignored: Vec<String> = self
            .graph
            .about(node)
            .iter()
            .filter_map(|statement| local(statement.predicate.as_str()))
            .filter(|name| !known.contains(name))
            .map(|name| format!("`{name}` of {subject} is ignored"))
            .collect();
        for finding in ignored {
            self.note(map, &finding);
        }
    }
}

/// The triples map that is read, and the namespaces of its expressions.
struct Scope<'s> {
    map: &'s NamedOrBlankNode,
    namespaces: &'s XpathNamespaces,
}

/// A term map, or a constant in its place.
#[derive(Clone, Copy)]
enum TermNode<'a> {
    Constant(&'a Term),
    Map(&'a NamedOrBlankNode),
}

/// Returns the name of a term of RML.
fn local(iri: &str) -> Option<&str> {
    let vocabularies = [R2RML, OLD, NEW, FORMULATIONS];
    vocabularies.iter().find_map(|it| iri.strip_prefix(it))
}

fn named(term: &Term) -> Option<&str> {
    match term {
        Term::NamedNode(node) => local(node.as_str()),
        Term::BlankNode(_) | Term::Literal(_) => None,
    }
}

const PROPERTIES_OF_MAP: [&str; 5] = [
    "baseIRI",
    "logicalSource",
    "predicateObjectMap",
    "subject",
    "subjectMap",
];
const PROPERTIES_OF_PREDICATE_OBJECT: [&str; 6] = [
    "graph",
    "graphMap",
    "object",
    "objectMap",
    "predicate",
    "predicateMap",
];
const PROPERTIES_OF_SOURCE: [&str; 3] = ["iterator", "referenceFormulation", "source"];

const MAX_MAPPING: usize = 4 << 20;
const MAX_MAPS: usize = 2000;
