//! The skills that were found at a server.

use plant_opcua::types::{NodeId, Variant};

use super::packed::Packed;
use crate::grip::GripPoint;
use crate::parameters::ParameterType;
use crate::tool_state::ToolState;
use crate::value::{SkillValue, ValueShape};
use crate::variant::from_variant;
use crate::workspace::RobotWorkspace;

/// A skill of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundSkill {
    /// The name of its component.
    pub component: String,
    /// The ApplicationUri of the component behind a station; `None` for a skill of the server
    /// itself.
    pub behind: Option<String>,
    /// The number of the component in the space, if the server provides it.
    pub namespace: Option<u16>,
    /// The number of the skill in the component, from 1.
    pub number: Option<u16>,
    /// The name of the skill in its component.
    pub name: String,
    /// Its node, as `nsu=<namespace uri>;i=100`.
    pub node: String,
    /// Its type and all supertypes up to SkillType, nearest first. Types of the earlier system are
    /// followed by their equivalents of this crate. The types of a Program that is not a skill end
    /// with ProgramStateMachineType.
    pub types: Vec<FoundType>,
    /// The parameters of a run.
    pub parameters: Vec<FoundParameter>,
    /// The results of a run.
    pub results: Vec<FoundParameter>,
    /// The IRIs of the capabilities it provides.
    pub capabilities: Vec<String>,
    /// The state of the tool changer of a skill that changes tools, if its component shows it.
    pub tool_state: Option<ToolState>,
    /// The grip point of a grasp skill, if its component states it.
    pub grip_point: Option<GripPoint>,
    /// The workspace of a move, if its component states it.
    pub workspace: Option<RobotWorkspace>,
    /// Parameters and results that cannot be used, with the reasons.
    pub strange: Vec<String>,
    pub(super) nodes: Nodes,
}

/// A type of a skill.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundType {
    /// Its name.
    pub name: ParameterType,
    /// The identifier of its node in the namespace of its name, as `i=1200`.
    pub identifier: String,
}

/// A parameter or result of a skill.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundParameter {
    /// Its BrowseName.
    pub name: String,
    /// Type and rank.
    pub shape: ValueShape,
    /// The current value of the variable. For a parameter it is the default; a parameter without a
    /// value is mandatory.
    pub default: Option<SkillValue>,
    /// Its unit, by the symbol.
    pub unit: Option<String>,
    /// The lowest and the highest value of a number.
    pub range: Option<(f64, f64)>,
    /// Its node, as `nsu=<namespace uri>;i=1000017`.
    pub node: String,
    pub(super) id: NodeId,
    /// The structure that the server uses for the numbers, if any.
    pub(super) packed: Option<Packed>,
}

impl FoundParameter {
    /// Converts a value of the variable; `None` if it does not match.
    pub(super) fn shown(&self, variant: &Variant) -> Option<SkillValue> {
        match self.packed {
            Some(packed) => packed.unpack(variant),
            None => from_variant(variant),
        }
    }
}

/// The nodes that are needed to run a skill.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Nodes {
    pub(super) skill: NodeId,
    /// The object of its component; null where there is none.
    pub(super) component: NodeId,
    /// Children by name; the children of CurrentState and FinalResultData by path.
    pub(super) children: Vec<(String, NodeId)>,
}

impl Nodes {
    pub(super) fn get(&self, path: &str) -> Option<&NodeId> {
        self.children
            .iter()
            .find(|(name, _)| name == path)
            .map(|(_, node)| node)
    }
}

/// Returns the elements of an array of strings; nothing for another value.
pub(super) fn texts(value: Option<SkillValue>) -> Vec<String> {
    match value {
        Some(SkillValue::Array(_, texts)) => texts
            .iter()
            .filter_map(|text| text.as_str().map(str::to_owned))
            .collect(),
        _ => Vec::new(),
    }
}
