//! The method `SetFields`: sets or checks fields, with arguments that stations pass on.

use plant_opcua::server::{
    IdRange, InstanceError, MethodRefusal, MethodRequest, MethodSpec, OpcUaServer, method,
};
use plant_opcua::types::{
    Argument, DataTypeId, LocalizedText, NodeId, QualifiedName, StatusCode, Variant,
};

use super::{Rights, SET_FIELDS, answer, log};
use crate::configuration::{ComponentConfiguration, FieldChange, NotConfigured};
use crate::variant::{from_optional_pairs, to_optional_pairs};

/// Adds the method to the object `Configuration`.
pub(super) fn add(
    server: &OpcUaServer,
    object: &NodeId,
    ids: &mut IdRange,
    (configuration, rights): (&ComponentConfiguration, &Rights),
) -> Result<(), InstanceError> {
    let argument = |name: &str, data_type: DataTypeId, value_rank, about: &str| Argument {
        name: name.into(),
        data_type: data_type.into(),
        value_rank,
        array_dimensions: None,
        description: LocalizedText::new("en", about),
    };
    let text = |name, about| argument(name, DataTypeId::String, SCALAR, about);
    let names = || argument("Names", DataTypeId::String, ARRAY, "The names of fields.");
    let values = |about| argument("Values", DataTypeId::BaseDataType, ARRAY, about);
    let spec = MethodSpec {
        node_id: ids.next(),
        browse_name: QualifiedName::new(object.namespace, SET_FIELDS),
        object: object.clone(),
        arguments: (ids.next(), ids.next()),
        takes: vec![
            names(),
            values("Their new values; null removes a configured value."),
            argument(
                "CheckOnly",
                DataTypeId::Boolean,
                SCALAR,
                "Whether the values are checked only.",
            ),
        ],
        gives: vec![
            text("Status", "`configured` or `refused`."),
            text("Field", "The first wrong field."),
            text("Reason", "The reason of the refusal."),
            names(),
            values("Their values before; null for fields without a configured value."),
        ],
    };
    let (configuration, rights) = (configuration.clone(), rights.clone());
    let handler = method(move |request: MethodRequest| {
        rights.check(&request.caller)?;
        let invalid = || MethodRefusal::from(StatusCode::BadInvalidArgument);
        let [names, values, Variant::Boolean(checks)] = request.arguments.as_slice() else {
            return Err(invalid());
        };
        let given = from_optional_pairs(names, values).ok_or_else(invalid)?;
        let changed: Result<FieldChange, NotConfigured> = match checks {
            true => configuration.check(given),
            false => configuration.change(given),
        };
        let (before, fault) = match changed {
            Ok(before) => (before, None),
            Err(fault) => (FieldChange::new(), Some(fault)),
        };
        if !checks {
            log(&request.caller, fault.as_ref());
        }
        let told = answer(fault).map(Variant::from);
        Ok(told.into_iter().chain(to_optional_pairs(&before)).collect())
    });
    server.add_method(spec, handler)
}

const SCALAR: i32 = -1;
const ARRAY: i32 = 1;
