//! The graph of a server: one connection at a time writes it, and it is removed with the
//! connection.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use knowledge::{Knowledge, KnowledgeSource, ServedSpace, SourceKind};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tracing::error;

use crate::clock::now;

/// The ApplicationUris of servers in the graph, each with the name of the server that has it.
#[derive(Debug, Clone)]
pub(super) struct ServerUris(watch::Sender<UriOwners>);

#[derive(Debug, Default)]
struct UriOwners {
    /// The names of servers by their ApplicationUris.
    taken: BTreeMap<String, String>,
    /// ApplicationUris and names of servers that have entries of their own.
    claimed: BTreeSet<(String, String)>,
}

impl UriOwners {
    fn claimant(&self, uri: &str) -> Option<&String> {
        let first = (uri.to_owned(), String::new());
        let found = self.claimed.range(first..).next();
        found
            .filter(|(claimed, _)| claimed == uri)
            .map(|(_, name)| name)
    }
}

impl Default for ServerUris {
    fn default() -> Self {
        Self(watch::Sender::new(UriOwners::default()))
    }
}

impl ServerUris {
    /// Claims an ApplicationUri for a server that has an entry of its own: a server that only
    /// discovery found gives it back.
    pub(super) fn claim(&self, uri: &str, name: &str) -> UriClaim {
        let claim = (uri.to_owned(), name.to_owned());
        self.0.send_modify(|owners| {
            let _is_new = owners.claimed.insert(claim.clone());
        });
        UriClaim {
            uris: self.clone(),
            claim,
        }
    }

    /// Takes an ApplicationUri for a server, which has a claim or `only_discovered`.
    ///
    /// # Errors
    /// The name of the server that has it.
    pub(super) fn take(
        &self,
        uri: &str,
        name: &str,
        only_discovered: bool,
    ) -> Result<TakenUri, String> {
        let mut owner = None;
        self.0.send_if_modified(|owners| {
            let claimant = owners.claimant(uri).filter(|_| only_discovered);
            owner = owners.taken.get(uri).or(claimant).cloned();
            if owner.is_none() {
                owners.taken.insert(uri.to_owned(), name.to_owned());
            }
            owner.is_none()
        });
        match owner {
            Some(owner) => Err(owner),
            None => Ok(TakenUri {
                uris: self.clone(),
                uri: uri.to_owned(),
            }),
        }
    }

    /// Waits until no server has an ApplicationUri; with `only_discovered` also until no server
    /// claims it.
    pub(super) async fn free(&self, uri: &str, only_discovered: bool) {
        let mut owners = self.0.subscribe();
        let is_free = |owners: &UriOwners| {
            let is_claimed = only_discovered && owners.claimant(uri).is_some();
            !is_claimed && !owners.taken.contains_key(uri)
        };
        // The sender lives as long as this value.
        drop(owners.wait_for(is_free).await);
    }

    /// Waits until a server with an entry of its own claims an ApplicationUri.
    pub(super) async fn claimed(&self, uri: &str) {
        let mut owners = self.0.subscribe();
        // The sender lives as long as this value.
        drop(
            owners
                .wait_for(|owners| owners.claimant(uri).is_some())
                .await,
        );
    }

    /// Returns the ApplicationUris of servers in the graph.
    pub(super) fn all(&self) -> Vec<String> {
        self.0.borrow().taken.keys().cloned().collect()
    }
}

/// The claim of an ApplicationUri, which ends when this value is dropped.
#[derive(Debug)]
pub(super) struct UriClaim {
    uris: ServerUris,
    claim: (String, String),
}

impl Drop for UriClaim {
    fn drop(&mut self) {
        self.uris.0.send_modify(|owners| {
            let _was_there = owners.claimed.remove(&self.claim);
        });
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
            .send_modify(|owners| drop(owners.taken.remove(&self.uri)));
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

    /// Replaces the graph, without the types of some namespaces. Returns the number of its
    /// statements.
    ///
    /// # Errors
    /// The reason for people.
    pub(super) async fn write(
        &self,
        space: ServedSpace,
        left_out: BTreeSet<String>,
    ) -> Result<usize, String> {
        let open = Arc::clone(&self.open);
        // Tens of thousands of statements take longer than a task may.
        let written = tokio::task::spawn_blocking(move || open.write(&space, &left_out));
        written
            .await
            .unwrap_or_else(|error| Err(format!("the graph cannot be written: {error}")))
    }
}

impl OpenGraph {
    fn write(&self, space: &ServedSpace, left_out: &BTreeSet<String>) -> Result<usize, String> {
        let is_closed = self.is_closed.lock();
        let is_closed = is_closed.unwrap_or_else(PoisonError::into_inner);
        if *is_closed {
            return Ok(0);
        }
        let triples = space.triples(&|namespace| left_out.contains(namespace));
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
