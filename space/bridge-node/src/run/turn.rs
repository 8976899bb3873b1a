//! The turns of run loops that share a thread.

/// The number of datagrams, or of events of the port, that a run loop handles in a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Turn {
    /// The program has a thread of its own.
    Whole,
    /// Other programs share the thread. The first values of a burst do not wait in one program
    /// until the other program has handled all of them.
    Shared,
}

impl Turn {
    /// Returns the number.
    pub(super) const fn length(self) -> usize {
        match self {
            Self::Whole => 32,
            Self::Shared => 8,
        }
    }
}
