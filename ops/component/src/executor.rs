//! The executor of a skill in the space: this program, or another server that it represents.

use std::sync::Arc;

use program::ProgramMethod;
use skills::{
    MirroredSkill, RunOutcome, Skill, SkillDescription, SkillOwner, SkillSnapshot, SkillValue,
};

use crate::fields;

/// An executable skill. Clones refer to the same skill.
#[derive(Debug, Clone)]
pub(crate) enum SkillExecutor {
    /// Executed by this program.
    Own(Skill),
    /// Executed by a server that is not a participant of the space.
    Theirs(MirroredSkill),
}

impl SkillExecutor {
    pub(crate) fn facts(&self) -> &Arc<SkillDescription> {
        match self {
            Self::Own(skill) => skill.facts(),
            Self::Theirs(mirror) => mirror.facts(),
        }
    }

    pub(crate) fn shown(&self) -> Arc<SkillSnapshot> {
        match self {
            Self::Own(skill) => skill.shown(),
            Self::Theirs(mirror) => mirror.shown(),
        }
    }

    /// Returns the outcome of a run, if it is one of the latest.
    pub(crate) fn outcome(&self, run: u32) -> Option<Arc<RunOutcome>> {
        match self {
            Self::Own(skill) => skill.outcome(run),
            Self::Theirs(mirror) => mirror.outcome(run),
        }
    }

    /// Calls a method and returns the number of the latest run.
    ///
    /// # Errors
    /// Returns the name of a StatusCode and the reason as text for the operator.
    pub(crate) async fn call(&self, by: SkillOwner, method: ProgramMethod) -> Result<u32, String> {
        match self {
            Self::Own(skill) => skill.call(by, method).await.map_err(|why| why.to_string()),
            Self::Theirs(mirror) => theirs(mirror, method, Vec::new()).await,
        }
    }

    /// Starts a run with these parameters and returns its number.
    ///
    /// # Errors
    /// Returns the errors of [`call`](Self::call).
    pub(crate) async fn start_with(
        &self,
        by: SkillOwner,
        parameters: Vec<(String, SkillValue)>,
    ) -> Result<u32, String> {
        match self {
            Self::Own(skill) => {
                let started = skill.start_with(by, parameters).await;
                started.map_err(|why| why.to_string())
            }
            Self::Theirs(mirror) => theirs(mirror, ProgramMethod::Start, parameters).await,
        }
    }

    /// Executes a call of the space and returns its response: success, message and run.
    pub(crate) async fn answer(
        &self,
        by: SkillOwner,
        method: ProgramMethod,
        request: &[u8],
    ) -> [SkillValue; 3] {
        let answer = match method {
            ProgramMethod::Start => match self.parameters(request) {
                Ok(parameters) => self.start_with(by, parameters).await,
                Err(why) => Err(format!("BadInvalidArgument: {why}")),
            },
            ProgramMethod::Suspend
            | ProgramMethod::Resume
            | ProgramMethod::Halt
            | ProgramMethod::Reset => self.call(by, method).await,
        };
        match answer {
            Ok(run) => [true.into(), "".into(), run.into()],
            Err(message) => [false.into(), message.into(), self.shown().run.into()],
        }
    }

    /// Decodes the parameters of a request: a field for each parameter of the type, in its order,
    /// or no field at all. Null fields are not set.
    fn parameters(&self, request: &[u8]) -> Result<Vec<(String, SkillValue)>, String> {
        let values = fields::values(request)?;
        let declared = &self.facts().parameters;
        if values.is_empty() {
            return Ok(Vec::new());
        }
        if values.len() != declared.len() {
            return Err(format!(
                "the request has {} fields, and the skill {} parameters",
                values.len(),
                declared.len()
            ));
        }
        let given = declared.iter().zip(values);
        Ok(given
            .filter_map(|(parameter, value)| Some((parameter.name.clone(), value?)))
            .collect())
    }
}

async fn theirs(
    mirror: &MirroredSkill,
    method: ProgramMethod,
    parameters: Vec<(String, SkillValue)>,
) -> Result<u32, String> {
    let called = mirror.call(method, parameters).await;
    called.map_err(|fault| fault.to_string())
}
