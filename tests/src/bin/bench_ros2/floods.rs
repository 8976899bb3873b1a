//! Higher rates than both bridges can carry.

use std::collections::BTreeMap;
use std::time::Duration;

use system_tests::{
    Cell, METRICS_ROS1, METRICS_ROS2, drops, drops_by_reason, metrics, now, number,
};

use crate::ends::{SILENCE_MS, SendingPace};
use crate::through::{NAMES, Ways};

pub(crate) fn measure(cell: &Cell, floods: u64) {
    let mut ways = Ways::stand(cell, WAITING);
    println!("\nMessages of 1 KiB, `drop_oldest: {WAITING}`, each rate {floods} times:\n");
    println!(
        "| way | offered | sent | lost | of these dropped by the bridges | taken/s | p50, ms | longest, ms |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for way in [1, 2] {
        flood(&mut ways, way, floods);
    }
}

fn flood(ways: &mut Ways, way: usize, floods: u64) {
    for (shown, ticks, rate) in RATES {
        for _ in 0..floods {
            let pace = SendingPace {
                ticks,
                size: 1024,
                period: rate.map_or(Duration::ZERO, |rate| Duration::from_secs(1) / rate),
                burst: 0,
                pause: Duration::ZERO,
            };
            let before = bridges_reasons();
            let start = now();
            let mut report = ways.send(way, pace);
            let mut took = now().saturating_sub(start);
            if report.distinct < ticks {
                // `took` includes the silence at the end, in which missing samples were awaited.
                took = took.saturating_sub(Duration::from_millis(SILENCE_MS));
            }
            #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
            let taken = report.distinct as f64 / took.as_secs_f64();
            println!(
                "| {} | {shown} | {ticks} | {} | {} | {taken:.0} | {:.1} | {:.1} |",
                NAMES[way],
                ticks - report.distinct,
                increase(&before, &bridges_reasons()),
                report.times.at(0.5) / 1000.0,
                report.times.at(1.0) / 1000.0
            );
        }
    }
}

/// Returns the number of samples that both bridges have dropped.
pub(crate) fn bridges_dropped() -> u64 {
    let bridges = [METRICS_ROS1, METRICS_ROS2];
    let statuses = bridges.into_iter().filter_map(metrics);
    statuses.map(|status| drops(&status)).sum()
}

/// Returns the number of samples that both bridges have dropped, by reason, or have missed by their
/// sequence numbers.
fn bridges_reasons() -> BTreeMap<String, u64> {
    let mut sums = BTreeMap::new();
    for status in [METRICS_ROS1, METRICS_ROS2].into_iter().filter_map(metrics) {
        for (reason, count) in drops_by_reason(&status) {
            *sums.entry(reason).or_default() += count;
        }
        *sums.entry("missing".to_owned()).or_default() += number(&status, "missing");
    }
    sums
}

/// Returns the increases of counters as a text, the largest first.
fn increase(before: &BTreeMap<String, u64>, after: &BTreeMap<String, u64>) -> String {
    let mut increases: Vec<(u64, &str)> = after
        .iter()
        .map(|(reason, count)| {
            let former = before.get(reason).copied().unwrap_or_default();
            (count.saturating_sub(former), reason.as_str())
        })
        .filter(|(count, _)| *count > 0)
        .collect();
    if increases.is_empty() {
        return "0".to_owned();
    }
    increases.sort_unstable_by(|one, other| other.cmp(one));
    let texts: Vec<String> = increases
        .iter()
        .map(|(count, reason)| format!("{count} {reason}"))
        .collect();
    texts.join(", ")
}

const WAITING: u32 = 10_000;
const RATES: [(&str, u64, Option<u32>); 4] = [
    ("10 k/s", 20_000, Some(10_000)),
    ("20 k/s", 40_000, Some(20_000)),
    ("40 k/s", 60_000, Some(40_000)),
    ("as fast as one can", 100_000, None),
];
