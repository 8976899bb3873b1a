//! The constant description of a skill.

use std::time::Duration;

use program::Rest;
use tracing::debug;

use crate::driver::RunResults;
use crate::parameters::{ParameterType, SkillParameter};

/// The constant description of a skill.
#[derive(Debug, Clone)]
pub struct SkillDescription {
    /// The name of the skill in its component.
    pub name: String,
    /// Its type and all supertypes, nearest first.
    pub types: Vec<ParameterType>,
    /// The parameters of a run.
    pub parameters: Vec<SkillParameter>,
    /// The results of a run.
    pub results: Vec<SkillParameter>,
    /// The IRIs of the capabilities that it provides.
    pub capabilities: Vec<String>,
    /// Time limit of a run; `None` for no limit.
    pub timeout: Option<Duration>,
    /// The state after a successful run, as its type defines it.
    pub rests_in: Rest,
}

impl SkillDescription {
    /// Returns the results that the type declares, in the order of the type.
    pub(crate) fn in_order(&self, results: RunResults) -> RunResults {
        let mut ordered = Vec::new();
        for declared in &self.results {
            let found = results.iter().find(|(name, _)| *name == declared.name);
            let fits = found.and_then(|(_, value)| declared.shape.take(value.clone()));
            match fits {
                Some(value) => ordered.push((declared.name.clone(), value)),
                None => debug!(skill = self.name, "the driver gave no {}", declared.name),
            }
        }
        ordered
    }
}
