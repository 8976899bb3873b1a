//! `cargo xtask bench skills station`: many devices with many skills below one station.

use std::fs;
use std::ops::Range;
use std::time::{Duration, Instant};

use skills::{ClientOptions, ParameterType, RunnableSkill as _, SkillClient};
use system_tests::{
    Cell, Child, PlantSite, StartedChild, Times, cpu_share, eventually, metrics, processor_time,
    program, resident,
};

/// Measures the time until the skills of all devices are seen above the station, the duration of
/// runs through the station, and the resources of the station when idle.
pub(crate) fn all(devices: usize, skills: usize, runs: usize) -> Option<()> {
    let cell = Cell::with(&[])?;
    let (bus, inside) = (cell.segment(), cell.segment());
    let [top, middle, bottom] = [cell.site(), cell.site(), cell.site()];
    bus.plug(&top, "bus0", "10.80.0.1");
    bus.plug(&middle, "upper0", "10.80.0.11");
    inside.plug(&middle, "lower0", "10.80.1.1");
    inside.plug(&bottom, "dev0", "10.80.1.21");
    let station = station(&middle);
    eventually("the station serves", SOON, || {
        middle.within(|| seen(skills)).map(drop)
    });
    let began = Instant::now();
    let children: Vec<Child> = (0..devices)
        .map(|number| device(&cell, &bottom, (number, skills)))
        .collect();
    let started = began.elapsed();
    let serve = eventually("all devices serve", SOON, || {
        pause();
        let serving = bottom.within(|| listening(FIRST_PORT..FIRST_PORT + devices));
        (serving >= devices).then(|| began.elapsed())
    });
    let shown = eventually("all devices are shown", SOON, || {
        pause();
        let seen = middle.within(|| seen(skills))?;
        (seen >= devices).then(|| began.elapsed())
    });
    let load = Load::until_now(&station, &children, &bottom);
    let (listed, found, mut times) = top.within(|| above(runs));
    assert_eq!(found, devices * skills, "skills above the station");
    let idle = cpu_share(station.id(), WINDOW);
    println!("\n{devices} devices of {skills} skills below one station:\n");
    println!(
        "| all started | all serve | all shown above | listed by a client in | run of 1 ms, p50 | p99 | RAM of the station | of a processor, idle |\n|---|---|---|---|---|---|---|---|"
    );
    println!(
        "| {:.1} s | {:.1} s | {:.1} s | {:.2} s | {:.1} ms | {:.1} ms | {:.1} MB | {:.1} % |",
        started.as_secs_f64(),
        serve.as_secs_f64(),
        shown.as_secs_f64(),
        listed.as_secs_f64(),
        times.at(0.5) / 1e3,
        times.at(0.99) / 1e3,
        resident(station.id()) as f64 / 1e6,
        idle * 100.0
    );
    println!(
        "\nUntil all were shown, the devices took {:.1} s of processor time ({:.0} ms each), the station {:.1} s. Each device received {:.0} UDP datagrams, and the kernel dropped {:.0} for it.",
        load.devices.as_secs_f64(),
        load.devices.as_secs_f64() * 1e3 / devices as f64,
        load.station.as_secs_f64(),
        load.received as f64 / devices as f64,
        load.dropped as f64 / devices as f64
    );
    drop(children);
    Some(())
}

/// The work of the programs so far.
struct Load {
    devices: Duration,
    station: Duration,
    /// UDP datagrams that the devices received.
    received: u64,
    /// UDP datagrams that the kernel dropped for the devices, by their filters and for full
    /// buffers.
    dropped: u64,
}

impl Load {
    fn until_now(station: &Child, children: &[Child], bottom: &PlantSite) -> Self {
        let times = children.iter().map(|child| processor_time(child.id()));
        Self {
            devices: times.sum(),
            station: processor_time(station.id()),
            received: bottom
                .within(|| datagrams("InDatagrams"))
                .unwrap_or_default(),
            dropped: bottom.within(|| datagrams("InErrors")).unwrap_or_default(),
        }
    }
}

/// Returns a count of UDP datagrams of this host by its name in `/proc/net/snmp`.
fn datagrams(counted: &str) -> Option<u64> {
    let counters = fs::read_to_string("/proc/thread-self/net/snmp").ok()?;
    let mut of_udp = counters.lines().filter(|line| line.starts_with("Udp: "));
    let (names, counts) = (of_udp.next()?, of_udp.next()?);
    let mut both = names.split(' ').zip(counts.split(' '));
    both.find(|(name, _)| *name == counted)?.1.parse().ok()
}

/// Returns the number of these TCP ports of this host that accept connections.
fn listening(ports: Range<usize>) -> usize {
    let sockets = fs::read_to_string("/proc/thread-self/net/tcp").unwrap_or_default();
    let open = sockets.lines().filter_map(|line| {
        let mut fields = line.split_whitespace().skip(1);
        let (local, _, state) = (fields.next()?, fields.next()?, fields.next()?);
        let (_, port) = local.split_once(':')?;
        (state == LISTENS).then(|| usize::from_str_radix(port, 16).ok())?
    });
    open.filter(|port| ports.contains(port)).count()
}

/// Waits before the next look at the programs, so that looking is not what they are busy with: the
/// status of a hundred servers is a page of its own.
fn pause() {
    std::thread::sleep(LOOK_EVERY);
}

fn station(at: &PlantSite) -> Child {
    let levels = [
        "--endpoint",
        "opc.tcp://10.80.1.1:4840",
        "--interface",
        "lower0",
    ];
    let upper = ["--upper-interface", "upper0", "--upper-endpoint", UPPER];
    StartedChild::new("station", &program("ua-station"))
        .args([
            "--name",
            "station",
            "--allow-unsecured",
            "--metrics",
            STATUS,
        ])
        .args(levels)
        .args(upper)
        .at(at)
        .start()
}

/// Starts a component with skills that complete their actions at once.
fn device(cell: &Cell, at: &PlantSite, (number, skills): (usize, usize)) -> Child {
    let name = format!("device-{number}");
    let mut yaml = format!(
        "component: {name}\napplication_uri: urn:ua-bridge:bench:{name}\nnamespace: {}\nsecurity: [None]\nskills:\n",
        number + 1
    );
    for skill in 0..skills {
        yaml.push_str(&format!(
            "  - {{name: Release{skill}, type: ReleaseSkillType, driver: {{simulated: {{duration: 1 ms}}}}}}\n"
        ));
    }
    let endpoint = format!("opc.tcp://10.80.1.21:{}", FIRST_PORT + number);
    StartedChild::new(&name, &program("ua-component"))
        .args([cell.file(&format!("{name}.yaml"), &yaml)])
        .args(["--endpoint", &endpoint, "--lds", "opc.tcp://10.80.1.1:4840"])
        .args(["--interface", "dev0"])
        .at(at)
        .start()
}

/// Returns the number of devices in the station that have skills with at least five methods.
fn seen(skills: usize) -> Option<usize> {
    let status = metrics(STATUS)?;
    let below = status["level"]["below"].as_array()?;
    let methods = below.iter().map(|one| one["server"]["methods"].as_u64());
    let least = u64::try_from(5 * skills).unwrap();
    Some(
        methods
            .filter(|methods| methods.is_some_and(|methods| methods >= least))
            .count(),
    )
}

/// Lists the skills as a client above the station, and runs the first. Returns the time to list
/// them, their number, and the durations of the runs.
fn above(runs: usize) -> (Duration, usize, Times) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let options = ClientOptions {
            within: SOON,
            ..ClientOptions::default()
        };
        let client = SkillClient::connect(UPPER, &options).await.unwrap();
        let began = Instant::now();
        let of = ParameterType::own("ReleaseSkillType");
        let found = client.skills_of(&of).await.unwrap();
        let listed = began.elapsed();
        let handle = client.handle(&found[0]);
        let mut times = Times::default();
        for _ in 0..runs {
            let began = Instant::now();
            let outcome = handle.run(Vec::new(), SOON).await.unwrap();
            assert!(outcome.succeeded, "{}", outcome.message);
            times.add(began.elapsed());
        }
        client.close().await;
        (listed, found.len(), times)
    })
}

const UPPER: &str = "opc.tcp://10.80.0.11:4841";
const STATUS: &str = "127.0.0.1:9104";
const FIRST_PORT: usize = 20_000;
const SOON: Duration = Duration::from_secs(300);
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// The state of a listening socket in `/proc/net/tcp`.
const LISTENS: &str = "0A";
const WINDOW: Duration = Duration::from_secs(20);
