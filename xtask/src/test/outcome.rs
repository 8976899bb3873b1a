//! The summary of a test run.

use std::{cmp::Reverse, fmt, time::Duration};

use super::job::{JobReport, ResultCounts};
use crate::shell::CommandOutcome;

const SLOWEST: usize = 20;

/// The counts, failures and slowest tests of a test run.
pub(super) struct TestOutcome<'a> {
    counts: ResultCounts,
    programs: usize,
    failed: Vec<&'a str>,
    flaky: &'a [String],
    most_flaky: usize,
    skipped: Vec<&'a str>,
    slowest: Vec<(&'a str, Duration)>,
}

impl<'a> TestOutcome<'a> {
    /// Creates the summary. `skipped` has the reasons of skipped tests. More than `most_flaky`
    /// tests that passed only at the second attempt are a failure.
    pub(super) fn new(report: &'a JobReport, skipped: Vec<&'a str>, most_flaky: usize) -> Self {
        let mut counts = ResultCounts::default();
        for done in &report.done {
            counts.passed += done.counts.passed;
            counts.failed += done.counts.failed;
            counts.ignored += done.counts.ignored;
        }
        let mut slowest: Vec<_> = report
            .done
            .iter()
            .map(|done| (done.name(), done.took))
            .collect();
        slowest.sort_by_key(|(_, took)| Reverse(*took));
        slowest.truncate(SLOWEST);
        let failed = report.done.iter().filter(|done| !done.passed);
        Self {
            counts,
            programs: report.done.len(),
            failed: failed.map(|done| done.name()).collect(),
            flaky: &report.flaky,
            most_flaky,
            skipped,
            slowest,
        }
    }

    fn too_flaky(&self) -> bool {
        self.flaky.len() > self.most_flaky
    }

    pub(super) fn ended(&self) -> CommandOutcome {
        match self.failed.is_empty() && !self.too_flaky() {
            true => CommandOutcome::WELL,
            false => CommandOutcome::BADLY,
        }
    }
}

impl fmt::Display for TestOutcome<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nthe slowest:")?;
        for (name, took) in &self.slowest {
            writeln!(f, "{:8.1} s  {name}", took.as_secs_f64())?;
        }
        for reason in &self.skipped {
            writeln!(f, "skipped: {reason}")?;
        }
        for name in self.flaky {
            writeln!(
                f,
                "flaky: {name} (it passed when it was tried once more, alone)"
            )?;
        }
        if self.too_flaky() {
            writeln!(f, "more than {} flaky tests are a failure", self.most_flaky)?;
        }
        for name in &self.failed {
            writeln!(f, "failed: {name}")?;
        }
        let word = match self.ended() == CommandOutcome::WELL {
            true => "ok",
            false => "FAILED",
        };
        // A skipped test returns early, so its program counts it as passed.
        let skipped = u64::try_from(self.skipped.len()).unwrap_or(u64::MAX);
        writeln!(
            f,
            "\ntest result: {word}. {} passed; {} failed; {} ignored; {} flaky, {skipped} skipped, in {} processes",
            self.counts.passed.saturating_sub(skipped),
            self.counts.failed,
            self.counts.ignored,
            self.flaky.len(),
            self.programs
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ended(flaky: usize) -> CommandOutcome {
        let report = JobReport {
            flaky: vec!["a test".to_owned(); flaky],
            ..JobReport::default()
        };
        TestOutcome::new(&report, Vec::new(), 2).ended()
    }

    #[test]
    fn two_flaky_tests_are_told_and_a_third_fails_the_run() {
        assert_eq!(
            (ended(2), ended(3)),
            (CommandOutcome::WELL, CommandOutcome::BADLY)
        );
    }
}
