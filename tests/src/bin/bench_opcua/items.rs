//! A thousand monitored items that change about as often as their subscription is published, each
//! 100 ms.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use plant_opcua::client::{ClientSubscription, MonitoredWatch, Notice, OpcUaClient, Sampled};
use plant_opcua::types::Variant;
use system_tests::{Times, cpu_share, micros, now, resident};
use tokio::runtime::Runtime;

use crate::feed::PERIOD;
use crate::servers::{BenchServer, ITEMS, START, plain, variable};

pub(crate) fn measure(runtime: &Runtime, servers: &mut [BenchServer], seconds: u64) {
    println!(
        "\n{ITEMS} items that change each {} ms, published each {} ms, each change wanted, {seconds} s for each server; \
         milliseconds from the change:\n",
        PERIOD.as_millis(),
        PUBLISHING.as_millis()
    );
    println!(
        "| server | all told after | changes due | changes seen | lost of these | p50 | p99 | later than {} ms | CPU share | idle | in RAM |",
        LATE.as_millis()
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for server in servers {
        row(runtime, server, seconds);
    }
}

fn row(runtime: &Runtime, server: &mut BenchServer, seconds: u64) {
    let began = Instant::now();
    let (client, mut values) = runtime.block_on(subscribed(server.endpoint));
    let made = began.elapsed();
    // No value changes.
    let idle = cpu_share(server.id(), IDLE);
    server.change(true);
    let seconds = Duration::from_secs(seconds);
    let watched = runtime.block_on(async {
        watch(&mut values, SETTLING).await;
        let (from, used) = (now(), server.used());
        let mut seen = watch(&mut values, seconds).await;
        let (to, used) = (now(), server.used() - used);
        // Changes before the end may still be in transit.
        seen.extend(watch(&mut values, SETTLING).await);
        ReportedChanges::within(seen, micros(from), micros(to), used)
    });
    server.change(false);
    let ReportedChanges {
        ticks,
        distinct,
        mut delays,
        late,
        used,
    } = watched;
    let (due, changes) = (
        ITEMS * (seconds.as_millis() / PERIOD.as_millis()) as usize,
        ticks * ITEMS,
    );
    println!(
        "| {} | {:.0} | {due} | {changes} | {} | {:.1} | {:.1} | {late} | {:.0} % | {:.1} % | {:.0} MB |",
        server.name,
        made.as_secs_f64() * 1e3,
        changes.saturating_sub(distinct),
        delays.at(0.5) / 1e3,
        delays.at(0.99) / 1e3,
        used.as_secs_f64() / seconds.as_secs_f64() * 100.0,
        idle * 100.0,
        resident(server.id()) as f64 / 1e6
    );
    assert_eq!(values.dropped(), 0, "the client itself has lost some");
    runtime.block_on(client.close());
}

/// Creates a subscription and waits until all its items have reported their first value.
async fn subscribed(endpoint: &str) -> (OpcUaClient, ClientSubscription) {
    let client = OpcUaClient::open(plain(), endpoint);
    client.up(START).await.unwrap();
    let watches = (0..ITEMS).map(|number| {
        MonitoredWatch::Sampled(Sampled {
            node: variable(number),
            // Each change, as it occurs.
            interval: Duration::ZERO,
            queue: 10,
            deadband: 0.0,
        })
    });
    let mut values = client.subscribe(watches.collect(), PUBLISHING, ROOM);
    let mut told = BTreeSet::new();
    while told.len() < ITEMS {
        let next = tokio::time::timeout(START, values.next()).await;
        match next.unwrap().unwrap() {
            Notice::Value { watch, .. } => {
                told.insert(watch);
            }
            Notice::Refused { watch, status } => panic!("item {watch} is refused: {status}"),
            Notice::Subscribed | Notice::Event { .. } => {}
        }
    }
    (client, values)
}

/// An item, the time of its change, and the time of the notification.
type ItemChange = (usize, f64, f64);

async fn watch(values: &mut ClientSubscription, during: Duration) -> Vec<ItemChange> {
    let until = tokio::time::Instant::now() + during;
    let mut seen = Vec::new();
    while let Ok(notice) = tokio::time::timeout_at(until, values.next()).await {
        if let Some(Notice::Value { watch, value }) = notice
            && let Some(Variant::Double(changed)) = value.value
        {
            seen.push((watch, changed, micros(now())));
        }
    }
    seen
}

/// The notifications about the changes in a time span.
struct ReportedChanges {
    /// Number of changes of all variables.
    ticks: usize,
    /// Number of distinct changes that were reported.
    distinct: usize,
    delays: Times,
    late: usize,
    used: Duration,
}

impl ReportedChanges {
    fn within(told: Vec<ItemChange>, from: f64, to: f64, used: Duration) -> Self {
        let mut seen = Self {
            ticks: 0,
            distinct: 0,
            delays: Times::default(),
            late: 0,
            used,
        };
        let (mut ticks, mut distinct) = (BTreeSet::new(), BTreeSet::new());
        for (item, changed, at) in told {
            // All times here are positive, so their bits have the order of the numbers.
            if changed < from || changed >= to || !distinct.insert((changed.to_bits(), item)) {
                continue;
            }
            ticks.insert(changed.to_bits());
            let delay = Duration::from_secs_f64((at - changed).max(0.0) / 1e6);
            seen.late += usize::from(delay > LATE);
            seen.delays.add(delay);
        }
        (seen.ticks, seen.distinct) = (ticks.len(), distinct.len());
        seen
    }
}

const PUBLISHING: Duration = Duration::from_millis(100);
/// A change waits for the next publishing, 100 ms at most, and may miss a publishing.
const LATE: Duration = Duration::from_millis(200);
/// Number of notifications that may wait in the client.
const ROOM: usize = 200_000;
/// Duration of the measurement without changes.
const IDLE: Duration = Duration::from_secs(10);
const SETTLING: Duration = Duration::from_secs(2);
