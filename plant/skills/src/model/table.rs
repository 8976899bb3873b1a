//! The table.

use crate::value::{Builtin, Shape};

/// A skill type.
#[derive(Debug)]
pub struct SkillType {
    /// Its BrowseName.
    pub name: &'static str,
    /// The numeric identifier of its node; those of its children follow it, within a hundred.
    pub id: u32,
    /// The type of the table it is a subtype of.
    pub base: Option<&'static str>,
    /// Whether only subtypes have instances.
    pub is_abstract: bool,
    /// What its instances do, for people.
    pub about: &'static str,
    /// What a run is told, beside what the supertypes have. A parameter keeps its place: new ones come last.
    pub parameters: &'static [Variable],
    /// What a run says at its end, likewise.
    pub results: &'static [Variable],
}

/// A parameter or result in the table.
#[derive(Debug)]
pub struct Variable {
    /// Its BrowseName.
    pub name: &'static str,
    /// Type and rank.
    pub shape: Shape,
    /// How many elements an array has.
    pub length: Option<u32>,
    /// What counts where nothing is given.
    pub preset: Preset,
    /// The unit.
    pub unit: Option<&'static Unit>,
    /// The lowest and the highest of a number.
    pub range: Option<(f64, f64)>,
    /// What it means, for people.
    pub about: &'static str,
}

/// A default.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Preset {
    /// There is none: it must be given.
    None,
    /// A number.
    Number(f64),
    /// A text.
    Text(&'static str),
    /// A Boolean.
    Flag(bool),
}

/// A unit of UNECE Recommendation 20.
#[derive(Debug, PartialEq, Eq)]
pub struct Unit {
    /// As `m/s`.
    pub symbol: &'static str,
    /// As `metre per second`.
    pub name: &'static str,
    /// The code as a number: its characters, the first one highest (OPC 10000-8, 5.6.4.3).
    pub id: u32,
}

const NEWTON: Unit = Unit {
    symbol: "N",
    name: "newton",
    id: code(b"NEW"),
};
const METRE: Unit = Unit {
    symbol: "m",
    name: "metre",
    id: code(b"MTR"),
};
const SPEED: Unit = Unit {
    symbol: "m/s",
    name: "metre per second",
    id: code(b"MTS"),
};
const ACCELERATION: Unit = Unit {
    symbol: "m/s\u{b2}",
    name: "metre per second squared",
    id: code(b"MSK"),
};

const fn code(characters: &[u8; 3]) -> u32 {
    u32::from_be_bytes([0, characters[0], characters[1], characters[2]])
}

const fn number(
    name: &'static str,
    default: f64,
    unit: Option<&'static Unit>,
    range: (f64, f64),
    about: &'static str,
) -> Variable {
    Variable {
        name,
        shape: Shape::scalar(Builtin::Double),
        length: None,
        preset: Preset::Number(default),
        unit,
        range: Some(range),
        about,
    }
}

const fn text(name: &'static str, preset: Preset, about: &'static str) -> Variable {
    Variable {
        name,
        shape: Shape::scalar(Builtin::String),
        length: None,
        preset,
        unit: None,
        range: None,
        about,
    }
}

/// Position and orientation of a tool.
const fn position(name: &'static str, about: &'static str) -> Variable {
    Variable {
        name,
        shape: Shape::array(Builtin::Double),
        length: Some(6),
        preset: Preset::None,
        unit: None,
        range: None,
        about,
    }
}

/// All skill types, supertypes before their subtypes.
pub static TYPES: [SkillType; 9] = [
    SkillType {
        name: "SkillType",
        id: 1000,
        base: None,
        is_abstract: true,
        about: "What a component can do, as a Program of OPC 10000-10: made ready by Reset, begun by Start, ended by itself or by Halt.",
        parameters: &[],
        results: &[],
    },
    SkillType {
        name: "GripperSkillType",
        id: 1100,
        base: Some("SkillType"),
        is_abstract: true,
        about: "A skill of what holds things.",
        parameters: &[],
        results: &[],
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
        results: &[Variable {
            name: "Gripped",
            shape: Shape::scalar(Builtin::Boolean),
            length: None,
            preset: Preset::Flag(false),
            unit: None,
            range: None,
            about: "Whether a thing is held.",
        }],
    },
    SkillType {
        name: "ReleaseSkillType",
        id: 1300,
        base: Some("GripperSkillType"),
        is_abstract: false,
        about: "Lets go of what is held, if anything is.",
        parameters: &[],
        results: &[],
    },
    SkillType {
        name: "MoveSkillType",
        id: 1400,
        base: Some("SkillType"),
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
    },
    SkillType {
        name: "PtpMoveSkillType",
        id: 1500,
        base: Some("MoveSkillType"),
        is_abstract: false,
        about: "Moves from point to point, all axes beginning and ending together; the way between is free.",
        parameters: &[],
        results: &[],
    },
    SkillType {
        name: "LinearMoveSkillType",
        id: 1600,
        base: Some("MoveSkillType"),
        is_abstract: false,
        about: "Moves along a straight line.",
        parameters: &[],
        results: &[],
    },
    SkillType {
        name: "PickAndPlaceSkillType",
        id: 1700,
        base: Some("SkillType"),
        is_abstract: false,
        about: "Takes a thing from one place to another, by the skills of a robot and a gripper.",
        parameters: &[
            position(
                "PickPosition",
                "Where the thing is, as TargetPosition of a move.",
            ),
            position("PlacePosition", "Where it is to be, likewise."),
            number(
                "ApproachOffset",
                0.05,
                Some(&METRE),
                (0.0, 1.0),
                "How far above both positions moves begin and end.",
            ),
            text("ObjectId", Preset::Text(""), "Which thing, for the record."),
        ],
        results: &[],
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
        assert_eq!((METRE.id, NEWTON.id), (5_067_858, 5_129_559));
    }
}
