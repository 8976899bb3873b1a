//! Chooses the type under which a call of another space is offered as a service or an action.

use std::sync::Arc;

use bridge_core::{CallDescription, CallMap};
use messages::{ActionCalls, ServiceType, TypeName};

use crate::GraphError;

/// Returns the service type under which a call is offered. The order is: the type in the mapping;
/// the type that the executor names at the beginning of the description, as in `my_msgs/Weigh;
/// Weighs the part`; a type of `std_srvs` with the same fields. `find` returns the type of a name.
///
/// # Errors
/// The reason why there is no type.
pub fn call_type(
    call: &CallDescription,
    (mapped, map): (Option<&TypeName>, &CallMap),
    mut find: impl FnMut(&TypeName) -> Result<Arc<ServiceType>, GraphError>,
) -> Result<Arc<ServiceType>, GraphError> {
    if let Some(name) = mapped {
        let service_type = find(name)?;
        call.fits(&service_type, map)?;
        return Ok(service_type);
    }
    if let Some(name) = named(call) {
        let service_type = find(&name)?;
        call.fits(&service_type, map)?;
        return Ok(service_type);
    }
    let standard = match call.response.is_empty() {
        true => &STANDARD[..],
        // `std_srvs/Empty` would hide the response.
        false => STANDARD.get(..2).unwrap_or_default(),
    };
    let found = standard.iter().find_map(|name| {
        let service_type = find(&name.parse().ok()?).ok()?;
        call.fits(&service_type, map)
            .is_ok()
            .then_some(service_type)
    });
    found.ok_or_else(|| {
        let of = |fields: &[bridge_core::CallField]| {
            let names: Vec<&str> = fields.iter().map(|field| field.name.as_str()).collect();
            names.join(", ")
        };
        GraphError::NoServiceType {
            request: of(&call.request),
            response: of(&call.response),
        }
    })
}

/// Returns the action type under which a family of calls is offered: the type in the mapping, else
/// the type that the executor names in the description of the goals. `find` returns the type of a
/// name.
///
/// # Errors
/// The reason why there is no type.
pub fn action_type(
    call: &CallDescription,
    (mapped, map): (Option<&TypeName>, &CallMap),
    find: impl FnOnce(&TypeName) -> Result<Arc<ActionCalls>, GraphError>,
) -> Result<Arc<ActionCalls>, GraphError> {
    let name = mapped.cloned().or_else(|| named(call));
    let name = name.ok_or(GraphError::NoActionType)?;
    let calls = find(&name)?;
    call.fits(calls.goal(), map)?;
    Ok(calls)
}

/// Returns the type named in the description of a call.
fn named(call: &CallDescription) -> Option<TypeName> {
    let first = call.about.split(';').next()?.trim();
    first.parse().ok()
}

/// Types for calls without a named type, most informative first.
const STANDARD: [&str; 3] = ["std_srvs/Trigger", "std_srvs/SetBool", "std_srvs/Empty"];

#[cfg(test)]
mod tests {
    use bridge_core::{CallField, CallRole};
    use messages::{Dialect, TypeRegistry};
    use uadp::BuiltinType;

    use super::*;

    fn answers() -> Vec<CallField> {
        vec![
            CallField::scalar("success", BuiltinType::Boolean),
            CallField::scalar("message", BuiltinType::String),
            CallField::scalar("run", BuiltinType::UInt32),
        ]
    }

    fn call(request: Vec<CallField>, response: Vec<CallField>, about: &str) -> CallDescription {
        CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: about.to_owned(),
            role: CallRole::Call,
            request,
            response,
        }
    }

    fn chosen(call: &CallDescription, mapped: Option<&str>) -> Result<String, String> {
        let registry = TypeRegistry::bundle(Dialect::Ros2);
        let mapped = mapped.map(|name| name.parse().unwrap());
        let find = |name: &TypeName| Ok(registry.service(name)?);
        call_type(call, (mapped.as_ref(), &CallMap::default()), find)
            .map(|found| found.name().to_string())
            .map_err(|error| error.to_string())
    }

    #[test]
    fn a_call_that_needs_nothing_is_a_trigger() {
        let trigger = Ok("std_srvs/Trigger".to_owned());
        assert_eq!(chosen(&call(vec![], answers(), ""), None), trigger);
        let force = || CallField::scalar("force", BuiltinType::Double);
        let optional = call(vec![force().optional()], answers(), "Grasps; softly");
        assert_eq!(chosen(&optional, None), trigger);
        let needed = call(vec![force()], answers(), "");
        let why = chosen(&needed, None).unwrap_err();
        assert!(why.contains("request (force)"), "{why}");
    }

    #[test]
    fn a_call_without_a_result_is_a_service_without_one() {
        let data = CallField::scalar("data", BuiltinType::Boolean);
        let set = call(vec![data], answers(), "");
        assert_eq!(chosen(&set, None).unwrap(), "std_srvs/SetBool");
        assert_eq!(
            chosen(&call(vec![], vec![], ""), None).unwrap(),
            "std_srvs/Empty"
        );
        let number = vec![CallField::scalar("number", BuiltinType::Double)];
        chosen(&call(vec![], number, ""), None).unwrap_err();
    }

    #[test]
    fn the_mapping_decides_before_the_executor_and_that_before_the_standard_types() {
        let named = call(vec![], answers(), "std_srvs/Empty; grasps");
        assert_eq!(chosen(&named, None).unwrap(), "std_srvs/Empty");
        assert_eq!(
            chosen(&named, Some("std_srvs/Trigger")).unwrap(),
            "std_srvs/Trigger"
        );
        chosen(&named, Some("std_srvs/SetBool")).unwrap_err();
        let unknown = call(vec![], answers(), "my_msgs/Weigh; weighs");
        let why = chosen(&unknown, None).unwrap_err();
        assert!(why.contains("my_msgs/Weigh"), "{why}");
    }
}
