//! The method with which the supervisor of the component's level sets the location of the component
//! in the plant.

use std::sync::Arc;

use plant_opcua::server::{
    IdRange, InstanceError, MethodRefusal, MethodRequest, MethodSpec, OpcUaServer, VariableSpec,
    method,
};
use plant_opcua::supervision::{CONFIGURE, CONFIGURED, Supervision, configure_takes};
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, QualifiedName, ReferenceTypeId, StatusCode,
    VariableTypeId, Variant,
};
use plant_opcua::users::UserAccess;
use tracing::warn;

/// Adds the method `Configure`, and properties with its last arguments, to the object of a
/// component. Only the supervisor of the component and users with the role ConfigureAdmin may call
/// it.
pub(super) fn configurable(
    server: &OpcUaServer,
    object: &NodeId,
    ids: &mut IdRange,
    (supervision, users): (Supervision, Arc<UserAccess>),
) -> Result<(), InstanceError> {
    let mut shown = Vec::new();
    for (name, _) in CONFIGURED {
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
        browse_name: QualifiedName::new(object.namespace, CONFIGURE),
        object: object.clone(),
        arguments: (ids.next(), ids.next()),
        takes: configure_takes(),
        gives: Vec::new(),
    };
    let shower = server.clone();
    let handler = method(move |request: MethodRequest| {
        let caller = &request.caller;
        supervision
            .admits(caller, users.roles_of(caller))
            .inspect_err(|_| {
                warn!(
                    application = ?caller.application_uri, user = ?caller.user, proven = caller.proven,
                    "refused Configure: the component is not registered with this client"
                );
            })?;
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
            return Err(MethodRefusal::Arguments(each));
        }
        let values = shown.iter().cloned().zip(request.arguments);
        let values = values.map(|(node, value)| (node, DataValue::new_now(value)));
        shower.show_all(values.collect())?;
        Ok(Vec::new())
    });
    server.add_method(spec, handler)
}

const LONGEST: usize = 1024;
