//! The visible state of a skill and its observers.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::SystemTime;

use program::{ProgramMachineState, ProgramMethod, Transition};

use crate::authority::SkillOwner;
use crate::parameters::Parameters;
use crate::refusal::SkillRefusal;
use crate::value::SkillValue;

/// A snapshot of a skill. It outlives the client that started the run.
#[derive(Debug, Clone)]
pub struct SkillSnapshot {
    /// The state of the state machine.
    pub state: ProgramMachineState,
    /// The last transition; `None` before the first transition.
    pub last: Option<&'static Transition>,
    /// Time of the last transition; before the first, the creation time of the skill.
    pub since: SystemTime,
    /// The number of the newest run; 0 before the first.
    pub run: u32,
    /// The progress of the newest run, 0 to 1.
    pub progress: f32,
    /// The current step of the newest run.
    pub step: String,
    /// The parameters of the newest run.
    pub parameters: Arc<Parameters>,
    /// The outcome of the newest run that has ended.
    pub outcome: Option<Arc<RunOutcome>>,
    /// The last call and its caller.
    pub diagnostic: ProgramDiagnostic,
    /// The reason why a run that is being cancelled has not ended.
    pub pending: Option<String>,
    /// Whether the outcome of the newest run is unknown: only a Reset makes the skill Ready.
    pub needs_reset: bool,
    /// For each of [`ProgramMethod::ALL`], whether a call is possible in this state.
    pub executable: [bool; 5],
}

impl SkillSnapshot {
    /// Returns the snapshot of a skill that was created at this time and has had no run.
    pub(crate) fn first(
        state: ProgramMachineState,
        executable: [bool; 5],
        created: SystemTime,
    ) -> Self {
        Self {
            state,
            last: None,
            since: created,
            run: 0,
            progress: 0.0,
            step: String::new(),
            parameters: Arc::default(),
            outcome: None,
            diagnostic: ProgramDiagnostic {
                created,
                last_call: None,
            },
            pending: None,
            needs_reset: false,
            executable,
        }
    }

    /// Records a transition at this time. A skill that is Ready needs no Reset.
    pub(crate) fn enter(&mut self, transition: &'static Transition, at: SystemTime) {
        self.state = transition.to;
        self.last = Some(transition);
        self.since = at;
        self.needs_reset &= transition.to != ProgramMachineState::Ready;
    }

    /// Records the outcome of the newest run. If it is unknown, the skill needs a Reset.
    pub(crate) fn end(&mut self, outcome: &Arc<RunOutcome>) {
        self.outcome = Some(Arc::clone(outcome));
        self.needs_reset |= outcome.unknown;
    }
}

/// Returns whether a run is in progress in a state.
pub(crate) fn is_work(state: ProgramMachineState) -> bool {
    matches!(
        state,
        ProgramMachineState::Running | ProgramMachineState::Suspended
    )
}

/// Returns the time of an event of a skill.
#[expect(
    clippy::disallowed_methods,
    reason = "when a machine did something is told by the clock of its host"
)]
pub(crate) fn clock() -> SystemTime {
    SystemTime::now()
}

/// The end of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOutcome {
    /// The number of the run.
    pub run: u32,
    /// Whether the work was done.
    pub succeeded: bool,
    /// Whether the end of the work is unknown: its machine may move, and the skill needs a Reset.
    pub unknown: bool,
    /// The reason of a failure, or a message.
    pub message: String,
    /// The results, in the order of the type; empty after a failure.
    pub results: Vec<(String, SkillValue)>,
    /// The steps and their parts in order, each with the seconds since the start of the run: `0.412
    /// MovePick`.
    pub trace: Vec<String>,
}

/// The words in the message of an outcome that is unknown, for observers that receive a message
/// only.
pub const UNKNOWN_OUTCOME: &str = "the outcome is unknown";

impl RunOutcome {
    /// Returns the message for observers that receive a message only: it says that the outcome is
    /// unknown, if it is.
    #[must_use]
    pub fn shown_message(&self) -> Cow<'_, str> {
        match (self.unknown, self.message.as_str()) {
            (true, "") => Cow::Borrowed(UNKNOWN_OUTCOME),
            (true, message) if !message.contains(UNKNOWN_OUTCOME) => {
                Cow::Owned(format!("{UNKNOWN_OUTCOME}: {message}"))
            }
            (_, message) => Cow::Borrowed(message),
        }
    }
}

/// The content of ProgramDiagnostic (OPC 10000-10, 5.2.9).
#[derive(Debug, Clone)]
pub struct ProgramDiagnostic {
    /// The creation time of the skill.
    pub created: SystemTime,
    /// The last call, accepted or refused.
    pub last_call: Option<LastCall>,
}

/// A call of a method.
#[derive(Debug, Clone)]
pub struct LastCall {
    /// The method.
    pub method: ProgramMethod,
    /// The caller.
    pub by: SkillOwner,
    /// The time of the call.
    pub at: SystemTime,
    /// The refusal, if the call was refused.
    pub refused: Option<SkillRefusal>,
}

/// A transition that has happened.
#[derive(Debug, Clone)]
pub struct Transitioned {
    /// The transition.
    pub transition: &'static Transition,
    /// The number of the newest run; 0 before the first.
    pub run: u32,
    /// A message for people.
    pub message: String,
    /// The time of the transition.
    pub at: SystemTime,
}

/// An event of a skill, in the order in which it happens.
#[derive(Debug, Clone, Copy)]
pub enum SkillEvent<'a> {
    /// A run is about to start with these parameters; its transition follows, and then the work.
    Parameters(&'a Parameters),
    /// A transition: before the work of a run starts, or after the outcome of a run.
    Transition(&'a Transitioned),
    /// The run has started another step.
    Step,
    /// The run is being cancelled and has not ended, or cannot be cancelled; with the reason for
    /// people.
    Pending(&'a str),
    /// The progress of the run has changed.
    Progress,
    /// The outcome of a run; its transition follows.
    Outcome(&'a RunOutcome),
    /// A call was accepted or refused.
    Called,
}

/// Receives all events of a skill in order, from the task that owns the skill. It must not block.
pub trait SkillObserver: Send + Sync + 'static {
    /// Receives an event, after which the skill has the state `shown`.
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot);

    /// Reports that the server of a mirrored skill is lost; no further events follow.
    fn lost(&self, why: &str) {
        let _is_told_otherwise = why;
    }
}

#[cfg(test)]
mod tests {
    use program::{Nature, ProgramInstance, Rest};

    use super::*;

    #[test]
    fn an_unknown_outcome_needs_a_reset_until_the_skill_is_ready() {
        let mut program = ProgramInstance::new(Nature {
            can_suspend: false,
            rests_in: Rest::Halted,
        });
        let at = SystemTime::UNIX_EPOCH;
        let mut shown = SkillSnapshot::first(program.state(), [false; 5], at);
        let mut call = |method| program.call(method).expect("it is possible");
        shown.enter(call(ProgramMethod::Reset), at);
        shown.enter(call(ProgramMethod::Start), at);
        let outcome = |unknown| {
            Arc::new(RunOutcome {
                run: 1,
                succeeded: false,
                unknown,
                message: String::new(),
                results: Vec::new(),
                trace: Vec::new(),
            })
        };
        shown.end(&outcome(false));
        assert!(!shown.needs_reset, "it failed");
        shown.end(&outcome(true));
        shown.enter(call(ProgramMethod::Halt), at);
        assert!(shown.needs_reset);
        shown.enter(call(ProgramMethod::Reset), at);
        assert!(!shown.needs_reset);
    }

    #[test]
    fn a_message_says_that_the_outcome_is_unknown() {
        let outcome = |unknown, message: &str| RunOutcome {
            run: 1,
            succeeded: false,
            unknown,
            message: message.to_owned(),
            results: Vec::new(),
            trace: Vec::new(),
        };
        for (unknown, message, shown) in [
            (true, "no response", "the outcome is unknown: no response"),
            (true, "", "the outcome is unknown"),
            (
                true,
                "halted; the outcome is unknown",
                "halted; the outcome is unknown",
            ),
            (false, "nothing was gripped", "nothing was gripped"),
        ] {
            assert_eq!(outcome(unknown, message).shown_message(), shown);
        }
    }
}
