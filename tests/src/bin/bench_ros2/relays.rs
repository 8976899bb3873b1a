//! Round trips of samples through relays on three DDS implementations, and of datagrams through an
//! echo.

use std::net::UdpSocket;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use system_tests::{Cell, Child, StartedChild, Times, per_message, processor_time};

use crate::Plan;
use crate::ends::{LIMIT, PATIENCE, START, count, times};

pub(crate) fn measure(cell: &Cell, plan: &Plan) {
    let mut paths = [
        Path::echo(),
        Path::relay(0, "Cyclone DDS (C)", |from, to| {
            cell.cyclone_c(&["relay", from, to, "--limit", LIMIT])
        }),
        Path::relay(1, "bridge-ros2's reader and writer", |from, to| {
            cell.ros2_relay_started(from, to).start().ready(START)
        }),
        Path::relay(2, "Fast DDS", |from, to| {
            let interface = ["--interface", "127.0.0.1", "--limit", LIMIT];
            cell.fastdds(&[&["relay", from, to], &interface[..]].concat())
        }),
    ];
    let mut pinger = Pinger::start(cell);
    for path in &paths {
        path.begin(&mut pinger);
    }
    if plan.has("round-trip") {
        round_trip(&mut paths, &mut pinger, plan);
    }
    if plan.has("throughput") {
        throughput(&mut paths, &mut pinger, plan);
    }
}

fn round_trip(paths: &mut [Path], pinger: &mut Pinger, plan: &Plan) {
    println!(
        "\nThere and back, one sample at a time, the relays in turns of {}; microseconds:\n",
        plan.turn
    );
    println!(
        "| payload | relay | samples | lost | p50 | p99 | p50 / Cyclone | CPU of the relay per sample |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (size, shown) in SIZES {
        let messages = if size > LARGE {
            plan.messages / 10
        } else {
            plan.messages
        };
        let load = Load {
            samples: messages / 10,
            size,
            window: 1,
        };
        pass(paths, pinger, plan.turn, load);
        let samples = messages;
        let passed = pass(paths, pinger, plan.turn, Load { samples, ..load });
        print(shown, paths, passed);
    }
}

fn throughput(paths: &mut [Path], pinger: &mut Pinger, plan: &Plan) {
    println!(
        "\nWith a window of 32 samples on the way (2 of 1 MiB), in turns of {}:\n",
        plan.turn * 20
    );
    println!(
        "| payload | relay | samples | lost | samples/s | p99, us | CPU of the relay per sample, us |"
    );
    println!("|---|---|---|---|---|---|---|");
    for (size, shown) in SIZES {
        let (samples, window) = if size > LARGE {
            (plan.messages / 10, 2)
        } else {
            (plan.messages * 4, 32)
        };
        let load = Load {
            samples,
            size,
            window,
        };
        let passed = pass(paths, pinger, plan.turn, load);
        for (path, passed) in paths.iter().zip(passed) {
            let Some(mut passed) = passed else { continue };
            let count = passed.times.count();
            println!(
                "| {shown} | {} | {count} | {} | {:.0} | {:.0} | {:.1} |",
                path.name,
                passed.lost,
                count as f64 / passed.took.as_secs_f64(),
                passed.times.at(0.99),
                per_message(passed.used, count),
            );
        }
    }
}

fn print(size: &str, paths: &[Path], passed: Vec<Option<Passed>>) {
    let mut passed: Vec<_> = paths
        .iter()
        .zip(passed)
        .filter_map(|(path, passed)| Some((path, passed?)))
        .collect();
    let cyclone = passed
        .iter_mut()
        .find(|(path, _)| path.lane == Some(0))
        .map_or(f64::NAN, |(_, passed)| passed.times.at(0.5));
    for (path, passed) in &mut passed {
        let (p50, p99) = (passed.times.at(0.5), passed.times.at(0.99));
        let count = passed.times.count();
        println!(
            "| {size} | {} | {count} | {} | {p50:.1} | {p99:.1} | {:.2} | {:.1} |",
            path.name,
            passed.lost,
            p50 / cyclone,
            per_message(passed.used, count),
        );
    }
}

/// Sends through all paths in turns. The result is `None` for a path that cannot carry this load.
fn pass(paths: &mut [Path], pinger: &mut Pinger, turn: u64, load: Load) -> Vec<Option<Passed>> {
    let mut all: Vec<Option<Passed>> = paths
        .iter()
        .map(|path| path.carries(load).then(Passed::default))
        .collect();
    let turn = if load.window == 1 { turn } else { turn * 20 };
    let mut left = load.samples;
    while left > 0 {
        let samples = left.min(turn);
        left -= samples;
        for (path, all) in paths.iter_mut().zip(&mut all) {
            let Some(all) = all else { continue };
            let before = processor_time(path.relay.id());
            let passed = path.pass(pinger, Load { samples, ..load });
            // Lower than before if a thread has ended.
            all.used += processor_time(path.relay.id()).saturating_sub(before);
            all.times.extend(passed.times);
            all.lost += passed.lost;
            all.took += passed.took;
        }
    }
    all
}

/// A number of samples of a size, of which `window` may be in transit.
#[derive(Clone, Copy)]
struct Load {
    samples: u64,
    size: usize,
    window: u64,
}

/// The results of a path.
#[derive(Default)]
struct Passed {
    times: Times,
    lost: u64,
    took: Duration,
    used: Duration,
}

/// A relay.
struct Path {
    name: &'static str,
    /// The index in the pinger; the echo has a socket instead.
    lane: Option<usize>,
    socket: Option<UdpSocket>,
    relay: Child,
}

impl Path {
    fn relay(lane: usize, name: &'static str, start: impl FnOnce(&str, &str) -> Child) -> Self {
        let (from, to) = topics(lane);
        Self {
            name,
            lane: Some(lane),
            socket: None,
            relay: start(&from, &to),
        }
    }

    fn echo() -> Self {
        let me = std::env::current_exe().unwrap();
        let mut relay = StartedChild::new("echo", &me).args(["echo"]).start();
        let address = relay.wait_for_line("127.0.0.1:", Duration::from_secs(10));
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(address).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Self {
            name: "UDP echo",
            lane: None,
            socket: Some(socket),
            relay,
        }
    }

    fn carries(&self, load: Load) -> bool {
        self.socket.is_none() || (load.size <= LARGE && load.window == 1)
    }

    /// Passes samples until a whole turn of them returns, because endpoints that have just matched
    /// may miss some.
    fn begin(&self, pinger: &mut Pinger) {
        let Some(lane) = self.lane else { return };
        let start = Instant::now();
        let load = Load {
            samples: 10,
            size: 100,
            window: 1,
        };
        while pinger.pass(lane, load).lost > 0 {
            assert!(
                start.elapsed() < START,
                "nothing comes back from {}",
                self.name
            );
        }
    }

    fn pass(&self, pinger: &mut Pinger, load: Load) -> Passed {
        match (&self.socket, self.lane) {
            (Some(socket), _) => datagrams(socket, load),
            (None, Some(lane)) => pinger.pass(lane, load),
            (None, None) => Passed::default(),
        }
    }
}

fn datagrams(socket: &UdpSocket, Load { samples, size, .. }: Load) -> Passed {
    let mut passed = Passed::default();
    let sent = vec![b'.'; size + 5];
    let mut heard = vec![0; size + 5];
    for _ in 0..samples {
        let start = Instant::now();
        socket.send(&sent).unwrap();
        socket.recv(&mut heard).unwrap();
        passed.times.add(start.elapsed());
    }
    passed
}

/// Runs the echo: returns each datagram.
pub(crate) fn echo() -> ExitCode {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    println!("{}", socket.local_addr().unwrap());
    let mut buffer = vec![0; 65_536];
    while let Ok((length, from)) = socket.recv_from(&mut buffer) {
        if socket.send_to(&buffer[..length], from).is_err() {
            break;
        }
    }
    ExitCode::SUCCESS
}

/// Cyclone DDS with a writer to each relay and a reader from each.
struct Pinger(Child);

impl Pinger {
    fn start(cell: &Cell) -> Self {
        let lanes: Vec<(String, String)> = (0..LANES).map(topics).collect();
        let mut args = vec!["ping"];
        args.extend(lanes.iter().flat_map(|(from, to)| [from.as_str(), to]));
        let pairs = LANES.to_string();
        args.extend(["--pairs", &pairs, "--limit", LIMIT]);
        Self(cell.cyclone_c(&args))
    }

    fn pass(&mut self, lane: usize, load: Load) -> Passed {
        let Load {
            samples,
            size,
            window,
        } = load;
        let line = format!("{lane} {samples} {size} {window}");
        let answer = self.0.ask(&line, PATIENCE * 10);
        Passed {
            times: times(&answer),
            lost: count(&answer, "lost"),
            took: Duration::from_secs_f64(answer["seconds"].as_f64().unwrap()),
            used: Duration::ZERO,
        }
    }
}

fn topics(lane: usize) -> (String, String) {
    (format!("/there_{lane}"), format!("/back_{lane}"))
}

const LANES: usize = 3;
/// Characters of a text, and the name of its size. Length and NUL add 5 bytes.
const SIZES: [(usize, &str); 4] = [
    (11, "16 B"),
    (1024, "1 KiB"),
    (LARGE, "64 kB"),
    (1 << 20, "1 MiB"),
];
/// The largest text that fits into a datagram with its headers.
const LARGE: usize = 65_000;
