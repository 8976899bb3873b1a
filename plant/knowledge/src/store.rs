//! The store: a named graph per source, and the merge of all graphs as the default graph.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::{Mutex, PoisonError};
use std::{fmt, io};

use mtp::{Object, Triple as Statement};
use oxigraph::io::{RdfFormat, RdfParser, RdfSerializer};
use oxigraph::model::{
    GraphName, GraphNameRef, Literal, NamedNode, NamedNodeRef, NamedOrBlankNode, Term, Triple,
    vocab,
};
use oxigraph::store::{StorageError, Store, Transaction};
use serde::Serialize;
use thiserror::Error;
use tokio::sync::watch;

use crate::source::{DERIVED, Source, SourceKind};
use crate::vocabulary;

/// Error of adding data to the store.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum KnowledgeFault {
    /// A required IRI is invalid.
    #[error("`{text}` is no IRI: {why}")]
    Iri {
        /// The given text.
        text: String,
        /// Description of the error.
        why: String,
    },
    /// The source has too many statements.
    #[error("the source says more than the {most} statements that are kept of one")]
    TooMany {
        /// The limit.
        most: usize,
    },
    /// There are too many sources.
    #[error("there are {most} sources already, and no more are kept")]
    TooManySources {
        /// The limit.
        most: usize,
    },
    /// The text is not Turtle.
    #[error("{0}")]
    Turtle(String),
    /// The graph of derived statements is read-only.
    #[error("the derived graph is made by rules and cannot be written")]
    Derived,
    /// The store itself failed.
    #[error("the store fails: {0}")]
    Store(#[from] StorageError),
}

/// The knowledge of the plant. Reading and writing are safe from any thread; readers see a source
/// as a whole, before or after its replacement.
///
/// The default graph contains each statement of any source once: the merge as defined by SPARQL,
/// which counting requires.
pub struct Knowledge {
    store: Store,
    /// Serializes the writers.
    sources: Mutex<BTreeMap<Source, SourceStatus>>,
    changed: watch::Sender<u64>,
}

/// Status of a source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SourceStatus {
    /// The IRI of its graph.
    pub graph: String,
    /// Its kind.
    pub kind: SourceKind,
    /// Its name.
    pub name: String,
    /// Number of its statements.
    pub statements: usize,
    /// Time of its first addition in milliseconds since 1970; a replacement keeps it.
    pub since_ms: u64,
}

impl Knowledge {
    /// Creates an empty store in memory.
    ///
    /// # Errors
    /// Fails if memory is not available.
    pub fn new() -> Result<Self, KnowledgeFault> {
        Ok(Self {
            store: Store::new()?,
            sources: Mutex::new(BTreeMap::new()),
            changed: watch::channel(0).0,
        })
    }

    /// Replaces the statements of a source atomically for all readers. `at` is in milliseconds
    /// since 1970.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace(
        &self,
        source: &Source,
        statements: &[Statement],
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        if statements.len() > MAX_STATEMENTS {
            return Err(KnowledgeFault::TooMany {
                most: MAX_STATEMENTS,
            });
        }
        let statements = statements
            .iter()
            .map(triple)
            .collect::<Result<HashSet<_>, _>>()?;
        self.put(source, &statements, at)
    }

    /// Replaces the statements of a source by the statements of a Turtle file.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace_turtle(
        &self,
        source: &Source,
        turtle: &str,
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        let mut triples = HashSet::new();
        for quad in RdfParser::from_format(RdfFormat::Turtle)
            .rename_blank_nodes()
            .for_slice(turtle)
        {
            let quad = quad.map_err(|error| KnowledgeFault::Turtle(error.to_string()))?;
            triples.insert(Triple::from(quad));
            if triples.len() > MAX_STATEMENTS {
                return Err(KnowledgeFault::TooMany {
                    most: MAX_STATEMENTS,
                });
            }
        }
        self.put(source, &triples, at)
    }

    /// Removes a source atomically for all readers. Returns whether it existed.
    ///
    /// # Errors
    /// [`KnowledgeFault::Store`]; then nothing has changed.
    pub fn remove(&self, source: &Source) -> Result<bool, KnowledgeFault> {
        let mut sources = self.sources.lock().unwrap_or_else(PoisonError::into_inner);
        if !sources.contains_key(source) {
            return Ok(false);
        }
        self.write(&source.graph(), &HashSet::new())?;
        sources.remove(source);
        self.tell(&mut sources);
        Ok(true)
    }

    /// Returns the sources with their times.
    pub fn sources(&self) -> Vec<SourceStatus> {
        self.sources
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .values()
            .cloned()
            .collect()
    }

    /// Returns a number that increases with each change.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Writes all named graphs, or one of them, as N-Quads. Returns `None` if there is no such
    /// graph.
    ///
    /// # Errors
    /// Fails if the store or the writer fails.
    pub fn write_quads(&self, graph: Option<&str>, to: impl io::Write) -> io::Result<Option<()>> {
        let graph = match graph.map(NamedNodeRef::new) {
            Some(Ok(graph))
                if self
                    .store
                    .contains_named_graph(graph)
                    .map_err(io::Error::other)? =>
            {
                Some(GraphNameRef::from(graph))
            }
            Some(_) => return Ok(None),
            None => None,
        };
        let mut to = RdfSerializer::from_format(RdfFormat::NQuads).for_writer(to);
        for quad in self.store.quads_for_pattern(None, None, None, graph) {
            let quad = quad.map_err(io::Error::other)?;
            if !quad.graph_name.is_default_graph() {
                to.serialize_quad(&quad)?;
            }
        }
        to.finish()?;
        Ok(Some(()))
    }

    pub(crate) fn store(&self) -> &Store {
        &self.store
    }

    fn put(
        &self,
        source: &Source,
        triples: &HashSet<Triple>,
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        if source.kind == SourceKind::Derived {
            return Err(KnowledgeFault::Derived);
        }
        let mut sources = self.sources.lock().unwrap_or_else(PoisonError::into_inner);
        if sources.len() >= MAX_SOURCES && !sources.contains_key(source) {
            return Err(KnowledgeFault::TooManySources { most: MAX_SOURCES });
        }
        let graph = source.graph();
        self.write(&graph, triples)?;
        let status = sources
            .entry(source.clone())
            .or_insert_with(|| SourceStatus {
                graph,
                kind: source.kind,
                name: source.name.clone(),
                statements: 0,
                since_ms: at,
            });
        status.statements = triples.len();
        self.tell(&mut sources);
        Ok(())
    }

    /// Updates the count of derived statements, and notifies the receivers of changes.
    fn tell(&self, sources: &mut BTreeMap<Source, SourceStatus>) {
        let derived = NamedNodeRef::new_unchecked(DERIVED);
        let statements = self
            .store
            .quads_for_pattern(None, None, None, Some(derived.into()))
            .count();
        let since_ms = sources
            .values()
            .map(|source| source.since_ms)
            .min()
            .unwrap_or_default();
        sources.insert(
            Source::new(SourceKind::Derived, ""),
            SourceStatus {
                graph: DERIVED.to_owned(),
                kind: SourceKind::Derived,
                name: String::new(),
                statements,
                since_ms,
            },
        );
        self.changed.send_modify(|changes| *changes += 1);
    }

    /// Replaces the contents of a graph by `triples`, and updates the default graph and the derived
    /// graph, in a single transaction.
    fn write(&self, graph: &str, triples: &HashSet<Triple>) -> Result<(), KnowledgeFault> {
        let graph = named(graph)?;
        let sub_class = NamedNodeRef::new_unchecked(vocabulary::RDFS_SUB_CLASS_OF);
        let mut transaction = self.store.start_transaction()?;
        let is_about_classes =
            |changed: &[Triple]| changed.iter().any(|triple| triple.predicate == sub_class);
        let (added, removed) = difference(&transaction, &graph, triples)?;
        apply(&mut transaction, &graph, &added, &removed)?;
        if is_about_classes(&added) || is_about_classes(&removed) {
            let derived = named(DERIVED)?;
            let closure = closure(&transaction, sub_class, &derived)?;
            let (added, removed) = difference(&transaction, &derived, &closure)?;
            apply(&mut transaction, &derived, &added, &removed)?;
        }
        transaction.commit()?;
        Ok(())
    }
}

impl fmt::Debug for Knowledge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Knowledge")
            .field("sources", &self.sources)
            .finish_non_exhaustive()
    }
}

/// Returns the statements to add to a graph and to remove from it.
fn difference(
    transaction: &Transaction<'_>,
    graph: &NamedNode,
    wanted: &HashSet<Triple>,
) -> Result<(Vec<Triple>, Vec<Triple>), StorageError> {
    let present = transaction
        .quads_for_pattern(None, None, None, Some(graph.into()))
        .map(|quad| quad.map(Triple::from))
        .collect::<Result<HashSet<_>, _>>()?;
    let added = wanted.difference(&present).cloned().collect();
    let removed = present.difference(wanted).cloned().collect();
    Ok((added, removed))
}

fn apply(
    transaction: &mut Transaction<'_>,
    graph: &NamedNode,
    added: &[Triple],
    removed: &[Triple],
) -> Result<(), StorageError> {
    // The store keeps literals in their canonical form: `.120Z` is added again while `.12Z` is
    // removed. Statements are therefore removed before others are added.
    for triple in removed {
        transaction.remove(triple.as_ref().in_graph(graph));
    }
    for triple in removed {
        let (subject, predicate, object) = (
            triple.subject.as_ref(),
            triple.predicate.as_ref(),
            triple.object.as_ref(),
        );
        let mut said =
            transaction.quads_for_pattern(Some(subject), Some(predicate), Some(object), None);
        let elsewhere = said.find(|quad| {
            quad.as_ref()
                .map_or(true, |quad| !quad.graph_name.is_default_graph())
        });
        let is_said = elsewhere.transpose()?.is_some();
        drop(said);
        if !is_said {
            transaction.remove(triple.as_ref().in_graph(GraphNameRef::DefaultGraph));
        }
    }
    for triple in added {
        transaction.insert(triple.as_ref().in_graph(graph));
        transaction.insert(triple.as_ref().in_graph(GraphNameRef::DefaultGraph));
    }
    // A graph without statements does not exist.
    let is_empty = transaction
        .quads_for_pattern(None, None, None, Some(graph.into()))
        .next()
        .is_none();
    if is_empty {
        transaction.remove_named_graph(graph)?;
    }
    Ok(())
}

/// Applies the rule for subclasses: transitive through any number of classes, and reflexive.
/// Questions never need a path (`rdfs:subClassOf*`), which the evaluator would follow last and for
/// all classes.
fn closure(
    transaction: &Transaction<'_>,
    sub_class: NamedNodeRef<'_>,
    derived: &NamedNode,
) -> Result<HashSet<Triple>, StorageError> {
    let mut above: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for quad in transaction.quads_for_pattern(None, Some(sub_class), None, None) {
        let quad = quad?;
        let is_direct = matches!(&quad.graph_name, GraphName::NamedNode(graph) if graph != derived);
        if let (NamedOrBlankNode::NamedNode(class), Term::NamedNode(supertype), true) =
            (quad.subject, quad.object, is_direct)
        {
            above.entry(supertype.as_str().to_owned()).or_default();
            above
                .entry(class.into_string())
                .or_default()
                .insert(supertype.into_string());
        }
    }
    let mut all = HashSet::new();
    for class in above.keys() {
        let mut seen: BTreeSet<&str> = BTreeSet::from([class.as_str()]);
        let mut waiting = vec![class.as_str()];
        while let Some(next) = waiting.pop() {
            let further = above.get(next).into_iter().flatten();
            waiting.extend(
                further
                    .map(String::as_str)
                    .filter(|further| seen.insert(further)),
            );
        }
        if all.len() + seen.len() > MAX_DERIVED {
            tracing::warn!(
                most = MAX_DERIVED,
                "the classes have more superclasses than are kept; questions about types miss some"
            );
            break;
        }
        let class = NamedNode::new_unchecked(class);
        let above = seen.into_iter().map(NamedNode::new_unchecked);
        all.extend(above.map(|above| Triple::new(class.clone(), sub_class, above)));
    }
    Ok(all)
}

fn triple(statement: &Statement) -> Result<Triple, KnowledgeFault> {
    let object: Term = match &statement.object {
        Object::Iri(iri) => named(iri)?.into(),
        Object::Text(text) => Literal::new_simple_literal(text).into(),
        Object::Integer(number) => Literal::from(*number).into(),
        Object::Number(number) => Literal::from(*number).into(),
        Object::Boolean(value) => Literal::from(*value).into(),
        Object::Time(time) => Literal::new_typed_literal(time, vocab::xsd::DATE_TIME).into(),
    };
    Ok(Triple::new(
        named(&statement.subject)?,
        named(&statement.predicate)?,
        object,
    ))
}

fn named(iri: &str) -> Result<NamedNode, KnowledgeFault> {
    let text: String = iri.chars().take(200).collect();
    NamedNode::new(iri).map_err(|error| KnowledgeFault::Iri {
        text,
        why: error.to_string(),
    })
}

/// The base NodeSet, the largest published NodeSet, results in some 40 000.
const MAX_STATEMENTS: usize = 200_000;
const MAX_SOURCES: usize = 2000;
const MAX_DERIVED: usize = 500_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals_that_are_not_canonical_stay_when_their_source_is_replaced() {
        let knowledge = Knowledge::new().unwrap();
        let source = Source::new(SourceKind::File, "times.ttl");
        let literals = [
            r#""2026-11-27T10:00:00.120Z"^^xsd:dateTime"#,
            r#""2026-11-27T10:00:01.000Z"^^xsd:dateTime"#,
            r#""007"^^xsd:integer"#,
            r#""1.50"^^xsd:decimal"#,
            r#""1e0"^^xsd:double"#,
            r#""1"^^xsd:boolean"#,
            r#""P0Y14M"^^xsd:duration"#,
        ];
        let mut turtle = "@prefix xsd: <http://www.w3.org/2001/XMLSchema#> .\n".to_owned();
        for (at, literal) in (1..).zip(literals) {
            let line = format!("<urn:example:{at}> <urn:example:is> {literal} .\n");
            turtle.push_str(&line);
            // Each version repeats the statements of the version before.
            knowledge.replace_turtle(&source, &turtle, 0).unwrap();
            let own = named(&source.graph()).unwrap();
            for graph in [own.as_ref().into(), GraphNameRef::DefaultGraph] {
                let found = knowledge
                    .store
                    .quads_for_pattern(None, None, None, Some(graph))
                    .count();
                assert_eq!(found, at, "{literal}");
            }
        }
        // A statement that is no longer in the file is removed, for any form of its literal.
        knowledge
            .replace_turtle(&source, "<urn:a> <urn:b> <urn:c> .", 0)
            .unwrap();
        assert_eq!(knowledge.store.len().unwrap(), 2);
    }
}
