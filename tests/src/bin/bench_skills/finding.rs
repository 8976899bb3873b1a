//! `cargo xtask bench skills finding`: the time until a new server is discovered, the time until
//! its method is called from another workstation, and the cost of many servers.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

use discovery::client::{find_servers, find_servers_on_network};
use discovery::{
    AnnounceSettings, MdnsInterface, ServerAnnouncement, ServerChange, ServerDescription,
    ServerWatcher, WatchSettings, announce, be_there, watch,
};
use plant_opcua::client::{Browse, ClientConfig, OpcUaClient};
use plant_opcua::types::{NodeId, ObjectId};
use system_tests::{
    Cell, Child, HERE, Peer, PlantSite, Segment, StartedChild, Times, WIRE, WireEffect, cpu_share,
    eventually, group_member, program, resident,
};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

/// Runs all measurements; stops with the reason if a peer is missing.
pub(crate) fn all(runs: usize, servers: usize) -> Option<()> {
    seen(runs)?;
    called(runs)?;
    many(servers)
}

fn runtime() -> Runtime {
    // The runtime's threads are in the network of this thread.
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap()
}

/// Announces a server that has no other function.
async fn plugged(name: &str, at: Ipv4Addr, lds: Option<&str>) -> ServerAnnouncement {
    let listener = TcpListener::bind((at, 0)).await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let server = ServerDescription {
        application_uri: format!("urn:bench:{name}"),
        product_uri: String::new(),
        name: name.to_owned(),
        url: format!("opc.tcp://{at}:{port}/"),
        capabilities: vec!["DA".to_owned()],
        number: None,
    };
    let settings = AnnounceSettings {
        lds: lds.map(str::to_owned),
        mdns: lds.is_none().then(|| MdnsInterface::parse(&at.to_string())),
        ..AnnounceSettings::default()
    };
    let announced = announce(server.clone(), settings).unwrap();
    tokio::spawn(async move { be_there(listener, &server).await });
    announced
}

/// Measures from the announcement of a server to its discovery by watchers.
fn seen(runs: usize) -> Option<()> {
    let cell = Cell::with(&[Peer::NodeOpcua])?;
    let host = cell.host(WireEffect::default());
    let _lds = lds(&["--interface", WIRE]);
    let mut other = cell
        .node_opcua_started("lds.js", &["4841", "5"])
        .on(&host)
        .start();
    other.wait_for_json("node-opcua answers itself", SOON, |line| {
        line.get("network").map(drop)
    });
    let here: Ipv4Addr = HERE.parse().unwrap();
    println!(
        "\n{runs} servers, one after the other; milliseconds since each was told to announce itself:\n"
    );
    println!("| who hears of it | median | worst |\n|---|---|---|");
    let runtime = runtime();
    let [mut ours, mut listed, mut theirs] = [(); 3].map(|()| Times::default());
    runtime.block_on(async {
        let settings = WatchSettings {
            mdns: Some(MdnsInterface::parse(HERE)),
            ..WatchSettings::default()
        };
        let mut watcher = watch(settings).unwrap();
        for run in 0..runs {
            let name = format!("watched-{run}");
            let began = Instant::now();
            let announced = plugged(&name, here, None).await;
            until_seen(&mut watcher, &name).await;
            ours.add(began.elapsed());
            announced.leave().await;
            let name = format!("listed-{run}");
            let began = Instant::now();
            let announced = plugged(&name, here, None).await;
            until_listed(LDS, &name).await;
            listed.add(began.elapsed());
            announced.leave().await;
            let name = format!("theirs-{run}");
            let began = since_1970();
            let announced = plugged(&name, here, None).await;
            let at = tokio::task::block_in_place(|| listed_by(&mut other, &name));
            theirs.add(at.saturating_sub(began));
            announced.leave().await;
        }
    });
    for (who, times) in [
        ("a watcher of ours", &mut ours),
        ("who asks `ua-lds`: FindServersOnNetwork", &mut listed),
        (
            "who asks the discovery server of node-opcua, each 5 ms",
            &mut theirs,
        ),
    ] {
        row(who, times);
    }
    Some(())
}

fn row(what: &str, times: &mut Times) {
    println!(
        "| {what} | {:.0} | {:.0} |",
        times.at(0.5) / 1e3,
        times.at(1.0) / 1e3
    );
}

async fn until_seen(watcher: &mut ServerWatcher, name: &str) {
    let seen = async {
        while let Some(found) = watcher.next().await {
            if matches!(&found, ServerChange::Seen(known) if known.name.starts_with(name)) {
                return;
            }
        }
    };
    tokio::time::timeout(SOON, seen).await.unwrap();
}

/// Returns the time at which node-opcua listed the server, in milliseconds.
fn listed_by(other: &mut Child, name: &str) -> Duration {
    other.wait_for_json(&format!("{name} is listed"), SOON, |line| {
        let mut network = line["network"].as_array()?.iter();
        let is_it = |one: &serde_json::Value| {
            one["name"]
                .as_str()
                .is_some_and(|its| its.starts_with(name))
        };
        network.any(is_it).then_some(())?;
        line["at_ms"].as_u64().map(Duration::from_millis)
    })
}

fn since_1970() -> Duration {
    let now = std::time::SystemTime::now();
    now.duration_since(std::time::UNIX_EPOCH).unwrap()
}

async fn until_listed(url: &str, name: &str) {
    let end = Instant::now() + SOON;
    loop {
        let listed = find_servers_on_network(url, SOON).await;
        if let Ok(listed) = &listed
            && listed.iter().any(|one| one.name.starts_with(name))
        {
            return;
        }
        assert!(Instant::now() < end, "{name} is not listed: {listed:?}");
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Measures from the start of a component to the answer of its method, called at another
/// workstation.
fn called(runs: usize) -> Option<()> {
    let cell = Cell::with(&[Peer::NodeOpcua])?;
    let bus = cell.segment();
    let top = cell.site();
    bus.plug(&top, "bus0", "10.80.0.1");
    let levels = [1, 2].map(|at| Level::new(&cell, &bus, at));
    let _top = station(&top, "cell", "10.80.0.1", &["--interface", "bus0"]);
    let _stations = [1, 2].map(|at| {
        let (level, name) = (&levels[at - 1], format!("station-{at}"));
        let args = ["--interface", "lower0", "--upper-interface", "upper0"];
        let address = format!("10.80.{at}.1");
        station(
            &level.station,
            &name,
            &address,
            &[&args[..], &["--upper-lds", "uri=urn:*"]].concat(),
        )
    });
    let [first, second] = &levels;
    let url = "opc.tcp://10.80.1.1:4840".to_owned();
    let mut times = Times::default();
    let mut known = None;
    // The first run finds the location of the method.
    for _ in 0..=runs {
        let began = Instant::now();
        let component = second.component();
        let path = first.device.within(|| answered(&url, known.as_deref()));
        if known.replace(path).is_some() {
            times.add(began.elapsed());
        }
        drop(component);
        first.device.within(|| gone(&url));
    }
    let path = serde_json::to_string(&known.unwrap_or_default()).unwrap();
    let mut by_other = other_client(&cell, first, (&url, &path), || second.component(), runs);
    println!(
        "\n{runs} starts of a component; milliseconds to the answer to Reset of its skill, called at another workstation:\n"
    );
    println!("| way | median | worst |\n|---|---|---|");
    row(
        "component -> station -> cell -> station -> client",
        &mut times,
    );
    row("the same to a client of node-opcua", &mut by_other);
    Some(())
}

/// Measures the same with a client of node-opcua that runs all the time.
fn other_client(
    cell: &Cell,
    at: &Level,
    (lds, path): (&str, &str),
    start: impl Fn() -> Child,
    runs: usize,
) -> Times {
    let other = cell.node_opcua_started("across.js", &[lds, DEVICE[1]]);
    let mut other = other.told().at(&at.device).start().ready(SOON);
    let mut times = Times::default();
    for run in 1..=runs {
        let began = since_1970();
        let component = start();
        other.tell(path);
        let answered = eventually("node-opcua is answered", SOON, || {
            let answers = other.json_lines();
            let mut answers = answers
                .iter()
                .filter_map(|line| line["answered_ms"].as_u64());
            answers.nth(run - 1).map(Duration::from_millis)
        });
        times.add(answered.saturating_sub(began));
        drop(component);
        at.device.within(|| gone(lds));
    }
    times
}

/// A workstation with two devices.
struct Level {
    _inside: Segment,
    station: PlantSite,
    device: PlantSite,
    at: usize,
}

impl Level {
    fn new(cell: &Cell, bus: &Segment, at: usize) -> Self {
        let (inside, station, device) = (cell.segment(), cell.site(), cell.site());
        bus.plug(&station, "upper0", &format!("10.80.0.{}", 10 + at));
        inside.plug(&station, "lower0", &format!("10.80.{at}.1"));
        inside.plug(&device, "dev0", &format!("10.80.{at}.21"));
        Self {
            _inside: inside,
            station,
            device,
            at,
        }
    }

    fn component(&self) -> Child {
        let example = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../examples/plant/parallel-gripper.yaml");
        let endpoint = format!("opc.tcp://10.80.{}.21:0", self.at);
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
            .at(&self.device)
            .start()
    }
}

fn station(at: &PlantSite, name: &str, address: &str, more: &[&str]) -> Child {
    let endpoint = format!("opc.tcp://{address}:4840");
    StartedChild::new(name, &program("ua-station"))
        .args(["--name", name, "--endpoint", &endpoint, "--allow-unsecured"])
        .args(more)
        .at(at)
        .start()
}

/// Runs a client of the other workstation in the network of this thread.
fn asking<T>(url: &str, what: impl AsyncFnOnce(&OpcUaClient) -> T) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let config = ClientConfig {
            timeout: SOON,
            ..ClientConfig::new("urn:ua-bridge:bench:client", "bench")
        };
        let client = OpcUaClient::open(config, &neighbour(url).await);
        client.up(SOON).await.unwrap();
        let told = what(&client).await;
        client.close().await;
        told
    })
}

/// Returns the URL of the other workstation from the discovery server of this workstation.
async fn neighbour(lds: &str) -> String {
    let end = Instant::now() + SOON;
    loop {
        let listed = find_servers(lds, SOON).await;
        let mut found = listed.iter().flatten();
        if let Some(other) = found.find(|one| one.name == DEVICE[1])
            && let Some(url) = other.discovery_urls.first()
        {
            return url.clone();
        }
        assert!(Instant::now() < end, "no neighbour: {listed:?}");
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Calls the method until it answers, and returns the names of its path.
fn answered(url: &str, known: Option<&[String]>) -> Vec<String> {
    asking(url, async |client| {
        let end = Instant::now() + SOON;
        loop {
            let path = match known {
                Some(path) => Some(path.to_vec()),
                None => search(client).await,
            };
            if let Some(path) = path
                && let Some(nodes) = nodes(client, &path).await
                && let [.., object, method] = &*nodes
            {
                let called = client.call(object, method, Vec::new()).await;
                if called.is_ok() {
                    return path;
                }
            }
            assert!(Instant::now() < end, "the method does not answer");
            tokio::time::sleep(LOOK_EVERY).await;
        }
    })
}

/// Waits until the loss of the component is detected: a workstation without methods is not listed.
fn gone(lds: &str) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let is_listed = || {
        let listed = runtime.block_on(find_servers(lds, SOON)).unwrap();
        listed.iter().any(|one| one.name == DEVICE[1])
    };
    eventually("the component is missed", SOON, || {
        (!is_listed()).then_some(())
    });
}

/// Returns the nodes of a path of names below Objects.
async fn nodes(client: &OpcUaClient, path: &[String]) -> Option<Vec<NodeId>> {
    let mut nodes = vec![NodeId::from(ObjectId::ObjectsFolder)];
    for name in path {
        let below = client.browse(nodes.last()?, Browse::hierarchical()).await;
        let below = below.ok()?;
        let next = below
            .iter()
            .find(|one| one.browse_name.name.as_ref() == name);
        nodes.push(next?.node_id.node_id.clone());
    }
    Some(nodes)
}

/// Returns the path of the method below the component.
async fn search(client: &OpcUaClient) -> Option<Vec<String>> {
    let path = DEVICE.map(str::to_owned).to_vec();
    let mut left = vec![(nodes(client, &path).await?.pop()?, path)];
    while let Some((node, path)) = left.pop() {
        let below = client.browse(&node, Browse::hierarchical()).await;
        for one in below.unwrap_or_default() {
            let name = one.browse_name.name.as_ref().to_owned();
            let is_it = name == "Reset";
            let path = [path.clone(), vec![name]].concat();
            if is_it {
                return Some(path);
            }
            if path.len() < DEVICE.len() + 6 {
                left.push((one.node_id.node_id, path));
            }
        }
    }
    None
}

/// Measures many registering servers: the time until all are listed, and their cost when idle.
fn many(servers: usize) -> Option<()> {
    let _cell = Cell::with(&[])?;
    let lds = lds(&[]);
    let runtime = runtime();
    let (began, crowd) = (Instant::now(), servers);
    let told: Vec<ServerAnnouncement> = runtime.block_on(async {
        let mut told = Vec::new();
        for at in 0..crowd {
            let name = format!("crowd-{at}");
            told.push(plugged(&name, Ipv4Addr::LOCALHOST, Some(LDS)).await);
        }
        told
    });
    let all = async {
        let registered = async {
            while find_servers(LDS, SOON).await.unwrap_or_default().len() < servers {
                tokio::time::sleep(LOOK_EVERY).await;
            }
            began.elapsed()
        };
        let announced = async {
            loop {
                let listed = find_servers_on_network(LDS, SOON).await;
                if listed.unwrap_or_default().len() >= servers {
                    return began.elapsed();
                }
                tokio::time::sleep(LOOK_EVERY).await;
            }
        };
        let both = async { tokio::join!(registered, announced) };
        tokio::time::timeout(SOON * 2, both).await.unwrap()
    };
    let (registered, announced) = runtime.block_on(all);
    let ear = group_member(MDNS);
    ear.set_nonblocking(true).unwrap();
    let idle = cpu_share(lds.id(), WINDOW);
    let mut packet = [0; 9000];
    let (mut packets, mut bytes) = (0_u32, 0);
    while let Ok(length) = ear.recv(&mut packet) {
        packets += 1;
        bytes += length;
    }
    println!(
        "\n{servers} servers register with one discovery server, which announces them and tries each once a second:\n"
    );
    println!(
        "| all registered | all announced | in RAM | of a processor, idle | mDNS packets per s | bytes per s |\n|---|---|---|---|---|---|"
    );
    println!(
        "| {:.0} ms | {:.0} ms | {:.1} MB | {:.1} % | {:.1} | {:.0} |",
        registered.as_secs_f64() * 1e3,
        announced.as_secs_f64() * 1e3,
        resident(lds.id()) as f64 / 1e6,
        idle * 100.0,
        f64::from(packets) / WINDOW.as_secs_f64(),
        bytes as f64 / WINDOW.as_secs_f64()
    );
    runtime.block_on(async {
        for announced in told {
            drop(announced);
        }
    });
    Some(())
}

fn lds(args: &[&str]) -> Child {
    let child = StartedChild::new("ua-lds", &program("ua-lds"))
        .args(args)
        .start();
    eventually("ua-lds answers", SOON, || {
        std::net::TcpStream::connect(LDS.trim_start_matches("opc.tcp://")).ok()
    });
    child
}

const LDS: &str = "opc.tcp://127.0.0.1:4840";
/// The path of the component at the other workstation.
const DEVICE: [&str; 4] = ["Neighbours", "station-2", "Devices", "parallel-gripper"];
const MDNS: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(224, 0, 0, 251), 5353);
const SOON: Duration = Duration::from_secs(20);
const WINDOW: Duration = Duration::from_secs(20);
const LOOK_EVERY: Duration = Duration::from_millis(2);
