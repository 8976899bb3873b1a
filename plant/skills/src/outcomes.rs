//! The outcomes of the newest runs of a skill.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use crate::lock::lock;
use crate::shown::RunOutcome;

/// The outcomes of the newest runs of a skill. Clones share them.
#[derive(Debug, Clone, Default)]
pub(crate) struct NewestOutcomes(Arc<Mutex<VecDeque<Arc<RunOutcome>>>>);

impl NewestOutcomes {
    /// Adds an outcome. The oldest outcome gives way to it.
    pub(crate) fn keep(&self, outcome: RunOutcome) -> Arc<RunOutcome> {
        let outcome = Arc::new(outcome);
        let mut outcomes = lock(&self.0);
        if outcomes.len() >= MOST_OUTCOMES {
            outcomes.pop_front();
        }
        outcomes.push_back(Arc::clone(&outcome));
        outcome
    }

    /// Returns the outcome of a run, if it is kept.
    pub(crate) fn of(&self, run: u32) -> Option<Arc<RunOutcome>> {
        let outcomes = lock(&self.0);
        outcomes.iter().find(|outcome| outcome.run == run).cloned()
    }
}

/// Number of outcomes that are kept.
const MOST_OUTCOMES: usize = 64;
