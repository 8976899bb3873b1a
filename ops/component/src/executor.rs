//! The executor of a skill in the space: this program, or another server that it represents.

use std::sync::Arc;

use bridge_node::Executed;
use program::ProgramMethod;
use skills::{
    MirroredSkill, RunOutcome, Skill, SkillDescription, SkillFault, SkillOwner, SkillRefusal,
    SkillSnapshot, SkillValue, StartCondition,
};
use tracing::warn;

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
            Self::Theirs(mirror) => Ok(mirror.call(method, Vec::new()).await?),
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

    /// Starts a run with these parameters if the condition is true just before the start, and
    /// returns its number.
    ///
    /// # Errors
    /// Returns the errors of [`call`](Self::call). The run may have started if the error
    /// [`hides_start`](SkillRequestError::hides_start).
    pub(crate) async fn start_with(
        &self,
        by: SkillOwner,
        parameters: Vec<(String, SkillValue)>,
        condition: StartCondition,
    ) -> Result<u32, SkillRequestError> {
        if !condition() {
            return Err(SkillRequestError::NotStarted);
        }
        match self {
            Self::Own(skill) => Ok(skill.start_with(by, parameters).await?),
            Self::Theirs(mirror) => Ok(mirror.start_if(condition, parameters).await?),
        }
    }

    /// Executes a call of the space. The response has the fields success, message and run. Start is
    /// not executed if the condition is false.
    pub(crate) async fn execute(
        &self,
        (by, method): (SkillOwner, ProgramMethod),
        request: &[u8],
        condition: StartCondition,
    ) -> Executed {
        let answer = match method {
            ProgramMethod::Start => match self.parameters(request) {
                Ok(parameters) => self.start_with(by, parameters, condition).await,
                Err(error) => Err(error),
            },
            ProgramMethod::Suspend
            | ProgramMethod::Resume
            | ProgramMethod::Halt
            | ProgramMethod::Reset => self.call(by, method).await,
        };
        let answer = match answer {
            Ok(run) => [true.into(), "".into(), run.into()],
            Err(error) if error.is_unknown(method) => {
                let skill = &self.facts().name;
                warn!(skill, %method, "it is unknown whether the skill executed a call: {error}");
                return Executed::Lost;
            }
            Err(error) => [
                false.into(),
                error.to_string().into(),
                self.shown().run.into(),
            ],
        };
        Executed::Answered(fields::block(&answer))
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
    /// The request was cancelled, or its deadline passed before the run started.
    #[error("the request was cancelled or came too late, so no run was started")]
    NotStarted,
    /// The goal arrived after its deadline.
    #[error("the goal came too late, so no run was started")]
    Late,
}

impl SkillRequestError {
    /// Returns true if a run may have started although a start returned this error.
    pub(crate) fn hides_start(&self) -> bool {
        match self {
            Self::Theirs(fault) => match fault {
                SkillFault::Lost(_) | SkillFault::Unexpected(_) | SkillFault::NotHalted(_) => true,
                SkillFault::Refused { .. } | SkillFault::TimedOut(_) => false,
            },
            Self::Refused(_)
            | Self::Field(_)
            | Self::Count { .. }
            | Self::NeedsReset(_)
            | Self::NotStarted
            | Self::Late => false,
        }
    }

    /// Returns true if the skill may have executed a method that returned this error.
    pub(crate) fn is_unknown(&self, method: ProgramMethod) -> bool {
        let is_start = method == ProgramMethod::Start;
        // A skill that does not have a method is not lost.
        let has_no_method = matches!(self, Self::Theirs(SkillFault::Unexpected(_)));
        self.hides_start() && (is_start || !has_no_method)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_lost_start_may_have_started_a_run() {
        let text = || "no answer".to_owned();
        let lost = SkillRequestError::Theirs(SkillFault::Lost(text()));
        assert!(lost.hides_start() && lost.is_unknown(ProgramMethod::Halt));
        let missing = SkillRequestError::Theirs(SkillFault::Unexpected(text()));
        assert!(missing.hides_start() && missing.is_unknown(ProgramMethod::Start));
        assert!(!missing.is_unknown(ProgramMethod::Suspend));
        let moves = SkillRequestError::Theirs(SkillFault::NotHalted(text()));
        assert!(moves.hides_start());
        let refused = SkillRequestError::Theirs(SkillFault::Refused {
            status: "BadInvalidState".to_owned(),
            text: text(),
        });
        for error in [
            refused,
            SkillRequestError::NotStarted,
            SkillRequestError::Late,
        ] {
            assert!(!error.hides_start() && !error.is_unknown(ProgramMethod::Start));
        }
    }
}
