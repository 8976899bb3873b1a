//! 500 messages of 1 KiB in a burst, as sent by a node that had to wait for its data.

use crate::path::RelayPath;
use system_tests::Times;

pub(crate) fn measure(paths: &mut [RelayPath], bursts: u64) {
    let mut all: Vec<(Times, u64)> = paths.iter().map(|_| (Times::default(), SIZE)).collect();
    for _ in 0..bursts {
        for (path, (times, fewest)) in paths.iter_mut().zip(&mut all) {
            let burst = path.lane.stream(SIZE, 1024, None);
            *fewest = burst.count().min(*fewest);
            times.extend(burst);
        }
    }
    println!("\n{bursts} bursts of {SIZE} messages of 1 KiB; microseconds:\n");
    println!("| path | sent | delivered | fewest of a burst | p50 | last of 100 |");
    println!("|---|---|---|---|---|---|");
    for (path, (times, fewest)) in paths.iter().zip(&mut all) {
        println!(
            "| {} | {} | {} | {fewest} | {:.0} | {:.0} |",
            path.name,
            bursts * SIZE,
            times.count(),
            times.at(0.5),
            times.at(0.99)
        );
    }
}

const SIZE: u64 = 500;
