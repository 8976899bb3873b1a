//! Duties of a discovery server towards registering servers (OPC 10000-4, 5.5 and OPC 10000-12, 4),
//! in both directions.

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, eventually, metrics, number};

use super::{Greeter, LDS, SOON, STATUS, announced, lds, list, on_network, registered, who};

const NODE: &str = "opc.tcp://127.0.0.1:4843";
const CLIENT_URI: &str = "urn:ua-bridge:system-tests:client";

/// Registers with asyncua once and returns the answer.
fn register(cell: &Cell, args: &[&str]) -> Value {
    let all = [&["register", LDS][..], args].concat();
    cell.asyncua_once("opcua_discovery.py", &all).remove(0)
}

fn listener() -> (Greeter, String) {
    let greeter = Greeter::start();
    let url = greeter.url().to_owned();
    (greeter, url)
}

#[test]
fn each_fault_of_a_registration_has_its_status_and_bounds_are_kept() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&[]);
    let (_listener, url) = listener();
    let many: Vec<String> = (0..17).map(|port| format!("{url}/{port}")).collect();
    let many: Vec<&str> = many.iter().flat_map(|url| ["--url", url]).collect();
    let long = format!("{url}/{}", "x".repeat(1024));
    let codes = vec!["--capability=DA"; 33];
    let file = cell.file("installed", "");
    let file = file.to_str().unwrap();
    let fine = ["--url", &url];
    for (what, args, status) in [
        ("too many URLs", many, "BadInvalidArgument"),
        (
            "a URL that is too long",
            vec!["--url", &long],
            "BadInvalidArgument",
        ),
        (
            "a URL of two lines",
            vec!["--url", "opc.tcp://h:1/\nx"],
            "BadInvalidArgument",
        ),
        (
            "too many capabilities",
            [&fine[..], &["--mdns", "x"], &codes].concat(),
            "BadInvalidArgument",
        ),
        (
            "a client",
            [&fine[..], &["--type", "Client"]].concat(),
            "BadInvalidArgument",
        ),
        (
            "no semaphore file",
            [&fine[..], &["--semaphore", "/nowhere/at/all"]].concat(),
            "BadSemaphoreFileMissing",
        ),
        (
            "a semaphore file",
            [&fine[..], &["--semaphore", file]].concat(),
            "Good",
        ),
    ] {
        let answer = register(&cell, &args);
        // asyncua spells a name as in an earlier version of the standard's tables.
        let told = answer["status"]
            .as_str()
            .unwrap()
            .replace("Sempahore", "Semaphore");
        assert_eq!(told, status, "{what}: {answer}");
    }
    assert!(registered("urn:asyncua:arm").is_some());
    std::fs::remove_file(file).unwrap();
    eventually("it is uninstalled", SOON, || {
        registered("urn:asyncua:arm").is_none().then_some(())
    });
    let losses = metrics(STATUS).unwrap()["losses"].clone();
    assert_eq!(losses[0]["loss"], "semaphore_gone", "{losses}");
}

#[test]
fn a_registration_that_is_not_repeated_runs_out_after_two_periods() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&["--register-period", "2"]);
    let (_listener, url) = listener();
    let _repeats = announced("gripper", &["--register-period", "1"]);
    assert_eq!(register(&cell, &["--url", &url])["status"], "Good");
    assert!(registered("urn:asyncua:arm").is_some());
    eventually("asyncua is forgotten", SOON, || {
        registered("urn:asyncua:arm").is_none().then_some(())
    });
    let losses = metrics(STATUS).unwrap()["losses"].clone();
    assert_eq!(losses[0]["loss"], "expired", "{losses}");
    assert!(
        registered("urn:who:gripper").is_some(),
        "it repeats its own"
    );
}

#[test]
fn records_on_the_network_rise_and_are_found_by_all_their_capabilities_in_any_case() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&[]);
    let (_arm, arm) = listener();
    let (_leg, leg) = listener();
    let named = |name: &str, url: &str, codes: &[&str]| {
        let uri = format!("urn:asyncua:{name}");
        let codes: Vec<String> = codes
            .iter()
            .map(|code| format!("--capability={code}"))
            .collect();
        let mut args = vec!["--url", url, "--mdns", name, "--uri", &uri];
        args.extend(codes.iter().map(String::as_str));
        assert_eq!(register(&cell, &args)["status"], "Good");
    };
    named("arm", &arm, &["DA", "AC"]);
    named("leg", &leg, &["DA", "HD"]);
    let find = |args: &[&str]| {
        let all = [&["find", LDS][..], args].concat();
        let lines = cell.asyncua_once("opcua_discovery.py", &all);
        let network = list(&lines, "network").iter();
        let found = network.filter(|one| one["capabilities"] != json!(["LDS"]));
        let names = found.map(|one| (one["name"].as_str().unwrap().to_owned(), number(one, "id")));
        names.collect::<Vec<_>>()
    };
    let all = find(&[]);
    assert_eq!(all.len(), 2, "{all:?}");
    assert!(all[0].1 < all[1].1, "they rise: {all:?}");
    let of =
        |found: Vec<(String, u64)>| found.into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(of(find(&["--capability=da", "--capability=hd"])), ["leg"]);
    assert!(find(&["--capability=DA", "--capability=LDS"]).is_empty());
    let second = all[1].1.to_string();
    assert_eq!(of(find(&["--start", &second])), ["leg"], "from that on");
    // Another address makes another record, and no record number is repeated.
    let (_moved, moved) = listener();
    named("arm", &moved, &["DA", "AC"]);
    let again = find(&[]);
    assert_eq!(again[1].0, "arm");
    assert!(again[1].1 > all[1].1, "{again:?} after {all:?}");
}

#[test]
fn only_a_secured_channel_registers_where_that_is_asked_and_nobody_changes_what_it_did() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let [ours, theirs] = ["lds-pki", "client"].map(|name| cell.folder().join(name));
    let [ours, theirs] = [ours.to_str().unwrap(), theirs.to_str().unwrap()];
    let (_listener, url) = listener();
    let itself = ["--url", &url, "--uri", CLIENT_URI];
    let secured = ["--security", "Basic256Sha256", "--certificates", theirs];
    let secured = [&itself[..], &secured].concat();
    let trusting = ["--pki", ours, "--trust-any-client-certificate"];
    let strict = lds(&[&trusting[..], &["--secured-only"]].concat());
    let open = register(&cell, &itself);
    assert_eq!(open["status"], "BadSecurityModeInsufficient");
    assert_eq!(register(&cell, &secured)["status"], "Good");
    drop(strict);
    let _lenient = lds(&trusting);
    assert_eq!(register(&cell, &secured)["status"], "Good");
    for more in [&[][..], &["--offline"]] {
        let open = register(&cell, &[&itself[..], more].concat());
        assert_eq!(open["status"], "BadSecurityModeInsufficient", "{more:?}");
    }
    assert!(registered(CLIENT_URI).is_some());
    let leaves = [&secured[..], &["--offline"]].concat();
    assert_eq!(register(&cell, &leaves)["status"], "Good");
    assert_eq!(registered(CLIENT_URI), None);
}

#[test]
fn a_server_of_node_opcua_registers_over_a_secured_channel_and_takes_that_back() {
    let Some(cell) = Cell::with(&[Peer::NodeOpcua]) else {
        return;
    };
    let pki = cell.folder().join("lds-pki");
    let _lds = lds(&["--pki", pki.to_str().unwrap(), "--secured-only"]);
    let trusted = pki.join("trusted/node.der");
    let args = ["4842", LDS, trusted.to_str().unwrap()];
    let mut node = cell.node_opcua("registers.js", &args);
    let uri = node.wait_for_json("who it is", SOON, |line| {
        line["uri"].as_str().map(str::to_owned)
    });
    let found = eventually("it is registered", SOON * 3, || registered(&uri));
    assert!(
        found["urls"][0].as_str().unwrap().ends_with(":4842"),
        "{found}"
    );
    node.wait_for_line("serverRegistered", SOON);
    node.signal(Signal::SIGTERM);
    node.wait_for_end(SOON * 2);
    assert_eq!(registered(&uri), None, "it said so before it ended");
    let losses = metrics(STATUS).unwrap()["losses"].clone();
    assert_eq!(losses[0]["loss"], "unregistered", "{losses}");
}

#[test]
fn ours_registers_with_node_opcua_over_a_secured_channel_once_that_is_trusted() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _lds = lds(&[]);
    let pki = store(&cell);
    let mut node = cell.node_opcua_started("lds.js", &["4843"]).start();
    node.wait_for_line("ready", SOON * 3);
    let mut gripper = who(&[
        "announce",
        "gripper",
        "--lds",
        NODE,
        "--no-mdns",
        "--uri",
        CLIENT_URI,
        "--pki",
        pki.to_str().unwrap(),
    ]);
    gripper.wait_for_line("cannot register at the discovery server: refused", SOON);
    let rejected = std::fs::read_dir(pki.join("rejected")).unwrap();
    let rejected = rejected
        .map(|file| file.unwrap().path())
        .collect::<Vec<_>>();
    assert_eq!(
        rejected.len(),
        1,
        "what it was not trusted by: {rejected:?}"
    );
    std::fs::rename(&rejected[0], pki.join("trusted/node.der")).unwrap();
    is_listed(&mut node, true);
    gripper.end();
    is_listed(&mut node, false);
}

/// Makes a certificate store with a key pair.
fn store(cell: &Cell) -> std::path::PathBuf {
    let made = cell.folder().join("client");
    let secured = ["--security", "Basic256Sha256", "--certificates"];
    // The script creates its pair before it finds that there is no such channel.
    let all = [&["find", LDS][..], &secured, &[made.to_str().unwrap()]].concat();
    drop(cell.asyncua_try("opcua_discovery.py", &all));
    let pki = cell.folder().join("gripper-pki");
    for folder in ["own", "private", "trusted", "rejected"] {
        std::fs::create_dir_all(pki.join(folder)).unwrap();
    }
    for (from, to) in [
        ("client_certificate.der", "own/cert.der"),
        ("client_key.pem", "private/private.pem"),
    ] {
        std::fs::copy(made.join(from), pki.join(to)).unwrap();
    }
    pki
}

/// Waits until node-opcua lists our server, or does not list it.
fn is_listed(node: &mut Child, wanted: bool) {
    let what = format!("node-opcua lists the gripper: {wanted}");
    node.wait_for_json(&what, SOON * 2, |line| {
        let uris = line["registered"].as_array()?;
        (uris.contains(&json!(CLIENT_URI)) == wanted).then_some(())
    });
}

#[test]
fn where_the_newer_service_is_not_known_the_older_one_is_asked() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _old = cell.asyncua("opcua_old_lds.py", &["opc.tcp://127.0.0.1:4844"]);
    let old = "opc.tcp://127.0.0.1:4844";
    let mut gripper = who(&["announce", "gripper", "--lds", old]);
    gripper.wait_for_line("registered", SOON);
    let lines = cell.asyncua_once("opcua_discovery.py", &["find-servers", old]);
    let uris: Vec<&Value> = list(&lines, "registered")
        .iter()
        .map(|one| &one["uri"])
        .collect();
    assert!(uris.contains(&&json!("urn:who:gripper")), "{uris:?}");
    assert_eq!(
        on_network("gripper"),
        None,
        "there is no other discovery server"
    );
}
