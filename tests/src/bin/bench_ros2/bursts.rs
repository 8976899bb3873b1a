//! Bursts of a hundred messages through both bridges.

use std::time::Duration;

use system_tests::Cell;

use crate::ends::{MeterReport, SendingPace};
use crate::floods::bridges_dropped;
use crate::through::{NAMES, WAITING, Ways};

pub(crate) fn measure(cell: &Cell, bursts: u64) {
    let mut ways = Ways::stand(cell, WAITING);
    println!("\n{bursts} bursts of {BURST} messages of 1 KiB; microseconds:\n");
    println!(
        "| rate in a burst | way | sent | lost | repeated | out of order | dropped by the bridges | p50 | last of 100 |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for rate in [10_000, 30_000] {
        let mut all = [
            MeterReport::default(),
            MeterReport::default(),
            MeterReport::default(),
        ];
        let mut dropped = [0; 3];
        for _ in 0..bursts {
            for (way, (all, dropped)) in all.iter_mut().zip(&mut dropped).enumerate() {
                let pace = SendingPace {
                    ticks: BURST,
                    size: 1024,
                    period: Duration::from_secs(1) / rate,
                    burst: 0,
                    pause: Duration::ZERO,
                };
                let before = bridges_dropped();
                all.extend(ways.send(way, pace));
                *dropped += bridges_dropped() - before;
            }
        }
        for ((name, mut all), dropped) in NAMES.into_iter().zip(all).zip(dropped) {
            let sent = bursts * BURST;
            println!(
                "| {} k/s | {name} | {sent} | {} | {} | {} | {dropped} | {:.0} | {:.0} |",
                rate / 1000,
                sent - all.distinct,
                all.repeated,
                all.disordered,
                all.times.at(0.5),
                all.times.at(0.99)
            );
        }
    }
}

const BURST: u64 = 100;
