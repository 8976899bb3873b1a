//! The report of a run of the scenario.

use std::fmt::Write as _;

use serde::Serialize;

use crate::stage::StepRun;

/// The report.
#[derive(Clone, Debug, Serialize)]
pub(super) struct FusesReport {
    pub(super) speed: f64,
    pub(super) insertions: Vec<FuseInsertion>,
}

/// The insertion of a fuse.
#[derive(Clone, Debug, Serialize)]
pub(super) struct FuseInsertion {
    pub(super) arm: &'static str,
    pub(super) tries: usize,
    /// Number of tries that ended at the force limit.
    pub(super) resisted: usize,
    /// Distance of the arm from the height of an inserted fuse after the last try, mm.
    pub(super) from_seat_mm: Option<f64>,
    pub(super) released: bool,
    pub(super) lasted_ms: Option<u64>,
    /// The runs of skills, in the order in which they began.
    pub(super) steps: Vec<StepRun>,
}

impl FusesReport {
    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        // Writing to a String cannot fail.
        _ = writeln!(
            out,
            "{:<12} {:>5} {:>16} {:>14} {:>9} {:>10}",
            "arm", "tries", "with resistance", "from the seat", "released", "lasted"
        );
        for insertion in &self.insertions {
            let far = insertion.from_seat_mm;
            let far = far.map_or_else(|| "-".to_owned(), |mm| format!("{mm:.2} mm"));
            let lasted = insertion.lasted_ms;
            let lasted = lasted.map_or_else(|| "-".to_owned(), |ms| format!("{ms} ms"));
            _ = writeln!(
                out,
                "{:<12} {:>5} {:>16} {far:>14} {:>9} {lasted:>10}",
                insertion.arm, insertion.tries, insertion.resisted, insertion.released
            );
        }
        out
    }
}
