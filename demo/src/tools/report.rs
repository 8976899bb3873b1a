//! The report of a run of the scenario.

use std::fmt::Write as _;

use serde::Serialize;

/// The report.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct ToolsReport {
    pub(super) speed: f64,
    pub(super) swapped: bool,
    /// Number of robots in the cell.
    pub(super) robots: usize,
    /// Time from the start of the components until all their skills were found.
    pub(super) found_ms: Option<f64>,
    pub(super) runs: Vec<ToolsRun>,
    /// Time from the signal that killed a component until the run reported it, and until the
    /// component was found again after its restart.
    pub(super) told_lost_ms: Option<f64>,
    pub(super) found_again_ms: Option<f64>,
}

/// A run of a skill.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ToolsRun {
    /// The skill, as `tool-changer.ChangeTool`.
    pub(super) skill: String,
    /// The purpose of the run.
    pub(super) what: String,
    pub(super) succeeded: bool,
    pub(super) message: String,
    pub(super) lasted_ms: f64,
    /// The observed steps, in order.
    pub(super) steps: Vec<String>,
}

impl ToolsReport {
    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        let ms = |ms: Option<f64>| ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0} ms"));
        // Writing to a String cannot fail.
        _ = writeln!(
            out,
            "{:<28} {:<28} {:>9}  outcome",
            "skill", "what for", "lasted"
        );
        for run in &self.runs {
            let outcome = if run.succeeded { "done" } else { &run.message };
            _ = writeln!(
                out,
                "{:<28} {:<28} {:>6.0} ms  {outcome}",
                run.skill, run.what, run.lasted_ms
            );
        }
        _ = writeln!(
            out,
            "\nall skills found after {}; {} robots in the cell",
            ms(self.found_ms),
            self.robots
        );
        _ = writeln!(
            out,
            "a gripper killed on the way: told after {}, found again {} after its new start",
            ms(self.told_lost_ms),
            ms(self.found_again_ms)
        );
        out
    }
}
