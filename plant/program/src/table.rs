//! States, transitions and their identifiers, as the NodeSet of namespace 0 defines them.

use std::fmt;

use crate::Rest;

/// A state of ProgramStateMachineType (OPC 10000-10, 5.2.3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum State {
    /// Not started, or ended. A Reset leads to Ready.
    Halted,
    /// Can be started.
    Ready,
    /// Doing its work.
    Running,
    /// The work is suspended.
    Suspended,
}

impl State {
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

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A method of ProgramStateMachineType (OPC 10000-10, 5.2.3.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Method {
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

impl Method {
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

impl fmt::Display for Method {
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
pub enum Cause {
    /// Only a method call.
    Method(Method),
    /// Only the end of the work.
    Work,
    /// A method call or the end of the work.
    MethodOrWork(Method),
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
    pub from: State,
    /// The target state.
    pub to: State,
    /// The cause.
    pub cause: Cause,
}

impl Transition {
    pub(crate) fn by_method(from: State, method: Method) -> Option<&'static Self> {
        TRANSITIONS.iter().find(|transition| {
            let caused = match transition.cause {
                Cause::Method(cause) | Cause::MethodOrWork(cause) => cause == method,
                Cause::Work => false,
            };
            caused && transition.from == from
        })
    }

    pub(crate) fn by_ending(from: State, ending: Ending, rest: Rest) -> Option<&'static Self> {
        let to = match (from, ending, rest) {
            (State::Running, Ending::Success, Rest::Ready) => State::Ready,
            (State::Running, Ending::Success, Rest::Halted)
            | (State::Running | State::Suspended, Ending::Failure, _) => State::Halted,
            (State::Suspended, Ending::Success, _) | (State::Halted | State::Ready, _, _) => {
                return None;
            }
        };
        TRANSITIONS.iter().find(|transition| {
            transition.from == from
                && transition.to == to
                && !matches!(transition.cause, Cause::Method(_))
        })
    }
}

/// All transitions, by their numbers.
pub static TRANSITIONS: [Transition; 9] = [
    Transition {
        number: 1,
        name: "HaltedToReady",
        node_id: 2408,
        from: State::Halted,
        to: State::Ready,
        cause: Cause::Method(Method::Reset),
    },
    Transition {
        number: 2,
        name: "ReadyToRunning",
        node_id: 2410,
        from: State::Ready,
        to: State::Running,
        cause: Cause::Method(Method::Start),
    },
    Transition {
        number: 3,
        name: "RunningToHalted",
        node_id: 2412,
        from: State::Running,
        to: State::Halted,
        cause: Cause::MethodOrWork(Method::Halt),
    },
    Transition {
        number: 4,
        name: "RunningToReady",
        node_id: 2414,
        from: State::Running,
        to: State::Ready,
        cause: Cause::Work,
    },
    Transition {
        number: 5,
        name: "RunningToSuspended",
        node_id: 2416,
        from: State::Running,
        to: State::Suspended,
        cause: Cause::Method(Method::Suspend),
    },
    Transition {
        number: 6,
        name: "SuspendedToRunning",
        node_id: 2418,
        from: State::Suspended,
        to: State::Running,
        cause: Cause::Method(Method::Resume),
    },
    Transition {
        number: 7,
        name: "SuspendedToHalted",
        node_id: 2420,
        from: State::Suspended,
        to: State::Halted,
        cause: Cause::MethodOrWork(Method::Halt),
    },
    Transition {
        number: 8,
        name: "SuspendedToReady",
        node_id: 2422,
        from: State::Suspended,
        to: State::Ready,
        cause: Cause::Method(Method::Reset),
    },
    Transition {
        number: 9,
        name: "ReadyToHalted",
        node_id: 2424,
        from: State::Ready,
        to: State::Halted,
        cause: Cause::Method(Method::Halt),
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
        ids.extend(State::ALL.map(State::node_id));
        ids.extend(Method::ALL.map(Method::node_id));
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), 9 + 4 + 5, "no identifier is given twice");
    }
}
