//! What a run of the story was like.

use std::fmt::Write as _;

use serde::Serialize;

/// All of it.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Report {
    pub(super) finished: bool,
    pub(super) failure: Option<String>,
    pub(super) speed: f64,
    pub(super) swapped: bool,
    /// How many robots there are in the cell.
    pub(super) robots: usize,
    /// From the start of the components until all of their skills were found.
    pub(super) found_ms: Option<f64>,
    pub(super) runs: Vec<Run>,
    /// From the signal that killed a component: until the run said so, and until it was found again after its start.
    pub(super) told_lost_ms: Option<f64>,
    pub(super) found_again_ms: Option<f64>,
}

/// One run of a skill.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Run {
    /// As `tool-changer.ChangeTool`.
    pub(super) skill: String,
    /// What it was run for.
    pub(super) what: String,
    pub(super) succeeded: bool,
    pub(super) message: String,
    pub(super) lasted_ms: f64,
    /// Those that were seen, in their order.
    pub(super) steps: Vec<String>,
}

impl Report {
    /// As people read it.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        let ms = |ms: Option<f64>| ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0} ms"));
        // A write to a String cannot fail.
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
