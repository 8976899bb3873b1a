//! `cargo xtask bench plant`: many cells at one MQTT broker, in one process.
//!
//! Each cell is a Router with its topics, which all have a value, and a connection with the broker
//! under a prefix of its own. A client reads the values of all cells. The broker is then killed,
//! and all cells connect again at once.

mod cell;

use std::process::{ExitCode, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use system_tests::{Cell, Child, Peer, anonymous, processor_time};

use cell::{PlantCell, SentMessages};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if matches!(args.first().map(String::as_str), Some("--help" | "-h")) {
        println!(
            "bench-plant [CELLS [TOPICS [PERIOD]]]   100 cells of 1000 topics, each with a value every 10 s"
        );
        return ExitCode::SUCCESS;
    }
    let number = |at: usize, otherwise: u16| {
        let text = args.get(at).and_then(|text| text.parse().ok());
        text.unwrap_or(otherwise)
    };
    let size = Size {
        cells: number(0, 100),
        topics: number(1, 1000),
        period: Duration::from_secs(u64::from(number(2, 10).max(1))),
    };
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return ExitCode::FAILURE;
    };
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(bench(&cell, size));
    ExitCode::SUCCESS
}

/// The size of the plant.
#[derive(Debug, Clone, Copy)]
struct Size {
    cells: u16,
    /// Topics of each cell.
    topics: u16,
    /// The period of the values of a topic.
    period: Duration,
}

impl Size {
    fn all_topics(self) -> u64 {
        u64::from(self.cells) * u64::from(self.topics)
    }
}

/// Memory and processor time of this process and of the broker.
#[derive(Debug, Clone, Copy)]
struct Usage {
    memory: [u64; 2],
    time: [Duration; 2],
    at: Instant,
}

impl Usage {
    fn now(broker: &Child) -> Self {
        let processes = [std::process::id(), broker.id()];
        Self {
            memory: processes.map(anonymous),
            time: processes.map(processor_time),
            at: Instant::now(),
        }
    }

    /// Prints the use of a processor since `before`.
    fn print_load(self, what: &str, before: Self) {
        let window = (self.at - before.at).as_secs_f64();
        let share = |of: usize| (self.time[of] - before.time[of]).as_secs_f64() / window * 100.0;
        println!(
            "{what}: cells {:.0} %, broker {:.0} % of a processor, over {window:.1} s",
            share(0),
            share(1)
        );
    }
}

async fn bench(cell: &Cell, size: Size) {
    let configuration = "listener 1883 127.0.0.1\nallow_anonymous true\nsys_interval 1\nmax_queued_messages 100000\n";
    let broker = cell.mosquitto_with(configuration);
    let mut reader = std::process::Command::new("mosquitto_sub")
        .args(["-h", "127.0.0.1", "-t", "plant/+/uadp/data/#", "-F", "%l"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let empty = Usage::now(&broker);
    let start = Instant::now();
    let mut plant: Vec<PlantCell> = (0..size.cells)
        .map(|number| PlantCell::new(number, size.topics))
        .collect();
    connected(&mut plant).await;
    println!(
        "{} cells connected in {:.1} s",
        size.cells,
        start.elapsed().as_secs_f64()
    );

    // Each topic gets its first value, and is announced.
    let mut sent = SentMessages::default();
    run(&mut plant, size, size.period, &mut sent).await;
    settle(&mut plant).await;
    let full = Usage::now(&broker);
    full.print_load("start and first values", empty);
    for (what, of) in [("cells", 0), ("broker", 1)] {
        let bytes = full.memory[of].saturating_sub(empty.memory[of]);
        println!(
            "memory of the {what}: {:.1} MB, {} bytes per topic",
            bytes as f64 / 1e6,
            bytes / size.all_topics()
        );
    }
    println!(
        "bytes of a message: value {}, announcement {}",
        sent.value_bytes / sent.values.max(1),
        sent.announcement_bytes / sent.announcements.max(1)
    );

    let mut sent = SentMessages::default();
    let window = size.period * 2;
    run(&mut plant, size, window, &mut sent).await;
    let rate = sent.values as f64 / window.as_secs_f64();
    Usage::now(&broker).print_load(&format!("{rate:.0} values a second"), full);
    println!(
        "refused: {} of {} values",
        sent.refused,
        sent.values + sent.refused
    );

    storm(cell, &mut plant, (size, configuration), broker).await;
    let _ended = reader.kill();
    let _status = reader.wait();
}

/// Kills the broker and starts it again without its stored messages.
async fn storm(
    cell: &Cell,
    plant: &mut [PlantCell],
    (size, configuration): (Size, &str),
    broker: Child,
) {
    broker.signal(Signal::SIGKILL);
    drop(broker);
    while plant.iter().any(|cell| !cell.is_lost()) {
        turn(plant, &mut SentMessages::default()).await;
    }
    let start = Instant::now();
    let broker = cell.mosquitto_with(configuration);
    let before = Usage::now(&broker);
    connected(plant).await;
    println!(
        "restart of the broker: all cells connected after {:.1} s",
        start.elapsed().as_secs_f64()
    );
    settle(plant).await;
    let after = Usage::now(&broker);
    println!(
        "restart of the broker: all {} announcements repeated after {:.1} s",
        size.all_topics(),
        start.elapsed().as_secs_f64()
    );
    after.print_load("restart of the broker", before);
}

/// Waits until all cells are connected.
async fn connected(plant: &mut [PlantCell]) {
    let start = Instant::now();
    while plant.iter().any(PlantCell::is_lost) {
        assert!(start.elapsed() < LONGEST, "all cells connect");
        turn(plant, &mut SentMessages::default()).await;
    }
}

/// Waits until this process has nothing left to send: it uses little processor time.
async fn settle(plant: &mut [PlantCell]) {
    let start = Instant::now();
    let own = std::process::id();
    loop {
        assert!(start.elapsed() < LONGEST, "the cells come to rest");
        let (at, before) = (Instant::now(), processor_time(own));
        while at.elapsed() < Duration::from_millis(500) {
            turn(plant, &mut SentMessages::default()).await;
        }
        let used = processor_time(own) - before;
        if used.as_secs_f64() < 0.25 * at.elapsed().as_secs_f64() {
            return;
        }
    }
}

/// Gives the topics values for the time of `window`.
async fn run(plant: &mut [PlantCell], size: Size, window: Duration, sent: &mut SentMessages) {
    let start = Instant::now();
    let mut given = 0;
    while start.elapsed() < window {
        let share = start.elapsed().as_secs_f64() / size.period.as_secs_f64();
        let due = (share * f64::from(size.topics)) as u64;
        for cell in plant.iter_mut() {
            cell.say(due - given);
        }
        given = due;
        turn(plant, sent).await;
    }
}

/// Lets each cell send and receive, and the connections work.
async fn turn(plant: &mut [PlantCell], sent: &mut SentMessages) {
    for cell in plant.iter_mut() {
        cell.turn(sent);
    }
    tokio::time::sleep(TURN).await;
}

const TURN: Duration = Duration::from_millis(20);
const LONGEST: Duration = Duration::from_secs(300);
