//! The delays measured by the bridges, and their table.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use super::pages::{PageError, fetch};

/// The part of a bridge's status page with the delays per hop, by the names of the bridge: `out`,
/// `origin`, `network`, `in`.
#[derive(Debug, Default, Deserialize)]
pub(crate) struct BridgeStatus {
    pub(crate) hops: BTreeMap<String, BridgeHop>,
}

/// The delays of a hop, as measured by a bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct BridgeHop {
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    pub(crate) max_us: f64,
    pub(crate) count: u64,
}

/// The hops of the paper between robots of ROS 1 and ROS 2. `None` if a bridge did not respond.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(crate) struct RobotHops {
    /// In the ROS 1 bridge.
    #[serde(rename = "tPB1")]
    pub(crate) pb1: Option<BridgeHop>,
    /// On the PubSub network.
    #[serde(rename = "tTR0")]
    pub(crate) tr0: Option<BridgeHop>,
    /// In the ROS 2 bridge.
    #[serde(rename = "tPB2")]
    pub(crate) pb2: Option<BridgeHop>,
}

impl RobotHops {
    /// Reads the status pages of both bridges. Returns the hops and the errors, as text for people.
    pub(crate) async fn ask([ros1, ros2]: [u16; 2]) -> (Self, Vec<String>) {
        let (ros1, ros2) = tokio::join!(fetch::<BridgeStatus>(ros1), fetch::<BridgeStatus>(ros2));
        let (mut hops, mut missing) = (Self::default(), Vec::new());
        let mut no_figures = |bridge: &str, error: PageError| {
            missing.push(format!("{bridge} gives no figures: {error}"));
        };
        match ros1 {
            Ok(status) => hops.pb1 = status.hops.get("out").copied(),
            Err(error) => no_figures("bridge-ros1", error),
        }
        match ros2 {
            Ok(status) => {
                hops.tr0 = status.hops.get("network").copied();
                hops.pb2 = status.hops.get("in").copied();
            }
            Err(error) => no_figures("bridge-ros2", error),
        }
        (hops, missing)
    }
}

impl BridgeHop {
    /// Calculates the statistics of delays in nanoseconds; `None` if there are no delays.
    pub(crate) fn of(nanos: &[i64]) -> Option<Self> {
        let mut sorted = nanos.to_vec();
        sorted.sort_unstable();
        // The smallest delay that at least `percent` of all delays do not exceed.
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

/// Formats a table of delays: label, measured values and the value of the paper.
pub(crate) fn delays(rows: &[(&str, Option<BridgeHop>, &str)]) -> String {
    let mut text = String::new();
    row(&mut text, "delay", ["p50", "p99", "max", "count"], "paper");
    for (label, hop, paper) in rows {
        let cells = hop.map_or_else(
            || ["-", "-", "-", "0"].map(str::to_owned),
            |hop| {
                let [p50, p99, max] = [hop.p50_us, hop.p99_us, hop.max_us].map(duration);
                [p50, p99, max, hop.count.to_string()]
            },
        );
        row(
            &mut text,
            label,
            cells.each_ref().map(String::as_str),
            paper,
        );
    }
    text
}

fn row(text: &mut String, label: &str, cells: [&str; 4], paper: &str) {
    let [p50, p99, max, count] = cells;
    // Writing to a String cannot fail.
    let _written = writeln!(
        text,
        "{label:<36} {p50:>9} {p99:>9} {max:>9} {count:>6}   {paper}"
    );
}

pub(crate) fn micros(nanos: i64) -> f64 {
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

    #[test]
    fn quantiles_of_a_few_delays_are_delays_that_were_measured() {
        let hop = BridgeHop::of(&[3000, 1000, 2000, 9000]).unwrap();
        assert_eq!(
            (hop.p50_us, hop.p99_us, hop.max_us, hop.count),
            (2.0, 9.0, 9.0, 4)
        );
        assert_eq!(BridgeHop::of(&[]), None);
    }

    #[test]
    fn durations_are_in_the_unit_people_read() {
        assert_eq!(duration(41.4), "41 us");
        assert_eq!(duration(1234.0), "1.23 ms");
        assert_eq!(duration(2_040_000.0), "2.04 s");
    }
}
