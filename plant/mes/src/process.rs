//! A process: steps in their order, and what each of them needs.

use std::time::Duration;

use knowledge::{is_iri, vocabulary as v};
use mtp::{Object, Triple, escaped};
use skills::TypeName;

/// Something that the MES can be asked to do, by its IRI.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Process {
    pub(crate) iri: String,
    pub(crate) name: String,
    pub(crate) work: Job,
    /// In their order.
    pub(crate) steps: Vec<Step>,
    /// How long each run of a skill may take.
    pub(crate) within: Duration,
    /// How long to wait for a component that a plan lacks.
    pub(crate) wait: Duration,
}

/// How the steps are done.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Job {
    /// All together, by the composite that brings a thing from one place to another.
    PickAndPlace(skills::Job),
    /// One after the other, a skill each, with these parameters as JSON.
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
    /// What it is for. In all steps of a composite one skill has one role.
    pub(crate) role: Role,
    /// The class of capability it has to realise.
    pub(crate) capability: Option<String>,
    /// The type it has to have, or one below it.
    pub(crate) skill_type: Option<TypeName>,
}

/// What a skill is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Role {
    /// Moves fast, on a way of the robot's choice.
    Ptp,
    /// Moves straight.
    Linear,
    /// Takes hold of the thing.
    Grasp,
    /// Lets it go.
    Release,
    /// Does the step of this number, by itself.
    Alone(usize),
}

impl Role {
    /// Those of the composite.
    pub(crate) const OF_COMPOSITE: [Self; 4] =
        [Self::Ptp, Self::Linear, Self::Grasp, Self::Release];

    /// As the YAML and the graph have it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Ptp => "ptp",
            Self::Linear => "linear",
            Self::Grasp => "grasp",
            Self::Release => "release",
            Self::Alone(_) => "skill",
        }
    }

    /// The type of ours that it takes where the process does not say which.
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

    /// Skills of one group are all of one component: one robot moves, one tool holds and lets go.
    pub(crate) fn group(self) -> Group {
        match self {
            Self::Ptp | Self::Linear => Group::Robot,
            Self::Grasp | Self::Release => Group::Tool,
            Self::Alone(step) => Group::Alone(step),
        }
    }
}

/// Roles that one component has to fill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Group {
    Robot,
    Tool,
    Alone(usize),
}

impl Process {
    /// The process in the terms of the graph. `type_iri` finds the IRI of a type, where it is known.
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

/// The IRI of a step of a process.
pub(crate) fn step_iri(process: &str, step: &str) -> String {
    format!("{process}/step/{}", escaped(step))
}
