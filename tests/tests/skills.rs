//! A component with third-party clients: asyncua and node-opcua call its skills as plain Programs.

use std::fs;
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

const SOON: Duration = Duration::from_secs(30);
const ENDPOINT: &str = "opc.tcp://127.0.0.1:4855";
const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/plant");
const FAULTS: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../plant/skills/tests/faults.yaml"
);
const FAULTS_TOLD: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../plant/skills/tests/faults.txt"
);

/// A component with a skill that runs until it is halted, a skill that completes at once, and a
/// skill with a target parameter.
const COMPONENT: &str = "
component: bench
application_uri: urn:ua-bridge:system-tests:component
namespace: 9
skills:
  - {name: Hold, type: GraspSkillType, driver: {simulated: {duration: 10 min}}}
  - {name: Let, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}
  - {name: Move, type: PtpMoveSkillType, driver: simulated}
";

/// Transition, its node, and its from and to states, with the numbers of OPC 10000-10.
const TRANSITIONS: [(&str, &str, &str, &str); 9] = [
    ("HaltedToReady", "i=2408", "Halted", "Ready"),
    ("ReadyToRunning", "i=2410", "Ready", "Running"),
    ("RunningToHalted", "i=2412", "Running", "Halted"),
    ("RunningToReady", "i=2414", "Running", "Ready"),
    ("RunningToSuspended", "i=2416", "Running", "Suspended"),
    ("SuspendedToRunning", "i=2418", "Suspended", "Running"),
    ("SuspendedToHalted", "i=2420", "Suspended", "Halted"),
    ("SuspendedToReady", "i=2422", "Suspended", "Ready"),
    ("ReadyToHalted", "i=2424", "Ready", "Halted"),
];

fn component_started(file: &Path, args: &[&str]) -> StartedChild {
    StartedChild::new("ua-component", &program("ua-component"))
        .args([file])
        .args(args)
}

fn component(file: &Path) -> Child {
    let args = [
        "--endpoint",
        ENDPOINT,
        "--lds",
        "none",
        "--interface",
        "lo",
        "--metrics",
        "127.0.0.1:9855",
    ];
    let child = component_started(file, &args).start();
    eventually("the component serves", SOON, || {
        std::net::TcpStream::connect(ENDPOINT.trim_start_matches("opc.tcp://")).ok()
    });
    child
}

fn state(name: &str) -> (u32, &'static str) {
    match name {
        "Halted" => (11, "i=2406"),
        "Ready" => (12, "i=2400"),
        "Running" => (13, "i=2402"),
        _ => (14, "i=2404"),
    }
}

mod configuration;
mod expired;
mod faults;
mod foreign;
mod nodesets;
mod own;
mod reload;
mod robot;
mod unknown;
mod values;
mod worse;

#[test]
fn a_client_with_a_queue_sees_each_state_of_runs_that_are_over_at_once() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // Several runs start and end within a sampling interval of the client.
    let yaml = COMPONENT.replace("50 ms", "1 ms");
    let _component = component(&cell.file("component.yaml", &yaml));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "quick"]);
    let seen = lines[0]["seen"].as_array().unwrap();
    let mut expected = vec![json!("Ready")];
    for _ in 0..10 {
        expected.extend([json!("Running"), json!("Ready")]);
    }
    assert_eq!(*seen, expected);
}

#[test]
fn clients_walk_all_states_and_methods_and_see_nine_kinds_of_transition() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let yaml = cell.file("component.yaml", COMPONENT);
    let first = component(&yaml);
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "walk"]);
    assert_is_whole(&lines);
    drop(first);
    let _second = component(&yaml);
    let uri = "urn:ua-bridge:system-tests:component";
    assert_is_whole(&cell.node_opcua_once("walk.js", &[ENDPOINT, uri]));
}

#[test]
fn a_client_that_names_types_of_events_is_told_of_transitions_or_of_none() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _component = component(&cell.file("component.yaml", COMPONENT));
    let listening = |kind: &str| {
        let mut client = cell.asyncua("opcua_events.py", &[ENDPOINT, kind]);
        client.wait_for_json("the client listens", SOON, |line| {
            line.get("ready").map(|_| ())
        });
        client
    };
    let base_model_change = listening("i=2132");
    // Transitions of skills are a subtype of ProgramTransitionEventType.
    let transitions = listening("i=2378");
    let told = |client: &Child| -> Vec<Value> {
        let lines = client.json_lines().into_iter();
        lines.filter(|line| line.get("ready").is_none()).collect()
    };
    let _ran = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "quick"]);
    let seen = eventually("all transitions are told", SOON, || {
        let seen = told(&transitions);
        (seen.len() > 20).then_some(seen)
    });
    let kind = &seen[0]["type"];
    assert!(
        kind.as_str().is_some_and(|kind| kind.starts_with("ns=")),
        "{kind}"
    );
    assert!(seen.iter().all(|event| event["type"] == *kind), "{seen:?}");
    assert_eq!(told(&base_model_change), Vec::<Value>::new());
}

/// Checks each state with each method, each transition with its numbers, and a run to its end, as
/// seen by a client.
#[expect(clippy::too_many_lines, reason = "one walk through all states")]
fn assert_is_whole(lines: &[Value]) {
    let cells: Vec<&Value> = lines
        .iter()
        .filter(|line| line.get("method").is_some())
        .collect();
    assert_eq!(cells.len(), 20);
    let mut taken = Vec::new();
    for cell in cells {
        let (before, after) = (&cell["before"], &cell["after"]);
        if cell["status"] == "Good" {
            taken.push((
                cell["state"].as_str().unwrap(),
                cell["method"].as_str().unwrap(),
                after[0].as_str().unwrap(),
            ));
        } else {
            assert_eq!(
                (&cell["status"], before),
                (&json!("BadInvalidState"), after),
                "{cell}"
            );
        }
        assert_eq!(cell["executable"], cell["status"] == "Good", "{cell}");
        let (number, _) = state(after[0].as_str().unwrap());
        assert_eq!(
            (&after[0], &after[2]),
            (&after[1], &json!(number)),
            "{cell}"
        );
    }
    taken.sort_unstable();
    let mut expected = [
        ("Halted", "Reset", "Ready"),
        ("Ready", "Start", "Running"),
        ("Ready", "Halt", "Halted"),
        ("Running", "Halt", "Halted"),
        ("Running", "Suspend", "Suspended"),
        ("Suspended", "Resume", "Running"),
        ("Suspended", "Halt", "Halted"),
        ("Suspended", "Reset", "Ready"),
    ];
    expected.sort_unstable();
    assert_eq!(taken, expected);

    for (number, (name, id, from, to)) in (1..).zip(TRANSITIONS) {
        let seen = lines.iter().filter_map(|line| line.get("event"));
        let seen = seen
            .into_iter()
            .find(|event| event["Transition.Number"] == number);
        let event = seen.unwrap_or_else(|| panic!("no event of {name}"));
        let ((from_number, from_id), (to_number, to_id)) = (state(from), state(to));
        let fields = [
            ("Transition", json!(name)),
            ("Transition.Id", json!(id)),
            ("FromState", json!(from)),
            ("FromState.Id", json!(from_id)),
            ("FromState.Number", json!(from_number)),
            ("ToState", json!(to)),
            ("ToState.Id", json!(to_id)),
            ("ToState.Number", json!(to_number)),
        ];
        for (field, value) in fields {
            assert_eq!(event[field], value, "{field} of {event}");
        }
        assert!(
            event["EventType"]
                .as_str()
                .is_some_and(|of| of.ends_with("i=2000")),
            "{event}"
        );
    }
    let ended = lines.iter().find(|line| line.get("result").is_some());
    let ended = ended.unwrap();
    let result = &ended["result"];
    assert_eq!(
        (&result["Run"], &result["Succeeded"]),
        (&ended["run"], &json!(true))
    );
    let diagnostic = lines
        .iter()
        .find_map(|line| line.get("diagnostic"))
        .unwrap();
    assert_eq!(*diagnostic, json!({"method": "Start", "status": "Good"}));
}

#[test]
fn a_start_without_its_parameter_or_with_a_wrong_one_moves_nothing_and_says_which() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _component = component(&cell.file("component.yaml", COMPONENT));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "refused"]);
    let told: Vec<(&str, &str, &str)> = lines
        .iter()
        .filter_map(|line| {
            Some((
                line["what"].as_str()?,
                line["status"].as_str()?,
                line["shown"][0].as_str()?,
            ))
        })
        .collect();
    let expected = [
        ("without", "BadArgumentsMissing", "Ready"),
        ("short", "BadInvalidArgument", "Ready"),
        ("text", "BadTypeMismatch", "Ready"),
        ("fast", "BadInvalidArgument", "Ready"),
        ("far", "BadInvalidArgument", "Ready"),
        ("good", "Good", "Running"),
        ("while it runs", "BadInvalidState", "Running"),
    ];
    assert_eq!(told, expected);
}

#[test]
fn a_position_is_taken_as_a_frame_of_the_core_namespace_too() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _component = component(&cell.file("component.yaml", COMPONENT));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "frame"]);
    let told: Vec<(&Value, &Value, &Value)> = lines
        .iter()
        .map(|line| (&line["what"], &line["status"], &line["value"]))
        .collect();
    let (first, second) = (
        json!([0.3, 0.1, 0.4, 0.0, 0.5, 0.0]),
        json!([0.4, 0.0, 0.4, 0.0, 0.0, 0.0]),
    );
    let (good, bad) = (json!("Good"), json!("BadTypeMismatch"));
    let whats = ["written", "not a frame", "started", "executed"].map(|what| json!(what));
    let [written, not_a_frame, started, executed] = &whats;
    let expected = [
        (written, &good, &first),
        (not_a_frame, &bad, &first),
        (started, &good, &first),
        (executed, &good, &second),
    ];
    assert_eq!(told, expected);
}

#[test]
fn a_run_begun_in_one_call_is_told_of_by_its_number_to_another_session() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _component = component(&cell.file("component.yaml", COMPONENT));
    let lines = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "execute"]);
    let of = |what: &str| line_of(&lines, what);
    // Invalid calls leave a Halted skill Halted.
    for (what, status) in [
        ("uneven", "BadInvalidArgument"),
        ("wrong", "BadTypeMismatch"),
    ] {
        let told = (&of(what)["status"], &of(what)["state"]);
        assert_eq!(told, (&json!(status), &json!("Halted")), "{what}");
    }
    // Empty arrays have the right type, too.
    assert_eq!(of("without")["status"], json!("Good"));
    let outcome = &of("outcome")["outcome"];
    let (ended, succeeded, message) = (&outcome[0], &outcome[1], &outcome[2]);
    assert_eq!(
        (ended, succeeded, message),
        (&json!(true), &json!(true), &json!(""))
    );
    assert_eq!((&outcome[3], &outcome[4]), (&json!([]), &json!([])));
    assert_eq!(of("newest")["outcome"], *outcome);
    assert_eq!(of("unknown")["status"], json!("BadNotFound"));

    let given = (&of("given")["status"], &of("given")["force"]);
    assert_eq!(given, (&json!("Good"), &json!(3.5)));
    let late = &of("late")["outcome"];
    assert_eq!(
        (&late[0], &late[1], &late[2]),
        (
            &json!(true),
            &json!(false),
            &json!("the work was not done within 300ms")
        )
    );

    // The first session has the lease of the skill it uses, with or without a lock, until it
    // releases it.
    assert_eq!(of("lock")["other"], json!("BadLocked"));
    assert_eq!(of("lock")["locked"], json!(false));
    let locked = of("locked");
    assert_eq!(
        (&locked["init"], &locked["other"], &locked["by"]),
        (
            &json!(0),
            &json!("BadLocked"),
            &json!("a person at a panel")
        )
    );
    assert_eq!(locked["locked"], json!(true));
    let unlocked = of("unlocked");
    assert_eq!(
        (&unlocked["exit"], &unlocked["other"], &unlocked["locked"]),
        (&json!(0), &json!("Good"), &json!(false))
    );
}

#[test]
fn a_type_of_another_maker_is_loaded_found_by_its_supertype_and_run_by_other_clients() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let mut printed = StartedChild::new("ua-component", &program("ua-component"))
        .args(["--nodeset"])
        .start();
    assert!(printed.wait_for_end(SOON).success());
    let nodeset = cell.file("skills.xml", &printed.lines().join("\n"));
    let vendor = Path::new(EXAMPLES).join("vacuum-gripper.xml");
    let schema = test_data::foreign("nodesets/UANodeSet.xsd");
    let schema = schema
        .as_ref()
        .map(|path| ["--xsd", path.to_str().unwrap()]);
    let files = [nodeset.to_str().unwrap(), vendor.to_str().unwrap()];
    let args: Vec<&str> = schema.into_iter().flatten().chain(files).collect();
    let loaded = cell.asyncua_once("opcua_import.py", &args);
    assert_eq!(loaded[0]["complaints"], json!([]));
    // Null without the schema, or without a library that applies it.
    let faults = &loaded[0]["faults"];
    assert!(*faults == json!([]) || faults.is_null(), "{faults}");
    assert_eq!(
        loaded[0]["entries"]["GraspSkillType"],
        json!(["http://www.hsu-ifa.de/ontologies/VDI2860#Tensioning"])
    );
    assert_eq!(
        loaded[0]["types"]["GraspSkillType"],
        json!(["GripperSkillType"])
    );
    assert_eq!(
        loaded[0]["types"]["SkillType"],
        json!(["ProgramStateMachineType"])
    );
    let values = &loaded[0]["values"];
    assert_eq!(values["GraspSkillType.Force"], json!(20.0));
    assert_eq!(values["MoveGripperSkillType.Force"], json!(10.0));
    assert_eq!(
        loaded[1]["types"]["VacuumGraspSkillType"],
        json!(["GraspSkillType"])
    );

    let _component = component(&Path::new(EXAMPLES).join("vacuum-gripper.yaml"));
    let found = cell.asyncua_once("opcua_skill.py", &[ENDPOINT, "find:GraspSkillType"]);
    let found: Vec<(&Value, &Value)> = found
        .iter()
        .map(|line| (&line["name"], &line["type"]))
        .collect();
    assert_eq!(
        found,
        [(&json!("VacuumGrasp"), &json!("VacuumGraspSkillType"))]
    );
    let lines = cell.node_opcua_once("skill.js", &[ENDPOINT, "urn:example:vacuum-gripper", "1"]);
    let numbers: Vec<&Value> = lines.iter().filter_map(|line| line.get("number")).collect();
    assert_eq!(numbers, [&json!(1), &json!(2), &json!(4)]);
    assert_eq!(
        *lines.last().unwrap(),
        json!({"reset": "Good", "start": "Good", "state": "Ready"})
    );
}

#[test]
fn a_yaml_with_faults_is_refused_with_all_of_them() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    for args in [&["--check"][..], &[]] {
        let mut child = component_started(Path::new(FAULTS), args).start();
        assert_eq!(child.wait_for_end(SOON).code(), Some(78));
        let lines = child.lines();
        let expected = fs::read_to_string(FAULTS_TOLD).unwrap();
        for line in expected.lines().filter(|line| line.starts_with("error[")) {
            assert!(
                lines.iter().any(|told| told == line),
                "{line} is not in {lines:#?}"
            );
        }
    }
    for example in ["parallel-gripper.yaml", "robot.yaml", "vacuum-gripper.yaml"] {
        let mut child = component_started(&Path::new(EXAMPLES).join(example), &["--check"]).start();
        assert!(child.wait_for_end(SOON).success(), "{child}");
        child.wait_for_line(&format!("{example} can run"), SOON);
    }
}

/// Starts a simulator of a device, and returns its address.
fn simulator(args: &[&str]) -> (Child, String) {
    let child = StartedChild::new("ua-component", &program("ua-component"))
        .args(["simulate"])
        .args(args)
        .start();
    let at = eventually("the simulator says where it is", SOON, || {
        let line = child
            .lines()
            .into_iter()
            .find(|line| line.contains(" at "))?;
        let (_, at) = line.split_once(" at ")?;
        Some(at.split(" unit ").next().unwrap_or_default().to_owned())
    });
    (child, at)
}

fn line_of<'l>(lines: &'l [Value], what: &str) -> &'l Value {
    let found = lines.iter().find(|line| line["what"] == what);
    found.unwrap_or_else(|| panic!("nothing of {what} in {lines:?}"))
}

#[test]
fn simulated_grippers_are_what_the_tables_of_their_makers_say_to_another_client() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let tty = cell.folder().join("gripper");
    for line in [
        "tcp://127.0.0.1:1502",
        "rtu+tcp://127.0.0.1:1504",
        &format!("serial:{}", tty.display()),
    ] {
        let (_simulator, at) = simulator(&[
            "robotiq-2f85",
            "--listen",
            line,
            "--object",
            "0.0425",
            "--speed",
            "4",
        ]);
        let seen = cell.asyncua_once("device_registers.py", &["robotiq", &at]);
        let fault = |what: &str| line_of(&seen, what)["gFLT"].clone();
        assert_eq!(
            (
                fault("reset"),
                fault("told to go too early"),
                fault("activated")
            ),
            (json!(0), json!(5), json!(0))
        );
        let moving = line_of(&seen, "moving");
        assert_eq!(
            (&moving["gGTO"], &moving["gOBJ"], &moving["gPR"]),
            (&json!(1), &json!(0), &json!(255)),
            "{line}"
        );
        let closed = line_of(&seen, "closed");
        assert_eq!(
            (&closed["gOBJ"], &closed["gPO"]),
            (&json!(2), &json!(128)),
            "{line}"
        );
        let opened = line_of(&seen, "opened");
        assert_eq!(
            (&opened["gOBJ"], &opened["gPO"]),
            (&json!(3), &json!(0)),
            "{line}"
        );
        let refused = line_of(&seen, "exceptions");
        let codes = ["register 3000", "coil", "write 2000"].map(|what| refused[what].clone());
        assert_eq!(codes, [json!(2), json!(1), json!(2)]);
        // gACT and gSTA.
        assert_eq!(
            line_of(&seen, "read and written")["status"]
                .as_u64()
                .map(|status| status & 0x31),
            Some(0x31)
        );
    }

    let (_simulator, at) = simulator(&["schmalz-ecbpi", "--speed", "4"]);
    let seen = cell.asyncua_once("device_registers.py", &["schmalz", &at]);
    let of = |what: &str, field: &str| line_of(&seen, what)[field].clone();
    assert_eq!(
        (of("at first", "present"), of("at first", "mbar")),
        (json!(0), json!(0))
    );
    assert_eq!(
        (of("vacuum", "code"), of("held", "in_range")),
        (json!(204), json!(1))
    );
    assert!(of("held", "mbar").as_u64() > Some(500), "{seen:?}");
    assert_eq!(of("let go", "detached"), json!(1));
    assert_eq!(
        (of("wrong", "code"), of("elsewhere", "code")),
        (json!(400), json!(404))
    );
}

#[test]
fn a_simulated_robot_and_its_tool_changer_are_what_clients_of_other_makers_expect() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let (_robot, _) = simulator(&["universal-robot"]);
    let dock = "3@0.4,0,0.5,0,0,1.5";
    let (_changer, at) = simulator(&["kelvin-tool-changer", "--tool", dock]);
    // The flange is in that dock and turned by more than the ring needs, so the tool is locked.
    let seen = eventually("the tool is locked", SOON, || {
        let seen = cell.asyncua_once("device_registers.py", &["converter", &at]);
        (seen[0]["volts"] == json!(7.4)).then_some(seen)
    });
    assert_eq!(seen.len(), 1);

    let seen = cell.asyncua_once("ur_judge.py", &["127.0.0.1"]);
    let first = line_of(&seen, "at first");
    assert_eq!(first["pose"], json!([0.4, 0.0, 0.5, 0.0, 0.0, 0.0]));
    assert_eq!(
        (&first["mode"], &first["safety"], &first["connected"]),
        (&json!(7), &json!(1), &json!(true))
    );
    let secondary = line_of(&seen, "secondary");
    assert_eq!(
        (
            &secondary["powered"],
            &secondary["running"],
            &secondary["mode"]
        ),
        (&json!(true), &json!(false), &json!(7))
    );
    assert_eq!(secondary["place"], json!([0.4, 0.0, 0.5, 0.0, 0.0, 0.0]));
    let moved = line_of(&seen, "moved");
    let half = (std::f64::consts::FRAC_PI_2 * 1e4).round() / 1e4;
    assert_eq!(moved["pose"], json!([0.2, 0.1, 0.4, 0.0, half, 0.0]));
    assert!(moved["fastest"].as_f64() <= Some(0.2505), "{moved}");
    // The turn takes longer than the path: pi/2 rad, 0.25 s to accelerate, 0.25 s to decelerate.
    let seconds = |what: &str| line_of(&seen, what)["seconds"].as_f64().unwrap();
    let expected = std::f64::consts::FRAC_PI_2 / 0.25 + 0.25;
    assert!((seconds("moved") - expected).abs() < 0.5, "{moved}");
    assert!(
        (seconds("moved slowly") - 2.0 * 1.05).abs() < 0.5,
        "{seen:?}"
    );
    let stands = line_of(&seen, "stands");
    assert_eq!(
        (&stands["still"], &stands["register"], &stands["program"]),
        (&json!(true), &json!(8), &json!(2))
    );
}
