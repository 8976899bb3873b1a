//! Goals that are withdrawn before their action server, of rclpy, has decided about them. In each
//! case the goal is cancelled on acceptance, and nothing is reported as halted before.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, METRICS_ROS2, Peer, StartedChild, eventually, metrics, program,
};
use system_tests::{METRICS_SERVER, SERVER_ENDPOINT};

const SOON: Duration = Duration::from_secs(60);
const CELL: &str = "
spaces: [{id: 2, domain: 2}]
namespaces: {2: urn:cell}
calls:
  - {node: ns=2;i=70, name: Hasty, origin: 2, timeout: 1s, ros: {action: /hasty, type: test_msgs/Fibonacci}}
  - {node: ns=2;i=80, name: Patient, origin: 2, timeout: 20s, ros: {action: /patient, type: test_msgs/Fibonacci}}
";
const COMPONENT_METRICS: &str = "127.0.0.1:9105";

/// Starts a server that needs this many seconds to decide about a goal.
fn server(cell: &Cell, action: &str, seconds: &str) -> Child {
    let args = ["serve", action, "--decides-after", seconds];
    let server = cell.rclpy_started(Distribution::Kilted, "ros2_rclpy_action.py", &args);
    server.env("ROS_DOMAIN_ID", "2").told().start().ready(SOON)
}

fn asked(server: &mut Child, order: i32) {
    server.wait_for_json("the server is asked", SOON, |line| {
        (line.get("asked")? == order).then_some(())
    });
}

/// Checks that the goal was accepted and cancelled before it did anything else.
fn cancelled(server: &mut Child, order: i32) {
    let worked = server.wait_for_json("the goal ends", SOON, |line| {
        (line.get("worked")? == order).then(|| line.clone())
    });
    assert_eq!(worked["cancelled"], true, "{worked}");
}

fn call(words: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(["call"])
        .args(words)
        .args(["--interface", "lo", "--wait", "30", "--json"])
        .ends_on(Signal::SIGINT)
        .start()
}

fn event(child: &mut Child, event: &str) -> Value {
    child.wait_for_json(event, SOON, |line| {
        (line.get("event")? == event).then(|| line.clone())
    })
}

/// Returns the pending cancellations in `/status`.
fn pending(address: &str) -> Vec<Value> {
    let status = metrics(address).unwrap_or_default();
    let lines = status["cancellations_pending"].as_array();
    lines.cloned().unwrap_or_default()
}

#[test]
fn the_time_of_the_mapping_and_ctrl_c_cancel_a_goal_on_acceptance() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let (mut hasty, mut patient) = (server(&cell, "/hasty", "3"), server(&cell, "/patient", "3"));
    let mut bridge = cell.bridge_ros2_alone(&[mapping.to_str().unwrap()]).start();

    // The mapping gives the server one second.
    let mut call_of_hasty = call(&["Hasty", "order=100"]);
    asked(&mut hasty, 100);
    eventually("the cancellation is pending", SOON, || {
        (!pending(METRICS_ROS2).is_empty()).then_some(())
    });
    let result = event(&mut call_of_hasty, "result");
    assert_eq!(result["status"], "CANCELED", "{result}");
    assert_ne!(call_of_hasty.wait_for_end(SOON).code(), Some(0));
    cancelled(&mut hasty, 100);
    assert_eq!(pending(METRICS_ROS2), Vec::<Value>::new());

    // Ctrl-C waits for the end of the goal.
    let mut call_of_patient = call(&["Patient", "order=102"]);
    asked(&mut patient, 102);
    call_of_patient.signal(Signal::SIGINT);
    let result = event(&mut call_of_patient, "result");
    assert_eq!(result["status"], "CANCELED", "{result}");
    call_of_patient.wait_for_end(SOON);
    cancelled(&mut patient, 102);

    // A second Ctrl-C ends the program, and the goal is still cancelled.
    let mut call_of_patient = call(&["Patient", "order=104"]);
    asked(&mut patient, 104);
    call_of_patient.signal(Signal::SIGINT);
    call_of_patient.wait_for_line("cancelling the goal", SOON);
    call_of_patient.signal(Signal::SIGINT);
    call_of_patient.wait_for_line("outcome is unknown", SOON);
    call_of_patient.wait_for_end(SOON);
    cancelled(&mut patient, 104);

    // SIGTERM waits for pending cancellations.
    let call_of_patient = call(&["Patient", "order=106"]);
    asked(&mut patient, 106);
    call_of_patient.signal(Signal::SIGINT);
    eventually("the cancellation is pending", SOON, || {
        (!pending(METRICS_ROS2).is_empty()).then_some(())
    });
    bridge.signal(Signal::SIGTERM);
    cancelled(&mut patient, 106);
    bridge.wait_for_end(SOON);
}

#[test]
fn a_skill_is_halted_once_its_goal_has_ended() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let mut patient = server(&cell, "/patient", "6");
    let _bridge = cell.bridge_ros2_alone(&[mapping.to_str().unwrap()]).start();
    let component = cell.file(
        "arm.yaml",
        "
component: arm
application_uri: urn:ua-bridge:system-tests:arm
namespace: 7
endpoint: opc.tcp://127.0.0.1:0
security: [None]
skills:
  - {name: Grasp, type: GraspSkillType, driver: {action: {name: ua_2_2_80, within: 20 s, goal: {order: 200}, results: {Gripped: true}}}}
  - {name: Hasty, type: GraspSkillType, driver: {action: {name: ua_2_2_80, within: 1 s, goal: {order: 202}, results: {Gripped: true}}}}
  - {name: Leaving, type: GraspSkillType, driver: {action: {name: ua_2_2_80, goal: {order: 204}, results: {Gripped: true}}}}
",
    );
    let mut component = StartedChild::new("ua-component", &program("ua-component"))
        .args([&component])
        .args(["--interface", "lo", "--metrics", COMPONENT_METRICS])
        .start();
    let reset = |skill: &str| {
        assert_eq!(
            call(&[&format!("arm.{skill}.Reset")])
                .wait_for_end(SOON)
                .code(),
            Some(0)
        );
    };

    reset("Grasp");
    let mut run = call(&["arm.Grasp"]);
    asked(&mut patient, 200);
    let halt = call(&["arm.Grasp.Halt", "--no-wait"]).wait_for_end(SOON);
    assert_eq!(halt.code(), Some(0));
    let shown = pending(COMPONENT_METRICS);
    assert!(
        shown[0].as_str().unwrap().contains("cancellation pending"),
        "{shown:?}"
    );
    let is_halted = |run: &Child| {
        run.json_lines()
            .iter()
            .any(|line| line["state"] == "Halted")
    };
    assert!(!is_halted(&run), "the goal has not ended");
    cancelled(&mut patient, 200);
    event(&mut run, "result");
    run.wait_for_end(SOON);
    assert_eq!(pending(COMPONENT_METRICS), Vec::<Value>::new());

    reset("Hasty");
    let mut run = call(&["arm.Hasty"]);
    asked(&mut patient, 202);
    cancelled(&mut patient, 202);
    let result = event(&mut run, "result");
    assert_eq!(result["succeeded"], false, "{result}");
    assert!(
        result["message"].to_string().contains("cancelled"),
        "{result}"
    );
    run.wait_for_end(SOON);

    // The end of the component halts its skills and waits for their end.
    reset("Leaving");
    let _run = call(&["arm.Leaving"]);
    asked(&mut patient, 204);
    component.signal(Signal::SIGTERM);
    cancelled(&mut patient, 204);
    component.wait_for_end(SOON);
}

/// Starts a client that calls a method of the Program of `/patient`.
fn ask_program(cell: &Cell, method: &str, values: &Value) -> Child {
    let method = format!("UaSpace/Programs/Patient/{method}");
    let values = values.to_string();
    let args = [
        SERVER_ENDPOINT,
        &method,
        "--value",
        &values,
        "--patience",
        "40",
    ];
    cell.asyncua_started("opcua_call.py", &args).start()
}

fn status(client: &mut Child) -> Value {
    client.wait_for_json("the answer", SOON, |line| line.get("status").cloned())
}

/// Returns a value of the Program; empty if it cannot be read.
fn shown(cell: &Cell, path: &str) -> String {
    let node = format!("ns=1;s=ua_2_2_80.program.{path}");
    let read = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, &node]);
    read.map_or_else(String::new, |read| read[0]["value"].to_string())
}

#[test]
fn a_program_needs_a_reset_after_its_server_was_killed_or_ended_during_a_goal() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let mapping = mapping.to_str().unwrap();
    let mut patient = server(&cell, "/patient", "0");
    let _bridge = cell.bridge_ros2_alone(&[mapping]).start();
    let ask = |method: &str, values: &Value| status(&mut ask_program(&cell, method, values));
    let is = |state: &str| {
        eventually(&format!("the Program is {state}"), SOON, || {
            shown(&cell, "CurrentState").contains(state).then_some(())
        });
    };
    let mut server = cell.ua_server(&[mapping]);
    is("Ready");
    for (order, signal) in [(300, Signal::SIGKILL), (302, Signal::SIGTERM)] {
        assert_eq!(ask("Start", &json!([order])), "Good");
        patient.wait_for_json("the goal is accepted", SOON, |line| {
            (line.get("goal")? == order).then_some(())
        });
        is("Running");
        server.signal(signal);
        server.wait_for_end(SOON);
        server = cell.ua_server(&[mapping]);
        is("Halted");
        assert_eq!(shown(&cell, "FinalResultData.Status"), "0");
        assert_eq!(ask("Start", &json!([400])), "BadInvalidState");
        assert_eq!(ask("Reset", &json!([])), "Good");
        is("Ready");
    }
    // After a goal with a known end nothing is unknown.
    assert_eq!(ask("Start", &json!([3])), "Good");
    eventually("the goal has ended", SOON, || {
        (shown(&cell, "FinalResultData.Status") == "4").then_some(())
    });
    is("Ready");
    server.signal(Signal::SIGKILL);
    server.wait_for_end(SOON);
    server = cell.ua_server(&[mapping]);
    is("Ready");
    let is_asked = |line: &Value| line.get("goal") == Some(&json!(400));
    assert!(!patient.json_lines().iter().any(is_asked), "{server}");
}

#[test]
fn a_program_is_halted_once_its_goal_has_ended() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let mapping = mapping.to_str().unwrap();
    let mut patient = server(&cell, "/patient", "10");
    let _bridge = cell.bridge_ros2_alone(&[mapping]).start();
    let _server = cell.ua_server(&[mapping]);
    let ask = |method: &str, values: &Value| ask_program(&cell, method, values);
    let shown = |path: &str| shown(&cell, path);
    let mut started = ask("Start", &json!([300]));
    asked(&mut patient, 300);
    assert_eq!(status(&mut ask("Halt", &json!([]))), "Good");
    assert!(
        shown("CurrentState").contains("Running"),
        "the goal has not ended"
    );
    let lines = pending(METRICS_SERVER);
    assert!(
        lines[0].as_str().unwrap().contains("cancellation pending"),
        "{lines:?}"
    );
    cancelled(&mut patient, 300);
    eventually("the Program is Halted", SOON, || {
        shown("CurrentState").contains("Halted").then_some(())
    });
    assert_ne!(status(&mut started), "Good");
    assert_eq!(shown("FinalResultData.Status"), "5");
    assert_eq!(pending(METRICS_SERVER), Vec::<Value>::new());
}
