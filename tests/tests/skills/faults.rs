//! Skills that lose their component or client, and clients that compete for the same skill.

use std::time::{Duration, Instant};

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

use super::{COMPONENT, ENDPOINT, SOON, component, line_of};

#[test]
fn a_component_that_was_killed_in_a_run_does_not_go_on_with_it_nor_give_its_number_again() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let yaml = cell.file("component.yaml", COMPONENT);
    let mut first = component(&yaml);
    let begun = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "begin"]);
    let run = begun[0]["run"].as_u64().unwrap();
    first.signal(nix::sys::signal::Signal::SIGKILL);
    first.wait_for_end(SOON);
    let _second = component(&yaml);
    let after = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, &format!("after:{run}")]);
    let [after] = after.as_slice() else {
        panic!("{after:?}");
    };
    assert_eq!(
        (&after["state"], &after["shown"], &after["known"]),
        (&json!("Halted"), &json!(0), &json!("BadNotFound"))
    );
    assert_eq!(after["status"], json!("Good"));
    assert!(after["run"].as_u64() > Some(run), "{run} and {after}");
}

#[test]
fn a_session_that_has_nothing_done_keeps_nobody_from_the_component_for_long() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let yaml = format!("lease: 2 s\n{COMPONENT}");
    let _component = component(&cell.file("component.yaml", &yaml));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "idle"]);
    assert_eq!(line_of(&lines, "at once")["status"], json!("BadLocked"));
    let later = line_of(&lines, "later");
    let seconds = later["seconds"].as_f64().unwrap();
    assert!((1.5..10.0).contains(&seconds), "{later}");
    // The other client has the lease.
    assert_eq!(later["mine"], json!("BadLocked"));
}

#[test]
fn of_two_sessions_that_begin_at_once_one_does_and_the_other_is_told() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _component = component(&cell.file("component.yaml", COMPONENT));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "race"]);
    let runs: Vec<u64> = lines
        .iter()
        .inspect(|line| assert_eq!(line["race"], json!(["BadLocked", "Good"])))
        .map(|line| line["runs"][0].as_u64().unwrap())
        .collect();
    assert_eq!(runs.len(), 20);
    // Each race started a single run, and no further runs were started.
    assert!(runs.windows(2).all(|two| two[1] == two[0] + 1), "{runs:?}");
}

/// The robot's address; the composite finds the robot by its name alone.
const ROBOT: &str = "opc.tcp://127.0.0.1:24840";
const HANDLING: &str = "opc.tcp://127.0.0.1:12346";
const GRIPPER: &str = "opc.tcp://127.0.0.1:10254";

fn part(cell: &Cell, name: &str, endpoint: &str, yaml: &str) -> Child {
    let file = cell.file(&format!("{name}.yaml"), yaml);
    let child = StartedChild::new(name, &program("ua-component"))
        .args([file])
        .args(["--endpoint", endpoint, "--lds", "none", "--interface", "lo"])
        .start();
    eventually("the component serves", SOON, || {
        std::net::TcpStream::connect(endpoint.trim_start_matches("opc.tcp://")).ok()
    });
    child
}

fn ua_space(words: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--interface", "lo"])
        .start()
}

#[test]
fn a_composite_halts_and_retreats_within_two_seconds_when_a_component_is_killed_in_mid_skill() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _robot = part(
        &cell,
        "robot",
        ROBOT,
        "{component: robot, application_uri: 'urn:ua-bridge:system-tests:robot', namespace: 6, skills: [
            {name: Ptp, type: PtpMoveSkillType, driver: {simulated: {reach: 1.3, time_scale: 50}}},
            {name: Linear, type: LinearMoveSkillType, driver: {simulated: {reach: 1.3, time_scale: 50}}}]}",
    );
    let mut gripper = part(
        &cell,
        "gripper",
        GRIPPER,
        "{component: gripper, application_uri: 'urn:ua-bridge:system-tests:gripper', namespace: 7, skills: [
            {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 60 s}}},
            {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}]}",
    );
    let _handling = part(
        &cell,
        "handling",
        HANDLING,
        &format!(
            "{{component: handling, application_uri: 'urn:ua-bridge:system-tests:handling', namespace: 8, skills: [
            {{name: Place, type: PickAndPlaceSkillType,
              driver: {{pick_and_place: {{robot: 'urn:ua-bridge:system-tests:robot', gripper: '{GRIPPER}', within: 60 s}}}}}}]}}"
        ),
    );
    let uses = cell.asyncua_once("opcua_skill.py", &[HANDLING, "uses"]);
    let uses: Vec<&Value> = uses.iter().map(|line| &line["uses"]).collect();
    assert_eq!(uses.len(), 4, "{uses:?}");
    assert!(
        uses.contains(&&json!([GRIPPER, "GraspSkillType"])),
        "{uses:?}"
    );
    let mut reset = ua_space(&["call", "handling.Place.Reset"]);
    assert!(reset.wait_for_end(SOON).success(), "{reset}");
    let mut run = ua_space(&[
        "call",
        "handling.Place",
        "PickPosition=0.4,0.2,0.1,0,0,0",
        "PlacePosition=0.4,-0.2,0.1,0,0,0",
        "--json",
    ]);
    let has = |run: &Child, what: &dyn Fn(&Value) -> bool| run.json_lines().iter().any(what);
    eventually("the gripper is at work", SOON, || {
        has(&run, &|line| line["step"] == "Grasp").then_some(())
    });
    let killed = Instant::now();
    gripper.signal(nix::sys::signal::Signal::SIGKILL);
    eventually("the composite is halted", SOON, || {
        has(&run, &|line| line["state"] == "Halted").then_some(())
    });
    let took = killed.elapsed();
    assert!(took < Duration::from_secs(2), "{took:?} {run}");
    assert_eq!(run.wait_for_end(SOON).code(), Some(1), "{run}");
    let lines = run.json_lines();
    let result = lines.iter().find(|line| line["event"] == "result");
    let message = result.unwrap()["message"].as_str().unwrap().to_owned();
    // Whether the gripper holds the part is unknown.
    assert!(
        message.starts_with("the outcome is unknown: Grasp: gripper.")
            && message.contains(" is lost: ")
            && message.ends_with("the robot has retreated"),
        "{message}"
    );
    gripper.wait_for_end(SOON);
}
