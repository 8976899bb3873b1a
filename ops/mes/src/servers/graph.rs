//! The graph of a server: one connection at a time writes it, and it is removed with the
//! connection.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use knowledge::{Knowledge, KnowledgeSource, ServedSpace, SourceKind};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tracing::error;

use crate::cell::now;

/// The ApplicationUris of servers in the graph, each with the name of the server that has it.
#[derive(Debug, Clone)]
pub(super) struct ServerUris(watch::Sender<BTreeMap<String, String>>);

impl Default for ServerUris {
    fn default() -> Self {
        Self(watch::Sender::new(BTreeMap::new()))
    }
}

impl ServerUris {
    /// Takes an ApplicationUri for a server.
    ///
    /// # Errors
    /// The name of the server that has it.
    pub(super) fn take(&self, uri: &str, name: &str) -> Result<TakenUri, String> {
        let mut owner = None;
        self.0.send_if_modified(|taken| match taken.get(uri) {
            Some(known) => {
                owner = Some(known.clone());
                false
            }
            None => {
                taken.insert(uri.to_owned(), name.to_owned());
                true
            }
        });
        match owner {
            Some(owner) => Err(owner),
            None => Ok(TakenUri {
                uris: self.clone(),
                uri: uri.to_owned(),
            }),
        }
    }

    /// Waits until no server has an ApplicationUri.
    pub(super) async fn free(&self, uri: &str) {
        let mut taken = self.0.subscribe();
        // The sender lives as long as this value.
        drop(taken.wait_for(|taken| !taken.contains_key(uri)).await);
    }
}

/// An ApplicationUri that is in use until this value is dropped.
#[derive(Debug)]
pub(super) struct TakenUri {
    uris: ServerUris,
    uri: String,
}

impl Drop for TakenUri {
    fn drop(&mut self) {
        self.uris
            .0
            .send_modify(|taken| drop(taken.remove(&self.uri)));
    }
}

/// The graph of a connected server. It is removed when this value is dropped, and its
/// ApplicationUri is free after that.
pub(super) struct ServerGraph {
    open: Arc<OpenGraph>,
    taken: Option<TakenUri>,
}

struct OpenGraph {
    knowledge: Arc<Knowledge>,
    source: KnowledgeSource,
    /// Set with the removal, so that a late write does not restore the graph.
    is_closed: Mutex<bool>,
}

impl ServerGraph {
    pub(super) fn new(knowledge: Arc<Knowledge>, taken: TakenUri) -> Self {
        let source = KnowledgeSource::new(SourceKind::Server, &taken.uri);
        Self {
            open: Arc::new(OpenGraph {
                knowledge,
                source,
                is_closed: Mutex::default(),
            }),
            taken: Some(taken),
        }
    }

    /// Returns the IRI of the graph.
    pub(super) fn iri(&self) -> String {
        self.open.source.graph()
    }

    /// Replaces the graph. Returns the number of its statements.
    ///
    /// # Errors
    /// The reason for people.
    pub(super) async fn write(&self, space: ServedSpace) -> Result<usize, String> {
        let open = Arc::clone(&self.open);
        // Tens of thousands of statements take longer than a task may.
        let written = tokio::task::spawn_blocking(move || open.write(&space));
        written
            .await
            .unwrap_or_else(|error| Err(format!("the graph cannot be written: {error}")))
    }
}

impl OpenGraph {
    fn write(&self, space: &ServedSpace) -> Result<usize, String> {
        let is_closed = self.is_closed.lock();
        let is_closed = is_closed.unwrap_or_else(PoisonError::into_inner);
        if *is_closed {
            return Ok(0);
        }
        let sources = self.knowledge.sources().into_iter();
        let nodesets = sources.filter(|source| source.kind == SourceKind::NodeSet);
        let known: Vec<String> = nodesets.map(|source| source.name).collect();
        let triples = space.triples(&|namespace| known.iter().any(|known| known == namespace));
        let count = triples.len();
        let written = self
            .knowledge
            .replace_ontology(&self.source, triples, now());
        written.map(|()| count).map_err(|fault| fault.to_string())
    }

    fn close(&self) {
        let is_closed = self.is_closed.lock();
        let mut is_closed = is_closed.unwrap_or_else(PoisonError::into_inner);
        *is_closed = true;
        if let Err(fault) = self.knowledge.remove(&self.source) {
            let source = &self.source.name;
            error!(source, "cannot remove the graph of a server: {fault}");
        }
    }
}

impl Drop for ServerGraph {
    fn drop(&mut self) {
        let open = Arc::clone(&self.open);
        let taken = self.taken.take();
        let close = move || {
            open.close();
            drop(taken);
        };
        match Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(close)),
            Err(_) => close(),
        }
    }
}
