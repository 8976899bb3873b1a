//! From the start of a program to the first sample that it relays.

use std::time::{Duration, Instant};

use system_tests::{Cell, Child, Times};

use crate::ends::{LIMIT, START, count};

pub(crate) fn measure(cell: &Cell, turns: u64) {
    println!(
        "\nFrom a relay's start until the first sample is back, its peer a Cyclone DDS that was there before, {turns} times; milliseconds:\n"
    );
    println!("| relay | p50 | longest |");
    println!("|---|---|---|");
    let mut all: Vec<(&str, Times)> = RELAYS.map(|name| (name, Times::default())).into();
    for turn in 0..turns {
        for (name, times) in &mut all {
            times.add(first_back(cell, name, turn));
        }
    }
    for (name, mut times) in all {
        println!(
            "| {name} | {:.0} | {:.0} |",
            times.at(0.5) / 1e3,
            times.at(1.0) / 1e3
        );
    }
}

fn first_back(cell: &Cell, relay: &str, turn: u64) -> Duration {
    let from = format!("/join_{turn}");
    let to = format!("/joined_{turn}");
    let mut pinger = cell.cyclone_c(&["ping", &from, &to, "--limit", LIMIT, "--patience", "0.005"]);
    let start = Instant::now();
    let _relay = start_relay(cell, relay, &from, &to);
    loop {
        if count(&pinger.ask("0 1 40 1", START), "lost") == 0 {
            return start.elapsed();
        }
        assert!(start.elapsed() < START, "{relay} repeats nothing");
    }
}

fn start_relay(cell: &Cell, relay: &str, from: &str, to: &str) -> Child {
    match relay {
        CYCLONE => cell.cyclone_c_started(&["relay", from, to]).start(),
        FAST_DDS => cell
            .fastdds_started(&["relay", from, to, "--interface", "127.0.0.1"])
            .start(),
        _ => cell.ros2_relay_started(from, to).start(),
    }
}

const CYCLONE: &str = "Cyclone DDS (C)";
const FAST_DDS: &str = "Fast DDS";
const RELAYS: [&str; 3] = [CYCLONE, "bridge-ros2's reader and writer", FAST_DDS];
