//! Reads, browses, writes and calls, one at a time.

use std::time::{Duration, Instant};

use plant_opcua::client::{Browse, OpcUaClient, SecurityChoice};
use plant_opcua::types::{NodeId, ObjectId, ReferenceTypeId, Variant};
use system_tests::{Cell, Times, per_message};

use crate::servers::{BenchServer, METHOD, SPACE, WRITTEN, connected, variable};

pub(crate) async fn measure(cell: &Cell, servers: &[BenchServer], requests: usize) {
    println!(
        "\n{requests} requests of each kind to each server, one at a time, in turns of {TURN}; microseconds:\n"
    );
    println!("| what | security | server | p50 | p99 | p50 / asyncua | CPU of the server |");
    println!("|---|---|---|---|---|---|---|");
    for (security, shown) in [
        (SecurityChoice::None, "None"),
        (SecurityChoice::Basic256Sha256, "Basic256Sha256"),
    ] {
        let mut asked = Vec::new();
        for server in servers {
            asked.push(
                BenchSession::of(server, connected(cell, server.endpoint, security).await).await,
            );
        }
        for what in KINDS {
            kind(&mut asked, what, shown, requests).await;
        }
        for one in asked {
            one.client.close().await;
        }
    }
}

/// Measures a kind of request with all servers.
async fn kind(
    asked: &mut [BenchSession<'_>],
    what: BenchedService,
    security: &str,
    requests: usize,
) {
    // The first request of a kind is not measured: the server may have to look the node up.
    for one in &mut *asked {
        one.ask(what, 0).await;
    }
    let mut all: Vec<(Times, Duration)> = asked.iter().map(|_| Default::default()).collect();
    let mut left = requests;
    while left > 0 {
        let turn = left.min(TURN);
        left -= turn;
        for (one, (times, used)) in asked.iter_mut().zip(&mut all) {
            let before = one.server.used();
            for number in 0..turn {
                let began = Instant::now();
                one.ask(what, left + number).await;
                times.add(began.elapsed());
            }
            *used += one.server.used() - before;
        }
    }
    let measured = asked.iter().zip(&mut all);
    let rows: Vec<(&str, f64, f64, f64)> = measured
        .map(|(one, (times, used))| {
            let each = per_message(*used, times.count());
            (one.server.name, times.at(0.5), times.at(0.99), each)
        })
        .collect();
    let other = rows.iter().find(|row| row.0 == "asyncua");
    let other = other.map_or(f64::NAN, |row| row.1);
    for (name, p50, p99, used) in &rows {
        let (what, ratio) = (what.shown(), p50 / other);
        println!("| {what} | {security} | {name} | {p50:.0} | {p99:.0} | {ratio:.2} | {used:.0} |");
    }
}

const KINDS: [BenchedService; 5] = [
    BenchedService::ReadOne,
    BenchedService::ReadMany,
    BenchedService::Browse,
    BenchedService::Write,
    BenchedService::Call,
];

#[derive(Clone, Copy)]
enum BenchedService {
    ReadOne,
    ReadMany,
    Browse,
    Write,
    Call,
}

impl BenchedService {
    const fn shown(self) -> &'static str {
        match self {
            Self::ReadOne => "read 1",
            Self::ReadMany => "read 100",
            Self::Browse => "browse",
            Self::Write => "write 1",
            Self::Call => "call",
        }
    }
}

/// A server, and the session with it.
struct BenchSession<'a> {
    server: &'a BenchServer,
    client: OpcUaClient,
    nodes: Vec<NodeId>,
    object: NodeId,
}

impl<'a> BenchSession<'a> {
    async fn of(server: &'a BenchServer, client: OpcUaClient) -> Self {
        let parents = Browse::of(ReferenceTypeId::HasComponent).inverse();
        let until = Instant::now() + METHOD_THERE;
        let object = loop {
            // The object of a call of the space appears with the announcement of its executor.
            let found = client.browse(&method(), parents.clone()).await;
            match found.unwrap_or_default().first() {
                Some(parent) => break parent.node_id.node_id.clone(),
                None => assert!(Instant::now() < until, "{} has no method", server.name),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        Self {
            server,
            client,
            nodes: (0..MANY).map(variable).collect(),
            object,
        }
    }

    async fn ask(&mut self, what: BenchedService, number: usize) {
        match what {
            BenchedService::ReadOne => {
                let one = self.nodes.get(number % MANY..=number % MANY).unwrap();
                assert_eq!(self.client.read(one).await.unwrap().len(), 1);
            }
            BenchedService::ReadMany => {
                let read = self.client.read(&self.nodes).await.unwrap();
                assert_eq!(read.len(), MANY);
            }
            BenchedService::Browse => {
                // The Server object has about the same references in all servers.
                let node = ObjectId::Server.into();
                let found = self.client.browse(&node, Browse::hierarchical()).await;
                assert!(found.unwrap().len() > 5);
            }
            BenchedService::Write => {
                let written = NodeId::new(SPACE, WRITTEN);
                let value = Variant::Double(number as f64);
                let told = self.client.write(&[(written, value)]).await.unwrap();
                assert!(told.iter().all(|status| status.is_good()), "{told:?}");
            }
            BenchedService::Call => {
                let called = self.client.call(&self.object, &method(), Vec::new()).await;
                let told = called.unwrap();
                assert_eq!(told.first(), Some(&Variant::Boolean(true)), "{told:?}");
            }
        }
    }
}

fn method() -> NodeId {
    NodeId::new(SPACE, u32::from(METHOD))
}

/// Number of requests to a server before the next server's turn.
const TURN: usize = 50;
/// Number of values of a large Read.
const MANY: usize = 100;
const METHOD_THERE: Duration = Duration::from_secs(10);
