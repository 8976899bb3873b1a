//! NodeSet2 files (OPC 10000-6, Annex F): reads and checks them, and orders them by their
//! dependencies.

mod document;
mod files;
mod outline;
mod structures;
#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, HashMap};
use std::io;
use std::path::PathBuf;
use std::str::FromStr as _;
use std::sync::atomic::{AtomicUsize, Ordering};

use opcua::nodes::{ImportedItem, NodeBase as _, NodeSet2Import, NodeSetImport, NodeType};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    DataTypeDefinition, Identifier, NamespaceMap, NodeId, NodeSetNamespaceMapper, ReferenceTypeId,
    StructureDefinition,
};
use opcua::xml::schema::ua_node_set::{AliasTable, NodeIdAlias, UANode, UANodeSet};

use crate::limits::MOST_NODESETS;

pub use self::files::{FileFault, Imported, ImportedNodeSets, fingerprint};
pub use self::outline::{NodeKind, ValueKind, builtin};

use self::document::{Parsed, Text};
use self::outline::Outline;

/// The namespace of the OPC Foundation, index 0 of every server.
pub const CORE: &str = "http://opcfoundation.org/UA/";

/// An error of a NodeSet.
#[derive(Debug, thiserror::Error)]
pub enum NodeSetError {
    /// The file cannot be read.
    #[error("the NodeSet {file} cannot be read: {source}")]
    Read {
        /// The file.
        file: String,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
    /// The text is not a NodeSet2 document.
    #[error("{file} is not a NodeSet2 document: {reason}")]
    Xml {
        /// The file.
        file: String,
        /// The reason and its location.
        reason: String,
    },
    /// A node of the document is invalid.
    #[error("{file}:{line}: node {node}: {reason}")]
    Node {
        /// The file.
        file: String,
        /// The line, from 1.
        line: usize,
        /// The NodeId as written in the file.
        node: String,
        /// The reason.
        reason: String,
    },
    /// The values of some nodes cannot be decoded, for example structures of unknown types.
    #[error("{file}: {missing} of its {all} nodes are not usable, because a value cannot be read")]
    Values {
        /// The file.
        file: String,
        /// The number of nodes that were left out.
        missing: usize,
        /// The number of nodes of the file.
        all: usize,
    },
    /// The value of a node cannot be decoded, for example a structure of an unknown type. The node
    /// exists without the value.
    #[error("{file}:{line}: node {node}: the value cannot be read: {reason}")]
    Unread {
        /// The file.
        file: String,
        /// The line of the node, from 1.
        line: usize,
        /// The NodeId as written in the file.
        node: String,
        /// The reason.
        reason: String,
    },
    /// The number of further nodes with values that cannot be decoded.
    #[error("{file}: cannot read the values of {count} more nodes")]
    MoreUnread {
        /// The file.
        file: String,
        /// The number of further nodes.
        count: usize,
    },
    /// The file contains only nodes of the core namespace, which every server has.
    #[error("{file} has nodes of the core namespace, as {node}")]
    Core {
        /// The file.
        file: String,
        /// The NodeId of the first node.
        node: String,
    },
    /// There are too many files.
    #[error("there are more than {MOST_NODESETS} NodeSets")]
    Many,
    /// No file provides a namespace that is required.
    #[error("{file} needs the namespace {uri}, which no given NodeSet contains")]
    Missing {
        /// The file.
        file: String,
        /// The required namespace.
        uri: String,
    },
    /// Some files depend on each other.
    #[error("these NodeSets need each other: {0}")]
    Circle(String),
    /// Two files contain nodes of the same namespace.
    #[error("{first} and {second} both have nodes of the namespace {uri}")]
    Twice {
        /// The first file.
        first: String,
        /// The second file.
        second: String,
        /// The namespace.
        uri: String,
    },
}

/// The source of a NodeSet.
#[derive(Debug)]
pub(crate) enum NodeSetSource {
    Text { name: String, xml: String },
    Bytes { name: String, bytes: Vec<u8> },
    File(PathBuf),
}

/// A NodeSet that is ready for import.
pub(crate) struct ImportedNodeSet {
    file: String,
    facts: Facts,
    /// The DataTypes and their encodings.
    types: NodeSet2Import,
    /// All other nodes.
    others: NodeSet2Import,
    /// The nodes without their values, which cannot be decoded.
    unread: Vec<NodeId>,
}

/// The properties of a valid document.
struct Facts {
    /// The namespace table, by index minus `offset`.
    uris: Vec<String>,
    offset: usize,
    /// The namespaces of its nodes.
    provides: BTreeSet<String>,
    /// The other namespaces that it refers to, without [`CORE`].
    needs: BTreeSet<String>,
    nodes: Outline,
}

/// Splits a document into the DataTypes with their encodings, and all other nodes.
fn parted(mut set: UANodeSet) -> (UANodeSet, UANodeSet) {
    let is_type = |node: &UANode| match node {
        UANode::DataType(_) => true,
        UANode::Object(object) => object.base.base.browse_name.0.starts_with(ENCODING),
        UANode::Variable(_)
        | UANode::Method(_)
        | UANode::View(_)
        | UANode::ObjectType(_)
        | UANode::VariableType(_)
        | UANode::ReferenceType(_) => false,
    };
    let (types, others) = set.nodes.drain(..).partition(is_type);
    let tables = set.aliases.iter().flat_map(|table| &table.aliases);
    let aliases = tables.map(|one| NodeIdAlias {
        id: one.id.clone(),
        alias: one.alias.clone(),
    });
    let aliases = aliases.collect();
    let of_types = UANodeSet {
        aliases: Some(AliasTable { aliases }),
        nodes: types,
        ..UANodeSet::default()
    };
    set.nodes = others;
    (of_types, set)
}

fn imported(set: UANodeSet) -> NodeSet2Import {
    NodeSet2Import::new_nodeset("en", set, Vec::new())
}

/// Reads the sources and orders them.
///
/// # Errors
/// Returns the first error of a source.
pub(crate) fn load(sources: Vec<NodeSetSource>) -> Result<Vec<ImportedNodeSet>, NodeSetError> {
    let read = sources.into_iter().map(ImportedNodeSet::read);
    ordered(read.collect::<Result<_, _>>()?)
}

/// A file that was read and is valid.
struct CheckedNodeSet {
    file: String,
    text: Text,
    facts: Facts,
    types: NodeSet2Import,
    /// The nodes that are not DataTypes or encodings.
    others: UANodeSet,
}

impl CheckedNodeSet {
    fn read(source: NodeSetSource) -> Result<Self, NodeSetError> {
        let Parsed { file, text, set } = Parsed::read(source)?;
        let facts = Facts::of(&file, &text, &set)?;
        let (types, others) = parted(set);
        Ok(Self {
            file,
            text,
            facts,
            types: imported(types),
            others,
        })
    }
}

impl ImportedNodeSet {
    fn read(source: NodeSetSource) -> Result<Self, NodeSetError> {
        let CheckedNodeSet {
            file,
            facts,
            types,
            others,
            ..
        } = CheckedNodeSet::read(source)?;
        Ok(Self {
            file,
            facts,
            types,
            others: imported(others),
            unread: Vec::new(),
        })
    }

    /// Returns the DataTypes and their encodings.
    fn types(&self, namespaces: &NodeSetNamespaceMapper<'_>) -> Vec<ImportedItem> {
        let mut items: Vec<ImportedItem> = self.types.load(namespaces).collect();
        encoded(&mut items);
        items
    }

    /// Returns the namespaces of its nodes.
    pub(crate) fn provides(&self) -> impl Iterator<Item = &str> {
        self.facts.provides.iter().map(String::as_str)
    }

    /// Imports the nodes into an address space, to which the namespaces are added.
    ///
    /// # Errors
    /// Returns an error if nodes were left out.
    pub(crate) fn import(
        &self,
        address_space: &mut AddressSpace,
        namespaces: &mut NamespaceMap,
    ) -> Result<(), NodeSetError> {
        let counted = Counted {
            set: self,
            loaded: AtomicUsize::new(0),
        };
        address_space.import_node_set(&counted, namespaces);
        let loaded = counted.loaded.into_inner();
        if loaded < self.facts.nodes.len() {
            return Err(NodeSetError::Values {
                file: self.file.clone(),
                missing: self.facts.nodes.len() - loaded,
                all: self.facts.nodes.len(),
            });
        }
        Ok(())
    }
}

impl Facts {
    fn of(file: &str, text: &Text, set: &UANodeSet) -> Result<Self, NodeSetError> {
        let uris = document::uris(set).to_vec();
        let offset = document::offset(set);
        let aliases = set.aliases.iter().flat_map(|table| &table.aliases);
        let check = Check {
            file,
            text,
            uris: &uris,
            offset,
            aliases: aliases
                .map(|alias| (alias.alias.as_str(), alias.id.0.as_str()))
                .collect(),
        };
        let mut nodes = Outline::default();
        let mut provides = BTreeSet::new();
        let mut needs = BTreeSet::new();
        for node in &set.nodes {
            let (id, used) = check.node(node)?;
            let uri = check.uri(id.namespace).unwrap_or(CORE);
            provides.insert(uri.to_owned());
            needs.extend(used);
            let resolved = |text: &str| check.id(text).ok();
            if !nodes.insert(id, node, &resolved) {
                return Err(check.wrong(node, "two nodes have this NodeId"));
            }
        }
        for node in &set.nodes {
            let id = check.id(&node.base().node_id.0).unwrap_or_default();
            let mut at = &id;
            let is_endless = (0..DEEPEST).all(|_| match nodes.supertype(at) {
                Some(next) => {
                    at = next;
                    true
                }
                None => false,
            });
            if is_endless {
                let reason =
                    format!("it has more than {DEEPEST} supertypes, or is a supertype of itself");
                return Err(check.wrong(node, reason));
            }
        }
        for model in set.models.iter().flat_map(|table| &table.models) {
            provides.insert(model.model_uri.clone());
            let required = model.required_model.iter();
            needs.extend(required.map(|model| model.model_uri.clone()));
        }
        needs.remove(CORE);
        needs.retain(|uri| !provides.contains(uri));
        Ok(Self {
            uris,
            offset,
            provides,
            needs,
            nodes,
        })
    }

    /// Returns the URI of a namespace index of the file.
    fn uri(&self, index: u16) -> Option<&str> {
        if index == 0 {
            return Some(CORE);
        }
        let at = usize::from(index).checked_sub(self.offset)?;
        self.uris.get(at).map(String::as_str)
    }

    /// Returns a NodeId with the namespace index of the file.
    fn local(&self, uri: &str, identifier: &Identifier) -> Option<NodeId> {
        let at = self.uris.iter().position(|one| one == uri)?;
        Some(NodeId {
            namespace: u16::try_from(at + self.offset).ok()?,
            identifier: identifier.clone(),
        })
    }

    fn register_namespaces(&self, namespaces: &mut NodeSetNamespaceMapper<'_>) {
        for (index, uri) in (0_u16..).skip(self.offset).zip(&self.uris) {
            if index > 0 {
                namespaces.add_namespace(uri, index);
            }
        }
    }
}

/// The import of the library, without its output to stdout for each namespace.
struct Counted<'a> {
    set: &'a ImportedNodeSet,
    loaded: AtomicUsize,
}

impl NodeSetImport for Counted<'_> {
    fn register_namespaces(&self, namespaces: &mut NodeSetNamespaceMapper<'_>) {
        self.set.facts.register_namespaces(namespaces);
    }

    fn get_own_namespaces(&self) -> Vec<String> {
        let uris = self.set.facts.uris.iter().filter(|uri| *uri != CORE);
        uris.cloned().collect()
    }

    fn load<'a>(
        &'a self,
        namespaces: &'a NodeSetNamespaceMapper<'_>,
    ) -> Box<dyn Iterator<Item = ImportedItem> + 'a> {
        let types = self.set.types(namespaces);
        let others = self.set.others.load(namespaces);
        let items = types.into_iter().chain(others);
        Box::new(items.inspect(|_| {
            self.loaded.fetch_add(1, Ordering::Relaxed);
        }))
    }
}

/// Sets the DefaultEncodingId of each structure definition, which the library leaves out. Clients
/// that build a type from the definition send this id.
fn encoded(items: &mut [ImportedItem]) {
    let has_encoding: NodeId = ReferenceTypeId::HasEncoding.into();
    let mut ids = HashMap::new();
    for item in items.iter() {
        let node = item.node.as_node();
        if node.browse_name().name.as_ref() == BINARY {
            let of = item
                .references
                .iter()
                .filter(|one| one.type_id == has_encoding && !one.is_forward);
            ids.extend(of.map(|one| (one.target_id.clone(), node.node_id().clone())));
        }
    }
    for item in items {
        let NodeType::DataType(data_type) = &mut item.node else {
            continue;
        };
        let Some(DataTypeDefinition::Structure(definition)) = data_type.data_type_definition()
        else {
            continue;
        };
        if let Some(id) = ids.get(data_type.node_id())
            && definition.default_encoding_id.is_null()
        {
            let definition = StructureDefinition {
                default_encoding_id: id.clone(),
                ..definition.clone()
            };
            data_type.set_data_type_definition(Some(DataTypeDefinition::Structure(definition)));
        }
    }
}

/// The BrowseName of the binary encoding of a structure (OPC 10000-3, 5.8.4).
const BINARY: &str = "Default Binary";
/// The prefix of the BrowseNames of encodings.
const ENCODING: &str = "Default ";
/// Maximum number of supertypes of a DataType.
const DEEPEST: usize = 64;

/// Checks for faults at which the library would panic or silently leave out nodes.
struct Check<'a> {
    file: &'a str,
    text: &'a Text,
    uris: &'a [String],
    offset: usize,
    aliases: HashMap<&'a str, &'a str>,
}

/// A NodeId of a file that names no node of the file's namespaces.
#[derive(Debug, thiserror::Error)]
enum WrongNodeId {
    #[error("`{0}` is neither a NodeId nor an alias")]
    NoNodeId(String),
    #[error("`{text}` has namespace {index}, but the table of the file has {count}")]
    Namespace {
        text: String,
        index: u16,
        count: usize,
    },
}

impl Check<'_> {
    fn wrong(&self, node: &UANode, reason: impl Into<String>) -> NodeSetError {
        let node = node.base().node_id.0.clone();
        NodeSetError::Node {
            file: self.file.to_owned(),
            line: self.text.lines_of(&[&node]).remove(&node).unwrap_or(1),
            node,
            reason: reason.into(),
        }
    }

    fn uri(&self, index: u16) -> Option<&str> {
        if index == 0 {
            return Some(CORE);
        }
        let at = usize::from(index).checked_sub(self.offset)?;
        self.uris.get(at).map(String::as_str)
    }

    fn id(&self, text: &str) -> Result<NodeId, WrongNodeId> {
        let resolved = self.aliases.get(text).copied().unwrap_or(text);
        let id = NodeId::from_str(resolved).map_err(|_| WrongNodeId::NoNodeId(text.to_owned()))?;
        match self.uri(id.namespace) {
            Some(_) => Ok(id),
            None => Err(WrongNodeId::Namespace {
                text: text.to_owned(),
                index: id.namespace,
                count: self.uris.len(),
            }),
        }
    }

    /// Returns the NodeId of a node, and the namespaces that the node refers to.
    fn node(&self, node: &UANode) -> Result<(NodeId, BTreeSet<String>), NodeSetError> {
        let base = node.base();
        let mut used = BTreeSet::new();
        let mut id_of = |text: &str| {
            let id = self.id(text);
            let id = id.map_err(|fault| self.wrong(node, fault.to_string()))?;
            used.extend(self.uri(id.namespace).map(str::to_owned));
            Ok(id)
        };
        let id = id_of(&base.node_id.0)?;
        for reference in base.references.iter().flat_map(|list| &list.references) {
            id_of(&reference.reference_type.0)?;
            if id_of(&reference.node_id.0)? == id {
                return Err(self.wrong(node, "it refers to itself"));
            }
        }
        match node {
            UANode::Variable(variable) => drop(id_of(&variable.data_type.0)?),
            UANode::VariableType(variable) => drop(id_of(&variable.data_type.0)?),
            UANode::Object(_)
            | UANode::Method(_)
            | UANode::View(_)
            | UANode::ObjectType(_)
            | UANode::DataType(_)
            | UANode::ReferenceType(_) => {}
        }
        let name = base.browse_name.0.as_str();
        let index = match name.split_once(':') {
            Some((index, _)) if index.chars().all(|c| c.is_ascii_digit()) => index.parse().ok(),
            Some(_) | None => Some(0),
        };
        if index.and_then(|index| self.uri(index)).is_none() {
            let reason = format!("the namespace of its BrowseName `{name}` is not in the table");
            return Err(self.wrong(node, reason));
        }
        Ok((id, used))
    }
}

/// Orders the NodeSets so that each NodeSet follows its dependencies.
fn ordered(sets: Vec<ImportedNodeSet>) -> Result<Vec<ImportedNodeSet>, NodeSetError> {
    let mut owners: HashMap<&str, &ImportedNodeSet> = HashMap::new();
    for set in &sets {
        for uri in &set.facts.provides {
            if let Some(first) = owners.insert(uri, set) {
                return Err(NodeSetError::Twice {
                    first: first.file.clone(),
                    second: set.file.clone(),
                    uri: uri.clone(),
                });
            }
        }
    }
    for set in &sets {
        if let Some(uri) = set
            .facts
            .needs
            .iter()
            .find(|uri| !owners.contains_key(uri.as_str()))
        {
            return Err(NodeSetError::Missing {
                file: set.file.clone(),
                uri: uri.clone(),
            });
        }
    }
    let mut waiting = sets;
    let mut there: BTreeSet<String> = BTreeSet::new();
    let mut ordered = Vec::new();
    while !waiting.is_empty() {
        let ready = |set: &ImportedNodeSet| set.facts.needs.is_subset(&there);
        let (next, rest): (Vec<_>, Vec<_>) = waiting.into_iter().partition(ready);
        if next.is_empty() {
            let files: Vec<&str> = rest.iter().map(|set| set.file.as_str()).collect();
            return Err(NodeSetError::Circle(files.join(", ")));
        }
        there.extend(
            next.iter()
                .flat_map(|set| set.facts.provides.iter().cloned()),
        );
        ordered.extend(next);
        waiting = rest;
    }
    Ok(ordered)
}
