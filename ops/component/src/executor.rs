//! Who executes a skill that is in the space: this program, or a server that it speaks for.

use std::sync::Arc;

use program::Method;
use skills::{Facts, Mirror, Outcome, Owner, Shown, Skill, Value};

use crate::fields;

/// A skill to be run. Clones are of the same one.
#[derive(Debug, Clone)]
pub(crate) enum Executor {
    /// Executed here.
    Own(Skill),
    /// Executed by a server that knows nothing of the space.
    Theirs(Mirror),
}

impl Executor {
    pub(crate) fn facts(&self) -> &Arc<Facts> {
        match self {
            Self::Own(skill) => skill.facts(),
            Self::Theirs(mirror) => mirror.facts(),
        }
    }

    pub(crate) fn shown(&self) -> Arc<Shown> {
        match self {
            Self::Own(skill) => skill.shown(),
            Self::Theirs(mirror) => mirror.shown(),
        }
    }

    /// How a run ended, of the newest ones.
    pub(crate) fn outcome(&self, run: u32) -> Option<Arc<Outcome>> {
        match self {
            Self::Own(skill) => skill.outcome(run),
            Self::Theirs(mirror) => mirror.outcome(run),
        }
    }

    /// Calls a method: gives the number of the newest run.
    ///
    /// # Errors
    /// The name of a StatusCode and why, for people.
    pub(crate) async fn call(&self, by: Owner, method: Method) -> Result<u32, String> {
        match self {
            Self::Own(skill) => skill.call(by, method).await.map_err(|why| why.to_string()),
            Self::Theirs(mirror) => theirs(mirror, method, Vec::new()).await,
        }
    }

    /// Begins a run with these parameters: gives its number.
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub(crate) async fn start_with(
        &self,
        by: Owner,
        parameters: Vec<(String, Value)>,
    ) -> Result<u32, String> {
        match self {
            Self::Own(skill) => {
                let started = skill.start_with(by, parameters).await;
                started.map_err(|why| why.to_string())
            }
            Self::Theirs(mirror) => theirs(mirror, Method::Start, parameters).await,
        }
    }

    /// What a call of the space answers: success, message and run.
    pub(crate) async fn answer(&self, by: Owner, method: Method, request: &[u8]) -> [Value; 3] {
        let answer = match method {
            Method::Start => match self.parameters(request) {
                Ok(parameters) => self.start_with(by, parameters).await,
                Err(why) => Err(format!("BadInvalidArgument: {why}")),
            },
            Method::Suspend | Method::Resume | Method::Halt | Method::Reset => {
                self.call(by, method).await
            }
        };
        match answer {
            Ok(run) => [true.into(), "".into(), run.into()],
            Err(message) => [false.into(), message.into(), self.shown().run.into()],
        }
    }

    /// The parameters of a request: a field for each of the type's, in its order, or none at all. What is null is not given.
    fn parameters(&self, request: &[u8]) -> Result<Vec<(String, Value)>, String> {
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
    mirror: &Mirror,
    method: Method,
    parameters: Vec<(String, Value)>,
) -> Result<u32, String> {
    let called = mirror.call(method, parameters).await;
    called.map_err(|fault| fault.to_string())
}
