//! Reads the NodeSet2 files of a mapping (`server.nodesets`) for its check, with the reader of
//! `ua-server`.

use std::path::PathBuf;

use mappings::{Identifier, NodeSetFault, NodeSetNode, NodeSetType};
use opcua::types::{ByteString, Identifier as Known};
use plant_opcua::nodeset::{ImportedNodeSets, NodeKind, ValueKind};
use uadp::BuiltinType;

/// Reads the files for a check.
#[must_use]
pub fn read(files: &[PathBuf]) -> Box<dyn mappings::NodeSets> {
    let (sets, faults) = ImportedNodeSets::read(files);
    let faults = faults.into_iter().map(|fault| NodeSetFault {
        file: fault.file,
        is_fatal: fault.error.is_fatal(),
        what: fault.error.to_string(),
        help: fault.error.help().to_owned(),
    });
    Box::new(Read {
        faults: faults.collect(),
        sets,
    })
}

/// Converts an identifier to the type of the OPC UA library.
#[must_use]
pub fn identifier(text: &Identifier) -> Known {
    match text {
        Identifier::Numeric(number) => Known::Numeric(*number),
        Identifier::String(text) => Known::String(text.as_str().into()),
        // The mapping has validated the texts of both variants.
        Identifier::Guid(text) => Known::Guid(text.parse().unwrap_or_default()),
        Identifier::Opaque(text) => {
            Known::ByteString(ByteString::from_base64(text).unwrap_or_default())
        }
    }
}

struct Read {
    sets: ImportedNodeSets,
    faults: Vec<NodeSetFault>,
}

impl mappings::NodeSets for Read {
    fn faults(&mut self) -> Vec<NodeSetFault> {
        std::mem::take(&mut self.faults)
    }

    fn fingerprint(&self) -> u64 {
        self.sets.fingerprint()
    }

    fn has(&self, uri: &str) -> bool {
        self.sets.provides().any(|one| one == uri)
    }

    fn node(&self, uri: &str, node: &Identifier) -> Option<NodeSetNode> {
        Some(match self.sets.node(uri, &identifier(node))? {
            NodeKind::Variable(kind, rank) => NodeSetNode::Variable(of(kind), rank),
            NodeKind::Method => NodeSetNode::Method,
            NodeKind::Other => NodeSetNode::Other,
        })
    }
}

fn of(kind: ValueKind) -> NodeSetType {
    match kind {
        ValueKind::Any => NodeSetType::Any,
        ValueKind::Builtin(id) => {
            BuiltinType::from_id(id).map_or(NodeSetType::Any, NodeSetType::Builtin)
        }
        ValueKind::Number => NodeSetType::Number,
        ValueKind::Integer => NodeSetType::Integer,
        ValueKind::UnsignedInteger => NodeSetType::UnsignedInteger,
    }
}
