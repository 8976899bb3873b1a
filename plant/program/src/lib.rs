//! The state machine of an OPC UA Program (OPC 10000-10, 4.2) as a table.
//!
//! A [`ProgramInstance`] is an instance of ProgramStateMachineType. It processes [`ProgramMethod`]s
//! and the [`Ending`] of a run, and returns the resulting [`Transition`], or the reason why there
//! is no transition. It runs nothing, stores no parameters and does not depend on a server. Its
//! owner stores the parameters, publishes the transition and then starts the work. The [`Lease`]
//! controls which client may call.
//!
//! | state | Start | Suspend | Resume | Halt | Reset |
//! |---|---|---|---|---|---|
//! | Halted | | | | | Ready |
//! | Ready | Running | | | Halted | |
//! | Running | | Suspended | | Halted | |
//! | Suspended | | | Running | Halted | Ready |
//!
//! Part 10 lists Reset as a cause of two transitions from Suspended, to Ready and to Halted. In
//! this crate it leads to Ready.

mod lease;
mod table;

pub use lease::{Lease, LeaseHeld};
pub use table::{
    Ending, ProgramMachineState, ProgramMethod, TRANSITIONS, Transition, TransitionCause,
};

use thiserror::Error;

/// The number of a run of a program. Numbers are incremented with each Start and wrap around after
/// 2^32 runs; 0 is not a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct RunId(u32);

impl RunId {
    /// Returns the number, by which clients read the outcome of the run.
    #[must_use]
    pub fn number(self) -> u32 {
        self.0
    }

    fn next(self) -> Self {
        Self(self.0.wrapping_add(1).max(1))
    }
}

/// The properties of a program that its type defines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nature {
    /// Whether the work can be suspended and resumed. Otherwise Suspend is never executable.
    pub can_suspend: bool,
    /// The state after a successful run: Ready if it can be started again, Halted if it requires a
    /// Reset.
    pub rests_in: Rest,
}

/// The state after a successful run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rest {
    /// By RunningToReady, as skills of the Plug and Produce line do.
    Ready,
    /// By RunningToHalted, as programs that run once do.
    Halted,
}

/// A refused method call; nothing has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum RefusedMethod {
    /// The table has no such transition. BadInvalidState (OPC 10000-10, 5.2.3.2).
    #[error("{method} is not possible in the state {state}")]
    State {
        /// The called method.
        method: ProgramMethod,
        /// The current state, which does not change.
        state: ProgramMachineState,
    },
    /// The work of this type cannot be suspended. BadNotSupported.
    #[error("this program cannot be suspended")]
    CannotSuspend,
}

/// The end of a run that is not the current run, for example of a worker that was halted and ends
/// later.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("run {run:?} is not the current run")]
pub struct NotRunning {
    /// The run that ended.
    pub run: RunId,
}

/// An instance of a program. Its initial state is Halted (OPC 10000-10).
#[derive(Debug, Clone)]
pub struct ProgramInstance {
    nature: Nature,
    state: ProgramMachineState,
    last: Option<&'static Transition>,
    run: Option<RunId>,
    /// The number of the first run.
    first: u32,
}

impl ProgramInstance {
    /// Creates a program. Its first run has the number 1.
    #[must_use]
    pub fn new(nature: Nature) -> Self {
        Self::counting_from(nature, 1)
    }

    /// Creates a program with this number for its first run; 0 counts as 1. A restarted program
    /// counts from an unused number, so that its runs are not confused with earlier runs.
    #[must_use]
    pub fn counting_from(nature: Nature, first: u32) -> Self {
        Self {
            nature,
            state: ProgramMachineState::Halted,
            last: None,
            run: None,
            first: first.max(1),
        }
    }

    /// Sets whether the work can be suspended, for work that is done in another way from the next
    /// run on.
    pub fn set_can_suspend(&mut self, can_suspend: bool) {
        self.nature.can_suspend = can_suspend;
    }

    /// Calls a method and returns the resulting transition.
    ///
    /// # Errors
    /// [`RefusedMethod`]; nothing has changed.
    pub fn call(&mut self, method: ProgramMethod) -> Result<&'static Transition, RefusedMethod> {
        if method == ProgramMethod::Suspend && !self.nature.can_suspend {
            return Err(RefusedMethod::CannotSuspend);
        }
        let transition = Transition::by_method(self.state, method).ok_or(RefusedMethod::State {
            method,
            state: self.state,
        })?;
        if method == ProgramMethod::Start {
            self.run = Some(match self.run {
                None => RunId(self.first),
                Some(last) => last.next(),
            });
        }
        Ok(self.take(transition))
    }

    /// Reports the end of the work of a run and returns the resulting transition.
    ///
    /// # Errors
    /// [`NotRunning`] for any run except the current run, and for the success of a suspended run,
    /// because suspended work cannot finish.
    pub fn ended(&mut self, run: RunId, ending: Ending) -> Result<&'static Transition, NotRunning> {
        let transition = if self.run == Some(run) {
            Transition::by_ending(self.state, ending, self.nature.rests_in)
        } else {
            None
        };
        let transition = transition.ok_or(NotRunning { run })?;
        Ok(self.take(transition))
    }

    /// Returns the current state.
    #[must_use]
    pub fn state(&self) -> ProgramMachineState {
        self.state
    }

    /// Returns the last transition; `None` before the first transition.
    #[must_use]
    pub fn last_transition(&self) -> Option<&'static Transition> {
        self.last
    }

    /// Returns the newest run, in progress or ended; `None` before the first Start.
    #[must_use]
    pub fn run(&self) -> Option<RunId> {
        self.run
    }

    /// Returns whether a call is possible in the current state: the attribute Executable of the
    /// method's node.
    #[must_use]
    pub fn is_executable(&self, method: ProgramMethod) -> bool {
        (method != ProgramMethod::Suspend || self.nature.can_suspend)
            && Transition::by_method(self.state, method).is_some()
    }

    fn take(&mut self, transition: &'static Transition) -> &'static Transition {
        self.state = transition.to;
        self.last = Some(transition);
        transition
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SKILL: Nature = Nature {
        can_suspend: true,
        rests_in: Rest::Ready,
    };

    fn program(state: ProgramMachineState) -> (ProgramInstance, Option<RunId>) {
        let mut program = ProgramInstance::new(SKILL);
        let way: &[ProgramMethod] = match state {
            ProgramMachineState::Halted => &[],
            ProgramMachineState::Ready => &[ProgramMethod::Reset],
            ProgramMachineState::Running => &[ProgramMethod::Reset, ProgramMethod::Start],
            ProgramMachineState::Suspended => &[
                ProgramMethod::Reset,
                ProgramMethod::Start,
                ProgramMethod::Suspend,
            ],
        };
        for method in way {
            program.call(*method).unwrap();
        }
        assert_eq!(program.state(), state);
        let run = program.run();
        (program, run)
    }

    #[test]
    fn of_twenty_calls_eight_are_legal_and_the_others_change_nothing() {
        let mut legal = Vec::new();
        for state in ProgramMachineState::ALL {
            for method in ProgramMethod::ALL {
                let (mut program, _) = program(state);
                let before = (program.state(), program.last_transition(), program.run());
                assert_eq!(
                    program.is_executable(method),
                    program.clone().call(method).is_ok()
                );
                match program.call(method) {
                    Ok(transition) => {
                        assert_eq!((transition.from, transition.to), (state, program.state()));
                        legal.push((state, method, transition.to));
                    }
                    Err(refused) => {
                        assert_eq!(refused, RefusedMethod::State { method, state });
                        let after = (program.state(), program.last_transition(), program.run());
                        assert_eq!(after, before, "{method} in {state}");
                    }
                }
            }
        }
        legal.sort();
        let mut expected = [
            (
                ProgramMachineState::Halted,
                ProgramMethod::Reset,
                ProgramMachineState::Ready,
            ),
            (
                ProgramMachineState::Ready,
                ProgramMethod::Start,
                ProgramMachineState::Running,
            ),
            (
                ProgramMachineState::Ready,
                ProgramMethod::Halt,
                ProgramMachineState::Halted,
            ),
            (
                ProgramMachineState::Running,
                ProgramMethod::Suspend,
                ProgramMachineState::Suspended,
            ),
            (
                ProgramMachineState::Running,
                ProgramMethod::Halt,
                ProgramMachineState::Halted,
            ),
            (
                ProgramMachineState::Suspended,
                ProgramMethod::Resume,
                ProgramMachineState::Running,
            ),
            (
                ProgramMachineState::Suspended,
                ProgramMethod::Halt,
                ProgramMachineState::Halted,
            ),
            (
                ProgramMachineState::Suspended,
                ProgramMethod::Reset,
                ProgramMachineState::Ready,
            ),
        ];
        expected.sort();
        assert_eq!(legal, expected);
    }

    #[test]
    fn a_run_ends_where_its_type_says_and_fails_into_halted() {
        for (rests_in, rest, number) in [
            (Rest::Ready, ProgramMachineState::Ready, 4),
            (Rest::Halted, ProgramMachineState::Halted, 3),
        ] {
            let mut program = ProgramInstance::new(Nature { rests_in, ..SKILL });
            program.call(ProgramMethod::Reset).unwrap();
            program.call(ProgramMethod::Start).unwrap();
            let run = program.run().unwrap();
            let end = program.ended(run, Ending::Success).unwrap();
            assert_eq!((end.number, program.state()), (number, rest));
        }
        let (mut program, run) = program(ProgramMachineState::Running);
        let end = program.ended(run.unwrap(), Ending::Failure).unwrap();
        assert_eq!(
            (end.number, program.state()),
            (3, ProgramMachineState::Halted)
        );
    }

    #[test]
    fn a_worker_that_ends_after_it_was_halted_does_not_end_the_next_run() {
        let (mut program, first) = program(ProgramMachineState::Running);
        let first = first.unwrap();
        for method in [
            ProgramMethod::Halt,
            ProgramMethod::Reset,
            ProgramMethod::Start,
        ] {
            program.call(method).unwrap();
        }
        assert_eq!(
            program.ended(first, Ending::Success),
            Err(NotRunning { run: first })
        );
        assert_eq!(program.state(), ProgramMachineState::Running);
        let second = program.run().unwrap();
        assert_ne!(second, first);
        assert!(program.ended(second, Ending::Success).is_ok());
        assert_eq!(
            program.ended(second, Ending::Success),
            Err(NotRunning { run: second })
        );
    }

    #[test]
    fn runs_are_counted_from_where_it_is_told_and_never_are_0() {
        for (first, numbers) in [(0, [1, 2]), (7, [7, 8]), (u32::MAX, [u32::MAX, 1])] {
            let mut program = ProgramInstance::counting_from(SKILL, first);
            program.call(ProgramMethod::Reset).unwrap();
            for number in numbers {
                program.call(ProgramMethod::Start).unwrap();
                let run = program.run().unwrap();
                assert_eq!(run.number(), number);
                program.ended(run, Ending::Success).unwrap();
            }
        }
    }

    #[test]
    fn a_suspended_run_can_fail_but_does_no_work() {
        let (mut program, run) = program(ProgramMachineState::Suspended);
        let run = run.unwrap();
        assert!(program.ended(run, Ending::Success).is_err());
        let end = program.ended(run, Ending::Failure).unwrap();
        assert_eq!(
            (end.number, program.state()),
            (7, ProgramMachineState::Halted)
        );
    }

    #[test]
    fn what_cannot_stand_still_is_never_suspended() {
        let mut program = ProgramInstance::new(Nature {
            can_suspend: false,
            ..SKILL
        });
        program.call(ProgramMethod::Reset).unwrap();
        program.call(ProgramMethod::Start).unwrap();
        assert!(!program.is_executable(ProgramMethod::Suspend));
        assert_eq!(
            program.call(ProgramMethod::Suspend),
            Err(RefusedMethod::CannotSuspend)
        );
        assert!(program.is_executable(ProgramMethod::Halt));
    }
}
