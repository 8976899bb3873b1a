//! `cargo xtask bench redundancy`: random faults of two redundant bridges at 1000 values a second.
//!
//! rospy publishes numbers, two bridges of ROS 1 with the ranks 1 and 2 share the space, and a
//! subscriber in the group records each number with its arrival. The active bridge is killed,
//! stopped for a random time, cut off from the group, or asked to hand over, in a random order. The
//! gap of a fault is the longest time without a new number from the fault on.

mod network;

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;
use std::process::ExitCode;
use std::thread::sleep;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use system_tests::{Cell, Child, GroupNumbers, Peer, Started, eventually, metrics, program};

use network::Network;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("--help" | "-h") => {
            println!(
                "bench-redundancy [FAULTS [SEED]]   faults of the active bridge, 200 unless told, about 3 s each"
            );
            ExitCode::SUCCESS
        }
        _ => {
            let number = |at: usize, otherwise: u64| {
                let text = args.get(at).and_then(|text| text.parse().ok());
                text.unwrap_or(otherwise)
            };
            bench(number(0, 200), number(1, 1))
        }
    }
}

/// A fault of the active bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    Killed,
    Stopped,
    CutOff,
    SwitchedOver,
}

impl Fault {
    const ALL: [Self; 4] = [
        Self::Killed,
        Self::Stopped,
        Self::CutOff,
        Self::SwitchedOver,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::Killed => "kill -9",
            Self::Stopped => "SIGSTOP, SIGCONT after 0.2 to 1.5 s",
            Self::CutOff => "group cut off for 0.3 to 1.5 s",
            Self::SwitchedOver => "planned switch-over",
        }
    }
}

/// A fault and the time of its begin.
struct Done {
    fault: Fault,
    at: Instant,
    end: Instant,
}

/// A deterministic sequence of random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % limit
    }
}

/// Two bridges with an interface each.
struct Pair<'c> {
    cell: &'c Cell,
    mapping: String,
    bridges: [Option<Child>; 2],
}

impl<'c> Pair<'c> {
    fn start(cell: &'c Cell) -> Self {
        let mapping = cell.file("cell.yaml", MAPPING);
        let mut pair = Self {
            cell,
            mapping: mapping.to_str().unwrap().to_owned(),
            bridges: [None, None],
        };
        for at in 0..2 {
            pair.bridges[at] = Some(pair.bridge(at).start());
        }
        pair
    }

    fn bridge(&self, at: usize) -> Started {
        let rank = ["1", "2"][at];
        let interface = network::BRIDGES[at].name;
        self.cell
            .with_ros1(Started::new("bridge-ros1", &program("bridge-ros1")))
            .args([&self.mapping])
            .args(["--rank", rank, "--interface", interface])
            .args(["--metrics", METRICS[at]])
    }

    fn role(at: usize) -> Option<String> {
        let role = &metrics(METRICS[at])?["redundancy"]["role"];
        role.as_str().map(str::to_owned)
    }

    /// Waits until a bridge is active and the other is its standby. Returns the active bridge.
    fn settled(&self) -> usize {
        eventually("one bridge is active, the other is standby", SOON, || {
            let roles = [Self::role(0)?, Self::role(1)?];
            match [&roles[0][..], &roles[1][..]] {
                ["active", "standby"] => Some(0),
                ["standby", "active"] => Some(1),
                _ => None,
            }
        })
    }

    /// Returns the number of values of the topic that a bridge received from ROS.
    fn received(at: usize) -> Option<u64> {
        let status = metrics(METRICS[at])?;
        let sent = status["topics"]["ua_1_2_12"]["sent"].as_u64()?;
        Some(sent + status["redundancy"]["muted_sent"].as_u64()?)
    }

    /// Waits until a bridge receives values, which a restarted bridge does after it is a standby.
    fn wait_for_values(at: usize) {
        let before = Self::received(at).unwrap_or_default();
        eventually("the standby receives the topic", SOON, || {
            (Self::received(at)? > before + 20).then_some(())
        });
    }

    fn child(&self, at: usize) -> &Child {
        self.bridges[at].as_ref().unwrap()
    }
}

fn bench(faults: u64, seed: u64) -> ExitCode {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return ExitCode::FAILURE;
    };
    let network = Network::lay();
    let _master = cell.roscore();
    let mut pair = Pair::start(&cell);
    pair.settled();
    let numbers = GroupNumbers::of((1, 2, 12), network::READER);
    let count = (faults * 10_000 + 60_000).to_string();
    let args = ["/numbers", "std_msgs/String", "--rate", "1000"];
    let mut publisher = cell
        .rospy_started("ros1_pub.py", &args)
        .args(["--numbered", &count, "--warm-up", "\"warm-up\""])
        .told()
        .start();
    eventually("both bridges receive the topic", SOON, || {
        let receives = |at: usize| Pair::received(at).map(|received| received > 3);
        ([0, 1].map(receives) == [Some(true); 2]).then_some(())
    });
    publisher.tell("go");
    numbers.wait_for(1_000);
    let mut random = Random(seed);
    let mut done = Vec::new();
    let (mut arrivals, mut unsettled) = (Vec::new(), 0);
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    println!("{faults} random faults of the active bridge at 1 kHz, seed {seed}, {cores} cores\n");
    for turn in 0..faults {
        let active = pair.settled();
        Pair::wait_for_values(1 - active);
        sleep(Duration::from_millis(300 + random.below(300)));
        if Pair::role(active).as_deref() != Some("active") {
            // A busy machine has changed the roles meanwhile.
            unsettled += 1;
            continue;
        }
        // Each fault is as frequent as the others.
        let fault = Fault::ALL[usize::try_from((turn + random.below(4)) % 4).unwrap()];
        let at = Instant::now();
        strike(&mut pair, (active, fault), &network, &mut random);
        sleep(Duration::from_millis(500));
        let end = Instant::now();
        done.push(Done { fault, at, end });
        arrivals.extend(numbers.take());
        if turn % 20 == 19 {
            eprintln!("{} faults", turn + 1);
        }
    }
    pair.settled();
    sleep(Duration::from_secs(1));
    arrivals.extend(numbers.take());
    report(&done, &arrivals, unsettled)
}

fn strike(
    pair: &mut Pair<'_>,
    (active, fault): (usize, Fault),
    network: &Network,
    random: &mut Random,
) {
    match fault {
        Fault::Killed => {
            let mut child = pair.bridges[active].take().unwrap();
            child.signal(Signal::SIGKILL);
            child.wait_for_end(SOON);
            sleep(Duration::from_millis(500));
            pair.bridges[active] = Some(pair.bridge(active).start());
        }
        Fault::Stopped => {
            pair.child(active).signal(Signal::SIGSTOP);
            sleep(Duration::from_millis(200 + random.below(1_300)));
            pair.child(active).signal(Signal::SIGCONT);
        }
        Fault::CutOff => {
            network.cut(active);
            sleep(Duration::from_millis(300 + random.below(1_200)));
            network.mend(active);
        }
        Fault::SwitchedOver => pair.child(active).signal(Signal::SIGUSR1),
    }
}

fn report(done: &[Done], arrivals: &[(Instant, u32)], unsettled: u64) -> ExitCode {
    let mut gaps: BTreeMap<Fault, Vec<f64>> = BTreeMap::new();
    for fault in done {
        // The number before the fault is the begin of the gap.
        let begin = arrivals.partition_point(|(at, _)| *at < fault.at);
        let end = arrivals.partition_point(|(at, _)| *at < fault.end);
        let during = &arrivals[begin.saturating_sub(1)..end];
        let longest = during
            .windows(2)
            .map(|pair| pair[1].0 - pair[0].0)
            .max()
            .unwrap_or(fault.end - fault.at);
        let all = gaps.entry(fault.fault).or_default();
        all.push(longest.as_secs_f64() * 1e3);
    }
    println!("| fault | faults | gap p50 | p90 | p99 | longest | within 150 ms |");
    println!("|---|---|---|---|---|---|---|");
    let mut all: Vec<f64> = gaps.values().flatten().copied().collect();
    for (fault, gaps) in &mut gaps {
        row(fault.name(), gaps);
    }
    row("all", &mut all);
    let mut seen = BTreeSet::new();
    let (mut doubled, mut disordered, mut last) = (0, 0, None);
    for (_, number) in arrivals {
        if !seen.insert(*number) {
            doubled += 1;
        } else if last > Some(*number) {
            disordered += 1;
        }
        last = last.max(Some(*number));
    }
    let first = seen.first().copied().unwrap_or_default();
    let sent = u64::from(last.unwrap_or_default() - first) + 1;
    let lost = sent - u64::try_from(seen.len()).unwrap();
    println!(
        "\n{sent} values: {lost} lost, {doubled} doubled, {disordered} out of order; {unsettled} faults left out, \
         because the roles had changed before"
    );
    match doubled + disordered {
        0 => ExitCode::SUCCESS,
        _ => ExitCode::FAILURE,
    }
}

fn row(name: &str, gaps: &mut [f64]) {
    if gaps.is_empty() {
        return;
    }
    gaps.sort_by(f64::total_cmp);
    let at = |percent: usize| gaps[(gaps.len() - 1) * percent / 100];
    let within = gaps.iter().filter(|gap| **gap <= 150.0).count();
    println!(
        "| {name} | {} | {:.0} ms | {:.0} ms | {:.0} ms | {:.0} ms | {within} |",
        gaps.len(),
        at(50),
        at(90),
        at(99),
        at(100)
    );
}

const MAPPING: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:plant}
variables:
  - {node: ns=2;i=12, name: Numbers, origin: 1, queue: {drop_oldest: 1000}, ros: {topic: /numbers, type: std_msgs/String}}
";
const METRICS: [&str; 2] = ["127.0.0.1:9101", "127.0.0.1:9112"];
const SOON: Duration = Duration::from_secs(60);

/// The address of an interface.
pub(crate) const fn address(last: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 78, 0, last)
}
