//! `ua-space` with running programs: it lists, echoes and measures values of a bridge, and finds
//! and starts a skill.

use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{
    CaptureFile, Cell, METRICS_ROS1, Peer, StartedChild, UadpSocket, eventually, metrics, program,
};

const SOON: Duration = Duration::from_secs(30);
const TWIST: &str = "geometry_msgs/Twist";

/// Runs `ua-space` in the cell's network. Returns the exit code and the output.
fn ua_space(words: &[&str]) -> (i32, Vec<String>) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--interface", "lo"])
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.lines())
}

fn objects(lines: &[String]) -> Vec<Value> {
    let lines = lines
        .iter()
        .filter_map(|line| serde_json::from_str(line).ok());
    lines.collect()
}

#[test]
fn what_a_ros_1_node_publishes_is_listed_echoed_and_measured_without_a_mapping() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[]);
    let twist = json!({"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.125}});
    let value = twist.to_string();
    let repeat = ["--repeat", "0", "--value", &value];
    let _node = cell.rospy(
        "ros1_pub.py",
        &[&["/ua_1_2_10", TWIST], &repeat[..]].concat(),
    );
    let listed = eventually("the topic is listed with its type", SOON, || {
        let (code, lines) = ua_space(&["list", "--seconds", "1", "--json"]);
        assert_eq!(code, 0, "{lines:?}");
        let all = objects(&lines).pop()?;
        let all = all["topics"].as_array()?.iter();
        let mut found = all.filter(|line| line["topic"] == "ua_1_2_10" && line["type"] == TWIST);
        found.next().cloned()
    });
    assert_eq!(
        (&listed["kind"], &listed["origin"]),
        (&json!("value"), &json!("ROS 1"))
    );
    let (code, lines) = ua_space(&["echo", "/ua_1_2_10", "-n", "1"]);
    assert_eq!(code, 0, "{lines:?}");
    for line in ["linear.x: 0.5", "angular.z: -0.125"] {
        assert!(
            lines.iter().any(|found| found == line),
            "{line} in {lines:?}"
        );
    }
    let (code, lines) = ua_space(&["hz", "ua_1_2_10", "--seconds", "1.5", "--json"]);
    let rate = objects(&lines)
        .pop()
        .and_then(|rhythm| rhythm["rate_hz"].as_f64());
    assert!(
        code == 0 && rate.is_some_and(|rate| rate > 2.0),
        "{lines:?}"
    );
    let (code, lines) = ua_space(&[
        "trace",
        "--metrics",
        METRICS_ROS1,
        "--seconds",
        "1",
        "--json",
    ]);
    let traced = objects(&lines).pop().unwrap_or_default();
    let program = &traced["programs"][0];
    assert_eq!(
        (code, &program["program"]),
        (0, &json!("bridge-ros1")),
        "{lines:?}"
    );
    assert!(
        program["hops"]["out"]["p50_us"].as_f64() > Some(0.0),
        "{program}"
    );
    let hops = traced["topics"].as_array().unwrap();
    for hop in ["origin", "network"] {
        let is_it = |row: &&Value| row["topic"] == "ua_1_2_10" && row["hop"] == hop;
        let row = hops.iter().find(is_it).unwrap_or(&Value::Null);
        assert!(
            row["max_us"].as_f64() >= row["p50_us"].as_f64() && row["count"].as_u64() > Some(0),
            "{row}"
        );
    }
    // The hops of one topic, of the programs of this host.
    let (code, lines) = ua_space(&["trace", "ua_1_2_10", "--seconds", "2", "--json"]);
    let traced = objects(&lines).pop().unwrap_or_default();
    let out = &traced["hops"][0];
    assert_eq!(
        (code, &out["hop"], &out["program"]),
        (0, &json!("out"), &json!("bridge-ros1")),
        "{lines:?}"
    );
    assert!(out["p999_us"].as_f64() > Some(0.0), "{out}");
}

const NAMED: &str = r#"
spaces: [{id: 1}]
namespaces: {2: urn:test}
variables:
  - {node: ns=2;i=10, name: Left.Speed, origin: 1, ros: {topic: /left/speed, type: geometry_msgs/Twist}}
  - {node: ns=2;i=11, name: Right.Speed, origin: 1, ros: {topic: /right/speed, type: geometry_msgs/Twist}}
  - {node: ns=2;i=12, name: Right.Forward, origin: 1, ros: {topic: /right/speed, type: geometry_msgs/Twist, field: linear.x}}
"#;

#[test]
fn mapped_topics_are_listed_echoed_and_completed_by_their_names_and_ros_topics() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", NAMED);
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let twist = json!({"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}});
    let value = twist.to_string();
    let _nodes = ["left", "right"].map(|side| {
        let topic = format!("/{side}/speed");
        let words = ["--node", side, "--repeat", "0", "--value", &value];
        cell.rospy("ros1_pub.py", &[&[&topic, TWIST], &words[..]].concat())
    });
    let listed = eventually("both topics are listed with their names", SOON, || {
        let (code, lines) = ua_space(&["list", "--topics", "--seconds", "1", "--json"]);
        assert_eq!(code, 0, "{lines:?}");
        let all = objects(&lines).pop()?;
        let of = |topic: &str| {
            let mut all = all["topics"].as_array()?.iter();
            all.find(|line| line["topic"] == topic && line["name"].is_string())
                .cloned()
        };
        Some([of("ua_1_2_10")?, of("ua_1_2_11")?, of("ua_1_2_12")?])
    });
    let names: Vec<&Value> = listed.iter().map(|line| &line["name"]).collect();
    assert_eq!(names, ["Left.Speed", "Right.Speed", "Right.Forward"]);
    let ros = json!([{"space": 1, "topic": "/left/speed"}]);
    assert_eq!(
        (&listed[0]["ros_topics"], &listed[0]["quality"]),
        (&ros, &json!("Good"))
    );
    let lines = eventually("the table has the names", SOON, || {
        let (_, lines) = ua_space(&["list", "--topics", "--seconds", "1"]);
        let row = lines.iter().find(|line| line.starts_with("ua_1_2_10"))?;
        (row.contains("Left.Speed") && row.contains("/left/speed")).then_some(lines)
    });
    let narrow = |line: &String| line.chars().count() <= 80;
    assert!(lines.iter().all(narrow), "{lines:?}");

    for name in ["Left.Speed", "/left/speed", "left/speed"] {
        let (code, lines) = ua_space(&["echo", name, "-n", "1", "--json"]);
        let shown = objects(&lines).pop().unwrap_or_default();
        assert_eq!(
            (code, &shown["topic"]),
            (0, &json!("ua_1_2_10")),
            "{name}: {lines:?}"
        );
        assert_eq!(shown["value"]["linear.x"], 0.5);
    }
    for name in ["Speed", "/right/speed"] {
        let lines = eventually("the name is ambiguous", SOON, || {
            let (code, lines) = ua_space(&["echo", name, "-n", "1"]);
            (code == 64).then_some(lines)
        });
        let listed = |topic: &str| lines.iter().any(|line| line.contains(topic));
        assert!(
            listed("is the name of 2 topics") && listed("ua_1_2_11"),
            "{lines:?}"
        );
    }
    eventually("the shell completes the name", SOON, || {
        let offered = completed(&["echo", "--interface", "lo", "Left"]);
        (offered == ["Left.Speed"]).then_some(())
    });
    let status = metrics(METRICS_ROS1).unwrap();
    assert_eq!(status["topics"]["ua_1_2_10"]["name"], "Left.Speed");
    eventually("top shows the topic by its name", SOON, || {
        let (code, lines) = ua_space(&["top", "--seconds", "2", "--sort", "name"]);
        assert_eq!(code, 0, "{lines:?}");
        let row = lines.iter().find(|line| line.starts_with("ua_1_2_10"))?;
        row.contains("Left.Speed").then_some(())
    });
    eventually("the bandwidth is measured", SOON, || {
        let (_, lines) = ua_space(&["bw", "/left/speed", "--seconds", "3", "--json"]);
        let load = objects(&lines).pop()?;
        (load["bytes_per_second"].as_f64() > Some(0.0)).then_some(())
    });
}

#[test]
fn starting_files_are_accepted_by_their_programs() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let run = |name: &str, words: &[&str]| {
        let mut child = StartedChild::new(name, &program(name)).args(words).start();
        (child.wait_for_end(SOON).code().unwrap(), child.lines())
    };
    for (kind, checker, verb) in [
        ("component", "ua-component", "--check"),
        ("mes", "ua-mes", "--check"),
        ("mapping", "ua-space", "check"),
    ] {
        let path = cell.folder().join(format!("{kind}.yaml"));
        let path = path.to_str().unwrap();
        let (code, lines) = run("ua-space", &["new", kind, "-o", path]);
        assert_eq!(code, 0, "{kind}: {lines:?}");
        let (code, lines) = run(checker, &[verb, path]);
        assert_eq!(code, 0, "{kind}: {lines:?}");
        let (code, lines) = run("ua-space", &["new", kind, "-o", path]);
        assert_eq!(code, 74, "an existing file is kept: {lines:?}");
    }
    for driver in ["ros", "moveit", "exec", "http"] {
        let path = cell.folder().join(format!("{driver}.yaml"));
        let path = path.to_str().unwrap();
        let new = ["new", "component", "--driver", driver, "-o", path];
        let (code, lines) = run("ua-space", &new);
        assert_eq!(code, 0, "{driver}: {lines:?}");
        let (code, lines) = run("ua-component", &["--check", path]);
        assert_eq!(code, 0, "{driver}: {lines:?}");
    }
}

#[test]
fn a_skill_of_a_component_is_found_and_run_to_its_result() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let yaml =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/plant/parallel-gripper.yaml");
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([yaml.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("pki")])
        .start();
    let skill = eventually(
        "the skill is listed with its state and its call",
        SOON,
        || {
            let (_, lines) = ua_space(&["skills", "parallel-gripper", "--seconds", "1", "--json"]);
            let all = objects(&lines).pop()?;
            let grasp = all
                .as_array()?
                .iter()
                .find(|skill| skill["skill"] == "Grasp")?;
            let is_whole = grasp["state"].is_string() && grasp["calls"]["Start"].is_string();
            is_whole.then(|| grasp.clone())
        },
    );
    assert_eq!(
        (&skill["type"], &skill["topic"], &skill["calls"]["Start"]),
        (
            &json!("GraspSkillType"),
            &json!("ua_0_7_101"),
            &json!("ua_0_7_105")
        )
    );
    if skill["state"] == "Halted" {
        let (code, lines) = ua_space(&["call", "parallel-gripper.Grasp.Reset"]);
        assert_eq!(code, 0, "{lines:?}");
    }
    let (code, lines) = ua_space(&["call", "parallel-gripper.Grasp", "Force=12.5", "--json"]);
    let events = objects(&lines);
    assert_eq!(
        (code, &events[0]["fields"]["success"]),
        (0, &json!(true)),
        "{lines:?}"
    );
    let states = events.iter().filter(|event| event["event"] == "state");
    let states: Vec<&str> = states.filter_map(|event| event["state"].as_str()).collect();
    assert_eq!(states, ["Running", "Ready"], "{lines:?}");
    let result = events
        .iter()
        .find(|event| event["event"] == "result")
        .unwrap_or(&Value::Null);
    assert_eq!(
        (&result["succeeded"], &result["results"]),
        (&json!(true), &json!({"Gripped": true}))
    );
    let (code, lines) = ua_space(&["call", "parallel-gripper.Grasp", "Force=hard"]);
    assert_eq!(code, 64, "{lines:?}");
    let (code, lines) = ua_space(&["call", "parallel-gripper.Grasp.Resume"]);
    assert!(
        code == 1 && lines.iter().any(|line| line.contains("BadInvalidState")),
        "{lines:?}"
    );
}

/// Returns the completions of bash for the last word of a line, with the script of `ua-space`.
fn completed(line: &[&str]) -> Vec<String> {
    let words: Vec<String> = line.iter().map(|word| format!("'{word}'")).collect();
    let ua_space = program("ua-space");
    let script = format!(
        "source <('{0}' completion bash); COMP_WORDS=('{0}' {1}); COMP_CWORD={2}; _ua_space; printf '%s\\n' \"${{COMPREPLY[@]}}\"",
        ua_space.display(),
        words.join(" "),
        line.len(),
    );
    let mut child = StartedChild::new("bash", Path::new("/bin/bash"))
        .args(["--norc", "-c", &script])
        .start();
    assert!(child.wait_for_end(SOON).success(), "{child}");
    child.lines()
}

fn completes_names() {
    let offered = completed(&["skills", "start", "--interface", "lo", "vacuum-gripper.V"]);
    assert_eq!(offered, ["vacuum-gripper.VacuumGrasp"]);
    let offered = completed(&["call", "--interface", "lo", "parallel-gripper.Grasp"]);
    assert!(
        offered.contains(&"parallel-gripper.Grasp.Halt".to_owned()),
        "{offered:?}"
    );
}

#[test]
fn skills_of_two_components_are_told_run_watched_and_completed_by_their_names() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/plant");
    let _components = ["parallel-gripper.yaml", "vacuum-gripper.yaml"].map(|yaml| {
        StartedChild::new("ua-component", &program("ua-component"))
            .args([examples.join(yaml)])
            .args(["--interface", "lo", "--lds", "none"])
            .args(["--pki".into(), cell.folder().join("pki")])
            .start()
    });
    let names = ["parallel-gripper.Grasp", "vacuum-gripper.VacuumGrasp"];
    eventually("both are heard", SOON, || {
        let offered = completed(&["skills", "--interface", "lo", "info", ""]);
        let has_both = names
            .iter()
            .all(|name| offered.iter().any(|one| one == name));
        has_both.then_some(())
    });
    assert_eq!(completed(&["ski"]), ["skills"]);
    assert_eq!(completed(&["skills", "--interface", "lo", "w"]), ["watch"]);
    completes_names();

    let mut watch = StartedChild::new("ua-space", &program("ua-space"))
        .args(["skills", "watch", "vacuum-gripper", "--json"])
        .args(["--interface", "lo"])
        .start();
    let events = |watch: &system_tests::Child, what: &str| {
        let lines = watch.json_lines();
        let of = lines.into_iter().filter(|line| line["event"] == *what);
        of.collect::<Vec<_>>()
    };
    eventually("it says how they are", SOON, || {
        (events(&watch, "state").len() >= 2).then_some(())
    });
    // Both skills are Halted: they are reset first.
    for name in names {
        let (code, lines) = ua_space(&["skills", "start", name, "Force=9", "--json"]);
        assert_eq!(code, 0, "{lines:?}");
        let steps = objects(&lines);
        assert_eq!(steps[0]["event"], "answer", "{lines:?}");
        let result = steps.iter().find(|step| step["event"] == "result");
        assert_eq!(result.map(|step| &step["succeeded"]), Some(&json!(true)));
    }
    let result = eventually("the end of the run is watched", SOON, || {
        events(&watch, "result").pop()
    });
    assert_eq!(
        (&result["skill"], &result["succeeded"], &result["results"]),
        (
            &json!("vacuum-gripper.VacuumGrasp"),
            &json!(true),
            &json!({"Gripped": true})
        )
    );
    let run = &result["run"];
    // The last state may arrive after the result.
    eventually("its states are watched", SOON, || {
        let states = events(&watch, "state");
        let states: Vec<&str> = states
            .iter()
            .filter(|state| state["run"] == *run)
            .filter_map(|state| state["state"].as_str())
            .collect();
        (states == ["Running", "Ready"]).then_some(())
    });
    watch.end();

    let (code, lines) = ua_space(&["skills", "info", names[1], "--json"]);
    let whole = objects(&lines).pop().unwrap();
    assert_eq!(
        (
            code,
            &whole["type"],
            &whole["state"],
            &whole["result"]["run"]
        ),
        (0, &json!("VacuumGraspSkillType"), &json!("Ready"), run)
    );
    let parameters = whole["parameters"].as_array().unwrap();
    let has = |name: &str| parameters.iter().any(|one| one["name"] == *name);
    assert!(has("Force") && has("Vacuum"), "{whole}");
    what_is_wrong_is_told();
}

fn what_is_wrong_is_told() {
    let (code, lines) = ua_space(&["skills", "info", "parallel-gripper.Grip", "--seconds", "1"]);
    assert_eq!(code, 69, "{lines:?}");
    let names_it = |line: &String| line.contains("parallel-gripper.Grasp");
    assert!(lines.iter().any(names_it), "{lines:?}");
    let (code, lines) = ua_space(&["skills", "start", "parallel-gripper.Grasp", "Force=hard"]);
    assert_eq!(code, 64, "{lines:?}");
}

#[test]
fn tshark_reads_what_a_component_and_its_caller_say() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let group = UadpSocket::join();
    let yaml =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/plant/parallel-gripper.yaml");
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([yaml.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("pki")])
        .start();
    eventually("the skill is made ready", SOON, || {
        (ua_space(&["call", "parallel-gripper.Grasp.Reset"]).0 == 0).then_some(())
    });
    assert_eq!(ua_space(&["call", "parallel-gripper.Grasp"]).0, 0);
    let heard = group.receive_for(Duration::from_millis(200));
    let shown = cell.dissect(&CaptureFile::of(heard), &[]);
    for shown in &shown {
        let wrong = shown.has("uadp.malformed") || shown.has("uadp.dissector_bug");
        assert!(!wrong, "{:?}: {shown:?}", shown.expert_infos());
    }
    let with = |topic: &str, field: &str, value: &str| {
        let mut shown = shown.iter();
        shown.any(|shown| {
            shown.all("uadp.topic").contains(&topic.to_owned())
                && shown.all(field).contains(&value.to_owned())
        })
    };
    assert!(with("ua_0_7_101", "uadp.field.string", "Running"), "state");
    assert!(with("ua_0_7_105", "uadp.dataset.kind", "5"), "request");
    assert!(with("ua_0_7_105", "uadp.dataset.kind", "6"), "response");
    assert!(with("ua_0_7_105", "uadp.action.state", "2"), "Done");
}
