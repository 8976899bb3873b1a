//! The DataTypes of messages in the arguments of Methods. A DataType exists as long as a Method
//! uses it.

use bridge_node::{CallDescription, CallField};
use mappings::TopicId;
use messages::ArrayRank;
use opcua::server::address_space::AddressSpace;
use opcua::types::{Argument, LocalizedText, NodeId};
use tracing::warn;

use crate::layout::VariableShape;
use crate::structures::Structure;

/// The DataTypes of arguments, beside the DataTypes of variables.
#[derive(Debug, Default)]
pub(crate) struct ArgumentTypes {
    /// DataTypes of variables. They stay when calls are removed.
    of_variables: Vec<Structure>,
    /// DataTypes of calls, with the calls that use each of them.
    of_calls: Vec<(Structure, Vec<TopicId>)>,
}

impl ArgumentTypes {
    pub(crate) fn set_variables(&mut self, structures: &[Structure]) {
        self.of_variables = structures.to_vec();
    }

    /// Adds the DataTypes of a call that do not exist yet. If another definition has the name of a
    /// DataType, or if there are too many, the arguments of this type are Structures without a
    /// definition.
    pub(crate) fn add(
        &mut self,
        address_space: &mut AddressSpace,
        (topic, description): (TopicId, &CallDescription),
    ) {
        let fields = description.request.iter().chain(&description.response);
        for field in fields {
            for structure in structures(topic, field) {
                if self.knows(&structure) {
                    self.of_calls
                        .iter_mut()
                        .filter(|(known, of)| *known == structure && !of.contains(&topic))
                        .for_each(|(_, of)| of.push(topic));
                } else if self.has_other(&structure) || self.of_calls.len() >= MOST_TYPES {
                    warn!(%topic, name = structure.name, "cannot define the DataType of an argument: another DataType has its name, or the limit of DataTypes is reached");
                } else {
                    structure.insert(address_space);
                    self.of_calls.push((structure, vec![topic]));
                }
            }
        }
    }

    /// Removes the DataTypes that no other call and no variable uses.
    pub(crate) fn remove(&mut self, address_space: &mut AddressSpace, topic: TopicId) {
        for (_, of) in &mut self.of_calls {
            of.retain(|one| *one != topic);
        }
        let variables = &self.of_variables;
        self.of_calls.retain(|(structure, of)| {
            let stays = variables.iter().any(|one| one.is_same(structure));
            if of.is_empty() && !stays {
                structure.remove(address_space);
            }
            !of.is_empty()
        });
    }

    /// Returns the DataType of an argument.
    pub(crate) fn data_type(&self, topic: TopicId, field: &CallField) -> NodeId {
        let all = structures(topic, field);
        match all.first() {
            Some(first) if all.iter().all(|one| self.knows(one)) => first.data_type(),
            Some(_) | None => VariableShape::of(field).data_type(),
        }
    }

    /// Converts fields into the arguments of a Method.
    pub(crate) fn arguments(&self, topic: TopicId, fields: &[CallField]) -> Vec<Argument> {
        let argument = |field: &CallField| Argument {
            name: field.name.as_str().into(),
            data_type: self.data_type(topic, field),
            value_rank: VariableShape::of(field).value_rank(),
            array_dimensions: match field.rank {
                ArrayRank::Scalar => None,
                ArrayRank::Array { fixed } => Some(vec![fixed.unwrap_or(0)]),
            },
            description: LocalizedText::null(),
        };
        fields.iter().map(argument).collect()
    }

    fn knows(&self, structure: &Structure) -> bool {
        self.all().any(|known| known == structure)
    }

    fn has_other(&self, structure: &Structure) -> bool {
        self.all().any(|known| known.is_same(structure))
    }

    fn all(&self) -> impl Iterator<Item = &Structure> {
        let of_calls = self.of_calls.iter().map(|(structure, _)| structure);
        self.of_variables.iter().chain(of_calls)
    }
}

/// Returns the structure of a field and the structures nested in it.
fn structures(topic: TopicId, field: &CallField) -> Vec<Structure> {
    let structure = field.structure.as_deref();
    structure.map_or_else(Vec::new, |of| Structure::of_call(of, topic.namespace.get()))
}

/// Largest number of DataTypes of calls. The limit exists because every participant of the space
/// can announce DataTypes.
const MOST_TYPES: usize = 1_024;
