//! Output of the commands that observe a running space and send requests to it.

mod component;

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, UdpSocket};
use std::process::{Command, Stdio};
use std::time::Duration;

use component::GroupComponent;
use serde_json::{Value, json};

use crate::program::{ProgramEnd, named, run, run_on};

fn object(text: &str) -> Value {
    serde_json::from_str(text).unwrap()
}

fn of(component: &GroupComponent, words: &[&str]) -> ProgramEnd {
    run(&component.words(words))
}

#[test]
fn topics_and_calls_are_listed_with_what_they_are_whatever_else_is_in_the_group() {
    let component = GroupComponent::start();
    let group = component.address;
    let noise = std::thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        for round in 0..300_u16 {
            let mut made_up = vec![0x11 | 0x40, 0x01, 7, 0];
            made_up.extend(round.to_le_bytes());
            for datagram in [&b"garbage"[..], &[0xff; 40], &made_up, &[]] {
                // Multicast from a socket bound to loopback stays on loopback.
                let _sent = socket.send_to(datagram, group);
            }
            std::thread::park_timeout(Duration::from_millis(2));
        }
    });
    let ended = of(
        &component,
        &["list", "--json", "--topics", "--seconds", "2"],
    );
    noise.join().unwrap();
    assert_eq!(ended.code, 0, "{ended:?}");
    let all = object(&ended.stdout);
    let line = |topic: &str| {
        let mut all = all["topics"].as_array().unwrap().iter();
        all.find(|line| line["topic"] == topic).unwrap().clone()
    };
    let state = line("ua_0_7_101");
    assert_eq!(
        (
            &state["kind"],
            &state["origin"],
            &state["name"],
            &state["type"]
        ),
        (
            &json!("value"),
            &json!("OPC UA"),
            &json!("gripper.Grasp.State"),
            &json!("ua_msgs/SkillState")
        )
    );
    let rate = state["rate_hz"].as_f64().unwrap();
    assert!((5.0..=40.0).contains(&rate), "{rate}");
    let start = line("ua_0_7_105");
    assert_eq!(
        (&start["kind"], &start["name"]),
        (&json!("call"), &json!("gripper.Grasp.Start"))
    );
    assert_eq!(
        start["takes"],
        json!([{"name": "Force", "type": "Double"}, {"name": "Name", "type": "String", "optional": true}])
    );
}

#[test]
fn a_pipe_gets_a_table_without_colour() {
    let component = GroupComponent::start();
    let ended = of(&component, &["list", "--topics", "--seconds", "1.5"]).quiet();
    let mut lines = ended.lines();
    let head = lines.next().unwrap();
    assert_eq!(
        head.split_whitespace().collect::<Vec<_>>().join(" "),
        "TOPIC NAME KIND RATE LAST TYPE"
    );
    assert!(
        lines.any(|line| line.starts_with("ua_0_7_101  gripper.Grasp.State  value  ")),
        "{ended}"
    );
    assert!(!ended.contains('\x1b'));
}

#[test]
fn a_value_is_echoed_field_by_field_under_its_names_and_counted() {
    let component = GroupComponent::start();
    let ended = of(&component, &["echo", "/ua_0_7_101", "-n", "2", "--json"]);
    let lines = ended.lines();
    assert_eq!((ended.code, lines.len()), (0, 2), "{ended:?}");
    assert_eq!(lines[0]["value"]["state"], "Ready");
    assert_eq!(lines[1]["value"]["step"], "Closing");
    assert!(
        lines[0]["time"].as_str().unwrap().starts_with("20"),
        "{}",
        lines[0]
    );
    let yaml = of(&component, &["echo", "ua_0_7_101", "-n", "1"]).quiet();
    let fields: Vec<&str> = yaml.lines().skip(1).collect();
    let wanted = [
        "state: \"Ready\"",
        "number: 12",
        "last_transition: \"HaltedToReady\"",
        "progress: 0.5",
        "step: \"Closing\"",
        "run: 0",
    ];
    assert_eq!(fields, wanted);
    let hz = of(
        &component,
        &["hz", "ua_0_7_101", "--seconds", "1.2", "--json"],
    );
    let rate = hz.lines().last().unwrap()["rate_hz"].as_f64().unwrap();
    assert!((5.0..=40.0).contains(&rate), "{rate}");
}

#[test]
fn a_topic_is_known_by_its_name_to_every_verb() {
    let component = GroupComponent::start();
    for name in ["gripper.Grasp.State", "Grasp.State", "grasp.state"] {
        let ended = of(&component, &["echo", name, "-n", "1", "--json"]);
        let lines = ended.lines();
        assert_eq!((ended.code, lines.len()), (0, 1), "{ended:?}");
        assert_eq!(lines[0]["topic"], "ua_0_7_101");
        assert_eq!(lines[0]["value"]["state"], "Ready");
    }
    let info = of(
        &component,
        &["info", "gripper.Grasp.State", "--seconds", "4"],
    )
    .quiet();
    assert!(info.contains("topic:       ua_0_7_101"), "{info}");
    let hz = of(
        &component,
        &["hz", "Grasp.State", "--seconds", "5", "--json"],
    );
    let rate = hz.lines().last().unwrap()["rate_hz"].as_f64().unwrap();
    assert!(rate > 1.0, "{rate}");
}

#[test]
fn an_unknown_name_is_reported_with_the_name_that_may_be_meant() {
    let component = GroupComponent::start();
    let words = ["echo", "gripper.Grasp.Stat", "--seconds", "4"];
    let ended = of(&component, &words);
    assert_eq!((ended.code, ended.stdout.as_str()), (69, ""));
    for part in [
        "no topic named gripper.Grasp.Stat was announced",
        "did you mean `gripper.Grasp.State`?",
    ] {
        assert!(ended.stderr.contains(part), "{}", ended.stderr);
    }
    assert_eq!(run(&["info", ""]).code, 64);
}

#[test]
fn of_a_topic_nobody_sends_it_is_told_what_there_is() {
    let component = GroupComponent::start();
    let ended = of(&component, &["echo", "ua_0_7_99", "--seconds", "0.5"]);
    assert_eq!((ended.code, ended.stdout.as_str()), (69, ""));
    assert!(
        ended
            .stderr
            .contains("ua_0_7_99 was not heard in 239.255.41.7:"),
        "{}",
        ended.stderr
    );
    assert!(
        ended.stderr.contains("`ua-space list` shows"),
        "{}",
        ended.stderr
    );
    assert_eq!(run(&["echo", "ua_1_2"]).code, 64);
}

#[test]
fn a_call_says_what_it_takes_and_gives() {
    let component = GroupComponent::start();
    let text = of(&component, &["info", "ua_0_7_105", "--seconds", "1"]).quiet();
    for line in [
        "name:        gripper.Grasp.Start",
        "takes:       Force: Double",
        "gives:       run: UInt32",
    ] {
        assert!(text.lines().any(|found| found == line), "{line} in {text}");
    }
}

#[test]
fn the_skills_are_listed_with_their_states_and_how_to_start_them() {
    let component = GroupComponent::start();
    let all = object(&of(&component, &["skills", "--json", "--seconds", "1.5"]).quiet());
    let skill = &all[0];
    assert_eq!(
        (
            &skill["component"],
            &skill["skill"],
            &skill["type"],
            &skill["state"],
            &skill["run"]
        ),
        (
            &json!("gripper"),
            &json!("Grasp"),
            &json!("GraspSkillType"),
            &json!("Ready"),
            &json!(0)
        )
    );
    assert_eq!(
        skill["calls"],
        json!({"Start": "ua_0_7_105", "Halt": "ua_0_7_106"})
    );
    assert_eq!(skill["takes"], "(Force: Double, [Name: String])");
    let table = of(&component, &["skills", "--seconds", "1.5"]).quiet();
    let row = "gripper    Grasp  GraspSkillType  Ready  0    ua_0_7_105 (Force: Double, [Name:…";
    assert_eq!(table.lines().nth(1), Some(row), "{table}");
}

#[test]
fn a_skill_is_started_by_its_name_and_followed_to_its_result() {
    let component = GroupComponent::start();
    let ended = of(&component, &["call", "gripper.Grasp", "Force=12.5"]);
    assert_eq!(
        (ended.code, ended.stderr.as_str()),
        (0, ""),
        "{}",
        ended.stdout
    );
    let lines: Vec<&str> = ended.stdout.lines().collect();
    assert_eq!(lines[..3], ["success: true", "message: \"\"", "run: 1"]);
    let steps = &lines[3..];
    assert_eq!(
        steps[..2],
        ["  Running (ReadyToRunning)", "  50 %, Closing"]
    );
    for step in ["  Ready (RunningToReady)", "  succeeded", "  Gripped: true"] {
        assert!(steps.contains(&step), "{step} in {steps:?}");
    }
    assert_eq!(component.started(), 1, "however often it was repeated");
    let requestors = component.requestors();
    assert!(
        requestors.len() == 1 && requestors[0].starts_with("ua-space-"),
        "{requestors:?}"
    );
    let json = of(
        &component,
        &["call", "ua_0_7_105", "Force=1", "Name=x=y", "--json"],
    );
    let events: Vec<Value> = json.lines();
    assert_eq!((json.code, &events[0]["fields"]["run"]), (0, &json!(2)));
    let result = events
        .iter()
        .find(|event| event["event"] == "result")
        .unwrap();
    assert_eq!(result["results"], json!({"Gripped": true}));
}

#[test]
fn answers_count_only_from_the_sender_that_announced_the_call() {
    let component = GroupComponent::start_beside_a_forger();
    let ended = of(&component, &["call", "gripper.Grasp", "Force=12.5"]);
    assert_eq!(ended.code, 0, "{ended:?}");
    assert!(ended.stdout.contains("\nrun: 1\n"), "{}", ended.stdout);
    assert!(!ended.stdout.contains("4242"), "{}", ended.stdout);
    let told = "answers of other senders do not count";
    assert_eq!(ended.stderr.matches(told).count(), 1, "{}", ended.stderr);
}

#[test]
fn what_is_wrong_with_parameters_is_said_before_anything_moves() {
    let component = GroupComponent::start();
    let help = "this call takes Force: Double, [Name: String]";
    for (words, why) in [
        (&["call", "gripper.Grasp"][..], "Force is missing"),
        (
            &["call", "gripper.Grasp", "Force=much"],
            "Force: expected a Double, found `much`",
        ),
        (
            &["call", "gripper.Grasp", "Force=1", "Speed=2"],
            "there is no parameter `Speed`",
        ),
    ] {
        let ended = of(&component, words);
        assert_eq!((ended.code, ended.stdout.as_str()), (64, ""), "{ended:?}");
        assert!(
            ended.stderr.contains(why) && ended.stderr.contains(help),
            "{}",
            ended.stderr
        );
    }
    assert_eq!(component.started(), 0);
    let ended = of(&component, &["call", "gripper.Grasp", "Force=200"]);
    assert_eq!(ended.code, 1);
    assert!(
        ended
            .stderr
            .contains("BadInvalidArgument: Force 100 at most")
            && ended.stderr.contains(help),
        "{ended:?}"
    );
    let ended = of(&component, &["call", "gripper.Open", "--wait", "1"]);
    assert_eq!(ended.code, 69);
    assert!(
        ended
            .stderr
            .contains("there are ua_0_7_105 gripper.Grasp.Start, ua_0_7_106"),
        "{}",
        ended.stderr
    );
}

#[test]
fn ctrl_c_halts_the_run_and_says_how_it_ended() {
    let component = GroupComponent::start();
    let mut child = named("ua-space")
        .args(component.words(&["call", "gripper.Grasp", "Force=0"]))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut all = Vec::new();
    while !all.iter().any(|line: &String| line.contains("Running")) {
        all.push(lines.next().unwrap().unwrap());
    }
    let interrupted = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(interrupted.success());
    all.extend(lines.map(Result::unwrap));
    let code = child.wait().unwrap().code();
    let mut told = String::new();
    child
        .stderr
        .take()
        .unwrap()
        .read_to_string(&mut told)
        .unwrap();
    assert_eq!((code, component.halted()), (Some(1), 1), "{all:?} {told}");
    assert!(
        all.iter()
            .any(|line| line.contains("Halted (RunningToHalted)")),
        "{all:?}"
    );
    assert!(
        told.contains("calling Halt") && told.contains("run 1 did not succeed"),
        "{told}"
    );
}

#[test]
fn a_run_is_followed_although_announcements_are_lost() {
    let component = GroupComponent::start_losing(4);
    let mut child = named("ua-space")
        .args(component.words(&["call", "gripper.Grasp", "Force=0"]))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let running = lines.find(|line| line.as_ref().unwrap().contains("Running"));
    if running.is_some() {
        let id = child.id().to_string();
        let halted = Command::new("kill").args(["-INT", &id]).status();
        assert!(halted.unwrap().success());
    }
    let ended = child.wait_with_output().unwrap();
    let told = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(1), "{told}");
    assert!(told.contains("run 1 did not succeed"), "{told}");
}

#[test]
fn of_who_falls_silent_in_a_call_it_is_said_that_nobody_knows() {
    let component = GroupComponent::start();
    let words = component.words(&["call", "gripper.Grasp", "Force=0", "--json"]);
    let mut child = named("ua-space")
        .args(&words)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    while !lines.next().unwrap().unwrap().contains("Running") {}
    drop(component);
    let since = tokio::time::Instant::now();
    let ended = child.wait_with_output().unwrap();
    let told = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(69), "{told}");
    assert!(
        told.contains("nothing was heard of the component; how it ended is not known"),
        "{told}"
    );
    assert!(since.elapsed() < Duration::from_secs(9));
}

/// Serves each of the `answers` to one request. Returns the URL, and a thread that returns the
/// requests.
fn server(
    answers: Vec<(&'static str, &'static str)>,
) -> (String, std::thread::JoinHandle<Vec<String>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let thread = std::thread::spawn(move || {
        let mut heard = Vec::new();
        for (head, body) in answers {
            let (mut stream, _) = listener.accept().unwrap();
            let mut reader = BufReader::new(stream.try_clone().unwrap());
            let (mut request, mut accept, mut length) = (String::new(), String::new(), 0);
            loop {
                let mut line = String::new();
                reader.read_line(&mut line).unwrap();
                if let Some(value) = line.to_lowercase().strip_prefix("accept:") {
                    accept = value.trim().to_owned();
                }
                if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                if line.trim().is_empty() {
                    break;
                }
                if request.is_empty() {
                    request = line.trim().to_owned();
                }
            }
            let mut content = vec![0; length];
            reader.read_exact(&mut content).unwrap();
            let content = String::from_utf8(content).unwrap();
            heard.push(format!("{request}\n{accept}\n{content}"));
            let length = body.len();
            write!(
                stream,
                "HTTP/1.1 {head}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{body}"
            )
            .unwrap();
        }
        heard
    });
    (url, thread)
}

const JSON: &str = "200 OK\r\nContent-Type: application/json";
const QUESTIONS: &str = r#"{"questions":[{"name":"what-can-run","about":"What can do it","parameters":["capability"],"columns":["name"]}]}"#;

#[test]
fn a_question_is_asked_by_its_name_and_answered_as_a_table() {
    let rows = r#"{"question":"what-can-run","columns":["kind","name","parameters","endpoint"],
        "rows":[{"kind":"skill","name":"Grasp","parameters":["Force: Double","N: String"],"endpoint":null}]}"#;
    let (url, asked) = server(vec![(JSON, rows), (JSON, QUESTIONS), (JSON, rows)]);
    let table = run(&["ask", "what-can-run", "--url", &url]).quiet();
    let wanted = "KIND   NAME   PARAMETERS                ENDPOINT\nskill  Grasp  Force: Double, N: String  -\n";
    assert_eq!(table, wanted);
    let json = run(&[
        "ask",
        "what-can-run",
        "urn:example:a b",
        "--url",
        &url,
        "--json",
    ])
    .quiet();
    assert_eq!(object(&json)["rows"][0]["name"], "Grasp");
    let asked = asked.join().unwrap();
    assert_eq!(
        asked[0],
        "GET /ask/what-can-run HTTP/1.1\napplication/json\n"
    );
    assert_eq!(
        asked[2],
        "GET /ask/what-can-run?capability=urn%3Aexample%3Aa%20b HTTP/1.1\napplication/json\n"
    );
}

#[test]
fn a_query_is_sent_as_it_is_and_what_is_wrong_with_it_is_told() {
    let results = r#"{"head":{"vars":["s","n"]},"results":{"bindings":[{"s":{"type":"uri","value":"urn:x"}}]}}"#;
    let wrong = r#"{"error":"malformed","message":"expected } at line 1"}"#;
    let sparql = "200 OK\r\nContent-Type: application/sparql-results+json";
    let (url, asked) = server(vec![
        (sparql, results),
        ("400 Bad Request\r\nContent-Type: application/json", wrong),
        (
            "404 Not Found\r\nContent-Type: application/json",
            r#"{"error":"unknown","message":"there are what-can-run"}"#,
        ),
    ]);
    let query = "SELECT ?s ?n WHERE { ?s ?p ?n }";
    let table = run_on(&["ask", "--sparql", "-", "--url", &url], query.as_bytes()).quiet();
    assert_eq!(table, "S      N\nurn:x  -\n");
    let ended = run_on(&["ask", "--sparql", "-", "--url", &url], b"SELECT {");
    assert_eq!(ended.code, 65);
    assert!(
        ended.stderr.contains("malformed: expected } at line 1"),
        "{}",
        ended.stderr
    );
    let ended = run(&["ask", "who-are-you", "--url", &url]);
    assert_eq!(ended.code, 64);
    assert!(
        ended.stderr.contains("unknown: there are what-can-run"),
        "{}",
        ended.stderr
    );
    let asked = asked.join().unwrap();
    assert_eq!(
        asked[0],
        format!(
            "POST /sparql HTTP/1.1\napplication/sparql-results+json, application/n-triples\n{query}"
        )
    );
    let away = run(&["ask", "what-can-run", "--url", &url]);
    assert_eq!(away.code, 69);
    assert!(away.stderr.contains("no connection: "), "{}", away.stderr);
}

#[test]
fn delays_are_told_by_program_and_by_topic() {
    let component = GroupComponent::start();
    let hops = r#"{"program":"bridge-ros1","space":1,"topics":{},
        "hops":{"out":{"count":7,"negative":0,"p50_us":12.5,"p99_us":1500,"max_us":2000000},
                "in":{"count":0,"negative":0,"p50_us":0,"p99_us":0,"max_us":0}}}"#;
    let (url, asked) = server(vec![(JSON, hops)]);
    let table = of(&component, &["trace", "--seconds", "1", "--metrics", &url]).quiet();
    asked.join().unwrap();
    let rows: Vec<Vec<&str>> = table
        .lines()
        .map(|line| {
            line.split("  ")
                .map(str::trim)
                .filter(|cell| !cell.is_empty())
                .collect()
        })
        .collect();
    let has = |cells: &[&str]| rows.iter().any(|row| row.starts_with(cells));
    assert!(
        has(&[
            "bridge-ros1",
            "1",
            "out: into space",
            "12.5 us",
            "1.50 ms",
            "2.00 s",
            "7"
        ]),
        "{table}"
    );
    let has_hop = |cells: &[&str]| {
        let named = |row: &Vec<&str>| row.contains(&"gripper.Grasp.State");
        let mut of_it = rows.iter().filter(|row| named(row));
        of_it.any(|row| row.windows(cells.len()).any(|part| part == cells))
    };
    assert!(has_hop(&["origin", "1.00 ms"]), "{table}");
    assert!(has_hop(&["network"]), "{table}");
    let ended = run(&["trace", "--seconds", "0", "--metrics", &url]);
    assert_eq!(ended.code, 69);
}
