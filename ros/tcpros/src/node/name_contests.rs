//! Whether another node has taken the name of this node.

use std::sync::atomic::{AtomicU64, Ordering};

/// Counts the master's reports that another node has taken this node's name. A report may be late:
/// the name may be this node's again, so each report opens a contest that is decided by asking.
#[derive(Debug, Default)]
pub(super) struct NameContests {
    begun: AtomicU64,
    /// The number of contests after which the name was this node's.
    decided: AtomicU64,
}

impl NameContests {
    /// Begins a contest.
    pub(super) fn begin(&self) {
        self.begun.fetch_add(1, Ordering::AcqRel);
    }

    /// Returns the number of the open contest.
    pub(super) fn open(&self) -> Option<u64> {
        let last = self.begun.load(Ordering::Acquire);
        (last != self.decided.load(Ordering::Acquire)).then_some(last)
    }

    /// Records that the name was this node's after this number of contests.
    pub(super) fn decide(&self, contest: u64) {
        self.decided.store(contest, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_contest_that_begins_during_a_decision_stays_open() {
        let contests = NameContests::default();
        assert_eq!(contests.open(), None);
        contests.begin();
        let asked = contests.open().unwrap();
        contests.begin();
        contests.decide(asked);
        let second = contests.open().unwrap();
        contests.decide(second);
        assert_eq!(contests.open(), None);
    }
}
