//! The trace of the current run, and the outcomes of the last runs.

use std::sync::Arc;
use std::time::Duration;

use crate::driver::Line;
use crate::outcomes::NewestOutcomes;
use crate::shown::RunOutcome;

/// The trace of the current run, and the outcomes of the last runs.
pub(super) struct SkillHistory {
    outcomes: NewestOutcomes,
    trace: Vec<String>,
}

impl SkillHistory {
    /// Creates a history that adds to these outcomes.
    pub(super) const fn new(outcomes: NewestOutcomes) -> Self {
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

    /// Adds a report to the trace, with the time since the start of the run.
    pub(super) fn add(&mut self, since_start: Duration, line: &Line) {
        let (Line::Step(text)
        | Line::Note(text)
        | Line::Pending(text)
        | Line::Refused(text)
        | Line::Unknown(text)) = line;
        if self.trace.len() < MOST_TRACED {
            let text: String = text.chars().take(LONGEST_TRACED).collect();
            let seconds = since_start.as_secs_f64();
            self.trace.push(format!("{seconds:.3} {text}"));
        }
    }

    /// Adds an outcome.
    pub(super) fn keep(&self, outcome: RunOutcome) -> Arc<RunOutcome> {
        self.outcomes.keep(outcome)
    }
}

/// Maximum number of trace lines of a run, and the maximum length of each in characters.
const MOST_TRACED: usize = 256;
const LONGEST_TRACED: usize = 240;
