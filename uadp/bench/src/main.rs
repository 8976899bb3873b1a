//! Benchmark of the codec. Without arguments it measures wall time; `count CASE N` only performs
//! the work, for an instruction counter.

mod ours;
mod theirs;

use std::hint::black_box;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use ours::{Config, EncodedContent};

/// Number of rounds. The fastest round counts, because slower rounds were disturbed.
const ROUNDS: u32 = 15;
const MESSAGES: u32 = 100_000;

/// A measured case, with a name for tables and the command line.
struct Case {
    name: String,
    work: Box<dyn FnMut(u32)>,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        [] => {
            let mut both = cases();
            both.extend(their_cases());
            wall(&mut both);
            ExitCode::SUCCESS
        }
        ["list"] => {
            for case in cases() {
                println!("{}", case.name);
            }
            ExitCode::SUCCESS
        }
        ["count", name, messages] => {
            let mut cases = cases();
            let case = cases.iter_mut().find(|case| case.name == name);
            match (case, messages.parse()) {
                (Some(case), Ok(messages)) => {
                    (case.work)(messages);
                    ExitCode::SUCCESS
                }
                _ => usage(),
            }
        }
        _ => usage(),
    }
}

fn usage() -> ExitCode {
    eprintln!("usage: uadp-bench [list | count CASE MESSAGES]");
    ExitCode::from(64)
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for payload in EncodedContent::ALL {
        let name = payload.name();
        let mut datagram = Vec::with_capacity(2048);
        let config = Config::new();
        cases.push(case("encode", name, move |messages| {
            for number in 0..messages {
                ours::encode(payload, number as u16, &config, &mut datagram);
                black_box(&datagram);
            }
        }));
        let mut datagram = Vec::new();
        ours::encode(payload, 7, &Config::new(), &mut datagram);
        cases.push(case("decode", name, move |messages| {
            for _ in 0..messages {
                black_box(ours::decode(black_box(&datagram)));
            }
        }));
    }
    cases
}

/// Cases that are timed only, not counted.
fn their_cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for payload in EncodedContent::ALL {
        let message = theirs::message(payload);
        let mut datagram = Vec::new();
        ours::encode(payload, 1, &Config::new(), &mut datagram);
        let written = theirs::encode(&message);
        assert_eq!(
            written.as_slice().len(),
            datagram.len(),
            "not the same message"
        );
        cases.push(case("zerodds encode", payload.name(), move |messages| {
            for _ in 0..messages {
                black_box(theirs::encode(&message));
            }
        }));
        cases.push(case("zerodds decode", payload.name(), move |messages| {
            for _ in 0..messages {
                theirs::decode(black_box(&datagram));
            }
        }));
    }
    cases
}

fn case(what: &str, payload: &str, work: impl FnMut(u32) + 'static) -> Case {
    Case {
        name: format!("{what} {payload}"),
        work: Box::new(work),
    }
}

/// Measures the cases in turn, so that all of them run under the same conditions.
fn wall(cases: &mut [Case]) {
    let mut best = vec![Duration::MAX; cases.len()];
    for _ in 0..ROUNDS {
        for (case, best) in cases.iter_mut().zip(&mut best) {
            let start = Instant::now();
            (case.work)(MESSAGES);
            *best = start.elapsed().min(*best);
        }
    }
    for (case, best) in cases.iter().zip(best) {
        let nanos = best.as_secs_f64() * 1e9 / f64::from(MESSAGES);
        println!("{:<32} {nanos:8.1} ns", case.name);
    }
}
