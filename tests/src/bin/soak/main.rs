//! `cargo xtask soak [HOURS [SEED]]`: all programs of a cell for hours, with a random fault each
//! minute.
//!
//! Numbers go from ROS 1 to ROS 2 and back, ten a second. After each fault, the programs must be
//! ready again, both subscribers must receive new numbers, and a process must run the skill of a
//! component: otherwise a state is lost, or a process failed. The longest gap of each minute and
//! the growth of memory are printed.

mod plant;

use std::process::ExitCode;
use std::thread::sleep;
use std::time::{Duration, Instant};

use system_tests::{Cell, Child, METRICS_SERVER, Peer, metrics};

use plant::{Random, RoundFault, SoakPlant};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if matches!(args.first().map(String::as_str), Some("--help" | "-h")) {
        println!("soak [HOURS [SEED]]   2 hours unless told; a fraction of an hour is possible");
        return ExitCode::SUCCESS;
    }
    let hours: f64 = args.first().and_then(|of| of.parse().ok()).unwrap_or(2.0);
    let seed = args.get(1).and_then(|of| of.parse().ok()).unwrap_or(1);
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python, Peer::Clock, Peer::Mosquitto]) else {
        return ExitCode::FAILURE;
    };
    let duration = Duration::from_secs_f64(hours.clamp(0.05, 200.0) * 3600.0);
    soak(&cell, duration, seed)
}

/// A topic from one ROS to the other.
#[derive(Clone, Copy)]
enum Way {
    Forth,
    Back,
}

impl Way {
    const BOTH: [Self; 2] = [Self::Forth, Self::Back];

    const fn topic(self) -> [&'static str; 2] {
        match self {
            Self::Forth => ["/ua_1_5_10", "std_msgs/String"],
            Self::Back => ["/ua_2_5_11", "std_msgs/String"],
        }
    }

    /// Starts the publisher of numbers.
    fn publisher(self, cell: &Cell, duration: Duration) -> Child {
        let seconds = duration.as_secs() + 600;
        let (count, limit) = ((seconds * RATE).to_string(), (seconds + 600).to_string());
        let rate = RATE.to_string();
        let more = ["--numbered", &count, "--rate", &rate, "--limit", &limit];
        match self {
            Self::Forth => cell.rospy("ros1_pub.py", &[&self.topic()[..], &more].concat()),
            Self::Back => {
                let domain = ["--domain", "2"];
                cell.cyclone("ros2_pub.py", &[&self.topic()[..], &more, &domain].concat())
            }
        }
    }

    fn subscriber(self, cell: &Cell) -> Child {
        let limit = ["--limit", "600"];
        match self {
            Self::Forth => {
                let domain = ["--domain", "2"];
                cell.cyclone(
                    "ros2_sub.py",
                    &[&self.topic()[..], &limit, &domain].concat(),
                )
            }
            Self::Back => cell.rospy("ros1_sub.py", &[&self.topic()[..], &limit].concat()),
        }
    }
}

/// A subscriber of a round.
struct Reader {
    child: Child,
}

impl Reader {
    fn new(way: Way, cell: &Cell) -> Self {
        Self {
            child: way.subscriber(cell),
        }
    }

    /// Returns the numbers that arrived, in their order.
    fn numbers(&self) -> Vec<u64> {
        let values = self.child.values().into_iter();
        values
            .filter_map(|value| value["data"].as_str()?.parse().ok())
            .collect()
    }

    /// Returns the number of values so far.
    fn count(&self) -> usize {
        self.child.values().len()
    }

    /// Returns the longest time between two values, or since the last one.
    fn gap(&self) -> Duration {
        let mut arrivals = self.child.arrivals();
        arrivals.push(Instant::now());
        let gaps = arrivals.windows(2).map(|pair| pair[1] - pair[0]);
        gaps.max().unwrap_or_default()
    }

    /// Returns how many numbers arrived again directly after themselves.
    fn doubled(&self) -> usize {
        let numbers = self.numbers();
        numbers.windows(2).filter(|pair| pair[1] == pair[0]).count()
    }

    /// Returns how many numbers arrived after a newer number.
    fn disordered(&self) -> usize {
        let numbers = self.numbers();
        numbers.windows(2).filter(|pair| pair[1] < pair[0]).count()
    }
}

/// Waits for `done` or the end of the time. Returns whether it is done.
fn is_soon(time: Duration, mut done: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    while start.elapsed() < time {
        if done() {
            return true;
        }
        sleep(Duration::from_millis(50));
    }
    false
}

/// The result of all rounds.
#[derive(Default)]
struct Tally {
    rounds: u64,
    lost: u64,
    failed_processes: u64,
    doubled: usize,
    disordered: usize,
    longest: Duration,
}

fn soak(cell: &Cell, duration: Duration, seed: u64) -> ExitCode {
    let clock = cell.wall_clock();
    let _master = cell.roscore();
    let mut plant = SoakPlant::start(cell, &clock);
    plant.heal();
    let _publishers = Way::BOTH.map(|way| way.publisher(cell, duration));
    let mut random = Random(seed);
    let mut tally = Tally::default();
    println!(
        "soak of {:.1} h, seed {seed}",
        duration.as_secs_f64() / 3600.0
    );
    let start = Instant::now();
    while start.elapsed() < duration {
        round(cell, &mut plant, &mut random, &mut tally);
    }
    report(&mut plant, &tally)
}

/// A minute with one fault.
fn round(cell: &Cell, plant: &mut SoakPlant<'_>, random: &mut Random, tally: &mut Tally) {
    let end = Instant::now() + ROUND;
    let readers = Way::BOTH.map(|way| Reader::new(way, cell));
    let has_begun = is_soon(HEALED, || readers.iter().all(|of| of.count() > NEW));
    let all = u64::try_from(RoundFault::ALL.len()).unwrap();
    let fault = RoundFault::ALL[usize::try_from(random.below(all)).unwrap()];
    let what = plant.strike(fault, random);
    let healed = plant.heal();
    let forwarded = forwarded();
    let before = readers.each_ref().map(Reader::count);
    let is_new = is_soon(HEALED, || {
        let mut pairs = readers.iter().zip(before);
        pairs.all(|(of, before)| of.count() > before + NEW) && self::forwarded() > forwarded
    });
    let runs = SoakPlant::start_process().wait_for_end(PROCESS).success();
    sleep(end.saturating_duration_since(Instant::now()));
    for program in &mut plant.programs {
        program.sample();
    }
    tally.rounds += 1;
    let is_lost = !has_begun || !is_new;
    tally.lost += u64::from(is_lost);
    tally.failed_processes += u64::from(!runs);
    let disordered: usize = readers.iter().map(Reader::disordered).sum();
    tally.disordered += disordered;
    let doubled: usize = readers.iter().map(Reader::doubled).sum();
    tally.doubled += doubled;
    let [forth, back] = readers.each_ref().map(Reader::gap);
    tally.longest = tally.longest.max(forth).max(back);
    println!(
        "{:4} {what}: ready after {:.1} s, gaps {:.2} s forth and {:.2} s back, {doubled} doubled, \
         {disordered} out of order{}",
        tally.rounds,
        healed.as_secs_f64(),
        forth.as_secs_f64(),
        back.as_secs_f64(),
        match (is_lost, runs) {
            (true, _) => ", A STATE IS LOST",
            (false, false) => ", THE PROCESS FAILED",
            (false, true) => "",
        }
    );
}

/// Returns the number of messages that the server has forwarded to the broker.
fn forwarded() -> u64 {
    let status = metrics(METRICS_SERVER).unwrap_or_default();
    status["carriers"][1]["forwarded"]
        .as_u64()
        .unwrap_or_default()
}

fn report(plant: &mut SoakPlant<'_>, tally: &Tally) -> ExitCode {
    let Tally {
        rounds,
        lost,
        failed_processes,
        doubled,
        disordered,
        longest,
    } = tally;
    println!(
        "{rounds} faults: {lost} without new states afterwards, {failed_processes} processes failed, \
         {doubled} states doubled, {disordered} values out of order, longest gap {:.2} s",
        longest.as_secs_f64()
    );
    let mut grows = false;
    for program in &mut plant.programs {
        program.note_growth();
        match program.growth {
            Some((span, percent)) => {
                grows |= span >= Duration::from_secs(3600) && percent > MOST_GROWTH;
                let minutes = span.as_secs() / 60;
                println!(
                    "memory of {}: {percent:+.2} %/h over {minutes} min",
                    program.name
                );
            }
            None => println!("memory of {}: restarted too often", program.name),
        }
    }
    let is_ordered = *doubled == 0 && *disordered == 0;
    match *lost == 0 && *failed_processes == 0 && is_ordered && !grows {
        true => ExitCode::SUCCESS,
        false => ExitCode::FAILURE,
    }
}

/// Numbers a second of each topic.
const RATE: u64 = 10;
const ROUND: Duration = Duration::from_secs(60);
/// The time for new states after a fault.
const HEALED: Duration = Duration::from_secs(30);
/// The time for a process of one step.
const PROCESS: Duration = Duration::from_secs(100);
/// The number of new values that show that states arrive again.
const NEW: usize = 10;
/// The growth of memory in percent an hour that fails the soak.
const MOST_GROWTH: f64 = 1.0;
