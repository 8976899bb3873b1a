//! The method by which whoever supervises the component's level tells it where it is in the plant.

use plant_opcua::server::{
    IdRange, InstanceError, MethodRequest, MethodSpec, Refusal, Server, VariableSpec, method,
};
use plant_opcua::types::{
    Argument, DataTypeId, DataValue, LocalizedText, NodeId, QualifiedName, ReferenceTypeId,
    StatusCode, VariableTypeId, Variant,
};

/// What a component is told, in this order; it shows each as a property of its object.
const TOLD: [(&str, &str); 3] = [
    (
        "Place",
        "Where the component is, as cell-1/station-a/gripper",
    ),
    ("SupervisorUri", "The ApplicationUri of whoever says so"),
    (
        "DiscoveryUrl",
        "The discovery server of the component's level",
    ),
];

/// Gives the object of a component the method `Configure` and what it was told last.
pub(super) fn configurable(
    server: &Server,
    object: &NodeId,
    ids: &mut IdRange,
) -> Result<(), InstanceError> {
    let mut shown = Vec::new();
    for (name, _) in TOLD {
        let node_id = ids.next();
        server.add_variable(&VariableSpec {
            node_id: node_id.clone(),
            browse_name: QualifiedName::new(object.namespace, name),
            display_name: LocalizedText::new("", name),
            type_definition: VariableTypeId::PropertyType.into(),
            parent: object.clone(),
            reference: ReferenceTypeId::HasProperty.into(),
            data_type: DataTypeId::String.into(),
            value_rank: -1,
            value: DataValue::new_now(Variant::from("")),
            writable: false,
        })?;
        shown.push(node_id);
    }
    let spec = MethodSpec {
        node_id: ids.next(),
        browse_name: QualifiedName::new(object.namespace, "Configure"),
        object: object.clone(),
        arguments: (ids.next(), ids.next()),
        takes: TOLD.map(|(name, about)| argument(name, about)).to_vec(),
        gives: Vec::new(),
    };
    let shower = server.clone();
    let handler = method(move |request: MethodRequest| {
        let fits = |argument: &Variant| {
            let Variant::String(text) = argument else {
                return false;
            };
            text.as_ref().len() <= LONGEST && !text.as_ref().contains(char::is_control)
        };
        let each = request
            .arguments
            .iter()
            .map(|argument| match fits(argument) {
                true => StatusCode::Good,
                false => StatusCode::BadOutOfRange,
            });
        let each: Vec<StatusCode> = each.collect();
        if each.contains(&StatusCode::BadOutOfRange) {
            return Err(Refusal::Arguments(each));
        }
        let values = shown.iter().cloned().zip(request.arguments);
        let values = values.map(|(node, value)| (node, DataValue::new_now(value)));
        shower.show_all(values.collect())?;
        Ok(Vec::new())
    });
    server.add_method(spec, handler)
}

fn argument(name: &str, about: &str) -> Argument {
    Argument {
        name: name.into(),
        data_type: DataTypeId::String.into(),
        value_rank: -1,
        array_dimensions: None,
        description: LocalizedText::new("en", about),
    }
}

const LONGEST: usize = 1024;
