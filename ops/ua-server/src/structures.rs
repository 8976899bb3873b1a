//! The DataTypes of messages that are structures: messages in arrays, in variables with `as:
//! structure`, in calls, and nested in these messages.
//!
//! On the wire, the TypeId of an ExtensionObject is the name of its message type in the namespace
//! of its topic. A TypeId is the NodeId of an encoding (OPC 10000-6, 5.2.2.15), so this NodeId
//! belongs to the encoding, and the DataType has another NodeId.

use std::sync::Arc;

use bridge_node::{CallField, CallStructure, Definitions, RosEnvironment, TypePaths};
use mappings::{Binding, SpaceId, Variable};
use messages::{ArrayRank, Dialect, MemberKind, MessageType};
use opcua::nodes::{DataTypeBuilder, ObjectBuilder, ReferenceDirection};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    DataTypeDefinition, DataTypeId, LocalizedText, NodeId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StructureDefinition, StructureField, StructureType,
};
use tracing::warn;
use uadp::BuiltinType;

/// The definitions of the message types of the mapping, for ROS 1 and ROS 2.
pub(crate) struct MappedTypes {
    ros1: Definitions,
    ros2: Definitions,
}

impl MappedTypes {
    pub(crate) fn new(types: &Arc<TypePaths>) -> Self {
        let of = |dialect| Definitions::new(dialect, Arc::clone(types), RosEnvironment::from_env());
        Self {
            ros1: of(Dialect::Ros1),
            ros2: of(Dialect::Ros2),
        }
    }

    /// Switches to the current `type_paths`.
    pub(crate) fn replace(&mut self, types: &Arc<TypePaths>) {
        self.ros1.replace(types);
        self.ros2.replace(types);
    }

    /// Returns the message type of a variable's values, if it is known.
    pub(crate) fn of(&mut self, variable: &Variable) -> Option<Arc<MessageType>> {
        let origin = variable.binding(variable.topic.space);
        let Binding {
            space,
            message_type,
            ..
        } = origin.or_else(|| variable.bindings.first())?;
        let definitions = match *space {
            SpaceId::ROS1 => &mut self.ros1,
            _ => &mut self.ros2,
        };
        // Faults of the definition were reported with the mapping.
        definitions.find(message_type).ok()
    }
}

/// A message type in the address space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Structure {
    pub(crate) namespace: u16,
    pub(crate) name: String,
    fields: Vec<Member>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Member {
    name: String,
    kind: Kind,
    rank: ArrayRank,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Kind {
    Value(BuiltinType),
    /// A message, by its name.
    Structure(String),
}

/// The structures of all variables, each once.
#[derive(Debug, Default)]
pub(crate) struct VariableStructures(Vec<Structure>);

impl VariableStructures {
    /// Adds the message at a path of a message type, with its nested messages, and returns its
    /// DataType. Returns `None` if there is no message at the path, or if another definition has
    /// its name in this namespace.
    pub(crate) fn add(&mut self, of: &MessageType, path: &str, namespace: u16) -> Option<NodeId> {
        let found: Vec<Structure> = of
            .structures(path)
            .iter()
            .map(|one| Structure::new(one, namespace))
            .collect();
        let name = found.first()?.name.clone();
        let other = |one: &&Structure| {
            self.0
                .iter()
                .any(|known| known.is_same(one) && known != *one)
        };
        if let Some(other) = found.iter().find(other) {
            warn!(
                "variables of namespace {namespace} define {} differently: some of them do not get the DataType of {name}",
                other.name
            );
            return None;
        }
        for one in found {
            if !self.0.contains(&one) {
                self.0.push(one);
            }
        }
        Some(data_type(namespace, &name))
    }

    pub(crate) fn into_vec(self) -> Vec<Structure> {
        self.0
    }
}

impl Structure {
    fn new(of: &messages::MessageStructure<'_>, namespace: u16) -> Self {
        let member = |field: &messages::StructureMember<'_>| Member {
            name: field.name.to_owned(),
            kind: match field.kind {
                MemberKind::Value(builtin) => Kind::Value(builtin),
                MemberKind::Message(name) => Kind::Structure(name.to_string()),
            },
            rank: field.rank,
        };
        Self {
            namespace,
            name: of.name.to_string(),
            fields: of.fields.iter().map(member).collect(),
        }
    }

    /// Returns the message in a field of a call and its nested messages, outermost first and each
    /// once.
    pub(crate) fn of_call(of: &CallStructure, namespace: u16) -> Vec<Self> {
        let mut all: Vec<&CallStructure> = vec![of];
        let mut at = 0;
        while let Some(next) = all.get(at) {
            let inner = next
                .fields
                .iter()
                .filter_map(|field| field.structure.as_deref());
            let inner: Vec<&CallStructure> = inner.collect();
            for one in inner {
                if !all.iter().any(|known| known.name == one.name) {
                    all.push(one);
                }
            }
            at += 1;
        }
        let member = |field: &CallField| Member {
            name: field.name.clone(),
            kind: match &field.structure {
                Some(structure) => Kind::Structure(structure.name.clone()),
                None => Kind::Value(field.builtin),
            },
            rank: field.rank,
        };
        let structures = all.into_iter().map(|one| Self {
            namespace,
            name: one.name.clone(),
            fields: one.fields.iter().map(member).collect(),
        });
        structures.collect()
    }

    /// Returns the DataType.
    pub(crate) fn data_type(&self) -> NodeId {
        data_type(self.namespace, &self.name)
    }

    /// Removes the DataType and its encoding from the address space.
    pub(crate) fn remove(&self, address_space: &mut AddressSpace) {
        for node in [self.data_type(), encoding(self.namespace, &self.name)] {
            drop(address_space.delete(&node, true));
        }
    }

    /// Returns true if both have the same nodes.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        (self.namespace, &self.name) == (other.namespace, &other.name)
    }

    fn definition(&self) -> StructureDefinition {
        let field = |member: &Member| StructureField {
            name: member.name.as_str().into(),
            description: LocalizedText::null(),
            data_type: match &member.kind {
                Kind::Value(builtin) => NodeId::new(0, u32::from(builtin.id())),
                Kind::Structure(name) => data_type(self.namespace, name),
            },
            value_rank: match member.rank {
                ArrayRank::Scalar => -1,
                ArrayRank::Array { .. } => 1,
            },
            array_dimensions: match member.rank {
                ArrayRank::Scalar => None,
                ArrayRank::Array { fixed } => Some(vec![fixed.unwrap_or(0)]),
            },
            max_string_length: 0,
            is_optional: false,
        };
        StructureDefinition {
            default_encoding_id: encoding(self.namespace, &self.name),
            base_data_type: DataTypeId::Structure.into(),
            structure_type: StructureType::Structure,
            fields: Some(self.fields.iter().map(field).collect()),
        }
    }

    /// Adds the DataType and its encoding to the address space. A DataType of the same name is
    /// replaced.
    pub(crate) fn insert(&self, address_space: &mut AddressSpace) {
        self.remove(address_space);
        let id = self.data_type();
        let encoding = encoding(self.namespace, &self.name);
        DataTypeBuilder::new(
            &id,
            QualifiedName::new(self.namespace, self.name.as_str()),
            LocalizedText::from(self.name.as_str()),
        )
        .data_type_definition(DataTypeDefinition::Structure(self.definition()))
        .subtype_of(DataTypeId::Structure)
        .insert(address_space);
        ObjectBuilder::new(
            &encoding,
            QualifiedName::new(0, DEFAULT_BINARY),
            LocalizedText::from(DEFAULT_BINARY),
        )
        .has_type_definition(ObjectTypeId::DataTypeEncodingType)
        .reference(
            id,
            ReferenceTypeId::HasEncoding,
            ReferenceDirection::Inverse,
        )
        .insert(address_space);
    }
}

fn data_type(namespace: u16, name: &str) -> NodeId {
    NodeId::new(namespace, format!("DataType.{name}"))
}

fn encoding(namespace: u16, name: &str) -> NodeId {
    NodeId::new(namespace, name)
}

/// The BrowseName of an encoding (OPC 10000-5, 7.1).
const DEFAULT_BINARY: &str = "Default Binary";

#[cfg(test)]
mod tests {
    use messages::TypeRegistry;

    use super::*;

    #[test]
    fn an_array_of_messages_has_a_data_type_for_each_message_in_it_once() {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let mut structures = VariableStructures::default();
        let array = registry
            .get(&"geometry_msgs/PoseArray".parse().unwrap())
            .unwrap();
        let pose = registry
            .get(&"geometry_msgs/Pose".parse().unwrap())
            .unwrap();
        let id = NodeId::new(2, "DataType.geometry_msgs/Pose");
        assert_eq!(structures.add(&array, "poses", 2), Some(id.clone()));
        assert_eq!(structures.add(&pose, "", 2), Some(id));
        let all = structures.into_vec();
        let names: Vec<&str> = all.iter().map(|one| one.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "geometry_msgs/Pose",
                "geometry_msgs/Point",
                "geometry_msgs/Quaternion"
            ]
        );
        let definition = all[0].definition();
        assert_eq!(
            definition.default_encoding_id,
            NodeId::new(2, "geometry_msgs/Pose"),
            "the TypeId on the wire"
        );
        let fields = definition.fields.unwrap();
        let types: Vec<String> = fields.iter().map(|one| one.data_type.to_string()).collect();
        assert_eq!(
            types,
            [
                "ns=2;s=DataType.geometry_msgs/Point",
                "ns=2;s=DataType.geometry_msgs/Quaternion"
            ]
        );
    }
}
