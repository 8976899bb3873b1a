//! Large address spaces: the time until they are served, and the resources they use.

use std::fmt::Write as _;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use plant_opcua::client::OpcUaClient;
use plant_opcua::types::{NodeId, StatusCode};
use system_tests::{Cell, METRICS_SERVER, SERVER_ENDPOINT, cpu_share, eventually, resident};
use tokio::runtime::Runtime;

use crate::servers::{BenchServer, START, asyncua, node_opcua, pairs, plain, variable};

pub(crate) fn measure(cell: &Cell, runtime: &Runtime, most: usize) {
    println!(
        "\nFrom the start of the process to the first answer, which is a Read of the last variable:\n"
    );
    println!("| variables | server | first answer | in RAM | of a processor, idle |");
    println!("|---|---|---|---|---|");
    for count in [LEAST, most / 10, most] {
        ours(cell, runtime, (count, History::Usual));
        if count == LEAST {
            ours(cell, runtime, (count, History::Off));
        }
        // asyncua takes minutes for ten thousand nodes.
        for (start, most) in [(asyncua as Start, 1000), (node_opcua, 10_000)] {
            if count > most {
                continue;
            }
            let pairs = pairs(cell);
            let began = Instant::now();
            let server = start(cell, count, &pairs);
            let answer = runtime.block_on(answers(server.endpoint, variable(count - 1)));
            assert!(answer.is_good(), "{} answers {answer}", server.name);
            shown(count, server.name, began.elapsed(), server.id());
        }
    }
}

/// Whether the server keeps past values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum History {
    Usual,
    Off,
}

impl History {
    const fn server(self) -> &'static str {
        match self {
            Self::Usual => "ua-server",
            Self::Off => "ua-server, no history",
        }
    }
}

fn ours(cell: &Cell, runtime: &Runtime, (count, history): (usize, History)) {
    let mut text = mapping(count);
    if history == History::Off {
        text.push_str("server: {history: {values: 0}}\n");
    }
    let mapping = cell.file("nodes.yaml", &text);
    let began = Instant::now();
    let path = mapping.to_string_lossy();
    // `ua_server` expects the metrics page soon; this measurement waits for the endpoint.
    let mut child = cell.ua_server_started(&[&path]).start();
    let listens = || TcpStream::connect(SERVER_ENDPOINT.trim_start_matches("opc.tcp://")).is_ok();
    let serves = eventually("the server listens or ends", LONGEST, || {
        match child.runs() {
            true => listens().then_some(true),
            false => Some(false),
        }
    });
    if !serves {
        let told = child.lines();
        let why = told.first().map_or("it ended", String::as_str);
        println!("| {count} | {} | {why} | | |", history.server());
        return;
    }
    let last = NodeId::new(namespace(count - 1), id(count - 1));
    let answer = runtime.block_on(answers(SERVER_ENDPOINT, last));
    assert_eq!(answer, StatusCode::BadWaitingForInitialData);
    shown(count, history.server(), began.elapsed(), child.id());
    assert!(system_tests::metrics(METRICS_SERVER).is_some());
}

fn shown(count: usize, name: &str, took: Duration, process: u32) {
    let idle = cpu_share(process, Duration::from_secs(5));
    println!(
        "| {count} | {name} | {:.0} ms | {:.0} MB | {:.1} % |",
        took.as_secs_f64() * 1e3,
        resident(process) as f64 / 1e6,
        idle * 100.0
    );
}

/// Returns the status of a variable as soon as the server answers.
async fn answers(endpoint: &str, node: NodeId) -> StatusCode {
    let mut config = plain();
    config.backoff = (Duration::from_millis(10), Duration::from_millis(50));
    let client = OpcUaClient::open(config, endpoint);
    client.up(LONGEST).await.unwrap();
    let until = Instant::now() + START;
    loop {
        let read = client.read(std::slice::from_ref(&node)).await.unwrap();
        let status = read.first().and_then(|value| value.status);
        let status = status.unwrap_or(StatusCode::Good);
        if status != StatusCode::BadNodeIdUnknown || Instant::now() > until {
            client.close().await;
            return status;
        }
    }
}

/// Writes a mapping of variables of space 2 in folders of a thousand, in as many namespaces as
/// their numbers need.
fn mapping(count: usize) -> String {
    let mut text = "spaces: [{id: 2}]\nnamespaces:\n".to_owned();
    for index in 2..=namespace(count - 1) {
        writeln!(text, "  {index}: 'urn:ua-bridge:bench:{index}'").unwrap();
    }
    text.push_str("variables:\n");
    for number in 0..count {
        let (index, id, folder) = (namespace(number), id(number), number / 1000);
        writeln!(
            text,
            "  - {{node: ns={index};i={id}, name: f{folder}.v{number}, type: Double, origin: 2}}"
        )
        .unwrap();
    }
    text
}

fn namespace(number: usize) -> u16 {
    2 + u16::try_from(number / A_NAMESPACE).unwrap()
}

fn id(number: usize) -> u32 {
    1 + u32::try_from(number % A_NAMESPACE).unwrap()
}

/// The smallest address space.
const LEAST: usize = 1000;
/// A DataSetWriterId has 16 bits.
const A_NAMESPACE: usize = 50_000;
type Start = fn(&Cell, usize, &str) -> BenchServer;

const LONGEST: Duration = Duration::from_secs(600);
