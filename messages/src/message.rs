use std::sync::Arc;

use uadp::BuiltinType;

use crate::definition::{Arity, Number, Primitive};
use crate::resolve::{Shape, ShapeKind};
use crate::{Constant, Dialect, TypeName};

/// A message type with all it needs resolved.
#[derive(Debug)]
pub struct MessageType {
    pub(crate) name: TypeName,
    pub(crate) dialect: Dialect,
    pub(crate) md5: String,
    pub(crate) definition: String,
    pub(crate) leaves: Vec<Leaf>,
    pub(crate) shape: Arc<Shape>,
}

/// A field of the flattened message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leaf {
    /// Names from the outside in, joined by dots: `pose.position.x`.
    pub path: String,
    /// The builtin type of the value or of its elements; ExtensionObject for an array of messages.
    pub builtin: BuiltinType,
    /// Single value or array. An array of bytes is a ByteString and single.
    pub rank: Rank,
}

impl Leaf {
    /// The one field of a message that crosses as it is ([`Selection::Bytes`](crate::Selection::Bytes)): a ByteString
    /// without a name.
    pub const fn bytes() -> Self {
        Self {
            path: String::new(),
            builtin: BuiltinType::ByteString,
            rank: Rank::Scalar,
        }
    }

    /// Whether it is a field of the message at `path`.
    pub fn is_inside(&self, path: &str) -> bool {
        self.path
            .strip_prefix(path)
            .is_some_and(|rest| rest.starts_with('.'))
    }
}

/// Whether a field is an array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// A single value.
    Scalar,
    /// An array of one dimension.
    Array {
        /// The only length it may have.
        fixed: Option<u32>,
    },
}

impl MessageType {
    /// Package and name.
    pub fn name(&self) -> &TypeName {
        &self.name
    }

    /// Whether it is the same on the wire, by its fields and those of all messages in it.
    pub fn is_same(&self, other: &Self) -> bool {
        self.dialect == other.dialect && self.shape == other.shape
    }

    /// The ROS whose bytes it describes.
    pub fn dialect(&self) -> Dialect {
        self.dialect
    }

    /// The 32 hex digits ROS 1 peers compare; empty for a ROS 2 type, which has none.
    pub fn md5(&self) -> &str {
        &self.md5
    }

    /// The text of the type and, each after a line of `=` and a line `MSG: package/Name`, of the types it needs: what a
    /// ROS 1 publisher puts into its connection header.
    pub fn definition(&self) -> &str {
        &self.definition
    }

    /// The fields in message order.
    pub fn leaves(&self) -> &[Leaf] {
        &self.leaves
    }

    /// The constants of the message itself, in the order of its text; those of messages in it are theirs.
    pub fn constants(&self) -> &[Constant] {
        &self.shape.constants
    }

    /// The constant of that name.
    pub fn constant(&self, name: &str) -> Option<&Constant> {
        self.constants()
            .iter()
            .find(|constant| constant.name == name)
    }

    /// How many bytes the array of bytes at that path has in every message; `None` where it may have another number, or
    /// is none.
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

    /// The field of that path.
    pub fn leaf(&self, path: &str) -> Option<&Leaf> {
        self.leaves.iter().find(|leaf| leaf.path == path)
    }
}

/// The type of one field `data` that carries a value of the builtin type, where nothing else says the type.
///
/// DateTime is `std_msgs/Time`, which only ROS 1 has; ROS 2 has `builtin_interfaces/Time`, see
/// [`Registry::standard_type`](crate::Registry::standard_type). None for arrays and ByteStrings: the `MultiArray` types
/// of std_msgs have a layout beside their data, so they are more than one field. None too for what ROS has no type for.
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
