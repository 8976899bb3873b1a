//! `cargo xtask bench mqtt`: the time of a round trip of a value over an MQTT broker, between two
//! carriers and between two clients of paho, in turns at one mosquitto.
//!
//! The payload of paho is the value alone. That of the carriers is a NetworkMessage with the value,
//! which is encoded and decoded at both ends.

mod carriers;

use std::process::ExitCode;
use std::time::Duration;

use system_tests::{BROKER, Cell, Child, Peer, Times};

use carriers::CarrierPair;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if matches!(args.first().map(String::as_str), Some("--help" | "-h")) {
        println!("bench-mqtt [ROUND_TRIPS]   2000 round trips of each size and path");
        return ExitCode::SUCCESS;
    }
    let round_trips: usize = args.first().and_then(|of| of.parse().ok()).unwrap_or(2000);
    let Some(cell) = Cell::with(&[Peer::MqttPython, Peer::Mosquitto]) else {
        return ExitCode::FAILURE;
    };
    let broker = cell.mosquitto_without_log();
    println!("| value | path | round trips | p50 | p99 | p50 / paho |");
    println!("|---|---|---|---|---|---|");
    let mut own = CarrierPair::connect(BROKER);
    let mut is_met = true;
    for size in SIZES {
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

/// Measures round trips of values of a size in bytes, and prints the results in microseconds.
/// Returns whether those of the carriers are short enough.
fn measure((cell, own): (&Cell, &mut CarrierPair), size: usize, round_trips: usize) -> bool {
    let mut paho = Paho::connect(cell, size);
    let (mut of_own, mut of_paho) = (Times::default(), Times::default());
    let each = round_trips.div_ceil(TURNS).max(1);
    for _ in 0..TURNS {
        paho.round_trips(each, &mut of_paho);
        own.round_trips(each, size, &mut of_own);
    }
    let paho = of_paho.at(0.5);
    print(size, "paho -> mosquitto -> paho and back", of_paho, paho);
    let own = of_own.at(0.5);
    print(
        size,
        "carrier -> mosquitto -> carrier and back",
        of_own,
        paho,
    );
    own <= MOST * paho
}

fn print(size: usize, path: &str, mut times: Times, paho: f64) {
    let (p50, p99) = (times.at(0.5), times.at(0.99));
    let (count, ratio) = (times.count(), p50 / paho);
    println!("| {size} B | {path} | {count} | {p50:.0} | {p99:.0} | {ratio:.2} |");
}

/// Two clients of paho, each in its own process.
struct Paho {
    asks: Child,
    _echoes: Child,
}

impl Paho {
    fn connect(cell: &Cell, size: usize) -> Self {
        let size = size.to_string();
        let start = |mode| {
            let started = cell.mqtt_python_started("mqtt_round_trip.py", &[mode, &size]);
            started.told().start().ready(SOON)
        };
        Self {
            _echoes: start("echo"),
            asks: start("ask"),
        }
    }

    fn round_trips(&mut self, count: usize, times: &mut Times) {
        let answer = self.asks.ask(&count.to_string(), SOON);
        for micros in answer["us"].as_array().unwrap() {
            times.add(Duration::from_secs_f64(micros.as_f64().unwrap() / 1e6));
        }
    }
}

/// Sizes of values in bytes.
const SIZES: [usize; 2] = [8, 1024];
/// The turns in which both paths are measured, so that both see the same machine.
const TURNS: usize = 10;
/// The most that a round trip may take, as a multiple of that of paho.
const MOST: f64 = 1.3;
const SOON: Duration = Duration::from_secs(60);
