//! A discovery server inside another program, where no `ua-lds` runs.

use std::path::PathBuf;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

use super::{Greeter, LDS, SOON, lds, list, told, who};

const GRIPPER: &str = "urn:example:gripper";
const ROBOT: &str = "urn:example:robot";
const QUIET: &str = "urn:who:quiet";
const TAKES_OVER: &str = "no discovery server runs: this program is the discovery server now";

fn component(yaml: &str) -> Child {
    let example = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/plant");
    StartedChild::new(yaml, &program("ua-component"))
        .args([example.join(yaml)])
        .args(["--interface", "lo", "--lds", "embed"])
        .start()
}

/// Starts a server that only registers at the port of the discovery server.
fn quiet() -> Child {
    who(&["announce", "quiet", "--lds", LDS])
}

fn uris(lines: &[Value]) -> Vec<String> {
    let all = list(lines, "registered").iter();
    all.filter_map(|server| server["uri"].as_str().map(str::to_owned))
        .collect()
}

/// Polls with asyncua until these are all registered servers except the discovery server itself.
/// Returns the lines of that poll.
fn listed(cell: &Cell, what: &str, deadline: Duration, wanted: &[&str]) -> Vec<Value> {
    eventually(what, deadline, || {
        let lines = cell.asyncua_try("opcua_discovery.py", &["find", LDS])?;
        // A discovery server with more connections than it keeps closes one: the client asks again.
        lines.iter().find(|line| line["registered"].is_array())?;
        let uris = uris(&lines);
        let all = wanted.iter().all(|uri| uris.iter().any(|one| one == uri));
        (all && uris.len() == wanted.len() + 1).then_some(lines)
    })
}

/// Returns the name of the discovery server.
fn called(lines: &[Value]) -> String {
    let all = list(lines, "registered").iter();
    let mut itself = all.filter(|server| {
        server["uri"]
            .as_str()
            .is_some_and(|uri| uri.ends_with(":ua-lds"))
    });
    itself.next().unwrap()["name"].as_str().unwrap().to_owned()
}

fn embeds(child: &Child) -> bool {
    child.lines().iter().any(|line| line.contains(TAKES_OVER))
}

#[test]
fn the_first_component_of_a_host_is_its_discovery_server_and_the_next_one_when_it_is_killed() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let mut watch = who(&["watch"]);
    let mut first = component("parallel-gripper.yaml");
    first.wait_for_line(TAKES_OVER, SOON);
    let lines = listed(&cell, "the first is listed", SOON, &[GRIPPER]);
    assert_eq!(
        called(&lines),
        "UA bridge discovery server in parallel-gripper"
    );
    let seen = told(&mut watch, "seen", "ua-lds");
    assert_eq!(seen["url"], format!("{LDS}/"));
    told(&mut watch, "seen", "parallel-gripper");
    // The discovery server hears announcements no earlier than other programs do.
    eventually("another client finds both announcements", SOON, || {
        let theirs = cell.node_opcua_once("find.js", &[LDS]);
        assert!(uris(&theirs).iter().any(|uri| uri == GRIPPER), "{theirs:?}");
        let announced = list(&theirs, "network").iter();
        let announced: Vec<&Value> = announced.map(|one| &one["capabilities"]).collect();
        let both = announced.contains(&&json!(["LDS"])) && announced.contains(&&json!(["DA"]));
        both.then_some(())
    });
    let restarted = first.lines();
    let restarted = restarted.iter().find(|line| line.contains("restarted"));
    assert_eq!(
        restarted, None,
        "what it says of its start twice is one run"
    );
    let second = component("robot.yaml");
    let _quiet = quiet();
    listed(&cell, "all register there", SOON, &[GRIPPER, ROBOT, QUIET]);
    assert!(!embeds(&second), "one is enough: {second}");
    let mut second = second;
    first.signal(Signal::SIGKILL);
    // The promised time is a second or two; the rest is for a loaded machine. The start of asyncua
    // takes seconds on such a machine and is not included.
    let promised = Duration::from_secs(5);
    second.wait_for_line(TAKES_OVER, promised);
    second.wait_for_line(&format!("registered uri=\"{QUIET}\""), promised);
    let lines = listed(
        &cell,
        "the remaining servers are listed",
        SOON,
        &[ROBOT, QUIET],
    );
    assert_eq!(called(&lines), "UA bridge discovery server in robot");
    second.end();
    for name in ["ua-lds", "robot"] {
        eventually(&format!("{name} says goodbye"), SOON, || {
            let lines = watch.json_lines();
            let of_it = |line: &&Value| {
                let its = line["name"].as_str().is_some_and(|it| it.starts_with(name));
                its && line["loss"] == "goodbye"
            };
            lines.iter().find(of_it).map(drop)
        });
    }
    let _lds = lds(&[]);
    listed(&cell, "its port is free by then", SOON, &[QUIET]);
}

#[test]
fn nobody_embeds_a_discovery_server_beside_one_and_it_says_who_does() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let standalone = lds(&[]);
    let gripper = component("parallel-gripper.yaml");
    let robot = component("robot.yaml");
    let lines = listed(&cell, "both register", SOON, &[GRIPPER, ROBOT]);
    assert_eq!(called(&lines), "UA bridge discovery server");
    assert!(!embeds(&gripper) && !embeds(&robot), "{gripper} {robot}");
    standalone.signal(Signal::SIGKILL);
    eventually("one of them is it", SOON, || {
        (embeds(&gripper) || embeds(&robot)).then_some(())
    });
    let lines = listed(&cell, "both are listed", SOON, &[GRIPPER, ROBOT]);
    assert!(embeds(&gripper) != embeds(&robot), "{gripper} {robot}");
    let name = called(&lines);
    let mut late = StartedChild::new("ua-lds", &program("ua-lds")).start();
    let why = late.wait_for_line("cannot listen at", SOON);
    assert!(why.contains(&name) && why.contains("--endpoint"), "{why}");
    assert_eq!(late.wait_for_end(SOON).code(), Some(69));
}

#[test]
fn many_servers_that_may_embed_agree_on_one() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // More connections than the discovery server keeps from a single address.
    let many = who(&[
        "announce",
        "many",
        "--count",
        "100",
        "--lds",
        "embed",
        "--no-mdns",
    ]);
    let names: Vec<String> = (0..100).map(|at| format!("urn:who:many-{at}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    listed(&cell, "all are listed", SOON, &names);
    let lines = many.lines();
    let embedding = lines.iter().filter(|line| line.contains(TAKES_OVER));
    assert_eq!(embedding.count(), 1, "{many}");
}

#[test]
fn an_embedded_discovery_server_takes_registrations_over_secured_channels_of_whom_the_program_trusts()
 {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut server = cell.ua_server(&["--endpoint", "opc.tcp://127.0.0.1:4841", "--lds", "embed"]);
    server.wait_for_line(TAKES_OVER, SOON);
    let greeter = Greeter::start();
    let client = cell.folder().join("client");
    let itself = "urn:ua-bridge:system-tests:client";
    let register = || {
        let fixed = ["--security", "Basic256Sha256", "--certificates"];
        let who = ["register", LDS, "--url", greeter.url(), "--uri", itself];
        let all = [&who[..], &fixed, &[client.to_str().unwrap()]].concat();
        cell.asyncua_once("opcua_discovery.py", &all).remove(0)["status"].clone()
    };
    assert_ne!(register(), "Good");
    let refused = server.wait_for_line("whose certificate is not trusted", SOON);
    let trusted = cell.folder().join("pki/trusted");
    assert!(refused.contains(trusted.to_str().unwrap()), "{refused}");
    std::fs::copy(
        client.join("client_certificate.der"),
        trusted.join("client.der"),
    )
    .unwrap();
    assert_eq!(register(), "Good");
    let lines = cell.asyncua_once("opcua_discovery.py", &["find", LDS]);
    assert!(uris(&lines).iter().any(|uri| uri == itself), "{lines:?}");
    server.end();
    let mut server = cell.ua_server(&["--endpoint", LDS, "--lds", "embed"]);
    server.wait_for_line("the server itself listens at", SOON);
}
