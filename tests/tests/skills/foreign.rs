//! Skills of a third-party server that has Programs of OPC 10000-10 and knows nothing of the space:
//! `ua-server` acts for it.

use std::fs;
use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, METRICS_SERVER, Peer, StartedChild, eventually, metrics, program,
};

/// The time that asyncua needs to start on a busy machine.
const SOON: Duration = Duration::from_secs(40);
const MACHINE: &str = "opc.tcp://127.0.0.1:4857";
const MAPPING: &str = "
namespaces: {12: 'urn:ua-bridge:system-tests:machine'}
servers:
  - {name: press, endpoint: 'opc.tcp://127.0.0.1:4857', security: None, skills: 12}
";

fn machine(cell: &Cell, more: &[&str]) -> Child {
    let machine = cell.asyncua_started("opcua_programs.py", &[&[MACHINE], more].concat());
    machine.start().ready(SOON)
}

fn ua_space(words: &[&str]) -> (i32, Vec<String>) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--interface", "lo"])
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.lines())
}

fn objects(lines: &[String]) -> Vec<Value> {
    let lines = lines.iter();
    lines
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect()
}

/// Waits until `count` skills with known states and calls are listed, and returns them.
fn listed(count: usize) -> Vec<Value> {
    listed_of("press", count)
}

fn listed_of(machine: &str, count: usize) -> Vec<Value> {
    eventually("the skills of the machine are listed", SOON, || {
        let (_, lines) = ua_space(&["skills", machine, "--seconds", "1.5", "--json"]);
        let all = objects(&lines).pop()?.as_array()?.clone();
        let whole = |skill: &&Value| {
            skill["state"].is_string() && skill["calls"].as_object().unwrap().len() == 5
        };
        (all.len() == count && all.iter().filter(whole).count() == count).then_some(all)
    })
}

/// Runs a skill with `ua-space skills start`. Returns the exit code, the states that were seen, and
/// the result.
fn run(words: &[&str]) -> (i32, Vec<String>, Value) {
    let (code, lines) = ua_space(&[&["skills", "start"], words, &["--json"]].concat());
    let events = objects(&lines);
    let of = |kind: &'static str| {
        let events = events.iter();
        events.filter(move |event| event["event"] == kind)
    };
    let states = of("state").filter_map(|event| event["state"].as_str().map(str::to_owned));
    let states: Vec<String> = states.collect();
    let result = of("result")
        .next()
        .cloned()
        .unwrap_or_else(|| json!({"lines": lines}));
    (code, states, result)
}

/// Checks the second Stamp: a frame is the six numbers of a position, a range is two numbers.
fn takes_structures_that_are_numbers(machine: &mut Child) {
    let target = "Target=0.25,0,0.5,0,1.5,-0.25";
    let (code, _, result) = run(&["press.Stamp_2", target, "Bounds=-2,2,-3,3"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    assert_eq!(result["results"]["Reached"], json!([0.25, 0.0, 0.5]));
    let told = machine.wait_for_json("the machine says where to", SOON, |line| {
        line.get("target").map(|_| line.clone())
    });
    assert_eq!(told["target"], json!([0.25, 0.0, 0.5, 0.0, 1.5, -0.25]));
    assert_eq!(told["bounds"], json!([[-2.0, 2.0], [-3.0, 3.0]]));
    let (code, lines) = ua_space(&["skills", "start", "press.Stamp_2", "Target=0.25,0,0.5"]);
    let told = lines.join(" ");
    assert!(code != 0 && told.contains("Target"), "{told}");
}

#[test]
fn a_machine_that_knows_programs_only_is_in_the_space_as_a_component_is() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("press.yaml", MAPPING);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let mut machine = machine(&cell, &[]);

    let skills = listed(4);
    let shown: Vec<[&Value; 4]> = skills
        .iter()
        .map(|skill| {
            [
                &skill["skill"],
                &skill["type"],
                &skill["topic"],
                &skill["state"],
            ]
        })
        .collect();
    let halted = json!("Halted");
    let expected = [
        ("Stamp", "ProgramStateMachineType", "ua_0_12_101"),
        ("Blink", "ProgramStateMachineType", "ua_0_12_201"),
        ("Grasp", "GraspGripperSkillType", "ua_0_12_301"),
        ("Stamp_2", "ProgramStateMachineType", "ua_0_12_401"),
    ]
    .map(|(name, of, topic)| [json!(name), json!(of), json!(topic)]);
    for (shown, expected) in shown.iter().zip(&expected) {
        let [name, of, topic] = expected;
        assert_eq!(*shown, [name, of, topic, &halted]);
    }
    // Unsupported Programs and duplicate names are listed with the reason.
    let faults = metrics(METRICS_SERVER).unwrap()["servers"][0]["faults"].clone();
    let fault = |name: &str| faults[name].as_str().unwrap_or_default().to_owned();
    assert!(fault("press.Odd").contains("CurrentState"), "{faults}");
    let second = fault("press.Stamp_2");
    assert!(
        second.contains("another one is called Stamp") && second.contains("Where is of"),
        "{faults}"
    );
    assert_eq!(faults.as_object().unwrap().len(), 2, "{faults}");

    // The skill is reset, gets its parameter and runs; its results are returned.
    let (code, states, result) = run(&["press.Stamp", "Force=33.5"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    assert_eq!(states, ["Running", "Ready"]);
    assert_eq!(result["results"], json!({"Parts": 1}));
    let started = machine.wait_for_json("the machine says what it was given", SOON, |line| {
        (line.get("started")? == "Stamp").then(|| line.clone())
    });
    assert_eq!(
        (&started["state"], &started["force"]),
        (&json!("Ready"), &json!(33.5))
    );
    // A run that ends at once is still reported as a run.
    let echo = StartedChild::new("ua-space", &program("ua-space"))
        .args(["echo", "ua_0_12_202", "--json", "--interface", "lo"])
        .start();
    eventually("both transitions of a run are told", SOON, || {
        let (code, _, result) = run(&["press.Blink"]);
        assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
        let told = echo.lines().join(" ");
        let parts = ["ReadyToRunning", "RunningToReady"].map(|name| told.find(name));
        (parts[0].is_some() && parts[0] < parts[1]).then_some(())
    });
    let (code, _, result) = run(&["press.Grasp", "Force=5"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    takes_structures_that_are_numbers(&mut machine);
    // A failed run is reported.
    let (code, states, result) = run(&["press.Stamp", "Force=99"]);
    assert_eq!((code, &result["succeeded"]), (1, &json!(false)), "{result}");
    assert_eq!(states, ["Running", "Halted"]);

    // The Start of the machine accepts every state; the space does not.
    let (code, lines) = ua_space(&["call", "press.Stamp.Start"]);
    assert!(
        code == 1 && lines.iter().any(|line| line.contains("BadInvalidState")),
        "{lines:?}"
    );
    let starts = machine.json_lines();
    let of_stamp = |line: &&Value| line["started"] == "Stamp" && line["first"] == 1000;
    assert_eq!(starts.iter().filter(of_stamp).count(), 2, "{starts:?}");
}

#[test]
fn a_machine_is_reached_as_the_saved_mapping_says() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // The machine does not support this security policy.
    let secured = MAPPING.replace("None", "Basic256Sha256");
    let mapping = cell.file("press.yaml", &secured);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let _machine = machine(&cell, &[]);
    eventually("the machine is refused", SOON, || {
        let server = metrics(METRICS_SERVER)?["servers"][0].clone();
        (server["up"] == false && server["why"].is_string()).then_some(())
    });
    fs::write(&mapping, MAPPING).unwrap();
    server.signal(Signal::SIGHUP);
    listed(4);
}

#[test]
fn goals_for_a_machine_run_it_are_cancelled_and_end_when_it_is_gone() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("press.yaml", MAPPING);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let mut first = machine(&cell, &["--seconds", "100"]);
    listed(4);
    let goal = |words: &[&str]| {
        StartedChild::new("ua-space", &program("ua-space"))
            .args(["call", "press.Stamp.Goal", "--json", "--interface", "lo"])
            .args(words)
            .start()
    };
    let runs = |child: &mut Child| {
        child.wait_for_json("it runs", SOON, |line| {
            (line["event"] == "feedback" && line["fields"]["state"] == "Running").then_some(())
        });
    };
    let mut cancelled = goal(&["{force: 12.5}", "--run-timeout", "3"]);
    runs(&mut cancelled);
    let started = first.wait_for_json("the machine is started", SOON, |line| {
        line.get("started").map(|_| line.clone())
    });
    assert_eq!(started["force"], 12.5, "{started}");
    first.wait_for_json("the machine is halted", SOON, |line| {
        (line.get("halted")? == "Stamp").then_some(())
    });
    cancelled.wait_for_end(SOON);
    let ended = |child: &Child| {
        let lines = child.json_lines();
        let mut ended = lines.iter().filter(|line| line["event"] == "result");
        ended
            .next()
            .cloned()
            .unwrap_or_else(|| json!({"lines": lines}))
    };
    assert_eq!(ended(&cancelled)["status"], "CANCELED", "{cancelled}");

    let mut lost = goal(&["{force: 12.5}"]);
    runs(&mut lost);
    drop(first);
    let code = lost.wait_for_end(SOON).code();
    assert_ne!(code, Some(0), "{lost}");
    eventually("nobody can call it", SOON, || {
        let (_, lines) = ua_space(&["skills", "press", "--seconds", "1", "--json"]);
        let all = objects(&lines).pop()?.as_array()?.clone();
        let none = |skill: &Value| skill["calls"].as_object().unwrap().is_empty();
        all.iter().all(none).then_some(())
    });
    let _second = machine(&cell, &[]);
    listed(4);
    let (code, _, result) = run(&["press.Stamp"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
}

/// A mapping for the bridge alone: the ROS 2 action of the machine's first Program.
const STAMP: &str = "
spaces: [{id: 2, domain: 2}]
namespaces: {12: 'urn:ua-bridge:system-tests:machine'}
calls:
  - node: ns=12;i=110
    name: press.Stamp.Goal
    origin: 0
    ros:
      - {space: 2, action: /stamp, type: test_msgs/Fibonacci, goal: {force: 12.5}, feedback: {sequence: [1]}, result: {sequence: [2]}}
";

#[test]
fn a_client_of_rclpy_runs_and_cancels_the_program_of_a_machine_as_an_action() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mapping = cell.file("press.yaml", MAPPING);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let mut machine = machine(&cell, &["--seconds", "6"]);
    let actions = cell.file("stamp.yaml", STAMP);
    let _bridge = cell.bridge_ros2(&[actions.to_str().unwrap()]);
    listed(4);
    let args = ["call", "/stamp", "--results", "--wait", "60"];
    let client = cell.rclpy_started(Distribution::Jazzy, "ros2_rclpy_action.py", &args);
    let mut client = client.told().start().ready(SOON);
    let line = |client: &mut Child, key: &str, goal: u64, wanted: &str| {
        client.wait_for_json(&format!("{key} {goal} with {wanted}"), SOON, |line| {
            (line.get(key)? == goal).then(|| line.get(wanted).cloned())?
        })
    };

    client.tell("send 7");
    assert_eq!(line(&mut client, "goal", 0, "accepted"), true);
    assert_eq!(line(&mut client, "feedback", 0, "sequence"), json!([1]));
    let started = machine.wait_for_json("the machine is started", SOON, |line| {
        line.get("started").map(|_| line.clone())
    });
    assert_eq!(started["force"], 12.5, "{started}");
    assert_eq!(line(&mut client, "result", 0, "status"), "SUCCEEDED");
    assert_eq!(line(&mut client, "result", 0, "sequence"), json!([2]));

    client.tell("send 8");
    assert_eq!(line(&mut client, "goal", 1, "accepted"), true);
    assert_eq!(line(&mut client, "feedback", 1, "sequence"), json!([1]));
    client.tell("cancel 1");
    machine.wait_for_json("the machine is halted", SOON, |line| {
        (line.get("halted")? == "Stamp").then_some(())
    });
    assert_eq!(line(&mut client, "result", 1, "status"), "CANCELED");
}

const LDS: &str = "opc.tcp://127.0.0.1:4840";

/// Starts ua-lds and waits until it answers.
fn discovery_server(cell: &Cell) -> Child {
    discovery_server_with(cell, &[])
}

fn discovery_server_with(cell: &Cell, more: &[&str]) -> Child {
    let args = ["--interface", "lo", "--endpoint", LDS];
    let child = StartedChild::new("ua-lds", &program("ua-lds"))
        .args(args)
        .args(more)
        .start();
    eventually("ua-lds answers", SOON, || {
        cell.asyncua_try("opcua_discovery.py", &["find-servers", LDS])
    });
    child
}

/// Registers a machine with asyncua, which renews no registrations.
fn register(cell: &Cell, machine: &str, uri: &str, more: &[&str]) {
    let args = [
        "register", LDS, "--url", machine, "--uri", uri, "--name", "machine",
    ];
    let said = cell.asyncua_once("opcua_discovery.py", &[&args, more].concat());
    assert_eq!(said[0]["status"], "Good", "{said:?}");
}

/// Returns the servers that ua-server has sessions with: the name, and whether the server is
/// connected.
fn servers() -> Vec<(String, bool)> {
    let status = metrics(METRICS_SERVER).unwrap();
    let servers = status["servers"].as_array().cloned().unwrap_or_default();
    let server = |server: &Value| Some((server["name"].as_str()?.to_owned(), server["up"] == true));
    servers.iter().filter_map(server).collect()
}

#[test]
fn a_machine_that_is_announced_is_in_the_space_without_being_named_until_it_is_gone() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file(
        "found.yaml",
        "
namespaces: {42: 'urn:ua-bridge:system-tests:machine'}
server:
  endpoint: opc.tcp://127.0.0.1:4858
  find_skills: {uris: ['urn:ua-bridge:system-tests:*'], first: 40, most: 4, security: None}
",
    );
    let _lds = discovery_server(&cell);
    let other = "opc.tcp://127.0.0.1:4859";
    let other = cell.asyncua_started("opcua_programs.py", &[other, "--uri", "urn:elsewhere:saw"]);
    let _other = other.start().ready(SOON);
    register(
        &cell,
        "opc.tcp://127.0.0.1:4859",
        "urn:elsewhere:saw",
        &["--mdns", "saw"],
    );
    let first = machine(&cell, &[]);
    let server = cell.ua_server(&[mapping.to_str().unwrap(), "--announce"]);
    let uri = "urn:ua-bridge:system-tests:machine";
    register(&cell, MACHINE, uri, &["--mdns", "press on the left"]);

    let topics = |skills: &[Value]| -> Vec<String> {
        let topics = skills.iter().filter_map(|skill| skill["topic"].as_str());
        topics.map(str::to_owned).collect()
    };
    let skills = listed_of("machine", 4);
    let numbers = ["ua_0_42_101", "ua_0_42_201", "ua_0_42_301", "ua_0_42_401"];
    assert_eq!(topics(&skills), numbers);
    let (code, states, result) = run(&["machine.Stamp", "Force=33.5"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    assert_eq!(states, ["Running", "Ready"]);
    assert_eq!(servers(), [("machine".to_owned(), true)]);

    drop(first);
    eventually("the machine is not known any more", SOON, || {
        servers().is_empty().then_some(())
    });
    let (_, lines) = ua_space(&["skills", "machine", "--seconds", "1.5", "--json"]);
    let left = objects(&lines).pop().unwrap_or_else(|| json!([]));
    let callable = |skill: &Value| {
        skill["calls"]
            .as_object()
            .is_some_and(|calls| !calls.is_empty())
    };
    assert!(!left.as_array().unwrap().iter().any(callable), "{left}");

    // The machine is back at its old number.
    let _second = machine(&cell, &[]);
    register(&cell, MACHINE, uri, &["--mdns", "press on the left"]);
    assert_eq!(topics(&listed_of("machine", 4)), numbers);

    // Without discovery of servers, ua-server does not act for the machine.
    fs::write(&mapping, "server: {endpoint: 'opc.tcp://127.0.0.1:4858'}").unwrap();
    server.signal(Signal::SIGHUP);
    eventually("the machine is left alone", SOON, || {
        servers().is_empty().then_some(())
    });
}

#[test]
fn a_component_that_a_discovery_server_lists_is_left_alone() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file(
        "one.yaml",
        "
server:
  endpoint: opc.tcp://127.0.0.1:4858
  find_skills: {uris: ['urn:ua-bridge:system-tests:*'], first: 40, most: 1, security: None}
",
    );
    let _lds = discovery_server(&cell);
    // Nothing is announced by mDNS here, so the list of the discovery server has to be read.
    let lds = ["--lds", LDS];
    let server = cell.ua_server(&[&[mapping.to_str().unwrap()], &lds[..]].concat());
    let component = cell.file("bench.yaml", super::COMPONENT);
    let _component = super::component(&component);
    let uri = "urn:ua-bridge:system-tests:component";
    register(&cell, super::ENDPOINT, uri, &["--old"]);
    eventually("it is in the space by itself", SOON, || {
        let lines = server.lines();
        let mut lines = lines.iter();
        let says =
            lines.any(|line| line.contains("in the space by itself") && line.contains("component"));
        says.then_some(())
    });
    eventually("it has no number", SOON, || {
        servers().is_empty().then_some(())
    });
}

#[test]
fn a_secured_machine_of_node_opcua_that_registers_by_itself_is_run_once_it_is_trusted() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let mapping = |security: &str| {
        format!(
            "
server:
  endpoint: opc.tcp://127.0.0.1:4858
  find_skills: {{uris: ['urn:*'], first: 40, most: 4, security: {security}}}
"
        )
    };
    let file = cell.file("secured.yaml", &mapping("None"));
    let pki = cell.folder().join("lds-pki");
    let _lds = discovery_server_with(&cell, &["--pki", pki.to_str().unwrap()]);
    let certificate = pki.join("trusted/node.der");
    let args = ["4857", LDS, certificate.to_str().unwrap()];
    let mut machine = cell.node_opcua_started("programs.js", &args).start();
    let uri = machine.wait_for_json("who it is", SOON, |line| {
        line["uri"].as_str().map(str::to_owned)
    });
    machine.wait_for_line("serverRegistered", SOON);
    let server = cell.ua_server(&[file.to_str().unwrap(), "--lds", LDS]);
    let refused = |what: &str, is_meant: &dyn Fn(&str) -> bool| {
        eventually(what, SOON, || {
            let told = metrics(METRICS_SERVER)?["servers"][0].clone();
            (told["up"] == false && is_meant(told["why"].as_str()?)).then_some(())
        });
    };
    // The server has no channel without security; with security, its certificate is not trusted
    // automatically.
    refused("there is no channel without security", &|why| {
        why.contains("it offers Basic256Sha256/SignAndEncrypt, but None is required")
    });
    fs::write(&file, mapping("Basic256Sha256")).unwrap();
    server.signal(Signal::SIGHUP);
    refused("it is not trusted", &|why| !why.contains("it offers"));
    let trusted = Command::new(program("ua-server"))
        .arg("trust")
        .arg(&certificate)
        .arg("--pki")
        .arg(cell.folder().join("pki"))
        .output()
        .unwrap();
    assert!(trusted.status.success(), "{trusted:?}");

    let name = uri.rsplit(':').next().unwrap();
    let skills = listed_of(name, 1);
    assert_eq!(skills[0]["skill"], "Weld", "{skills:?}");
    let told = metrics(METRICS_SERVER).unwrap()["servers"][0].clone();
    assert_eq!(told["secured"], true, "{told}");
    let (code, states, result) = run(&[&format!("{name}.Weld"), "Force=33.5"]);
    assert_eq!((code, &result["succeeded"]), (0, &json!(true)), "{result}");
    assert_eq!(states, ["Running", "Ready"]);
    assert_eq!(result["results"], json!({"ForceUsed": 33.5}));
    let started = machine.wait_for_json("the machine says what it was given", SOON, |line| {
        line.get("started").cloned()
    });
    assert_eq!(started, 33.5);
}
