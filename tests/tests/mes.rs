//! The MES with components that start, are killed and are replaced: its knowledge, and the outcome
//! of processes.

use std::fs;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{Cell, Child, Started, eventually, http_get, program};

const SOON: Duration = Duration::from_secs(30);
const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/plant");
/// A module with six procedures.
const MANIFEST: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/mtp/stage.aml");
const AT: &str = "127.0.0.1:8087";
const PROCESS: &str = "urn:example:process:move-part";

/// Starts a program of the plant with a modified file of the examples.
fn start(cell: &Cell, name: &str, file: &str, changes: &[(&str, &str)], more: &[&str]) -> Child {
    let text = fs::read_to_string(Path::new(EXAMPLES).join(file)).unwrap();
    let text = changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "{file} has no {from}");
        text.replace(from, to)
    });
    let path = cell.file(file, &text);
    Started::new(file, &program(name))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(more)
        .start()
}

fn get(path: &str) -> Option<Value> {
    serde_json::from_str(&http_get(AT, path)?).ok()
}

fn rows(question: &str) -> Vec<Value> {
    let answer = get(&format!("/ask/{question}")).unwrap_or_default();
    answer["rows"].as_array().cloned().unwrap_or_default()
}

/// Waits until the run of the process is as wanted, and returns it.
fn run(what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    eventually(what, SOON, || {
        let run = get("/status")?["runs"][0].clone();
        wanted(&run).then_some(run)
    })
}

/// Returns a list of an answer.
fn list<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value[key].as_array().map_or(&[], Vec::as_slice)
}

/// Starts the MES and requests the process while no component is available for it.
fn mes(cell: &Cell) -> Child {
    for file in ["capabilities.ttl", "vacuum-gripper.xml"] {
        fs::copy(Path::new(EXAMPLES).join(file), cell.folder().join(file)).unwrap();
    }
    let manifests = format!("manifests: [{{name: dancer, file: {MANIFEST}}}]\nprocesses:\n");
    let changes = [("processes:\n", manifests.as_str())];
    let mes = start(cell, "ua-mes", "mes.yaml", &changes, &["--run", PROCESS]);
    let waiting = run("the process waits for somebody", |run| {
        run["waits_for"].is_string()
    });
    let waits_for = waiting["waits_for"].as_str().unwrap();
    assert!(
        waits_for.contains("urn:example:capability:grasp"),
        "{waits_for}"
    );
    mes
}

#[test]
fn a_gripper_that_is_killed_in_the_middle_is_replaced_by_another_makers() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _mes = mes(&cell);
    let fast = [("{reach: 1.3}", "{reach: 1.3, time_scale: 20}")];
    let _robot = start(&cell, "ua-component", "robot.yaml", &fast, &[]);
    let slow = [("400 ms", "60 s")];
    let gripper = start(&cell, "ua-component", "parallel-gripper.yaml", &slow, &[]);
    run("the gripper grasps", |run| {
        let last = list(&run["plans"][0], "ran").last();
        last.is_some_and(|ran| ran["step"] == "Grasp" && ran["outcome"] == "running")
    });
    let can_run = rows("what-can-run");
    let of = |component: &str| {
        let rows = can_run.iter().filter(|row| row["component"] == component);
        rows.count()
    };
    let there = ["robot", "parallel-gripper", "mes", "Stage:1.0.0"].map(of);
    assert_eq!(there, [2, 2, 1, 6], "{can_run:?}");
    let plan = get(&format!("/plan/{PROCESS}")).unwrap();
    assert_eq!(plan["complete"], true, "{plan}");

    gripper.signal(Signal::SIGKILL);
    let broken = run("the plan is broken and another is waited for", |run| {
        run["plans"][0]["outcome"] == "failed" && run["waits_for"].is_string()
    });
    let plan = &broken["plans"][0];
    assert_eq!(plan["retreated"], true, "{broken}");
    let ran: Vec<_> = list(plan, "ran")
        .iter()
        .filter_map(|ran| ran["step"].as_str())
        .collect();
    let steps = ["MovePickApproachBefore", "MovePick", "Grasp"];
    assert_eq!(ran, [&steps[..], &["MovePickApproachError"]].concat());
    eventually("the gripper is gone from the graph", SOON, || {
        let there = rows("components");
        let mut names = there.iter().map(|row| &row["name"]);
        names.all(|name| name != "parallel-gripper").then_some(())
    });

    let fast = [("300 ms", "50 ms"), ("200 ms", "50 ms")];
    let _vacuum = start(&cell, "ua-component", "vacuum-gripper.yaml", &fast, &[]);
    let done = run("the process is done", |run| run["outcome"] == "done");
    is_replaced(&done);
}

/// Checks that the vacuum gripper was chosen by the supertype and capability of its skill, and that
/// the graph has the whole run.
fn is_replaced(run: &Value) {
    let [_, plan] = list(run, "plans") else {
        panic!("{run}")
    };
    assert_eq!(plan["outcome"], "done", "{run}");
    let mut needs = list(&plan["steps"][0], "needs").iter();
    let grasp = needs.find(|need| need["role"] == "grasp").unwrap();
    assert_eq!(grasp["chosen"], "urn:example:vacuum-gripper#i=100");
    let why = grasp["candidates"][0]["why"].as_str().unwrap();
    let by_subclass = "hold-by-vacuum, which is below urn:example:capability:grasp";
    assert!(why.contains(by_subclass), "{why}");
    let by_type = rows("skills?type=urn:ua-bridge:skills%23i=1200");
    let types: Vec<&Value> = by_type.iter().map(|row| &row["type"]).collect();
    assert_eq!(types, ["VacuumGraspSkillType"], "by the type above its own");
    // The graph is updated after `/status`.
    let ran = eventually("the graph has the run as done", SOON, || {
        let done = rows("runs").first()?["outcome"] == "done";
        done.then(|| rows("run-steps"))
    });
    let lost = ran.iter().filter(|row| row["outcome"] == "lost");
    let lost: Vec<&Value> = lost.map(|row| &row["component"]).collect();
    assert_eq!(lost, ["urn:example:gripper"]);
}

#[test]
fn a_manifest_cut_in_half_and_an_unknown_process_are_told_with_their_names() {
    let Some(cell) = Cell::with(&[]) else { return };
    let half = "<CAEXFile>\n<InstanceHierarchy Name=\"a\">\n<InternalElement";
    let half = cell.file("half.aml", half);
    fs::copy(
        Path::new(EXAMPLES).join("capabilities.ttl"),
        cell.folder().join("capabilities.ttl"),
    )
    .unwrap();
    let manifests = format!(
        "manifests: [{{name: half, file: {}}}]\nprocesses:\n",
        half.display()
    );
    let mut mes = start(
        &cell,
        "ua-mes",
        "mes.yaml",
        &[("processes:\n", &manifests)],
        &[],
    );
    assert_eq!(mes.wait_for_end(SOON).code(), Some(78));
    let told = mes.to_string();
    assert!(told.contains("half: line 3:"), "{told}");
    let mut mes = start(
        &cell,
        "ua-mes",
        "mes.yaml",
        &[],
        &["--run", "urn:example:process:nothing"],
    );
    assert!(!mes.wait_for_end(SOON).success());
    assert!(
        mes.to_string()
            .contains("--run urn:example:process:nothing"),
        "{mes}"
    );
}
