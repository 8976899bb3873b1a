//! Skills with an unknown last outcome: they do not start before an operator resets them.

use std::fs;

use serde_json::json;
use system_tests::{Cell, Peer, StartedChild, eventually, metrics, program};

use super::{SOON, component};

/// A program that writes a line for each run. The first run ends without a result.
const WORK: &str = r#"read start
echo run >> runs
if [ "$(wc -l < runs)" -gt 1 ]; then
  echo '{"result": {"Gripped": true}}'
fi
"#;

const GRIPPER: &str = "
component: cup
application_uri: urn:ua-bridge:system-tests:component
namespace: 9
skills:
  - {name: Grasp, type: GraspSkillType, driver: {exec: {command: [sh, work.sh]}}}
";

fn ua_space(words: &[&str]) -> (i32, String) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--interface", "lo"])
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.lines().join("\n"))
}

#[test]
fn a_skill_is_started_after_an_unknown_outcome_only_with_reset() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _work = cell.file("work.sh", WORK);
    let _component = component(&cell.file("cup.yaml", GRIPPER));
    let runs = || {
        let lines = fs::read_to_string(cell.folder().join("runs")).unwrap_or_default();
        lines.lines().count()
    };

    let (code, told) = ua_space(&["skills", "start", "cup.Grasp"]);
    assert!(
        code != 0 && told.contains("the outcome is unknown") && told.contains("without a result"),
        "{code} {told}"
    );
    assert_eq!(runs(), 1);
    // Neither verb starts it: the machine may move.
    let (code, told) = ua_space(&["skills", "start", "cup.Grasp"]);
    assert!(
        code == 1 && told.contains("cup.Grasp is not started") && told.contains("--reset"),
        "{code} {told}"
    );
    let (code, told) = ua_space(&["call", "cup.Grasp"]);
    assert!(
        code == 1 && told.contains("BadInvalidState"),
        "{code} {told}"
    );
    assert_eq!(runs(), 1);

    let (code, told) = ua_space(&["skills", "start", "cup.Grasp", "--reset"]);
    assert!(code == 0 && told.contains("succeeded"), "{code} {told}");
    assert_eq!(runs(), 2);
}

const MACHINE: &str = "opc.tcp://127.0.0.1:4857";
const MAPPING: &str = "
namespaces: {12: 'urn:ua-bridge:system-tests:machine'}
servers:
  - {name: press, endpoint: 'opc.tcp://127.0.0.1:4857', security: None, skills: 12}
";

#[test]
fn a_start_that_a_machine_does_not_answer_is_sent_once_and_reported_as_unknown() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("press.yaml", MAPPING);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let machine = cell.asyncua_started("opcua_programs.py", &[MACHINE, "--deaf"]);
    let machine = machine.start().ready(SOON);
    eventually("the machine is connected", SOON, || {
        let server = metrics(system_tests::METRICS_SERVER)?["servers"][0].clone();
        (server["up"] == true).then_some(())
    });
    eventually("the skill is reset", SOON, || {
        (ua_space(&["call", "press.Stamp.Reset", "--wait", "20"]).0 == 0).then_some(())
    });
    let (code, told) = ua_space(&["call", "press.Stamp", "Force=5", "--timeout", "20"]);
    assert!(code == 69 && told.contains("is not known"), "{code} {told}");
    let started = |lines: Vec<serde_json::Value>| {
        let started = lines
            .iter()
            .filter(|line| line["started"] == json!("Stamp"));
        started.count()
    };
    assert_eq!(started(machine.json_lines()), 1);
}
