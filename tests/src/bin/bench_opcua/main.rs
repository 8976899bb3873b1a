//! `cargo xtask bench opcua`: ua-server compared with third-party servers, with the same client for
//! all, and the delivery of values of the space to clients.

mod confirmed;
mod connect;
mod feed;
mod items;
mod latency;
mod nodes;
mod rate;
mod servers;
mod services;

use std::process::ExitCode;

use system_tests::{Cell, Peer};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let Some(plan) = Plan::of(&args) else {
        print!("{HELP}");
        return ExitCode::from(64);
    };
    if plan.help {
        print!("{HELP}");
        return ExitCode::SUCCESS;
    }
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua, Peer::Ros2]) else {
        return ExitCode::FAILURE;
    };
    // The runtime's threads are in the network of this thread.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    if BESIDE.iter().any(|part| plan.has(part)) {
        let mut servers = servers::all(&cell, servers::ITEMS);
        if plan.has("services") {
            runtime.block_on(services::measure(&cell, &servers, plan.requests));
        }
        if plan.has("connect") {
            runtime.block_on(connect::measure(&cell, &servers, plan.connects));
        }
        if plan.has("items") {
            items::measure(&runtime, &mut servers, plan.seconds);
        }
    }
    if plan.has("confirmed") {
        runtime.block_on(confirmed::measure(&cell, plan.requests));
    }
    if plan.has("latency") {
        latency::measure(&cell, &runtime, plan.requests);
    }
    if plan.has("rate") {
        rate::measure(&cell, &runtime, plan.seconds);
    }
    if plan.has("nodes") {
        nodes::measure(&cell, &runtime, plan.nodes);
    }
    ExitCode::SUCCESS
}

/// The benchmarks to run and their sizes.
struct Plan {
    help: bool,
    /// The parts to run; all parts if empty.
    parts: Vec<String>,
    /// Requests of each kind to each server.
    requests: usize,
    /// Connections with each policy to each server.
    connects: usize,
    /// Duration of changing values and of fifty topics.
    seconds: u64,
    /// Nodes in the largest address space.
    nodes: usize,
}

impl Plan {
    /// Returns the plan, or `None` if the arguments are invalid.
    fn of(args: &[String]) -> Option<Self> {
        let mut plan = Self {
            help: false,
            parts: Vec::new(),
            requests: 2000,
            connects: 50,
            seconds: 20,
            nodes: 100_000,
        };
        let mut args = args.iter();
        while let Some(arg) = args.next() {
            match arg.as_str() {
                "--help" | "-h" => plan.help = true,
                "--quick" => {
                    plan = Self {
                        requests: 200,
                        connects: 5,
                        seconds: 3,
                        nodes: 2000,
                        ..plan
                    }
                }
                "--requests" => plan.requests = positive(args.next())?,
                "--connects" => plan.connects = positive(args.next())?,
                "--seconds" => plan.seconds = u64::try_from(positive(args.next())?).ok()?,
                "--nodes" => plan.nodes = positive(args.next())?,
                part if PARTS.contains(&part) => plan.parts.push(part.to_owned()),
                _ => return None,
            }
        }
        Some(plan)
    }

    fn has(&self, part: &str) -> bool {
        self.parts.is_empty() || self.parts.iter().any(|wanted| wanted == part)
    }
}

fn positive(arg: Option<&String>) -> Option<usize> {
    arg?.parse().ok().filter(|number| *number > 0)
}

/// Parts that need all servers.
const BESIDE: [&str; 3] = ["services", "connect", "items"];
const PARTS: [&str; 7] = [
    "services",
    "connect",
    "items",
    "confirmed",
    "latency",
    "rate",
    "nodes",
];

const HELP: &str = "\
bench-opcua [--quick] [--requests N] [--connects N] [--seconds N] [--nodes N] [PART..]

  --quick        a trial of a minute or two; its figures are no measurement
  --requests N   of each kind to each server, and values from the space to a client, 2000 unless told
  --connects N   connections with each policy to each server, 50 unless told
  --seconds N    how long values change, 20 unless told
  --nodes N      variables in the largest address space, 100000 unless told
  PART           services, connect, items, confirmed, latency, rate, nodes; all unless told
";
