//! Changes of the store: statements of graphs, their merge, and the derived statements.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use oxigraph::model::{GraphNameRef, NamedNode, Triple};
use oxigraph::store::{StorageError, Transaction};
use tokio::sync::watch;

use crate::journal::Record;
use crate::rules::apply::Derived;
use crate::rules::{Extent, Schema};
use crate::source::{DERIVED, KnowledgeSource, SourceKind};
use crate::store::{
    KnowledgeFault, MAX_SOURCES, MAX_STATEMENTS, SourceLifetime, SourceStatus, WrittenSources,
    named,
};

/// A change of a graph: the statements that it removes and adds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct GraphChange {
    pub(crate) removed: Vec<Triple>,
    pub(crate) added: Vec<Triple>,
}

/// A change of the store. It is undone when it is dropped before the commit.
pub(crate) struct StoreChange<'a> {
    pub(crate) written: &'a mut WrittenSources,
    pub(crate) transaction: Transaction<'a>,
    changed: &'a watch::Sender<u64>,
    /// Whether the change is about the schema of the rules.
    is_of_schema: bool,
    /// The changed statements, if the rules need them.
    touched: HashSet<Triple>,
    /// The changes for the journal.
    changes: BTreeMap<KnowledgeSource, GraphChange>,
    /// Sources that are replaced as a whole, with all their statements.
    whole: BTreeMap<KnowledgeSource, HashSet<Triple>>,
    removed: BTreeSet<KnowledgeSource>,
    /// Number of removed statements.
    removed_statements: usize,
    /// Number of added statements. The store keeps them if the change is undone, so that they count
    /// as removed until the commit.
    added_statements: usize,
    pub(crate) lasting: SourceLifetime,
}

impl<'a> StoreChange<'a> {
    /// Begins a change of lasting sources.
    pub(crate) fn new(
        written: &'a mut WrittenSources,
        transaction: Transaction<'a>,
        changed: &'a watch::Sender<u64>,
    ) -> Self {
        Self {
            written,
            transaction,
            changed,
            is_of_schema: false,
            touched: HashSet::new(),
            changes: BTreeMap::new(),
            whole: BTreeMap::new(),
            removed: BTreeSet::new(),
            removed_statements: 0,
            added_statements: 0,
            lasting: SourceLifetime::Yes,
        }
    }

    /// Removes the status of a source with the commit.
    pub(crate) fn remove(&mut self, source: &KnowledgeSource) {
        self.removed.insert(source.clone());
    }
    /// Returns the transaction, for queries that see the changes.
    pub(crate) fn transaction(&self) -> &Transaction<'_> {
        &self.transaction
    }

    /// Returns the sources.
    pub(crate) fn sources(&self) -> impl Iterator<Item = &KnowledgeSource> {
        self.written.sources.keys().chain(self.changes.keys())
    }

    /// Returns the statements of a source.
    pub(crate) fn triples(
        &self,
        source: &KnowledgeSource,
    ) -> Result<HashSet<Triple>, KnowledgeFault> {
        let graph = named(&source.graph())?;
        let quads =
            self.transaction
                .quads_for_pattern(None, None, None, Some(graph.as_ref().into()));
        let triples = quads.map(|quad| quad.map(Triple::from));
        Ok(triples.collect::<Result<_, _>>()?)
    }

    pub(crate) fn replace(
        &mut self,
        source: &KnowledgeSource,
        triples: HashSet<Triple>,
    ) -> Result<(), KnowledgeFault> {
        let graph = named(&source.graph())?;
        let (added, removed) = difference(&self.transaction, &graph, &triples)?;
        self.change(source, GraphChange { removed, added })?;
        self.changes.remove(source);
        // The journal has literals as the store has them, so that a later removal finds them.
        let whole = match self.lasting {
            SourceLifetime::Yes => self.triples(source)?,
            SourceLifetime::No => triples,
        };
        self.whole.insert(source.clone(), whole);
        Ok(())
    }

    /// Changes the statements of a source. Statements that are there already, or are not there,
    /// are left as they are. Returns the number of changed statements.
    pub(crate) fn change(
        &mut self,
        source: &KnowledgeSource,
        change: GraphChange,
    ) -> Result<usize, KnowledgeFault> {
        if source.kind == SourceKind::Derived {
            return Err(KnowledgeFault::Derived);
        }
        let is_new = !self.written.sources.contains_key(source)
            && !self.changes.contains_key(source)
            && !self.whole.contains_key(source);
        if is_new && self.written.sources.len() + self.changes.len() >= MAX_SOURCES {
            return Err(KnowledgeFault::TooManySources { most: MAX_SOURCES });
        }
        let graph = named(&source.graph())?;
        let mut effective = GraphChange::default();
        for triple in &change.removed {
            if let Some(known) = stored(&self.transaction, &graph, triple)? {
                self.transaction.remove(known.as_ref().in_graph(&graph));
                effective.removed.push(known);
            }
        }
        for triple in &change.added {
            if stored(&self.transaction, &graph, triple)?.is_none() {
                self.transaction.insert(triple.as_ref().in_graph(&graph));
                self.added_statements += 1;
                self.written.removed += 1;
                effective
                    .added
                    .extend(stored(&self.transaction, &graph, triple)?);
            }
        }
        merge(
            &mut self.transaction,
            &graph,
            &effective.added,
            &effective.removed,
        )?;
        let extent = self.written.rules.extent();
        let all = || effective.added.iter().chain(&effective.removed);
        self.is_of_schema |= all().any(|triple| Schema::has(triple, extent));
        if extent == Extent::OwlRl {
            self.touched.extend(all().cloned());
        }
        self.removed_statements += effective.removed.len();
        let count = effective.added.len() + effective.removed.len();
        let kept = self.changes.entry(source.clone()).or_default();
        kept.then(effective);
        Ok(count)
    }

    /// Stores the changes of lasting sources, and makes all changes visible.
    ///
    /// # Errors
    /// [`KnowledgeFault`]; then nothing has changed.
    pub(crate) fn commit(mut self, at: u64) -> Result<(), KnowledgeFault> {
        let mut statuses: Vec<(KnowledgeSource, SourceStatus)> = Vec::new();
        for source in self.changes.keys().chain(self.whole.keys()) {
            if self.removed.contains(source) {
                continue;
            }
            let known = self.written.sources.get(source);
            let mut status = known
                .cloned()
                .unwrap_or_else(|| SourceStatus::new(source, at));
            status.statements = match (self.whole.get(source), self.changes.get(source)) {
                (Some(triples), _) => triples.len(),
                (None, Some(change)) => {
                    let grown = status.statements.saturating_add(change.added.len());
                    grown.saturating_sub(change.removed.len())
                }
                (None, None) => status.statements,
            };
            if status.statements > MAX_STATEMENTS {
                return Err(KnowledgeFault::TooMany {
                    most: MAX_STATEMENTS,
                });
            }
            if source.kind == SourceKind::Graph && status.statements == 0 {
                self.removed.insert(source.clone());
                continue;
            }
            let was_lasting = status.lasting;
            status.lasting = self.lasting == SourceLifetime::Yes && self.written.journal.is_some();
            if was_lasting && !status.lasting {
                self.removed.insert(source.clone());
            }
            statuses.push((source.clone(), status));
        }
        let rules = &self.written.rules;
        let derived = if self.is_of_schema {
            rules.after_schema(&self.transaction, &self.touched)?
        } else {
            rules.after(&self.transaction, &self.touched)?
        };
        derive(&mut self.transaction, &derived)?;
        self.removed_statements += derived.removed.len();
        self.added_statements += derived.added.len();
        self.written.removed += derived.added.len();
        let written = &mut *self.written;
        if let Some(journal) = &mut written.journal {
            let known = &written.sources;
            let removed = self
                .removed
                .iter()
                .filter(|source| known.get(*source).is_some_and(|known| known.lasting));
            let mut records: Vec<_> = removed.map(|source| Record::Remove { source }).collect();
            if self.lasting == SourceLifetime::Yes {
                let puts = self.whole.iter();
                let puts = puts.filter(|(source, _)| !self.removed.contains(*source));
                records.extend(puts.map(|(source, triples)| Record::Put {
                    source,
                    at,
                    triples,
                }));
                let changes = self.changes.iter();
                let changes = changes.filter(|(source, _)| !self.removed.contains(*source));
                records.extend(changes.map(|(source, change)| Record::Change {
                    source,
                    at,
                    change,
                }));
            }
            journal.append(&records)?;
        }
        self.transaction.commit()?;
        for source in &self.removed {
            written.sources.remove(source);
        }
        written.sources.extend(statuses);
        let undone = written.removed.saturating_sub(self.added_statements);
        written.removed = undone.saturating_add(self.removed_statements);
        written.derived(derived);
        self.changed.send_modify(|changes| *changes += 1);
        Ok(())
    }
}

impl GraphChange {
    /// Adds a later change.
    fn then(&mut self, later: Self) {
        // The removal of an added statement undoes the addition.
        let mut removed: HashSet<Triple> = later.removed.into_iter().collect();
        self.added.retain(|triple| !removed.remove(triple));
        self.removed.extend(removed);
        self.added.extend(later.added);
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

/// Changes the graph of derived statements.
pub(crate) fn derive(
    transaction: &mut Transaction<'_>,
    derived: &Derived,
) -> Result<(), KnowledgeFault> {
    let graph = named(DERIVED)?;
    let Derived { added, removed, .. } = derived;
    for triple in removed {
        transaction.remove(triple.as_ref().in_graph(&graph));
    }
    for triple in added {
        transaction.insert(triple.as_ref().in_graph(&graph));
    }
    Ok(merge(transaction, &graph, added, removed)?)
}

/// Updates the default graph after a change of a graph.
fn merge(
    transaction: &mut Transaction<'_>,
    graph: &NamedNode,
    added: &[Triple],
    removed: &[Triple],
) -> Result<(), StorageError> {
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

/// Returns a statement of a graph as the store has it: literals are in their canonical form.
fn stored(
    transaction: &Transaction<'_>,
    graph: &NamedNode,
    triple: &Triple,
) -> Result<Option<Triple>, StorageError> {
    let mut quads = transaction.quads_for_pattern(
        Some(triple.subject.as_ref()),
        Some(triple.predicate.as_ref()),
        Some(triple.object.as_ref()),
        Some(graph.into()),
    );
    let quad = quads.next().transpose()?;
    Ok(quad.map(Triple::from))
}
