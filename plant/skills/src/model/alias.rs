//! The names of skill types in an earlier system. Its components are found and run under the
//! equivalent types.

use super::{SkillType, find};
use crate::parameters::ParameterType;

/// The namespaces of that system.
pub const EARLIER: [&str; 6] = [
    "https://fortiss.org/UA/Device/",
    "https://fortiss.org/UA/Robotics/",
    "https://fortiss.org/UA/universal_robots/",
    "https://fortiss.org/UA/KelvinToolchanger/",
    "https://fortiss.org/UA/CompositeSkills/",
    "https://fortiss.org/UA/SemanticMES/",
];

/// A name of that system, without the optional suffix `Type`, and its equivalent in this crate.
const ALIASES: [(&str, &str); 21] = [
    ("Skill", "SkillType"),
    ("GripperSkill", "GripperSkillType"),
    ("GraspGripperSkill", "GraspSkillType"),
    ("ReleaseGripperSkill", "ReleaseSkillType"),
    ("MoveGripperSkill", "MoveGripperSkillType"),
    ("MoveSkill", "MotionSkillType"),
    ("PtpMoveSkill", "MotionSkillType"),
    ("LinearMoveSkill", "MotionSkillType"),
    ("CartesianPtpMoveSkill", "PtpMoveSkillType"),
    ("CartesianLinearMoveSkill", "LinearMoveSkillType"),
    ("CartesianLinearForceMoveSkill", "ForceMoveSkillType"),
    ("JointPtpMoveSkill", "JointPtpMoveSkillType"),
    ("JointLinearMoveSkill", "JointLinearMoveSkillType"),
    ("PositionStreamSkill", "PositionStreamSkillType"),
    ("AttachToolSkill", "AttachToolSkillType"),
    ("DetachToolSkill", "DetachToolSkillType"),
    ("DropToolSkill", "DetachToolSkillType"),
    ("ChangeToolSkill", "ChangeToolSkillType"),
    ("PickAndPlaceSkill", "PickAndPlaceSkillType"),
    ("NavigateToSkill", "NavigateToSkillType"),
    ("ExecuteProcessSkill", "ExecuteProcessSkillType"),
];

/// Returns the equivalent of a type of the earlier system; `None` for all other types.
#[must_use]
pub fn of(name: &ParameterType) -> Option<&'static SkillType> {
    if !EARLIER.contains(&name.namespace.as_str()) {
        return None;
    }
    let stem = name.name.strip_suffix("Type").unwrap_or(&name.name);
    let known = ALIASES.iter().find(|(earlier, _)| *earlier == stem);
    known.and_then(|(_, own)| find(own))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn earlier(namespace: &str, name: &str) -> Option<&'static str> {
        let name = ParameterType {
            namespace: namespace.to_owned(),
            name: name.to_owned(),
        };
        of(&name).map(|known| known.name)
    }

    #[test]
    fn each_alias_is_of_a_type_that_is_there_and_counts_in_its_namespaces_only() {
        for (name, own) in ALIASES {
            for name in [name.to_owned(), format!("{name}Type")] {
                assert_eq!(earlier(EARLIER[0], &name), Some(own), "{name}");
            }
        }
        assert_eq!(earlier("urn:vendor", "GraspGripperSkillType"), None);
        assert_eq!(earlier(EARLIER[0], "RobotiqType"), None);
    }
}
