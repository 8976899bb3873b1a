//! The trace of the current run, and the outcomes of the last runs.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use tokio::time::Instant;

use crate::driver::Line;
use crate::lock::lock;
use crate::shown::RunOutcome;

/// The trace of the current run, and the outcomes of the last runs.
pub(super) struct SkillHistory {
    outcomes: Arc<Mutex<VecDeque<Arc<RunOutcome>>>>,
    trace: Vec<String>,
}

impl SkillHistory {
    /// Creates a history that adds to these outcomes.
    pub(super) const fn new(outcomes: Arc<Mutex<VecDeque<Arc<RunOutcome>>>>) -> Self {
        Self {
            outcomes,
            trace: Vec::new(),
        }
    }

    pub(super) fn clear_trace(&mut self) {
        self.trace.clear();
    }

    pub(super) fn take_trace(&mut self) -> Vec<String> {
        std::mem::take(&mut self.trace)
    }

    /// Adds a report to the trace of a run that began at this time.
    pub(super) fn add(&mut self, began: Instant, line: &Line) {
        let (Line::Step(text)
        | Line::Note(text)
        | Line::Pending(text)
        | Line::Refused(text)
        | Line::Unknown(text)) = line;
        if self.trace.len() < MOST_TRACED {
            let text: String = text.chars().take(LONGEST_TRACED).collect();
            let seconds = began.elapsed().as_secs_f64();
            self.trace.push(format!("{seconds:.3} {text}"));
        }
    }

    /// Adds an outcome. The oldest outcome gives way to it.
    pub(super) fn keep(&self, outcome: RunOutcome) -> Arc<RunOutcome> {
        let outcome = Arc::new(outcome);
        let mut outcomes = lock(&self.outcomes);
        if outcomes.len() >= MOST_OUTCOMES {
            outcomes.pop_front();
        }
        outcomes.push_back(Arc::clone(&outcome));
        outcome
    }
}

/// Maximum number of trace lines of a run, and the maximum length of each in characters.
const MOST_TRACED: usize = 256;
const LONGEST_TRACED: usize = 240;
/// Number of outcomes that are kept.
const MOST_OUTCOMES: usize = 64;
