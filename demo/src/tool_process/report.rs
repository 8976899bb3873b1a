//! The report of the scenario.

use std::fmt::Write as _;

use serde::Serialize;

use super::{CHANGER, FINGERS, VACUUM};
use crate::stage::StepRun;

/// The report.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct ProcessReport {
    pub(super) speed: f64,
    pub(super) swapped: bool,
    /// Number of components in the cell.
    pub(super) components: usize,
    pub(super) runs: Vec<ReportedRun>,
    /// The number of grips, and of those by the gripper that was attached.
    pub(super) grips: usize,
    pub(super) right: usize,
}

/// A run of the process.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct ReportedRun {
    pub(super) outcome: String,
    pub(super) reason: Option<String>,
    /// The number of plans.
    pub(super) plans: usize,
    /// The reason for which the process waited while the gripper was unplugged.
    pub(super) waited_for: Option<String>,
    pub(super) lasted_ms: f64,
    /// The runs of skills, in the order in which they began.
    pub(super) steps: Vec<StepRun>,
}

impl ProcessReport {
    /// Adds a run, and counts its grips.
    pub(super) fn add(&mut self, run: ReportedRun) {
        let (right, grips) = run.grips();
        self.right += right;
        self.grips += grips;
        self.runs.push(run);
    }

    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        // Writing to a String cannot fail.
        _ = writeln!(out, "{:<5} {:>5} {:>10}  outcome", "run", "plans", "lasted");
        for (number, run) in (1..).zip(&self.runs) {
            let ReportedRun {
                plans,
                lasted_ms,
                outcome,
                ..
            } = run;
            _ = writeln!(out, "{number:<5} {plans:>5} {lasted_ms:>7.0} ms  {outcome}");
        }
        _ = writeln!(
            out,
            "{} of {} grips by the right gripper",
            self.right, self.grips
        );
        out
    }
}

impl ReportedRun {
    /// Returns the number of grips by the right gripper, and of all grips that were done.
    fn grips(&self) -> (usize, usize) {
        let done = self.steps.iter().filter(|step| step.outcome == "done");
        let grips: Vec<bool> = done
            .filter_map(|step| Some(step.component.contains(gripper(&step.step)?)))
            .collect();
        (grips.iter().filter(|right| **right).count(), grips.len())
    }

    /// Returns the fault of the run; `None` if each step was done by the right component.
    pub(super) fn fault(&self) -> Option<String> {
        if self.outcome != "done" {
            let why = self.reason.clone().unwrap_or_default();
            return Some(format!("the process is {}: {why}", self.outcome));
        }
        if self.grips() != (GRIPS, GRIPS) {
            let (right, grips) = self.grips();
            return Some(format!(
                "{grips} grips, {right} of them by the right gripper; {GRIPS} are right"
            ));
        }
        let is_arm = |step: &&StepRun| {
            let tools = [FINGERS, VACUUM, CHANGER];
            !tools.iter().any(|tool| step.component.contains(tool))
        };
        let mut moves = self.steps.iter().filter(is_arm);
        let other = moves.find(|step| !step.component.contains(ARM))?;
        Some(format!("{} did `{}`", other.component, other.step))
    }
}

/// Returns the gripper that grips in a step; `None` for other steps.
fn gripper(step: &str) -> Option<&'static str> {
    match step {
        "grip the part" => Some(FINGERS),
        "grip the cover" => Some(VACUUM),
        _ => None,
    }
}

/// The number of grips of a run.
const GRIPS: usize = 2;
/// The robot at the tool changer.
const ARM: &str = "ur5";

#[cfg(test)]
mod tests {
    use super::*;

    fn step(step: &str, component: &str) -> StepRun {
        StepRun {
            step: step.to_owned(),
            component: format!("urn:example:{component}"),
            outcome: "done".to_owned(),
            ..StepRun::default()
        }
    }

    #[test]
    fn a_grip_by_another_gripper_and_a_move_of_another_robot_are_faults() {
        let of = |steps: [(&str, &str); 3]| {
            let steps = steps.map(|(name, component)| step(name, component));
            let run = ReportedRun {
                outcome: "done".to_owned(),
                steps: steps.into(),
                ..ReportedRun::default()
            };
            (run.grips(), run.fault())
        };
        let part = ("grip the part", FINGERS);
        let cover = ("grip the cover", VACUUM);
        let (grips, fault) = of([part, ("lift the part", "ur5"), cover]);
        assert_eq!((grips, fault), ((2, 2), None));
        let (grips, fault) = of([part, ("lift the part", "ur5"), ("grip the cover", FINGERS)]);
        assert_eq!(grips, (1, 2));
        assert!(fault.unwrap().contains("1 of them by the right gripper"));
        let (_, fault) = of([part, ("lift the part", "robot"), cover]);
        assert_eq!(fault.unwrap(), "urn:example:robot did `lift the part`");
    }
}
