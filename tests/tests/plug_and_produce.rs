//! The demo of plug and produce, from the first component to the last query, with the programs that
//! users run.

use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, StartedChild, program};

const MANIFEST: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/mtp/stage.aml");

#[test]
fn components_are_found_run_lost_and_replaced_within_the_published_times() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let mut demo = StartedChild::new("demo", &program("demo"))
        .args(["--scenario", "plug-and-produce", "--speed", "8", "--json"])
        .args(["--manifest", MANIFEST])
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(120));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report}");
    assert_eq!(report["finished"], true, "{report}");
    let ms = |value: &Value| value.as_f64().unwrap_or(f64::MAX);
    for part in ["robot", "gripper", "vacuum"] {
        let known = &report["components"][part];
        assert_eq!(
            known.as_object().map(serde_json::Map::len),
            Some(8),
            "{known}"
        );
        assert!(
            known.as_object().unwrap().values().all(Value::is_number),
            "{known}"
        );
        let first = ms(&known["announced"]).min(ms(&known["registered"]));
        // Published were 211 ms for the fastest of three components, on an otherwise idle machine.
        assert!(ms(&known["listed"]) - first < 1000.0, "{part}: {known}");
    }
    for ros in ["ros1", "ros2"] {
        let states = report["grasps"][ros]["states"].as_array().unwrap();
        let last: Vec<&str> = states
            .iter()
            .rev()
            .take(3)
            .filter_map(Value::as_str)
            .collect();
        assert_eq!(last, ["Ready", "Running", "Ready"], "{ros}");
    }
    assert_eq!(report["runs"][0]["plans"], 1, "{report}");
    assert_eq!(report["runs"][1]["plans"], 2, "{report}");
    let loss = &report["loss"];
    for level in ["announced", "registered", "in_graph"] {
        assert!(ms(&loss["lost_ms"][level]) <= 2500.0, "{level}: {loss}");
    }
    assert_eq!(report["question"]["skills"], 6, "{report}");
}

/// Returns whether the steps of a composite are in order; polling may miss short steps.
fn are_in_order(seen: &Value, steps: &[&str]) -> bool {
    let mut left = steps.iter();
    let seen = seen.as_array().unwrap();
    seen.iter().all(|step| left.any(|known| step == known))
}

fn tool_change(more: &[&str]) -> Value {
    let mut demo = StartedChild::new("demo", &program("demo"))
        .args(["--scenario", "tool-change", "--speed", "16", "--json"])
        .args(more)
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(150));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report} {demo}");
    report
}

#[test]
fn a_robot_changes_its_tools_and_survives_the_loss_of_one_wherever_they_hang() {
    let Some(_cell) = Cell::with(&[]) else { return };
    for more in [&[][..], &["--swap-tools"]] {
        let report = tool_change(more);
        assert_eq!(
            (&report["finished"], &report["robots"]),
            (&Value::from(true), &Value::from(2)),
            "{report}"
        );
        let runs = report["runs"].as_array().unwrap();
        let ran: Vec<(&str, &str, bool)> = runs
            .iter()
            .map(|run| {
                let succeeded = run["succeeded"].as_bool().unwrap();
                (
                    run["skill"].as_str().unwrap(),
                    run["what"].as_str().unwrap(),
                    succeeded,
                )
            })
            .collect();
        let expected = [
            ("tool-changer.ChangeTool", "robotiq-2f85", true),
            ("handling.Place", "a part", true),
            ("tool-changer.ChangeTool", "schmalz-ecbpi", true),
            ("handling.Place", "a part", false),
            ("handling.Place", "a part", true),
            ("tool-changer.DetachTool", "no tool", true),
        ];
        assert_eq!(ran, expected);
        let told = runs[3]["message"].as_str().unwrap();
        assert!(
            told.contains("is lost") && told.ends_with("the robot has retreated"),
            "{told}"
        );
        let take = [
            "BackDoor",
            "Park",
            "Lock",
            "BackRotate",
            "FrontDoor",
            "WaitForTool",
            "Approach",
            "WaitForReady",
        ];
        assert!(are_in_order(&runs[0]["steps"], &take), "{}", runs[0]);
        let put = [
            "PowerOff",
            "Approach",
            "FrontDoor",
            "Start",
            "Unlock",
            "Park",
            "BackDoor",
            "WaitForRelease",
        ];
        assert!(
            are_in_order(&runs[2]["steps"], &[put, take].concat()),
            "{}",
            runs[2]
        );
        assert!(are_in_order(&runs[5]["steps"], &put), "{}", runs[5]);
        assert!(report["told_lost_ms"].as_f64() < Some(10_000.0), "{report}");
        assert!(
            report["found_again_ms"].as_f64() < Some(10_000.0),
            "{report}"
        );
    }
}

/// Plays a story of processes to its end, and returns its report.
fn told(scenario: &str, speed: &str) -> Value {
    let mut demo = StartedChild::new("demo", &program("demo"))
        .args(["--scenario", scenario, "--speed", speed, "--json"])
        .start();
    let ended = demo.wait_for_end(Duration::from_secs(170));
    let report = demo.json_lines().pop().unwrap_or_default();
    assert!(ended.success(), "{report} {demo}");
    assert_eq!(report["finished"], true, "{report}");
    report
}

#[test]
fn a_fuse_that_hits_the_box_is_inserted_by_a_second_try_of_arms_of_two_makes() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let report = told("fuses", "4");
    let insertions = report["insertions"].as_array().unwrap();
    let arms: Vec<&Value> = insertions.iter().map(|of| &of["arm"]).collect();
    assert_eq!(arms, ["ur5", "fuse-arm"], "{report}");
    for insertion in insertions {
        let counts = ["tries", "resisted"].map(|of| insertion[of].as_u64());
        assert_eq!(counts, [Some(2), Some(1)], "{insertion}");
        assert_eq!(insertion["released"], true, "{insertion}");
        let far = insertion["from_seat_mm"].as_f64().unwrap();
        assert!(far.abs() < 1.0, "{insertion}");
        let steps = insertion["steps"].as_array().unwrap();
        let steps: Vec<&str> = steps.iter().filter_map(|of| of["step"].as_str()).collect();
        let expected = [
            "over the magazine",
            "down to the fuse",
            "grip",
            "lift",
            "over the slot",
            "insert",
            "back off",
            "shift",
            "insert again",
            "release",
            "away",
        ];
        assert_eq!(steps, expected);
    }
}

#[test]
fn terminal_blocks_come_onto_the_rail_by_a_gripper_that_the_robot_takes_and_puts_away() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let report = told("terminals", "16");
    let steps = report["steps"].as_array().unwrap();
    let ran: Vec<(&str, &str)> = steps
        .iter()
        .map(|step| {
            let text = |key: &str| step[key].as_str().unwrap();
            (text("step"), text("component"))
        })
        .collect();
    let (changer, handling) = ("urn:example:tool-changer", "urn:example:handling");
    let expected = [
        ("take the gripper", changer),
        ("first block", handling),
        ("second block", handling),
        ("third block", handling),
        ("put the gripper away", changer),
    ];
    assert_eq!(ran, expected, "{report}");
    // The simulated robot was with its fingers at each block and at its place on the rail.
    let visits = report["visits"].as_array().unwrap();
    assert_eq!(visits.len(), 6, "{report}");
    let nearest = visits
        .iter()
        .map(|visit| visit["nearest_mm"].as_f64().unwrap());
    assert!(nearest.into_iter().all(|mm| mm <= 0.1), "{report}");
}

#[test]
fn a_process_of_the_graph_uses_the_attached_tool_and_is_planned_anew_when_it_is_unplugged() {
    let Some(_cell) = Cell::with(&[]) else { return };
    for more in [&["--runs", "2"][..], &["--swap-tools"]] {
        let mut demo = StartedChild::new("demo", &program("demo"))
            .args(["--scenario", "process", "--speed", "16", "--json"])
            .args(more)
            .start();
        let ended = demo.wait_for_end(Duration::from_secs(170));
        let report = demo.json_lines().pop().unwrap_or_default();
        assert!(ended.success(), "{report} {demo}");
        let runs = report["runs"].as_array().unwrap();
        let grips = 2 * u64::try_from(runs.len()).unwrap();
        let counts = ["components", "grips", "right"].map(|of| report[of].as_u64());
        assert_eq!(counts, [Some(5), Some(grips), Some(grips)], "{report}");
        // The gripper was unplugged in the first run.
        assert!(runs[0]["plans"].as_u64() >= Some(2), "{report}");
        let waited_for = runs[0]["waited_for"].as_str().unwrap();
        assert!(waited_for.contains("grip the cover"), "{waited_for}");
        let is_move = |step: &&Value| step["parameters"].get("TargetPosition").is_some();
        for run in runs {
            let steps = run["steps"].as_array().unwrap();
            let mut arms = steps.iter().filter(is_move).map(|of| &of["component"]);
            assert!(arms.all(|arm| arm == "urn:example:ur5"), "{run}");
            let first = ["take the fingers", "over the part"];
            let began = [0, 1].map(|at: usize| steps[at]["step"].as_str().unwrap());
            assert_eq!(began, first);
        }
    }
}
