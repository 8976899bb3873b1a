//! NodeSets that others require, from the folder of the YAML.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use knowledge::nodeset::{ModelVersion, NodeSetModel};
use knowledge::{KnowledgeSource, SourceKind, SourceLifetime};
use tracing::{info, warn};

use super::{Finding, MesSources, bytes, decoded, finding, node_set};
use crate::nodeset_folder::{FolderNodeSet, NodeSetFolder};
use crate::settings::Source;

impl MesSources {
    /// Reads the folder of NodeSets. A folder that cannot be read completes NodeSets as before.
    pub(super) fn read_folder(
        &self,
        of_yaml: &Source,
        earlier: Option<Arc<NodeSetFolder>>,
        named: &mut BTreeSet<KnowledgeSource>,
    ) {
        let source = KnowledgeSource::new(SourceKind::NodeSet, &of_yaml.name);
        named.insert(source.clone());
        let mut folder = earlier.filter(|folder| folder.path() == of_yaml.path);
        self.try_one(source, |source| {
            let read = NodeSetFolder::read(&of_yaml.path, folder.as_deref())?;
            for what in read.findings() {
                self.found(source, what, false);
            }
            folder = Some(Arc::new(read));
            Ok(())
        });
        self.state().folder = folder;
    }

    /// Adds the NodeSets that a NodeSet requires from the folder, if there is one, and adds them to
    /// `known`. Models that are missing or too old are findings of the NodeSet.
    pub(super) fn complete(
        &self,
        source: &KnowledgeSource,
        model: &NodeSetModel,
        known: &mut BTreeMap<String, ModelVersion>,
        lasting: SourceLifetime,
    ) -> Vec<KnowledgeSource> {
        let folder = self.state().folder.clone();
        let Some(folder) = folder else {
            return Vec::new();
        };
        let mut taken: BTreeSet<String> = BTreeSet::new();
        let mut faults: BTreeMap<String, Vec<String>> = BTreeMap::new();
        let completion = folder.complete(model, known, &mut |file| {
            let namespace = file.model.namespace.clone();
            let path = file.path.display();
            match self.take_file(file, lasting) {
                Ok(()) => {
                    info!(source = source.name, "{namespace} was added from {path}");
                    taken.insert(namespace);
                    true
                }
                Err(what) => {
                    let of_namespace = faults.entry(namespace.clone()).or_default();
                    of_namespace.push(format!("{path}: {what}"));
                    // An older file does not replace contents that this file gave before.
                    let is_kept = self.has_version(&file.model);
                    if is_kept {
                        taken.insert(namespace);
                    }
                    is_kept
                }
            }
        });
        for what in completion.findings {
            self.found(source, what, false);
        }
        let mut added = Vec::new();
        for file in completion.files {
            let namespace = file.model.namespace;
            let other = KnowledgeSource::new(SourceKind::NodeSet, &namespace);
            let is_refused = !taken.contains(&namespace);
            let found: Vec<Finding> = faults
                .remove(&namespace)
                .into_iter()
                .flatten()
                .map(|what| finding(&other, what, is_refused))
                .collect();
            for Finding { source, what, .. } in &found {
                warn!(kind = %other.kind, source, "cannot read a source: {what}");
            }
            self.state().findings.insert(other.clone(), found);
            added.push(other);
            let version = self.knowledge.model_version(&namespace);
            known.insert(namespace, version);
        }
        added
    }

    /// Returns the models of the NodeSets that were added by command, also before a restart:
    /// those of the graph that the YAML does not name.
    pub(super) fn added_node_sets(
        &self,
        named: &BTreeSet<KnowledgeSource>,
        known: &BTreeMap<String, ModelVersion>,
    ) -> Vec<NodeSetModel> {
        let is_added = |namespace: &&String| {
            let source = KnowledgeSource::new(SourceKind::NodeSet, namespace);
            !named.contains(&source)
        };
        let added = known.keys().filter(is_added);
        added
            .map(|namespace| self.knowledge.node_set_model(namespace))
            .collect()
    }

    /// Completes a NodeSet that was added by command from the folder, like [`Self::complete`].
    pub(super) fn complete_stored(
        &self,
        model: &NodeSetModel,
        known: &mut BTreeMap<String, ModelVersion>,
    ) {
        let source = KnowledgeSource::new(SourceKind::NodeSet, &model.namespace);
        self.state().findings.remove(&source);
        let added = self.complete(&source, model, known, SourceLifetime::Yes);
        let mut state = self.state();
        for other in added {
            // It does not leave with a NodeSet of the YAML that it completed before.
            state.of_yaml.remove(&other);
        }
    }

    /// Adds a NodeSet of the folder to the graph.
    fn take_file(&self, file: &FolderNodeSet, lasting: SourceLifetime) -> Result<(), String> {
        let source = KnowledgeSource::new(SourceKind::NodeSet, &file.model.namespace);
        let read = node_set(&decoded(&bytes(&file.path)?)?)?;
        self.put(&source, &read.triples, lasting)
    }

    /// Returns whether the graph has a NodeSet that is not older than a model.
    fn has_version(&self, model: &NodeSetModel) -> bool {
        let source = KnowledgeSource::new(SourceKind::NodeSet, &model.namespace);
        let version = self.knowledge.model_version(&model.namespace);
        self.is_known(&source) && !version.is_older_than(&model.version)
    }
}
