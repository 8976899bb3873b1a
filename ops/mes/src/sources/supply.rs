//! NodeSets that others require, from the URL of the YAML.
//!
//! A reading of the YAML takes files of earlier fetches only. A task of its own fetches the others,
//! one after the other, so that neither a request nor the program waits for a server.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use knowledge::nodeset::{ModelVersion, NodeSetModel};
use knowledge::{KnowledgeSource, SourceKind, SourceLifetime};
use tokio::task::{JoinError, spawn_blocking};
use tokio::time::timeout;
use tracing::{error, info, warn};

use super::{Finding, MesSources, finding};
use crate::nodeset_url::{self, NodeSetFetchError, NodeSetFetcher, NodeSetUrl};

/// The NodeSets that are completed from a URL.
#[derive(Debug, Default)]
pub(super) struct NodeSetSupply {
    url: Option<Arc<NodeSetUrl>>,
    /// The NodeSets whose required models are fetched, by their namespaces.
    requirers: BTreeMap<String, NodeSetRequirer>,
    /// The namespaces without a NodeSet, with the reason, since the last reading of the YAML.
    failed: BTreeMap<String, FailedFetch>,
    /// The number of fetches since the last reading of the YAML or pause.
    fetches: usize,
    /// The number of fetched bytes since the last reading of the YAML.
    bytes: usize,
}

/// A NodeSet whose required models are fetched.
#[derive(Debug, Clone)]
struct NodeSetRequirer {
    model: NodeSetModel,
    lasting: SourceLifetime,
    /// The number of NodeSets between it and a NodeSet that was named or added; 0 for the latter.
    depth: usize,
}

#[derive(Debug)]
struct FailedFetch {
    why: String,
    is_transient: bool,
}

/// A namespace without a NodeSet, and its place among the NodeSets that require it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct MissingNodeSet {
    namespace: String,
    /// The version that is required.
    version: ModelVersion,
    lasting: SourceLifetime,
    depth: usize,
}

impl NodeSetRequirer {
    /// A NodeSet that was added by command.
    const fn added(model: NodeSetModel) -> Self {
        Self {
            model,
            lasting: SourceLifetime::Yes,
            depth: 0,
        }
    }
}

impl NodeSetSupply {
    /// Returns the first namespace that a NodeSet requires, that is neither known nor was tried
    /// before, and that is wanted.
    fn missing(
        &self,
        known: &BTreeMap<String, ModelVersion>,
        is_wanted: impl Fn(&str) -> bool,
    ) -> Option<MissingNodeSet> {
        let mut all = self.requirers.values().flat_map(|requirer| {
            let required = requirer.model.required.iter();
            required.map(move |(namespace, version)| (requirer, namespace, version))
        });
        let is_missing = |namespace: &String| {
            !known.contains_key(namespace)
                && !self.failed.contains_key(namespace)
                && is_wanted(namespace)
        };
        let (requirer, namespace, version) = all.find(|(_, namespace, _)| is_missing(namespace))?;
        Some(MissingNodeSet {
            namespace: namespace.clone(),
            version: version.clone(),
            lasting: requirer.lasting,
            depth: requirer.depth.saturating_add(1),
        })
    }

    /// Returns why nothing more is fetched, if a limit is reached.
    fn exceeded(&self, missing: &MissingNodeSet) -> Option<String> {
        if missing.depth > DEEPEST {
            Some(format!(
                "more than {DEEPEST} NodeSets require one another in turn"
            ))
        } else if self.fetches >= MOST_FETCHES {
            Some(format!("at most {MOST_FETCHES} NodeSets are fetched"))
        } else if self.bytes >= MOST_BYTES {
            Some(format!(
                "at most {} MiB of NodeSets are fetched",
                MOST_BYTES >> 20
            ))
        } else {
            None
        }
    }

    fn failed(&mut self, namespace: &str, why: String, is_transient: bool) {
        let failed = FailedFetch { why, is_transient };
        self.failed.insert(namespace.to_owned(), failed);
    }

    /// Returns the findings of a NodeSet that requires others.
    fn findings(
        &self,
        url: &NodeSetUrl,
        requirer: &NodeSetRequirer,
        known: &BTreeMap<String, ModelVersion>,
    ) -> Vec<String> {
        let by = &requirer.model.namespace;
        let required = requirer.model.required.iter();
        let required = required.filter(|(namespace, _)| namespace != by);
        let findings = required.filter_map(|(namespace, required)| {
            let known = known.get(namespace);
            match (known, self.failed.get(namespace)) {
                (Some(version), _) if version.is_older_than(required) => Some(format!(
                    "{by} requires {namespace} in the {required} or newer, and the NodeSet that \
                     is there has the {version}; give a newer file"
                )),
                (Some(_), _) => None,
                (None, Some(FailedFetch { why, .. })) => Some(format!(
                    "{by} requires {namespace}, which cannot be fetched from {url}: {why}"
                )),
                (None, None) => Some(format!(
                    "{by} requires {namespace}, which is fetched from {url}"
                )),
            }
        });
        findings.collect()
    }
}

impl MesSources {
    /// Keeps fetched NodeSets in a folder, for the next start of the program.
    pub(crate) fn cached_in(mut self, folder: Option<PathBuf>) -> Self {
        self.cache = folder;
        self
    }

    /// Begins to complete NodeSets anew from a URL, or from none: those of the YAML, and those that
    /// were added by command. Earlier NodeSets of the same URL are kept, and others are read from
    /// the cache; both are added to `named`.
    pub(super) fn supply_anew(
        &self,
        url: Option<&NodeSetUrl>,
        (models, stored): (Vec<NodeSetModel>, Vec<NodeSetModel>),
        named: &mut BTreeSet<KnowledgeSource>,
        known: &mut BTreeMap<String, ModelVersion>,
    ) {
        let earlier = std::mem::take(&mut self.state().supply);
        let is_same = earlier.url.as_deref() == url;
        let mut requirers = earlier.requirers;
        let mut kept = requirers.clone();
        kept.retain(|_, requirer| is_same && requirer.lasting == SourceLifetime::No);
        requirers.retain(|_, requirer| requirer.lasting == SourceLifetime::Yes);
        for model in stored {
            let requirer = NodeSetRequirer::added(model);
            let namespace = requirer.model.namespace.clone();
            requirers.entry(namespace).or_insert(requirer);
        }
        for namespace in requirers.keys().filter(|_| url.is_some()) {
            let source = KnowledgeSource::new(SourceKind::NodeSet, namespace);
            self.state().findings.remove(&source);
        }
        requirers.extend(models.into_iter().map(|model| {
            let requirer = NodeSetRequirer {
                model,
                lasting: SourceLifetime::No,
                depth: 0,
            };
            (requirer.model.namespace.clone(), requirer)
        }));
        let mut supply = NodeSetSupply {
            url: url.cloned().map(Arc::new),
            requirers,
            ..NodeSetSupply::default()
        };
        let mut skipped: BTreeSet<String> = BTreeSet::new();
        while let Some(url) = url
            && let Some(missing) = supply.missing(known, |name| !skipped.contains(name))
        {
            let namespace = missing.namespace.clone();
            let source = KnowledgeSource::new(SourceKind::NodeSet, &namespace);
            // A NodeSet that only the YAML required is not in the journal. If an added NodeSet
            // requires it, it has to be in the journal too.
            let kept = kept.remove(&namespace);
            let kept =
                kept.filter(|kept| kept.lasting == missing.lasting && self.is_known(&source));
            let model = kept.map(|requirer| requirer.model);
            let model = match supply.exceeded(&missing) {
                None => model.or_else(|| self.cached(url, &missing, true)),
                Some(_) => None,
            };
            let Some(model) = model else {
                skipped.insert(namespace);
                continue;
            };
            match missing.lasting {
                SourceLifetime::No => drop(named.insert(source)),
                SourceLifetime::Yes => drop(self.state().of_yaml.remove(&source)),
            }
            known.insert(namespace.clone(), model.version.clone());
            supply.requirers.insert(namespace, missing.requirer(model));
        }
        self.state().supply = supply;
        self.show_supply();
        self.wanted.notify_one();
    }

    /// Completes a NodeSet that was added while the program runs.
    pub(super) fn supply_for(&self, model: NodeSetModel) {
        let requirer = NodeSetRequirer::added(model);
        let namespace = requirer.model.namespace.clone();
        let mut state = self.state();
        state.supply.failed.remove(&namespace);
        state.supply.requirers.insert(namespace, requirer);
        drop(state);
        self.show_supply();
        self.wanted.notify_one();
    }

    /// Stops to complete a NodeSet, which was removed. It is not fetched again at once.
    pub(super) fn supply_without(&self, namespace: &str) {
        let mut state = self.state();
        state.supply.requirers.remove(namespace);
        let why = "it was removed; SIGHUP fetches it again".to_owned();
        state.supply.failed(namespace, why, false);
        drop(state);
        self.show_supply();
    }

    /// Returns the models that a NodeSet requires and that would be fetched.
    pub(super) fn would_fetch(&self, model: &NodeSetModel) -> Vec<String> {
        let url = self.state().supply.url.clone();
        let requirer = NodeSetRequirer::added(model.clone());
        let known = self.known_node_sets();
        url.map_or_else(Vec::new, |url| {
            NodeSetSupply::default().findings(&url, &requirer, &known)
        })
    }

    /// Returns the URL and the namespace that is fetched next, if any.
    fn next_fetch(&self) -> Option<(Arc<NodeSetUrl>, String)> {
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        let known = self.known_node_sets();
        let mut state = self.state();
        let supply = &mut state.supply;
        let url = Arc::clone(supply.url.as_ref()?);
        while let Some(missing) = supply.missing(&known, |_| true) {
            match supply.exceeded(&missing) {
                None => {
                    supply.fetches = supply.fetches.saturating_add(1);
                    return Some((url, missing.namespace));
                }
                Some(why) => supply.failed(&missing.namespace, why, false),
            }
        }
        drop(state);
        self.show_supply();
        None
    }

    /// Adds a fetched NodeSet to the graph, unless it is not required any more. A failure is a
    /// finding of the NodeSets that require it.
    pub(super) fn deliver(
        &self,
        url: &Arc<NodeSetUrl>,
        namespace: &str,
        fetched: Result<Bytes, NodeSetFetchError>,
    ) {
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        let known = self.known_node_sets();
        let state = self.state();
        let is_same = state.supply.url.as_ref() == Some(url);
        let missing = state.supply.missing(&known, |name| name == namespace);
        drop(state);
        let Some(missing) = missing.filter(|_| is_same) else {
            return;
        };
        let bytes = fetched.as_ref().map_or(0, Bytes::len);
        let supplied = fetched.and_then(|bytes| {
            let read = nodeset_url::read(&bytes, namespace)?;
            self.keep_file(url, namespace, &bytes);
            Ok(read)
        });
        let supplied = match supplied {
            Ok(read) => self
                .supply_with(&missing, &read.triples)
                .map(|()| read.model)
                .map_err(|why| (why, false)),
            // A file of an earlier fetch, though it is older than required.
            Err(error) => self
                .cached(url, &missing, false)
                .ok_or_else(|| (error.to_string(), error.is_transient())),
        };
        let mut state = self.state();
        state.supply.bytes = state.supply.bytes.saturating_add(bytes);
        match supplied {
            Ok(model) => {
                info!("{namespace} was added from {url}");
                if missing.lasting == SourceLifetime::No {
                    let source = KnowledgeSource::new(SourceKind::NodeSet, namespace);
                    state.of_yaml.insert(source);
                }
                let requirer = missing.requirer(model);
                state
                    .supply
                    .requirers
                    .insert(namespace.to_owned(), requirer);
            }
            Err((why, is_transient)) => {
                warn!(namespace, "cannot fetch a NodeSet from {url}: {why}");
                state.supply.failed(namespace, why, is_transient);
            }
        }
        drop(state);
        self.show_supply();
    }

    fn supply_with(&self, missing: &MissingNodeSet, triples: &[mtp::Triple]) -> Result<(), String> {
        let source = KnowledgeSource::new(SourceKind::NodeSet, &missing.namespace);
        self.put(&source, triples, missing.lasting)
    }

    /// Adds a NodeSet of the cache to the graph, if the cache has it. `is_new` asks for a NodeSet
    /// that is not older than required.
    fn cached(
        &self,
        url: &NodeSetUrl,
        missing: &MissingNodeSet,
        is_new: bool,
    ) -> Option<NodeSetModel> {
        let path = self.cache_file(url, &missing.namespace)?;
        let bytes = bridge_node::read_bounded(&path, super::LARGEST).ok()?;
        // A damaged file is fetched again.
        let read = nodeset_url::read(&bytes, &missing.namespace).ok()?;
        if is_new && read.model.version.is_older_than(&missing.version) {
            return None;
        }
        let added = self.supply_with(missing, &read.triples);
        added.ok().map(|()| read.model)
    }

    /// Writes a fetched file into the cache.
    fn keep_file(&self, url: &NodeSetUrl, namespace: &str, bytes: &[u8]) {
        let Some(path) = self.cache_file(url, namespace) else {
            return;
        };
        let write = || -> io::Result<()> {
            if let Some(folder) = path.parent() {
                fs::create_dir_all(folder)?;
            }
            let new = path.with_extension("new");
            fs::write(&new, bytes)?;
            fs::rename(&new, &path)
        };
        if let Err(error) = write() {
            let path = path.display();
            warn!(%error, "cannot keep {namespace} for the next start in {path}");
        }
    }

    fn cache_file(&self, url: &NodeSetUrl, namespace: &str) -> Option<PathBuf> {
        let name = nodeset_url::file_name(namespace).ok()?;
        let folder = self.cache.as_ref()?.join(FOLDER).join(url.folder_name());
        Some(folder.join(format!("{name}.xml")))
    }

    /// Updates the findings of the NodeSets that require others.
    fn show_supply(&self) {
        let known = self.known_node_sets();
        let mut state = self.state();
        let Some(url) = state.supply.url.clone() else {
            return;
        };
        let all = state.supply.requirers.values();
        let all: Vec<(KnowledgeSource, Vec<Finding>)> = all
            .map(|requirer| {
                let name = &requirer.model.namespace;
                let source = KnowledgeSource::new(SourceKind::NodeSet, name);
                let found = state.supply.findings(&url, requirer, &known).into_iter();
                let found = found.map(|what| finding(&source, what, false)).collect();
                (source, found)
            })
            .collect();
        state.findings.extend(all);
    }

    /// Forgets the fetches that may succeed later. Returns whether there are any.
    fn retry(&self) -> bool {
        let supply = &mut self.state().supply;
        let before = supply.failed.len();
        supply.failed.retain(|_, failed| !failed.is_transient);
        supply.fetches = 0;
        supply.failed.len() < before
    }
}

impl MissingNodeSet {
    const fn requirer(&self, model: NodeSetModel) -> NodeSetRequirer {
        NodeSetRequirer {
            model,
            lasting: self.lasting,
            depth: self.depth,
        }
    }
}

/// Fetches NodeSets for as long as the program runs.
pub(crate) async fn supply(sources: Arc<MesSources>) {
    loop {
        let is_wanted = timeout(RETRY, sources.wanted.notified()).await.is_ok();
        if !is_wanted && !sources.retry() {
            continue;
        }
        if let Err(error) = fetch_all(&sources).await {
            error!("cannot fetch NodeSets: {error}");
        }
    }
}

async fn fetch_all(sources: &Arc<MesSources>) -> Result<(), JoinError> {
    let mut fetcher: Option<NodeSetFetcher> = None;
    loop {
        let next = Arc::clone(sources);
        let Some((url, namespace)) = spawn_blocking(move || next.next_fetch()).await? else {
            return Ok(());
        };
        let usable = fetcher.take().filter(|fetcher| *fetcher.url() == url);
        let fetcher = fetcher.insert(usable.unwrap_or_else(|| NodeSetFetcher::new(url)));
        let fetched = fetcher.fetch(&namespace).await;
        let (url, sources) = (Arc::clone(fetcher.url()), Arc::clone(sources));
        spawn_blocking(move || sources.deliver(&url, &namespace, fetched)).await?;
    }
}

/// The folder of fetched NodeSets in the folder of the program.
const FOLDER: &str = "nodesets";
/// Maximum number of NodeSets that require one another in turn.
const DEEPEST: usize = 16;
/// Maximum number of fetches after a reading of the YAML, and after each pause.
const MOST_FETCHES: usize = 64;
/// Maximum number of fetched bytes between two readings of the YAML; the last file may exceed it.
const MOST_BYTES: usize = 256 << 20;
/// Pause before a server that did not answer is asked again.
const RETRY: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests;
