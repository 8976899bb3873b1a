//! A plant of two levels: a cell, two workstations, two devices each. Each level is a separate
//! network.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    CaptureFile, Cell, Child, Peer, PlantSite, Segment, StartedChild, eventually, http_answer,
    metrics, program,
};

use super::{MDNS, SOON, STATUS, list};

/// Network prefixes of the cell's level and of each workstation's level.
const BUS: &str = "10.80.0";
const INSIDE: [&str; 2] = ["10.81.0", "10.82.0"];

struct Plant {
    /// Keeps the network alive.
    _bus: Segment,
    /// For each workstation: the network, the station's host, and the hosts of its devices.
    stations: [(Segment, PlantSite, [PlantSite; 2]); 2],
    cell: PlantSite,
    /// Sockets that receive all mDNS traffic on the bus and in each workstation.
    ears: [(PlantSite, UdpSocket); 3],
}

fn plant(cell: &Cell) -> Plant {
    let bus = cell.segment();
    let top = cell.site();
    bus.plug(&top, "bus0", &format!("{BUS}.1"));
    let stations = [0, 1].map(|at| {
        let (inside, site) = (cell.segment(), cell.site());
        bus.plug(&site, "upper0", &format!("{BUS}.{}", 11 + at));
        inside.plug(&site, "lower0", &format!("{}.1", INSIDE[at]));
        let devices = [21, 22].map(|last| {
            let device = cell.site();
            inside.plug(&device, "dev0", &format!("{}.{last}", INSIDE[at]));
            device
        });
        (inside, site, devices)
    });
    let ear = |segment: &Segment, network: &str| {
        let site = cell.site();
        let address = format!("{network}.99");
        segment.plug(&site, "ear0", &address);
        let socket = site.within(|| {
            let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, MDNS.port())).unwrap();
            let address: Ipv4Addr = address.parse().unwrap();
            socket.join_multicast_v4(MDNS.ip(), &address).unwrap();
            socket
        });
        socket.set_nonblocking(true).unwrap();
        (site, socket)
    };
    let ears = [
        ear(&bus, BUS),
        ear(&stations[0].0, INSIDE[0]),
        ear(&stations[1].0, INSIDE[1]),
    ];
    Plant {
        _bus: bus,
        stations,
        cell: top,
        ears,
    }
}

fn top(plant: &Plant) -> Child {
    let endpoint = format!("opc.tcp://{BUS}.1:4840");
    let args = [
        "--name",
        "cell",
        "--place",
        "plant/cell-1",
        "--interface",
        "bus0",
    ];
    StartedChild::new("cell", &program("ua-station"))
        .args(args)
        .args([
            "--endpoint",
            &endpoint,
            "--allow-unsecured",
            "--metrics",
            STATUS,
        ])
        .at(&plant.cell)
        .start()
}

fn station(plant: &Plant, at: usize, more: &[&str]) -> Child {
    let name = ["station-a", "station-b"][at];
    let endpoint = format!("opc.tcp://{}.1:4840", INSIDE[at]);
    StartedChild::new(name, &program("ua-station"))
        .args([
            "--name",
            name,
            "--endpoint",
            &endpoint,
            "--interface",
            "lower0",
        ])
        .args(["--upper-interface", "upper0", "--allow-unsecured"])
        .args(["--metrics", STATUS])
        .args(more)
        .at(&plant.stations[at].1)
        .start()
}

/// Starts a `ua-component` gripper, which finds the discovery server of its level.
fn gripper(plant: &Plant, at: usize) -> Child {
    let example = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../examples/plant/parallel-gripper.yaml");
    let endpoint = format!("opc.tcp://{}.21:0", INSIDE[at]);
    StartedChild::new("ua-component", &program("ua-component"))
        .args([&example])
        .args([
            "--endpoint",
            &endpoint,
            "--lds",
            "any",
            "--interface",
            "dev0",
        ])
        .at(&plant.stations[at].2[0])
        .start()
}

/// Starts an asyncua device that is configured with the address of the discovery server.
fn device(cell: &Cell, plant: &Plant, at: usize) -> Child {
    let endpoint = format!("opc.tcp://{}.22:4850/", INSIDE[at]);
    let lds = format!("opc.tcp://{}.1:4840", INSIDE[at]);
    let name = ["adder-a", "adder-b"][at];
    let args = [&*endpoint, &lds, name, &format!("urn:asyncua:{name}")];
    cell.asyncua_started("opcua_device.py", &args)
        .at(&plant.stations[at].2[1])
        .start()
}

/// Returns the status of a station.
fn status(site: &PlantSite) -> Option<Value> {
    site.within(|| metrics(STATUS))
}

fn below(site: &PlantSite, name: &str) -> Option<Value> {
    shown(site, "below", name)
}

fn shown(site: &PlantSite, level: &str, name: &str) -> Option<Value> {
    let status = status(site)?;
    let peers = status["level"][level].as_array()?;
    let of = |one: &&Value| one["server"]["name"] == name;
    peers.iter().find(of).map(|one| one["server"].clone())
}

fn place(site: &PlantSite, name: &str) -> Option<String> {
    below(site, name)?["place"].as_str().map(str::to_owned)
}

/// Calls a method with asyncua from a site, and returns the answer.
fn call(cell: &Cell, site: &PlantSite, url: &str, path: &str, value: &str) -> Value {
    let args = [url, path, "--value", value];
    let mut asked = cell
        .asyncua_started("opcua_call.py", &args)
        .at(site)
        .start();
    assert!(asked.wait_for_end(SOON * 3).success());
    asked.json_lines().pop().unwrap()
}

/// Returns the addresses in the mDNS records that an ear received.
fn told(cell: &Cell, (_, ear): &(PlantSite, UdpSocket)) -> BTreeSet<String> {
    let mut packets = Vec::new();
    let mut buffer = [0; 9000];
    while let Ok(length) = ear.recv(&mut buffer) {
        packets.push(buffer[..length].to_vec());
    }
    assert!(!packets.is_empty());
    let lines = cell.fields(&CaptureFile::of(packets).to_port(MDNS.port()), &["dns.a"]);
    let addresses = lines.iter().flat_map(|line| line.split(','));
    addresses
        .filter(|address| !address.is_empty())
        .map(str::to_owned)
        .collect()
}

/// The configuration phase: from the top down, in order of arrival.
fn are_configured(plant: &Plant, adders: &mut [Child; 2]) {
    let [a, b] = [0, 1].map(|at| &plant.stations[at].1);
    for (at, site) in [a, b].into_iter().enumerate() {
        let name = ["station-a", "station-b"][at];
        let wanted = format!("plant/cell-1/{name}/parallel-gripper");
        eventually("the gripper is configured", SOON * 2, || {
            (place(site, "parallel-gripper")? == wanted).then_some(())
        });
        let adder = ["adder-a", "adder-b"][at];
        let wanted = format!("plant/cell-1/{name}/{adder}");
        let line = adders[at].wait_for_json("its place", SOON, |line| {
            (line["place"] == wanted).then(|| line.clone())
        });
        assert_eq!(
            line["discovery"],
            format!("opc.tcp://{}.1:4840", INSIDE[at])
        );
        let lines = eventually("it is registered above", SOON, || {
            let registered = status(&plant.cell)?["servers"].clone();
            let urls = registered
                .as_array()?
                .iter()
                .map(|one| one["urls"][0].clone());
            let urls: Vec<Value> = urls.collect();
            let wanted = format!("opc.tcp://{BUS}.{}:", 11 + at);
            let starts = |url: &Value| url.as_str().is_some_and(|url| url.starts_with(&wanted));
            urls.iter().any(starts).then_some(urls)
        });
        assert!(lines.iter().all(|url| url.as_str().unwrap().contains(BUS)));
    }
}

#[test]
fn a_device_calls_a_device_of_another_workstation_and_no_level_sees_another() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::Tshark]) else {
        return;
    };
    let plant = plant(&cell);
    let _top = top(&plant);
    let _stations = [0, 1].map(|at| station(&plant, at, &["--upper-lds", "uri=urn:*"]));
    let _grippers = [0, 1].map(|at| gripper(&plant, at));
    let mut adders = [0, 1].map(|at| device(&cell, &plant, at));
    are_configured(&plant, &mut adders);
    let [a, b] = [0, 1].map(|at| &plant.stations[at].1);
    eventually("each sees the other's devices", SOON, || {
        let seen = |site: &PlantSite, other| shown(site, "above", other)?["methods"].as_u64();
        let [on_a, on_b] = [seen(a, "station-b")?, seen(b, "station-a")?];
        (on_a > 10 && on_b > 10).then_some(())
    });
    // A device on A queries the discovery server of its level, finds B's server there, and calls
    // its method.
    let device_on_a = &plant.stations[0].2[1];
    let lds = format!("opc.tcp://{}.1:4840", INSIDE[0]);
    let found = cell.asyncua_started("opcua_discovery.py", &["find", &lds]);
    let mut found = found.at(device_on_a).start();
    assert!(found.wait_for_end(SOON * 3).success());
    let lines = found.json_lines();
    let other = list(&lines, "registered")
        .iter()
        .find(|one| one["name"] == "station-b");
    let other = other.unwrap_or_else(|| panic!("no station-b in {lines:?}"));
    assert!(
        other["gateway"]
            .as_str()
            .unwrap()
            .ends_with(":ua-station:station-a"),
        "{other}"
    );
    let said = json!(lines).to_string();
    assert!(!said.contains(BUS) && !said.contains(INSIDE[1]), "{said}");
    let url = other["urls"][0].as_str().unwrap();
    let path = "Neighbours/station-b/Devices/adder-b/device/Add";
    let sum = call(&cell, device_on_a, url, path, "[2.5, 4.0]");
    assert_eq!(
        sum,
        json!({"status": "Good", "arguments": [], "value": [6.5]})
    );
    let wrong = call(&cell, device_on_a, url, path, r#"[{"String": "x"}, 4.0]"#);
    assert_eq!(wrong["status"], "BadInvalidArgument", "{wrong}");
    // A method with arguments that are only meaningful at its own server is not passed on, and is
    // counted.
    assert_eq!(below(b, "adder-b").unwrap()["methods_kept_back"], 1);
    let networks = [BUS, INSIDE[0], INSIDE[1]];
    for (ear, network) in plant.ears.iter().zip(networks) {
        let addresses = told(&cell, ear);
        let of_it = |address: &String| address.starts_with(network);
        assert!(
            !addresses.is_empty() && addresses.iter().all(of_it),
            "{network}: {addresses:?}"
        );
    }
    // A killed device is reported lost at the level of its methods, and a restarted device returns.
    adders[1].signal(Signal::SIGKILL);
    let before = Instant::now();
    eventually("it is missed below", SOON, || {
        below(b, "adder-b").is_none().then_some(())
    });
    assert!(
        before.elapsed() < Duration::from_secs(3),
        "{:?}",
        before.elapsed()
    );
    eventually("and through both stations", SOON, || {
        let args = [url, path, "--wait", "0", "--value", "[1.0, 1.0]"];
        let mut asked = cell
            .asyncua_started("opcua_call.py", &args)
            .at(device_on_a)
            .start();
        assert!(asked.wait_for_end(SOON * 3).success());
        let answer = asked.json_lines().pop()?;
        (answer["status"] == "BadNodeIdUnknown" || answer.get("missing").is_some()).then_some(())
    });
}

/// The endpoint of the first workstation for calls from the upper level.
const UPPER: &str = "opc.tcp://10.80.0.11:4870";

/// Starts an asyncua client that calls a method and keeps its session until it is ordered to leave.
fn holding(cell: &Cell, site: &PlantSite, path: &str, value: &str) -> Child {
    let args = [UPPER, path, "--value", value, "--hold", "--patience", "20"];
    let client = cell.asyncua_started("opcua_call.py", &args);
    client.at(site).told().start()
}

fn answer(client: &mut Child) -> Value {
    client.wait_for_json("the answer", SOON * 3, |line| {
        line.get("status").map(|_| line.clone())
    })
}

/// Returns whether the discovery server of a level lists the server with this URI.
fn listed(site: &PlantSite, uri: &str) -> bool {
    let status = status(site);
    let servers = status
        .as_ref()
        .and_then(|status| status["servers"].as_array());
    servers.is_some_and(|servers| servers.iter().any(|one| one["uri"] == uri))
}

#[test]
fn a_device_that_serves_one_request_at_a_time_is_called_for_long_and_keeps_its_place_meanwhile() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let plant = plant(&cell);
    let _station = station(&plant, 0, &["--upper-endpoint", UPPER]);
    let mut adder = device(&cell, &plant, 0);
    let (site, uri) = (&plant.stations[0].1, "urn:asyncua:adder-a");
    eventually("its methods are shown", SOON * 2, || {
        (below(site, "adder-a")?["state"] == "connected").then_some(())
    });
    let path = "Devices/adder-a/device/Hold";
    let mut caller = holding(&cell, &plant.cell, path, "[7.0]");
    adder.wait_for_json("it holds", SOON, |line| line.get("holds").map(|_| ()));
    eventually("it has held", SOON, || {
        assert!(listed(site, uri), "it is listed while it is called");
        assert_ne!(below(site, "adder-a").unwrap()["state"], "away");
        let lines = adder.json_lines();
        lines
            .iter()
            .any(|line| line.get("held").is_some())
            .then_some(())
    });
    let held = json!({"status": "Good", "arguments": [], "value": [7.0]});
    assert_eq!(answer(&mut caller), held);
    // A StatusCode arrives as the device sent it: BadOutOfMemory besides an invalid argument, and
    // Uncertain.
    for (code, name) in [
        (0x8003_0000_u32, "BadOutOfMemory"),
        (0x4000_0000, "Uncertain"),
    ] {
        let path = "Devices/adder-a/device/Judge";
        let judged = call(&cell, &plant.cell, UPPER, path, &format!("[{code}]"));
        let arguments = json!(["BadOutOfRange"]);
        assert_eq!(
            judged,
            json!({"status": name, "arguments": arguments, "value": [1.5]})
        );
        let args = [UPPER, path, &format!("[{code}]")];
        let other = cell.node_opcua_started("call.js", &args);
        let mut other = other.at(&plant.cell).start();
        assert!(other.wait_for_end(SOON * 3).success(), "{other}");
        let told = other.json_lines().pop().unwrap();
        assert_eq!(told, json!({"status": name, "value": [1.5]}));
    }
    // Another device of the level calls the method directly.
    let url = format!("opc.tcp://{}.22:4850/", INSIDE[0]);
    let args = [&*url, "device/Hold", "--value", "[7.0]", "--patience", "20"];
    let direct = cell.asyncua_started("opcua_call.py", &args);
    let mut direct = direct.at(&plant.stations[0].2[0]).start();
    let before = below(site, "adder-a").unwrap()["methods"].clone();
    while direct.json_lines().len() < 2 {
        assert!(direct.runs() && listed(site, uri), "{direct}");
        std::thread::yield_now();
    }
    assert_eq!(below(site, "adder-a").unwrap()["methods"], before);
    // The loss of a host is detected during a call.
    let mut caller = holding(&cell, &plant.cell, path, "[30.0]");
    eventually("it holds again", SOON, || {
        let lines = adder.json_lines();
        lines.iter().any(|line| line["holds"] == 30.0).then_some(())
    });
    plant.stations[0].2[1].within(|| {
        let down = std::process::Command::new("ip")
            .args(["link", "set", "dev0", "down"])
            .status();
        assert!(down.unwrap().success());
    });
    let before = Instant::now();
    assert_eq!(answer(&mut caller)["status"], "BadRequestInterrupted");
    let took = before.elapsed();
    assert!(took < Duration::from_millis(2_500), "{took:?}");
}

#[test]
fn a_lock_through_a_station_is_of_its_caller_and_ends_with_the_callers_session() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let plant = plant(&cell);
    let _station = station(&plant, 0, &["--upper-endpoint", UPPER]);
    let _gripper = gripper(&plant, 0);
    let gripper = "Devices/parallel-gripper/parallel-gripper";
    let lock = format!("{gripper}/Lock/InitLock");
    let mut first = holding(&cell, &plant.cell, &lock, r#"["first"]"#);
    assert_eq!(answer(&mut first)["value"], json!([0]));
    let second = || call(&cell, &plant.cell, UPPER, &lock, r#"["second"]"#);
    assert_eq!(second()["value"], json!([-1]), "it is locked");
    let exit = format!("{gripper}/Lock/ExitLock");
    let exit = call(&cell, &plant.cell, UPPER, &exit, "[]");
    assert_eq!(exit["value"], json!([-1]), "the lock is of another");
    first.tell("leave");
    assert!(first.wait_for_end(SOON).success());
    eventually("the lock is free", SOON, || {
        (second()["value"] == json!([0])).then_some(())
    });
}

#[test]
fn only_the_supervisor_configures_a_component_and_a_station() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let plant = plant(&cell);
    let _top = top(&plant);
    let more = ["--upper-lds", "uri=urn:*", "--upper-endpoint", UPPER];
    let _station = station(&plant, 0, &more);
    let _gripper = gripper(&plant, 0);
    let site = &plant.stations[0].1;
    let wanted = "plant/cell-1/station-a/parallel-gripper";
    eventually("the gripper is configured", SOON * 3, || {
        (place(site, "parallel-gripper")? == wanted).then_some(())
    });
    let elsewhere = r#"["elsewhere", "urn:x", "opc.tcp://10.9.9.9:4840"]"#;
    let moved = call(&cell, &plant.cell, UPPER, "station-a/Configure", elsewhere);
    assert_eq!(moved["status"], "BadUserAccessDenied", "{moved}");
    let url = status(site).unwrap()["level"]["below"][0]["url"].clone();
    let device = &plant.stations[0].2[1];
    let path = "parallel-gripper/Configure";
    let moved = call(&cell, device, url.as_str().unwrap(), path, elsewhere);
    assert_eq!(moved["status"], "BadUserAccessDenied", "{moved}");
    let shown = status(site).unwrap()["level"]["place"].clone();
    assert_eq!(shown, "plant/cell-1/station-a");
}

/// Adds a certificate or a revocation list to the trust list of a store.
fn trust(cell: &Cell, store: &str, what: &str) {
    let told = std::process::Command::new(program("ua-server"))
        .args(["trust", what, "--pki"])
        .arg(cell.folder().join(store))
        .output()
        .unwrap();
    assert!(told.status.success(), "{told:?}");
}

/// Creates the user otto, an operator, in a store.
fn operator(cell: &Cell, store: &str) {
    let password = cell.file("password", &format!("{PASSWORD}\n"));
    let made = std::process::Command::new(program("ua-server"))
        .args(["user", "add", "otto", "--role", "operator", "--pki"])
        .arg(cell.folder().join(store))
        .stdin(std::fs::File::open(password).unwrap())
        .output()
        .unwrap();
    assert!(made.status.success(), "{made:?}");
}

const PASSWORD: &str = "correct horse battery";

/// Starts a `ua-component` gripper with secured channels only and a separate store.
fn secured_gripper(cell: &Cell, site: &PlantSite) -> Child {
    let example = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../examples/plant/parallel-gripper.yaml");
    let text = std::fs::read_to_string(example).unwrap();
    assert!(text.contains("security: [None]"), "{text}");
    let text = text.replace("security: [None]", "security: [Basic256Sha256]");
    let file = cell.file("parallel-gripper.yaml", &text);
    let endpoint = format!("opc.tcp://{}.21:0", INSIDE[0]);
    StartedChild::new("ua-component", &program("ua-component"))
        .args([&file])
        .args(["--endpoint", &endpoint, "--lds", "any"])
        .args(["--interface", "dev0", "--pki"])
        .args([&cell.folder().join("gripper-pki")])
        .at(site)
        .start()
}

/// A workstation with secured channels only, and hosts above and below it.
struct Guarded {
    _networks: [Segment; 2],
    station: PlantSite,
    above: PlantSite,
    devices: [PlantSite; 2],
    supervisor: Child,
    /// The folder with the key pairs of devices; most are issued by a trusted authority.
    pairs: String,
    /// The endpoint for calls from the upper level.
    top: String,
}

fn guarded(cell: &Cell) -> Guarded {
    let (bus, inside) = (cell.segment(), cell.segment());
    let [station, above, first, second] = [(); 4].map(|()| cell.site());
    bus.plug(&above, "bus0", &format!("{BUS}.1"));
    bus.plug(&station, "upper0", &format!("{BUS}.11"));
    inside.plug(&station, "lower0", &format!("{}.1", INSIDE[0]));
    inside.plug(&first, "dev0", &format!("{}.21", INSIDE[0]));
    inside.plug(&second, "dev0", &format!("{}.22", INSIDE[0]));
    let pairs = cell.folder().join("pairs").to_str().unwrap().to_owned();
    let host = format!("{}.22", INSIDE[0]);
    let _made = cell.asyncua_once("opcua_access.py", &["servers", &pairs, "--host", &host]);
    for file in ["plant.der", "plant.crl"] {
        trust(cell, "station-pki", &format!("{pairs}/{file}"));
    }
    let lds = format!("opc.tcp://{}.1:4840", INSIDE[0]);
    let top = format!("opc.tcp://{BUS}.11:4870");
    let supervisor = StartedChild::new("station-a", &program("ua-station"))
        .args(["--name", "station-a", "--place", "plant/cell-1"])
        .args(["--endpoint", &lds, "--interface", "lower0"])
        .args(["--upper-interface", "upper0", "--upper-endpoint", &top])
        .args(["--metrics", STATUS, "--pki"])
        .args([&cell.folder().join("station-pki")])
        .at(&station)
        .start();
    eventually("the station answers", SOON, || status(&station));
    Guarded {
        _networks: [bus, inside],
        station,
        above,
        devices: [first, second],
        supervisor,
        pairs,
        top,
    }
}

impl Guarded {
    /// Starts an asyncua device with a key pair, which registers with the same or another pair.
    fn device(&self, cell: &Cell, name: &str, uri: &str, (pair, registers): (&str, &str)) -> Child {
        let port = 4850 + name.len();
        let endpoint = format!("opc.tcp://{}.22:{port}/", INSIDE[0]);
        let lds = format!("opc.tcp://{}.1:4840", INSIDE[0]);
        let named = [&*endpoint, &lds, name, uri];
        let with = ["--pairs", &self.pairs, "--pair", pair];
        let device = cell.asyncua_started("opcua_device.py", &[named, with].concat());
        let device = device.args(["--registers-with", registers]);
        device.at(&self.devices[1]).start()
    }
}

#[test]
fn over_secured_channels_a_device_is_configured_and_called_and_one_that_is_not_trusted_is_told_of()
{
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut plant = guarded(&cell);
    let uri = "urn:ua-bridge:system-tests:plc";
    // An asyncua device with a certificate issued by the authority.
    let mut adder = plant.device(&cell, "adder", uri, ("sound", "sound"));
    let told = adder.wait_for_json("its place", SOON * 3, |line| {
        line["place"].is_string().then(|| line.clone())
    });
    assert_eq!(told["place"], "plant/cell-1/adder");
    let shown = below(&plant.station, "adder").unwrap();
    assert_eq!(shown["secured"], true, "{shown}");
    // Its method is called from the upper level over a secured channel. A trusted certificate does
    // not grant a role.
    let path = "Devices/adder/device/Add";
    let args = [&*plant.top, path, "--value", "[2.5, 4.0]"];
    let secured = [
        "--security",
        "Basic256Sha256",
        "--certificates",
        &plant.pairs,
    ];
    let called = |user: &[&str]| {
        let args = [&args[..], &secured, user].concat();
        let called = cell.asyncua_started("opcua_call.py", &args);
        let mut called = called.at(&plant.above).start();
        let ended = called.wait_for_end(SOON * 3);
        ended.success().then(|| called.json_lines().pop().unwrap())
    };
    assert_eq!(called(&[]).unwrap()["status"], "BadUserAccessDenied");
    operator(&cell, "station-pki");
    let sum = eventually("the operator is known", SOON, || {
        let sum = called(&["--user", "otto", "--password", PASSWORD])?;
        (sum["status"] == "Good").then_some(sum)
    });
    assert_eq!(
        sum,
        json!({"status": "Good", "arguments": [], "value": [6.5]})
    );
    // A device that registers with a trusted certificate and presents another certificate.
    let another = format!("{uri}:another");
    let mut stranger = plant.device(&cell, "stranger", &another, ("stranger", "impostor"));
    let refused = eventually("the stranger is refused", SOON * 3, || {
        let shown = below(&plant.station, "stranger")?;
        (shown["state"] == "refused").then_some(shown)
    });
    let why = refused["fault"].as_str().unwrap();
    assert!(why.contains("BadCertificateChainIncomplete"), "{why}");
    assert!(refused["certificates_refused"].as_u64() > Some(0));
    assert!(refused.get("place").is_none(), "{refused}");
    let line = "BadCertificateChainIncomplete";
    plant.supervisor.wait_for_line(line, SOON);
    let lines = stranger.json_lines();
    assert!(lines.iter().all(|line| line.get("place").is_none()));
    // Without the adder every server of the level is refused.
    let ready = || plant.station.within(|| http_answer(STATUS, "/readyz"));
    assert_eq!(ready().unwrap().0, 200, "the adder is connected");
    drop(adder);
    let reason = eventually("the station is not ready", SOON * 3, || {
        let (code, reason) = ready()?;
        (code == 503).then_some(reason)
    });
    let expected = "no server of the level below is connected; refused: 1, the first stranger";
    assert!(reason.contains(expected), "{reason}");
    let shown = status(&plant.station).unwrap();
    assert_eq!(shown["program"], "ua-station", "{shown}");
    // The command suggested by the station solves the problem.
    let (_, command) = why.rsplit_once("`ua-server trust ").unwrap();
    let (digits, _) = command.split_once(' ').unwrap();
    trust(&cell, "station-pki", digits);
    stranger.wait_for_json("its place", SOON * 3, |line| {
        (line["place"] == "plant/cell-1/stranger").then_some(())
    });
    eventually("the station is ready", SOON, || {
        (ready()?.0 == 200).then_some(())
    });
}

#[test]
fn a_component_of_ours_is_configured_over_secured_channels_once_each_trusts_the_other() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let plant = guarded(&cell);
    let [station, own] = ["station-pki", "gripper-pki"].map(|store| {
        let file = cell.folder().join(store).join("own/cert.der");
        file.to_str().unwrap().to_owned()
    });
    trust(&cell, "gripper-pki", &station);
    let _gripper = secured_gripper(&cell, &plant.devices[0]);
    eventually("the gripper has a certificate", SOON, || {
        std::path::Path::new(&own).exists().then_some(())
    });
    trust(&cell, "station-pki", &own);
    eventually("the gripper is configured", SOON * 4, || {
        let shown = below(&plant.station, "parallel-gripper")?;
        let place = "plant/cell-1/parallel-gripper";
        (shown["secured"] == true && shown["place"] == place).then_some(())
    });
}
