//! The MES with components that start, are killed and are replaced: its knowledge, which users
//! change, and the outcome of processes.

mod configuring;
mod exchange;
mod judges;
mod live_servers;
mod nodeset_url;
mod opcua_knowledge;
mod queries;
mod remote;

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{Cell, Child, Peer, StartedChild, eventually, http_get, program};

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
    StartedChild::new(file, &program(name))
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
    assert_eq!(there, [2, 2, 2, 6], "{can_run:?}");
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
fn a_manifest_cut_in_half_is_a_finding_and_an_unknown_process_is_refused() {
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
    let changes = [("processes:\n", &*manifests)];
    let mut mes = start(&cell, "ua-mes", "mes.yaml", &changes, &["--check"]);
    assert_eq!(mes.wait_for_end(SOON).code(), Some(78));
    let told = mes.to_string();
    assert!(told.contains("half: line 3:"), "{told}");
    let mes = start(&cell, "ua-mes", "mes.yaml", &changes, &[]);
    let findings = || Some(list(&get("/status")?, "findings").to_vec());
    let found = eventually("the manifest is a finding", SOON, findings);
    let [found] = found.as_slice() else {
        panic!("{found:?}")
    };
    assert_eq!(
        (&found["source"], &found["line"]),
        (&"half".into(), &3.into())
    );
    assert_eq!(rows("processes").len(), 6, "all other sources are read");
    // The repaired file is read again.
    fs::copy(MANIFEST, cell.folder().join("half.aml")).unwrap();
    mes.signal(Signal::SIGHUP);
    eventually("the manifest is in the graph", SOON, || {
        let modules = rows("what-can-run");
        let is_there = modules.iter().any(|row| row["component"] == "Stage:1.0.0");
        (is_there && findings()?.is_empty()).then_some(())
    });
    drop(mes);
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

/// Runs `ua-space` with these arguments, and returns its output.
fn space(arguments: &[&str]) -> (bool, String) {
    let output = std::process::Command::new(program("ua-space"))
        .args(arguments)
        .output()
        .unwrap();
    let text = [output.stdout, output.stderr].concat();
    (
        output.status.success(),
        String::from_utf8_lossy(&text).into_owned(),
    )
}

/// A process as Turtle: a grasp and a release, in steps of their own.
const HOLD: &str = r#"@prefix css: <http://www.w3id.org/hsu-aut/css#> . @prefix cask: <http://www.w3id.org/hsu-aut/cask#> .
@prefix ua: <urn:ua-bridge:plant#> . @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
<urn:hold> a css:Process ; rdfs:label "hold" ; ua:wait 20 ; ua:hasStep <urn:hold/grip> , <urn:hold/let-go> .
<urn:hold/grip> rdfs:label "grip" ; ua:position 1 ;
    css:requiresCapability [ a cask:RequiredCapability , <urn:example:capability:grasp> ] FORCE .
<urn:hold/let-go> rdfs:label "let go" ; ua:position 2 ;
    css:requiresCapability [ a cask:RequiredCapability , <urn:example:capability:release> ] .
"#;

/// Starts a gripper that cannot grasp, and then the one of the examples.
fn two_grippers(cell: &Cell) -> [Child; 2] {
    // This gripper has been there for longer, and cannot grasp but release.
    let other = [
        ("component: parallel-gripper", "component: another"),
        (
            "application_uri: urn:example:gripper",
            "application_uri: urn:example:another",
        ),
        ("namespace: 7", "namespace: 8"),
        ("capability:grasp", "capability:look"),
    ];
    let another = start(cell, "ua-component", "parallel-gripper.yaml", &other, &[]);
    let is_there = |name: &str| rows("components").iter().any(|row| row["name"] == name);
    eventually("another gripper is in the graph", SOON, || {
        is_there("another").then_some(())
    });
    let fast = [("400 ms", "50 ms")];
    let gripper = start(cell, "ua-component", "parallel-gripper.yaml", &fast, &[]);
    eventually("the gripper is in the graph", SOON, || {
        is_there("parallel-gripper").then_some(())
    });
    [another, gripper]
}

/// Adds the process with a parameter that no skill has, and replaces it with the right one. Checks
/// its plan each time.
fn add_wrong_and_right(cell: &Cell) {
    let wrong = HOLD.replace(
        "FORCE",
        "; ua:hasParameter [ cask:hasVariableName \"Nonsense\" ; ua:value 1 ]",
    );
    let file = cell.file("hold.ttl", &wrong);
    let (added, told) = space(&["source", "add", file.to_str().unwrap()]);
    assert!(added, "{told}");
    let plan = get("/plan/urn:hold").unwrap();
    assert_eq!(plan["complete"], false, "{plan}");
    let missing = plan["missing"].as_str().unwrap();
    assert!(missing.contains("has no parameter Nonsense"), "{missing}");
    let (can_run, told) = space(&["plan", "urn:hold"]);
    assert!(
        !can_run && told.contains("has no parameter Nonsense"),
        "{told}"
    );

    let file = cell.file("hold.ttl", &HOLD.replace("FORCE", ""));
    let (added, told) = space(&["source", "add", file.to_str().unwrap()]);
    assert!(added && told.contains("replaced"), "{told}");
    let (can_run, told) = space(&["plan", "hold"]);
    let is_chosen = |line: &str| line.contains("parallel-gripper") && line.contains("yes");
    assert!(can_run && told.lines().any(is_chosen), "{told}");
    let plan = get("/plan/urn:hold").unwrap();
    assert_eq!(plan["complete"], true, "{plan}");
    let chosen: Vec<&Value> = list(&plan["plan"], "steps")
        .iter()
        .map(|step| &step["needs"][0]["chosen"])
        .collect();
    let of = |chosen: &Value| {
        chosen
            .as_str()
            .unwrap_or_default()
            .split('#')
            .next()
            .unwrap_or_default()
            .to_owned()
    };
    assert_eq!(of(chosen[0]), "urn:example:gripper");
    assert_eq!(
        of(chosen[1]),
        "urn:example:gripper",
        "the gripper that grasped"
    );
}

#[test]
fn a_process_that_is_added_as_rdf_runs_with_one_gripper_and_outlasts_a_kill() {
    let Some(cell) = Cell::with(&[]) else { return };
    fs::copy(
        Path::new(EXAMPLES).join("capabilities.ttl"),
        cell.folder().join("capabilities.ttl"),
    )
    .unwrap();
    let store = cell.folder().join("store");
    let store = ["--store", store.to_str().unwrap()];
    let mes = start(&cell, "ua-mes", "mes.yaml", &[], &store);
    let _grippers = two_grippers(&cell);
    add_wrong_and_right(&cell);

    let update = cell.file("update.ru", "INSERT DATA { <urn:a> <urn:b> 1 }");
    let (updated, told) = space(&["source", "update", update.to_str().unwrap()]);
    assert!(updated, "{told}");
    let bad = cell.file("bad.ttl", "<urn:a> <urn:b> .\n\n<urn:c> <urn:d");
    let (added, told) = space(&["source", "add", bad.to_str().unwrap()]);
    assert!(!added && told.contains("line 1"), "{told}");

    mes.signal(Signal::SIGKILL);
    drop(mes);
    let run = ["--run", "urn:hold"];
    let _mes = start(
        &cell,
        "ua-mes",
        "mes.yaml",
        &[],
        &[&store[..], &run].concat(),
    );
    let done = self::run("the process of the store runs", |run| {
        run["process"] == "urn:hold" && !run["ended_ms"].is_null()
    });
    assert_eq!(done["outcome"], "done", "{done}");
    let used = list(&done["plans"][0], "ran").iter();
    let used: Vec<&Value> = used.map(|ran| &ran["component"]).collect();
    assert_eq!(used, ["urn:example:gripper"; 2]);
    let (listed, told) = space(&["source", "list"]);
    assert!(
        listed && told.contains("hold.ttl") && told.contains("urn:ua-bridge:graph:unnamed"),
        "{told}"
    );
    let (removed, told) = space(&["source", "remove", "file", "hold.ttl"]);
    assert!(removed, "{told}");
    assert!(get("/plan/urn:hold").is_none());
}

/// Processes that take the pose of an object, and undo the grasp when the last move fails.
const COMPENSATED: &str = r"processes:
  - process: urn:fetch
    wait: 90 s
    steps:
      - {step: locate, needs: {skill: {type: LocateObjectSkillType}}, parameters: {ObjectId: box}}
      - step: move
        needs: {skill: {type: PtpMoveSkillType}}
        parameters: {TargetPosition: {result: Pose, of: locate}}
      - step: grip
        needs: {skill: {type: GraspSkillType}}
        compensation: {step: let go, needs: {skill: {type: ReleaseSkillType}}}
      - step: move away
        needs: {skill: {type: PtpMoveSkillType}}
        parameters: {TargetPosition: [AWAY, 0, 0.2, 0, 0, 0]}
        by: {component_of: move}
      - {step: put down, needs: {skill: {type: ReleaseSkillType}}}
  - process: urn:hold
    steps:
      - {step: grip, needs: {skill: {type: GraspSkillType}}}
      - {step: put down, needs: {skill: {type: ReleaseSkillType}}}
";

/// Starts the MES with these processes and a last move that goes so far.
fn compensating(cell: &Cell, away: &str) -> Child {
    let object = "<urn:box> <urn:ua-bridge:plant#objectId> \"box\" ; <urn:ua-bridge:plant#pose> \"0.4 0.2 0.1 0 0 0\" .";
    fs::write(cell.folder().join("box.ttl"), object).unwrap();
    let capabilities = Path::new(EXAMPLES).join("capabilities.ttl");
    fs::copy(capabilities, cell.folder().join("capabilities.ttl")).unwrap();
    let processes = COMPENSATED.replace("AWAY", away);
    let changes = [
        ("[capabilities.ttl]", "[capabilities.ttl, box.ttl]"),
        ("processes:\n", &*processes),
    ];
    let mes = start(cell, "ua-mes", "mes.yaml", &changes, &[]);
    eventually("all components are in the graph", SOON, || {
        let known = rows("components");
        let is_there = |name: &&str| known.iter().any(|row| row["name"] == *name);
        let names = ["mes", "robot", "parallel-gripper"];
        names.iter().all(is_there).then_some(())
    });
    mes
}

#[test]
fn a_failed_job_undoes_its_steps_and_jobs_share_a_gripper() {
    let Some(cell) = Cell::with(&[]) else { return };
    let fast = [("{reach: 1.3}", "{reach: 1.3, time_scale: 20}")];
    let _robot = start(&cell, "ua-component", "robot.yaml", &fast, &[]);
    let fast = [("400 ms", "50 ms")];
    let _gripper = start(&cell, "ua-component", "parallel-gripper.yaml", &fast, &[]);
    let mes = compensating(&cell, "9");
    let (done, told) = space(&["job", "start", "urn:fetch", "--wait"]);
    assert!(!done, "{told}");
    let ends = told.trim_end().ends_with("; compensated: `grip`");
    assert!(
        ends && told.contains("move away: robot.PtpMove Bad"),
        "{told}"
    );
    let ran = eventually("the graph has the run", SOON, || {
        let ran = rows("run-steps");
        let is_over = rows("runs").first()?["outcome"] == "failed";
        is_over.then_some(ran)
    });
    let part = |row: &Value| {
        [
            row["step"].clone(),
            row["outcome"].clone(),
            row["compensates"].clone(),
        ]
    };
    let ran: Vec<Value> = ran
        .iter()
        .map(|row| part(row).into_iter().collect())
        .collect();
    let expected = serde_json::json!([
        ["locate", "done", false],
        ["move", "done", false],
        ["grip", "done", false],
        ["move away", "failed", false],
        ["let go", "done", true],
    ]);
    assert_eq!(Value::from(ran), expected);
    let (is_known, told) = space(&["job", "start", "urn:nothing"]);
    assert!(!is_known && told.contains("is no process here"), "{told}");
    drop(mes);

    let _mes = compensating(&cell, "0.5");
    for process in ["urn:fetch", "urn:hold", "urn:fetch"] {
        let (started, told) = space(&["job", "start", process]);
        assert!(started, "{told}");
    }
    let ended = eventually("all jobs have ended", SOON * 3, || {
        let listed = get("/jobs")?;
        let all = list(&listed, "jobs").to_vec();
        let have_ended = all.iter().all(|job| job["outcome"] != "running");
        have_ended.then_some(all)
    });
    let outcomes: Vec<_> = ended.iter().map(|job| &job["outcome"]).collect();
    assert_eq!(outcomes, ["done"; 3], "{ended:?}");
    let (listed, told) = space(&["job", "list"]);
    assert!(listed && told.matches("done").count() == 3, "{told}");
    reaches_a_goal();
}

/// Adds the goal of the examples, and runs the sequence that reaches it.
fn reaches_a_goal() {
    let file = format!("{EXAMPLES}/goal.ttl");
    let (added, told) = space(&["source", "add", &file]);
    assert!(added, "{told}");
    let goal = "urn:example:goal:sorted";
    let (planned, told) = space(&["goal", goal, "--json"]);
    assert!(
        planned && told.contains(r#""fact":"urn:example:fact:holding","holds":true,"since":2"#),
        "{told}"
    );
    let (done, told) = space(&["job", "start", goal, "--wait"]);
    assert!(done && told.trim_end().ends_with(": done"), "{told}");
    let (held, told) = space(&["ask", "what-can-hold", "100 mm/s", "--json"]);
    assert!(held && told.contains("MaxVelocity"), "{told}");
}

/// Sends an update of SPARQL. Returns whether it was acknowledged.
fn update(text: &str) -> bool {
    post("/update", "application/sparql-update", text) == Some(200)
}

/// Sends a body of a media type. Returns the status code, if there is an answer.
fn post(path: &str, media: &str, text: &str) -> Option<u16> {
    let send = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect(AT)?;
        stream.set_read_timeout(Some(SOON))?;
        let length = text.len();
        write!(
            stream,
            "POST {path} HTTP/1.1\r\nHost: {AT}\r\nContent-Type: {media}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{text}"
        )?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(answer)
    };
    let answer = send().ok()?;
    answer.split_whitespace().nth(1)?.parse().ok()
}

#[test]
fn a_kill_in_the_middle_of_updates_loses_no_acknowledged_one() {
    let Some(cell) = Cell::with(&[]) else { return };
    fs::copy(
        Path::new(EXAMPLES).join("capabilities.ttl"),
        cell.folder().join("capabilities.ttl"),
    )
    .unwrap();
    let folder = cell.folder().join("store");
    let store = ["--store", folder.to_str().unwrap()];
    let mut acknowledged = 0;
    for kills in 1..=3 {
        let mes = start(&cell, "ua-mes", "mes.yaml", &[], &store);
        eventually("the MES answers", SOON, || get("/status"));
        let graphs = get("/graphs").unwrap();
        let written = list(&graphs, "graphs")
            .iter()
            .find(|graph| graph["graph"] == "urn:updates");
        let written = written.and_then(|graph| graph["statements"].as_u64());
        // An update may have been stored whose acknowledgement the kill prevented.
        let there = written.unwrap_or(0);
        assert!(
            there == acknowledged || there == acknowledged + 1,
            "{there} of {acknowledged}"
        );
        acknowledged = there;
        let enough = acknowledged + 100;
        thread::scope(|scope| {
            let (reached, wait) = mpsc::channel();
            let updates = scope.spawn(move || {
                let mut done = acknowledged;
                let insert = |number| {
                    let triple = format!("<urn:s{number}> <urn:p> {number}");
                    update(&format!(
                        "INSERT DATA {{ GRAPH <urn:updates> {{ {triple} }} }}"
                    ))
                };
                while insert(done) {
                    done += 1;
                    if done == enough {
                        reached.send(()).unwrap();
                    }
                }
                done
            });
            wait.recv_timeout(SOON).unwrap();
            mes.signal(Signal::SIGKILL);
            acknowledged = updates.join().unwrap();
        });
        assert!(acknowledged >= 100 * kills);
    }
}

/// Starts the three modules of the example recipe, simulated, and their services as skills.
fn modules(cell: &Cell) -> Vec<Child> {
    let mut started = Vec::new();
    for (module, port) in [("dosing", 4855), ("mixing", 4856), ("reacting", 4857)] {
        let file = format!("{module}.aml");
        let manifest = cell.folder().join(&file);
        fs::copy(Path::new(EXAMPLES).join(&file), &manifest).unwrap();
        let listen = format!("opc.tcp://127.0.0.1:{port}");
        let pea = StartedChild::new(module, &program("ua-space"))
            .args(["pea", manifest.to_str().unwrap(), "--listen", &listen])
            .args(["--acting", "0.05", "--executing", "0.5"])
            .start();
        started.push(pea);
        let yaml = format!("{module}.yaml");
        started.push(start(cell, "ua-component", &yaml, &[], &[]));
    }
    started
}

#[test]
fn a_recipe_of_batchml_runs_as_a_job_order_of_an_opcua_client() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let recipe = Path::new(EXAMPLES).join("batch.xml");
    fs::copy(recipe, cell.folder().join("batch.xml")).unwrap();
    let text = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                endpoint: opc.tcp://127.0.0.1:48401\nsecurity: [None]\nrecipes: [batch.xml]\n";
    let path = cell.file("mes.yaml", text);
    let _mes = StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .start();
    let _modules = modules(&cell);
    let process = "urn:ua-bridge:recipe:StirredAndReacted";
    eventually("each step has a skill", SOON, || {
        let plan = get(&format!("/plan/{process}"))?;
        (plan["complete"] == true).then_some(())
    });
    let said = cell.asyncua_once("opcua_jobs.py", &["opc.tcp://127.0.0.1:48401", process]);
    let calls: Vec<(&str, u64)> = said
        .iter()
        .filter_map(|line| Some((line["call"].as_str()?, line["status"].as_u64()?)))
        .collect();
    let expected = [
        ("Store", 1),
        ("Store", 16),
        ("Stop", 8),
        ("Start", 1),
        ("Clear", 8),
        ("StoreAndStart", 1),
        ("Pause", 1),
        ("Resume", 1),
        ("Stop", 1),
        ("Clear", 1),
    ];
    assert_eq!(calls, expected, "{said:?}");
    let response = said.last().unwrap();
    assert_eq!(
        response["state"], 5,
        "the first job order has ended: {response}"
    );
    let runs = get("/status").unwrap()["runs"].clone();
    let outcomes: Vec<_> = list(&serde_json::json!({ "runs": runs }), "runs")
        .iter()
        .map(|run| run["outcome"].as_str().unwrap_or_default().to_owned())
        .collect();
    assert_eq!(
        outcomes.first().map(String::as_str),
        Some("done"),
        "{outcomes:?}"
    );
    // The reactor is heated while the liquid is dosed and stirred.
    let ran = list(&runs[0]["plans"][0], "ran");
    let steps: Vec<_> = ran.iter().filter_map(|ran| ran["step"].as_str()).collect();
    assert_eq!(steps.len(), 4, "{ran:?}");
    let of = |step: &str, key: &str| {
        let ran = ran.iter().find(|ran| ran["step"] == step).unwrap();
        ran[key].as_u64().unwrap()
    };
    assert!(
        of("heat the reactor", "started_ms") < of("dose", "ended_ms"),
        "{ran:?}"
    );
    assert!(
        of("cool the reactor", "started_ms") >= of("stir", "ended_ms"),
        "{ran:?}"
    );
}
