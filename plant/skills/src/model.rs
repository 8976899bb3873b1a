//! The skill types of namespace [`NAMESPACE`], defined by one table.

pub mod alias;
mod nodeset;
mod table;
mod types;
mod units;

pub use nodeset::{DomainNodeSet, domain_nodesets, nodeset};
pub use table::{Preset, SkillType, TableUnit, TableVariable};
pub use types::TYPES;

pub use crate::parameters::NAMESPACE;
use crate::parameters::SkillParameter;
use crate::value::{Builtin, SkillValue, ValueShape};

/// The base type of all skills.
pub const SKILL_TYPE: &str = "SkillType";
/// The type of the events of transitions.
pub const EVENT_TYPE: &str = "SkillTransitionEventType";
/// The interface of a component, with the folder `Skills`.
pub const CONTROLLER_TYPE: &str = "ISkillControllerType";
/// The namespace of OPC 10000-100, which defines the locks of components.
pub(crate) const DEVICES: &str = "http://opcfoundation.org/UA/DI/";

/// The members of the results of SkillType itself.
pub(crate) const OUTCOME: [&str; 5] = ["Run", "Succeeded", "Message", "Trace", "Unknown"];

/// The method of a component that switches it off.
pub const POWER_OFF: &str = "PowerOffDevice";
/// The properties of the skills of a tool changer: the tool plate in the frame of the flange.
pub const TOOL_PLATE_OFFSET: &str = "ToolPlateOffset";
/// The ApplicationUri of the attached tool; empty for none.
pub const CURRENT_TOOL: &str = "CurrentTool";
/// The endpoint of the robot that carries the changer.
pub const MOVER_ENDPOINT: &str = "MoveSkillControllerEndpoint";

/// The largest distance from the base of a robot, m.
pub const REACH: &str = "Reach";
/// The names of the zones of a robot.
pub const ZONE_NAMES: &str = "ZoneNames";
/// The bounds of these zones.
pub const ZONE_BOUNDS: &str = "ZoneBounds";
/// The properties of a grasp skill with a grip point.
pub const GRIP_POINT_OFFSET: &str = "GripPointOffset";
/// A value of [`GripType`](crate::GripType).
pub const GRIP_POINT_TYPE: &str = "GripPointType";
/// The smallest and the largest width between the fingers.
pub const GRIP_POINT_OPENING: &str = "GripPointOpening";

/// The reference from a skill to a skill that does part of its work.
pub const USES_SKILL: &str = "UsesSkill";
/// The type of the target of that reference.
pub const USED_SKILL_TYPE: &str = "UsedSkillType";

/// Returns a type of the table by its BrowseName.
#[must_use]
pub fn find(name: &str) -> Option<&'static SkillType> {
    TYPES.iter().find(|known| known.name == name)
}

impl SkillType {
    /// Returns the supertype; `None` for SkillType, whose supertype is ProgramStateMachineType of
    /// namespace 0.
    #[must_use]
    pub fn supertype(&self) -> Option<&'static Self> {
        find(self.base?)
    }

    /// Returns the type and all its supertypes in the table, nearest first.
    pub fn chain(&'static self) -> impl Iterator<Item = &'static Self> {
        std::iter::successors(Some(self), |of| of.supertype())
    }

    /// Returns the parameters, with the supertypes' parameters first.
    #[must_use]
    pub fn parameters(&'static self) -> Vec<SkillParameter> {
        self.inherited(|of| of.parameters)
    }

    /// Returns the results, with the supertypes' results first.
    #[must_use]
    pub fn results(&'static self) -> Vec<SkillParameter> {
        self.inherited(|of| of.results)
    }

    fn inherited(
        &'static self,
        of: impl Fn(&'static Self) -> &'static [TableVariable],
    ) -> Vec<SkillParameter> {
        let mut chain: Vec<&Self> = self.chain().collect();
        chain.reverse();
        chain
            .into_iter()
            .flat_map(of)
            .map(TableVariable::parameter)
            .collect()
    }
}

impl TableVariable {
    fn parameter(&self) -> SkillParameter {
        SkillParameter {
            name: self.name.to_owned(),
            shape: self.shape,
            length: self.length,
            default: self.default_value(),
            unit: self.unit.map(|unit| unit.symbol.to_owned()),
            range: self.range,
            about: self.about.to_owned(),
        }
    }

    /// Returns the default value.
    #[must_use]
    pub fn default_value(&self) -> Option<SkillValue> {
        match self.preset {
            Preset::None => None,
            Preset::Number(number) => {
                ValueShape::scalar(Builtin::Double)
                    .take(number.into())
                    .and_then(|value| {
                        // All numbers of the table match their types.
                        self.shape.read_json(&value.to_json()).ok()
                    })
            }
            Preset::Text(text) => Some(text.into()),
            Preset::Flag(flag) => Some(flag.into()),
            Preset::Zeros(count) => Some((0..count).map(|_| 0.0).collect::<Vec<f64>>().into()),
        }
    }
}
