//! `cargo xtask bench mqtt`: the time of a round trip over an MQTT broker, between two carriers and
//! between two clients of paho, in turns at one mosquitto.

mod carriers;

use std::process::ExitCode;
use std::time::Duration;

use system_tests::{BROKER, Cell, Child, Peer};

use carriers::CarrierPair;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if matches!(args.first().map(String::as_str), Some("--help" | "-h")) {
        println!("bench-mqtt [ROUND_TRIPS]   2000 round trips of each size and path");
        return ExitCode::SUCCESS;
    }
    let round_trips: usize = args.first().and_then(|of| of.parse().ok()).unwrap_or(2000);
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Mosquitto]) else {
        return ExitCode::FAILURE;
    };
    let broker = cell.mosquitto_with("listener 1883 127.0.0.1\nallow_anonymous true\n");
    println!("| bytes | path | round trips | p50 | p99 | p50 / paho |");
    println!("|---|---|---|---|---|---|");
    let mut own = CarrierPair::connect(BROKER);
    let mut is_met = true;
    for size in [100, 1000, 10_000] {
        is_met &= measure((&cell, &mut own), size, round_trips);
    }
    drop(broker);
    match is_met {
        true => ExitCode::SUCCESS,
        false => {
            println!("a round trip takes more than {MOST} times that of paho");
            ExitCode::FAILURE
        }
    }
}

/// Measures round trips of messages of a size in bytes, and prints the results in microseconds.
/// Returns whether those of the carriers are short enough.
fn measure((cell, own): (&Cell, &mut CarrierPair), size: usize, round_trips: usize) -> bool {
    let mut paho = Paho::connect(cell, size);
    let (mut of_own, mut of_paho) = (Vec::new(), Vec::new());
    let each = round_trips.div_ceil(TURNS);
    for _ in 0..TURNS {
        of_paho.extend(paho.round_trips(each));
        of_own.extend(own.round_trips(each, size));
    }
    let paho = Quantiles::of(of_paho);
    let own = Quantiles::of(of_own);
    paho.print(size, "paho -> mosquitto -> paho and back", &paho);
    own.print(size, "carrier -> mosquitto -> carrier and back", &paho);
    own.p50.as_secs_f64() <= MOST * paho.p50.as_secs_f64()
}

/// Two clients of paho, each in its own process.
struct Paho {
    asks: Child,
    _echoes: Child,
    turn: usize,
}

impl Paho {
    fn connect(cell: &Cell, size: usize) -> Self {
        let size = size.to_string();
        let start = |mode| {
            let started = cell.asyncua_started("mqtt_round_trip.py", &[mode, &size]);
            started.told().start().ready(SOON)
        };
        Self {
            _echoes: start("echo"),
            asks: start("ask"),
            turn: 0,
        }
    }

    fn round_trips(&mut self, count: usize) -> Vec<Duration> {
        self.asks.tell(&count.to_string());
        let turn = self.turn;
        self.turn += 1;
        let micros = self.asks.wait_for_json("the round trips", SOON, |line| {
            (line["turn"] == turn).then(|| line["us"].as_array().cloned())?
        });
        let micros = micros.iter().map(|of| of.as_f64().unwrap());
        micros.map(|of| Duration::from_secs_f64(of / 1e6)).collect()
    }
}

/// The distribution of round trips.
struct Quantiles {
    count: usize,
    p50: Duration,
    p99: Duration,
}

impl Quantiles {
    fn of(mut all: Vec<Duration>) -> Self {
        all.sort();
        Self {
            count: all.len(),
            p50: all[all.len() / 2],
            p99: all[all.len() * 99 / 100],
        }
    }

    fn print(&self, size: usize, path: &str, paho: &Self) {
        let micros = |of: Duration| of.as_secs_f64() * 1e6;
        println!(
            "| {size} | {path} | {} | {:.0} | {:.0} | {:.2} |",
            self.count,
            micros(self.p50),
            micros(self.p99),
            micros(self.p50) / micros(paho.p50)
        );
    }
}

/// The turns in which both paths are measured, so that both see the same machine.
const TURNS: usize = 10;
/// The most that a round trip may take, as a multiple of that of paho.
const MOST: f64 = 1.3;
const SOON: Duration = Duration::from_secs(60);
