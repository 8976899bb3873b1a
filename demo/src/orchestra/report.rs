//! The report at the end: the outcome, and the delays beside the published delays.

use serde::Serialize;

use super::story::LineStory;
use crate::stage::{BridgeHop, RobotHops, delays, micros};

/// The outcome, as printed by `--json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct OrchestraReport {
    covers: u32,
    delivered: u32,
    by_conveyor: u32,
    by_turtlebot: u32,
    /// In seconds of the scenario; `null` if it was not switched off before the last cover arrived.
    conveyor_off_at_s: Option<f64>,
    finished: bool,
    hops: RobotHops,
    /// Duration of each call of the switch, from the client's call to its response.
    switch_answered_us: Vec<f64>,
    /// `null` if the conveyor was not switched off, or was not running at that time.
    server_saw_conveyor_off_after_us: Option<f64>,
}

impl OrchestraReport {
    pub(crate) fn of(story: &LineStory, hops: RobotHops) -> Self {
        Self {
            covers: story.covers(),
            delivered: story.delivered(),
            by_conveyor: story.by_conveyor(),
            by_turtlebot: story.by_turtlebot(),
            conveyor_off_at_s: story.conveyor_off_at().map(|s| (s * 1e3).round() / 1e3),
            finished: story.finished(),
            hops,
            switch_answered_us: story
                .switch_answered_after()
                .iter()
                .copied()
                .map(micros)
                .collect(),
            server_saw_conveyor_off_after_us: story.server_saw_off_after().map(micros),
        }
    }

    /// Returns the table for people.
    pub(crate) fn table(&self, story: &LineStory) -> String {
        let mut text = format!(
            "\n{} of {} covers arrived: {} by conveyor, {} by TurtleBot3\n\n",
            self.delivered, self.covers, self.by_conveyor, self.by_turtlebot
        );
        let saw_off: Vec<i64> = story.server_saw_off_after().into_iter().collect();
        let rows = [
            ("tPB1, in the ROS 1 bridge", self.hops.pb1, "2 s"),
            ("tTR0, PubSub network", self.hops.tr0, "-"),
            ("tPB2, in the ROS 2 bridge", self.hops.pb2, "-"),
            (
                "Conveyor.Switch called to answered",
                BridgeHop::of(story.switch_answered_after()),
                "-",
            ),
            (
                "conveyor off at Niryo Ned to server",
                BridgeHop::of(&saw_off),
                "2 s",
            ),
            (
                "cover placed to counter at server",
                BridgeHop::of(&story.place_to_counter()),
                "4 s",
            ),
            (
                "placed on TurtleBot3 to it moves *",
                BridgeHop::of(&story.place_to_move()),
                "about 10 s",
            ),
        ];
        text.push_str(&delays(&rows));
        text.push_str("* with TurtleBot3's own 2 s of loading, divided by the speed\n");
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pace::Speed;

    #[test]
    fn the_json_has_the_names_people_were_told() {
        let story = LineStory::new(4, Speed::new(1.0).unwrap());
        let hop = BridgeHop {
            p50_us: 41.0,
            p99_us: 99.5,
            max_us: 120.0,
            count: 7,
        };
        let hops = RobotHops {
            pb1: Some(hop),
            tr0: None,
            pb2: None,
        };
        assert_eq!(
            serde_json::to_string(&OrchestraReport::of(&story, hops)).unwrap(),
            r#"{"covers":4,"delivered":0,"by_conveyor":0,"by_turtlebot":0,"conveyor_off_at_s":null,"finished":false,"hops":{"tPB1":{"p50_us":41.0,"p99_us":99.5,"max_us":120.0,"count":7},"tTR0":null,"tPB2":null},"switch_answered_us":[],"server_saw_conveyor_off_after_us":null}"#
        );
    }
}
