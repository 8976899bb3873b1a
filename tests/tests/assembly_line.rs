//! The demo of the assembly line, with the programs that people run: its conveyor is switched by a call.

use std::time::Duration;

use system_tests::{Cell, Started, program};

#[test]
fn the_conveyor_is_switched_by_a_call_and_the_line_goes_on_without_it() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let mut demo = Started::new("demo", &program("demo"))
        .args(["--speed", "10", "--json"])
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(180));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report}");
    assert_eq!(report["finished"], true, "{report}");
    // Some went by the conveyor before it was switched off, and the others without it.
    let by = ["by_conveyor", "by_turtlebot"].map(|by| report[by].as_u64().unwrap_or_default());
    assert!(by.iter().all(|covers| *covers > 0), "{report}");
    assert_eq!(by.iter().sum::<u64>(), 4, "{report}");
    let off = report["conveyor_off_at_s"].as_f64().unwrap_or_default();
    assert!((25.0..40.0).contains(&off), "{report}");
    let answered = report["switch_answered_us"].as_array().unwrap();
    assert_eq!(answered.len(), 2, "on and off: {report}");
}
