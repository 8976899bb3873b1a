//! The turns of a run loop: how much it handles in a row before other tasks of its thread run.

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

    /// Returns the limits of a turn of datagrams.
    pub(super) const fn limits(self) -> TurnLimits {
        TurnLimits {
            datagrams: self.length(),
            bytes: BYTES,
        }
    }
}

/// The remaining limits of a turn of datagrams.
#[derive(Debug)]
pub(super) struct TurnLimits {
    datagrams: usize,
    bytes: usize,
}

impl TurnLimits {
    /// Counts a datagram of a size in bytes. Returns whether the turn goes on after it.
    pub(super) const fn goes_on_after(&mut self, size: usize) -> bool {
        self.datagrams = self.datagrams.saturating_sub(1);
        self.bytes = self.bytes.saturating_sub(size);
        self.datagrams > 0 && self.bytes > 0
    }
}

/// The bytes after which a turn of datagrams ends. Large samples arrive in datagrams of up to
/// 64 KiB and leave by DDS in rounds of 64 KiB, by a task of the same thread.
const BYTES: usize = 128 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    fn datagrams_of_a_turn(turn: Turn, size: usize) -> usize {
        let mut limits = turn.limits();
        let mut count = 1;
        while limits.goes_on_after(size) {
            count += 1;
        }
        count
    }

    #[test]
    fn a_turn_ends_after_a_number_of_small_datagrams_and_after_few_large_datagrams() {
        assert_eq!(datagrams_of_a_turn(Turn::Whole, 1024), 32);
        assert_eq!(datagrams_of_a_turn(Turn::Whole, 65_000), 3);
        assert_eq!(datagrams_of_a_turn(Turn::Shared, 0), 8);
        assert_eq!(datagrams_of_a_turn(Turn::Shared, 1_000_000), 1);
    }
}
