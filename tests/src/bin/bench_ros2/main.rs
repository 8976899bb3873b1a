//! `cargo xtask bench ros2`: relays of DDS samples compared with a UDP echo, and both bridges
//! between ROS 1 and ROS 2.
//!
//! The DDS ends of every path are Cyclone DDS in C, the ROS 1 and UADP ends blocking sockets
//! without any library. The compared paths take turns, so that all of them see the same machine.

mod bursts;
mod calls;
mod ends;
mod floods;
mod goals;
mod idle;
mod images;
mod joining;
mod many;
mod relays;
mod sealed;
mod through;
mod work;

use std::process::ExitCode;

use system_tests::{Cell, Peer};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if args.first().is_some_and(|arg| arg == "echo") {
        return relays::echo();
    }
    let Some(plan) = Plan::of(&args) else {
        print!("{HELP}");
        return ExitCode::from(64);
    };
    if plan.help {
        print!("{HELP}");
        return ExitCode::SUCCESS;
    }
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2, Peer::FastDds, Peer::CycloneC]) else {
        return ExitCode::FAILURE;
    };
    if plan.has("round-trip") || plan.has("throughput") {
        relays::measure(&cell, &plan);
    }
    if plan.has("joining") {
        joining::measure(&cell, plan.turns);
    }
    if plan.has("idle") {
        idle::measure(&cell, plan.seconds);
    }
    if plan.has("many") {
        many::measure(&cell, plan.seconds);
    }
    if [
        "through", "sealed", "bursts", "floods", "calls", "goals", "work", "images",
    ]
    .iter()
    .any(|part| plan.has(part))
    {
        let _core = cell.roscore();
        if plan.has("through") {
            through::measure(&cell, plan.seconds);
        }
        if plan.has("sealed") {
            sealed::measure(&cell, plan.seconds);
        }
        if plan.has("bursts") {
            bursts::measure(&cell, plan.turns);
        }
        if plan.has("work") {
            work::measure(&cell, plan.seconds);
        }
        if plan.has("images") {
            images::measure(&cell, plan.seconds.min(IMAGES), plan.in_memory);
        }
        if plan.has("calls") {
            calls::measure(&cell, plan.calls);
        }
        if plan.has("goals") {
            goals::measure(&cell, plan.calls / 4);
        }
        if plan.has("floods") {
            floods::measure(&cell, plan.turns.min(FLOODS));
        }
    }
    ExitCode::SUCCESS
}

/// The benchmarks to run and their sizes.
struct Plan {
    help: bool,
    /// The parts to run; all parts if empty.
    parts: Vec<String>,
    /// Messages of each size, one at a time, through each relay; a tenth of this number for large
    /// samples.
    messages: u64,
    /// Messages through a relay before the next relay's turn.
    turn: u64,
    /// Seconds at 1 kHz, and seconds of idling.
    seconds: u64,
    /// Repetitions of events that happen a few times only.
    turns: u64,
    /// Calls of a service, one at a time and many at a time.
    calls: u64,
    /// Whether images cross the space in shared memory, which the programs must be built with.
    in_memory: bool,
}

impl Plan {
    /// Returns the plan, or `None` if the arguments are invalid.
    fn of(args: &[String]) -> Option<Self> {
        let mut plan = Self {
            help: false,
            parts: Vec::new(),
            messages: 5000,
            turn: 50,
            seconds: 20,
            turns: 20,
            calls: 2000,
            in_memory: false,
        };
        let mut args = args.iter();
        while let Some(arg) = args.next() {
            match arg.as_str() {
                "--help" | "-h" => plan.help = true,
                "--shm" => plan.in_memory = true,
                "--quick" => {
                    plan = Self {
                        messages: 500,
                        seconds: 2,
                        turns: 3,
                        calls: 200,
                        ..plan
                    }
                }
                "--turn" => plan.turn = args.next()?.parse().ok().filter(|turn| *turn > 0)?,
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
}

/// Each flood takes seconds.
const FLOODS: u64 = 3;
/// The most seconds of each load of images: there are 28 of them.
const IMAGES: u64 = 10;
const PARTS: [&str; 13] = [
    "round-trip",
    "throughput",
    "joining",
    "idle",
    "many",
    "through",
    "sealed",
    "bursts",
    "floods",
    "calls",
    "goals",
    "work",
    "images",
];

const HELP: &str = "\
bench-ros2 [--quick] [--seconds N] [--turn N] [PART..]

  --quick      a trial of a minute; its figures are no measurement
  --seconds N  how long each path gets messages at 1 kHz, 20 unless told
  --shm        images cross the space in shared memory; the bridges need the feature `shm`
  --turn N     samples through one relay before the next has its turn, 50 unless told
  PART         round-trip, throughput, joining, idle, many, through, sealed, bursts, floods, calls, goals, work, images; all unless told
";
