//! From a datagram of the space to a subscribed client.

use std::time::Duration;

use plant_opcua::client::{MonitoredWatch, Notice, OpcUaClient, Sampled};
use plant_opcua::types::Variant;
use system_tests::{Cell, Times, micros, now};
use tokio::runtime::Runtime;

use crate::feed::ValueSender;
use crate::servers::{START, ours, plain, variable};

pub(crate) fn measure(cell: &Cell, runtime: &Runtime, values: usize) {
    let server = ours(cell, 1);
    println!("\n{values} values from UADP to a subscribed client; milliseconds:\n");
    println!("| published each | values | lost | p50 | p99 | longest |");
    println!("|---|---|---|---|---|---|");
    for publishing in [10, 100] {
        let values = if publishing == 10 { values } else { values / 4 };
        let publishing = Duration::from_millis(publishing);
        let mut delays = runtime.block_on(row(server.endpoint, publishing, values));
        println!(
            "| {} ms | {values} | {} | {:.1} | {:.1} | {:.1} |",
            publishing.as_millis(),
            values as u64 - delays.count(),
            delays.at(0.5) / 1e3,
            delays.at(0.99) / 1e3,
            delays.at(1.0) / 1e3
        );
    }
}

async fn row(endpoint: &str, publishing: Duration, values: usize) -> Times {
    let client = OpcUaClient::open(plain(), endpoint);
    client.up(START).await.unwrap();
    let watch = MonitoredWatch::Sampled(Sampled {
        node: variable(0),
        interval: Duration::ZERO,
        queue: 100,
        deadband: 0.0,
    });
    let mut told = client.subscribe(vec![watch], publishing, 1000);
    while !matches!(told.next().await.unwrap(), Notice::Value { .. }) {}
    let (mut sender, mut delays) = (ValueSender::new(), Times::default());
    // Out of step with the publishing interval.
    let period = publishing * 23 / 20;
    for number in 0..values {
        let sent = micros(now());
        sender.send(&[0], u16::try_from(number % 65_536).unwrap(), sent);
        let until = tokio::time::Instant::now() + period;
        while let Ok(notice) = tokio::time::timeout_at(until, told.next()).await {
            took(notice, &mut delays);
        }
    }
    let until = tokio::time::Instant::now() + publishing * 10;
    while let Ok(notice) = tokio::time::timeout_at(until, told.next()).await {
        took(notice, &mut delays);
    }
    client.close().await;
    delays
}

fn took(notice: Option<Notice>, delays: &mut Times) {
    // The value of a silent writer is Uncertain.
    if let Some(Notice::Value { value, .. }) = notice
        && value.status.is_none_or(|status| status.is_good())
        && let Some(Variant::Double(sent)) = value.value
    {
        delays.add(Duration::from_secs_f64(
            (micros(now()) - sent).max(0.0) / 1e6,
        ));
    }
}
