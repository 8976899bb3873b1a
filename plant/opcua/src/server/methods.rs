//! Methods that are not declared in a type.

use std::sync::Arc;

use opcua::nodes::{Base, Method, Variable};
use opcua::server::address_space::AccessLevel;
use opcua::types::{
    Argument, DataTypeId, DataValue, ExtensionObject, LocalizedText, NodeClass, NodeId,
    QualifiedName, ReferenceTypeId, VariableTypeId, Variant,
};

use super::OpcUaServer;
use super::calls::MethodHandler;
use super::instances::{InstanceError, insert};

/// The description of a method of an object.
#[derive(Debug, Clone)]
pub struct MethodSpec {
    /// The NodeId of the method. The properties with its arguments have the NodeIds in
    /// [`arguments`](Self::arguments).
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// The object of the method.
    pub object: NodeId,
    /// The NodeIds of InputArguments and OutputArguments.
    pub arguments: (NodeId, NodeId),
    /// The input arguments.
    pub takes: Vec<Argument>,
    /// The output arguments.
    pub gives: Vec<Argument>,
}

impl OpcUaServer {
    /// Creates a method of an object, and sets its handler.
    ///
    /// # Errors
    /// Returns an error for an invalid NodeId or a missing object. No node is created in this case.
    pub fn add_method(
        &self,
        spec: MethodSpec,
        handler: Arc<dyn MethodHandler>,
    ) -> Result<(), InstanceError> {
        let alone = self.inner.making.lock();
        let spaces = &self.inner.spaces;
        let arguments = [
            ("InputArguments", spec.arguments.0, spec.takes),
            ("OutputArguments", spec.arguments.1, spec.gives),
        ];
        spaces.with(|view| {
            self.checked(view, &spec.node_id, &spec.object)?;
            let mut properties = arguments.iter();
            properties.try_for_each(|(_, id, _)| self.checked(view, id, &spec.object))
        })?;
        let mut own = spaces.own().write();
        let name = spec.browse_name.name.as_ref().to_owned();
        let display_name = LocalizedText::new("", &name);
        let method = Method::new(&spec.node_id, spec.browse_name, display_name, true, true);
        let component = ReferenceTypeId::HasComponent.into();
        insert(&mut own, method.into(), &spec.object, &component);
        for (which, id, arguments) in arguments {
            if arguments.is_empty() {
                continue;
            }
            let property = property(&id, which, arguments);
            let reference = ReferenceTypeId::HasProperty.into();
            insert(&mut own, property.into(), &spec.node_id, &reference);
            own.insert_reference(
                &id,
                &VariableTypeId::PropertyType.into(),
                ReferenceTypeId::HasTypeDefinition,
            );
        }
        drop(own);
        let calls = &self.inner.calls;
        calls.add(&spec.object, &spec.node_id, &name, &[]);
        calls.handle(&spec.object, &spec.node_id, handler);
        drop(alone);
        Ok(())
    }
}

fn property(id: &NodeId, name: &str, arguments: Vec<Argument>) -> Variable {
    let base = Base::new(
        NodeClass::Variable,
        id,
        QualifiedName::new(0, name),
        LocalizedText::new("", name),
    );
    let each = arguments.into_iter().map(with_dimensions);
    let value: Vec<ExtensionObject> = each.map(ExtensionObject::from_message).collect();
    let readable = AccessLevel::CURRENT_READ.bits();
    Variable::new_full(
        base,
        DataTypeId::Argument.into(),
        false,
        1,
        DataValue::new_now(Variant::from(value)),
        readable,
        readable,
        None,
        None,
    )
}

/// Returns an argument that the library encodes: a positive ValueRank has its dimensions, and other
/// ValueRanks have none. The length 0 of a dimension is any length (OPC 10000-3, 8.6). A ValueRank
/// above [`HIGHEST_RANK`] becomes OneOrMoreDimensions.
fn with_dimensions(mut argument: Argument) -> Argument {
    let dimensions = argument.array_dimensions.as_ref().map_or(0, Vec::len);
    match usize::try_from(argument.value_rank) {
        Ok(rank @ 1..=HIGHEST_RANK) if dimensions != rank => {
            argument.array_dimensions = Some(vec![0; rank]);
        }
        Ok(1..=HIGHEST_RANK) => {}
        Ok(0) | Err(_) => argument.array_dimensions = None,
        Ok(_) => {
            argument.value_rank = ONE_OR_MORE_DIMENSIONS;
            argument.array_dimensions = None;
        }
    }
    argument
}

/// Highest ValueRank of an argument that keeps its ValueRank.
const HIGHEST_RANK: usize = 8;
/// ValueRank of arrays of any dimensions (OPC 10000-3, 8.6).
const ONE_OR_MORE_DIMENSIONS: i32 = 0;

#[cfg(test)]
mod tests {
    use opcua::types::{BinaryDecodable as _, BinaryEncodable as _, ContextOwned};

    use super::*;

    #[test]
    fn arguments_with_any_dimensions_are_encoded_in_their_length() {
        let owned = ContextOwned::default();
        let context = owned.context();
        let (none, zeros) = (None, |rank| Some(vec![0; rank]));
        for (rank, dimensions, expected_rank, expected) in [
            (-3, Some(vec![4]), -3, None),
            (-1, Some(vec![]), -1, None),
            (-1, None, -1, None),
            (0, Some(vec![2, 3]), 0, None),
            (1, None, 1, zeros(1)),
            (2, Some(vec![2]), 2, zeros(2)),
            (2, Some(vec![2, 3]), 2, Some(vec![2, 3])),
            (8, None, 8, zeros(8)),
            (9, None, 0, None),
            (9, zeros(9), 0, None),
            (i32::MAX, none, 0, None),
        ] {
            let argument = with_dimensions(Argument {
                value_rank: rank,
                array_dimensions: dimensions,
                ..Argument::default()
            });
            let bytes = argument.encode_to_vec(&context);
            assert_eq!(bytes.len(), argument.byte_len(&context), "{rank}");
            let decoded = Argument::decode(&mut bytes.as_slice(), &context).unwrap();
            assert_eq!(decoded.value_rank, expected_rank, "{rank}");
            // The library encodes no dimensions as an empty list.
            let dimensions = decoded.array_dimensions.filter(|all| !all.is_empty());
            assert_eq!(dimensions, expected, "{rank}");
        }
    }
}
