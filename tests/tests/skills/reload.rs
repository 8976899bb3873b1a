//! The YAML of a component, which is saved while a client of another maker uses the component.

use std::fs;
use std::path::Path;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, metrics, program};

use super::{COMPONENT, ENDPOINT, SOON, component};

const METRICS: &str = "127.0.0.1:9855";

/// Saves a file as editors do: writes another file and renames it.
fn save(file: &Path, text: &str) {
    let beside = file.with_extension("new");
    fs::write(&beside, text).unwrap();
    fs::rename(beside, file).unwrap();
}

fn about() -> Option<Value> {
    metrics(METRICS).map(|status| status["mapping"].clone())
}

/// Waits until the component has adopted and refused so many versions.
fn reloaded(bench: &Child, (adopted, refused): (u64, u64)) -> Value {
    let wanted = (json!(adopted), json!(refused));
    eventually(&format!("reloads of {bench}"), SOON, || {
        let about = about()?;
        ((&about["reloads"], &about["refused"]) == (&wanted.0, &wanted.1)).then_some(about)
    })
}

/// Calls a method of a skill, or runs the skill to its end.
fn call(name: &str) {
    let mut called = StartedChild::new("ua-space", &program("ua-space"))
        .args(["call", name, "--interface", "lo"])
        .start();
    assert!(called.wait_for_end(SOON).success(), "{called}");
}

fn begin(cell: &Cell) -> Value {
    let begun = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "begin"]);
    assert_eq!(begun[0]["status"], "Good");
    begun[0]["run"].clone()
}

/// Checks that a run is in progress.
fn assert_runs(cell: &Cell, run: &Value) {
    let after = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, &format!("after:{run}")]);
    assert_eq!(
        (&after[0]["state"], &after[0]["shown"]),
        (&json!("Running"), run)
    );
}

#[test]
fn a_saved_component_acts_on_the_next_run_and_a_run_in_progress_goes_on() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.file("component.yaml", COMPONENT);
    let bench = component(&file);
    let run = begin(&cell);

    let short = COMPONENT.replace("10 min", "100 ms");
    save(&file, &short);
    let about = reloaded(&bench, (1, 0));
    let changes = json!(["skills.Hold.driver: changed, from the next run on"]);
    assert_eq!(about["changes"], changes);
    assert_runs(&cell, &run);
    call("bench.Hold.Halt");
    call("bench.Hold.Reset");
    call("bench.Hold");

    save(
        &file,
        &short.replace(
            "name: Let, type: ReleaseSkillType",
            "name: Let, type: ReleasSkillType",
        ),
    );
    let about = reloaded(&bench, (1, 1));
    let stale = about["stale"].as_str().unwrap_or_default();
    assert!(
        stale.ends_with("component.yaml cannot run (1 error)"),
        "{about}"
    );
    let finding = "component.yaml:7:23: P020: there is no type";
    eventually("the finding is in the log", SOON, || {
        let lines = bench.lines();
        lines
            .iter()
            .any(|line| line.contains(finding))
            .then_some(())
    });
    call("bench.Hold");

    save(&file, COMPONENT);
    let about = reloaded(&bench, (2, 1));
    assert_eq!(about["stale"], Value::Null);
    bench.signal(Signal::SIGHUP);
    assert_eq!(reloaded(&bench, (3, 1))["changes"], Value::Null);

    let run = begin(&cell);
    let more = "  - {name: Again, type: GraspSkillType, driver: simulated}\n";
    save(&file, &format!("{COMPONENT}{more}"));
    let about = reloaded(&bench, (4, 1));
    let change =
        "skills.Again: added, at the restart when no skill runs and no client holds the lease";
    assert_eq!(about["changes"], json!([change]));
    assert_runs(&cell, &run);
    call("bench.Hold.Halt");
    // The counters of the restarted program begin at 0.
    reloaded(&bench, (0, 0));
    let found = eventually("the restarted component serves the new skill", SOON, || {
        let found = cell.asyncua_try("opcua_skill.py", &[ENDPOINT, "find:GraspSkillType"])?;
        let mut names: Vec<String> = found.iter().map(|line| line["name"].to_string()).collect();
        // The order of the skills is that of their references.
        names.sort();
        (names.len() == 2).then_some(names)
    });
    assert_eq!(found, [r#""Again""#, r#""Hold""#]);
}

#[test]
fn a_change_of_the_identity_waits_for_the_operator() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let file = cell.file("component.yaml", COMPONENT);
    let bench = component(&file);
    save(
        &file,
        &COMPONENT.replace("namespace: 9", "namespace: 10\nlease: 5 s"),
    );
    let about = eventually("the restart is needed", SOON, || {
        let about = reloaded(&bench, (1, 0));
        (about["restart_needed"] != json!([])).then_some(about)
    });
    assert_eq!(about["restart_needed"], json!(["namespace", "lease"]));
    call("bench.Let.Reset");
    call("bench.Let");
    assert_eq!(
        reloaded(&bench, (1, 0))["restart_needed"],
        about["restart_needed"]
    );
}
