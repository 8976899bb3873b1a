//! The report of a run of the scenario.

use std::fmt::{self, Write as _};

use serde::Serialize;

use crate::stage::StepRun;

/// The report.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct TerminalsReport {
    pub(super) speed: f64,
    /// The runs of skills, in the order in which they began.
    pub(super) steps: Vec<StepRun>,
    /// The distances of the fingers from the blocks and from their places, by the simulated robot.
    pub(super) visits: Vec<BlockVisit>,
}

/// The smallest distance of the fingers from the place of a block.
#[derive(Clone, Debug, Serialize)]
pub(super) struct BlockVisit {
    /// The number of the block, from 1.
    pub(super) block: usize,
    pub(super) at: &'static str,
    pub(super) nearest_mm: f64,
}

impl fmt::Display for BlockVisit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            block,
            at,
            nearest_mm,
        } = self;
        write!(f, "{at} with block {block}: {nearest_mm:.2} mm from it")
    }
}

impl TerminalsReport {
    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        // Writing to a String cannot fail.
        _ = writeln!(out, "{:<22} {:>9}  outcome", "step", "lasted");
        for step in &self.steps {
            let ended = step.ended_ms;
            let lasted = ended.map(|ended| ended.saturating_sub(step.started_ms));
            let lasted = lasted.map_or_else(|| "-".to_owned(), |ms| format!("{ms} ms"));
            _ = writeln!(out, "{:<22} {lasted:>9}  {}", step.step, step.outcome);
        }
        for visit in &self.visits {
            _ = writeln!(out, "fingers at {visit}");
        }
        out
    }
}
