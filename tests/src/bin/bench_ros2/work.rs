//! The work of the bridges: system calls, wake-ups and CPU per message, and of idle programs.

use std::time::Duration;

use system_tests::{Cell, Child, SystemCalls, processor_time, wake_ups};

use crate::ends::SendingPace;
use crate::through::{NAMES, WAITING, Ways};

/// Measures the work per message, and the idle programs for some seconds.
pub(crate) fn measure(cell: &Cell, seconds: u64) {
    println!("\nThe work of each message, {seconds} s for each load:\n");
    println!(
        "| load | way | process | p50 (us) | p99 (us) | system calls per message | wake-ups per message | CPU per message (us) |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let two = ["bridge-ros1", "bridge-ros2"];
    per_message(&mut Ways::stand(cell, WAITING), seconds, &two);
    let one = ["ua-cell with both bridges"];
    per_message(&mut Ways::in_one_process(cell, WAITING), seconds, &one);
    idle(cell, seconds);
}

/// Prints the work of each process of the bridges. The delays are those of the whole way.
fn per_message(ways: &mut Ways, seconds: u64, names: &[&str]) {
    for (load, pace) in loads(seconds) {
        for way in [1, 2] {
            let name = NAMES.get(way).copied().unwrap_or_default();
            // A first turn lets discovery settle; the calls are counted in a turn of their own.
            ways.send(way, SendingPace { ticks: 100, ..pace });
            let used = |ways: &Ways| ways.bridges().iter().map(Used::of).collect::<Vec<_>>();
            let before = used(ways);
            let mut report = ways.send(way, pace);
            let after = used(ways);
            let bridges = ways.bridges().iter();
            let counting = bridges.map(|bridge| SystemCalls::count(bridge.id()));
            let counting: Vec<_> = counting.collect();
            ways.send(way, pace);
            let calls = counting.into_iter();
            let calls = calls.map(|counting| counting.and_then(SystemCalls::stop));
            let programs = names.iter().zip(calls);
            let [p50, p99] = [0.5, 0.99].map(|share| report.times.at(share));
            for ((program, calls), (before, after)) in programs.zip(before.into_iter().zip(after)) {
                let each = |count: u64| count as f64 / pace.ticks as f64;
                println!(
                    "| {load} | {name} | {program} | {p50:.1} | {p99:.1} | {} | {:.2} | {:.1} |",
                    calls.map_or_else(|| "-".to_owned(), |calls| format!("{:.2}", each(calls))),
                    each(after.wake_ups - before.wake_ups),
                    (after.time - before.time).as_secs_f64() * 1e6 / pace.ticks as f64
                );
            }
        }
    }
}

/// Returns the loads with their names.
fn loads(seconds: u64) -> [(&'static str, SendingPace); 4] {
    let kilohertz = |size| SendingPace::kilohertz(seconds, size);
    [
        (
            "64 B, 100/s",
            SendingPace {
                ticks: seconds * 100,
                period: Duration::from_millis(10),
                ..kilohertz(64)
            },
        ),
        ("64 B, 1000/s", kilohertz(64)),
        (
            "1 KiB, 2000/s in bursts of 20",
            SendingPace {
                ticks: seconds * 2000,
                period: Duration::ZERO,
                burst: 20,
                pause: Duration::from_millis(10),
                ..kilohertz(1024)
            },
        ),
        (
            "1 KiB, 10 000/s in bursts of 100",
            SendingPace {
                ticks: seconds * 10_000,
                period: Duration::ZERO,
                burst: 100,
                pause: Duration::from_millis(10),
                ..kilohertz(1024)
            },
        ),
    ]
}

struct Used {
    time: Duration,
    wake_ups: u64,
}

impl Used {
    fn of(program: &Child) -> Self {
        Self {
            time: processor_time(program.id()),
            wake_ups: wake_ups(program.id()),
        }
    }
}

fn idle(cell: &Cell, seconds: u64) {
    println!("\nIdle for {seconds} s, with 10 topics without publishers:\n");
    println!("| program | wake-ups per second | system calls per second | CPU (ms/s) |");
    println!("|---|---|---|---|");
    let topics: String = (10..20)
        .map(|id| format!("  - {{node: ns=2;i={id}, name: v{id}, type: Double, origin: 1}}\n"))
        .collect();
    let mapping =
        "spaces:\n  - id: 1\n  - id: 2\nnamespaces:\n  2: urn:ua-bridge:bench\nvariables:\n";
    let mapping = cell.file("idle.yaml", &format!("{mapping}{topics}"));
    let mapping = mapping.to_string_lossy();
    let programs = [
        ("bridge-ros1", cell.bridge_ros1(&[&mapping])),
        ("bridge-ros2", cell.bridge_ros2(&[&mapping])),
        ("ua-server", cell.ua_server(&[&mapping])),
    ];
    // Time in which discovery settles.
    std::thread::sleep(Duration::from_secs(8));
    for (name, program) in programs {
        let counting = SystemCalls::count(program.id());
        let before = Used::of(&program);
        std::thread::sleep(Duration::from_secs(seconds));
        let after = Used::of(&program);
        let calls = counting.and_then(SystemCalls::stop);
        let each = |count: u64| count as f64 / seconds as f64;
        println!(
            "| {name} | {:.1} | {} | {:.2} |",
            each(after.wake_ups - before.wake_ups),
            calls.map_or_else(|| "-".to_owned(), |calls| format!("{:.0}", each(calls))),
            (after.time - before.time).as_secs_f64() * 1e3 / seconds as f64
        );
    }
}
