//! The messages to the task of a skill.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use program::ProgramMethod;
use tokio::sync::oneshot;

use crate::authority::SkillOwner;
use crate::driver::Driver;
use crate::refusal::SkillRefusal;
use crate::value::SkillValue;

/// A message to the task.
#[derive(Debug)]
pub(crate) enum Order {
    Call(SkillCallRequest),
    /// Closes the component: a run in progress is halted, regardless of the holder of the lease.
    Close(oneshot::Sender<()>),
}

/// A call of a method, waiting for the task.
#[derive(Debug)]
pub(crate) struct SkillCallRequest {
    pub(crate) by: SkillOwner,
    pub(crate) method: ProgramMethod,
    pub(crate) given: Given,
    pub(crate) reply: oneshot::Sender<Result<u32, SkillRefusal>>,
}

/// The arguments of a Start call.
#[derive(Debug, Default)]
pub(crate) struct Given {
    /// The parameters; `None` uses the parameters that the caller wrote before.
    pub(crate) parameters: Option<Vec<(String, SkillValue)>>,
    /// Time limit of the run. It applies if it is shorter than the limit of the skill.
    pub(crate) within: Option<Duration>,
    /// Whether a Halted skill is reset first.
    pub(crate) readies: bool,
}

/// The driver and the time limit of the next runs.
pub(crate) struct Successor {
    pub(crate) driver: Arc<dyn Driver>,
    pub(crate) timeout: Option<Duration>,
}

impl fmt::Debug for Successor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_struct("Successor");
        shown
            .field("timeout", &self.timeout)
            .finish_non_exhaustive()
    }
}
