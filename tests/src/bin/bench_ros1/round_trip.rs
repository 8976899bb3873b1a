//! Messages one at a time through every path, the paths in turn.

use std::time::Duration;

use system_tests::{Times, per_message, string_frame};

use crate::lane::DIGITS;
use crate::path::RelayPath;

pub(crate) fn measure(paths: &mut [RelayPath], messages: u64) {
    println!("\nRound trip, one message at a time, {messages} per size and path; microseconds:\n");
    println!("| payload | path | p50 | p99 | p50 / echo | CPU per message |");
    println!("|---|---|---|---|---|---|");
    for (size, shown) in [(16, "16 B"), (1024, "1 KiB"), (100 * 1024, "100 KiB")] {
        pass(paths, size, messages / 10);
        let before: Vec<Duration> = paths.iter().map(RelayPath::processor_time).collect();
        let mut times = pass(paths, size, messages);
        let mut echo = None;
        for ((path, times), before) in paths.iter().zip(&mut times).zip(before) {
            let cost = per_message(path.processor_time() - before, messages);
            let (p50, p99) = (times.at(0.5), times.at(0.99));
            let ratio = p50 / *echo.get_or_insert(p50);
            println!(
                "| {shown} | {} | {p50:.1} | {p99:.1} | {ratio:.2} | {cost:.1} |",
                path.name
            );
        }
    }
}

/// The first messages of a turn are not timed: the previous path may still be working, because
/// threads continue after a message.
fn pass(paths: &mut [RelayPath], size: usize, messages: u64) -> Vec<Times> {
    let padding = " ".repeat(size - DIGITS);
    let mut all: Vec<Times> = paths.iter().map(|_| Times::default()).collect();
    for turn in (0..messages).step_by(TURN) {
        for (path, times) in paths.iter_mut().zip(&mut all) {
            for number in turn..messages.min(turn + TURN as u64) {
                let frame = string_frame(&format!("{padding}{number:0DIGITS$}"));
                let time = path.lane.pass(&frame);
                if number >= turn + UNTIMED {
                    times.add(time);
                }
            }
        }
    }
    all
}

/// Messages through a path before the next path's turn.
const TURN: usize = 50;
const UNTIMED: u64 = 10;
