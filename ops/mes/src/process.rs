//! Processes: their steps and the needs of each step.

use std::time::Duration;

use knowledge::{is_iri, vocabulary as v};
use mtp::{Object, Triple, escaped};
use skills::TypeName;

/// A process that the MES can run, identified by its IRI.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Process {
    pub(crate) iri: String,
    pub(crate) name: String,
    pub(crate) work: Job,
    /// The steps in order.
    pub(crate) steps: Vec<Step>,
    /// Time limit of each run of a skill.
    pub(crate) within: Duration,
    /// Time to wait for a component that a plan needs.
    pub(crate) wait: Duration,
}

/// The way in which the steps are done.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Job {
    /// All steps together, by the composite that moves an object to another pose.
    PickAndPlace(skills::Job),
    /// A sequence of skills, with these parameters as JSON.
    Sequence(Vec<Vec<(String, serde_json::Value)>>),
}

/// A step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Step {
    pub(crate) name: String,
    pub(crate) needs: Vec<Need>,
}

/// A skill that a step needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Need {
    /// The role of the skill. In all steps of a composite, each role has the same skill.
    pub(crate) role: Role,
    /// The class of the capability that the skill has to realise.
    pub(crate) capability: Option<String>,
    /// The required type; subtypes match too.
    pub(crate) skill_type: Option<TypeName>,
}

/// The role of a skill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Role {
    /// Moves fast, along a path that the robot chooses.
    Ptp,
    /// Moves along a straight line.
    Linear,
    /// Grasps the object.
    Grasp,
    /// Releases the object.
    Release,
    /// Does the step with this number alone.
    Alone(usize),
}

impl Role {
    /// The roles of the composite.
    pub(crate) const OF_COMPOSITE: [Self; 4] =
        [Self::Ptp, Self::Linear, Self::Grasp, Self::Release];

    /// Returns the name in the YAML and in the graph.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Ptp => "ptp",
            Self::Linear => "linear",
            Self::Grasp => "grasp",
            Self::Release => "release",
            Self::Alone(_) => "skill",
        }
    }

    /// Returns the default skill type of the role.
    pub(crate) fn skill_type(self) -> Option<TypeName> {
        let name = match self {
            Self::Ptp => "PtpMoveSkillType",
            Self::Linear => "LinearMoveSkillType",
            Self::Grasp => "GraspSkillType",
            Self::Release => "ReleaseSkillType",
            Self::Alone(_) => return None,
        };
        Some(TypeName::own(name))
    }

    /// Returns the group. The same component fills all roles of a group: one robot moves, one tool
    /// grasps and releases.
    pub(crate) fn group(self) -> Group {
        match self {
            Self::Ptp | Self::Linear => Group::Robot,
            Self::Grasp | Self::Release => Group::Tool,
            Self::Alone(step) => Group::Alone(step),
        }
    }
}

/// Roles that the same component has to fill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Group {
    Robot,
    Tool,
    Alone(usize),
}

impl Process {
    /// Returns the triples of the process. `type_iri` returns the IRI of a type, if it is known.
    pub(crate) fn triples(&self, type_iri: &dyn Fn(&TypeName) -> Option<String>) -> Vec<Triple> {
        let mut all = Vec::new();
        let mut say = |subject: &str, predicate: &str, object: Object| {
            all.push(Triple {
                subject: subject.to_owned(),
                predicate: predicate.to_owned(),
                object,
            });
        };
        let iri = |iri: &str| Object::Iri(iri.to_owned());
        say(&self.iri, v::RDF_TYPE, iri(v::PROCESS));
        say(&self.iri, v::RDFS_LABEL, Object::Text(self.name.clone()));
        for (step, position) in self.steps.iter().zip(1_i64..) {
            let step_iri = step_iri(&self.iri, &step.name);
            say(&self.iri, v::HAS_STEP, iri(&step_iri));
            say(&step_iri, v::RDF_TYPE, iri(v::STEP));
            say(&step_iri, v::RDFS_LABEL, Object::Text(step.name.clone()));
            say(&step_iri, v::POSITION, Object::Integer(position));
            for need in &step.needs {
                let need_iri = format!("{step_iri}/{}", need.role.name());
                say(&step_iri, v::REQUIRES_CAPABILITY, iri(&need_iri));
                say(&need_iri, v::RDF_TYPE, iri(v::REQUIRED_CAPABILITY));
                say(
                    &need_iri,
                    v::ROLE,
                    Object::Text(need.role.name().to_owned()),
                );
                if let Some(class) = need.capability.as_ref().filter(|class| is_iri(class)) {
                    say(&need_iri, v::RDF_TYPE, iri(class));
                    say(class, v::RDFS_SUB_CLASS_OF, iri(v::CAPABILITY));
                }
                if let Some(type_iri) = need.skill_type.as_ref().and_then(type_iri) {
                    say(&need_iri, v::REQUIRES_TYPE, iri(&type_iri));
                }
            }
        }
        all
    }
}

/// Returns the IRI of a step of a process.
pub(crate) fn step_iri(process: &str, step: &str) -> String {
    format!("{process}/step/{}", escaped(step))
}
