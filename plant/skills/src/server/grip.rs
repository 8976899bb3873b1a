//! The grip point of a grasp skill, for clients.

use plant_opcua::server::{Instance, Server};

use crate::grip::GripPoint;
use crate::model::{GRIP_POINT_OFFSET, GRIP_POINT_OPENING, GRIP_POINT_TYPE};
use crate::value::Value;
use crate::variant::to_variant;

/// Returns the values of a grip point, by the names of their properties.
fn values(grip: &GripPoint) -> Vec<(&'static str, Value)> {
    let mut values = vec![(GRIP_POINT_OFFSET, Value::from(grip.offset))];
    let grip_type = grip.grip_type.map(|of| Value::Int32(of.number()));
    values.extend(grip_type.map(|of| (GRIP_POINT_TYPE, of)));
    let opening = grip.opening.map(|(low, high)| Value::from(vec![low, high]));
    values.extend(opening.map(|opening| (GRIP_POINT_OPENING, opening)));
    values
}

/// Returns the optional properties that a skill with this grip point has.
pub(super) fn properties(grip: Option<&GripPoint>) -> impl Iterator<Item = String> {
    let values = grip.map(values).unwrap_or_default();
    values.into_iter().map(|(name, _)| name.to_owned())
}

/// Shows a grip point. Returns `false` if the type of the skill has no grip points.
pub(super) fn show(server: &Server, instance: &Instance, grip: &GripPoint) -> bool {
    values(grip).iter().all(|(name, value)| {
        let node = instance.node(name);
        node.is_some_and(|node| server.show(node, to_variant(value)).is_ok())
    })
}
