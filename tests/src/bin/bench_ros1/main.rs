//! `cargo xtask bench ros1`: relays of ROS 1 messages compared with a raw TCP echo, and
//! `bridge-ros1` under many topics.
//!
//! A single process plays both ends of every path, with blocking sockets. The compared paths take
//! turns, so that all of them see the same machine. The echo is a program that reads whole frames
//! from a TCP connection and writes each to another with blocking calls: the minimum work of a
//! relay.

mod bridge;
mod bursts;
mod lane;
mod open_loop;
mod path;
mod round_trip;
mod topics;

use std::process::ExitCode;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use system_tests::{Cell, Peer};

use crate::path::RelayPath;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["echo"] => return path::echo(),
        ["echo", lanes] => {
            allow_open_files();
            return path::echo_many(lanes.parse().unwrap());
        }
        _ => {}
    }
    let Some(plan) = Plan::of(&args) else {
        print!("{HELP}");
        return ExitCode::from(64);
    };
    if plan.help {
        print!("{HELP}");
        return ExitCode::SUCCESS;
    }
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return ExitCode::FAILURE;
    };
    allow_open_files();
    let _core = cell.roscore();
    if plan.relays() {
        let mut paths = RelayPath::all(&cell);
        if plan.has("round-trip") {
            round_trip::measure(&mut paths, plan.messages);
        }
        if plan.has("open-loop") {
            open_loop::measure(&mut paths, plan.seconds);
        }
        if plan.has("bursts") {
            bursts::measure(&mut paths, plan.bursts);
        }
    }
    if plan.has("bridge") {
        bridge::measure(&cell, plan.bridge_seconds);
    }
    if plan.has("topics") {
        topics::measure(&cell, plan.blocks);
    }
    ExitCode::SUCCESS
}

/// The benchmarks to run and their sizes.
struct Plan {
    help: bool,
    /// The parts to run; all parts if empty.
    parts: Vec<String>,
    /// Messages of each size, one at a time, through each path.
    messages: u64,
    /// Seconds of open loop through each path.
    seconds: u64,
    bursts: u64,
    bridge_seconds: u64,
    /// Turns of each relay with many topics.
    blocks: usize,
}

impl Plan {
    /// Returns the plan, or `None` if the arguments are invalid.
    fn of(args: &[String]) -> Option<Self> {
        let mut plan = Self {
            help: false,
            parts: Vec::new(),
            messages: 10_000,
            seconds: 60,
            bursts: 20,
            bridge_seconds: 10,
            blocks: 40,
        };
        let mut args = args.iter();
        while let Some(arg) = args.next() {
            match arg.as_str() {
                "--help" | "-h" => plan.help = true,
                "--quick" => {
                    plan = Self {
                        messages: 500,
                        seconds: 2,
                        bursts: 4,
                        bridge_seconds: 2,
                        blocks: 4,
                        ..plan
                    }
                }
                "--seconds" => plan.seconds = args.next()?.parse().ok()?,
                part if PARTS.contains(&part) => plan.parts.push(part.to_owned()),
                _ => return None,
            }
        }
        Some(plan)
    }

    fn has(&self, part: &str) -> bool {
        self.parts.is_empty() || self.parts.iter().any(|wanted| wanted == part)
    }

    fn relays(&self) -> bool {
        ["round-trip", "open-loop", "bursts"]
            .into_iter()
            .any(|part| self.has(part))
    }
}

/// Raises the limit of open files: a thousand topics in and out are 2000 connections, here and in a
/// relay, and many systems allow a process 1024.
fn allow_open_files() {
    let maximum = getrlimit(Resource::Nofile).maximum;
    let current = maximum;
    setrlimit(Resource::Nofile, Rlimit { current, maximum }).unwrap();
}

const PARTS: [&str; 5] = ["round-trip", "open-loop", "bursts", "bridge", "topics"];

const HELP: &str = "\
bench-ros1 [--quick] [--seconds N] [PART..]

  --quick      a trial of under a minute; its figures are no measurement
  --seconds N  how long each relay gets messages at 1 kHz, 60 unless told
  PART         round-trip, open-loop, bursts, bridge, topics; all unless told
";
