//! `cargo xtask bench skills`: the delays of a client, the duration of a skill's methods compared
//! with a plain method, many skills in a server, many devices below a station, the round trips of a
//! skill beside those of services, methods and values, and the time from the lock of a tool until
//! its skills are found.

mod crowd;
mod finding;
mod lock;
mod rtt;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use plant_opcua::client::{ClientConfig, MonitoredWatch, Notice, OpcUaClient, Select};
use plant_opcua::types::{Array, NodeId, ObjectTypeId, Variant, VariantScalarTypeId};
use skills::{ClientOptions, SkillClient};
use system_tests::{Cell, Child, StartedChild, Times, cpu_share, eventually, program, resident};
use tokio::runtime::Runtime;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let number = |name: &str, usual: usize| -> Option<usize> {
        match args.iter().position(|arg| arg == name) {
            None => Some(usual),
            Some(at) => args.get(at + 1)?.parse().ok(),
        }
    };
    let is = |name: &str| args.first().is_some_and(|arg| arg == name);
    let few_runs = is("finding") || is("lock");
    let (Some(runs), Some(skills), Some(servers), Some(devices), Some(boot)) = (
        number("--runs", if few_runs { 20 } else { 200 }),
        number("--skills", if is("station") { 20 } else { 1_000 }),
        number("--servers", 500),
        number("--devices", 100),
        number("--boot", 0),
    ) else {
        print!("{HELP}");
        return ExitCode::from(64);
    };
    if args.iter().any(|arg| arg == "--help") {
        print!("{HELP}");
        return ExitCode::SUCCESS;
    }
    let measured = match args.first().map(String::as_str) {
        Some("finding") => Some(finding::all(runs, servers)),
        Some("station") => Some(crowd::all(devices, skills, runs)),
        Some("rtt") => Some(rtt::all(runs)),
        Some("lock") => Some(lock::all(runs, boot)),
        Some(_) | None => None,
    };
    if let Some(measured) = measured {
        return measured.map_or(ExitCode::FAILURE, |()| ExitCode::SUCCESS);
    }
    let Some(cell) = Cell::with(&[]) else {
        return ExitCode::FAILURE;
    };
    // The runtime's threads are in the network of this thread.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let _component = component(&cell, 1, &mut Times::default());
    runtime.block_on(events(runs));
    runtime.block_on(methods(runs));
    drop(_component);
    many(&cell, &runtime, skills);
    ExitCode::SUCCESS
}

const HELP: &str = "\
cargo xtask bench skills [--runs N] [--skills N]
cargo xtask bench skills finding [--runs N] [--servers N]
cargo xtask bench skills station [--devices N] [--skills N] [--runs N]
cargo xtask bench skills rtt [--runs N]
cargo xtask bench skills lock [--runs N] [--boot S]

  --runs N     runs, calls and round trips of each kind (200); servers that are plugged in, and
               tools that are locked (20)
  --skills N   skills in one server (1000), or in each device (20)
  --servers N  servers that register with one discovery server (500)
  --devices N  devices below one station (100)
  --boot S     time that a locked tool needs to boot, in s (0)
";

/// Starts a component with this number of grippers that complete their actions at once.
fn component(cell: &Cell, pairs: usize, ready: &mut Times) -> Child {
    let mut yaml =
        "component: bench\napplication_uri: urn:ua-bridge:bench\nnamespace: 9\nskills:\n"
            .to_owned();
    for pair in 0..pairs {
        for (name, of) in [("Grasp", "GraspSkillType"), ("Release", "ReleaseSkillType")] {
            yaml.push_str(&format!(
                "  - {{name: {name}{pair}, type: {of}, driver: {{simulated: {{duration: 1 ms}}}}}}\n"
            ));
        }
    }
    let began = Instant::now();
    let child = StartedChild::new("ua-component", &program("ua-component"))
        .args([cell.file("bench.yaml", &yaml)])
        .args(["--endpoint", ENDPOINT, "--lds", "none", "--interface", "lo"])
        .start();
    eventually("the component serves", SOON, || {
        std::net::TcpStream::connect(ENDPOINT.trim_start_matches("opc.tcp://")).ok()
    });
    ready.add(began.elapsed());
    child
}

async fn client() -> OpcUaClient {
    let config = ClientConfig {
        timeout: SOON,
        ..ClientConfig::new("urn:ua-bridge:bench:client", "bench")
    };
    let client = OpcUaClient::open(config, ENDPOINT);
    client.up(SOON).await.unwrap();
    client
}

fn node(id: u32) -> NodeId {
    NodeId::new(1, id)
}

/// Measures from a Start to its answer and to the event for Running, and from this event to the end
/// of the run.
async fn events(runs: usize) {
    let client = client().await;
    let select = ["Transition/Number"];
    let watch = MonitoredWatch::Events {
        node: node(100),
        select: select
            .iter()
            .map(|path| Select::new(ObjectTypeId::BaseEventType, path))
            .collect(),
        of_type: None,
    };
    for interval in [10, 20, 100] {
        let mut events =
            client.subscribe(vec![watch.clone()], Duration::from_millis(interval), 100);
        while events.next().await != Some(Notice::Subscribed) {}
        let (mut answered, mut running, mut ended) =
            (Times::default(), Times::default(), Times::default());
        // The result may be bad, because the skill may be Ready already.
        let _reset = client.call(&node(100), &node(109), Vec::new()).await;
        for _ in 0..runs {
            let began = Instant::now();
            client
                .call(&node(100), &node(105), Vec::new())
                .await
                .unwrap();
            answered.add(began.elapsed());
            until(&mut events, 2).await;
            running.add(began.elapsed());
            until(&mut events, 4).await;
            ended.add(began.elapsed());
        }
        println!(
            "\n{runs} runs of 1 ms, events asked for every {interval} ms; milliseconds since Start:\n"
        );
        println!("| what | p50 | p99 |\n|---|---|---|");
        for (what, times) in [
            ("Start is answered", &mut answered),
            ("the event ReadyToRunning is there", &mut running),
            ("the event RunningToReady is there", &mut ended),
        ] {
            println!(
                "| {what} | {:.2} | {:.2} |",
                times.at(0.5) / 1e3,
                times.at(0.99) / 1e3
            );
        }
    }
    client.close().await;
}

/// Waits for the transition with this number.
async fn until(events: &mut plant_opcua::client::ClientSubscription, number: u32) {
    loop {
        if let Some(Notice::Event { fields, .. }) = events.next().await
            && fields.first() == Some(&Variant::UInt32(number))
        {
            return;
        }
    }
}

/// Measures a method without effect, compared with the methods of a skill.
async fn methods(runs: usize) {
    let client = client().await;
    let none = |value_type| {
        Variant::Array(Box::new(Array {
            value_type,
            values: Vec::new(),
            dimensions: None,
        }))
    };
    let execute = || {
        vec![
            none(VariantScalarTypeId::String),
            none(VariantScalarTypeId::Variant),
            Variant::Double(0.0),
        ]
    };
    let outcome = || vec![Variant::UInt32(0)];
    let skill = node(100);
    // The lease of the previous client ends a moment after its session.
    let until = Instant::now() + Duration::from_secs(5);
    while let Err(error) = client.call(&skill, &node(120), execute()).await {
        assert!(Instant::now() < until, "{error}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    while client
        .call(&skill, &node(121), outcome())
        .await
        .unwrap()
        .first()
        != Some(&Variant::Boolean(true))
    {
        assert!(Instant::now() < until, "the first run does not end");
    }
    let (mut plain, mut begun, mut whole) = (Times::default(), Times::default(), Times::default());
    for _ in 0..runs {
        let began = Instant::now();
        client.call(&skill, &node(121), outcome()).await.unwrap();
        plain.add(began.elapsed());
        let began = Instant::now();
        client.call(&skill, &node(120), execute()).await.unwrap();
        begun.add(began.elapsed());
        loop {
            let told = client.call(&skill, &node(121), outcome()).await.unwrap();
            if told.first() == Some(&Variant::Boolean(true)) {
                break;
            }
        }
        whole.add(began.elapsed());
    }
    println!("\n{runs} calls of each method, in turns; microseconds:\n");
    println!("| method | p50 | p99 |\n|---|---|---|");
    for (what, times) in [
        ("ReadOutcome: answered from memory", &mut plain),
        ("Execute: begins a run", &mut begun),
        (
            "Execute, and ReadOutcome until a run of 1 ms has ended",
            &mut whole,
        ),
    ] {
        println!("| {what} | {:.0} | {:.0} |", times.at(0.5), times.at(0.99));
    }
    client.close().await;
}

/// Measures many skills in a server: the time to start and to be listed, and the resources when
/// idle.
fn many(cell: &Cell, runtime: &Runtime, skills: usize) {
    println!(
        "\n| skills | serves after | listed in | in RAM | of a processor, idle |\n|---|---|---|---|---|"
    );
    for skills in [2, 100.min(skills), skills] {
        let mut ready = Times::default();
        let component = component(cell, skills.div_ceil(2), &mut ready);
        let (found, listed) = runtime.block_on(async {
            let options = ClientOptions {
                within: SOON,
                ..ClientOptions::default()
            };
            let client = SkillClient::connect(ENDPOINT, &options).await.unwrap();
            let began = Instant::now();
            let found = client.skills().await.unwrap().len();
            let listed = began.elapsed();
            client.close().await;
            (found, listed)
        });
        let idle = cpu_share(component.id(), Duration::from_secs(10));
        println!(
            "| {found} | {:.0} ms | {:.0} ms | {:.1} MB | {:.2} % |",
            ready.at(0.5) / 1e3,
            listed.as_secs_f64() * 1e3,
            resident(component.id()) as f64 / 1e6,
            idle * 100.0
        );
    }
}

const ENDPOINT: &str = "opc.tcp://127.0.0.1:4855";
const SOON: Duration = Duration::from_secs(60);
