//! The skill types, as a table.

use program::Rest;

use super::table::{Preset, SkillType, TableUnit, TableVariable};
use super::units::{ACCELERATION, KILOGRAM, METRE, NEWTON, RADIAN, SPEED, TURNING, TURNING_UP};
use crate::value::{Builtin, ValueShape};

const fn number(
    name: &'static str,
    default: f64,
    unit: Option<&'static TableUnit>,
    range: (f64, f64),
    about: &'static str,
) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::scalar(Builtin::Double),
        length: None,
        preset: Preset::Number(default),
        unit,
        range: Some(range),
        about,
    }
}

const fn text(name: &'static str, preset: Preset, about: &'static str) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::scalar(Builtin::String),
        length: None,
        preset,
        unit: None,
        range: None,
        about,
    }
}

/// A mandatory parameter: position and orientation of a tool.
const fn position(name: &'static str, about: &'static str) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::array(Builtin::Double),
        length: Some(6),
        preset: Preset::None,
        unit: None,
        range: None,
        about,
    }
}

/// An optional parameter: a position; six zeros if it is not given.
const fn optional_position(name: &'static str, about: &'static str) -> TableVariable {
    TableVariable {
        preset: Preset::Zeros(6),
        ..position(name, about)
    }
}

/// A mandatory parameter: an array of numbers.
const fn numbers(
    name: &'static str,
    length: Option<u32>,
    unit: Option<&'static TableUnit>,
    about: &'static str,
) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::array(Builtin::Double),
        length,
        preset: Preset::None,
        unit,
        range: None,
        about,
    }
}

/// A result: a number that the run measures.
const fn measured(
    name: &'static str,
    unit: Option<&'static TableUnit>,
    about: &'static str,
) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::scalar(Builtin::Double),
        length: None,
        preset: Preset::Number(0.0),
        unit,
        range: None,
        about,
    }
}

const fn flag(name: &'static str, about: &'static str) -> TableVariable {
    TableVariable {
        name,
        shape: ValueShape::scalar(Builtin::Boolean),
        length: None,
        preset: Preset::Flag(false),
        unit: None,
        range: None,
        about,
    }
}

const TOOL_POSITION: TableVariable = optional_position(
    "ToolPosition",
    "The pose of the flange at the dock of the tool, as TargetPosition of a move. Zeros: the dock that was used last.",
);
const TOOL_APP_URI: TableVariable = text(
    "ToolAppUri",
    Preset::None,
    "The ApplicationUri of the component that the tool is.",
);

/// All skill types, supertypes before their subtypes.
pub static TYPES: [SkillType; 23] = [
    SkillType {
        name: "SkillType",
        id: 1000,
        base: None,
        is_abstract: true,
        about: "What a component can do, as a Program of OPC 10000-10: made ready by Reset, begun by Start, ended by itself or by Halt.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "GripperSkillType",
        id: 1100,
        base: Some("SkillType"),
        is_abstract: true,
        about: "A skill of what holds things.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "GraspSkillType",
        id: 1200,
        base: Some("GripperSkillType"),
        is_abstract: false,
        about: "Takes hold of the thing that is there, and fails if there is none.",
        parameters: &[number(
            "Force",
            20.0,
            Some(&NEWTON),
            (0.0, 10_000.0),
            "How hard to hold, at most.",
        )],
        results: &[TableVariable {
            name: "Gripped",
            shape: ValueShape::scalar(Builtin::Boolean),
            length: None,
            preset: Preset::Flag(false),
            unit: None,
            range: None,
            about: "Whether a thing is held.",
        }],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "ReleaseSkillType",
        id: 1300,
        base: Some("GripperSkillType"),
        is_abstract: false,
        about: "Lets go of what is held, if anything is.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "MotionSkillType",
        id: 2300,
        base: Some("SkillType"),
        is_abstract: true,
        about: "Moves a robot.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "MoveSkillType",
        id: 1400,
        base: Some("MotionSkillType"),
        is_abstract: true,
        about: "Brings the tool to a position.",
        parameters: &[
            position(
                "TargetPosition",
                "x, y, z in m and the rotations about x, y, z in rad of the tool, in the frame of the robot's base.",
            ),
            number(
                "MaxVelocity",
                0.2,
                Some(&SPEED),
                (0.001, 10.0),
                "The tool is never faster.",
            ),
            number(
                "MaxAcceleration",
                1.0,
                Some(&ACCELERATION),
                (0.001, 100.0),
                "Nor does it gain or lose speed faster.",
            ),
            text(
                "ToolFrame",
                Preset::Text("flange"),
                "Which frame is brought there.",
            ),
        ],
        results: &[position(
            "Position",
            "Where the tool is, as TargetPosition.",
        )],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "PtpMoveSkillType",
        id: 1500,
        base: Some("MoveSkillType"),
        is_abstract: false,
        about: "Moves from point to point, all axes beginning and ending together; the way between is free.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "LinearMoveSkillType",
        id: 1600,
        base: Some("MoveSkillType"),
        is_abstract: false,
        about: "Moves along a straight line.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "PickAndPlaceSkillType",
        id: 1700,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Takes a thing from one place to another, by the skills of a robot and a gripper.",
        parameters: &[
            optional_position(
                "PickPosition",
                "The pose of the object, as TargetPosition of a move: its centre, with its z axis up. Zeros: the pose of ObjectId.",
            ),
            position(
                "PlacePosition",
                "The target pose of the object, as PickPosition.",
            ),
            number(
                "ApproachOffset",
                0.05,
                Some(&METRE),
                (0.0, 1.0),
                "Distance from both poses at which moves start and end, along the z axis of the tool.",
            ),
            text(
                "ObjectId",
                Preset::Text(""),
                "The object, which is looked up in the world of the component, in ua-mes, and by skills that locate objects.",
            ),
            text(
                "ToolSkillControllerEndpoint",
                Preset::Text(""),
                "The endpoint or ApplicationUri of the tool; empty for the tool that is attached.",
            ),
            text(
                "MoveSkillControllerEndpoint",
                Preset::Text(""),
                "The endpoint or ApplicationUri of the robot; empty for the robot that is found by its skills.",
            ),
        ],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "ExecuteProcessSkillType",
        id: 1800,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Runs a process of the plant's knowledge: finds skills for its steps and runs those.",
        parameters: &[
            text("ProcessIri", Preset::None, "The IRI of the process."),
            text(
                "ExecutionMode",
                Preset::Text("execute"),
                "What to do with the plan.",
            ),
        ],
        results: &[text(
            "Report",
            Preset::Text(""),
            "What was done, step by step.",
        )],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "MoveGripperSkillType",
        id: 2200,
        base: Some("GripperSkillType"),
        is_abstract: false,
        about: "Brings the fingers to a width, whether or not a thing is between them.",
        parameters: &[
            number(
                "Width",
                0.01,
                Some(&METRE),
                (0.0, 1.0),
                "How far the fingers are apart then.",
            ),
            number(
                "Force",
                10.0,
                Some(&NEWTON),
                (0.0, 10_000.0),
                "How hard they push on the way, at most.",
            ),
        ],
        results: &[
            measured("Width", Some(&METRE), "How far the fingers are apart."),
            flag("Gripped", "Whether a thing stopped them before."),
        ],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "ForceMoveSkillType",
        id: 2400,
        base: Some("LinearMoveSkillType"),
        is_abstract: false,
        about: "Moves along a straight line until it is there or something pushes back, either of which is success.",
        parameters: &[numbers(
            "MaxForce",
            Some(3),
            Some(&NEWTON),
            "At most so much along x, y, z of the tool; 0 for a direction that does not count.",
        )],
        results: &[
            flag("ForceExceeded", "Whether it stopped before the target."),
            numbers(
                "Force",
                Some(3),
                Some(&NEWTON),
                "The greatest force along x, y, z of the tool.",
            ),
        ],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "JointMoveSkillType",
        id: 2500,
        base: Some("MotionSkillType"),
        is_abstract: true,
        about: "Brings the joints of a robot to a position.",
        parameters: &[
            numbers(
                "TargetJointPosition",
                None,
                Some(&RADIAN),
                "Where each joint is to be, from the base on.",
            ),
            number(
                "MaxJointVelocity",
                1.0,
                Some(&TURNING),
                (0.001, 100.0),
                "No joint is faster.",
            ),
            number(
                "MaxJointAcceleration",
                2.0,
                Some(&TURNING_UP),
                (0.001, 1_000.0),
                "Nor does one gain or lose speed faster.",
            ),
        ],
        results: &[numbers(
            "JointPosition",
            None,
            Some(&RADIAN),
            "Where the joints are, as TargetJointPosition.",
        )],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "JointPtpMoveSkillType",
        id: 2600,
        base: Some("JointMoveSkillType"),
        is_abstract: false,
        about: "Moves from point to point, all joints beginning and ending together.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "JointLinearMoveSkillType",
        id: 2700,
        base: Some("JointMoveSkillType"),
        is_abstract: false,
        about: "Moves the tool along a straight line to where it is with the joints so.",
        parameters: &[],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "PositionStreamSkillType",
        id: 2800,
        base: Some("MotionSkillType"),
        is_abstract: true,
        about: "Follows positions that come while it runs, until it is halted. How they come is said by the subtype.",
        parameters: &[position(
            "TargetPosition",
            "The first of the positions, as that of a move.",
        )],
        results: &[position(
            "Position",
            "Where the tool is, as TargetPosition.",
        )],
        rests_in: Rest::Halted,
    },
    SkillType {
        name: "ToolSkillType",
        id: 2900,
        base: Some("SkillType"),
        is_abstract: true,
        about: "Changes what a robot has at its flange.",
        parameters: &[],
        results: &[text(
            "Tool",
            Preset::Text(""),
            "The ApplicationUri of the tool that is attached; nothing for none.",
        )],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "AttachToolSkillType",
        id: 3000,
        base: Some("ToolSkillType"),
        is_abstract: false,
        about: "Takes a tool from its place; fails where another one is attached.",
        parameters: &[TOOL_POSITION, TOOL_APP_URI],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "DetachToolSkillType",
        id: 3100,
        base: Some("ToolSkillType"),
        is_abstract: false,
        about: "Brings the tool that is attached to a dock, if one is.",
        parameters: &[TOOL_POSITION],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "ChangeToolSkillType",
        id: 3200,
        base: Some("ToolSkillType"),
        is_abstract: false,
        about: "Has that tool attached: detaches another one first, and does nothing where it is attached already.",
        parameters: &[TOOL_POSITION, TOOL_APP_URI],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "NavigateToSkillType",
        id: 3300,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Drives a mobile base to a place.",
        parameters: &[
            numbers(
                "Goal",
                Some(3),
                None,
                "x and y in m and the heading in rad, in the frame of Frame.",
            ),
            text("Frame", Preset::Text("map"), "In which frame Goal is said."),
        ],
        results: &[numbers(
            "Pose",
            Some(3),
            None,
            "Where the base is, as Goal.",
        )],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "RunConveyorSkillType",
        id: 3400,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Starts or stops a conveyor, which goes on as it is when the run has ended.",
        parameters: &[TableVariable {
            name: "On",
            shape: ValueShape::scalar(Builtin::Boolean),
            length: None,
            preset: Preset::Flag(true),
            unit: None,
            range: None,
            about: "Whether it is to run.",
        }],
        results: &[],
        rests_in: Rest::Ready,
    },
    SkillType {
        name: "LocateObjectSkillType",
        id: 3500,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Finds an object, and fails if it is not there.",
        parameters: &[text("ObjectId", Preset::None, "The object.")],
        results: &[
            position(
                "Pose",
                "The centre of the object with its z axis up, as TargetPosition of a move.",
            ),
            numbers(
                "Box",
                Some(3),
                Some(&METRE),
                "The lengths of a box along its x, y and z axes; zeros if it is not a box.",
            ),
            numbers(
                "Cylinder",
                Some(2),
                Some(&METRE),
                "The diameter and the height of an upright cylinder; zeros if it is not a cylinder.",
            ),
            measured("Mass", Some(&KILOGRAM), "Its mass; 0 if it is unknown."),
        ],
        rests_in: Rest::Ready,
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_consistent() {
        let mut ids = Vec::new();
        for (place, skill_type) in TYPES.iter().enumerate() {
            ids.push(skill_type.id);
            assert_eq!(
                skill_type.id % 100,
                0,
                "{} leaves room for its children",
                skill_type.name
            );
            let base = skill_type
                .base
                .map(|base| TYPES.iter().position(|of| of.name == base));
            assert!(
                base.is_none_or(|base| base < Some(place)),
                "{} comes after its supertype",
                skill_type.name
            );
            for variable in skill_type.parameters.iter().chain(skill_type.results) {
                let default = variable.default_value();
                assert_eq!(
                    default.is_some(),
                    variable.preset != Preset::None,
                    "{}",
                    variable.name
                );
                assert!(
                    default.is_none_or(|value| value.shape() == variable.shape),
                    "{}",
                    variable.name
                );
                assert!(
                    variable.length.is_none() || variable.shape.array,
                    "{}",
                    variable.name
                );
            }
        }
        let all = ids.len();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), all);
        assert_eq!(
            (METRE.id, NEWTON.id, TURNING.id),
            (5_067_858, 5_129_559, 12_865)
        );
    }
}
