//! The executor of a skill in the space: this program, or another server that it represents.

use std::sync::Arc;

use program::ProgramMethod;
use skills::{
    MirroredSkill, RunOutcome, Skill, SkillDescription, SkillFault, SkillOwner, SkillRefusal,
    SkillSnapshot, SkillValue,
};

use crate::fields::{self, FieldValueError};

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
    /// The skill refuses the method, or its component is lost.
    pub(crate) async fn call(
        &self,
        by: SkillOwner,
        method: ProgramMethod,
    ) -> Result<u32, SkillRequestError> {
        match self {
            Self::Own(skill) => Ok(skill.call(by, method).await?),
            Self::Theirs(mirror) => theirs(mirror, method, Vec::new()).await,
        }
    }

    /// Resets a skill that is Halted, unless the outcome of its last run is unknown.
    ///
    /// # Errors
    /// As [`call`](Self::call); the outcome of the last run is unknown.
    pub(crate) async fn make_ready(&self, by: SkillOwner) -> Result<u32, SkillRequestError> {
        match self {
            Self::Own(skill) => {
                let shown = skill.shown();
                if shown.needs_reset {
                    return Err(SkillRequestError::NeedsReset(shown.run));
                }
                Ok(skill.call(by, ProgramMethod::Reset).await?)
            }
            Self::Theirs(mirror) => Ok(mirror.make_ready().await?),
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
    ) -> Result<u32, SkillRequestError> {
        match self {
            Self::Own(skill) => Ok(skill.start_with(by, parameters).await?),
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
                Err(error) => Err(error),
            },
            ProgramMethod::Suspend
            | ProgramMethod::Resume
            | ProgramMethod::Halt
            | ProgramMethod::Reset => self.call(by, method).await,
        };
        match answer {
            Ok(run) => [true.into(), "".into(), run.into()],
            Err(error) => [
                false.into(),
                error.to_string().into(),
                self.shown().run.into(),
            ],
        }
    }

    /// Decodes the parameters of a request: a field for each parameter of the type, in its order,
    /// or no field at all. Null fields are not set.
    fn parameters(&self, request: &[u8]) -> Result<Vec<(String, SkillValue)>, SkillRequestError> {
        let values = fields::values(request)?;
        let declared = &self.facts().parameters;
        if values.is_empty() {
            return Ok(Vec::new());
        }
        if values.len() != declared.len() {
            return Err(SkillRequestError::Count {
                of: "request",
                given: values.len(),
                declared: declared.len(),
            });
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
) -> Result<u32, SkillRequestError> {
    Ok(mirror.call(method, parameters).await?)
}

/// The reason why a request to a skill is not executed. Its text starts with the name of a
/// StatusCode if the skill refuses the request.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SkillRequestError {
    /// A skill of this component refuses the method.
    #[error(transparent)]
    Refused(#[from] SkillRefusal),
    /// A skill of another component does not execute the method.
    #[error(transparent)]
    Theirs(#[from] SkillFault),
    /// A field is no parameter of a skill.
    #[error("BadInvalidArgument: {0}")]
    Field(#[from] FieldValueError),
    /// The request or goal has another number of fields than the skill has parameters.
    #[error("BadInvalidArgument: the {of} has {given} fields, and the skill {declared} parameters")]
    Count {
        /// The kind of request, as `goal`.
        of: &'static str,
        /// The number of fields.
        given: usize,
        /// The number of parameters.
        declared: usize,
    },
    /// The outcome of this run is unknown.
    #[error("BadInvalidState: the outcome of run {0} is unknown; Reset makes the skill ready")]
    NeedsReset(u32),
    /// The goal was cancelled.
    #[error("the goal was cancelled before its run began")]
    Cancelled,
    /// The goal arrived after its deadline.
    #[error("the goal came too late, so no run was started")]
    Late,
    /// The program stops.
    #[error("the component ends")]
    Ends,
}
