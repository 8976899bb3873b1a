//! The configuration of a component, for clients: an object with a variable for each field, and a
//! method that sets fields.

mod fields;

use std::future::Future;
use std::sync::Arc;

use plant_opcua::server::{
    IdRange, InstanceError, MethodRefusal, MethodRequest, MethodSpec, ObjectSpec, OpcUaServer,
    SessionCaller, VariableSpec, method,
};
use plant_opcua::supervision::{CONFIGURE, Supervision};
use plant_opcua::types::{
    Argument, DataTypeId, DataValue, KeyValuePair, LocalizedText, NodeId, ObjectTypeId,
    QualifiedName, ReferenceTypeId, StatusCode, Variant,
};
use plant_opcua::users::UserAccess;
use tracing::{info, warn};

use super::values::{describe, variable_type};
use crate::configuration::{ComponentConfiguration, Configurable, FieldError, NotConfigured};
use crate::value::SkillValue;
use crate::variant::{from_variant, to_variant};

/// Creates the object and its method. The returned future shows each change.
pub(super) fn serve(
    server: &OpcUaServer,
    component: &NodeId,
    ids: &mut IdRange,
    (configuration, by): (&ComponentConfiguration, (Supervision, Arc<UserAccess>)),
) -> Result<impl Future<Output = ()> + use<>, InstanceError> {
    let mut shown = Vec::new();
    if !configuration.fields().is_empty() {
        let own = component.namespace;
        let object = ObjectSpec {
            node_id: ids.next(),
            browse_name: QualifiedName::new(own, OBJECT),
            display_name: OBJECT.into(),
            type_definition: ObjectTypeId::BaseObjectType.into(),
            parent: component.clone(),
            reference: ReferenceTypeId::HasComponent.into(),
            event_notifier: false,
        };
        server.add_object(&object)?;
        for field in configuration.fields() {
            shown.push(add(server, &object.node_id, field, ids)?);
        }
        let text = |name: &str, about: &str| Argument {
            name: name.into(),
            data_type: DataTypeId::String.into(),
            value_rank: -1,
            array_dimensions: None,
            description: LocalizedText::new("en", about),
        };
        let spec = MethodSpec {
            node_id: ids.next(),
            browse_name: QualifiedName::new(own, CONFIGURE),
            object: object.node_id.clone(),
            arguments: (ids.next(), ids.next()),
            takes: vec![Argument {
                data_type: DataTypeId::KeyValuePair.into(),
                value_rank: 1,
                ..text(
                    "Configuration",
                    "The fields to be set; others keep their values.",
                )
            }],
            gives: vec![
                text("Status", "`configured` or `refused`."),
                text("Field", "The first wrong field."),
                text("Reason", "The reason of the refusal."),
            ],
        };
        let rights = Rights {
            supervision: by.0,
            users: by.1,
        };
        fields::add(server, &object.node_id, ids, (configuration, &rights))?;
        let configuration = configuration.clone();
        let handler = method(move |request: MethodRequest| {
            let caller = &request.caller;
            rights.check(caller)?;
            let [given] = request.arguments.as_slice() else {
                return Err(MethodRefusal::from(StatusCode::BadInvalidArgument));
            };
            let set = pairs(given).and_then(|given| configuration.set(given));
            let fault = set.err();
            log(caller, fault.as_ref());
            Ok(answer(fault).map(Variant::from).to_vec())
        });
        server.add_method(spec, handler)?;
    }
    Ok(keep(server.clone(), configuration.clone(), shown))
}

/// The right to configure the component.
#[derive(Clone)]
struct Rights {
    supervision: Supervision,
    users: Arc<UserAccess>,
}

impl Rights {
    fn check(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        let admitted = self.supervision.admits(caller, self.users.roles_of(caller));
        admitted.inspect_err(|_| {
            warn!(
                application = ?caller.application_uri, user = ?caller.user, proven = caller.proven,
                "refused a configuration: the component is not registered with this client"
            );
        })
    }
}

/// Logs a change of the configuration.
fn log(caller: &SessionCaller, fault: Option<&NotConfigured>) {
    match fault {
        None => info!(application = ?caller.application_uri, "configured"),
        Some(why) => {
            warn!(application = ?caller.application_uri, "refused a configuration: {why}");
        }
    }
}

/// Returns `Status`, `Field` and `Reason` of a change.
fn answer(fault: Option<NotConfigured>) -> [String; 3] {
    fault.map_or_else(
        || [CONFIGURED.to_owned(), String::new(), String::new()],
        |why| [REFUSED.to_owned(), why.field, why.reason.to_string()],
    )
}

/// Adds the variable of a field.
fn add(
    server: &OpcUaServer,
    object: &NodeId,
    field: &Configurable,
    ids: &mut IdRange,
) -> Result<NodeId, InstanceError> {
    let facts = &field.facts;
    let node = ids.next();
    server.add_variable(&VariableSpec {
        node_id: node.clone(),
        browse_name: QualifiedName::new(object.namespace, facts.name.as_str()),
        display_name: LocalizedText::new("", &facts.name),
        type_definition: variable_type(facts).into(),
        parent: object.clone(),
        reference: ReferenceTypeId::HasComponent.into(),
        data_type: NodeId::new(0, u32::from(facts.shape.builtin.id())),
        value_rank: if facts.shape.array { 1 } else { -1 },
        value: DataValue::new_now_status(Variant::Empty, StatusCode::BadWaitingForInitialData),
        writable: false,
    })?;
    describe(server, &node, facts, ids)?;
    Ok(node)
}

/// Shows the fields at each change.
async fn keep(server: OpcUaServer, configuration: ComponentConfiguration, nodes: Vec<NodeId>) {
    let mut changes = configuration.watch();
    loop {
        changes.mark_unchanged();
        let values = configuration.fields().iter().zip(&nodes);
        let values = values.map(|(field, node)| {
            let value = match configuration.value(field) {
                Some(value) => DataValue::new_now(to_variant(&value)),
                None => {
                    DataValue::new_now_status(Variant::Empty, StatusCode::BadWaitingForInitialData)
                }
            };
            (node.clone(), value)
        });
        if let Err(status) = server.show_all(values.collect()) {
            warn!(%status, "cannot show the configuration");
        }
        // The component holds the configuration.
        if changes.changed().await.is_err() {
            return;
        }
    }
}

/// Reads the argument: an array of KeyValuePair.
fn pairs(given: &Variant) -> Result<Vec<(String, SkillValue)>, NotConfigured> {
    let wrong = |field: &str, reason| NotConfigured {
        field: field.to_owned(),
        reason,
    };
    let elements = if let Variant::Array(array) = given {
        array.values.as_slice()
    } else {
        std::slice::from_ref(given)
    };
    let pair = |element: &Variant| {
        let Variant::ExtensionObject(object) = element else {
            return Err(wrong("", FieldError::NoPairs));
        };
        let Some(pair) = object.inner_as::<KeyValuePair>() else {
            return Err(wrong("", FieldError::NoPairs));
        };
        let name = pair.key.name.as_ref();
        let value = if let Variant::Variant(inner) = &pair.value {
            from_variant(inner)
        } else {
            from_variant(&pair.value)
        };
        let value = value.ok_or_else(|| wrong(name, FieldError::Unsupported))?;
        Ok((name.to_owned(), value))
    };
    elements.iter().map(pair).collect()
}

/// The object with the fields of a component.
pub(crate) const OBJECT: &str = "Configuration";
/// The method that sets fields, or checks them, through stations too.
pub(crate) const SET_FIELDS: &str = plant_opcua::supervision::SET_FIELDS;
/// The values of `Status`.
pub(crate) const CONFIGURED: &str = "configured";
const REFUSED: &str = "refused";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_read_from_a_structure_and_others_are_refused() {
        let pair = |value: Variant| {
            Variant::from(plant_opcua::types::ExtensionObject::from_message(
                KeyValuePair {
                    key: QualifiedName::new(0, "Force"),
                    value,
                },
            ))
        };
        let force = pairs(&pair(Variant::from(12.5)));
        assert_eq!(
            force,
            Ok(vec![("Force".to_owned(), SkillValue::from(12.5))])
        );
        let refused = pairs(&pair(Variant::Empty)).unwrap_err();
        assert_eq!(refused.field, "Force");
        assert!(pairs(&Variant::from("Force")).is_err());
    }
}
