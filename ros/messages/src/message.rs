use std::sync::Arc;

use uadp::BuiltinType;

use crate::definition::{Arity, Number, Primitive};
use crate::resolve::{MessageShape, ShapeKind};
use crate::{Constant, Dialect, TypeName};

/// A message type with all nested types resolved.
#[derive(Debug)]
pub struct MessageType {
    pub(crate) name: TypeName,
    pub(crate) dialect: Dialect,
    pub(crate) md5: String,
    pub(crate) definition: String,
    pub(crate) leaves: Vec<Leaf>,
    pub(crate) shape: Arc<MessageShape>,
}

/// A field of the flattened message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leaf {
    /// Names from the outside in, joined by dots: `pose.position.x`.
    pub path: String,
    /// The builtin type of the value or of its elements; ExtensionObject for an array of messages.
    pub builtin: BuiltinType,
    /// Single value or array. An array of bytes is a ByteString and single.
    pub rank: ArrayRank,
}

impl Leaf {
    /// Returns the only field of a message that is passed unchanged
    /// ([`Selection::Bytes`](crate::Selection::Bytes)): a ByteString without a name.
    pub const fn bytes() -> Self {
        Self {
            path: String::new(),
            builtin: BuiltinType::ByteString,
            rank: ArrayRank::Scalar,
        }
    }

    /// Returns whether it is a field of the message at `path`.
    pub fn is_inside(&self, path: &str) -> bool {
        self.path
            .strip_prefix(path)
            .is_some_and(|rest| rest.starts_with('.'))
    }
}

/// Whether a field is an array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArrayRank {
    /// A single value.
    Scalar,
    /// An array of one dimension.
    Array {
        /// The fixed length, if any.
        fixed: Option<u32>,
    },
}

impl MessageType {
    /// Returns package and name.
    pub fn name(&self) -> &TypeName {
        &self.name
    }

    /// Returns whether the wire format is the same, by the fields of the type and of all nested
    /// messages.
    pub fn is_same(&self, other: &Self) -> bool {
        self.dialect == other.dialect && self.shape == other.shape
    }

    /// Returns the ROS version whose bytes the type describes.
    pub fn dialect(&self) -> Dialect {
        self.dialect
    }

    /// Returns the 32 hex digits that ROS 1 peers compare; empty for a ROS 2 type.
    pub fn md5(&self) -> &str {
        &self.md5
    }

    /// Returns the text of the type followed by the texts of the types it needs, each after a line
    /// of `=` and a line `MSG: package/Name`. A ROS 1 publisher puts it into its connection header.
    pub fn definition(&self) -> &str {
        &self.definition
    }

    /// Returns the fields in message order.
    pub fn leaves(&self) -> &[Leaf] {
        &self.leaves
    }

    /// Returns the constants of the message itself, without those of nested messages, in the order
    /// of its text.
    pub fn constants(&self) -> &[Constant] {
        &self.shape.constants
    }

    /// Returns the constant of that name.
    pub fn constant(&self, name: &str) -> Option<&Constant> {
        self.constants()
            .iter()
            .find(|constant| constant.name == name)
    }

    /// Returns the fixed length of the byte array at that path, or `None` if its length varies or
    /// the field is not a byte array.
    pub(crate) fn fixed_bytes(&self, path: &str) -> Option<u32> {
        let mut shape = &self.shape;
        let mut parts = path.split('.').peekable();
        loop {
            let part = parts.next()?;
            let field = shape.fields.iter().find(|field| field.name == part)?;
            match (&field.kind, field.arity, parts.peek()) {
                (ShapeKind::Message(inner), Arity::One, Some(_)) => shape = inner,
                (
                    ShapeKind::Primitive(Primitive::Number(Number::UInt8)),
                    Arity::Fixed(count),
                    None,
                ) => {
                    return Some(count);
                }
                _ => return None,
            }
        }
    }

    /// Returns the field of that path.
    pub fn leaf(&self, path: &str) -> Option<&Leaf> {
        self.leaves.iter().find(|leaf| leaf.path == path)
    }
}

/// Returns the ROS type with the single field `data` for a value of the builtin type, as the
/// default type.
///
/// DateTime is `std_msgs/Time`, which only ROS 1 has; ROS 2 has `builtin_interfaces/Time`, see
/// [`TypeRegistry::standard_type`](crate::TypeRegistry::standard_type). Returns `None` for arrays
/// and ByteStrings: the `MultiArray` types of std_msgs have a layout beside their data, so they
/// have more than one field. Also returns `None` for builtin types without a ROS type.
pub fn standard_type(builtin: BuiltinType, array: bool) -> Option<TypeName> {
    let name = match builtin {
        _ if array => return None,
        BuiltinType::Boolean => "Bool",
        BuiltinType::SByte => "Int8",
        BuiltinType::Byte => "UInt8",
        BuiltinType::Int16 => "Int16",
        BuiltinType::UInt16 => "UInt16",
        BuiltinType::Int32 => "Int32",
        BuiltinType::UInt32 => "UInt32",
        BuiltinType::Int64 => "Int64",
        BuiltinType::UInt64 => "UInt64",
        BuiltinType::Float => "Float32",
        BuiltinType::Double => "Float64",
        BuiltinType::String => "String",
        BuiltinType::DateTime => "Time",
        BuiltinType::Guid
        | BuiltinType::ByteString
        | BuiltinType::XmlElement
        | BuiltinType::NodeId
        | BuiltinType::ExpandedNodeId
        | BuiltinType::StatusCode
        | BuiltinType::QualifiedName
        | BuiltinType::LocalizedText
        | BuiltinType::ExtensionObject
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => return None,
    };
    TypeName::new("std_msgs", name).ok()
}
