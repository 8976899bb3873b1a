//! States, transitions and their identifiers, as the NodeSet of namespace 0 defines them.

use std::fmt;

use crate::Rest;

/// A state of ProgramStateMachineType (OPC 10000-10, 5.2.3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ProgramMachineState {
    /// Not started, or ended. A Reset leads to Ready.
    Halted,
    /// Can be started.
    Ready,
    /// Doing its work.
    Running,
    /// The work is suspended.
    Suspended,
}

impl ProgramMachineState {
    /// All states.
    pub const ALL: [Self; 4] = [Self::Halted, Self::Ready, Self::Running, Self::Suspended];

    /// Returns the StateNumber.
    #[must_use]
    pub fn number(self) -> u32 {
        match self {
            Self::Halted => 11,
            Self::Ready => 12,
            Self::Running => 13,
            Self::Suspended => 14,
        }
    }

    /// Returns the numeric identifier of its node in namespace 0, which is the Id of CurrentState.
    #[must_use]
    pub fn node_id(self) -> u32 {
        match self {
            Self::Halted => 2406,
            Self::Ready => 2400,
            Self::Running => 2402,
            Self::Suspended => 2404,
        }
    }

    /// Returns the BrowseName.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Halted => "Halted",
            Self::Ready => "Ready",
            Self::Running => "Running",
            Self::Suspended => "Suspended",
        }
    }
}

impl fmt::Display for ProgramMachineState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A method of ProgramStateMachineType (OPC 10000-10, 5.2.3.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ProgramMethod {
    /// Starts a run.
    Start,
    /// Suspends the work.
    Suspend,
    /// Resumes the work.
    Resume,
    /// Ends the run, or leaves Ready.
    Halt,
    /// Leads to Ready.
    Reset,
}

impl ProgramMethod {
    /// All methods.
    pub const ALL: [Self; 5] = [
        Self::Start,
        Self::Suspend,
        Self::Resume,
        Self::Halt,
        Self::Reset,
    ];

    /// Returns the numeric identifier of the type's method in namespace 0. Clients may use it to
    /// call the method of any instance.
    #[must_use]
    pub fn node_id(self) -> u32 {
        match self {
            Self::Start => 2426,
            Self::Suspend => 2427,
            Self::Resume => 2428,
            Self::Halt => 2429,
            Self::Reset => 2430,
        }
    }

    /// Returns the BrowseName.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Start => "Start",
            Self::Suspend => "Suspend",
            Self::Resume => "Resume",
            Self::Halt => "Halt",
            Self::Reset => "Reset",
        }
    }
}

impl fmt::Display for ProgramMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The end of the work of a run, not caused by a method call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Ending {
    /// The work is done.
    Success,
    /// The work is not done and does not continue.
    Failure,
}

/// The cause of a transition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TransitionCause {
    /// Only a method call.
    Method(ProgramMethod),
    /// Only the end of the work.
    Work,
    /// A method call or the end of the work.
    MethodOrWork(ProgramMethod),
}

/// A transition of ProgramStateMachineType, which has nine (OPC 10000-10, 5.2.3.1).
#[derive(Debug, PartialEq, Eq)]
pub struct Transition {
    /// The TransitionNumber, 1 to 9.
    pub number: u32,
    /// The BrowseName, as `ReadyToRunning`.
    pub name: &'static str,
    /// The numeric identifier of its node in namespace 0, which is the Id of LastTransition.
    pub node_id: u32,
    /// The source state.
    pub from: ProgramMachineState,
    /// The target state.
    pub to: ProgramMachineState,
    /// The cause.
    pub cause: TransitionCause,
}

impl Transition {
    pub(crate) fn by_method(
        from: ProgramMachineState,
        method: ProgramMethod,
    ) -> Option<&'static Self> {
        TRANSITIONS.iter().find(|transition| {
            let caused = match transition.cause {
                TransitionCause::Method(cause) | TransitionCause::MethodOrWork(cause) => {
                    cause == method
                }
                TransitionCause::Work => false,
            };
            caused && transition.from == from
        })
    }

    pub(crate) fn by_ending(
        from: ProgramMachineState,
        ending: Ending,
        rest: Rest,
    ) -> Option<&'static Self> {
        let to = match (from, ending, rest) {
            (ProgramMachineState::Running, Ending::Success, Rest::Ready) => {
                ProgramMachineState::Ready
            }
            (ProgramMachineState::Running, Ending::Success, Rest::Halted)
            | (ProgramMachineState::Running | ProgramMachineState::Suspended, Ending::Failure, _) => {
                ProgramMachineState::Halted
            }
            (ProgramMachineState::Suspended, Ending::Success, _)
            | (ProgramMachineState::Halted | ProgramMachineState::Ready, _, _) => {
                return None;
            }
        };
        TRANSITIONS.iter().find(|transition| {
            transition.from == from
                && transition.to == to
                && !matches!(transition.cause, TransitionCause::Method(_))
        })
    }
}

/// All transitions, by their numbers.
pub static TRANSITIONS: [Transition; 9] = [
    Transition {
        number: 1,
        name: "HaltedToReady",
        node_id: 2408,
        from: ProgramMachineState::Halted,
        to: ProgramMachineState::Ready,
        cause: TransitionCause::Method(ProgramMethod::Reset),
    },
    Transition {
        number: 2,
        name: "ReadyToRunning",
        node_id: 2410,
        from: ProgramMachineState::Ready,
        to: ProgramMachineState::Running,
        cause: TransitionCause::Method(ProgramMethod::Start),
    },
    Transition {
        number: 3,
        name: "RunningToHalted",
        node_id: 2412,
        from: ProgramMachineState::Running,
        to: ProgramMachineState::Halted,
        cause: TransitionCause::MethodOrWork(ProgramMethod::Halt),
    },
    Transition {
        number: 4,
        name: "RunningToReady",
        node_id: 2414,
        from: ProgramMachineState::Running,
        to: ProgramMachineState::Ready,
        cause: TransitionCause::Work,
    },
    Transition {
        number: 5,
        name: "RunningToSuspended",
        node_id: 2416,
        from: ProgramMachineState::Running,
        to: ProgramMachineState::Suspended,
        cause: TransitionCause::Method(ProgramMethod::Suspend),
    },
    Transition {
        number: 6,
        name: "SuspendedToRunning",
        node_id: 2418,
        from: ProgramMachineState::Suspended,
        to: ProgramMachineState::Running,
        cause: TransitionCause::Method(ProgramMethod::Resume),
    },
    Transition {
        number: 7,
        name: "SuspendedToHalted",
        node_id: 2420,
        from: ProgramMachineState::Suspended,
        to: ProgramMachineState::Halted,
        cause: TransitionCause::MethodOrWork(ProgramMethod::Halt),
    },
    Transition {
        number: 8,
        name: "SuspendedToReady",
        node_id: 2422,
        from: ProgramMachineState::Suspended,
        to: ProgramMachineState::Ready,
        cause: TransitionCause::Method(ProgramMethod::Reset),
    },
    Transition {
        number: 9,
        name: "ReadyToHalted",
        node_id: 2424,
        from: ProgramMachineState::Ready,
        to: ProgramMachineState::Halted,
        cause: TransitionCause::Method(ProgramMethod::Halt),
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_numbers_follow_from_states_and_places() {
        for (place, transition) in (1..).zip(&TRANSITIONS) {
            assert_eq!(transition.number, place);
            let name = format!("{}To{}", transition.from, transition.to);
            assert_eq!(transition.name, name);
        }
        let mut ids: Vec<_> = TRANSITIONS
            .iter()
            .map(|transition| transition.node_id)
            .collect();
        ids.extend(ProgramMachineState::ALL.map(ProgramMachineState::node_id));
        ids.extend(ProgramMethod::ALL.map(ProgramMethod::node_id));
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), 9 + 4 + 5, "no identifier is given twice");
    }
}
