//! 1 KiB a thousand times a second, whether the last message has arrived or not, as a sensor sends.

use std::time::Duration;

use crate::path::RelayPath;
use system_tests::{Times, per_message};

pub(crate) fn measure(paths: &mut [RelayPath], seconds: u64) {
    println!(
        "\n1 KiB at 1 kHz, {seconds} s for each path, in turns of {} s; microseconds:\n",
        TURN.min(seconds)
    );
    let mut all: Vec<(Times, u64, Duration)> = paths.iter().map(|_| Default::default()).collect();
    let mut left = seconds;
    while left > 0 {
        let turn = left.min(TURN);
        left -= turn;
        for (path, (times, sent, used)) in paths.iter_mut().zip(&mut all) {
            let before = path.processor_time();
            let count = turn * 1000;
            times.extend(path.lane.stream(count, 1024, Some(PERIOD)));
            *sent += count;
            *used += path.processor_time() - before;
        }
    }
    println!("| path | sent | lost | p50 | p99 | CPU per message |");
    println!("|---|---|---|---|---|---|");
    for (path, (times, sent, used)) in paths.iter().zip(&mut all) {
        println!(
            "| {} | {sent} | {} | {:.1} | {:.1} | {:.1} |",
            path.name,
            *sent - times.count(),
            times.at(0.5),
            times.at(0.99),
            per_message(*used, *sent)
        );
    }
}

/// Seconds of a turn, so that all paths see the same machine and not the messages of other paths.
const TURN: u64 = 10;
const PERIOD: Duration = Duration::from_millis(1);
