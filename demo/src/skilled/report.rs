//! The report of a run of the scenario.

use std::fmt::Write as _;

use serde::Serialize;

use crate::stage::{RobotHops, delays};

/// The report.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct SkilledReport {
    pub(super) finished: bool,
    pub(super) failure: Option<String>,
    pub(super) speed: f64,
    pub(super) covers: u32,
    /// As the machines report it, not their callers.
    pub(super) by_conveyor: u32,
    pub(super) by_turtlebot: u32,
    /// Number of covers that were taken back from the dead conveyor.
    pub(super) taken_back: u32,
    /// Time from the start of the components until the skills of the line were found by their
    /// types.
    pub(super) found_ms: Option<f64>,
    /// Time from the signal that killed the conveyor until the line detected the loss.
    pub(super) told_lost_ms: Option<f64>,
    pub(super) runs: Vec<SkilledRun>,
    /// Delays of the values beside the skills, such as the feedback of an action.
    pub(super) hops: RobotHops,
}

/// A run of a skill.
#[derive(Clone, Debug, Serialize)]
pub(super) struct SkilledRun {
    /// The skill, as `line-handling.PickAndPlace`.
    pub(super) skill: String,
    /// The purpose of the run.
    pub(super) what: String,
    /// Empty after a success.
    pub(super) message: String,
    /// Time from the request of the line to the first action of a machine: the arm grasps, the
    /// conveyor is switched or the robot departs.
    pub(super) acted_ms: Option<f64>,
    /// Time from the request of the line to the outcome.
    pub(super) lasted_ms: f64,
}

impl SkilledReport {
    /// Returns the table for people.
    pub(super) fn table(&self) -> String {
        let mut out = String::from("\n");
        let ms = |ms: Option<f64>| ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0} ms"));
        // Writing to a String cannot fail.
        _ = writeln!(
            out,
            "{:<28} {:<34} {:>12} {:>10}  outcome",
            "skill", "what for", "machine acts", "lasted"
        );
        for run in &self.runs {
            let outcome = match run.message.is_empty() {
                true => "done",
                false => &run.message,
            };
            _ = writeln!(
                out,
                "{:<28} {:<34} {:>12} {:>7.1} ms  {outcome}",
                run.skill,
                run.what,
                run.acted_ms
                    .map_or_else(|| "-".to_owned(), |ms| format!("{ms:.1} ms")),
                run.lasted_ms
            );
        }
        _ = writeln!(
            out,
            "\n{} of {} covers arrived: {} by conveyor, {} by TurtleBot3; {} taken back from the dead conveyor",
            self.by_conveyor + self.by_turtlebot,
            self.covers,
            self.by_conveyor,
            self.by_turtlebot,
            self.taken_back
        );
        _ = writeln!(
            out,
            "all skills found after {}; the death of the conveyor known after {}",
            ms(self.found_ms),
            ms(self.told_lost_ms)
        );
        let RobotHops { pb1, tr0, pb2 } = self.hops;
        out.push('\n');
        out.push_str(&delays(&[
            ("tPB1, in the ROS 1 bridge", pb1, "2 s"),
            ("tTR0, PubSub network", tr0, "-"),
            ("tPB2, in the ROS 2 bridge", pb2, "-"),
        ]));
        out
    }
}
