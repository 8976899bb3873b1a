//! NodeSets from files that the user names. All faults of all files are reported together. A file
//! with values that cannot be decoded is used without these values.

use std::collections::hash_map::DefaultHasher;
use std::collections::{BTreeSet, HashMap};
use std::hash::{Hash as _, Hasher as _};
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use opcua::nodes::{NodeSetImport as _, NodeType};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    Context, DecodingOptions, Identifier, NamespaceMap, NodeId, NodeSetNamespaceMapper, TypeLoader,
    TypeLoaderCollection, Variant,
};
use opcua::xml::schema::ua_node_set::{UANode, UANodeSet};

use super::document::Text;
use super::outline::{self, NodeKind, OutlineEntry, ValueKind};
use super::structures::{self, LeftOutValue, Structures};
use super::{
    CORE, CheckedNodeSet, DEEPEST, Facts, ImportedNodeSet, NodeSetError, NodeSetSource, imported,
    ordered,
};
use crate::limits::{LARGEST_NODESETS, MOST_NODESETS};

/// NodeSets that are ready for import.
#[derive(Default)]
pub struct ImportedNodeSets {
    /// The NodeSets in the order of their dependencies.
    sets: Vec<ImportedNodeSet>,
    /// The namespaces of their nodes, in the order of the files.
    provides: Vec<String>,
    fingerprint: u64,
    /// Decodes values of the structures that the files define.
    structures: Arc<Structures>,
}

/// The imported nodes, by their NodeIds in the address space.
#[derive(Debug, Default)]
pub struct Imported {
    /// All imported nodes.
    pub nodes: Vec<NodeId>,
    /// The nodes with values in the files that cannot be decoded.
    pub unread: Vec<NodeId>,
}

/// A fault of a file.
#[derive(Debug)]
pub struct FileFault {
    /// The index of the file, from 0.
    pub file: usize,
    /// The fault.
    pub error: NodeSetError,
}

impl NodeSetError {
    /// Returns whether the NodeSet is unusable.
    #[must_use]
    pub const fn is_fatal(&self) -> bool {
        !matches!(self, Self::Unread { .. } | Self::MoreUnread { .. })
    }

    /// Returns advice for the user.
    #[must_use]
    pub const fn help(&self) -> &'static str {
        match self {
            Self::Read { .. } => "the path is relative to the folder of the file that contains it",
            Self::Xml { .. } => {
                "a NodeSet2 file is an XML document <UANodeSet xmlns=\"http://opcfoundation.org/UA/2011/03/UANodeSet.xsd\">"
            }
            Self::Node { .. } => "correct the file, or export it again",
            Self::Values { .. } | Self::Unread { .. } | Self::MoreUnread { .. } => {
                "a structure needs the definition of its DataType in one of the files; the nodes exist without values"
            }
            Self::Missing { .. } => {
                "add the NodeSet2 file of this namespace; the order of the files does not matter"
            }
            Self::Circle(_) => "remove the dependency from one of them",
            Self::Twice { .. } => "remove one of the two",
            Self::Core { .. } => "the server already has this namespace: remove the file",
            Self::Many => "remove the files that the cell does not need",
        }
    }
}

impl std::fmt::Debug for ImportedNodeSets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut list = f.debug_list();
        list.entries(self.provides.iter()).finish()
    }
}

impl ImportedNodeSets {
    /// Reads and orders the files. Only regular files are opened.
    #[must_use]
    pub fn read(files: &[PathBuf]) -> (Self, Vec<FileFault>) {
        let mut faults = Vec::new();
        let mut documents = Vec::new();
        let mut room = LARGEST_NODESETS;
        for (file, path) in files.iter().enumerate() {
            let mut fault = |error| faults.push(FileFault { file, error });
            if file >= MOST_NODESETS {
                fault(NodeSetError::Many);
                break;
            }
            match length(path).and_then(|length| {
                room = room.checked_sub(length).ok_or_else(|| too_large(path))?;
                CheckedNodeSet::read(NodeSetSource::File(path.clone()))
            }) {
                Ok(document) => documents.push((file, document)),
                Err(error) => fault(error),
            }
        }
        Self::assemble(documents, faults, fingerprint(files))
    }

    /// Reads a single document.
    #[must_use]
    pub fn of_document(name: &str, bytes: &[u8]) -> (Self, Vec<FileFault>) {
        let source = NodeSetSource::Bytes {
            name: name.to_owned(),
            bytes: bytes.to_vec(),
        };
        match CheckedNodeSet::read(source) {
            Ok(document) => Self::assemble(vec![(0, document)], Vec::new(), 0),
            Err(error) => (Self::default(), vec![FileFault { file: 0, error }]),
        }
    }

    fn assemble(
        documents: Vec<(usize, CheckedNodeSet)>,
        mut faults: Vec<FileFault>,
        fingerprint: u64,
    ) -> (Self, Vec<FileFault>) {
        let structures = Arc::new(Structures::default());
        let mut map = NamespaceMap::new();
        let all = documents.iter().map(|(_, document)| document);
        define(all, &structures, &mut map);
        let mut read = Vec::new();
        for (file, document) in documents {
            let (set, unread) = document.into_set(&structures, &mut map);
            faults.extend(unread.into_iter().map(|error| FileFault { file, error }));
            read.push((file, set));
        }
        let is_whole = !faults.iter().any(|fault| fault.error.is_fatal());
        faults.extend(not_together(&read, is_whole));
        faults.sort_by_key(|fault| fault.file);
        if faults.iter().any(|fault| fault.error.is_fatal()) {
            return (Self::default(), faults);
        }
        let provides = read.iter();
        let provides = provides.flat_map(|(_, set)| set.provides().map(str::to_owned));
        let provides = provides.collect();
        let mut sets = Self {
            sets: Vec::new(),
            provides,
            fingerprint,
            structures,
        };
        match ordered(read.into_iter().map(|(_, set)| set).collect()) {
            Ok(ordered) => sets.sets = ordered,
            Err(error) => faults.push(FileFault { file: 0, error }),
        }
        (sets, faults)
    }

    /// Returns whether there are no NodeSets.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.sets.is_empty()
    }

    /// Returns the namespaces of their nodes, in the order of the files.
    pub fn provides(&self) -> impl Iterator<Item = &str> {
        self.provides.iter().map(String::as_str)
    }

    /// Returns a value that changes when a file is written or replaced.
    #[must_use]
    pub const fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// Returns the kind of a node; `None` if no NodeSet contains the node.
    #[must_use]
    pub fn node(&self, uri: &str, identifier: &Identifier) -> Option<NodeKind> {
        let set = self.of(uri)?;
        let id = set.facts.local(uri, identifier)?;
        Some(match set.facts.nodes.find(&id)? {
            OutlineEntry::Variable(data_type, rank) => {
                NodeKind::Variable(self.value_kind(set, data_type), rank)
            }
            OutlineEntry::Method => NodeKind::Method,
            OutlineEntry::Other => NodeKind::Other,
        })
    }

    fn of(&self, uri: &str) -> Option<&ImportedNodeSet> {
        self.sets
            .iter()
            .find(|set| set.facts.provides.contains(uri))
    }

    /// Returns the kind of the values of a DataType, by its supertypes.
    fn value_kind(&self, set: &ImportedNodeSet, data_type: &NodeId) -> ValueKind {
        let (mut set, mut id) = (set, data_type.clone());
        for _ in 0..DEEPEST {
            let Some(uri) = set.facts.uri(id.namespace) else {
                break;
            };
            if uri == CORE {
                return outline::core(&id);
            }
            let Some((owner, own)) = self
                .of(uri)
                .and_then(|owner| Some((owner, owner.facts.local(uri, &id.identifier)?)))
            else {
                break;
            };
            let Some(supertype) = owner.facts.nodes.supertype(&own) else {
                break;
            };
            (set, id) = (owner, supertype.clone());
        }
        ValueKind::Any
    }

    /// Imports the nodes into an address space, to which their namespaces are added. Returns the
    /// NodeIds in the address space.
    ///
    /// # Errors
    /// Returns an error if nodes were left out.
    pub fn import(
        &self,
        address_space: &mut AddressSpace,
        namespaces: &mut NamespaceMap,
    ) -> Result<Imported, NodeSetError> {
        for uri in &self.provides {
            address_space.add_namespace(uri, namespaces.add_namespace(uri));
        }
        let mut types = Vec::new();
        for set in &self.sets {
            let mut mapper = NodeSetNamespaceMapper::new(namespaces);
            set.facts.register_namespaces(&mut mapper);
            types.extend(set.types(&mapper));
        }
        let completed = structures::inherit(&mut types);
        self.structures.define(&types);
        let mut imported = Imported::default();
        for set in &self.sets {
            set.import(address_space, namespaces)?;
            let there = |id: &NodeId| {
                let namespace = namespaces.get_index(set.facts.uri(id.namespace)?)?;
                let identifier = id.identifier.clone();
                Some(NodeId {
                    namespace,
                    identifier,
                })
            };
            imported
                .nodes
                .extend(set.facts.nodes.ids().filter_map(there));
            imported.unread.extend(set.unread.iter().filter_map(there));
        }
        for (id, definition) in completed {
            if let Some(NodeType::DataType(data_type)) = address_space.find_mut(&id) {
                data_type.set_data_type_definition(Some(definition));
            }
        }
        Ok(imported)
    }
}

impl CheckedNodeSet {
    /// Returns the NodeSet without the values that cannot be decoded, and the findings for these
    /// values.
    fn into_set(
        mut self,
        structures: &Arc<Structures>,
        map: &mut NamespaceMap,
    ) -> (ImportedNodeSet, Vec<NodeSetError>) {
        let loader: Arc<dyn TypeLoader> = Arc::<Structures>::clone(structures);
        let nodes = without_unread(&self.facts, &mut self.others, &loader, map);
        let faults = unread(&self.file, &self.text, &nodes);
        let unread = nodes.iter().filter_map(|(node, _)| node.parse().ok());
        let mut others = imported(self.others);
        others.add_type_loader(loader);
        let set = ImportedNodeSet {
            unread: unread.collect(),
            file: self.file,
            facts: self.facts,
            types: self.types,
            others,
        };
        (set, faults)
    }
}

/// Returns the findings for nodes with values that cannot be decoded.
fn unread(file: &str, text: &Text, nodes: &[(String, String)]) -> Vec<NodeSetError> {
    if nodes.is_empty() {
        return Vec::new();
    }
    let reported = nodes.get(..MOST_UNREAD).unwrap_or(nodes);
    let ids: Vec<&str> = reported.iter().map(|(node, _)| node.as_str()).collect();
    let lines = text.lines_of(&ids);
    let each = reported.iter().map(|(node, reason)| NodeSetError::Unread {
        file: file.to_owned(),
        line: lines.get(node).copied().unwrap_or(1),
        node: node.clone(),
        reason: reason.clone(),
    });
    let count = nodes.len() - reported.len();
    let more = (count > 0).then(|| NodeSetError::MoreUnread {
        file: file.to_owned(),
        count,
    });
    each.chain(more).collect()
}

/// Maximum number of individual findings for undecodable values of a file.
const MOST_UNREAD: usize = 10;

/// Registers the structures that the files define. Their namespaces are numbered by the map.
fn define<'d>(
    documents: impl Iterator<Item = &'d CheckedNodeSet>,
    structures: &Structures,
    map: &mut NamespaceMap,
) {
    let mut items = Vec::new();
    for document in documents {
        let mut mapper = NodeSetNamespaceMapper::new(map);
        document.facts.register_namespaces(&mut mapper);
        items.extend(document.types.load(&mapper));
    }
    structures::inherit(&mut items);
    structures.define(&items);
}

/// Removes the values that cannot be decoded, and returns the NodeIds of their nodes with the
/// reasons.
fn without_unread(
    facts: &Facts,
    document: &mut UANodeSet,
    structures: &Arc<dyn TypeLoader>,
    map: &mut NamespaceMap,
) -> Vec<(String, String)> {
    let mut mapper = NodeSetNamespaceMapper::new(map);
    facts.register_namespaces(&mut mapper);
    let mut loaders = TypeLoaderCollection::new();
    loaders.add(Arc::clone(structures));
    let tables = document.aliases.iter().flat_map(|table| &table.aliases);
    let aliases = tables
        .map(|alias| (alias.alias.clone(), alias.id.0.clone()))
        .collect();
    let mut context = Context::new(mapper.namespaces(), &loaders, DecodingOptions::default());
    context.set_index_map(mapper.index_map());
    context.set_aliases(&aliases);
    let mut unread = Vec::new();
    for node in &mut document.nodes {
        let value = match node {
            UANode::Variable(variable) => &mut variable.value,
            UANode::VariableType(variable) => &mut variable.value,
            UANode::Object(_)
            | UANode::Method(_)
            | UANode::View(_)
            | UANode::ObjectType(_)
            | UANode::DataType(_)
            | UANode::ReferenceType(_) => continue,
        };
        let Some(written) = value else {
            continue;
        };
        let read = Variant::from_nodeset(&written.0, &context).map_err(LeftOutValue::from);
        let Err(fault) = read.and_then(|read| structures::check_sent(&read, &context)) else {
            continue;
        };
        *value = None;
        unread.push((node.base().node_id.0.clone(), fault.to_string()));
    }
    unread
}

/// Returns the conflicts between files. Missing namespaces are reported only if all files could be
/// read, because an unreadable file may contain them.
fn not_together(read: &[(usize, ImportedNodeSet)], is_whole: bool) -> Vec<FileFault> {
    let mut faults = Vec::new();
    let mut owners: HashMap<&str, &ImportedNodeSet> = HashMap::new();
    for (file, set) in read {
        for uri in &set.facts.provides {
            if let Some(first) = owners.get(uri.as_str()) {
                let error = NodeSetError::Twice {
                    first: first.file.clone(),
                    second: set.file.clone(),
                    uri: uri.clone(),
                };
                faults.push(FileFault { file: *file, error });
                break;
            }
        }
        owners.extend(set.facts.provides.iter().map(|uri| (uri.as_str(), set)));
    }
    if !is_whole {
        return faults;
    }
    for (file, set) in read {
        let missing = set.facts.needs.iter();
        let missing: BTreeSet<&String> = missing
            .filter(|uri| !owners.contains_key(uri.as_str()))
            .collect();
        faults.extend(missing.into_iter().map(|uri| FileFault {
            file: *file,
            error: NodeSetError::Missing {
                file: set.file.clone(),
                uri: uri.clone(),
            },
        }));
    }
    faults
}

/// Returns the size of a regular file in bytes.
fn length(path: &Path) -> Result<u64, NodeSetError> {
    let fault = |source| NodeSetError::Read {
        file: path.display().to_string(),
        source,
    };
    let found = std::fs::metadata(path).map_err(fault)?;
    if !found.is_file() {
        return Err(fault(io::Error::other("it is not a file")));
    }
    Ok(found.len())
}

fn too_large(path: &Path) -> NodeSetError {
    NodeSetError::Xml {
        file: path.display().to_string(),
        reason: format!(
            "with it the NodeSets have more than {} MiB",
            LARGEST_NODESETS >> 20
        ),
    }
}

/// Returns a value that changes when a file is written or replaced by a rename.
#[must_use]
pub fn fingerprint(files: &[PathBuf]) -> u64 {
    let mut hasher = DefaultHasher::new();
    for file in files {
        file.hash(&mut hasher);
        if let Ok(found) = std::fs::metadata(file) {
            let at = (found.ino(), found.len(), found.mtime(), found.mtime_nsec());
            at.hash(&mut hasher);
        }
    }
    hasher.finish()
}
