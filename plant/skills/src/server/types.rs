//! Derives the description of a skill from its type and the instance of the type.

use plant_opcua::server::{Instance, OpcUaServer};
use plant_opcua::types::{NodeId, Variant};
use program::Rest;

use crate::model::{self, NAMESPACE, OUTCOME, SkillType};
use crate::parameters::{ParameterType, SkillParameter};
use crate::value::ValueShape;
use crate::variant::{builtin_of, from_variant};

/// Returns a type and its supertypes, nearest first.
pub(super) fn chain(server: &OpcUaServer, type_id: &NodeId) -> Vec<ParameterType> {
    let namespaces = server.namespaces();
    let named = |id: &NodeId| {
        let name = server.browse_name(id)?;
        Some(ParameterType {
            namespace: namespaces.get(usize::from(name.namespace_index))?.clone(),
            name: name.name.as_ref().to_owned(),
        })
    };
    let supertypes = server.supertypes(type_id);
    std::iter::once(type_id)
        .chain(&supertypes)
        .filter_map(named)
        .collect()
}

/// Returns the variables of a group: first the variables of types of the table, in its order, then
/// the additional variables of other types.
pub(super) fn parameters(
    server: &OpcUaServer,
    instance: &Instance,
    group: &str,
    types: &[ParameterType],
    of_table: impl Fn(&'static SkillType) -> Vec<SkillParameter>,
) -> Vec<SkillParameter> {
    let nearest = types
        .iter()
        .find(|of| of.namespace == NAMESPACE)
        .and_then(|of| model::find(&of.name));
    let mut all = nearest.map(of_table).unwrap_or_default();
    for (path, node) in instance.nodes() {
        let Some(name) = path
            .strip_prefix(group)
            .and_then(|rest| rest.strip_prefix('/'))
        else {
            continue;
        };
        if name.contains('/') || OUTCOME.contains(&name) {
            continue;
        }
        let Some(facts) = server.variable_facts(node) else {
            continue;
        };
        let value = facts.value.value.as_ref().and_then(from_variant);
        if let Some(known) = all.iter_mut().find(|known| known.name == name) {
            // A subtype may override the default.
            if let Some(value) = value.filter(|value| value.shape() == known.shape) {
                known.default = Some(value);
            }
            continue;
        }
        let Some(builtin) = builtin_of(&facts.data_type) else {
            tracing::warn!(
                "{path}: skills do not support the data type {}",
                facts.data_type
            );
            continue;
        };
        let property = |which: &str| instance.node(&format!("{path}/{which}"));
        all.push(SkillParameter {
            name: name.to_owned(),
            shape: ValueShape {
                builtin,
                array: facts.value_rank >= 1,
            },
            length: None,
            default: value,
            unit: property("EngineeringUnits").and_then(|node| unit(server, node)),
            range: property("EURange").and_then(|node| range(server, node)),
            about: facts.description.text.as_ref().to_owned(),
        });
    }
    all
}

/// Returns the state after a successful run, as the most derived type defines it.
pub(super) fn rests_in(server: &OpcUaServer, instance: &Instance) -> Rest {
    let node = instance.node("ReadyAfterSuccess");
    match node
        .and_then(|node| server.value(node))
        .and_then(|value| value.value)
    {
        Some(Variant::Boolean(false)) => Rest::Halted,
        Some(_) | None => Rest::Ready,
    }
}

fn unit(server: &OpcUaServer, node: &NodeId) -> Option<String> {
    let value = server.value(node)?.value?;
    let Variant::ExtensionObject(object) = value else {
        return None;
    };
    let unit = object.inner_as::<plant_opcua::types::EUInformation>()?;
    Some(unit.display_name.text.as_ref().to_owned())
}

fn range(server: &OpcUaServer, node: &NodeId) -> Option<(f64, f64)> {
    let value = server.value(node)?.value?;
    let Variant::ExtensionObject(object) = value else {
        return None;
    };
    let range = object.inner_as::<plant_opcua::types::Range>()?;
    Some((range.low, range.high))
}
