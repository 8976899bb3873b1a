//! Interface of a check to the NodeSet2 files of a mapping. Another crate reads the files.

use uadp::BuiltinType;

use crate::node_id::Identifier;

/// NodeSet2 files, as [`Surroundings::nodesets`](crate::Surroundings::nodesets) reads them.
pub trait NodeSets {
    /// Returns the faults of the files; called once.
    fn faults(&mut self) -> Vec<NodeSetFault>;

    /// Returns a fingerprint that changes when a file changes.
    fn fingerprint(&self) -> u64;

    /// Returns `true` if a file has nodes of the namespace.
    fn has(&self, uri: &str) -> bool;

    /// Returns the kind of a node of a namespace; `None` if no file has it.
    fn node(&self, uri: &str, node: &Identifier) -> Option<NodeSetNode>;
}

/// Fault of one of the files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeSetFault {
    /// Index of the file, from 0.
    pub file: usize,
    /// `true` if the files cannot be used with the fault.
    pub is_fatal: bool,
    /// Message for users.
    pub what: String,
    /// Remedy for users.
    pub help: String,
}

/// Kind of a node of a NodeSet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeSetNode {
    /// A Variable: the type of its values, and its ValueRank (OPC 10000-3, 8.6).
    Variable(NodeSetType, i32),
    /// A Method.
    Method,
    /// Any other node.
    Other,
}

/// Type of the values of a Variable of a NodeSet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeSetType {
    /// Any type, or unknown.
    Any,
    /// One builtin type.
    Builtin(BuiltinType),
    /// Any numeric type.
    Number,
    /// Any type of signed integers.
    Integer,
    /// Any type of unsigned integers.
    UnsignedInteger,
}

impl NodeSetNode {
    /// Returns the builtin type of its values and `true` for arrays, if it has one builtin type.
    pub(crate) const fn value_type(self) -> Option<(BuiltinType, bool)> {
        match self {
            Self::Variable(NodeSetType::Builtin(builtin), -1) => Some((builtin, false)),
            Self::Variable(NodeSetType::Builtin(builtin), 1) => Some((builtin, true)),
            Self::Variable(..) | Self::Method | Self::Other => None,
        }
    }

    /// Returns `true` for a Variable that accepts such values.
    pub(crate) fn takes(self, (builtin, array): (BuiltinType, bool)) -> bool {
        let Self::Variable(kind, rank) = self else {
            return false;
        };
        // -3 is a scalar or one dimension, -2 any rank, 0 one dimension or more.
        let ranks: &[i32] = if array {
            &[1, 0, -2, -3]
        } else {
            &[-1, -2, -3]
        };
        ranks.contains(&rank) && kind.takes(builtin)
    }
}

impl NodeSetType {
    fn takes(self, builtin: BuiltinType) -> bool {
        use BuiltinType::{
            Byte, Double, Float, Int16, Int32, Int64, SByte, UInt16, UInt32, UInt64,
        };
        let signed = [SByte, Int16, Int32, Int64].contains(&builtin);
        let unsigned = [Byte, UInt16, UInt32, UInt64].contains(&builtin);
        match self {
            Self::Any => true,
            Self::Builtin(wanted) => wanted == builtin,
            Self::Number => signed || unsigned || [Float, Double].contains(&builtin),
            Self::Integer => signed,
            Self::UnsignedInteger => unsigned,
        }
    }
}
