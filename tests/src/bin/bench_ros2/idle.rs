//! The resources of an idle `bridge-ros2`.

use std::time::Duration;

use system_tests::{Cell, processor_time, resident, threads};

use crate::many::{FIRST, TOPICS, mapping};

pub(crate) fn measure(cell: &Cell, seconds: u64) {
    println!("\nNothing to do for {seconds} s:\n");
    println!("| bridge-ros2 | CPU share | RSS | threads |");
    println!("|---|---|---|---|");
    let topics = cell.file("idle.yaml", &mapping(2));
    for (name, args) in [
        ("without a mapping, nobody else in the domain", vec![]),
        (
            "50 topics, each with a subscriber and a publisher of Cyclone DDS",
            vec![topics.to_str().unwrap()],
        ),
    ] {
        let bridge = cell.bridge_ros2(&args);
        let _peers = (!args.is_empty()).then(|| {
            let (topics, first) = (TOPICS.to_string(), FIRST.to_string());
            let many = ["--topics", &topics, "--first", &first, "--limit", "1800"];
            ["meter", "pace"].map(|role| cell.cyclone_c(&[&[role, "/ua_2_2_"], &many[..]].concat()))
        });
        // Time in which endpoints settle.
        std::thread::sleep(Duration::from_secs(5));
        let before = processor_time(bridge.id());
        std::thread::sleep(Duration::from_secs(seconds));
        let used = processor_time(bridge.id()) - before;
        println!(
            "| {name} | {:.2} % | {:.0} MB | {} |",
            used.as_secs_f64() / seconds as f64 * 100.0,
            resident(bridge.id()) as f64 / 1e6,
            threads(bridge.id())
        );
    }
}
