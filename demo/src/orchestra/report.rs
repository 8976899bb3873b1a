//! What is printed at the end: the outcome, and the delays beside those of the paper.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use super::story::Story;

/// Of a bridge's status page, the delays per hop by its own names: `out`, `origin`, `network`, `in`.
#[derive(Debug, Default, Deserialize)]
pub(crate) struct Status {
    pub(crate) hops: BTreeMap<String, Hop>,
}

/// The delays of one hop as the bridges give them out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Hop {
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    pub(crate) max_us: f64,
    pub(crate) count: u64,
}

/// The hops of the paper that lie between the robots. `None` where a bridge did not answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Hops {
    /// In the ROS 1 bridge.
    #[serde(rename = "tPB1")]
    pub(crate) pb1: Option<Hop>,
    /// On the PubSub network.
    #[serde(rename = "tTR0")]
    pub(crate) tr0: Option<Hop>,
    /// In the ROS 2 bridge.
    #[serde(rename = "tPB2")]
    pub(crate) pb2: Option<Hop>,
}

/// The outcome, as `--json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Report {
    covers: u32,
    delivered: u32,
    by_conveyor: u32,
    by_turtlebot: u32,
    /// In seconds of the story; `null` when it was not switched off before the last cover arrived.
    conveyor_off_at_s: Option<f64>,
    finished: bool,
    hops: Hops,
    /// Of each call of the switch, from the client's call to its answer.
    switch_answered_us: Vec<f64>,
    /// `null` when the conveyor was not running when it was switched off, or was not switched off.
    server_saw_conveyor_off_after_us: Option<f64>,
}

impl Report {
    pub(crate) fn of(story: &Story, hops: Hops) -> Self {
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

    /// The table for people.
    pub(crate) fn table(&self, story: &Story) -> String {
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
                Hop::of(story.switch_answered_after()),
                "-",
            ),
            (
                "conveyor off at Niryo Ned to server",
                Hop::of(&saw_off),
                "2 s",
            ),
            (
                "cover placed to counter at server",
                Hop::of(&story.place_to_counter()),
                "4 s",
            ),
            (
                "placed on TurtleBot3 to it moves *",
                Hop::of(&story.place_to_move()),
                "about 10 s",
            ),
        ];
        row(&mut text, "delay", ["p50", "p99", "max", "count"], "paper");
        for (label, hop, paper) in rows {
            let cells = hop.map_or_else(
                || ["-", "-", "-", "0"].map(str::to_owned),
                |hop| {
                    let count = hop.count.to_string();
                    [
                        duration(hop.p50_us),
                        duration(hop.p99_us),
                        duration(hop.max_us),
                        count,
                    ]
                },
            );
            row(
                &mut text,
                label,
                cells.each_ref().map(String::as_str),
                paper,
            );
        }
        text.push_str("* with TurtleBot3's own 2 s of loading, divided by the speed\n");
        text
    }
}

impl Hop {
    /// Over a few delays in nanoseconds; `None` when there are none.
    fn of(nanos: &[i64]) -> Option<Self> {
        let mut sorted = nanos.to_vec();
        sorted.sort_unstable();
        // The smallest delay that `percent` of all do not exceed.
        let quantile = |percent: usize| {
            let rank = (sorted.len() * percent).div_ceil(100);
            sorted.get(rank.saturating_sub(1)).copied().map(micros)
        };
        Some(Self {
            p50_us: quantile(50)?,
            p99_us: quantile(99)?,
            max_us: quantile(100)?,
            count: u64::try_from(sorted.len()).ok()?,
        })
    }
}

fn row(text: &mut String, label: &str, cells: [&str; 4], paper: &str) {
    let [p50, p99, max, count] = cells;
    // Writing to a string does not fail.
    let _written = writeln!(
        text,
        "{label:<36} {p50:>9} {p99:>9} {max:>9} {count:>6}   {paper}"
    );
}

fn micros(nanos: i64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "delays are far below 2^53 ns")]
    let nanos = nanos as f64;
    nanos / 1e3
}

fn duration(micros: f64) -> String {
    if micros < 1e3 {
        format!("{micros:.0} us")
    } else if micros < 1e6 {
        format!("{:.2} ms", micros / 1e3)
    } else {
        format!("{:.2} s", micros / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pace::Speed;

    #[test]
    fn the_json_has_the_names_people_were_told() {
        let story = Story::new(4, Speed::new(1.0).unwrap());
        let hop = Hop {
            p50_us: 41.0,
            p99_us: 99.5,
            max_us: 120.0,
            count: 7,
        };
        let hops = Hops {
            pb1: Some(hop),
            tr0: None,
            pb2: None,
        };
        assert_eq!(
            serde_json::to_string(&Report::of(&story, hops)).unwrap(),
            r#"{"covers":4,"delivered":0,"by_conveyor":0,"by_turtlebot":0,"conveyor_off_at_s":null,"finished":false,"hops":{"tPB1":{"p50_us":41.0,"p99_us":99.5,"max_us":120.0,"count":7},"tTR0":null,"tPB2":null},"switch_answered_us":[],"server_saw_conveyor_off_after_us":null}"#
        );
    }

    #[test]
    fn quantiles_of_a_few_delays_are_delays_that_were_measured() {
        let hop = Hop::of(&[3000, 1000, 2000, 9000]).unwrap();
        assert_eq!(
            (hop.p50_us, hop.p99_us, hop.max_us, hop.count),
            (2.0, 9.0, 9.0, 4)
        );
        assert_eq!(Hop::of(&[]), None);
    }

    #[test]
    fn durations_are_in_the_unit_people_read() {
        assert_eq!(duration(41.4), "41 us");
        assert_eq!(duration(1234.0), "1.23 ms");
        assert_eq!(duration(2_040_000.0), "2.04 s");
    }
}
