//! Process modules: manifests compared with another XML library and with rdflib, and services that
//! run as skills with a simulated module.

mod pictures;

use std::collections::BTreeMap;
use std::process::{Command, Output};
use std::time::Duration;

use knowledge::{Knowledge, KnowledgeSource, NamedQuestion, SourceKind};
use mtp::Module;
use mtp::state::{Command as ServiceCommand, State};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, http_get, program};
use test_data::{foreign, own};

const SOON: Duration = Duration::from_secs(30);
const AT: &str = "127.0.0.1:8087";

/// Runs `ua-space` to its end.
fn space(args: &[&str]) -> Output {
    Command::new(program("ua-space"))
        .args(args)
        .output()
        .unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Returns the rows of a question about manifests that are in the graph as `urn:m:<number>`.
fn rows(knowledge: &Knowledge, question: &str, parameters: &[(&str, &str)]) -> Vec<Value> {
    let parameters: Vec<(String, String)> = parameters
        .iter()
        .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
        .collect();
    let answer = knowledge.ask(question, &parameters).unwrap();
    let rows = answer.rows.into_iter();
    rows.map(|row| serde_json::to_value(row).unwrap()).collect()
}

/// Returns the sorted values of columns.
fn columns(rows: &[Value], names: &[&str]) -> Vec<Value> {
    let mut found: Vec<Value> = rows
        .iter()
        .map(|row| names.iter().map(|name| row[name].clone()).collect())
        .collect();
    found.sort_by_key(Value::to_string);
    found
}

fn sorted(mut all: Vec<Value>) -> Vec<Value> {
    all.sort_by_key(Value::to_string);
    all
}

/// Returns an identifier without the namespace index that some manifests repeat in it.
fn identifier(of: &Value) -> Option<String> {
    let text = of.as_str()?;
    let rest = text
        .split_once(';')
        .filter(|(start, _)| start.starts_with("ns="));
    let text = rest.map_or(text, |(_, rest)| rest.trim_start_matches("s="));
    Some(text.to_owned())
}

/// Returns the identifier in a NodeId of an answer.
fn of_node(node: &Value) -> Option<String> {
    let (_, rest) = node.as_str()?.split_once(';')?;
    let (_, identifier) = rest.split_once('=')?;
    Some(identifier.to_owned())
}

#[test]
fn nine_questions_are_answered_as_the_xml_says() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let names = ["stage.aml", "mixer.aml", "column.aml"];
    let files = names.map(|name| own(&format!("mtp/{name}")));
    let paths: Vec<String> = files
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    are_answered(&cell, &paths);
}

#[test]
fn nine_questions_about_modules_of_other_makers_are_answered_as_the_xml_says() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let names = [
        "cps-edp-mixing-1.1.2/Manifest.aml",
        "huber-v14.1/Manifest.aml",
        "mtppy-recipe/example_recipe_manifest.aml",
        "p2o-bucket/Manifest.aml",
        "p2o-dosing-1.0.3/Manifest.aml",
        "pimad-core/PiMAd-core.0-0-1.aml",
        "recipol-hc30-siemens/2026-05-18-HC30_Stirring_V8.aml",
        "zvei-stirred-reactor-v1/Manifest.aml",
    ];
    let files = names.map(|name| foreign(&format!("mtp/{name}")));
    let paths: Option<Vec<String>> = files
        .into_iter()
        .map(|path| path.map(|path| path.display().to_string()))
        .collect();
    let Some(paths) = paths else { return };
    are_answered(&cell, &paths);
}

/// Compares the answers of the nine questions with the XML of manifests.
fn are_answered(cell: &Cell, paths: &[String]) {
    let args: Vec<&str> = paths.iter().map(String::as_str).collect();
    let judged = cell.asyncua_once("mtp_judge.py", &args);
    assert_eq!(judged.len(), paths.len());
    let knowledge = Knowledge::new().unwrap();
    let mut services_of = BTreeMap::new();
    for (number, path) in paths.iter().enumerate() {
        let module = Module::from_bytes(&std::fs::read(path).unwrap()).unwrap();
        let triples = module.triples(&format!("urn:m:{number}"), &BTreeMap::new());
        let source = KnowledgeSource::new(SourceKind::Mtp, &number.to_string());
        knowledge.replace(&source, &triples, 1).unwrap();
        pictures::are_as_judged(&module, &judged[number]);
        services_of.insert(number, module.services);
    }
    for (number, wanted) in judged.iter().enumerate() {
        let module = format!("urn:m:{number}");
        components_are(&knowledge, &module, wanted);
        variables_are(&knowledge, &module, wanted);
        for service in wanted["services"].as_array().unwrap() {
            let of_module = services_of[&number].iter();
            let mut of_name = of_module.filter(|one| json!(one.name) == service["name"]);
            let known = of_name.next().unwrap();
            let service_iri = format!("{module}/service/{}", mtp::escaped(&known.id));
            service_is(&knowledge, &service_iri, known, service);
        }
        let mut services = Vec::new();
        for service in wanted["services"].as_array().unwrap() {
            for procedure in service["procedures"].as_array().unwrap() {
                let name = format!(
                    "{}/{}",
                    service["name"].as_str().unwrap(),
                    procedure["name"].as_str().unwrap()
                );
                services.push(json!([service["name"], name, procedure["number"]]));
            }
        }
        let found = rows(&knowledge, "services-of", &[("module", &module)]);
        let names = ["service_name", "procedure_name", "number"];
        assert_eq!(columns(&found, &names), sorted(services), "{module}");
    }
}

/// Checks components-of and modules-with.
fn components_are(knowledge: &Knowledge, module: &str, wanted: &Value) {
    let found = rows(knowledge, "components-of", &[("module", module)]);
    let of_kind = |kind: &str| {
        let rows: Vec<Value> = found
            .iter()
            .filter(|row| row["kind"] == kind)
            .cloned()
            .collect();
        columns(&rows, &["name"])
    };
    let names = |key: &str| {
        let all = wanted[key].as_array().unwrap().iter();
        sorted(all.map(|name| json!([name])).collect())
    };
    assert_eq!(of_kind("sensor"), names("sensors"), "{module}");
    assert_eq!(of_kind("server"), names("servers"), "{module}");
    let actuators = wanted["actuators"].as_array().unwrap();
    let of_actuators = actuators.iter().map(|one| json!([one[0]]));
    assert_eq!(
        of_kind("actuator"),
        sorted(of_actuators.collect()),
        "{module}"
    );
    let services = wanted["services"].as_array().unwrap();
    let of_services = services.iter().map(|one| json!([one["name"]]));
    assert_eq!(
        of_kind("service"),
        sorted(of_services.collect()),
        "{module}"
    );
    let assemblies = found.iter().filter(|row| {
        ["sensor", "actuator", "data assembly"].contains(&row["kind"].as_str().unwrap())
    });
    assert_eq!(json!(assemblies.count()), wanted["assemblies"], "{module}");
    for actuator in actuators {
        let kind = actuator[1].as_str().unwrap();
        let with = rows(knowledge, "modules-with", &[("what", kind)]);
        let is_there = with.iter().any(|row| {
            row["module"] == wanted["module"]
                && row["name"] == actuator[0]
                && row["kind"] == "actuator"
        });
        assert!(is_there, "{module} {actuator}: {with:?}");
    }
    for service in services {
        let name = service["name"].as_str().unwrap();
        let with = rows(knowledge, "modules-with", &[("what", name)]);
        let is_there = with
            .iter()
            .any(|row| row["module"] == wanted["module"] && row["kind"] == "service");
        assert!(is_there, "{module} {name}: {with:?}");
    }
}

/// Checks access-of for every node of a module.
fn variables_are(knowledge: &Knowledge, module: &str, wanted: &Value) {
    let start = format!("{module}/item/");
    let mut all = rows(knowledge, "access-of", &[]);
    all.retain(|row| row["of"].as_str().is_some_and(|of| of.starts_with(&start)));
    let names = ["name", "endpoint", "namespace_uri", "identifier", "access"];
    let found = columns(&all, &names);
    let access = |bits: &Value| match bits.as_u64() {
        Some(1) => "read",
        Some(2) => "write",
        Some(3) => "read and write",
        _ => "none",
    };
    let expected = wanted["access"].as_array().unwrap().iter().map(|item| {
        let identifier = identifier(&item[3]).unwrap();
        let is_number = all.iter().any(|row| {
            row["name"] == item[0] && row["identifier"] == json!(format!("i={identifier}"))
        });
        let kind = if is_number { "i" } else { "s" };
        json!([
            item[0],
            item[1].as_str().unwrap_or_default(),
            item[2],
            format!("{kind}={identifier}"),
            access(&item[4])
        ])
    });
    assert_eq!(found, sorted(expected.collect()), "{module}");
}

/// Checks state-of, skills-for, transitions-now, parameters-of and outputs-of for the skills of a
/// service.
fn service_is(knowledge: &Knowledge, service_iri: &str, known: &mtp::MtpService, wanted: &Value) {
    let capability = format!("{service_iri}/capability");
    let skills = rows(knowledge, "skills-for", &[("capability", &capability)]);
    let procedures = wanted["procedures"].as_array().unwrap();
    let names = procedures.iter().map(|procedure| {
        let name = procedure["name"].as_str().unwrap();
        json!([format!("{}/{name}", known.name)])
    });
    assert_eq!(
        columns(&skills, &["skill_name"]),
        sorted(names.collect()),
        "{service_iri}"
    );
    for (procedure, wanted_procedure) in known.procedures.iter().zip(procedures) {
        assert_eq!(json!(procedure.name), wanted_procedure["name"]);
        let skill = format!("{service_iri}/procedure/{}", mtp::escaped(&procedure.id));
        let state = rows(knowledge, "state-of", &[("skill", &skill)]);
        assert_eq!(state.len(), 1, "{skill}");
        assert_eq!(
            of_node(&state[0]["node"]),
            identifier(&wanted["state"]),
            "{skill}"
        );
        let idle = [("skill", &*skill), ("state", "Idle")];
        let transitions = rows(knowledge, "transitions-now", &idle);
        assert_eq!(
            columns(&transitions, &["command", "value", "target"]),
            [
                json!(["Abort", 256, "Aborting"]),
                json!(["Start", 4, "Starting"]),
                json!(["Stop", 8, "Stopping"])
            ],
            "{skill}"
        );
        let command = identifier(&wanted["command"]);
        assert!(
            transitions
                .iter()
                .all(|row| of_node(&row["node"]) == command)
        );
        let none = rows(knowledge, "transitions-now", &[("skill", &skill)]);
        assert_eq!(none, Vec::<Value>::new(), "the state is unknown");
        parameters_are(knowledge, &skill, wanted, wanted_procedure);
    }
}

fn parameters_are(knowledge: &Knowledge, skill: &str, service: &Value, wanted: &Value) {
    let number = |value: &Value| json!(value.as_f64());
    let mut found: Vec<Value> = rows(knowledge, "parameters-of", &[("skill", skill)])
        .iter()
        .map(|row| {
            let nodes = ["node", "min_node", "max_node"].map(|name| of_node(&row[name]));
            json!([row["name"], nodes, number(&row["min"]), number(&row["max"])])
        })
        .collect();
    found.sort_by_key(Value::to_string);
    let mut expected: Vec<Value> = wanted["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| {
            let nodes = ["node", "min_node", "max_node"].map(|name| identifier(&one[name]));
            json!([one["name"], nodes, number(&one["min"]), number(&one["max"])])
        })
        .collect();
    if let Some(selection) = identifier(&service["selection"]) {
        expected.push(json!(["ProcedureExt", [selection, null, null], null, null]));
    }
    assert_eq!(found, sorted(expected), "{skill}");
    let outputs = rows(knowledge, "outputs-of", &[("skill", skill)]);
    let mut named = columns(&outputs, &["name"]);
    named.dedup();
    let of_service = service["variables"].as_array().unwrap().iter();
    let of_procedure = wanted["outputs"].as_array().unwrap().iter();
    let expected = of_service
        .map(|name| json!([name]))
        .chain(of_procedure.map(|one| json!([one["name"]])));
    assert_eq!(named, sorted(expected.collect()), "{skill}");
}

#[test]
fn verbs_show_manifests_and_report_what_is_left_out() {
    let column = own("mtp/column.aml").display().to_string();
    let checked = space(&["mtp", "check", "--json", &column]);
    assert!(checked.status.success(), "{checked:?}");
    let checked: Value = serde_json::from_str(&stdout(&checked)).unwrap();
    let numbers = ["services", "procedures", "sensors", "actuators", "nodes"];
    let numbers = numbers.map(|name| checked[name].as_u64().unwrap());
    assert_eq!(numbers, [2, 3, 6, 5, 117], "{checked}");
    pictures::are_listed_and_drawn(&column, &checked);
    let skills = space(&["mtp", "skills", "--json", &column]);
    let skills: Value = serde_json::from_str(&stdout(&skills)).unwrap();
    assert_eq!(skills[0]["skill"], "Heating/Ramp", "{skills}");
    assert_eq!(skills[0]["parameters"][0]["unit"], "°C", "{skills}");
    let table = stdout(&space(&["mtp", "skills", &column]));
    assert!(table.contains("Setpoint: Float [20"), "{table}");
    let rdf = stdout(&space(&[
        "mtp",
        "rdf",
        &column,
        "--base",
        "urn:example:column",
    ]));
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "column.nt");
    knowledge.replace_turtle(&source, &rdf, 1).unwrap();
    assert_eq!(rows(&knowledge, "services-of", &[]).len(), 3);

    let broken = std::fs::read_to_string(&column).unwrap();
    let Some(cell) = Cell::with(&[]) else { return };
    pictures::are_noted_if_left_out(&cell, &broken);
    let broken = broken.replacen("<Value>n-Level.V</Value>", "<Value>n-gone</Value>", 1);
    let broken = cell.file("broken.aml", &broken).display().to_string();
    let refused = space(&["mtp", "check", &broken]);
    assert_eq!(refused.status.code(), Some(65));
    let said = stdout(&refused);
    assert!(
        said.contains("Level.V: it refers to an ID that no OPCUAItem has"),
        "{said}"
    );
    assert_eq!(
        space(&["mtp", "check", "/nowhere.aml"]).status.code(),
        Some(74)
    );
}

/// Starts the simulated module of a manifest of the tests.
fn simulated(manifest: &str, more: &[&str]) -> Child {
    let path = own(&format!("mtp/{manifest}")).display().to_string();
    let mut child = StartedChild::new("pea", &program("ua-space"))
        .args(["pea", &path, "--listen", "opc.tcp://127.0.0.1:4840"])
        .args(["--acting", "0.05", "--executing", "0.2"])
        .args(more)
        .start();
    child.wait_for_line(" is at opc.tcp://", SOON);
    child
}

/// Starts the component with the services of a manifest as skills.
fn component(cell: &Cell, manifest: &str, capabilities: &str) -> Child {
    let path = own(&format!("mtp/{manifest}")).display().to_string();
    let text = format!(
        "component: module\napplication_uri: urn:example:module\nnamespace: 51\nsecurity: [None]\n\
         device:\n  mtp:\n    manifest: {path}\n    capabilities: {capabilities}\n"
    );
    let path = cell.file("module.yaml", &text).display().to_string();
    StartedChild::new("component", &program("ua-component"))
        .args([&path, "--interface", "lo", "--lds", "none"])
        .start()
}

#[test]
fn a_service_of_a_module_is_called_as_a_skill() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _module = simulated("stage.aml", &[]);
    let _component = component(&cell, "stage.aml", "{}");
    let call = |parameters: &[&str]| {
        let args = [
            "call",
            "--interface",
            "lo",
            "--wait",
            "30",
            "--timeout",
            "30",
        ];
        space(&[&args[..], parameters].concat())
    };
    // Skills of a device are Halted at first.
    for reset in ["module.Solo-Polka.Reset", "module.Duet-Tango.Reset"] {
        let ready = call(&[reset]);
        assert!(ready.status.success(), "{ready:?}");
    }
    let polka = call(&["module.Solo-Polka"]);
    assert!(polka.status.success(), "{polka:?}");
    let tango = ["module.Duet-Tango", "Tempo=42.5", "Turns=7", "RunTime=0.2"];
    let tango = call(&tango);
    assert!(tango.status.success(), "{tango:?}");
    let high = ["module.Duet-Tango", "Tempo=42.5", "Turns=700"];
    let high = call(&high);
    assert_eq!(high.status.code(), Some(1), "{high:?}");
    let said = stdout(&high) + &String::from_utf8_lossy(&high.stderr);
    assert!(said.contains("Turns is from"), "{said}");
    let info = space(&["skills", "info", "module.Duet-Tango", "--interface", "lo"]);
    assert!(stdout(&info).contains("Tempo"), "{info:?}");
}

#[test]
fn a_manifest_in_a_folder_is_a_component_until_it_is_removed() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _module = simulated("stage.aml", &[]);
    let folder = cell.folder().join("modules");
    std::fs::create_dir(&folder).unwrap();
    let supervisor = StartedChild::new("modules", &program("ua-component"))
        .args(["modules", folder.to_str().unwrap(), "--first", "51", "--"])
        .args(["--interface", "lo", "--lds", "none", "--pki"])
        .args([cell.folder().join("pki")])
        .start();
    let settings = "capabilities:\n  Solo/Polka: [urn:example:capability:dance]\n";
    std::fs::write(folder.join("dance.yaml"), settings).unwrap();
    std::fs::write(folder.join("broken.aml"), "<CAEXFile>").unwrap();
    std::fs::copy(own("mtp/stage.aml"), folder.join("dance.aml")).unwrap();
    let call = |name: &str| {
        let options = ["--interface", "lo", "--wait", "30", "--timeout", "30"];
        space(&[&["call", name][..], &options].concat())
    };
    let ready = call("dance.Solo-Polka.Reset");
    assert!(ready.status.success(), "{ready:?}\n{supervisor}");
    let polka = call("dance.Solo-Polka");
    assert!(polka.status.success(), "{polka:?}");
    let told = || supervisor.lines().join("\n");
    eventually("the faulty manifest has a reason", SOON, || {
        told()
            .contains("broken: its files are faulty")
            .then_some(())
    });
    // A second supervisor would run the component twice.
    let second = Command::new(program("ua-component"))
        .args(["modules", folder.to_str().unwrap()])
        .output()
        .unwrap();
    assert_eq!(second.status.code(), Some(69), "{second:?}");
    let why = String::from_utf8_lossy(&second.stderr);
    assert!(why.contains("in use by another"), "{why}");
    std::fs::remove_file(folder.join("dance.aml")).unwrap();
    eventually("its skills are gone", SOON, || {
        let listed = space(&["skills", "--interface", "lo"]);
        (!stdout(&listed).contains("Solo-Polka")).then_some(())
    });
    // It comes back with the same number.
    std::fs::copy(own("mtp/stage.aml"), folder.join("dance.aml")).unwrap();
    let ready = call("dance.Solo-Polka.Reset");
    assert!(ready.status.success(), "{ready:?}\n{}", told());
    let numbers = std::fs::read_to_string(folder.join(".ua-component/numbers.json")).unwrap();
    let numbers: Value = serde_json::from_str(&numbers).unwrap();
    assert_eq!(numbers, json!({"broken": 51, "dance": 52}));
}

#[test]
fn a_service_is_run_once_by_a_command_that_ctrl_c_stops() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _module = simulated("stage.aml", &[]);
    let stage = own("mtp/stage.aml").display().to_string();
    let run = |more: &[&str]| space(&[&["mtp", "run", stage.as_str()][..], more].concat());
    let polka = run(&["Solo", "--procedure", "Polka", "--json"]);
    assert!(polka.status.success(), "{polka:?}");
    let told = stdout(&polka);
    let lines: Vec<Value> = told
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert!(lines.contains(&json!({"step": "Execute"})), "{told}");
    assert_eq!(lines.last().unwrap()["end"]["succeeded"], true, "{told}");
    let high = run(&["Duet", "--procedure", "Tango", "Tempo=42.5", "Turns=700"]);
    assert_eq!(high.status.code(), Some(1), "{high:?}");
    let why = String::from_utf8_lossy(&high.stderr).into_owned();
    assert!(why.contains("Turns is from 1 to 100"), "{why}");
    for wrong in [&["Trio"][..], &["Duet", "--procedure", "Tango", "Tempo=x"]] {
        let refused = run(wrong);
        assert_eq!(refused.status.code(), Some(64), "{refused:?}");
    }
    let mut waltz = StartedChild::new("waltz", &program("ua-space"))
        .args(["mtp", "run", &stage, "Duet", "--procedure", "Waltz"])
        .start();
    waltz.wait_for_line("Execute", SOON);
    waltz.signal(Signal::SIGINT);
    let status = waltz.wait_for_end(SOON);
    assert_eq!(status.code(), Some(130), "{waltz}");
    waltz.wait_for_line("the service is Stopped", SOON);
    let again = run(&["Duet", "--procedure", "Waltz", "RunTime=0.1"]);
    assert!(again.status.success(), "{again:?}");
    assert!(
        stdout(&again).contains("reset"),
        "it was stopped: {again:?}"
    );
    drop(cell);
}

#[test]
fn the_test_engines_of_the_association_accept_the_package_of_a_module() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    for name in ["stage.aml", "column.aml"] {
        let manifest = own("mtp").join(name).display().to_string();
        let package = cell.folder().join(format!("{name}.aasx"));
        let package = package.display().to_string();
        let made = space(&["aas", &manifest, "--aasx", &package]);
        assert!(made.status.success(), "{made:?}");
        let again = space(&["aas", &manifest, "--aasx", &package]);
        assert_eq!(again.status.code(), Some(74), "no file is replaced");
        let said = cell.asyncua_once("aas_judge.py", &[&package]);
        let manifest = format!("aasx/files/{name}");
        assert_eq!(
            said,
            [
                json!({"ok": true, "faults": [], "parts": ["aasx/aasx-origin", "aasx/data.json", manifest]})
            ]
        );
    }
}

#[test]
fn a_module_of_mtppy_runs_and_its_state_machine_is_ours() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let said = cell.asyncua_once("mtppy_pea.py", &["table"]);
    let cells = said[0]["table"].as_array().unwrap();
    assert_eq!(cells.len(), 160);
    let mut others = Vec::new();
    for cell in cells {
        let name = |at: usize| cell[at].as_str().unwrap();
        let state = State::of_name(name(0)).unwrap();
        let command = ServiceCommand::of_name(name(1)).unwrap();
        let theirs = State::of_name(name(2)).filter(|after| *after != state);
        assert_eq!(theirs.is_some(), cell[3], "CommandEn: {cell}");
        if state.after(command) != theirs {
            others.push(format!("{state} {command}"));
        }
    }
    // MTPPy allows Complete in more states.
    let more = ["Starting", "Paused", "Unholding", "Pausing", "Resuming"];
    let mut more: Vec<String> = more
        .iter()
        .map(|state| format!("{state} Complete"))
        .collect();
    others.sort();
    more.sort();
    assert_eq!(others, more);

    let endpoint = "opc.tcp://127.0.0.1:4840";
    let mut module = cell
        .asyncua_started("mtppy_pea.py", &["serve", endpoint])
        .start();
    let manifest = module.wait_for_json("the manifest", SOON, |line| {
        line["manifest"].as_str().map(str::to_owned)
    });
    let file = cell.file("stirrer.aml", &manifest).display().to_string();
    let run = |more: &[&str]| space(&[&["mtp", "run", file.as_str(), "Stir"][..], more].concat());
    let quick = run(&["--procedure", "Quick", "Time=0.3"]);
    assert!(quick.status.success(), "{quick:?}");
    assert!(stdout(&quick).contains("Turns: 7"), "{quick:?}");
    // It has to be reset: the word of Resetting is 32678 in MTPPy.
    let slow = run(&["RunTime=0.3"]);
    assert!(slow.status.success(), "{slow:?}");
    let stopped = run(&["--run-timeout", "3"]);
    assert_eq!(stopped.status.code(), Some(1), "{stopped:?}");
}

#[test]
fn a_service_of_a_module_is_a_step_of_a_process_and_its_state_is_in_the_graph() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _module = simulated("stage.aml", &[]);
    let dance = "urn:example:capability:dance";
    let _component = component(&cell, "stage.aml", &format!("{{Solo/Polka: [{dance}]}}"));
    let manifest = own("mtp/stage.aml").display().to_string();
    let text = format!(
        "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\nsecurity: [None]\n\
         endpoint: opc.tcp://127.0.0.1:0\nsparql: {AT}\n\
         manifests:\n  - {{name: stage, file: {manifest}, connect: true, capabilities: {{Solo/Polka: [{dance}]}}}}\n\
         processes:\n  - process: urn:example:process:show\n    wait: 60 s\n    steps:\n      - {{step: dance, needs: {{skill: {dance}}}}}\n"
    );
    let path = cell.file("mes.yaml", &text).display().to_string();
    let _mes = StartedChild::new("mes", &program("ua-mes"))
        .args([&path, "--interface", "lo", "--lds", "none"])
        .args(["--run", "urn:example:process:show"])
        .start();
    let get = |path: &str| -> Option<Value> { serde_json::from_str(&http_get(AT, path)?).ok() };
    let run = eventually("the process is done", SOON, || {
        let run = get("/status")?["runs"][0].clone();
        run["ended_ms"].is_number().then_some(run)
    });
    assert_eq!(run["outcome"], "done", "{run}");
    let row = eventually("the state of the service is in the graph", SOON, || {
        let answer = get("/ask/state-of?skill=Solo/Polka")?;
        let row = answer["rows"][0].clone();
        (row["state"] == "Completed").then_some(row)
    });
    assert_eq!(row["value"], 131_072, "{row}");
    let transitions = get("/ask/transitions-now?skill=Solo/Polka").unwrap();
    let commands = columns(
        transitions["rows"].as_array().unwrap(),
        &["command", "value"],
    );
    assert_eq!(
        commands,
        [
            json!(["Abort", 256]),
            json!(["Reset", 2]),
            json!(["Stop", 8])
        ]
    );
    eventually("the state of the skill is in the graph", SOON, || {
        let skill = get("/ask/state-of?skill=Solo-Polka")?;
        (skill["rows"][0]["state"] == "Ready").then_some(())
    });
    let shown = Command::new(program("ua-space"))
        .args(["ask", "state-of", "Solo/Polka", "--json"])
        .output()
        .unwrap();
    assert!(stdout(&shown).contains("Completed"), "{shown:?}");
}

#[test]
fn asyncua_sees_the_simulated_module_follow_the_handshake() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let _module = simulated("column.aml", &[]);
    let manifest = own("mtp/column.aml").display().to_string();
    let args = ["opc.tcp://127.0.0.1:4840", &manifest, "Draining"];
    let said = cell.asyncua_once("pea_judge.py", &args);
    let said = said.first().unwrap();
    assert_eq!(said["read"], 117, "{said}");
    assert_eq!(said["unreadable"], json!([]), "{said}");
    // A command without automatic mode has no effect.
    assert_eq!(said["without_handshake"], 16, "{said}");
    // The states follow each other by growing words; a short state may be missed.
    let states = said["states"].as_array().unwrap();
    assert!(states.is_sorted_by_key(Value::as_u64), "{said}");
    assert_eq!(states.last(), Some(&json!(131_072)), "{said}");
    assert_eq!(said["command"], 0, "{said}");
}

#[test]
fn nine_questions_have_names() {
    for name in [
        "components-of",
        "state-of",
        "services-of",
        "skills-for",
        "transitions-now",
        "parameters-of",
        "outputs-of",
        "access-of",
        "modules-with",
    ] {
        assert!(
            !NamedQuestion::of(name).unwrap().about().is_empty(),
            "{name}"
        );
    }
}
