//! The kinds of the nodes of a NodeSet, and the kinds of the values of its variables.

use std::collections::HashMap;

use opcua::types::{Identifier, NodeId, ReferenceTypeId};
use opcua::xml::schema::ua_node_set::UANode;

/// The kind of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeKind {
    /// A Variable with the kind of its values and its ValueRank.
    Variable(ValueKind, i32),
    /// A Method.
    Method,
    /// Any other NodeClass.
    Other,
}

/// The kind of the values of a DataType.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ValueKind {
    /// Any value, or an unknown DataType.
    Any,
    /// The built-in type with this id (OPC 10000-6, 5.1.2).
    Builtin(u8),
    /// Any numeric type.
    Number,
    /// Any signed integer type.
    Integer,
    /// Any unsigned integer type.
    UnsignedInteger,
}

/// The nodes of a NodeSet, by their NodeIds in the file.
#[derive(Default)]
pub(super) struct Outline(HashMap<NodeId, Entry>);

enum Entry {
    Variable {
        data_type: NodeId,
        rank: i32,
    },
    Method,
    /// A DataType with its supertype.
    DataType(Option<NodeId>),
    Other,
}

/// The entry of a node.
pub(super) enum OutlineEntry<'o> {
    Variable(&'o NodeId, i32),
    Method,
    Other,
}

impl Outline {
    /// Adds a node; returns `false` if the NodeId exists already.
    pub(super) fn insert(
        &mut self,
        id: NodeId,
        node: &UANode,
        resolved: &dyn Fn(&str) -> Option<NodeId>,
    ) -> bool {
        let entry = match node {
            UANode::Variable(variable) => Entry::Variable {
                data_type: resolved(&variable.data_type.0).unwrap_or_default(),
                rank: variable.value_rank.0,
            },
            UANode::Method(_) => Entry::Method,
            UANode::DataType(data_type) => {
                let references = data_type.base.base.references.iter();
                let mut references = references.flat_map(|list| &list.references);
                let supertype = references.find(|one| {
                    let of = resolved(&one.reference_type.0);
                    !one.is_forward && of.is_some_and(|of| of == ReferenceTypeId::HasSubtype)
                });
                Entry::DataType(supertype.and_then(|one| resolved(&one.node_id.0)))
            }
            UANode::Object(_)
            | UANode::View(_)
            | UANode::ObjectType(_)
            | UANode::VariableType(_)
            | UANode::ReferenceType(_) => Entry::Other,
        };
        self.0.insert(id, entry).is_none()
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn ids(&self) -> impl Iterator<Item = &NodeId> {
        self.0.keys()
    }

    pub(super) fn find(&self, id: &NodeId) -> Option<OutlineEntry<'_>> {
        Some(match self.0.get(id)? {
            Entry::Variable { data_type, rank } => OutlineEntry::Variable(data_type, *rank),
            Entry::Method => OutlineEntry::Method,
            Entry::DataType(_) | Entry::Other => OutlineEntry::Other,
        })
    }

    /// Returns the supertype of a DataType.
    pub(super) fn supertype(&self, id: &NodeId) -> Option<&NodeId> {
        match self.0.get(id)? {
            Entry::DataType(supertype) => supertype.as_ref(),
            Entry::Variable { .. } | Entry::Method | Entry::Other => None,
        }
    }
}

/// Returns the kind of the values of a DataType of the core namespace.
pub(super) fn core(id: &NodeId) -> ValueKind {
    match id.identifier {
        Identifier::Numeric(NUMBER) => ValueKind::Number,
        Identifier::Numeric(INTEGER) => ValueKind::Integer,
        Identifier::Numeric(UNSIGNED_INTEGER) => ValueKind::UnsignedInteger,
        Identifier::Numeric(number) => builtin(number).map_or(ValueKind::Any, ValueKind::Builtin),
        Identifier::String(_) | Identifier::Guid(_) | Identifier::ByteString(_) => ValueKind::Any,
    }
}

/// Returns the id of the built-in type of the DataType `i=number` of the core namespace (OPC
/// 10000-3, 5.8.3; OPC 10000-6, 5.1.2). Returns `None` for abstract DataTypes and for DataTypes
/// that this table does not contain; their supertypes may have a built-in type.
#[must_use]
pub const fn builtin(number: u32) -> Option<u8> {
    // A DataType that is a built-in type has the number of the built-in type; 24 to 29 are
    // abstract.
    Some(match number {
        1..=23 | 25 => {
            let [id, ..] = number.to_le_bytes();
            id
        }
        29 => 6,
        30 | 311 | 521 | 16307 | 2000..=2003 => 15,
        290 => 11,
        293 | 294 => 13,
        291 | 292 | 295 | 12877..=12881 | 23751 | 24263 | 31918 => 12,
        288 | 289 | 17588 | 20998 => 7,
        11737 => 9,
        _ => return None,
    })
}

const NUMBER: u32 = 26;
const INTEGER: u32 = 27;
const UNSIGNED_INTEGER: u32 = 28;
