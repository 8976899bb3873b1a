//! The work of a reading, which is bounded in steps and in time.

use crate::fault::ShapeFault;

/// The work of a reading so far, with its limits.
pub(crate) struct ReadingBudget<'c> {
    /// About the number of comparisons of edges with each other, of all shapes.
    spent: u64,
    /// The value of `spent` at which the time limit is checked next.
    next_look: u64,
    /// Returns whether the time of the reading is over.
    is_over: &'c dyn Fn() -> bool,
    is_late: bool,
}

impl<'c> ReadingBudget<'c> {
    /// Creates a budget. The reading ends when `is_over` returns true.
    pub(crate) fn new(is_over: &'c dyn Fn() -> bool) -> Self {
        Self {
            spent: 0,
            next_look: 0,
            is_over,
            is_late: false,
        }
    }

    /// Counts some steps.
    ///
    /// # Errors
    /// The reading has to end.
    pub(crate) fn spend(&mut self, steps: u64) -> Result<(), ShapeFault> {
        self.add(steps);
        if self.is_late {
            Err(ShapeFault::Late)
        } else if self.spent > MOST_WORK {
            Err(ShapeFault::TooLarge)
        } else {
            Ok(())
        }
    }

    /// Counts some steps of a search, which ends by [`Self::is_left`].
    pub(crate) fn add(&mut self, steps: u64) {
        self.spent = self.spent.saturating_add(steps);
        if !self.is_late && self.spent >= self.next_look {
            self.next_look = self.spent.saturating_add(BETWEEN_LOOKS);
            self.is_late = (self.is_over)();
        }
    }

    /// Returns whether the reading may go on.
    pub(crate) fn is_left(&self) -> bool {
        !self.is_late && self.spent <= MOST_WORK
    }
}

impl std::fmt::Debug for ReadingBudget<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut shown = f.debug_struct("ReadingBudget");
        shown.field("spent", &self.spent);
        shown.field("is_late", &self.is_late).finish()
    }
}

/// Returns the work of a number of steps.
pub(crate) fn steps_of(count: usize) -> u64 {
    u64::try_from(count).unwrap_or(u64::MAX)
}

/// Maximum work of a file.
const MOST_WORK: u64 = 200_000_000;
/// Work between two checks of the time limit: some milliseconds.
const BETWEEN_LOOKS: u64 = 100_000;
