//! The store: a named graph per source, and the merge of all graphs as the default graph.

use std::collections::{BTreeMap, HashSet};
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError, RwLock};
use std::{fmt, io};

use mtp::{Object, Triple as Statement};
use oxigraph::io::{RdfFormat, RdfParser, RdfSerializer, RdfSyntaxError};
use oxigraph::model::{
    GraphNameRef, Literal, NamedNode, NamedNodeRef, NamedOrBlankNode, NamedOrBlankNodeRef, Term,
    TermRef, Triple, vocab,
};
use oxigraph::store::{StorageError, Store};
use serde::Serialize;
use thiserror::Error;
use tokio::sync::watch;
use tracing::warn;

use crate::journal::Journal;
use crate::rules::apply::{Derived, StoreRules};
use crate::source::{KnowledgeSource, SourceKind};
use crate::vocabulary;
use crate::writing::{GraphChange, StoreChange, derive};

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
    /// The graph belongs to a source of another kind.
    #[error(
        "the graph {0} is made from its source and cannot be written; write a graph with a name of your own"
    )]
    Protected(String),
    /// The journal failed.
    #[error("the change cannot be stored: {0}")]
    Journal(#[from] io::Error),
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
    /// The current store. A copy without removed statements replaces it, see
    /// [`Knowledge::compact`].
    store: RwLock<Store>,
    /// Serializes the writers.
    written: Mutex<WrittenSources>,
    changed: watch::Sender<u64>,
}

/// The sources of the statements, and the journal of the lasting sources.
#[derive(Debug, Default)]
pub(crate) struct WrittenSources {
    pub(crate) sources: BTreeMap<KnowledgeSource, SourceStatus>,
    pub(crate) journal: Option<Journal>,
    pub(crate) rules: StoreRules,
    /// Number of statements that were removed from the current store, or were added by a refused
    /// change. The store still has them.
    pub(crate) removed: usize,
}

/// The only writer of the store.
///
/// A store in memory keeps the statements that are removed from it, and their texts, until
/// [`Knowledge::compact`].
pub(crate) struct StoreWriter<'k> {
    written: MutexGuard<'k, WrittenSources>,
    store: Store,
    changed: &'k watch::Sender<u64>,
}

impl StoreWriter<'_> {
    /// Begins a change of any number of sources, which readers see as a whole.
    ///
    /// # Errors
    /// [`KnowledgeFault::Store`].
    pub(crate) fn begin(&mut self) -> Result<StoreChange<'_>, KnowledgeFault> {
        let transaction = self.store.start_transaction()?;
        let written = &mut *self.written;
        Ok(StoreChange::new(written, transaction, self.changed))
    }
}

/// Whether a source outlasts the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceLifetime {
    /// It is read again from its origin when the program starts.
    No,
    /// It is stored, if the knowledge has a journal.
    Yes,
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
    /// Whether it is stored and outlasts the program.
    pub lasting: bool,
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
            store: RwLock::new(Store::new()?),
            written: Mutex::default(),
            changed: watch::channel(0).0,
        })
    }

    /// Creates a store in memory, with the lasting sources of the journal in a folder. Returns it
    /// with the number of bytes of the journal that could not be read and were set aside.
    ///
    /// # Errors
    /// Fails if the folder cannot be read or written, or another program uses it.
    pub fn open(folder: &Path) -> Result<(Self, u64), KnowledgeFault> {
        let (journal, restored) = Journal::open(folder)?;
        let knowledge = Self::new()?;
        let mut written = knowledge.written();
        let store = knowledge.store();
        for (source, graph) in restored.graphs {
            let mut transaction = store.start_transaction()?;
            let name = named(&source.graph())?;
            for triple in &graph.triples {
                transaction.insert(triple.as_ref().in_graph(&name));
                transaction.insert(triple.as_ref().in_graph(GraphNameRef::DefaultGraph));
            }
            transaction.commit()?;
            let status = SourceStatus::new(&source, graph.at);
            let status = written.sources.entry(source).or_insert(status);
            status.statements = graph.triples.len();
            status.lasting = true;
        }
        written.journal = Some(journal);
        knowledge.derive_anew(&mut written, StoreRules::Off)?;
        drop(written);
        Ok((knowledge, restored.damaged))
    }

    /// Applies the rules of OWL 2 RL, or only that of subclasses. The derived statements are a
    /// graph of their own, and part of the merge of all graphs.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn set_rules(&self, are_on: bool) -> Result<(), KnowledgeFault> {
        let mut written = self.written();
        let rules = match (are_on, &written.rules) {
            (true, StoreRules::Off) => StoreRules::Suspended,
            (false, StoreRules::On(_) | StoreRules::Suspended) => StoreRules::Off,
            (true, StoreRules::On(_) | StoreRules::Suspended) | (false, StoreRules::Off) => {
                return Ok(());
            }
        };
        self.derive_anew(&mut written, rules)?;
        // Still locked: a copy of the store compares the numbers of changes.
        self.changed.send_modify(|changes| *changes += 1);
        Ok(())
    }

    /// Returns whether the rules of OWL 2 RL are `on`, `off`, or `suspended` because too many
    /// statements follow.
    pub fn rules(&self) -> &'static str {
        self.written().rules.name()
    }

    fn derive_anew(
        &self,
        written: &mut WrittenSources,
        rules: StoreRules,
    ) -> Result<(), KnowledgeFault> {
        let store = self.store();
        let mut transaction = store.start_transaction()?;
        let derived = rules.anew(&transaction)?;
        derive(&mut transaction, &derived)?;
        transaction.commit()?;
        written.removed += derived.removed.len();
        if !written.sources.is_empty() {
            written.derived(derived);
        } else if let Some(rules) = derived.rules {
            written.rules = rules;
        }
        Ok(())
    }

    /// Replaces the statements of a source atomically for all readers. `at` is in milliseconds
    /// since 1970.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace(
        &self,
        source: &KnowledgeSource,
        statements: &[Statement],
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        self.replace_with(source, statements, (at, SourceLifetime::No))
    }

    /// Replaces the statements of a source, and stores them if the source lasts.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace_with(
        &self,
        source: &KnowledgeSource,
        statements: &[Statement],
        (at, lasting): (u64, SourceLifetime),
    ) -> Result<(), KnowledgeFault> {
        let triples = statements.iter().map(triple);
        self.put(source, triples.collect::<Result<_, _>>()?, (at, lasting))
    }

    /// Replaces the statements of a source by the statements about nodes.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace_ontology(
        &self,
        source: &KnowledgeSource,
        triples: Vec<Triple>,
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        let triples = triples.into_iter().collect();
        self.put(source, triples, (at, SourceLifetime::No))
    }

    /// Replaces the statements of a source by the statements of a Turtle file.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn replace_turtle(
        &self,
        source: &KnowledgeSource,
        turtle: &str,
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        let triples = parsed(RdfFormat::Turtle, turtle.as_bytes())?;
        self.put(source, triples, (at, SourceLifetime::No))
    }

    /// Adds the statements of a document to a source, or replaces the source by them, and stores
    /// them if the source lasts. Returns whether the source is new.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub(crate) fn take(
        &self,
        source: &KnowledgeSource,
        (format, document): (RdfFormat, &[u8]),
        adds: bool,
        at: u64,
    ) -> Result<bool, KnowledgeFault> {
        let triples = parsed(format, document)?;
        let is_new = !self.written().sources.contains_key(source);
        if adds {
            let change = GraphChange {
                removed: Vec::new(),
                added: triples.into_iter().collect(),
            };
            let mut writer = self.writer();
            let mut writing = writer.begin()?;
            writing.change(source, change)?;
            writing.commit(at)?;
        } else {
            self.put(source, triples, (at, SourceLifetime::Yes))?;
        }
        Ok(is_new)
    }

    /// Replaces the statements of a lasting source by the statements of a Turtle document.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn take_turtle(
        &self,
        source: &KnowledgeSource,
        turtle: &str,
        at: u64,
    ) -> Result<(), KnowledgeFault> {
        let document = (RdfFormat::Turtle, turtle.as_bytes());
        self.take(source, document, false, at).map(drop)
    }

    /// Checks the statements of a Turtle file. Returns their number.
    ///
    /// # Errors
    /// [`KnowledgeFault`].
    pub fn check_turtle(turtle: &str) -> Result<usize, KnowledgeFault> {
        parsed(RdfFormat::Turtle, turtle.as_bytes()).map(|triples| triples.len())
    }

    /// Removes a source atomically for all readers. Returns whether it existed.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub fn remove(&self, source: &KnowledgeSource) -> Result<bool, KnowledgeFault> {
        let mut writer = self.writer();
        let mut writing = writer.begin()?;
        if !writing.written.sources.contains_key(source) {
            return Ok(false);
        }
        let of_graph = writing.triples(source)?;
        let change = GraphChange {
            removed: of_graph.into_iter().collect(),
            added: Vec::new(),
        };
        writing.change(source, change)?;
        writing.remove(source);
        writing.commit(0)?;
        Ok(true)
    }

    /// Returns the sources with their times.
    pub fn sources(&self) -> Vec<SourceStatus> {
        self.written().sources.values().cloned().collect()
    }

    fn written(&self) -> MutexGuard<'_, WrittenSources> {
        self.written.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the writer of the store. Copies the store first if it has far too many removed
    /// statements, for a program that does not [compact](Self::compact) it.
    pub(crate) fn writer(&self) -> StoreWriter<'_> {
        // The sources are locked first: a transaction waits for others without end.
        let mut written = self.written();
        let most = written.kept().saturating_add(MOST_REMOVED);
        if written.removed > most.saturating_mul(MOST_OF_KEPT) {
            match copied(&self.store()) {
                Ok(copy) => self.replace_store(&mut written, copy),
                Err(error) => {
                    warn!(%error, removed = written.removed, "cannot copy the store of statements");
                }
            }
        }
        StoreWriter {
            written,
            store: self.store(),
            changed: &self.changed,
        }
    }

    /// Frees the memory of removed statements, if they are more than the present ones: the present
    /// statements are copied into a new store. Changes do not wait for a copy, unless the
    /// statements change during each of the first copies. Takes seconds for a million statements.
    /// Returns whether the memory was freed.
    ///
    /// # Errors
    /// [`KnowledgeFault::Store`]; then the old store is used on.
    pub fn compact(&self) -> Result<bool, KnowledgeFault> {
        self.compact_with(&mut || ())
    }

    /// Calls `copied_once` after each copy that changes do not wait for.
    fn compact_with(&self, copied_once: &mut dyn FnMut()) -> Result<bool, KnowledgeFault> {
        for _ in 0..COPIES {
            let (before, store) = {
                let written = self.written();
                if written.removed <= written.kept().max(MOST_REMOVED) {
                    return Ok(false);
                }
                (*self.changed.borrow(), self.store())
            };
            let copy = copied(&store)?;
            copied_once();
            let mut written = self.written();
            if *self.changed.borrow() == before {
                self.replace_store(&mut written, copy);
                return Ok(true);
            }
        }
        let mut written = self.written();
        let copy = copied(&self.store())?;
        self.replace_store(&mut written, copy);
        Ok(true)
    }

    /// Replaces the store by its copy, while no change is made.
    fn replace_store(&self, written: &mut WrittenSources, copy: Store) {
        *self.store.write().unwrap_or_else(PoisonError::into_inner) = copy;
        written.removed = 0;
    }

    /// Returns the IRI of a type by its namespace and BrowseName, if a source has it.
    pub fn type_of(&self, namespace: &str, browse_name: &str) -> Option<String> {
        let store = self.store();
        let find = |subject: Option<NamedOrBlankNodeRef<'_>>, predicate: &str, text: &str| {
            let predicate = NamedNodeRef::new_unchecked(predicate);
            let text = Literal::new_simple_literal(text);
            let object = TermRef::from(&text);
            let quads = store.quads_for_pattern(subject, Some(predicate), Some(object), None);
            quads.flatten().map(|quad| quad.subject).collect::<Vec<_>>()
        };
        let named = find(None, vocabulary::BROWSE_NAME, browse_name);
        named.into_iter().find_map(|subject| {
            let of = find(
                Some(subject.as_ref()),
                vocabulary::NODE_NAMESPACE,
                namespace,
            );
            match subject {
                NamedOrBlankNode::NamedNode(node) if !of.is_empty() => Some(node.into_string()),
                NamedOrBlankNode::NamedNode(_) | NamedOrBlankNode::BlankNode(_) => None,
            }
        })
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
        let store = self.store();
        let graphs = match graph.map(NamedNode::new) {
            Some(Ok(graph))
                if store
                    .contains_named_graph(&graph)
                    .map_err(io::Error::other)? =>
            {
                vec![graph.into()]
            }
            Some(_) => return Ok(None),
            None => store
                .named_graphs()
                .collect::<Result<Vec<NamedOrBlankNode>, _>>()
                .map_err(io::Error::other)?,
        };
        let mut to = RdfSerializer::from_format(RdfFormat::NQuads).for_writer(to);
        for graph in &graphs {
            let graph = GraphNameRef::from(graph.as_ref());
            for quad in store.quads_for_pattern(None, None, None, Some(graph)) {
                to.serialize_quad(&quad.map_err(io::Error::other)?)?;
            }
        }
        to.finish()?;
        Ok(Some(()))
    }

    /// Writes the statements of a graph. Returns `None` if there is no such graph.
    ///
    /// # Errors
    /// Fails if the store or the writer fails.
    pub(crate) fn write_triples(
        &self,
        graph: &str,
        format: RdfFormat,
        to: impl io::Write,
    ) -> io::Result<Option<()>> {
        let graph = NamedNodeRef::new(graph).map_err(io::Error::other)?;
        let store = self.store();
        if !store
            .contains_named_graph(graph)
            .map_err(io::Error::other)?
        {
            return Ok(None);
        }
        let mut to = RdfSerializer::from_format(format).for_writer(to);
        for quad in store.quads_for_pattern(None, None, None, Some(graph.into())) {
            to.serialize_triple(&Triple::from(quad.map_err(io::Error::other)?))?;
        }
        to.finish()?;
        Ok(Some(()))
    }

    /// Returns the current store. A copy may replace it at any time.
    pub(crate) fn store(&self) -> Store {
        let store = self.store.read().unwrap_or_else(PoisonError::into_inner);
        store.clone()
    }

    fn put(
        &self,
        source: &KnowledgeSource,
        triples: HashSet<Triple>,
        (at, lasting): (u64, SourceLifetime),
    ) -> Result<(), KnowledgeFault> {
        if triples.len() > MAX_STATEMENTS {
            return Err(KnowledgeFault::TooMany {
                most: MAX_STATEMENTS,
            });
        }
        let mut writer = self.writer();
        let mut writing = writer.begin()?;
        writing.lasting = lasting;
        writing.replace(source, triples)?;
        writing.commit(at)
    }
}

/// Copies the statements into a new store, which has nothing of removed statements.
fn copied(store: &Store) -> Result<Store, StorageError> {
    let new = Store::new()?;
    let mut transaction = new.start_transaction()?;
    for quad in store.quads_for_pattern(None, None, None, None) {
        transaction.insert(quad?.as_ref());
    }
    transaction.commit()?;
    Ok(new)
}

impl WrittenSources {
    /// Returns the number of present statements.
    fn kept(&self) -> usize {
        self.sources.values().map(|source| source.statements).sum()
    }

    /// Updates the rules and the status of the derived statements.
    pub(crate) fn derived(&mut self, change: Derived) {
        let derived = KnowledgeSource::new(SourceKind::Derived, "");
        let since_ms = self.sources.values().map(|source| source.since_ms).min();
        let known = self.sources.get(&derived);
        let known = known.map_or(0, |known| known.statements);
        let mut status = SourceStatus::new(&derived, since_ms.unwrap_or_default());
        let grown = known.saturating_add(change.added.len());
        status.statements = grown.saturating_sub(change.removed.len());
        self.sources.insert(derived, status);
        if let Some(rules) = change.rules {
            self.rules = rules;
        }
    }
}

impl SourceStatus {
    pub(crate) fn new(source: &KnowledgeSource, at: u64) -> Self {
        Self {
            graph: source.graph(),
            kind: source.kind,
            name: source.name.clone(),
            statements: 0,
            lasting: false,
            since_ms: at,
        }
    }
}

/// Reads the statements of a document. Names of blank nodes are made new.
fn parsed(format: RdfFormat, document: &[u8]) -> Result<HashSet<Triple>, KnowledgeFault> {
    let mut triples = HashSet::new();
    for quad in RdfParser::from_format(format)
        .without_named_graphs()
        .rename_blank_nodes()
        .for_slice(document)
    {
        let quad = quad.map_err(|error| KnowledgeFault::Turtle(described(&error)))?;
        triples.insert(Triple::from(quad));
        if triples.len() > MAX_STATEMENTS {
            return Err(KnowledgeFault::TooMany {
                most: MAX_STATEMENTS,
            });
        }
    }
    Ok(triples)
}

/// Describes a syntax error with its line.
fn described(error: &RdfSyntaxError) -> String {
    match error.location() {
        Some(location) => format!("line {}: {error}", location.start.line + 1),
        None => error.to_string(),
    }
}

impl fmt::Debug for Knowledge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Knowledge")
            .field("written", &self.written)
            .finish_non_exhaustive()
    }
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

pub(crate) fn named(iri: &str) -> Result<NamedNode, KnowledgeFault> {
    let text: String = iri.chars().take(200).collect();
    NamedNode::new(iri).map_err(|error| KnowledgeFault::Iri {
        text,
        why: error.to_string(),
    })
}

/// The base NodeSet, the largest published NodeSet, results in some 40 000; a graph of a user may
/// be larger.
pub(crate) const MAX_STATEMENTS: usize = 2_000_000;
pub(crate) const MAX_SOURCES: usize = 2000;
/// Number of removed statements that a store keeps in any case: copies are for large numbers.
const MOST_REMOVED: usize = 4096;
/// A change copies the store if the removed statements exceed this multiple of the present ones and
/// [`MOST_REMOVED`].
const MOST_OF_KEPT: usize = 4;
/// Number of copies after which changes wait for the next one.
const COPIES: usize = 3;

#[cfg(test)]
mod tests;
