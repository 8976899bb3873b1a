//! Fifty topics at 1 kHz each into ua-server.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use plant_opcua::client::{ClientSubscription, MonitoredWatch, Notice, OpcUaClient, Sampled};
use system_tests::{
    Cell, METRICS_SERVER, all_overflowed, eventually, metrics, micros, now, number, per_message,
};
use tokio::runtime::Runtime;

use crate::feed::ValueSender;
use crate::servers::{BenchServer, START, ours, plain, variable};

pub(crate) fn measure(cell: &Cell, runtime: &Runtime, seconds: u64) {
    println!("\n{TOPICS} topics at 1 kHz each from UADP into ua-server, {seconds} s:\n");
    println!(
        "| values a datagram | client | sent | taken | lost | of these in sockets | told to the client | CPU share | CPU per value |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for a_datagram in [1, 25] {
        for client in [Hears::Nobody, Hears::Newest, Hears::Each] {
            let server = ours(cell, TOPICS);
            row(&server, runtime, (a_datagram, client), seconds);
        }
    }
}

/// The subscription of a client to the values, published each 100 ms.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Hears {
    Nobody,
    Newest,
    Each,
}

impl Hears {
    const fn shown(self) -> &'static str {
        match self {
            Self::Nobody => "none",
            Self::Newest => "the newest each 100 ms",
            Self::Each => "each value",
        }
    }
}

fn row(server: &BenchServer, runtime: &Runtime, (a_datagram, hears): (usize, Hears), seconds: u64) {
    let heard = (hears != Hears::Nobody).then(|| runtime.block_on(subscribed(server, hears)));
    let mut sender = ValueSender::new();
    let taken = || metrics(METRICS_SERVER).map(|status| number(&status, "delivered"));
    eventually("a value comes in", START, || {
        sender.send(&[0], 0, 0.0);
        taken().filter(|count| *count > 0)
    });
    let (before, overflowed) = (settled(taken), all_overflowed());
    let ticks = seconds * 1000;
    let sent = ticks * TOPICS as u64;
    let used = server.used();
    let done = AtomicBool::new(false);
    let (told, took, used) = std::thread::scope(|scope| {
        let (done, counted) = (&done, heard);
        let counting = scope.spawn(move || counted.map(|heard| counted_by(runtime, heard, done)));
        let began = Instant::now();
        send(&mut sender, a_datagram, ticks);
        let (took, used) = (began.elapsed(), server.used() - used);
        done.store(true, Ordering::Release);
        (counting.join().unwrap(), took, used)
    });
    let count = settled(taken) - before;
    let lost = overflowed.zip(all_overflowed()).map_or_else(
        || "unknown".to_owned(),
        |(before, after)| (after - before).to_string(),
    );
    let told = told.map_or_else(|| "-".to_owned(), |count| count.to_string());
    println!(
        "| {a_datagram} | {} | {sent} | {count} | {} | {lost} | {told} | {:.0} % | {:.1} us |",
        hears.shown(),
        sent.saturating_sub(count),
        used.as_secs_f64() / took.as_secs_f64() * 100.0,
        per_message(used, sent)
    );
}

/// Waits until a count stops growing, and returns it.
fn settled(count: impl Fn() -> Option<u64>) -> u64 {
    let mut last = None;
    eventually("the server has taken all", START, || {
        let now = count()?;
        let same = last.replace(now) == Some(now);
        std::thread::sleep(Duration::from_millis(300));
        same.then_some(now)
    })
}

/// Sends every topic once in each millisecond, at absolute times.
fn send(sender: &mut ValueSender, a_datagram: usize, ticks: u64) {
    let numbers: Vec<usize> = (0..TOPICS).collect();
    let mut due = Instant::now();
    for tick in 1..=ticks {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let value = micros(now());
        for numbers in numbers.chunks(a_datagram) {
            sender.send(numbers, u16::try_from(tick % 65_536).unwrap(), value);
        }
        due += Duration::from_millis(1);
    }
}

async fn subscribed(server: &BenchServer, hears: Hears) -> (OpcUaClient, ClientSubscription) {
    let client = OpcUaClient::open(plain(), server.endpoint);
    client.up(START).await.unwrap();
    let watches = (0..TOPICS).map(|number| {
        MonitoredWatch::Sampled(Sampled {
            node: variable(number),
            interval: Duration::ZERO,
            queue: if hears == Hears::Each { 500 } else { 1 },
            deadband: 0.0,
        })
    });
    let publishing = Duration::from_millis(100);
    let mut values = client.subscribe(watches.collect(), publishing, ROOM);
    let mut first = 0;
    while first < TOPICS {
        first += usize::from(matches!(values.next().await, Some(Notice::Value { .. })));
    }
    (client, values)
}

/// Counts the values that a client receives until it is done and no more values arrive.
fn counted_by(
    runtime: &Runtime,
    (client, mut values): (OpcUaClient, ClientSubscription),
    done: &AtomicBool,
) -> u64 {
    runtime.block_on(async {
        let mut count = 0;
        loop {
            match tokio::time::timeout(SILENCE, values.next()).await {
                Ok(Some(Notice::Value { value, .. })) => {
                    count += u64::from(value.status.is_none_or(|status| status.is_good()));
                }
                Ok(_) => {}
                Err(_) if done.load(Ordering::Acquire) => break,
                Err(_) => {}
            }
        }
        client.close().await;
        count
    })
}

const TOPICS: usize = 50;
/// Number of notifications that may wait in the client.
const ROOM: usize = 200_000;
const SILENCE: Duration = Duration::from_millis(500);
