//! The outputs of the state of a skill.

use std::fmt;
use std::sync::Arc;
use std::time::SystemTime;

use program::RunId;
use tokio::time::Instant;

use crate::driver::{Driver, Signal};
use crate::parameters::Parameters;
use crate::refusal::SkillRefusal;
use crate::shown::{RunOutcome, SkillEvent, SkillSnapshot, Transitioned};

/// The two clocks. The caller reads them once per input.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    /// The clock for time limits.
    pub(crate) monotonic: Instant,
    /// The clock for the times that clients read.
    pub(crate) wall: SystemTime,
}

/// An output, to be carried out in order.
pub(crate) enum SkillOutput<R> {
    /// An event for the observers, and the state of the skill after it.
    Event(SkillNotice, Arc<SkillSnapshot>),
    /// The work of a run starts.
    Run {
        run: RunId,
        driver: Arc<dyn Driver>,
        parameters: Parameters,
    },
    /// The work of the run in progress receives a signal.
    Signal(Signal),
    /// The work of the run in progress is aborted.
    Abort,
    /// The run has ended, and the component may run another skill. Clients have seen the outcome.
    Release {
        /// Time of the end.
        at: Instant,
    },
    /// The response to a caller.
    Reply(R, Result<u32, SkillRefusal>),
}

impl<R> fmt::Debug for SkillOutput<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Event(notice, _) => f.debug_tuple("Event").field(notice).finish(),
            Self::Run { run, .. } => f.debug_tuple("Run").field(&run.number()).finish(),
            Self::Signal(signal) => f.debug_tuple("Signal").field(signal).finish(),
            Self::Abort => f.write_str("Abort"),
            Self::Release { .. } => f.write_str("Release"),
            Self::Reply(_, answer) => f.debug_tuple("Reply").field(answer).finish(),
        }
    }
}

/// An event of a skill, with its content.
#[derive(Debug)]
pub(crate) enum SkillNotice {
    Parameters(Arc<Parameters>),
    Transition(Transitioned),
    Step,
    Pending(String),
    Progress,
    Outcome(Arc<RunOutcome>),
    Called,
}

impl SkillNotice {
    /// Returns the event for observers.
    pub(crate) fn event(&self) -> SkillEvent<'_> {
        match self {
            Self::Parameters(parameters) => SkillEvent::Parameters(parameters),
            Self::Transition(transitioned) => SkillEvent::Transition(transitioned),
            Self::Step => SkillEvent::Step,
            Self::Pending(why) => SkillEvent::Pending(why),
            Self::Progress => SkillEvent::Progress,
            Self::Outcome(outcome) => SkillEvent::Outcome(outcome),
            Self::Called => SkillEvent::Called,
        }
    }
}
