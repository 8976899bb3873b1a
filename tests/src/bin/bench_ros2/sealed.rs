//! The cost of signing and encryption: the whole way through both bridges in a secured group,
//! compared with an open group.

use std::process::Command;
use std::time::Duration;

use system_tests::{Cell, per_message, program};

use crate::ends::{MeterReport, SendingPace};
use crate::through::{NAMES, WAITING, Ways};

pub(crate) fn measure(cell: &Cell, seconds: u64) {
    let keys = cell.folder().join("bench.keys");
    let made = Command::new(program("ua-space"))
        .arg("keys")
        .arg(&keys)
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&made.stderr);
    assert!(made.status.success(), "{told}");
    println!(
        "\n1 kHz through bridges whose group is open, signed, or signed and encrypted, {seconds} s for each way, in turns of {TURN} s, \
         for each of which the bridges are started again; microseconds:\n"
    );
    println!(
        "| payload | way | group | sent | lost | p50 | p99 | p50 / open | CPU of both bridges per message | CPU / open |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let mut all: [[[Sum; SIZES.len()]; 2]; GROUPS.len()] = Default::default();
    let mut left = seconds;
    while left > 0 {
        let turn = left.min(TURN);
        left -= turn;
        for ((_, security), ways) in GROUPS.iter().zip(&mut all) {
            let mut stood = Ways::secured(cell, WAITING, security);
            for (way, sizes) in ways.iter_mut().enumerate() {
                for ((size, _), sum) in SIZES.iter().zip(sizes) {
                    let pace = SendingPace::kilohertz(turn, *size);
                    let before = stood.used(way + 1);
                    sum.sent += pace.ticks;
                    sum.report.extend(stood.send(way + 1, pace));
                    sum.used += stood.used(way + 1) - before;
                }
            }
        }
    }
    for (place, (_, shown)) in SIZES.iter().enumerate() {
        for way in 0..2 {
            let rows = all.iter_mut().map(|ways| &mut ways[way][place]);
            rows_of((shown, NAMES[way + 1]), rows);
        }
    }
}

/// Prints the rows of all groups, the open group first.
fn rows_of<'a>((size, way): (&str, &str), sums: impl Iterator<Item = &'a mut Sum>) {
    let mut open = None;
    for ((group, _), sum) in GROUPS.iter().zip(sums) {
        let p50 = sum.report.times.at(0.5);
        let used = per_message(sum.used, sum.sent);
        let (open_p50, open_used) = *open.get_or_insert((p50, used));
        println!(
            "| {size} | {way} | {group} | {} | {} | {p50:.1} | {:.1} | {:.2} | {used:.1} | {:.2} |",
            sum.sent,
            sum.sent - sum.report.distinct,
            sum.report.times.at(0.99),
            p50 / open_p50,
            used / open_used
        );
    }
}

#[derive(Default)]
struct Sum {
    report: MeterReport,
    sent: u64,
    used: Duration,
}

/// The groups, each with the additions to its mapping.
const GROUPS: [(&str, &str); 3] = [
    ("open", ""),
    (
        "signed",
        "security: [{group: bench, mode: sign, keys: {file: bench.keys}}]\n",
    ),
    (
        "signed and encrypted",
        "security: [{group: bench, keys: {file: bench.keys}}]\n",
    ),
];
const SIZES: [(usize, &str); 2] = [(64, "64 B"), (1024, "1 KiB")];
/// Seconds of a turn.
const TURN: u64 = 5;
