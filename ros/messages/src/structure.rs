//! Message types as structures of OPC UA.

use uadp::BuiltinType;

use crate::definition::{Arity, Number, Primitive};
use crate::resolve::{MessageShape, ShapeKind, flatten};
use crate::{ArrayRank, Leaf, MessageType, TypeName};

/// A message type as a structure: its fields in the order of their encoding (OPC 10000-6, 5.2.6).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MessageStructure<'m> {
    /// The message type.
    pub name: &'m TypeName,
    /// Its fields; a nested message is one field.
    pub fields: Vec<StructureMember<'m>>,
}

/// A field of a [`MessageStructure`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StructureMember<'m> {
    /// Its name in the message definition.
    pub name: &'m str,
    /// Type of the field or of its elements.
    pub kind: MemberKind<'m>,
    /// Single value or array.
    pub rank: ArrayRank,
}

/// Type of a [`StructureMember`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MemberKind<'m> {
    /// A value of a builtin type.
    Value(BuiltinType),
    /// A nested message, encoded inline.
    Message(&'m TypeName),
}

impl MessageType {
    /// Returns the type of the message, or of the messages in the array, at a path; for the empty
    /// path the type itself.
    #[must_use]
    pub fn message_at(&self, path: &str) -> Option<&TypeName> {
        self.shape_at(path).map(|shape| &shape.name)
    }

    /// Returns the message at a path, as in [`message_at`](Self::message_at), as a structure,
    /// followed by its nested structures, each once. Empty if the path has no message.
    #[must_use]
    pub fn structures(&self, path: &str) -> Vec<MessageStructure<'_>> {
        let mut found = Vec::new();
        if let Some(shape) = self.shape_at(path) {
            collect(shape, &mut found);
        }
        found
    }

    /// Returns the field at a path in each message of an array.
    #[must_use]
    pub fn leaf_inside(&self, array: &str, field: &str) -> Option<Leaf> {
        let (_, leaves) = self.element_leaves(array)?;
        leaves.into_iter().find(|leaf| leaf.path == field)
    }

    /// Returns the flattened fields of a message of the array at a path.
    pub(crate) fn element_leaves(&self, path: &str) -> Option<(&TypeName, Vec<Leaf>)> {
        let leaf = self.leaf(path)?;
        if leaf.builtin != BuiltinType::ExtensionObject {
            return None;
        }
        let shape = self.shape_at(path)?;
        let mut leaves = Vec::new();
        flatten(shape, "", &mut leaves);
        Some((&shape.name, leaves))
    }

    fn shape_at(&self, path: &str) -> Option<&MessageShape> {
        let mut parts = path.split('.').filter(|part| !part.is_empty());
        parts.try_fold(self.shape.as_ref(), |shape, part| {
            let field = shape.fields.iter().find(|field| field.name == part)?;
            match &field.kind {
                ShapeKind::Message(inner) => Some(inner.as_ref()),
                ShapeKind::Primitive(_) | ShapeKind::Sequence => None,
            }
        })
    }
}

/// Collects nested structures. The recursion is limited by the nesting limit of definitions.
fn collect<'m>(shape: &'m MessageShape, found: &mut Vec<MessageStructure<'m>>) {
    if found.iter().any(|known| *known.name == shape.name) {
        return;
    }
    found.push(MessageStructure {
        name: &shape.name,
        fields: shape.fields.iter().filter_map(member).collect(),
    });
    for field in &shape.fields {
        if let ShapeKind::Message(inner) = &field.kind {
            collect(inner, found);
        }
    }
}

/// Returns the member of a field, or `None` for a field that is not transferred.
fn member(field: &crate::resolve::ShapeField) -> Option<StructureMember<'_>> {
    let rank = match field.arity {
        Arity::One => ArrayRank::Scalar,
        Arity::Fixed(length) => ArrayRank::Array {
            fixed: Some(length),
        },
        Arity::Sequence { .. } => ArrayRank::Array { fixed: None },
    };
    let (kind, rank) = match &field.kind {
        ShapeKind::Sequence => return None,
        ShapeKind::Message(inner) => (MemberKind::Message(&inner.name), rank),
        ShapeKind::Primitive(Primitive::Number(Number::UInt8)) if rank != ArrayRank::Scalar => (
            MemberKind::Value(BuiltinType::ByteString),
            ArrayRank::Scalar,
        ),
        ShapeKind::Primitive(primitive) => (MemberKind::Value(primitive.builtin()), rank),
    };
    Some(StructureMember {
        name: &field.name,
        kind,
        rank,
    })
}

#[cfg(test)]
mod tests {
    use crate::{Dialect, TypeRegistry};

    #[test]
    fn a_message_is_a_structure_of_its_fields_with_each_message_in_it_once() {
        let registry = TypeRegistry::bundle(Dialect::Ros1);
        let name = "nav_msgs/Path".parse().unwrap();
        let path = registry.get(&name).unwrap();
        let names = |at: &str| -> Vec<String> {
            let structures = path.structures(at);
            structures.iter().map(|one| one.name.to_string()).collect()
        };
        assert_eq!(
            names(""),
            [
                "nav_msgs/Path",
                "std_msgs/Header",
                "geometry_msgs/PoseStamped",
                "geometry_msgs/Pose",
                "geometry_msgs/Point",
                "geometry_msgs/Quaternion",
            ]
        );
        assert_eq!(names("poses.pose.position"), ["geometry_msgs/Point"]);
        assert_eq!(names("header.frame_id"), [""; 0]);
        let header = &path.structures("header")[0];
        let fields: Vec<_> = header.fields.iter().map(|field| field.name).collect();
        assert_eq!(fields, ["stamp", "frame_id"], "seq is not carried");
        assert_eq!(
            path.message_at("poses").map(ToString::to_string).as_deref(),
            Some("geometry_msgs/PoseStamped")
        );
    }
}
