//! The report at the end: the outcome, and the delays beside the published delays.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Serialize;

use super::fact::{CanRunAnswer, PlugComponent, Ros, VisibilityLevel};
use super::story::{Grasp, LOST_FROM, PlugStory};
use crate::clock::millis;
use crate::pace::Speed;

/// The outcome, as printed by `--json`. Times are in milliseconds; `null` for events that have not
/// happened.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct PlugReport {
    finished: bool,
    failure: Option<String>,
    speed: f64,
    manifest: String,
    /// By component: time from the start of its process until it is known at a level.
    components: BTreeMap<PlugComponent, BTreeMap<VisibilityLevel, Option<f64>>>,
    /// By node: times from its request.
    grasps: BTreeMap<Ros, GraspTimes>,
    runs: Vec<RunTimes>,
    loss: Loss,
    question: Option<CanRunAnswer>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
struct GraspTimes {
    answered_ms: Option<f64>,
    running_ms: Option<f64>,
    ended_ms: Option<f64>,
    result_ms: Option<f64>,
    states: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct RunTimes {
    outcome: String,
    plans: usize,
    /// Duration of the run, including the time spent waiting.
    lasted_ms: Option<u64>,
    /// The reasons for which plans failed.
    broke: Vec<String>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
struct Loss {
    /// Time from the signal until the gripper is no longer known at a level.
    lost_ms: BTreeMap<VisibilityLevel, Option<f64>>,
    /// Time from the signal to the end of the plan, including the retreat of the robot.
    halted_and_retreated_ms: Option<f64>,
    /// Time from the start of the other gripper's process to the next plan.
    planned_anew_ms: Option<f64>,
}

impl PlugReport {
    pub(crate) fn of(
        story: &PlugStory,
        speed: Speed,
        manifest: &str,
        failure: Option<String>,
    ) -> Self {
        let levels = |part| {
            let level = |level| (level, story.after_start(part, level));
            VisibilityLevel::ALL.into_iter().map(level).collect()
        };
        let runs = story.runs.values().map(|run| RunTimes {
            outcome: run.outcome.clone(),
            plans: run.plans.len(),
            lasted_ms: run.ended_ms.and_then(|end| end.checked_sub(run.started_ms)),
            broke: run
                .plans
                .iter()
                .filter_map(|plan| plan.reason.clone())
                .collect(),
        });
        Self {
            finished: story.finished() && failure.is_none(),
            failure,
            speed: speed.factor(),
            manifest: manifest.to_owned(),
            components: PlugComponent::ALL
                .into_iter()
                .map(|part| (part, levels(part)))
                .collect(),
            grasps: [Ros::Ros1, Ros::Ros2]
                .into_iter()
                .map(|ros| {
                    (
                        ros,
                        story
                            .grasps
                            .get(&ros)
                            .map(GraspTimes::of)
                            .unwrap_or_default(),
                    )
                })
                .collect(),
            runs: runs.collect(),
            loss: Loss {
                lost_ms: LOST_FROM
                    .into_iter()
                    .map(|level| (level, story.after_kill(level)))
                    .collect(),
                halted_and_retreated_ms: story.halted_after(),
                planned_anew_ms: story.planned_anew_after(),
            },
            question: story.asked.clone(),
        }
    }

    /// Returns the table for people.
    pub(crate) fn table(&self) -> String {
        let mut text = String::from("\n");
        row(
            &mut text,
            "delay",
            ["robot", "gripper", "vacuum"],
            "published",
        );
        let known = |level: VisibilityLevel| PlugComponent::ALL.map(|part| self.known(part, level));
        let published = |level| {
            if level == VisibilityLevel::Announced {
                "under 1 s, and 7 s"
            } else {
                "-"
            }
        };
        for level in VisibilityLevel::ALL {
            let label = format!("process start to {}", short(level));
            row(
                &mut text,
                &label,
                known(level).map(shown).each_ref().map(String::as_str),
                published(level),
            );
        }
        let listed = PlugComponent::ALL.map(|part| {
            let announced = self.known(part, VisibilityLevel::Announced)?;
            let registered = self.known(part, VisibilityLevel::Registered)?;
            Some((self.known(part, VisibilityLevel::Listed)? - announced.min(registered)).max(0.0))
        });
        row(
            &mut text,
            "announced to skills listed",
            listed.map(shown).each_ref().map(String::as_str),
            "211, 253, 313 ms",
        );
        for level in LOST_FROM {
            let label = format!("killed to gone from {}", level.gone_from());
            let lost = self.loss.lost_ms.get(&level).copied().flatten();
            row(
                &mut text,
                &label,
                ["", &shown(lost), ""],
                "2 s (client time-out)",
            );
        }
        let halted = shown(self.loss.halted_and_retreated_ms);
        row(
            &mut text,
            "killed to halted and robot away",
            ["", &halted, ""],
            "-",
        );
        let anew = shown(self.loss.planned_anew_ms);
        row(
            &mut text,
            "process start to planned anew",
            ["", "", &anew],
            "-",
        );
        text.push('\n');
        row(&mut text, "grasp started from", ["ROS 1", "ROS 2", ""], "");
        let grasp = |of: fn(&GraspTimes) -> Option<f64>| {
            [Ros::Ros1, Ros::Ros2].map(|ros| shown(self.grasps.get(&ros).and_then(of)))
        };
        for (label, [ros1, ros2]) in [
            ("request to answer", grasp(|times| times.answered_ms)),
            ("request to Running seen", grasp(|times| times.running_ms)),
            ("request to result seen *", grasp(|times| times.result_ms)),
        ] {
            row(&mut text, label, [&ros1, &ros2, ""], "-");
        }
        text.push_str("* with the work of the gripper, divided by the speed\n");
        text
    }

    fn known(&self, part: PlugComponent, level: VisibilityLevel) -> Option<f64> {
        self.components.get(&part)?.get(&level).copied().flatten()
    }
}

impl GraspTimes {
    fn of(grasp: &Grasp) -> Self {
        let after = |at: Option<i64>| Some(millis(at? - grasp.asked_at?));
        let first = |state: &str| {
            let mut states = grasp.states.iter();
            states.find(|(_, known)| known == state).map(|(at, _)| *at)
        };
        let ended = grasp.has_run().then(|| grasp.states.last()).flatten();
        Self {
            answered_ms: after(grasp.answered.as_ref().map(|(at, _)| *at)),
            running_ms: after(first("Running")),
            ended_ms: after(ended.map(|(at, _)| *at)),
            result_ms: after(grasp.result.as_ref().map(|(at, _)| *at)),
            states: grasp
                .states
                .iter()
                .map(|(_, state)| state.clone())
                .collect(),
        }
    }
}

/// Returns a short label of a level.
const fn short(level: VisibilityLevel) -> &'static str {
    match level {
        VisibilityLevel::Announced => "heard by mDNS",
        VisibilityLevel::Registered => "registered",
        VisibilityLevel::Listed => "skills listed",
        VisibilityLevel::InGraph => "in the graph",
        VisibilityLevel::InSpace => "in the space",
        VisibilityLevel::AtServer => "seen by ua-server",
        VisibilityLevel::Ros1 => "in ROS 1",
        VisibilityLevel::Ros2 => "in ROS 2",
    }
}

fn row(text: &mut String, label: &str, cells: [&str; 3], published: &str) {
    let [first, second, third] = cells;
    let line = format!("{label:<40} {first:>9} {second:>9} {third:>9}   {published}");
    // Writing to a String cannot fail.
    let _written = writeln!(text, "{}", line.trim_end());
}

fn shown(ms: Option<f64>) -> String {
    ms.map_or_else(
        || "-".to_owned(),
        |ms| {
            if ms < 1e3 {
                format!("{ms:.0} ms")
            } else {
                format!("{:.2} s", ms / 1e3)
            }
        },
    )
}

#[cfg(test)]
mod tests {
    use super::super::fact::{Fact, NodeEvent};
    use super::*;

    fn story() -> PlugStory {
        let mut story = PlugStory::new();
        let ms = 1_000_000;
        for (at, fact) in [
            (100, Fact::Started(PlugComponent::Gripper)),
            (
                190,
                Fact::Reached(PlugComponent::Gripper, VisibilityLevel::Registered),
            ),
            (
                250,
                Fact::Reached(PlugComponent::Gripper, VisibilityLevel::Announced),
            ),
            (
                330,
                Fact::Reached(PlugComponent::Gripper, VisibilityLevel::Listed),
            ),
            (500, Fact::Node(NodeEvent::Asks { ros: Ros::Ros1 })),
            (
                512,
                Fact::Node(NodeEvent::Answered {
                    ros: Ros::Ros1,
                    success: true,
                    message: String::new(),
                }),
            ),
        ] {
            story.observe(at * ms, &fact);
        }
        story
    }

    #[test]
    fn the_json_has_a_time_for_all_that_happened_and_null_for_the_rest() {
        let speed = Speed::new(4.0).unwrap();
        let report = PlugReport::of(&story(), speed, "a.aml", Some("stuck".to_owned()));
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["finished"], false);
        assert_eq!(json["failure"], "stuck");
        assert_eq!(json["components"]["gripper"]["registered"], 90.0);
        assert!(json["components"]["gripper"]["in_graph"].is_null());
        assert!(json["components"]["robot"]["registered"].is_null());
        assert_eq!(json["grasps"]["ros1"]["answered_ms"], 12.0);
        assert!(json["grasps"]["ros2"]["answered_ms"].is_null());
        assert!(json["loss"]["lost_ms"]["registered"].is_null());
        assert!(json["question"].is_null());
        let keys: Vec<&String> = json.as_object().unwrap().keys().collect();
        let documented = [
            "components",
            "failure",
            "finished",
            "grasps",
            "loss",
            "manifest",
            "question",
            "runs",
            "speed",
        ];
        let mut keys: Vec<&str> = keys.into_iter().map(String::as_str).collect();
        keys.sort_unstable();
        assert_eq!(keys, documented);
    }

    #[test]
    fn skills_are_listed_after_the_first_word_of_the_component() {
        let table = PlugReport::of(&story(), Speed::new(1.0).unwrap(), "a.aml", None).table();
        let line = table
            .lines()
            .find(|line| line.starts_with("announced to skills listed"));
        assert!(line.unwrap().contains("140 ms"), "{table}");
        assert!(line.unwrap().ends_with("211, 253, 313 ms"), "{table}");
    }
}
