//! The grip point of a grasp skill and the workspace of a move, for clients.

use plant_opcua::server::{Instance, OpcUaServer};

use crate::grip::GripPoint;
use crate::model::{
    GRIP_POINT_OFFSET, GRIP_POINT_OPENING, GRIP_POINT_TYPE, REACH, ZONE_BOUNDS, ZONE_NAMES,
};
use crate::value::{Builtin, SkillValue};
use crate::variant::to_variant;
use crate::workspace::RobotWorkspace;

/// Returns the values of a grip point, by the names of their properties.
fn values(grip: &GripPoint) -> Vec<(&'static str, SkillValue)> {
    let mut values = vec![(GRIP_POINT_OFFSET, SkillValue::from(grip.offset))];
    let grip_type = grip.grip_type.map(|of| SkillValue::Int32(of.number()));
    values.extend(grip_type.map(|of| (GRIP_POINT_TYPE, of)));
    let opening = grip
        .opening
        .map(|(low, high)| SkillValue::from(vec![low, high]));
    values.extend(opening.map(|opening| (GRIP_POINT_OPENING, opening)));
    values
}

/// Returns the values of a workspace, by the names of their properties.
fn bounds(workspace: &RobotWorkspace) -> Vec<(&'static str, SkillValue)> {
    let reach = workspace
        .reach
        .map(|reach| (REACH, SkillValue::Double(reach)));
    let mut values = Vec::from_iter(reach);
    if !workspace.zones.is_empty() {
        let names = workspace.zones.iter().map(|zone| zone.name.as_str().into());
        values.push((
            ZONE_NAMES,
            SkillValue::Array(Builtin::String, names.collect()),
        ));
        values.push((ZONE_BOUNDS, SkillValue::from(workspace.bounds())));
    }
    values
}

/// The properties of a skill that its YAML states.
#[derive(Clone, Copy)]
pub(super) struct Stated<'a> {
    pub(super) grip: Option<&'a GripPoint>,
    /// The workspace of a move.
    pub(super) workspace: Option<&'a RobotWorkspace>,
}

impl Stated<'_> {
    fn values(&self) -> Vec<(&'static str, SkillValue)> {
        let grip = self.grip.map(values).unwrap_or_default();
        let workspace = self.workspace.map(bounds).unwrap_or_default();
        grip.into_iter().chain(workspace).collect()
    }

    /// Returns the optional properties of the skill.
    pub(super) fn properties(&self) -> impl Iterator<Item = String> {
        self.values().into_iter().map(|(name, _)| name.to_owned())
    }

    /// Shows the properties. Returns `false` if the type of the skill does not have them.
    pub(super) fn show(&self, server: &OpcUaServer, instance: &Instance) -> bool {
        self.values().iter().all(|(name, value)| {
            let node = instance.node(name);
            node.is_some_and(|node| server.show(node, to_variant(value)).is_ok())
        })
    }
}
