//! Discovery: `ua-lds` and servers that announce themselves, checked with third-party clients and
//! packets.

mod clock;
mod embedded;
mod enrolment;
mod faults;
mod gds;
mod levels;
mod listed;
mod presence;
mod rules;
mod space;
mod through;

use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    CaptureFile, Cell, Child, HERE, Peer, StartedChild, THERE, WIRE, WireEffect, eventually,
    group_member, metrics, number, program, resident,
};

const LDS: &str = "opc.tcp://127.0.0.1:4840";
const STATUS: &str = "127.0.0.1:9104";
/// Timeout of events without a promised time: each poll of a Python peer starts an interpreter,
/// which takes seconds on a loaded machine.
const SOON: Duration = Duration::from_secs(30);
const MDNS: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(224, 0, 0, 251), 5353);

fn lds(args: &[&str]) -> Child {
    let lds = StartedChild::new("ua-lds", &program("ua-lds"));
    let child = lds.args(["--metrics", STATUS]).args(args).start();
    eventually("ua-lds answers", SOON, || metrics(STATUS));
    child
}

/// Starts the example `who` and waits until it is ready.
fn who(args: &[&str]) -> Child {
    who_started(args).start().ready(SOON)
}

fn who_started(args: &[&str]) -> StartedChild {
    StartedChild::new("who", &program("examples/who")).args(args)
}

/// A listener that accepts connections but serves no client.
struct Greeter {
    url: String,
    end: Arc<AtomicBool>,
    at: SocketAddr,
}

impl Greeter {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap();
        let end = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&end);
        std::thread::spawn(move || {
            for client in listener.incoming() {
                if ends.load(Ordering::Relaxed) {
                    return;
                }
                drop(client);
            }
        });
        let url = format!("opc.tcp://{at}");
        Self { url, end, at }
    }

    fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for Greeter {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        // Wakes the listener so that it checks `end`.
        drop(TcpStream::connect(self.at));
    }
}

fn announced(name: &str, args: &[&str]) -> Child {
    who(&[&["announce", name, "--lds", LDS], args].concat())
}

/// Waits until the watcher reports this event of that server, and returns the line.
fn told(watch: &mut Child, found: &str, name: &str) -> Value {
    watch.wait_for_json(&format!("{name} {found}"), SOON, |line| {
        let of_it = line["name"].as_str()?.starts_with(name) && line["found"] == found;
        of_it.then(|| line.clone())
    })
}

/// Returns the milliseconds from an instant of this process to a line of another process.
fn after(since: Duration, line: &Value) -> u64 {
    let at = Duration::from_millis(line["at_ms"].as_u64().unwrap());
    u64::try_from(at.saturating_sub(since).as_millis()).unwrap()
}

fn now() -> Duration {
    std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .unwrap()
}

fn list<'a>(lines: &'a [Value], key: &str) -> &'a Vec<Value> {
    lines
        .iter()
        .find_map(|line| line[key].as_array())
        .unwrap_or_else(|| panic!("no {key} in {lines:?}"))
}

fn registered(uri: &str) -> Option<Value> {
    let status = metrics(STATUS)?;
    let servers = status["servers"].as_array()?;
    servers.iter().find(|server| server["uri"] == uri).cloned()
}

fn on_network(name: &str) -> Option<Value> {
    let status = metrics(STATUS)?;
    let network = status["network"].as_array()?;
    let starts = |record: &&Value| {
        record["name"]
            .as_str()
            .is_some_and(|its| its.starts_with(name))
    };
    network.iter().find(starts).cloned()
}

#[test]
fn clients_of_other_makers_list_who_is_registered_and_who_is_announced() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _lds = lds(&[]);
    let _gripper = announced("gripper", &["--path", "/gripper"]);
    eventually("the gripper is registered and announced", SOON, || {
        registered("urn:who:gripper").and_then(|_| on_network("gripper"))
    });
    for (maker, lines) in [
        (
            "asyncua",
            cell.asyncua_once("opcua_discovery.py", &["find", LDS]),
        ),
        ("node-opcua", cell.node_opcua_once("find.js", &[LDS])),
    ] {
        let uris: Vec<&Value> = list(&lines, "registered")
            .iter()
            .map(|server| &server["uri"])
            .collect();
        assert!(
            uris.contains(&&json!("urn:who:gripper")) && uris.len() == 2,
            "{maker}: {uris:?}"
        );
        let network = list(&lines, "network");
        let gripper = network.iter().find(|one| {
            one["url"]
                .as_str()
                .is_some_and(|url| url.ends_with("/gripper"))
        });
        assert_eq!(gripper.unwrap()["capabilities"], json!(["DA"]), "{maker}");
        assert!(
            network
                .iter()
                .any(|one| one["capabilities"] == json!(["LDS"])),
            "{maker}: itself"
        );
    }
    let refused = cell
        .asyncua_once("opcua_discovery.py", &["session", LDS])
        .remove(0);
    assert_eq!(
        refused["status"], "BadServiceUnsupported",
        "there are no sessions"
    );
}

#[test]
fn asyncua_registers_is_announced_and_gone_at_once_when_it_takes_that_back() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&[]);
    let mut watch = who(&["watch"]);
    let greeter = Greeter::start();
    let url = format!("{}/arm", greeter.url());
    let register = |args: &[&str]| {
        let all = [&["register", LDS, "--url", &url][..], args].concat();
        cell.asyncua_once("opcua_discovery.py", &all).remove(0)
    };
    assert_eq!(
        register(&["--mdns", "py-arm"]),
        json!({"status": "Good", "results": ["Good"]})
    );
    assert_eq!(registered("urn:asyncua:arm").unwrap()["urls"], json!([url]));
    assert_eq!(
        on_network("py-arm").unwrap()["capabilities"],
        json!(["DA", "AC"])
    );
    assert_eq!(
        told(&mut watch, "seen", "py-arm")["url"],
        url,
        "announced on its behalf"
    );
    register(&["--mdns", "py-arm", "--offline"]);
    assert_eq!(
        registered("urn:asyncua:arm").or_else(|| on_network("py-arm")),
        None
    );
    told(&mut watch, "gone", "py-arm");
    // The error codes of OPC 10000-4, 5.5.5.
    assert_eq!(register(&["--old"])["status"], "Good");
    assert_eq!(
        register(&["--old", "--name", ""])["status"],
        "BadServerNameMissing"
    );
    assert_eq!(
        register(&["--old", "--uri", ""])["status"],
        "BadServerUriInvalid"
    );
    let none = cell
        .asyncua_once("opcua_discovery.py", &["register", LDS])
        .remove(0);
    assert_eq!(none["status"], "BadDiscoveryUrlMissing");
}

#[test]
fn a_secured_channel_is_for_whom_it_trusts_who_registers_only_itself() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let [ours, theirs] = ["lds-pki", "client"].map(|name| cell.folder().join(name));
    let [ours, theirs] = [ours.to_str().unwrap(), theirs.to_str().unwrap()];
    let greeter = Greeter::start();
    let url = greeter.url().to_owned();
    let register = |uri: &str| {
        let secured = ["--security", "Basic256Sha256", "--certificates", theirs];
        let all = [
            &["register", LDS, "--url", &url, "--uri", uri][..],
            &secured,
        ]
        .concat();
        cell.asyncua_once("opcua_discovery.py", &all).remove(0)["status"].clone()
    };
    let itself = "urn:ua-bridge:system-tests:client";
    let mut strict = lds(&["--pki", ours]);
    assert_ne!(register(itself), "Good");
    let refused = strict.wait_for_line("rejected a client", SOON);
    let told = ["BadCertificateUntrusted", "`ua-server trust", "lds-pki"];
    assert!(told.iter().all(|one| refused.contains(one)), "{refused}");
    let counters = metrics(STATUS).unwrap()["counters"].clone();
    assert_eq!(number(&counters, "certificates_refused_total"), 1);
    assert_eq!(
        number(&metrics(STATUS).unwrap()["counters"], "questions_total"),
        1,
        "its GetEndpoints alone"
    );
    let certificate = cell.folder().join("client/client_certificate.der");
    std::fs::copy(
        certificate,
        cell.folder().join("lds-pki/trusted/client.der"),
    )
    .unwrap();
    assert_eq!(register(itself), "Good");
    assert!(registered(itself).is_some());
    assert_eq!(register("urn:asyncua:another"), "BadServerUriInvalid");
}

#[test]
fn who_registers_is_known_by_its_authority_until_its_certificate_is_revoked() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let [ours, issued] = ["lds-pki", "issued"].map(|name| cell.folder().join(name));
    let _made = cell.asyncua_once("opcua_access.py", &["issued", issued.to_str().unwrap()]);
    let greeter = Greeter::start();
    let register = |name: &str| {
        // The script uses the pair with this name.
        let theirs = cell.folder().join(name);
        std::fs::create_dir_all(&theirs).unwrap();
        for file in ["certificate.der", "key.pem"] {
            let (from, to) = (format!("{name}_{file}"), format!("client_{file}"));
            std::fs::copy(issued.join(from), theirs.join(to)).unwrap();
        }
        let secured = ["--security", "Basic256Sha256", "--certificates"];
        let own = ["--uri", "urn:ua-bridge:system-tests:client"];
        let what = ["register", LDS, "--url", greeter.url()];
        let all = [&what[..], &own, &secured, &[theirs.to_str().unwrap()]].concat();
        cell.asyncua_once("opcua_discovery.py", &all).remove(0)["status"].clone()
    };
    let trust = |file: &str| {
        let told = std::process::Command::new(program("ua-server"))
            .arg("trust")
            .args([&issued.join(file)])
            .arg("--pki")
            .arg(&ours)
            .output()
            .unwrap();
        assert!(told.status.success(), "{told:?}");
    };
    let mut strict = lds(&["--pki", ours.to_str().unwrap()]);
    trust("plant.der");
    assert_eq!(register("client"), "BadCertificateRevocationUnknown");
    strict.wait_for_line("ua-server trust FILE.crl", SOON);
    trust("plant.crl");
    assert_eq!(register("client"), "Good");
    assert!(registered("urn:ua-bridge:system-tests:client").is_some());
    assert_eq!(register("gone"), "BadCertificateRevoked");
    // A stranger does not learn which of the checks failed.
    assert_eq!(register("stranger"), "BadSecurityChecksFailed");
    trust("plant-now.crl");
    assert_eq!(register("client"), "BadCertificateRevoked");
    let counters = metrics(STATUS).unwrap()["counters"].clone();
    assert_eq!(number(&counters, "certificates_refused_total"), 4);
}

#[test]
fn a_killed_server_is_missed_in_two_seconds_and_one_that_leaves_at_once() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let _lds = lds(&[]);
    let mut watch = who(&["watch"]);
    let killed = announced("gripper", &[]);
    let mut leaves = announced("robot", &[]);
    told(&mut watch, "seen", "gripper");
    told(&mut watch, "seen", "robot");
    eventually("both are registered", SOON, || {
        registered("urn:who:gripper").and_then(|_| registered("urn:who:robot"))
    });
    let before = now();
    killed.signal(Signal::SIGKILL);
    let gone = told(&mut watch, "gone", "gripper");
    assert_eq!(gone["loss"], "unreachable");
    assert!(after(before, &gone) < 2500, "{gone}, killed at {before:?}");
    eventually("the discovery server misses it", SOON, || {
        (registered("urn:who:gripper").is_none() && on_network("gripper").is_none()).then_some(())
    });
    let losses = metrics(STATUS).unwrap()["losses"].clone();
    let lost = losses
        .as_array()
        .unwrap()
        .iter()
        .find(|loss| loss["name"] == "urn:who:gripper")
        .unwrap()
        .clone();
    assert_eq!(lost["loss"], "unreachable");
    let before = now();
    leaves.end();
    assert_eq!(
        registered("urn:who:robot"),
        None,
        "it said so before it ended"
    );
    let gone = told(&mut watch, "gone", "robot");
    assert_eq!(gone["loss"], "goodbye");
    assert!(after(before, &gone) < 500, "{gone}, ended at {before:?}");
}

#[test]
fn a_discovery_server_that_starts_last_or_anew_learns_of_everybody() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let mut gripper = announced("gripper", &[]);
    gripper.wait_for_line("not registered at the discovery server yet", SOON);
    let mut quiet = announced("quiet", &["--no-mdns"]);
    quiet.wait_for_line("not registered at the discovery server yet", SOON);
    let all = || {
        registered("urn:who:gripper")
            .and_then(|_| registered("urn:who:quiet"))
            .and_then(|_| on_network("gripper"))
            .and_then(|_| on_network("quiet"))
    };
    let first = lds(&[]);
    eventually("it knows all", SOON, all);
    first.signal(Signal::SIGKILL);
    eventually("it is gone", SOON, || {
        metrics(STATUS).is_none().then_some(())
    });
    drop(first);
    let _second = lds(&[]);
    eventually(
        "who announces itself is back",
        Duration::from_secs(3),
        || registered("urn:who:gripper").and_then(|_| on_network("gripper")),
    );
}

#[test]
fn node_opcuas_discovery_server_and_ours_see_what_the_other_announces() {
    let Some(cell) = Cell::with(&[Peer::NodeOpcua]) else {
        return;
    };
    let host = cell.host(WireEffect::default());
    let _lds = lds(&["--interface", WIRE]);
    let mut node = cell
        .node_opcua_started("lds.js", &["4841"])
        .on(&host)
        .start();
    node.wait_for_line("ready", Duration::from_secs(30));
    let seen = eventually("theirs is seen", SOON, || {
        let status = metrics(STATUS)?;
        let network = status["network"].as_array()?.clone();
        network
            .into_iter()
            .find(|record| record["url"] == format!("opc.tcp://{THERE}:4841/DiscoveryServer"))
    });
    assert_eq!(seen["capabilities"], json!(["LDS"]));
    node.wait_for_json(
        "node-opcua answers itself",
        Duration::from_secs(30),
        |line| line.get("network").map(drop),
    );
    let before = Instant::now();
    let _gripper = who(&["announce", "gripper", "--address", HERE]);
    node.wait_for_json("the gripper is seen by node-opcua", SOON, |line| {
        let network = line["network"].as_array()?;
        let gripper = |one: &&Value| {
            one["name"]
                .as_str()
                .is_some_and(|name| name.starts_with("gripper"))
        };
        network.iter().find(gripper).map(drop)
    });
    assert!(before.elapsed() < Duration::from_secs(2));
}

#[test]
fn the_cells_server_is_found_and_shows_who_is_there() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&[]);
    let endpoint = "opc.tcp://127.0.0.1:4841/";
    let mut server = cell.ua_server(&["--endpoint", endpoint, "--lds", LDS, "--announce"]);
    let found = eventually("the server is found", SOON, || on_network("ua-server"));
    assert_eq!(found["url"], endpoint);
    let uri = eventually("it is registered", SOON, || {
        let status = metrics(STATUS)?;
        status["servers"][0]["uri"].as_str().map(str::to_owned)
    });
    let gripper = announced("gripper", &[]);
    server.wait_for_line("discovered a server", SOON);
    // Both programs discover for themselves.
    let gripper_there = eventually("its discovery server sees it", SOON, || {
        on_network("gripper")
    });
    let name = gripper_there["name"].as_str().unwrap();
    let node = format!("ns=1;s=UaSpace.Components.{name}");
    let [url, online] = ["Url", "Online"].map(|property| format!("{node}.{property}"));
    let read = || cell.asyncua_once("opcua_read.py", &[endpoint, &url, &online]);
    let shown = read();
    assert!(
        shown[0]["value"]
            .as_str()
            .is_some_and(|url| url.starts_with("opc.tcp://127.0.0.1:")),
        "{shown:?}"
    );
    assert_eq!(shown[1]["value"], true);
    gripper.signal(Signal::SIGKILL);
    server.wait_for_line("lost a server", SOON);
    assert_eq!(read()[1]["value"], false);
    server.end();
    assert_eq!(registered(&uri), None, "it said so before it ended");
}

#[test]
fn tshark_reads_the_announcement_and_the_goodbye() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let socket = group_member(MDNS);
    socket
        .set_read_timeout(Some(Duration::from_millis(100)))
        .unwrap();
    let mut gripper = who(&["announce", "gripper", "--path", "/arm"]);
    gripper.end();
    let mut packets = Vec::new();
    let mut buffer = [0; 9000];
    while let Ok(length) = socket.recv(&mut buffer) {
        packets.push(buffer[..length].to_vec());
    }
    let fields = [
        "dns.resp.name",
        "dns.resp.ttl",
        "dns.txt",
        "dns.ptr.domain_name",
        "dns.srv.port",
        "dns.a",
    ];
    let lines = cell.fields(&CaptureFile::of(packets).to_port(MDNS.port()), &fields);
    let announcement = lines
        .iter()
        .find(|line| line.contains("path=/arm") && line.contains("4500"));
    let announcement = announcement.unwrap_or_else(|| panic!("no announcement in {lines:#?}"));
    for part in [
        "_opcua-tcp._tcp.local",
        "gripper-",
        "caps=DA",
        "start=",
        "127.0.0.1",
    ] {
        assert!(announcement.contains(part), "{part} in {announcement}");
    }
    let goodbye = lines.iter().find(|line| {
        line.contains("gripper-")
            && line
                .split('\t')
                .nth(1)
                .is_some_and(|ttl| ttl.starts_with("0,0"))
    });
    assert!(goodbye.is_some(), "no goodbye in {lines:#?}");
}

/// Invalid greetings, channels and messages.
fn malformed() -> Vec<Vec<u8>> {
    let hello = {
        let url = b"opc.tcp://127.0.0.1:4840";
        let numbers = [0_u32, 65_536, 65_536, 0, 0, 24];
        let body: Vec<u8> = numbers
            .iter()
            .flat_map(|number| number.to_le_bytes())
            .chain(*url)
            .collect();
        let size = u32::try_from(body.len() + 8).unwrap();
        [b"HELF".to_vec(), size.to_le_bytes().to_vec(), body].concat()
    };
    let after = |bytes: &[u8]| [hello.clone(), bytes.to_vec()].concat();
    let policy = b"http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256";
    let secured = [
        &b"OPNF"[..],
        &300_u32.to_le_bytes(),
        &[0; 4],
        &57_u32.to_le_bytes(),
        policy,
        &[0xff; 4],
        &[0x41; 300],
    ]
    .concat();
    vec![
        b"GET / HTTP/1.1\r\n\r\n".to_vec(),
        b"HELF\xff\xff\xff\xff".to_vec(),
        b"HELF\x00\x00\x00\x00".to_vec(),
        hello[..20].to_vec(),
        after(&hello),
        after(b"OPNF\x10\x00\x00\x00\xff\xff\xff\xff\xff\xff\xff\x7f"),
        after(&secured[..300]),
        after(b"MSGF\x18\0\0\0\x01\0\0\0\x01\0\0\0\x01\0\0\0\x01\0\0\0"),
        after(b"MSGC\xff\xff\x00\x00"),
        after(b"CLOF\x0c\0\0\0\x01\0\0\0"),
    ]
}

#[test]
fn malformed_packets_disturb_nobody_beside_them() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let server = lds(&[]);
    let mut watch = who(&["watch"]);
    let _gripper = announced("gripper", &[]);
    told(&mut watch, "seen", "gripper");
    let before = resident(server.id());
    let mdns = group_member(MDNS);
    mdns.set_multicast_loop_v4(true).unwrap();
    let template = announcement();
    let mut open = Vec::new();
    for round in 0..20 {
        for bytes in malformed() {
            let mut stream = TcpStream::connect("127.0.0.1:4840").unwrap();
            // The server may close the connection before all is sent.
            drop(stream.write_all(&bytes));
            // Half of the connections stay open and send nothing more.
            match round % 2 {
                0 => open.push(stream),
                _ => {
                    stream.set_read_timeout(Some(SOON)).unwrap();
                    drop(stream.shutdown(std::net::Shutdown::Write));
                    // Whether the server closes the connection or reports an error, the read ends.
                    drop(stream.read_to_end(&mut Vec::new()));
                }
            }
        }
        for cut in 0..template.len() {
            let mut packet = template.clone();
            packet[cut] ^= 1 << (round % 8);
            mdns.send_to(&packet, MDNS).unwrap();
            mdns.send_to(&template[..cut], MDNS).unwrap();
        }
    }
    let lines = cell.asyncua_once("opcua_discovery.py", &["find", LDS]);
    assert!(
        list(&lines, "network")
            .iter()
            .any(|one| one["name"].as_str().unwrap().starts_with("gripper-"))
    );
    let status = metrics(STATUS).unwrap();
    assert!(number(&status, "malformed_total") >= 60, "{status}");
    for process in [&server, &watch] {
        assert!(
            process
                .lines()
                .iter()
                .all(|line| !line.contains("panicked")),
            "{process}"
        );
    }
    let more = resident(server.id()).saturating_sub(before);
    assert!(more < 32 << 20, "{more} bytes more than before");
    assert!(watch.runs());
}

/// Returns an mDNS response for a single server: PTR, SRV, TXT and A.
fn announcement() -> Vec<u8> {
    let name = |labels: &[&str]| -> Vec<u8> {
        let label =
            |label: &&str| [&[u8::try_from(label.len()).unwrap()], label.as_bytes()].concat();
        labels.iter().flat_map(label).chain([0]).collect()
    };
    let service = ["_opcua-tcp", "_tcp", "local"];
    let instance = [&["forged"][..], &service].concat();
    let record = |owner: &[u8], kind: u16, data: &[u8]| {
        let length = u16::try_from(data.len()).unwrap();
        [
            owner,
            &kind.to_be_bytes(),
            &[0x80, 1, 0, 0, 0, 120],
            &length.to_be_bytes(),
            data,
        ]
        .concat()
    };
    let host = name(&["forged-host", "local"]);
    let place = [&[0, 0, 0, 0, 0x13, 0x88][..], &host].concat();
    [
        vec![0, 0, 0x84, 0, 0, 0, 0, 4, 0, 0, 0, 0],
        record(&name(&service), 12, &name(&instance)),
        record(&name(&instance), 33, &place),
        record(&name(&instance), 16, b"\x06path=/\x07caps=DA"),
        record(&host, 1, &[127, 0, 0, 1]),
    ]
    .concat()
}
