//! The demo of plug and produce, from the first component to the last question, with the programs that people run.

use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, Started, program};

const MANIFEST: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../shared/data/mtp/pimad-core/PiMAd-core.0-0-1.aml"
);

#[test]
fn components_are_found_run_lost_and_replaced_within_the_published_times() {
    let Some(_cell) = Cell::with(&[]) else { return };
    // The module of the example plant stands in where that of another maker is not.
    let manifest = ["--manifest", MANIFEST];
    let manifest = if Path::new(MANIFEST).exists() {
        &manifest[..]
    } else {
        &[]
    };
    let mut demo = Started::new("demo", &program("demo"))
        .args(["--scenario", "plug-and-produce", "--speed", "8", "--json"])
        .args(manifest)
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
        // 211 ms were published for the fastest of three components, on a machine of its own.
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
    assert_eq!(report["question"]["skills"], 5, "{report}");
}
