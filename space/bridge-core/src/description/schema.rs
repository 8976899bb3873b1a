//! The definitions of structures in metadata (OPC 10000-14, 6.2.3.2.3).

use std::collections::BTreeMap;

use messages::{ArrayRank, Leaf, MemberKind, MessageType, TypeName};
use uadp::discovery::{
    DataTypeSchemaHeader, StructureDefinition, StructureDescription, StructureField, WireArray,
};
use uadp::{BuiltinType, EncodeError, NodeId, QualifiedName};

/// Calls `then` with the definitions of the structures among the fields of a message.
pub(crate) fn with_structures<T>(
    message_type: &MessageType,
    leaves: &[Leaf],
    (namespace, uris): (u16, &BTreeMap<u16, String>),
    then: impl FnOnce(DataTypeSchemaHeader<'_>) -> Result<T, EncodeError>,
) -> Result<T, EncodeError> {
    let structures = structures(message_type, leaves);
    let namespaces = if structures.is_empty() {
        Vec::new()
    } else {
        namespaces_up_to(namespace, uris)
    };
    let inner_sizes: Vec<Vec<Vec<u32>>> = structures.iter().map(member_sizes).collect();
    let inner: Vec<Vec<StructureField<'_>>> = structures
        .iter()
        .zip(&inner_sizes)
        .map(|(structure, sizes)| structure_fields(structure, sizes, namespace))
        .collect();
    let described: Vec<StructureDescription<'_>> = structures
        .iter()
        .zip(&inner)
        .map(|(structure, fields)| structure_description(structure.name, fields, namespace))
        .collect();
    then(DataTypeSchemaHeader {
        namespaces: list(&namespaces),
        structure_data_types: list(&described),
        ..DataTypeSchemaHeader::default()
    })
}

/// Returns the list of namespaces up to the index that the TypeIds of ExtensionObjects use.
fn namespaces_up_to(namespace: u16, uris: &BTreeMap<u16, String>) -> Vec<Option<&str>> {
    if namespace > MAX_NAMESPACES {
        return Vec::new();
    }
    (1..=namespace)
        .map(|index| uris.get(&index).map(String::as_str))
        .collect()
}

/// Returns the types of the messages in arrays and of the messages nested in them, without
/// duplicates.
fn structures<'m>(
    message_type: &'m MessageType,
    leaves: &[Leaf],
) -> Vec<messages::MessageStructure<'m>> {
    let mut all: Vec<messages::MessageStructure<'m>> = Vec::new();
    for leaf in leaves {
        if leaf.builtin != BuiltinType::ExtensionObject {
            continue;
        }
        for structure in message_type.structures(&leaf.path) {
            if !all.iter().any(|known| known.name == structure.name) {
                all.push(structure);
            }
        }
    }
    all
}

fn member_sizes(structure: &messages::MessageStructure<'_>) -> Vec<Vec<u32>> {
    let ranks = structure.fields.iter().map(|field| field.rank);
    ranks.map(sizes).collect()
}

fn structure_description<'s>(
    name: &'s TypeName,
    fields: &'s [StructureField<'s>],
    namespace: u16,
) -> StructureDescription<'s> {
    StructureDescription {
        data_type_id: NodeId::string(namespace, name.as_str()),
        name: QualifiedName {
            namespace,
            name: Some(name.as_str()),
        },
        structure_definition: StructureDefinition {
            default_encoding_id: NodeId::string(namespace, name.as_str()),
            base_data_type: STRUCTURE,
            fields: list(fields),
            ..StructureDefinition::default()
        },
    }
}

fn structure_fields<'s>(
    structure: &'s messages::MessageStructure<'_>,
    sizes: &'s [Vec<u32>],
    namespace: u16,
) -> Vec<StructureField<'s>> {
    let fields = structure.fields.iter().zip(sizes);
    fields
        .map(|(field, sizes)| StructureField {
            name: Some(field.name),
            data_type: match field.kind {
                MemberKind::Value(builtin) => data_type(builtin, None, namespace),
                MemberKind::Message(of) => {
                    data_type(BuiltinType::ExtensionObject, Some(of), namespace)
                }
            },
            value_rank: value_rank(field.rank),
            array_dimensions: list(sizes),
            ..StructureField::default()
        })
        .collect()
}

/// Returns the DataType of a field. A message type and its encoding share a NodeId, the name of the
/// type.
pub(crate) fn data_type(builtin: BuiltinType, of: Option<&TypeName>, namespace: u16) -> NodeId<'_> {
    match of {
        Some(name) => NodeId::string(namespace, name.as_str()),
        None => NodeId::numeric(0, builtin.id().into()),
    }
}

pub(crate) const fn value_rank(rank: ArrayRank) -> i32 {
    match rank {
        ArrayRank::Scalar => -1,
        ArrayRank::Array { .. } => 1,
    }
}

/// Returns the number of elements in each dimension; 0 for a variable length.
pub(crate) fn sizes(rank: ArrayRank) -> Vec<u32> {
    match rank {
        ArrayRank::Scalar => Vec::new(),
        ArrayRank::Array { fixed } => vec![fixed.unwrap_or(0)],
    }
}

/// Returns the list of the elements; the null array if there are no elements.
pub(crate) const fn list<T>(elements: &[T]) -> WireArray<'_, T> {
    match elements {
        [] => WireArray::null(),
        elements => WireArray::new(elements),
    }
}

/// The DataType Structure (OPC 10000-5, 12.2.12).
const STRUCTURE: NodeId<'static> = NodeId::numeric(0, 22);
/// The maximum namespace index for which the list of namespaces is sent. The list grows with the
/// index.
const MAX_NAMESPACES: u16 = 64;
