//! The report of a run of the scenario.

use std::fmt::Write as _;

use serde::Serialize;

use crate::stage::StepRun;

/// The report.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct BatchReport {
    pub(super) speed: f64,
    /// Time from the start of the programs until each step had a skill.
    pub(super) planned_ms: Option<f64>,
    /// The runs of skills, in the order in which they began.
    pub(super) steps: Vec<StepRun>,
}

impl BatchReport {
    /// Returns whether two steps ran at the same time.
    pub(super) fn overlap(&self) -> bool {
        self.steps.iter().enumerate().any(|(number, one)| {
            let mut later = self.steps.iter().skip(number + 1);
            later.any(|other| one.ended_ms.is_some_and(|ended| other.started_ms < ended))
        })
    }

    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        let began = self.steps.iter().map(|step| step.started_ms).min();
        let began = began.unwrap_or_default();
        // Writing to a String cannot fail.
        _ = writeln!(out, "{:<20} {:>9} {:>9}  outcome", "step", "begins", "ends");
        for step in &self.steps {
            let at = |ms: u64| format!("{} ms", ms.saturating_sub(began));
            let ended = step.ended_ms.map_or_else(|| "-".to_owned(), at);
            let started = at(step.started_ms);
            _ = writeln!(
                out,
                "{:<20} {started:>9} {ended:>9}  {}",
                step.step, step.outcome
            );
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_overlap_if_one_begins_before_another_has_ended() {
        let step = |started_ms, ended_ms| StepRun {
            started_ms,
            ended_ms,
            ..StepRun::default()
        };
        let report = |steps| BatchReport {
            steps,
            ..BatchReport::default()
        };
        let in_turn = vec![step(1, Some(5)), step(5, Some(9))];
        assert!(!report(in_turn).overlap());
        let together = vec![step(1, Some(5)), step(2, Some(3))];
        assert!(report(together).overlap());
    }
}
