//! `cargo xtask bench redundancy`: random faults of two redundant bridges at 1000 values a second.
//!
//! rospy publishes numbers, two bridges of ROS 1 with the ranks 1 and 2 share the space, and a
//! subscriber in the group records each number with its arrival. The bridges and the station with
//! the publisher and the subscriber are hosts at two networks, that of the group and that of ROS.
//! The active bridge is killed, stopped for a random time, cut off from a network, or asked to hand
//! over, in a random order. The gap of a fault is the longest time without a new number from the
//! fault on.

mod network;

use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::thread::sleep;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use system_tests::{Cell, Child, Peer, eventually};

use network::SwitchedNetwork;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    match args.first().map(String::as_str) {
        Some("--help" | "-h") => {
            println!(
                "bench-redundancy [FAULTS [SEED]]   faults of the active bridge, 200 unless told, about 3 s each, \
                 for at most 10 minutes"
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
    RosCut,
    SwitchedOver,
}

impl Fault {
    const ALL: [Self; 5] = [
        Self::Killed,
        Self::Stopped,
        Self::CutOff,
        Self::RosCut,
        Self::SwitchedOver,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::Killed => "kill -9",
            Self::Stopped => "SIGSTOP, SIGCONT after 0.2 to 1.5 s",
            Self::CutOff => "group cut off for 0.3 to 1.5 s",
            Self::RosCut => "link to ROS down for 0.3 to 1.5 s",
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

/// Two bridges on their hosts.
struct Pair<'c> {
    cell: &'c Cell,
    network: &'c SwitchedNetwork,
    mapping: String,
    bridges: [Option<Child>; 2],
}

impl<'c> Pair<'c> {
    fn start(cell: &'c Cell, network: &'c SwitchedNetwork) -> Self {
        let mapping = cell.file("cell.yaml", MAPPING);
        let mut pair = Self {
            cell,
            network,
            mapping: mapping.to_str().unwrap().to_owned(),
            bridges: [None, None],
        };
        for at in 0..2 {
            pair.launch(at);
        }
        pair
    }

    fn launch(&mut self, at: usize) {
        let started = self.network.bridge(self.cell, at, &self.mapping);
        self.bridges[at] = Some(started.start());
    }

    fn role(&self, at: usize) -> Option<String> {
        let role = &self.network.status(at)?["redundancy"]["role"];
        role.as_str().map(str::to_owned)
    }

    /// Waits until a bridge is active and the other is its standby. Returns the active bridge.
    fn settled(&self) -> usize {
        eventually("one bridge is active, the other is standby", SOON, || {
            let roles = [self.role(0)?, self.role(1)?];
            match [&roles[0][..], &roles[1][..]] {
                ["active", "standby"] => Some(0),
                ["standby", "active"] => Some(1),
                _ => None,
            }
        })
    }

    /// Returns the number of values of the topic that a bridge received from ROS.
    fn received(&self, at: usize) -> Option<u64> {
        let status = self.network.status(at)?;
        let sent = status["topics"]["ua_1_2_12"]["sent"].as_u64()?;
        Some(sent + status["redundancy"]["muted_sent"].as_u64()?)
    }

    /// Waits until a bridge receives values, which a restarted bridge does after it is a standby.
    fn wait_for_values(&self, at: usize) {
        let before = self.received(at).unwrap_or_default();
        eventually("the standby receives the topic", SOON, || {
            (self.received(at)? > before + 20).then_some(())
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
    let network = SwitchedNetwork::lay(&cell);
    let _master = network.master(&cell);
    eventually("the master of ROS responds", SOON, || {
        network.has_master().then_some(())
    });
    let mut pair = Pair::start(&cell, &network);
    pair.settled();
    let numbers = network.numbers((1, 2, 12));
    let seconds = (faults * 10).min(LONGEST.as_secs()) + 120;
    let (count, limit) = ((seconds * 1000).to_string(), (seconds + 300).to_string());
    let args = ["/numbers", "std_msgs/String", "--rate", "1000"];
    let mut publisher = network
        .publisher(&cell, &args)
        .args(["--numbered", &count, "--limit", &limit])
        .args(["--warm-up", "\"warm-up\""])
        .told()
        .start();
    eventually("both bridges receive the topic", SOON, || {
        let receives = |at: usize| pair.received(at).map(|received| received > 3);
        ([0, 1].map(receives) == [Some(true); 2]).then_some(())
    });
    publisher.tell("go");
    numbers.wait_for(1_000);
    let mut random = Random(seed);
    let mut done = Vec::new();
    let (mut arrivals, mut unsettled) = (Vec::new(), 0);
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    println!("{faults} random faults of the active bridge at 1 kHz, seed {seed}, {cores} cores\n");
    let start = Instant::now();
    let all = u64::try_from(Fault::ALL.len()).unwrap();
    for turn in 0..faults {
        if start.elapsed() >= LONGEST {
            println!("ended after {turn} faults, because {LONGEST:?} have passed\n");
            break;
        }
        let active = pair.settled();
        pair.wait_for_values(1 - active);
        sleep(Duration::from_millis(100 + random.below(300)));
        if pair.role(active).as_deref() != Some("active") {
            // A busy machine has changed the roles meanwhile.
            unsettled += 1;
            continue;
        }
        let fault = Fault::ALL[usize::try_from((turn + random.below(all)) % all).unwrap()];
        let at = Instant::now();
        strike(&mut pair, (active, fault), &mut random);
        sleep(Duration::from_millis(300));
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

fn strike(pair: &mut Pair<'_>, (active, fault): (usize, Fault), random: &mut Random) {
    match fault {
        Fault::Killed => {
            let mut child = pair.bridges[active].take().unwrap();
            child.signal(Signal::SIGKILL);
            child.wait_for_end(SOON);
            sleep(Duration::from_millis(300));
            pair.launch(active);
        }
        Fault::Stopped => {
            pair.child(active).signal(Signal::SIGSTOP);
            sleep(Duration::from_millis(200 + random.below(1_300)));
            pair.child(active).signal(Signal::SIGCONT);
        }
        Fault::CutOff => {
            pair.network.set_group_cut(active, true);
            sleep(Duration::from_millis(300 + random.below(1_200)));
            pair.network.set_group_cut(active, false);
        }
        Fault::RosCut => {
            pair.network.set_ros_cut(active, true);
            sleep(Duration::from_millis(300 + random.below(1_200)));
            pair.network.set_ros_cut(active, false);
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
    distribution(&all);
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

/// Prints the number of faults by the length of their gap.
fn distribution(gaps: &[f64]) {
    println!("\n| gap | faults |");
    println!("|---|---|");
    let mut from = 0.0;
    for to in [
        25.0,
        50.0,
        75.0,
        100.0,
        125.0,
        150.0,
        300.0,
        1000.0,
        f64::INFINITY,
    ] {
        let count = gaps.iter().filter(|gap| (from..to).contains(*gap)).count();
        if to.is_finite() {
            println!("| {from:.0} to {to:.0} ms | {count} |");
        } else {
            println!("| longer | {count} |");
        }
        from = to;
    }
}

const MAPPING: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:plant}
variables:
  - {node: ns=2;i=12, name: Numbers, origin: 1, queue: {drop_oldest: 1000}, ros: {topic: /numbers, type: std_msgs/String}}
";
const SOON: Duration = Duration::from_secs(60);
/// The time after which no further fault is caused.
const LONGEST: Duration = Duration::from_secs(570);
