//! What a check asks of the NodeSet2 files that a mapping names. They are read elsewhere.

use uadp::BuiltinType;

use crate::node_id::Identifier;

/// NodeSet2 files, as [`Surroundings::nodesets`](crate::Surroundings::nodesets) reads them.
pub trait NodeSets {
    /// What is wrong with them; asked once.
    fn faults(&mut self) -> Vec<NodeSetFault>;

    /// Another one when one of the files is.
    fn fingerprint(&self) -> u64;

    /// Whether one of them has nodes of a namespace.
    fn has(&self, uri: &str) -> bool;

    /// What a node of a namespace is; `None` where none of them has it.
    fn node(&self, uri: &str, node: &Identifier) -> Option<NodeSetNode>;
}

/// Something about one of the files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeSetFault {
    /// Which of them, from 0.
    pub file: usize,
    /// Whether it keeps them from being used.
    pub is_fatal: bool,
    /// What, for people.
    pub what: String,
    /// What to do, for people.
    pub help: String,
}

/// What a node of a NodeSet is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeSetNode {
    /// A Variable: what its values are, and its ValueRank (OPC 10000-3, 8.6).
    Variable(NodeSetType, i32),
    /// A Method.
    Method,
    /// Anything else.
    Other,
}

/// What the values of a Variable of a NodeSet are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeSetType {
    /// Anything, or not known.
    Any,
    /// Of one builtin type.
    Builtin(BuiltinType),
    /// Of any numeric type.
    Number,
    /// Of any type of whole numbers with a sign.
    Integer,
    /// Of any type of whole numbers without a sign.
    UnsignedInteger,
}

impl NodeSetNode {
    /// The builtin type of its values and whether they are arrays, where it has one.
    pub(crate) const fn value_type(self) -> Option<(BuiltinType, bool)> {
        match self {
            Self::Variable(NodeSetType::Builtin(builtin), -1) => Some((builtin, false)),
            Self::Variable(NodeSetType::Builtin(builtin), 1) => Some((builtin, true)),
            Self::Variable(..) | Self::Method | Self::Other => None,
        }
    }

    /// Whether it is a Variable that takes such values.
    pub(crate) fn takes(self, (builtin, array): (BuiltinType, bool)) -> bool {
        let Self::Variable(kind, rank) = self else {
            return false;
        };
        // -3 is a scalar or one dimension, -2 anything, 0 one dimension or more.
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
