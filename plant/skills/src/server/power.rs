//! The method `PowerOffDevice`, which ends the program of a component before its device loses its
//! supply.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::server::{
    IdRange, InstanceError, MethodRefusal, MethodRequest, MethodSpec, OpcUaServer, method,
};
use plant_opcua::types::{
    Argument, DataTypeId, LocalizedText, NodeId, QualifiedName, StatusCode, Variant,
};
use plant_opcua::users::{Roles, UserAccess, UserRole};

use crate::model::POWER_OFF;
use crate::shown::is_work;
use crate::skill::Skill;

/// Ends the program after a delay.
#[derive(Clone)]
pub struct PowerOff(pub Arc<dyn Fn(Duration) + Send + Sync>);

impl fmt::Debug for PowerOff {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("PowerOff")
    }
}

/// Adds the method to the object of a component. It is refused while a skill runs.
pub(super) fn serve(
    server: &OpcUaServer,
    object: &NodeId,
    ids: &mut IdRange,
    skills: &[Skill],
    (power_off, users): (PowerOff, Arc<UserAccess>),
) -> Result<(), InstanceError> {
    let spec = MethodSpec {
        node_id: ids.next(),
        browse_name: QualifiedName::new(object.namespace, POWER_OFF),
        object: object.clone(),
        arguments: (ids.next(), ids.next()),
        takes: vec![Argument {
            name: "DelayMs".into(),
            data_type: DataTypeId::UInt32.into(),
            value_rank: -1,
            array_dimensions: None,
            description: LocalizedText::new("en", "The time until the program ends, ms."),
        }],
        gives: Vec::new(),
    };
    let skills = skills.to_vec();
    let handler = method(move |request: MethodRequest| {
        let may = Roles::of(&[UserRole::Operator, UserRole::Engineer]);
        if !users.roles_of(&request.caller).meets(may) {
            return Err(MethodRefusal::from(StatusCode::BadUserAccessDenied));
        }
        let runs = |skill: &Skill| is_work(skill.shown().state);
        if skills.iter().any(runs) {
            return Err(MethodRefusal::from(StatusCode::BadInvalidState));
        }
        let [Variant::UInt32(delay)] = request.arguments.as_slice() else {
            return Err(MethodRefusal::from(StatusCode::BadInvalidArgument));
        };
        if *delay > LONGEST_DELAY_MS {
            return Err(MethodRefusal::from(StatusCode::BadOutOfRange));
        }
        tracing::info!(delay, application = ?request.caller.application_uri, "switched off");
        (power_off.0)(Duration::from_millis((*delay).into()));
        Ok(Vec::new())
    });
    server.add_method(spec, handler)
}

/// Longest delay; a run that starts meanwhile is halted by the end of the program.
const LONGEST_DELAY_MS: u32 = 60_000;
