//! NodeSet2 documents: converts the bytes of a file into nodes, and provides line numbers for
//! findings.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;
use std::str::FromStr as _;

use opcua::types::NodeId;
use opcua::xml::schema::ua_node_set::{
    ListOfReferences, NodeId as NodeIdText, Reference, UANode, UANodeBase, UANodeSet,
};
use opcua::xml::{XmlErrorInner, load_nodeset2_file};
use quick_xml::XmlVersion;
use quick_xml::events::Event;
use quick_xml::reader::Reader;

use super::{CORE, NodeSetError, NodeSetSource};
use crate::limits::LARGEST_NODESET;

/// A parsed document.
pub(super) struct Parsed {
    /// The file name.
    pub(super) file: String,
    pub(super) text: Text,
    pub(super) set: UANodeSet,
}

impl Parsed {
    /// Parses a document, without its nodes of the core namespace.
    pub(super) fn read(source: NodeSetSource) -> Result<Self, NodeSetError> {
        let (file, text) = match source {
            NodeSetSource::Text { name, xml } => (name, Text(xml)),
            NodeSetSource::Bytes { name, bytes } => {
                let text = Text::of(&name, &bytes)?;
                (name, text)
            }
            NodeSetSource::File(path) => {
                let file = path.display().to_string();
                let text = Text::of(&file, &bytes(&path, &file)?)?;
                (file, text)
            }
        };
        let document = load_nodeset2_file(&text.0).map_err(|error| {
            if let XmlErrorInner::Xml(reason) = &error.error {
                return not_a_document(&file, reason.to_string());
            }
            let (line, node) = text.place_at(error.span.start);
            let reason = error.error.to_string();
            match node {
                Some(node) => NodeSetError::Node {
                    file: file.clone(),
                    line,
                    node,
                    reason,
                },
                None => not_a_document(&file, format!("line {line}: {reason}")),
            }
        })?;
        let mut set = document
            .node_set
            .ok_or_else(|| not_a_document(&file, "it has no UANodeSet element".to_owned()))?;
        leave_out_core(&file, &mut set)?;
        Ok(Self { file, text, set })
    }
}

fn not_a_document(file: &str, reason: String) -> NodeSetError {
    NodeSetError::Xml {
        file: file.to_owned(),
        reason,
    }
}

/// Reads a file of at most [`LARGEST_NODESET`] bytes.
fn bytes(path: &Path, file: &str) -> Result<Vec<u8>, NodeSetError> {
    let mut bytes = Vec::new();
    let read = File::open(path)
        .and_then(|opened| opened.take(LARGEST_NODESET + 1).read_to_end(&mut bytes));
    read.map_err(|source| NodeSetError::Read {
        file: file.to_owned(),
        source,
    })?;
    if u64::try_from(bytes.len()).is_ok_and(|length| length <= LARGEST_NODESET) {
        return Ok(bytes);
    }
    let reason = format!("it is larger than {} MiB", LARGEST_NODESET >> 20);
    Err(not_a_document(file, reason))
}

/// The text of a document.
pub(super) struct Text(String);

impl Text {
    fn of(file: &str, bytes: &[u8]) -> Result<Self, NodeSetError> {
        let text = xml_text::decode(bytes);
        let text = text.map_err(|error| not_a_document(file, error.to_string()))?;
        Ok(Self(text.into_owned()))
    }

    /// Returns the line of a byte offset, from 1.
    fn line(&self, at: usize) -> usize {
        let before = self.0.as_bytes().get(..at).unwrap_or(self.0.as_bytes());
        before.iter().filter(|byte| **byte == b'\n').count() + 1
    }

    /// Calls `found` with the start and the NodeId of each node, until it returns `false`.
    fn each_node(&self, found: &mut dyn FnMut(usize, String) -> bool) {
        let mut reader = Reader::from_str(&self.0);
        reader.config_mut().check_end_names = false;
        loop {
            let start = usize::try_from(reader.buffer_position()).unwrap_or(usize::MAX);
            let (Event::Start(element) | Event::Empty(element)) = (match reader.read_event() {
                Ok(Event::Eof) | Err(_) => return,
                Ok(event) => event,
            }) else {
                continue;
            };
            if !element.local_name().into_inner().starts_with("UA") {
                continue;
            }
            let id = element.try_get_attribute("NodeId").ok().flatten();
            let id = id.and_then(|id| id.normalized_value(XmlVersion::Implicit1_0).ok());
            if let Some(id) = id
                && !found(start, id.trim_ascii().to_owned())
            {
                return;
            }
        }
    }

    /// Returns the line of a byte offset, and the NodeId of the node at the offset.
    fn place_at(&self, at: usize) -> (usize, Option<String>) {
        let mut node = None;
        self.each_node(&mut |start, id| {
            let is_before = start <= at;
            if is_before {
                node = Some(id);
            }
            is_before
        });
        (self.line(at), node)
    }

    /// Returns the lines of nodes, from 1. For a duplicate NodeId the line of the last node is
    /// returned.
    pub(super) fn lines_of(&self, nodes: &[&str]) -> HashMap<String, usize> {
        let mut lines = HashMap::new();
        let (mut line, mut counted) = (1, 0);
        self.each_node(&mut |start, id| {
            if nodes.contains(&id.as_str()) {
                let between = self.0.as_bytes().get(counted..start).unwrap_or_default();
                line += between.iter().filter(|byte| **byte == b'\n').count();
                counted = start;
                lines.insert(id, line);
            }
            true
        });
        lines
    }
}

/// Returns the index of the first URI in the namespace table of a document.
///
/// The table starts at index 1 (OPC 10000-6, F.2). Some tools list the core namespace as the first
/// URI with index 0, other tools list it with index 1. In the second case, the largest namespace
/// index in use equals the length of the table.
pub(super) fn offset(set: &UANodeSet) -> usize {
    let uris = uris(set);
    if uris.first().is_none_or(|first| first != CORE) {
        return 1;
    }
    let index = |text: &NodeIdText| NodeId::from_str(&text.0).map_or(0, |id| id.namespace);
    let is_last = |text: &NodeIdText| usize::from(index(text)) == uris.len();
    let uses_last = set.nodes.iter().any(|node| {
        let base = node.base();
        let mut references = base.references.iter().flat_map(|list| &list.references);
        is_last(&base.node_id)
            || references.any(|one| is_last(&one.node_id) || is_last(&one.reference_type))
    });
    usize::from(uses_last)
}

pub(super) fn uris(set: &UANodeSet) -> &[String] {
    set.namespace_uris.as_ref().map_or(&[], |table| &table.uris)
}

/// Removes the nodes of the core namespace, which some servers export together with their own
/// nodes. References from a removed node to a node of the document are kept at the node of the
/// document.
///
/// # Errors
/// Returns [`NodeSetError::Core`] if the document has no other nodes.
fn leave_out_core(file: &str, set: &mut UANodeSet) -> Result<(), NodeSetError> {
    let (offset, count) = (offset(set), uris(set).len());
    let core_index =
        (offset == 1 && uris(set).first().is_some_and(|first| first == CORE)).then_some(1);
    let is_core = |id: &NodeId| id.namespace == 0 || Some(id.namespace) == core_index;
    let id_of = |text: &NodeIdText| NodeId::from_str(&text.0).ok();
    let is_of_core = |node: &UANode| id_of(&node.base().node_id).is_some_and(|id| is_core(&id));
    let Some(first) = set.nodes.iter().find(|node| is_of_core(node)) else {
        return Ok(());
    };
    if count == 0 || set.nodes.iter().all(is_of_core) {
        let node = first.base().node_id.0.clone();
        return Err(NodeSetError::Core {
            file: file.to_owned(),
            node,
        });
    }
    let (core, own): (Vec<_>, Vec<_>) = set.nodes.drain(..).partition(is_of_core);
    set.nodes = own;
    let mut kept: HashMap<NodeId, Vec<Reference>> = HashMap::new();
    for node in &core {
        let base = node.base();
        for one in base.references.iter().flat_map(|list| &list.references) {
            if let Some(target) = id_of(&one.node_id).filter(|id| !is_core(id)) {
                kept.entry(target).or_default().push(Reference {
                    node_id: base.node_id.clone(),
                    reference_type: one.reference_type.clone(),
                    is_forward: !one.is_forward,
                });
            }
        }
    }
    for node in &mut set.nodes {
        let more = id_of(&node.base().node_id).and_then(|id| kept.remove(&id));
        let base = base_of(node);
        let list = base.references.get_or_insert_with(|| ListOfReferences {
            references: Vec::new(),
        });
        for one in more.into_iter().flatten() {
            let is_there = list.references.iter().any(|known| {
                known.node_id.0 == one.node_id.0
                    && known.reference_type.0 == one.reference_type.0
                    && known.is_forward == one.is_forward
            });
            if !is_there {
                list.references.push(one);
            }
        }
    }
    Ok(())
}

fn base_of(node: &mut UANode) -> &mut UANodeBase {
    match node {
        UANode::Object(node) => &mut node.base.base,
        UANode::Variable(node) => &mut node.base.base,
        UANode::Method(node) => &mut node.base.base,
        UANode::View(node) => &mut node.base.base,
        UANode::ObjectType(node) => &mut node.base.base,
        UANode::VariableType(node) => &mut node.base.base,
        UANode::DataType(node) => &mut node.base.base,
        UANode::ReferenceType(node) => &mut node.base.base,
    }
}
