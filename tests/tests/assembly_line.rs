//! The demo of the assembly line with the programs that users run. The work is done by skills
//! (mappings/line-by-skills.yaml), or by topics with a conveyor that is switched by a call.

use std::time::Duration;

use system_tests::{Cell, StartedChild, program};

#[test]
fn the_conveyor_is_switched_by_a_call_and_the_line_goes_on_without_it() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let mut demo = StartedChild::new("demo", &program("demo"))
        .args(["--scenario", "line-by-topics", "--speed", "10", "--json"])
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(180));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report}");
    assert_eq!(report["finished"], true, "{report}");
    // Some covers went by the conveyor before it was switched off, the others without it.
    let by = ["by_conveyor", "by_turtlebot"].map(|by| report[by].as_u64().unwrap_or_default());
    assert!(by.iter().all(|covers| *covers > 0), "{report}");
    assert_eq!(by.iter().sum::<u64>(), 4, "{report}");
    let off = report["conveyor_off_at_s"].as_f64().unwrap_or_default();
    assert!((25.0..40.0).contains(&off), "{report}");
    let answered = report["switch_answered_us"].as_array().unwrap();
    assert_eq!(answered.len(), 2, "on and off: {report}");
}

#[test]
fn a_line_of_skills_takes_back_what_a_dead_conveyor_was_to_carry_and_goes_on_without_it() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let mut demo = StartedChild::new("demo", &program("demo"))
        .args(["--speed", "10", "--json"])
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(180));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report}");
    assert_eq!(report["finished"], true, "{report}");
    // Two covers arrived before the conveyor died; the third was on its way to the conveyor.
    let counts = ["by_conveyor", "by_turtlebot", "taken_back"].map(|of| report[of].as_u64());
    assert_eq!(counts, [Some(2), Some(2), Some(1)], "{report}");
    let told = report["told_lost_ms"].as_f64();
    assert!(told.is_some_and(|ms| ms <= 2000.0), "{report}");
    let runs = report["runs"].as_array().unwrap().iter();
    let runs: Vec<(&str, &str)> = runs
        .filter(|run| run["message"] == "")
        .map(|run| {
            (
                run["skill"].as_str().unwrap(),
                run["what"].as_str().unwrap(),
            )
        })
        .collect();
    let (arm, belt, base) = (
        "line-handling.PickAndPlace",
        "line-conveyor.Run",
        "line-base.NavigateTo",
    );
    let driven = [(base, "to the worker"), (base, "to the park")];
    let wanted = [
        (belt, "runs"),
        (arm, "from the storage to the conveyor"),
        (belt, "runs"),
        (arm, "from the storage to the conveyor"),
        (belt, "runs"),
        (arm, "from the storage to the conveyor"),
        (arm, "from the conveyor to the bucket"),
    ];
    let last = [(arm, "from the storage to the bucket")];
    assert_eq!(
        runs,
        [&wanted[..], &driven, &last, &driven].concat(),
        "{report}"
    );
}
