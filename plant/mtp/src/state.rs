//! The state machine of services (VDI/VDE/NAMUR 2658-4), which no manifest contains.

use std::fmt;

macro_rules! bits {
    ($(#[$about:meta])* $name:ident { $($item:ident = $bit:literal),+ $(,)? }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum $name {
            $(#[doc = concat!("The bit ", stringify!($bit), ".")] $item,)+
        }

        impl $name {
            /// All values, in the order of their bits.
            pub const ALL: &'static [Self] = &[$(Self::$item),+];

            /// Returns its bit in the words of a ServiceControl.
            #[must_use]
            pub const fn bit(self) -> u32 {
                match self { $(Self::$item => $bit),+ }
            }

            /// Returns its name.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$item => stringify!($item)),+ }
            }

            /// Returns the value of a bit; `None` for any other word.
            #[must_use]
            pub fn of_bit(word: u32) -> Option<Self> {
                Self::ALL.iter().copied().find(|one| one.bit() == word)
            }

            /// Returns the value of a name.
            #[must_use]
            pub fn of_name(name: &str) -> Option<Self> {
                let mut all = Self::ALL.iter().copied();
                all.find(|one| one.name().eq_ignore_ascii_case(name))
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

bits! {
    /// A state of a service, as a bit of StateCur.
    State {
        Stopped = 4,
        Starting = 8,
        Idle = 16,
        Paused = 32,
        Execute = 64,
        Stopping = 128,
        Aborting = 256,
        Aborted = 512,
        Holding = 1024,
        Held = 2048,
        Unholding = 4096,
        Pausing = 8192,
        Resuming = 16384,
        Resetting = 32768,
        Completing = 65536,
        Completed = 131072,
    }
}

bits! {
    /// A command to a service, as a bit of CommandExt and CommandEn.
    Command {
        Reset = 2,
        Start = 4,
        Stop = 8,
        Hold = 16,
        Unhold = 32,
        Pause = 64,
        Resume = 128,
        Abort = 256,
        Restart = 512,
        Complete = 1024,
    }
}

impl State {
    /// Returns whether the service leaves the state by itself.
    #[must_use]
    pub const fn is_acting(self) -> bool {
        self.next().is_some()
    }

    /// Returns the state that follows when the work of an acting state is done. Execute of a
    /// procedure that completes by itself is followed by Completing.
    #[must_use]
    pub const fn next(self) -> Option<Self> {
        Some(match self {
            Self::Starting | Self::Unholding | Self::Resuming => Self::Execute,
            Self::Stopping => Self::Stopped,
            Self::Aborting => Self::Aborted,
            Self::Holding => Self::Held,
            Self::Pausing => Self::Paused,
            Self::Resetting => Self::Idle,
            Self::Completing => Self::Completed,
            Self::Stopped
            | Self::Idle
            | Self::Paused
            | Self::Execute
            | Self::Aborted
            | Self::Held
            | Self::Completed => return None,
        })
    }

    /// Returns the state that follows a command; `None` if the state does not allow the command.
    #[must_use]
    pub const fn after(self, command: Command) -> Option<Self> {
        Some(match (self, command) {
            (Self::Stopped | Self::Aborted | Self::Completed, Command::Reset) => Self::Resetting,
            (Self::Idle, Command::Start) => Self::Starting,
            (Self::Execute, Command::Restart) => Self::Starting,
            (Self::Execute, Command::Complete) => Self::Completing,
            (Self::Execute, Command::Pause) => Self::Pausing,
            (Self::Paused, Command::Resume) => Self::Resuming,
            (Self::Held, Command::Unhold) => Self::Unholding,
            (
                Self::Starting
                | Self::Execute
                | Self::Completing
                | Self::Resuming
                | Self::Paused
                | Self::Pausing
                | Self::Unholding,
                Command::Hold,
            ) => Self::Holding,
            (Self::Stopped | Self::Stopping | Self::Aborting | Self::Aborted, Command::Stop) => {
                return None;
            }
            (_, Command::Stop) => Self::Stopping,
            (Self::Aborting | Self::Aborted, Command::Abort) => return None,
            (_, Command::Abort) => Self::Aborting,
            (
                _,
                Command::Reset
                | Command::Start
                | Command::Hold
                | Command::Unhold
                | Command::Pause
                | Command::Resume
                | Command::Restart
                | Command::Complete,
            ) => return None,
        })
    }

    /// Returns the commands that the state allows, as the word CommandEn.
    #[must_use]
    pub fn commands(self) -> u32 {
        let allowed = Command::ALL
            .iter()
            .filter(|command| self.after(**command).is_some());
        allowed.fold(0, |word, command| word | command.bit())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ten_commands_in_sixteen_states_are_accepted_as_the_standard_says() {
        let accepted = [
            (State::Stopped, "Reset Abort"),
            (State::Starting, "Stop Hold Abort"),
            (State::Idle, "Start Stop Abort"),
            (State::Paused, "Stop Hold Resume Abort"),
            (State::Execute, "Stop Hold Pause Abort Restart Complete"),
            (State::Stopping, "Abort"),
            (State::Aborting, ""),
            (State::Aborted, "Reset"),
            (State::Holding, "Stop Abort"),
            (State::Held, "Stop Unhold Abort"),
            (State::Unholding, "Stop Hold Abort"),
            (State::Pausing, "Stop Hold Abort"),
            (State::Resuming, "Stop Hold Abort"),
            (State::Resetting, "Stop Abort"),
            (State::Completing, "Stop Hold Abort"),
            (State::Completed, "Reset Stop Abort"),
        ];
        assert_eq!(accepted.len(), State::ALL.len());
        for (state, commands) in accepted {
            let found: Vec<&str> = Command::ALL
                .iter()
                .filter(|command| state.after(**command).is_some())
                .map(|command| command.name())
                .collect();
            assert_eq!(found.join(" "), commands, "{state}");
        }
        // The words of a PEA of another maker.
        let words = [
            (State::Idle, 268),
            (State::Execute, 1880),
            (State::Completed, 266),
            (State::Stopped, 258),
            (State::Aborted, 2),
            (State::Held, 296),
        ];
        for (state, word) in words {
            assert_eq!(state.commands(), word, "{state}");
        }
        assert_eq!(State::of_bit(32678), None, "a typing error in the field");
    }

    #[test]
    fn every_acting_state_ends_in_a_waiting_state() {
        let acting = State::ALL.iter().filter(|state| state.is_acting());
        assert_eq!(acting.count(), 9);
        for state in State::ALL {
            if let Some(next) = state.next() {
                assert!(!next.is_acting(), "{state} {next}");
            }
        }
    }
}
