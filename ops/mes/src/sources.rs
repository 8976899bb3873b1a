//! The sources of the graph: files of the YAML, and files that users add while the program runs.
//!
//! A source that cannot be read is a finding of the status page; all other sources are read.

mod completion;
mod supply;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use knowledge::nodeset::ModelVersion;
use knowledge::{
    Knowledge, KnowledgeSource, SourceCheck, SourceFiles, SourceFinding, SourceKind,
    SourceLifetime, line_of, nodeset,
};
use mtp::{Module, Triple, escaped};
use rml::{Folder, RmlMapping};
use serde::Serialize;
use step_files::StepProducts;
use tokio::sync::Notify;
use tracing::{info, warn};

use crate::clock::now;
use crate::nodeset_folder::NodeSetFolder;
use crate::process::Process;
use crate::recipe::{self, Recipe};
use crate::settings::{self, Manifest, NodeSetOrigin, RmlSource, Settings};

pub(crate) use self::supply::supply;

mod products;

/// The sources, and the findings about them.
pub(crate) struct MesSources {
    knowledge: Arc<Knowledge>,
    state: Mutex<State>,
    /// Held while NodeSets are added, removed or read again.
    order: Mutex<()>,
    /// Notified when a NodeSet may be missing that can be fetched.
    wanted: Notify,
    /// The folder of the program, for fetched NodeSets.
    cache: Option<PathBuf>,
}

#[derive(Debug, Default)]
struct State {
    /// The sources of the YAML, and the NodeSets that complete them.
    of_yaml: BTreeSet<KnowledgeSource>,
    /// The folder of NodeSets that complete others.
    folder: Option<Arc<NodeSetFolder>>,
    /// The URL of NodeSets that complete others.
    supply: supply::NodeSetSupply,
    /// The findings by the source.
    findings: BTreeMap<KnowledgeSource, Vec<Finding>>,
}

/// A fault of a source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Finding {
    /// The kind and name of the source.
    pub(crate) kind: SourceKind,
    pub(crate) source: String,
    /// The line in its file, from 1, if it is known.
    pub(crate) line: Option<usize>,
    pub(crate) what: String,
    /// Whether the source is not in the graph because of it.
    pub(crate) refused: bool,
}

impl MesSources {
    pub(crate) fn new(knowledge: Arc<Knowledge>) -> Self {
        Self {
            knowledge,
            state: Mutex::default(),
            order: Mutex::default(),
            wanted: Notify::new(),
            cache: None,
        }
    }

    /// Reads all files that the YAML names, and removes the sources that it named before.
    pub(crate) fn read(&self, settings: &Settings) {
        // Other sources do not wait for the geometry of products.
        let products: Vec<_> = settings
            .products
            .iter()
            .map(|file| {
                (
                    file,
                    bytes(&file.path).and_then(|bytes| products::read(&bytes)),
                )
            })
            .collect();
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        let mut named = BTreeSet::new();
        let ours = skills::model::nodeset();
        let source = KnowledgeSource::new(SourceKind::NodeSet, skills::model::NAMESPACE);
        named.insert(source.clone());
        self.try_one(source, |source| {
            let all = node_set(&ours)?;
            self.put(source, &all.triples, SourceLifetime::No)
        });
        let units = KnowledgeSource::new(SourceKind::File, "units of measurement");
        named.insert(units.clone());
        self.try_one(units, |source| {
            self.put(source, &knowledge::units::triples(), SourceLifetime::No)
        });
        let operations = KnowledgeSource::new(SourceKind::File, "operations");
        named.insert(operations.clone());
        self.try_one(operations, |source| {
            let all = knowledge::operations::triples();
            self.put(source, &all, SourceLifetime::No)
        });
        self.node_sets(settings, &mut named);
        for file in &settings.knowledge {
            let source = KnowledgeSource::new(SourceKind::File, &file.name);
            named.insert(source.clone());
            self.try_one(source, |source| {
                let text = utf8(&bytes(&file.path)?)?;
                let read = self.knowledge.replace_turtle(source, &text, now());
                read.map_err(|fault| fault.to_string())
            });
        }
        for manifest in &settings.manifests {
            let source = KnowledgeSource::new(SourceKind::Mtp, &manifest.source.name);
            named.insert(source.clone());
            self.try_one(source, |source| {
                self.module(
                    source,
                    &bytes(&manifest.source.path)?,
                    manifest,
                    SourceLifetime::No,
                )
            });
        }
        for rml in &settings.rml {
            let source = KnowledgeSource::new(SourceKind::File, &rml.mapping.name);
            named.insert(source.clone());
            self.try_one(source, |source| self.mapped(source, rml));
        }
        for (file, read) in products {
            let source = KnowledgeSource::new(SourceKind::Product, &file.name);
            named.insert(source.clone());
            self.try_one(source, |source| {
                self.products(source, &read?, SourceLifetime::No)
            });
        }
        for process in &settings.processes {
            let source = KnowledgeSource::new(SourceKind::Process, &process.iri);
            named.insert(source.clone());
            self.try_one(source, |source| self.process(source, process));
        }
        for recipe in &settings.recipes {
            let source = KnowledgeSource::new(SourceKind::Process, &recipe.source.name);
            named.insert(source.clone());
            self.try_one(source, |source| {
                let bytes = bytes(&recipe.source.path)?;
                let read = recipe::read(&decoded(&bytes)?, &recipe.names);
                self.recipe(source, read, SourceLifetime::No)
            });
        }
        self.remove_others(named);
        self.rules(settings.rules);
    }

    /// Removes the sources that the YAML named before and does not name now.
    fn remove_others(&self, named: BTreeSet<KnowledgeSource>) {
        let gone: Vec<KnowledgeSource> = {
            let mut state = self.state();
            let before = std::mem::replace(&mut state.of_yaml, named);
            before.difference(&state.of_yaml).cloned().collect()
        };
        for source in gone {
            self.state().findings.remove(&source);
            if let Err(fault) = self.knowledge.remove(&source) {
                warn!(source = source.name, "cannot remove a source: {fault}");
            }
        }
    }

    /// Reads the NodeSets, and completes them from the folder or the URL.
    fn node_sets(&self, settings: &Settings, named: &mut BTreeSet<KnowledgeSource>) {
        let mut models = Vec::new();
        for file in &settings.nodesets {
            // The graph of a NodeSet is named by its namespace, which only the file has.
            let read = bytes(&file.path).and_then(|bytes| node_set(&decoded(&bytes)?));
            let name = read
                .as_ref()
                .map_or(&file.name, |read| &read.model.namespace);
            let source = KnowledgeSource::new(SourceKind::NodeSet, name);
            named.insert(source.clone());
            self.try_one(source, |source| {
                let read = read?;
                self.put(source, &read.triples, SourceLifetime::No)?;
                models.push((source.clone(), read.model));
                Ok(())
            });
        }
        let earlier = self.state().folder.take();
        let url = match &settings.nodeset_folder {
            Some(NodeSetOrigin::Folder(of_yaml)) => {
                self.read_folder(of_yaml, earlier, named);
                None
            }
            Some(NodeSetOrigin::Url(url)) => Some(url),
            None => None,
        };
        let mut known = self.known_node_sets();
        known.retain(|namespace, _| {
            let source = KnowledgeSource::new(SourceKind::NodeSet, namespace);
            // NodeSets that completed others before are read again.
            named.contains(&source) || !self.state().of_yaml.contains(&source)
        });
        let stored = self.added_node_sets(named, &known);
        for (source, model) in &models {
            let added = self.complete(source, model, &mut known, SourceLifetime::No);
            named.extend(added);
        }
        for model in &stored {
            self.complete_stored(model, &mut known);
        }
        let models = models.into_iter().map(|(_, model)| model).collect();
        self.supply_anew(url, (models, stored), named, &mut known);
    }

    /// Returns the NodeSets of the graph with their versions.
    fn known_node_sets(&self) -> BTreeMap<String, ModelVersion> {
        let sources = self.knowledge.sources().into_iter();
        let all = sources.filter(|source| source.kind == SourceKind::NodeSet);
        all.map(|source| {
            let version = self.knowledge.model_version(&source.name);
            (source.name, version)
        })
        .collect()
    }

    fn rules(&self, are_on: bool) {
        if let Err(fault) = self.knowledge.set_rules(are_on) {
            warn!("cannot apply the rules: {fault}");
        }
    }

    /// Returns all findings.
    pub(crate) fn findings(&self) -> Vec<Finding> {
        self.state().findings.values().flatten().cloned().collect()
    }

    /// Adds a finding about the YAML itself, which replaces an earlier one.
    pub(crate) fn yaml(&self, name: &str, what: Option<String>) {
        let source = KnowledgeSource::new(SourceKind::File, name);
        let found = what.map(|what| finding(&source, what, true));
        self.state()
            .findings
            .insert(source, found.into_iter().collect());
    }

    /// Replaces the findings of a source. Each has a text, and whether the source is not in the
    /// graph because of it. New findings are logged.
    pub(crate) fn replace_findings(&self, source: &KnowledgeSource, whats: Vec<(String, bool)>) {
        let findings = whats.into_iter();
        let findings: Vec<Finding> = findings
            .map(|(what, refused)| finding(source, what, refused))
            .collect();
        let before = match findings.is_empty() {
            true => self.state().findings.remove(source),
            false => self
                .state()
                .findings
                .insert(source.clone(), findings.clone()),
        };
        let before = before.unwrap_or_default();
        for found in findings.iter().filter(|found| !before.contains(found)) {
            warn!(kind = %source.kind, source = source.name, "{}", found.what);
        }
    }

    /// Reads a source. Its faults become findings.
    fn try_one(
        &self,
        source: KnowledgeSource,
        read: impl FnOnce(&KnowledgeSource) -> Result<(), String>,
    ) {
        self.state().findings.remove(&source);
        if let Err(what) = read(&source) {
            warn!(kind = %source.kind, source = source.name, "cannot read a source: {what}");
            let found = finding(&source, what, true);
            self.state().findings.entry(source).or_default().push(found);
        }
    }

    fn module(
        &self,
        source: &KnowledgeSource,
        bytes: &[u8],
        manifest: &Manifest,
        lasting: SourceLifetime,
    ) -> Result<(), String> {
        let folder = manifest.source.path.parent();
        let mut beside = |name: &str| {
            // A manifest that was sent has no folder.
            let path = folder.filter(|_| lasting == SourceLifetime::No)?.join(name);
            bridge_node::read_bounded(&path, LARGEST).ok()
        };
        let module = Module::from_files(bytes, &mut beside).map_err(|fault| fault.to_string())?;
        let triples = module.triples(&manifest.iri, &manifest.capabilities);
        self.put(source, &triples, lasting)?;
        for found in &module.findings {
            self.found(source, found.to_string(), found.is_note);
        }
        let (name, services) = (&module.name, module.services.len());
        info!(
            manifest = source.name,
            module = name,
            services,
            "a module is in the graph"
        );
        Ok(())
    }

    /// Records a finding in a file that was read.
    fn found(&self, source: &KnowledgeSource, what: String, is_note: bool) {
        match is_note {
            true => info!(source = source.name, "{what}"),
            false => warn!(source = source.name, "{what}"),
        }
        self.keep(source, finding(source, what, false));
    }

    /// Adds a finding to the findings of its source.
    fn keep(&self, source: &KnowledgeSource, found: Finding) {
        let mut state = self.state();
        let findings = state.findings.entry(source.clone()).or_default();
        findings.push(found);
    }

    /// Runs an RML mapping.
    fn mapped(&self, source: &KnowledgeSource, rml: &RmlSource) -> Result<(), String> {
        let path = &rml.mapping.path;
        let at = |what: &dyn std::fmt::Display| format!("{}: {what}", path.display());
        let text = utf8(&bytes(&rml.mapping.path)?)?;
        let mapping = RmlMapping::read(&text).map_err(|fault| at(&fault))?;
        let mut folder = Folder::of(path);
        if let Some(file) = &rml.file {
            let files: Vec<&str> = mapping.files().into_iter().collect();
            let [only] = files.as_slice() else {
                return Err(at(&format!(
                    "it reads several files ({}), which the key `file` cannot replace; remove the \
                     key",
                    files.join(", ")
                )));
            };
            folder = folder.with(only, bytes(&file.path)?);
        }
        let output = mapping.run(&mut folder).map_err(|fault| at(&fault))?;
        let turtle = output.turtle().map_err(|error| error.to_string())?;
        let read = self
            .knowledge
            .replace_turtle(source, &utf8(&turtle)?, now());
        read.map_err(|fault| fault.to_string())?;
        let graphs = output.has_graphs().then(|| {
            "a source is one graph; the graphs of the mapping are merged in it".to_owned()
        });
        let findings = mapping.findings().iter().cloned();
        let findings = findings.chain(output.findings).chain(graphs);
        let findings: Vec<Finding> = findings
            .map(|what| finding(source, at(&what), false))
            .collect();
        for found in &findings {
            warn!(source = source.name, "{}", found.what);
        }
        self.state().findings.insert(source.clone(), findings);
        Ok(())
    }

    /// Returns the models that a NodeSet requires and that the folder does not have, or that would
    /// be fetched.
    fn missing(&self, kind: SourceKind, contents: &[u8]) -> Vec<String> {
        if kind != SourceKind::NodeSet {
            return Vec::new();
        }
        let folder = self.state().folder.clone();
        let model = decoded(contents).ok();
        let model = model.and_then(|text| nodeset::read_model(&text).ok());
        match (folder, model) {
            (Some(folder), Some(model)) => {
                let known = self.known_node_sets();
                folder.complete(&model, &known, &mut |_| true).findings
            }
            (None, Some(model)) => self.would_fetch(&model),
            (_, None) => Vec::new(),
        }
    }

    fn process(&self, source: &KnowledgeSource, process: &Process) -> Result<(), String> {
        let type_iri =
            |name: &skills::ParameterType| self.knowledge.type_of(&name.namespace, &name.name);
        self.put(source, &process.triples(&type_iri), SourceLifetime::No)
    }

    /// Adds the processes of a recipe, with its findings.
    ///
    /// # Errors
    /// The first finding, if the recipe has no process; the others are recorded.
    fn recipe(
        &self,
        source: &KnowledgeSource,
        read: Result<Recipe, Vec<recipe::RecipeFinding>>,
        lasting: SourceLifetime,
    ) -> Result<(), String> {
        let recipe = match read {
            Ok(recipe) => recipe,
            Err(errors) => {
                let mut errors = errors.into_iter();
                let first = errors.next().map(|found| found.to_string());
                for found in errors {
                    warn!(source = source.name, "{found}");
                    self.keep(source, finding(source, found.to_string(), true));
                }
                return Err(first.unwrap_or_default());
            }
        };
        let type_iri =
            |name: &skills::ParameterType| self.knowledge.type_of(&name.namespace, &name.name);
        let triples = recipe.processes.iter();
        let triples: Vec<Triple> = triples
            .flat_map(|process| process.triples(&type_iri))
            .collect();
        self.put(source, &triples, lasting)?;
        for found in &recipe.notes {
            self.found(source, found.to_string(), true);
        }
        for process in &recipe.processes {
            let (iri, steps) = (&process.iri, process.steps.len());
            info!(
                source = source.name,
                process = iri,
                steps,
                "a recipe is a process"
            );
        }
        Ok(())
    }

    fn put(
        &self,
        source: &KnowledgeSource,
        triples: &[Triple],
        lasting: SourceLifetime,
    ) -> Result<(), String> {
        self.knowledge
            .replace_with(source, triples, (now(), lasting))
            .map_err(|fault| fault.to_string())
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_known(&self, source: &KnowledgeSource) -> bool {
        let sources = self.knowledge.sources();
        let mut sources = sources.iter();
        sources.any(|known| known.kind == source.kind && known.name == source.name)
    }

    /// Refuses to change a source of the YAML, which would come back at the next start.
    fn of_yaml(&self, source: &KnowledgeSource) -> Result<(), String> {
        if self.state().of_yaml.contains(source) {
            return Err(format!(
                "the {} `{}` is named in the YAML of the MES, or completes a NodeSet there; change the file and send SIGHUP",
                source.kind, source.name
            ));
        }
        Ok(())
    }
}

/// The contents of a file that is added while the program runs.
enum AddedFile {
    NodeSet(nodeset::NodeSetContents),
    Products(StepProducts),
    Recipe(Recipe),
    Module,
    Turtle(String),
}

impl AddedFile {
    /// Reads a file.
    ///
    /// # Errors
    /// The reason why it cannot be added.
    fn read(kind: SourceKind, contents: &[u8]) -> Result<Self, String> {
        match kind {
            SourceKind::NodeSet => node_set(&decoded(contents)?).map(Self::NodeSet),
            SourceKind::Product => products::read(contents).map(Self::Products),
            SourceKind::Process => match recipe::in_source(contents)? {
                Some((text, names)) => {
                    let read = recipe::read(&text, &names).map_err(|errors| {
                        let errors: Vec<_> = errors.iter().map(ToString::to_string).collect();
                        errors.join("; ")
                    })?;
                    Ok(Self::Recipe(read))
                }
                None => utf8(contents).map(Self::Turtle),
            },
            SourceKind::File => utf8(contents).map(Self::Turtle),
            SourceKind::Mtp => Ok(Self::Module),
            SourceKind::Component
            | SourceKind::Run
            | SourceKind::State
            | SourceKind::Server
            | SourceKind::Graph
            | SourceKind::Derived => Err(format!("a {kind} is not read from a file")),
        }
    }
}

impl SourceFiles for MesSources {
    fn put(&self, kind: SourceKind, name: &str, contents: &[u8]) -> Result<bool, String> {
        // Other sources do not wait until the file is read.
        let read = AddedFile::read(kind, contents)?;
        let source = match &read {
            AddedFile::NodeSet(read) => KnowledgeSource::new(kind, &read.model.namespace),
            AddedFile::Products(_)
            | AddedFile::Recipe(_)
            | AddedFile::Module
            | AddedFile::Turtle(_) => KnowledgeSource::new(kind, name),
        };
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        self.of_yaml(&source)?;
        let is_new = !self.is_known(&source);
        self.state().findings.remove(&source);
        match read {
            AddedFile::NodeSet(read) => {
                Self::put(self, &source, &read.triples, SourceLifetime::Yes)?;
                let mut known = self.known_node_sets();
                self.complete(&source, &read.model, &mut known, SourceLifetime::Yes);
                self.supply_for(read.model);
            }
            AddedFile::Products(read) => self.products(&source, &read, SourceLifetime::Yes)?,
            AddedFile::Recipe(read) => self.recipe(&source, Ok(read), SourceLifetime::Yes)?,
            AddedFile::Module => {
                let manifest = Manifest {
                    source: settings::Source {
                        name: name.to_owned(),
                        path: name.into(),
                    },
                    iri: format!("urn:ua-bridge:mtp:{}", escaped(name)),
                    capabilities: BTreeMap::new(),
                    connect: settings::Connect::No,
                };
                self.module(&source, contents, &manifest, SourceLifetime::Yes)?;
            }
            AddedFile::Turtle(text) => {
                let taken = self.knowledge.take_turtle(&source, &text, now());
                taken.map_err(|fault| fault.to_string())?;
            }
        }
        info!(kind = %kind, source = source.name, "a source was added");
        Ok(is_new)
    }

    fn check(&self, kind: SourceKind, name: &str, contents: &[u8]) -> SourceCheck {
        let mut source = KnowledgeSource::new(kind, name);
        let read = examined(&mut source, contents).and_then(|notes| {
            self.of_yaml(&source).map_err(|why| vec![why])?;
            Ok(notes)
        });
        let read = read.map(|mut notes| {
            notes.extend(self.missing(kind, contents));
            notes
        });
        let accepted = read.is_ok();
        let whats = read.unwrap_or_else(|faults| faults);
        let findings = whats.into_iter().map(|what| {
            let found = finding(&source, what, !accepted);
            SourceFinding {
                line: found.line,
                what: found.what,
                refused: found.refused,
            }
        });
        SourceCheck {
            accepted,
            replaces: accepted && self.is_known(&source),
            findings: findings.collect(),
        }
    }

    fn remove(&self, kind: SourceKind, name: &str) -> Result<bool, String> {
        let source = KnowledgeSource::new(kind, name);
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        self.of_yaml(&source)?;
        let removed = self.knowledge.remove(&source);
        let removed = removed.map_err(|fault| fault.to_string())?;
        if removed {
            self.state().findings.remove(&source);
            if kind == SourceKind::NodeSet {
                self.supply_without(name);
            }
            info!(kind = %kind, source = name, "a source was removed");
        }
        Ok(removed)
    }

    fn list(&self) -> serde_json::Value {
        serde_json::json!({
            "sources": self.knowledge.sources(),
            "findings": self.findings(),
        })
    }
}

/// Reads the contents of a source without adding it, and names it as it would be added. Returns its
/// notes.
///
/// # Errors
/// The faults because of which it cannot be added.
fn examined(source: &mut KnowledgeSource, contents: &[u8]) -> Result<Vec<String>, Vec<String>> {
    let one = |what: String| vec![what];
    match source.kind {
        SourceKind::NodeSet => {
            let text = decoded(contents).map_err(one)?;
            source.name = node_set(&text).map_err(one)?.model.namespace;
            Ok(Vec::new())
        }
        SourceKind::Mtp => {
            // A manifest that was sent has no folder.
            let read = Module::from_files(contents, &mut |_: &str| None);
            let module = read.map_err(|fault| one(fault.to_string()))?;
            Ok(module.findings.iter().map(ToString::to_string).collect())
        }
        SourceKind::Product => products::examined(contents).map_err(one),
        SourceKind::File | SourceKind::Process => {
            let recipe = if source.kind == SourceKind::Process {
                recipe::in_source(contents).map_err(one)?
            } else {
                None
            };
            if let Some((text, names)) = recipe {
                let all = |found: Vec<recipe::RecipeFinding>| -> Vec<String> {
                    found.iter().map(ToString::to_string).collect()
                };
                return recipe::read(&text, &names)
                    .map(|recipe| all(recipe.notes))
                    .map_err(all);
            }
            let text = utf8(contents).map_err(one)?;
            let read = Knowledge::check_turtle(&text);
            read.map_err(|fault| one(fault.to_string()))?;
            Ok(Vec::new())
        }
        kind @ (SourceKind::Component
        | SourceKind::Run
        | SourceKind::State
        | SourceKind::Server
        | SourceKind::Graph
        | SourceKind::Derived) => Err(one(format!("a {kind} is not read from a file"))),
    }
}

fn node_set(text: &str) -> Result<nodeset::NodeSetContents, String> {
    nodeset::read(text).map_err(|fault| fault.to_string())
}

fn decoded(bytes: &[u8]) -> Result<std::borrow::Cow<'_, str>, String> {
    xml_text::decode(bytes).map_err(|fault| fault.to_string())
}

fn bytes(path: &Path) -> Result<Vec<u8>, String> {
    let shown = path.display();
    bridge_node::read_bounded(path, LARGEST)
        .map_err(|error| format!("cannot read {shown}: {error}"))
}

fn utf8(bytes: &[u8]) -> Result<String, String> {
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let known = bytes.get(..error.valid_up_to()).unwrap_or_default();
        let line = known.iter().filter(|byte| **byte == b'\n').count() + 1;
        format!("line {line}: it is not UTF-8; save it as UTF-8")
    })?;
    Ok(text.to_owned())
}

/// Creates a finding. Its line is the number behind the first `line` of the text.
fn finding(source: &KnowledgeSource, what: String, refused: bool) -> Finding {
    Finding {
        kind: source.kind,
        source: source.name.clone(),
        line: line_of(&what),
        what,
        refused,
    }
}

/// Maximum size of a file in bytes.
const LARGEST: u64 = 64 << 20;

#[cfg(test)]
mod tests;
