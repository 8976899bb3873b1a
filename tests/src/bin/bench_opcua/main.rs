//! `cargo xtask bench opcua`: ua-server beside servers of other makers, with one client for all, and what comes from the
//! space to clients.

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
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return ExitCode::FAILURE;
    };
    // Its threads are of the network of this one.
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

/// How much of what.
struct Plan {
    help: bool,
    /// Those to run; all when empty.
    parts: Vec<String>,
    /// Of each kind to each server.
    requests: usize,
    /// With each policy to each server.
    connects: usize,
    /// Of values that change, and of fifty topics.
    seconds: u64,
    /// In the largest address space.
    nodes: usize,
}

impl Plan {
    /// `None` when the arguments make no sense.
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

/// What needs all servers.
const BESIDE: [&str; 3] = ["services", "connect", "items"];
const PARTS: [&str; 6] = ["services", "connect", "items", "latency", "rate", "nodes"];

const HELP: &str = "\
bench-opcua [--quick] [--requests N] [--connects N] [--seconds N] [--nodes N] [PART..]

  --quick        a trial of a minute or two; its figures are no measurement
  --requests N   of each kind to each server, and values from the space to a client, 2000 unless told
  --connects N   connections with each policy to each server, 50 unless told
  --seconds N    how long values change, 20 unless told
  --nodes N      variables in the largest address space, 100000 unless told
  PART           services, connect, items, latency, rate, nodes; all unless told
";
