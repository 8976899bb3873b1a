//! The state machine of an OPC UA Program (OPC 10000-10, 4.2) as a table.
//!
//! A [`Program`] is one instance of ProgramStateMachineType: it takes [`Method`]s and the [`Ending`] of a run, and gives
//! the [`Transition`] that follows, or why there is none. It runs nothing, stores no parameters and knows no server: whoever
//! owns it keeps the parameters, shows the transition and only then lets the work begin. Who may call is the [`Lease`]'s.
//!
//! | state | Start | Suspend | Resume | Halt | Reset |
//! |---|---|---|---|---|---|
//! | Halted | | | | | Ready |
//! | Ready | Running | | | Halted | |
//! | Running | | Suspended | | Halted | |
//! | Suspended | | | Running | Halted | Ready |
//!
//! Part 10 lists Reset twice as a cause that leads out of Suspended, to Ready and to Halted; here it leads to Ready.

mod lease;
mod table;

pub use lease::{Held, Lease};
pub use table::{Cause, Ending, Method, State, TRANSITIONS, Transition};

use thiserror::Error;

/// One run of a program, from its Start to its end. Numbers rise by one and start over after 2^32 runs; 0 is no run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct RunId(u32);

impl RunId {
    /// The number by which the run's outcome is asked for later.
    #[must_use]
    pub fn number(self) -> u32 {
        self.0
    }

    fn next(self) -> Self {
        Self(self.0.wrapping_add(1).max(1))
    }
}

/// What the type of a program says of all its instances.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nature {
    /// Whether its work can stand still and go on. Without it Suspend is never executable.
    pub can_suspend: bool,
    /// Where a run ends that did its work: Ready where it may be started again, Halted where a Reset comes first.
    pub rests_in: Rest,
}

/// The state after success.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rest {
    /// By RunningToReady, as skills of the Plug and Produce line do.
    Ready,
    /// By RunningToHalted, as programs that run once do.
    Halted,
}

/// A method that is not legal now; nothing has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Refused {
    /// The table has no transition. BadInvalidState (OPC 10000-10, 5.2.3.2).
    #[error("{method} is not possible in the state {state}")]
    State {
        /// What was called.
        method: Method,
        /// Where the program is and stays.
        state: State,
    },
    /// The work of this type cannot stand still. BadNotSupported.
    #[error("this program cannot be suspended")]
    CannotSuspend,
}

/// The end of a run that is not the one that goes on, as that of a worker which was halted and ends only now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("run {run:?} is not the one that runs")]
pub struct NotRunning {
    /// The run that ended.
    pub run: RunId,
}

/// One instance. It begins in Halted, as Part 10 has it.
#[derive(Debug, Clone)]
pub struct Program {
    nature: Nature,
    state: State,
    last: Option<&'static Transition>,
    run: Option<RunId>,
    /// The number of the first run.
    first: u32,
}

impl Program {
    /// A program that was never started, whose first run is 1.
    #[must_use]
    pub fn new(nature: Nature) -> Self {
        Self::counting_from(nature, 1)
    }

    /// A program that was never started, whose first run has this number; 0 counts as 1. One that is loaded anew counts from
    /// where it has not been, so that nobody takes one of its runs for an earlier one.
    #[must_use]
    pub fn counting_from(nature: Nature, first: u32) -> Self {
        Self {
            nature,
            state: State::Halted,
            last: None,
            run: None,
            first: first.max(1),
        }
    }

    /// Calls a method: gives the transition that has happened.
    ///
    /// # Errors
    /// [`Refused`], and nothing has changed.
    pub fn call(&mut self, method: Method) -> Result<&'static Transition, Refused> {
        if method == Method::Suspend && !self.nature.can_suspend {
            return Err(Refused::CannotSuspend);
        }
        let transition = Transition::by_method(self.state, method).ok_or(Refused::State {
            method,
            state: self.state,
        })?;
        if method == Method::Start {
            self.run = Some(match self.run {
                None => RunId(self.first),
                Some(last) => last.next(),
            });
        }
        Ok(self.take(transition))
    }

    /// The work of a run has ended: gives the transition that has happened.
    ///
    /// # Errors
    /// [`NotRunning`] for any run but the one that goes on; a success of one that is suspended is none either, since its
    /// work stands still.
    pub fn ended(&mut self, run: RunId, ending: Ending) -> Result<&'static Transition, NotRunning> {
        let transition = match self.run == Some(run) {
            true => Transition::by_ending(self.state, ending, self.nature.rests_in),
            false => None,
        };
        let transition = transition.ok_or(NotRunning { run })?;
        Ok(self.take(transition))
    }

    /// The state now.
    #[must_use]
    pub fn state(&self) -> State {
        self.state
    }

    /// What led to the state; `None` before the first transition.
    #[must_use]
    pub fn last_transition(&self) -> Option<&'static Transition> {
        self.last
    }

    /// The newest run, whether it goes on or has ended; `None` before the first Start.
    #[must_use]
    pub fn run(&self) -> Option<RunId> {
        self.run
    }

    /// Whether a call would be taken now: the attribute Executable of the method's node.
    #[must_use]
    pub fn is_executable(&self, method: Method) -> bool {
        (method != Method::Suspend || self.nature.can_suspend)
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

    fn program(state: State) -> (Program, Option<RunId>) {
        let mut program = Program::new(SKILL);
        let way: &[Method] = match state {
            State::Halted => &[],
            State::Ready => &[Method::Reset],
            State::Running => &[Method::Reset, Method::Start],
            State::Suspended => &[Method::Reset, Method::Start, Method::Suspend],
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
        for state in State::ALL {
            for method in Method::ALL {
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
                        assert_eq!(refused, Refused::State { method, state });
                        let after = (program.state(), program.last_transition(), program.run());
                        assert_eq!(after, before, "{method} in {state}");
                    }
                }
            }
        }
        legal.sort();
        let mut expected = [
            (State::Halted, Method::Reset, State::Ready),
            (State::Ready, Method::Start, State::Running),
            (State::Ready, Method::Halt, State::Halted),
            (State::Running, Method::Suspend, State::Suspended),
            (State::Running, Method::Halt, State::Halted),
            (State::Suspended, Method::Resume, State::Running),
            (State::Suspended, Method::Halt, State::Halted),
            (State::Suspended, Method::Reset, State::Ready),
        ];
        expected.sort();
        assert_eq!(legal, expected);
    }

    #[test]
    fn a_run_ends_where_its_type_says_and_fails_into_halted() {
        for (rests_in, rest, number) in [
            (Rest::Ready, State::Ready, 4),
            (Rest::Halted, State::Halted, 3),
        ] {
            let mut program = Program::new(Nature { rests_in, ..SKILL });
            program.call(Method::Reset).unwrap();
            program.call(Method::Start).unwrap();
            let run = program.run().unwrap();
            let end = program.ended(run, Ending::Success).unwrap();
            assert_eq!((end.number, program.state()), (number, rest));
        }
        let (mut program, run) = program(State::Running);
        let end = program.ended(run.unwrap(), Ending::Failure).unwrap();
        assert_eq!((end.number, program.state()), (3, State::Halted));
    }

    #[test]
    fn a_worker_that_ends_after_it_was_halted_does_not_end_the_next_run() {
        let (mut program, first) = program(State::Running);
        let first = first.unwrap();
        for method in [Method::Halt, Method::Reset, Method::Start] {
            program.call(method).unwrap();
        }
        assert_eq!(
            program.ended(first, Ending::Success),
            Err(NotRunning { run: first })
        );
        assert_eq!(program.state(), State::Running);
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
            let mut program = Program::counting_from(SKILL, first);
            program.call(Method::Reset).unwrap();
            for number in numbers {
                program.call(Method::Start).unwrap();
                let run = program.run().unwrap();
                assert_eq!(run.number(), number);
                program.ended(run, Ending::Success).unwrap();
            }
        }
    }

    #[test]
    fn a_suspended_run_can_fail_but_does_no_work() {
        let (mut program, run) = program(State::Suspended);
        let run = run.unwrap();
        assert!(program.ended(run, Ending::Success).is_err());
        let end = program.ended(run, Ending::Failure).unwrap();
        assert_eq!((end.number, program.state()), (7, State::Halted));
    }

    #[test]
    fn what_cannot_stand_still_is_never_suspended() {
        let mut program = Program::new(Nature {
            can_suspend: false,
            ..SKILL
        });
        program.call(Method::Reset).unwrap();
        program.call(Method::Start).unwrap();
        assert!(!program.is_executable(Method::Suspend));
        assert_eq!(program.call(Method::Suspend), Err(Refused::CannotSuspend));
        assert!(program.is_executable(Method::Halt));
    }
}
